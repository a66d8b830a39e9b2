"""How a pointwise map is recovered from a functional map."""

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
    """Returns two point sets in which a vertex of X lies close to its match on Y.

    The embeddings are `Phi_X` and `Phi_Y C^T` in the pullback convention, and `Phi_X C^T` and `Phi_Y` in the
    pushforward convention. The convention matters because a filtered C shrinks the vectors that it maps. In
    the pushforward convention the *queries* shrink. They all come close to the few database points of small
    norm, which become hubs that attract most queries. In the pullback convention the *database* shrinks,
    which hardly changes the order of the distances from a query. On real pairs pullback maps are good, and
    pushforward maps fail.

    **Returns:** The queries, one row per vertex of X, and the database, one row per vertex of Y.
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
    """Returns the map X -> Y of a functional map, to points anywhere on the triangles of Y.

    Ezuz and Ben-Chen, "Deblurring and denoising of maps between shapes", 2017. The triangles of Y span a
    surface in the `spectral_embeddings` of Y. Each vertex of X is mapped to the nearest point of this
    surface. Neighbouring vertices of a fine X need not share a vertex of a coarse Y, so that textures and
    other functions stay smooth when the map transfers them. The time is about ten times that of an exhaustive
    `decode`: a second for 5000 vertices, growing with the product of the sizes.

    **Arguments:**

    - `faces_y`: the triangles of Y.

    **Returns:** A face of Y for each vertex of X (m,), and the barycentric weights (m, 3) of its corners.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_point_on_triangles(queries, database, faces_y)


def search_patches(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Patches, Patches]:
    """Returns patches of both shapes for `decode`. The same patches serve all functional maps.

    The patches of Y grow with the square root of its number of vertices. Then the work per patch and the work
    per point are balanced, and the time of a search grows with the number of vertices to the power 1.5.
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

    The setting `"patches"` always uses patches. `"auto"` uses patches where they are faster.
    """
    sizes = spectrum_x.mask.shape[0] * spectrum_y.mask.shape[0]
    pays = jax.default_backend() == "cpu" and sizes >= _PATCHES_FROM**2
    if search == "patches" or (search == "auto" and pays):
        return search_patches(spectrum_x, spectrum_y)
    return None


# Above this number of vertices (the geometric mean of both shapes), patches save more time than they take to
# compile.
_PATCHES_FROM = 15_000
# The best sizes as measured with scripts/benchmark_speed.py: vertices per patch of X, and the rank and size
# of patches of Y.
_QUERIES, _RANK = 128, 5
_SMALLEST_PATCH, _VERTICES_OF_SMALLEST = 40, 5000
