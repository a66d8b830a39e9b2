"""The nearest point on a triangulated surface, in any number of dimensions."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.core.arrays import Array, in_blocks, namespace, segment_min
from jaxsmw.core.linear_algebra import product

# The number of queries per block. The distances from all queries of a block to all triangles are stored at
# the same time.
_BLOCK = 32
# The number of candidates per block in `nearest_point_on_candidates`.
_PAIRS = 4096


def nearest_point_on_triangles(
    queries: Float[Array, "m d"],
    points: Float[Array, "n d"],
    faces: Int[Array, "f 3"],
    *,
    face_mask: Bool[Array, " f"] | None = None,
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """Find, for each query, the nearest point on a set of triangles in a space of any dimension.

    The search is exact up to rounding errors, in Euclidean distance. Every query is compared with all
    triangles, but no array of size m x f is stored. If the nearest point belongs to several triangles, for
    example to a common corner, the function returns one of these triangles.

    **Arguments:**

    - `queries`: (m, d), points in d dimensions, in any unit.
    - `points`: (n, d), the corners of the triangles, in the same unit.
    - `faces`: (f, 3), for each triangle the 0-based indices of its corners in `points`.
    - `face_mask`: (f,), False for triangles that the search ignores; at least one must be True.

    **Returns:** The 0-based row of `faces` with the nearest point (m,), int32, and the barycentric weights of
    the triangle's corners (m, 3), which are not negative and sum to 1.
    """
    xp = namespace(queries, points)
    queries, points, faces = xp.asarray(queries), xp.asarray(points), xp.asarray(faces)
    corners = points[faces]
    edges = corners[:, 1:] - corners[:, :1]
    lengths = product(edges, edges.mT)
    grams = (lengths[:, 0, 0], lengths[:, 0, 1], lengths[:, 1, 1])
    starts = product(edges, corners[:, 0, :, None])[:, :, 0].T
    # |q - a|² = |q|² + |a|² - 2 q·a. The term |q|² is the same for all triangles, so `search` omits it.
    norms = xp.sum(corners[:, 0] ** 2, axis=1)
    masked = xp.zeros(len(faces), bool) if face_mask is None else ~face_mask
    columns = [value[:, None] for value in (*grams, *starts, norms)]

    def search(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
        products = product(points, block.T)
        a, b, c = (products[faces[:, corner]] for corner in range(3))
        uu, uv, vv, start_u, start_v, norm = columns
        squared, _, _ = _closest(norm - 2 * a, b - a - start_u, c - a - start_v, uu, uv, vv)
        squared = xp.where(masked[:, None], xp.inf, squared)
        return xp.argmin(squared, axis=0).astype(xp.int32)

    found = in_blocks(search, queries, _BLOCK)
    # The weights are computed from the differences `queries - corners`, because differences of inner products
    # would lose digits by cancellation.
    away = queries - corners[found, 0]
    along_u, along_v = (xp.sum(away * edges[found, edge], axis=1) for edge in (0, 1))
    _, s, t = _closest(xp.sum(away**2, axis=1), along_u, along_v, *(gram[found] for gram in grams))
    return found, _weights(s, t)


def nearest_point_on_candidates(
    queries: Float[Array, "m d"],
    points: Float[Array, "n d"],
    faces: Int[Array, "f 3"],
    rows: Int[Array, " p"],
    candidates: Int[Array, " p"],
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """Find, for each query, the nearest point on the query's own candidate triangles, in any dimension.

    The time grows with the number of candidates, not with the number of all triangles.

    **Arguments:**

    - `queries`, `points`, `faces`: as in `nearest_point_on_triangles`.
    - `rows`, `candidates`: (p,), pairs of a query and a triangle in `faces` that is a candidate for it. Every
      query needs at least one candidate.

    **Returns:** As in `nearest_point_on_triangles`.
    """

    xp = namespace(queries, points)
    rows, candidates = xp.asarray(rows), xp.asarray(candidates)

    def compare(pairs: Int[Array, "block 2"]) -> Float[Array, "block 3"]:
        corners = points[faces[pairs[:, 1]]]
        edges, away = corners[:, 1:] - corners[:, :1], queries[pairs[:, 0]] - corners[:, 0]
        along = product(edges, away[:, :, None])[:, :, 0]
        gram = product(edges, edges.mT)
        lengths = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
        return xp.stack(_closest(xp.sum(away**2, axis=1), along[:, 0], along[:, 1], *lengths), axis=1)

    compared = in_blocks(compare, xp.stack([rows, candidates], axis=1), _PAIRS)
    squared, m, p = compared[:, 0], queries.shape[0], rows.shape[0]
    least = segment_min(squared, rows, m)
    best = segment_min(xp.where(squared == least[rows], xp.arange(p), p), rows, m)
    return candidates[best].astype(xp.int32), _weights(*compared[best, 1:].T)


def _weights(s: Float[Array, " m"], t: Float[Array, " m"]) -> Float[Array, "m 3"]:
    """Return the barycentric weights of points `a + s u + t v` in triangles with corner a and edges u, v."""
    # Rounding errors can make 1 - s - t slightly negative.
    xp = namespace(s)
    weights = xp.stack([xp.maximum(1 - s - t, 0), s, t], axis=1)
    return weights / xp.sum(weights, axis=1, keepdims=True)


def _closest(
    squared: Float[Array, "*n"],
    along_u: Float[Array, "*n"],
    along_v: Float[Array, "*n"],
    uu: Float[Array, "*#n"],
    uv: Float[Array, "*#n"],
    vv: Float[Array, "*#n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Return squared distances from points q to triangles `a + s u + t v`, and s and t of the nearest points.

    `squared` is `|q - a|²` up to a constant, and `along_u` is `(q - a)·u`.
    """

    xp = namespace(squared, along_u, uu)

    def at(s: Array, t: Array) -> Array:
        change = s * (s * uu + 2 * t * uv - 2 * along_u) + t * (t * vv - 2 * along_v)
        return squared + change

    def share(along: Array, length: Array) -> Array:
        return xp.clip(along / xp.where(length > 0, length, 1), 0, 1)

    on_u, on_v = share(along_u, uu), share(along_v, vv)
    across = share(along_v - along_u + uu - uv, uu - 2 * uv + vv)
    determinant = uu * vv - uv**2
    flat = determinant <= 0
    scale = xp.where(flat, 1, determinant)
    s = (vv * along_u - uv * along_v) / scale
    t = (uu * along_v - uv * along_u) / scale
    inside = ~flat & (s >= 0) & (t >= 0) & (s + t <= 1)

    zero = xp.zeros_like(on_u)
    best, best_s, best_t = at(on_u, zero), on_u, zero
    for s_there, t_there, allowed in ((zero, on_v, True), (1 - across, across, True), (s, t, inside)):
        there = at(s_there, t_there)
        better = (there < best) & allowed
        best = xp.where(better, there, best)
        best_s, best_t = xp.where(better, s_there, best_s), xp.where(better, t_there, best_t)
    return best, best_s, best_t
