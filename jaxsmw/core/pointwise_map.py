"""The computation of pointwise maps from functional maps."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float, Int, Int32

from jaxsmw.choices import Search
from jaxsmw.core.functional_map import Convention, out_and_in
from jaxsmw.core.products import product
from jaxsmw.core.search import Patches, make_patches, nearest_vertices
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_triangles


def spectral_embeddings(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """Returns two point sets in which each vertex of X is close to its match on Y.

    The embeddings are `Phi_X` and `Phi_Y C^T` in the pullback convention, and `Phi_X C^T` and `Phi_Y` in the
    pushforward convention. The convention matters because a filtered C shrinks the vectors that it maps. In
    the pushforward convention the *queries* shrink. All queries then come close to the few database points of
    small norm, which become hubs that attract most queries. In the pullback convention the *database*
    shrinks, which hardly changes the order of the distances from a query. On real pairs pullback maps are
    good, and pushforward maps fail.

    **Arguments:**

    - `functional_map`: C, (k_X, k_Y) in the pullback convention, (k_Y, k_X) in the pushforward convention.
    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `convention`: the direction of C, `"pullback"` or `"pushforward"`.

    **Returns:** The queries (m, d), one row per vertex of X, and the database (n, d), one row per vertex of
    Y. d is the number of rows of C. Both are in the unit of the eigenvectors.
    """
    rows_out, rows_in = out_and_in(convention, spectrum_x.eigenvectors, spectrum_y.eigenvectors)
    return out_and_in(convention, rows_out, product(rows_in, functional_map.T))


def decode(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
    patches: tuple[Patches, Patches] | None = None,
) -> Int32[Array, " m"]:
    """Returns the pointwise map T: X -> Y of a functional map, by nearest neighbours (Algorithm 1, step 3).

    T maps each vertex of X to the unmasked vertex of Y that is nearest in `spectral_embeddings`.

    **Arguments:**

    - `functional_map`, `spectrum_x`, `spectrum_y`, `convention`: see `spectral_embeddings`.
    - `patches`: the `search_patches` of X and Y, which make the search faster on large shapes.

    **Returns:** One vertex of Y per vertex of X, (m,).
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_vertices(queries, database, spectrum_y.mask, patches)


def decode_to_triangles(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    faces_y: Int[Array, "f 3"],
    *,
    convention: Convention = "pullback",
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """Returns the map from vertices of X to points on the triangles of Y that follows from a functional map.

    Ezuz and Ben-Chen, "Deblurring and denoising of maps between shapes", 2017. The triangles of Y span a
    surface in the `spectral_embeddings` of Y. Each vertex of X is mapped to the nearest point of this
    surface. Neighbouring vertices of a fine X need not share a vertex of a coarse Y, so textures and other
    functions stay smooth when the map transfers them. The function takes about ten times as long as an
    exhaustive `decode`: one second for shapes of 5000 vertices. The time grows with the product of the
    numbers of vertices.

    **Arguments:**

    - `functional_map`, `spectrum_x`, `spectrum_y`, `convention`: see `spectral_embeddings`.
    - `faces_y`: the triangles of Y (f, 3), as vertex indices.

    **Returns:** A face of Y for each vertex of X (m,), and the barycentric weights (m, 3) of its corners.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_point_on_triangles(queries, database, faces_y)


def search_patches(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Patches, Patches]:
    """Returns patches of both shapes for `decode`. The same patches serve all functional maps.

    The patches of Y grow with the square root of its number of vertices. This size balances the work per
    patch and the work per point. So the time of a search grows with the number of vertices to the power 1.5.

    **Returns:** The `Patches` of X, for the queries, and the `Patches` of Y, for the database.
    """
    n = spectrum_y.mask.shape[0]
    size = max(_SMALLEST_PATCH, _SMALLEST_PATCH * (n / _VERTICES_OF_SMALLEST) ** 0.5)
    return (
        make_patches(spectrum_x.eigenvectors, spectrum_x.mask, size=_QUERIES, rank=0),
        make_patches(spectrum_y.eigenvectors, spectrum_y.mask, size=round(size), rank=_RANK),
    )


def chosen_patches(
    search: Search, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Patches, Patches] | None:
    """Returns the `search_patches` of a `search` setting, or None for an exhaustive search.

    The setting `"patches"` always uses patches, and `"exhaustive"` never does. `"auto"` uses patches if the
    default backend is a CPU and the geometric mean of the numbers of vertices is at least 15 000.
    """
    sizes = spectrum_x.mask.shape[0] * spectrum_y.mask.shape[0]
    pays = jax.default_backend() == "cpu" and sizes >= _PATCHES_FROM**2
    if search == "patches" or (search == "auto" and pays):
        return search_patches(spectrum_x, spectrum_y)
    return None


# Above this number of vertices (the geometric mean of both shapes), patches save more time than their
# compilation takes.
_PATCHES_FROM = 15_000
# The best sizes as measured with scripts/benchmark_speed.py: vertices per patch of X, and the rank and size
# of patches of Y.
_QUERIES, _RANK = 128, 5
_SMALLEST_PATCH, _VERTICES_OF_SMALLEST = 40, 5000
