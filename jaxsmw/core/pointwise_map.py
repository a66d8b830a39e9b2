"""Functional maps read back as pointwise maps."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float, Int, Int32

from jaxsmw.core.functional_map import Convention
from jaxsmw.core.products import product
from jaxsmw.core.search import (
    Patches,
    approximate_nearest_neighbor,
    make_patches,
    nearest_neighbor,
    nearest_neighbor_in_patches,
)
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_triangles


def spectral_embeddings(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """The two point sets among which a functional map looks for nearest neighbours.

    Pullback: `Phi_X` and `Phi_Y C^T`. Pushforward: `Phi_X C^T` and `Phi_Y`. The choice is not innocent: a
    filtered C shrinks what it maps. Shrunken *queries* (pushforward) all fall near the few database points
    of small norm, which become hubs that attract everything; a shrunken *database* (pullback) keeps its
    order as seen from any query. On real pairs this makes the difference between a good map and none.

    **Returns:** One row per vertex of X (the queries), one per vertex of Y (the database).
    """
    if convention == "pullback":
        return spectrum_x.eigenvectors, product(spectrum_y.eigenvectors, functional_map.T)
    return product(spectrum_x.eigenvectors, functional_map.T), spectrum_y.eigenvectors


def decode(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
    patches: tuple[Patches, Patches] | None = None,
    approximate: bool = False,
) -> Int32[Array, " m"]:
    """The pointwise map T: X -> Y of a functional map, by nearest neighbours (Algorithm 1, step 3).

    For each vertex of X the vertex of Y, masked ones excluded, that is nearest in `spectral_embeddings`;
    found faster where `search_patches` of the two shapes are given, or nearly always if approximately
    (`approximate_nearest_neighbor`).

    **Returns:** One vertex of Y per vertex of X, (m,).
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    if patches is not None:
        return nearest_neighbor_in_patches(queries, database, *patches)
    search = approximate_nearest_neighbor if approximate else nearest_neighbor
    return search(queries, database, database_mask=spectrum_y.mask)


def decode_to_triangles(
    functional_map: Float[Array, "k_out k_in"],
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    faces_y: Int[Array, "f 3"],
    *,
    convention: Convention = "pullback",
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """The map X -> Y of a functional map, to points anywhere on the triangles of Y.

    Ezuz and Ben-Chen, "Deblurring and denoising of maps between shapes", 2017: for each vertex of X the point
    nearest in `spectral_embeddings`, where those of Y's vertices are joined by Y's triangles. Neighbours on a
    fine X need not share a vertex of a coarse Y, so that what is carried along the map, such as a texture,
    comes out smooth. Takes about as long as ten searches of all by `decode`, a second for 5000 vertices, and
    grows like them with the product of the sizes.

    **Arguments:**

    - `faces_y`: the triangles of Y.

    **Returns:** A face of Y for each vertex of X (m,), and barycentric weights (m, 3) for its corners.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_point_on_triangles(queries, database, faces_y)


def search_patches(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Patches, Patches]:
    """Patches of both shapes for `decode`, whatever the functional map.

    Those of Y grow with the square root of its number of vertices, which balances the work for each patch
    with that for its points; so the search takes about the power 1.5 of the number of vertices.
    """
    n = spectrum_y.mask.shape[0]
    size = max(_SMALLEST_PATCH, _SMALLEST_PATCH * (n / _VERTICES_OF_SMALLEST) ** 0.5)
    return (
        make_patches(spectrum_x.eigenvectors, spectrum_x.mask, size=_QUERIES, rank=0),
        make_patches(spectrum_y.eigenvectors, spectrum_y.mask, size=round(size), rank=_RANK),
    )


def chosen_patches(search: str, spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Patches, Patches] | None:
    """`search_patches` where a method is to search `"patches"`, or `"auto"` and they pay; None elsewhere."""
    sizes = spectrum_x.mask.shape[0] * spectrum_y.mask.shape[0]
    pays = jax.default_backend() == "cpu" and sizes >= _PATCHES_FROM**2
    if search == "patches" or (search == "auto" and pays):
        return search_patches(spectrum_x, spectrum_y)
    return None


# From so many vertices on (in the geometric mean of both shapes) patches save more than compiling them takes.
_PATCHES_FROM = 15_000
# Measured with scripts/benchmark_speed.py.
_QUERIES, _RANK = 128, 5
_SMALLEST_PATCH, _VERTICES_OF_SMALLEST = 40, 5000
