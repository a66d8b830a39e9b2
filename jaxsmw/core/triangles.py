"""The nearest point on a surface of triangles, in any number of dimensions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.products import product
from jaxsmw.core.search import in_blocks

# Queries whose distances to all triangles are had at once.
_BLOCK = 32


def nearest_point_on_triangles(
    queries: Float[Array, "m d"],
    points: Float[Array, "n d"],
    faces: Int[Array, "f 3"],
    *,
    face_mask: Bool[Array, " f"] | None = None,
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """For every query the point nearest to it on any of some triangles, exactly, in Euclidean distance.

    All triangles are compared, with nothing of size m x f stored: the distance to one follows from the
    products of the query with its corners, whatever the dimension. Where a point of several triangles is
    nearest, such as a corner, it is given on one of them.

    **Arguments:**

    - `queries`: points in d dimensions.
    - `points`, `faces`: corners, and the three that each triangle has.
    - `face_mask`: triangles with False are left out. If all are, the result is meaningless.

    **Returns:** The triangle each nearest point lies on (m,), and its barycentric weights (m, 3) for the
    triangle's corners in their order, not negative, of sum 1.
    """
    corners = points[faces]
    edges = corners[:, 1:] - corners[:, :1]
    lengths = product(edges, jnp.swapaxes(edges, 1, 2))
    grams = (lengths[:, 0, 0], lengths[:, 0, 1], lengths[:, 1, 1])
    starts = jnp.einsum("fed,fd->ef", edges, corners[:, 0], precision="highest")
    # |q - a|² = |q|² + |a|² - 2 q·a, of which the first is the same for all triangles.
    norms = jnp.sum(corners[:, 0] ** 2, axis=1)
    masked = jnp.zeros(len(faces), bool) if face_mask is None else ~face_mask
    columns = [value[:, None] for value in (*grams, *starts, norms)]

    def search(block: Float[Array, "block d"]) -> Int32[Array, " block"]:
        products = product(points, block.T)
        a, b, c = (products[faces[:, corner]] for corner in range(3))
        uu, uv, vv, start_u, start_v, norm = columns
        squared, _, _ = _closest(norm - 2 * a, b - a - start_u, c - a - start_v, uu, uv, vv)
        squared = jnp.where(masked[:, None], jnp.inf, squared)
        return jnp.argmin(squared, axis=0).astype(jnp.int32)

    found = in_blocks(search, queries, _BLOCK)
    # Once more from differences, in which nothing cancels.
    away = queries - corners[found, 0]
    along_u, along_v = (jnp.sum(away * edges[found, edge], axis=1) for edge in (0, 1))
    _, s, t = _closest(jnp.sum(away**2, axis=1), along_u, along_v, *(gram[found] for gram in grams))
    return found, jnp.stack([1 - s - t, s, t], axis=1)


def _closest(
    squared: Float[Array, "*n"],
    along_u: Float[Array, "*n"],
    along_v: Float[Array, "*n"],
    uu: Float[Array, "*#n"],
    uv: Float[Array, "*#n"],
    vv: Float[Array, "*#n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """The nearest point `a + s u + t v` of triangles to points q, and its squared distance.

    **Arguments:**

    - `squared`: `|q - a|²`; a constant in it is one in the distance.
    - `along_u`, `along_v`: `(q - a)·u` and `(q - a)·v`, for the edges u and v from a.
    - `uu`, `uv`, `vv`: products of these edges, or an axis of length 1 where they are the same for all.
    """

    def at(s: Array, t: Array) -> Array:
        change = s * (s * uu + 2 * t * uv - 2 * along_u) + t * (t * vv - 2 * along_v)
        return squared + change

    def share(along: Array, length: Array) -> Array:
        return jnp.clip(along / jnp.where(length > 0, length, 1), 0, 1)

    on_u, on_v = share(along_u, uu), share(along_v, vv)
    across = share(along_v - along_u + uu - uv, uu - 2 * uv + vv)
    determinant = uu * vv - uv**2
    flat = determinant <= 0
    scale = jnp.where(flat, 1, determinant)
    s = (vv * along_u - uv * along_v) / scale
    t = (uu * along_v - uv * along_u) / scale
    inside = ~flat & (s >= 0) & (t >= 0) & (s + t <= 1)

    zero = jnp.zeros_like(on_u)
    best, best_s, best_t = at(on_u, zero), on_u, zero
    for s_there, t_there, allowed in ((zero, on_v, True), (1 - across, across, True), (s, t, inside)):
        there = at(s_there, t_there)
        better = (there < best) & allowed
        best = jnp.where(better, there, best)
        best_s, best_t = jnp.where(better, s_there, best_s), jnp.where(better, t_there, best_t)
    return best, best_s, best_t
