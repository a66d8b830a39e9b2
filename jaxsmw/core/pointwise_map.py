"""The computation of pointwise maps from functional maps."""

from __future__ import annotations

from jaxtyping import Float, Int, Int32

from jaxsmw.core.arrays import Array
from jaxsmw.core.functional_map import Convention, FunctionalMap, out_and_in
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.triangles import nearest_point_on_triangles


def spectral_embeddings(
    functional_map: FunctionalMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
    """Return the points of X (m, d) and of Y (n, d) in which `decode` searches, of unit 1 / length.

    In the pullback convention, the points are the rows of `Phi_X` and of `Phi_Y C^T`. In the pushforward
    convention, they are the rows of `Phi_X C^T` and of `Phi_Y`.

    The convention matters because a filtered functional map shortens the vectors that it maps. In the
    pushforward convention, C shrinks the points of X (the queries), and a few points of Y with small norms
    are then nearest to most queries. In the pullback convention, C shrinks the points of Y, which hardly
    changes the order of the distances from a query. On real shapes, refinement with filtering therefore
    succeeds only in the pullback convention.
    """
    rows_out, rows_in = out_and_in(convention, spectrum_x.eigenvectors, spectrum_y.eigenvectors)
    return out_and_in(convention, rows_out, product(rows_in, functional_map.T))


def decode(
    functional_map: FunctionalMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    *,
    convention: Convention = "pullback",
) -> Int32[Array, " m"]:
    """Recover the pointwise map T: X -> Y from a functional map C by nearest-neighbour search.

    This is step 3 of Algorithm 1 of the MWP paper. T maps each vertex of X to the unmasked vertex of Y that
    is nearest in the `spectral_embeddings`. The search is exact up to rounding errors.

    **Arguments:**

    - `functional_map`: C, without unit, in the given `convention`.
    - `spectrum_x`, `spectrum_y`, `convention`: as in `encode`.

    **Returns:** The map T, an int32 array (m,) of 0-based vertices of Y.

    **Raises:** `ValueError` for an unknown convention.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_neighbor(queries, database, database_mask=spectrum_y.mask)


def decode_to_triangles(
    functional_map: FunctionalMap,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    faces_y: Int[Array, "f 3"],
    *,
    convention: Convention = "pullback",
) -> tuple[Int32[Array, " m"], Float[Array, "m 3"]]:
    """Convert a functional map C to a map from the vertices of X to points on the triangles of Y.

    The method is that of Ezuz and Ben-Chen, "Deblurring and denoising of maps between shapes", 2017. The
    triangles of Y span a surface in the space of the `spectral_embeddings`. Each vertex of X is mapped to the
    nearest point of this surface. Unlike with `decode`, functions on Y therefore stay smooth when they are
    transferred to a finer X. For shapes of 5000 vertices, the function takes about one second, ten times as
    long as `decode`. The time grows with the product of the numbers of vertices.

    The arguments are those of `decode`, and the triangles `faces_y` (f, 3), as vertex indices from 0 to n -
    1.

    **Returns:** The triangle of Y for each vertex of X, as a 0-based row of `faces_y` (m,), and the
    barycentric weights of its corners (m, 3), which are non-negative and sum to 1.

    **Raises:** `ValueError` for an unknown convention.
    """
    queries, database = spectral_embeddings(functional_map, spectrum_x, spectrum_y, convention=convention)
    return nearest_point_on_triangles(queries, database, faces_y)
