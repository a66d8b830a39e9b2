"""Readers and writers of spectra and functional maps, and a converter for spectra of other libraries.

`docs/exchange.md` explains the conventions. This module recognises objects of other libraries by their
attributes and does not import these libraries.
"""

from __future__ import annotations

import os
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from jaxsmw.core.arrays import Array
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError, check_suffix, naming
from jaxsmw.geometry.mesh import Mesh, to_host
from jaxsmw.io.formats.mat import (
    FUNCTIONAL_MAP,
    find_structs,
    is_mat_file,
    read_matrix,
    read_variables,
    write_variables,
)
from jaxsmw.io.formats.named_arrays import (
    ARRAY_SUFFIXES,
    is_array_file,
    read_named_array,
    read_named_arrays,
    write_named_arrays,
)

SPECTRUM_SUFFIXES = (*ARRAY_SUFFIXES, ".mat")
"""The suffixes of files with a spectrum or a functional map."""

# The name of a functional map in a file of named arrays.
_FUNCTIONAL_MAP = "functional_map"

# The docstring of `make_spectrum` lists the accepted objects.
SpectrumLike: TypeAlias = Any
MassMatrix: TypeAlias = Any

# The largest accepted deviation of eigenvectors from orthonormality with respect to vertex areas.
# Eigenvectors that were computed with a lumped mass matrix stay below this limit, even in single precision.
# Eigenvectors that were computed with a finite-element mass matrix exceed the limit by far.
_ORTHONORMALITY_TOLERANCE = 1e-3
# The largest accepted rounding error of an eigenvalue, relative to the largest eigenvalue.
_EIGENVALUE_TOLERANCE = 1e-5


def make_spectrum(
    eigenvalues: ArrayLike | SpectrumLike,
    eigenvectors: ArrayLike | None = None,
    vertex_areas: ArrayLike | MassMatrix | None = None,
    *,
    name: str = "spectrum",
) -> Spectrum:
    """Make a `Spectrum` from an eigenbasis that was computed elsewhere.

    The arrays are checked and scaled to a surface of area 1. If the surface has area a, the eigenvalues are
    multiplied by a, and the eigenvectors by the square root of a. The vertex areas are divided by a. To use a
    pullback C of the unscaled surfaces with the scaled spectra, multiply C by sqrt(a_Y / a_X), where a_X and
    a_Y are the areas of the unscaled surfaces X and Y.

    **Arguments:**

    - `eigenvalues`: the eigenvalues (k,), ascending and not negative, in units of 1 / length². If it is the
        only argument, it is a shape of another library: a `TriMesh` of pyFM after a call of its method
        `process`, a shape of geomfum with an eigenbasis, or any other object with the attributes
        `eigenvalues`, `eigenvectors` and `vertex_areas`.
    - `eigenvectors`: the eigenvectors (n, k), in units of 1 / length, orthonormal with respect to the vertex
        areas.
    - `vertex_areas`: the vertex areas (n,), in units of length², or the lumped mass matrix (n, n), dense or
        sparse. Vertices of zero area are masked. The unit of length is arbitrary.
    - `name`: the name of the spectrum in messages.

    **Returns:** A `Spectrum` of a surface of area 1, with `eigenvalues` (k,), `eigenvectors` (n, k),
    `vertex_areas` (n,) and `mask` (n,), but without descriptors, positions and normals. Its arrays have JAX's
    default float type (float32 unless `jax_enable_x64` is set).

    **Raises:** `InputError` if the arrays do not fit each other or are not finite real numbers, if
    eigenvalues are negative or not ascending, a vertex area is negative, the eigenvectors are not
    orthonormal, or an object of another library has no eigenbasis.
    """
    with naming(name):
        values, vectors, areas = eigenbasis_arrays(eigenvalues, eigenvectors, vertex_areas)
        _check_basis(values, vectors, areas)
    total, vectors = areas.sum(), np.where(areas[:, None] > 0, vectors, 0)
    arrays = np.maximum(values, 0) * total, vectors * np.sqrt(total), areas / total, areas > 0
    import jax

    return jax.device_put(Spectrum(*arrays))


def eigenbasis_arrays(
    eigenvalues: ArrayLike | SpectrumLike,
    eigenvectors: ArrayLike | None = None,
    vertex_areas: ArrayLike | MassMatrix | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the eigenvalues, eigenvectors and vertex areas of `make_spectrum` as float64, unscaled."""
    if eigenvectors is None and vertex_areas is None:
        eigenvalues, eigenvectors, vertex_areas = _parts(eigenvalues)
    values, vectors = real_array(eigenvalues, "eigenvalues"), real_array(eigenvectors, "eigenvectors")
    return values, vectors, real_array(_lumped(vertex_areas, vectors.shape), "vertex areas")


def _check_basis(values: np.ndarray, vectors: np.ndarray, areas: np.ndarray) -> None:
    k, n = values.size, areas.size
    if values.ndim != 1 or areas.ndim != 1 or vectors.shape != (n, k) or not 1 <= k <= n:
        raise InputError(
            f"eigenvalues {values.shape}, eigenvectors {vectors.shape} and vertex areas {areas.shape} do not "
            "fit each other: for n vertices give shapes (k,), (n, k) and (n,)."
        )
    if (areas < 0).any() or not areas.sum() > 0:
        raise InputError("some vertex areas are negative, or all are zero: correct the areas.")
    rounding = _EIGENVALUE_TOLERANCE * np.abs(values).max()
    if values.min() < -rounding:
        raise InputError(
            f"some eigenvalues are negative, down to {values.min():.3g}, but the Laplacian must be positive "
            "semi-definite: change its sign."
        )
    if (np.diff(values) < -rounding).any():
        raise InputError(
            "the eigenvalues do not ascend: sort them together with the columns of the eigenvectors."
        )
    vectors = np.where(areas[:, None] > 0, vectors, 0)
    deviation = np.abs(vectors.T @ (areas[:, None] * vectors) - np.eye(k)).max()
    if deviation > _ORTHONORMALITY_TOLERANCE:
        raise InputError(
            "the eigenvectors are not orthonormal with respect to the vertex areas (deviation "
            f"{deviation:.2g}): give the lumped mass matrix with which the eigenvectors were computed, in "
            "the same unit of length."
        )


def _parts(shape: SpectrumLike) -> tuple[Any, Any, Any]:
    """Return the eigenvalues, eigenvectors and vertex areas from a shape object of another library."""
    if hasattr(shape, "eigenvectors") and hasattr(shape, "vertex_areas"):
        if shape.eigenvectors is None:
            raise InputError("the shape has no eigenvectors yet: call its method process first.")
        return shape.eigenvalues, shape.eigenvectors, shape.vertex_areas
    if hasattr(shape, "basis") and hasattr(shape, "laplacian"):
        return shape.basis.vals, shape.basis.vecs, shape.laplacian.mass_matrix
    raise InputError(
        f"{type(shape).__name__} has no eigenbasis: give eigenvalues, eigenvectors and vertex areas, "
        "or a shape of pyFM or geomfum with an eigenbasis."
    )


def _lumped(areas: Any, shape: tuple[int, ...]) -> Any:
    """Return vertex areas as a list. Those of a mass matrix (n, n) are the sums of its rows."""
    areas = to_host(areas)
    if hasattr(areas, "to_sparse_coo") and "sparse" in str(areas.layout):  # a sparse tensor of PyTorch
        matrix = areas.to_sparse_coo().coalesce()
        areas = sp.coo_array((np.asarray(matrix.values()), np.asarray(matrix.indices())), shape=matrix.shape)
    if sp.issparse(areas) or np.ndim(areas) == 2:
        # The row sums of a malicious sparse matrix could fill the memory, so its shape is checked first.
        if sp.issparse(areas) and areas.shape != 2 * shape[:1]:
            raise InputError(
                f"eigenvectors {shape} and a mass matrix {areas.shape} do not fit each "
                "other: for n vertices give an (n, n) matrix."
            )
        return np.asarray(areas.sum(axis=1)).ravel()
    return areas


def real_array(values: Any, what: str) -> np.ndarray:
    """Convert values to a float64 array of any shape, and check that all numbers are finite."""
    try:
        array = np.asarray(to_host(values))
    except (TypeError, ValueError, RuntimeError):
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise InputError(f"the {what} are not an array of real numbers: convert them to an array of floats.")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"the {what} are not all finite: compute them again.")
    return array


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """Read the eigenbasis of a shape from a `.npz`, `.safetensors` or `.mat` file (see `write_spectrum`).

    A `.npz` or `.safetensors` file contains `eigenvalues` (k,), `eigenvectors` (n, k) and `vertex_areas`
    (n,). A `.mat` file contains the following variables, or one struct with fields of these names. `evals`
    (k) are the eigenvalues, and `evecs` (n, k) are the eigenvectors. The vertex areas are either `A`, which
    is the lumped mass matrix (n, n) or its diagonal, or a list `area` (n).

    **Returns:** A `Spectrum`, as from `make_spectrum`.

    **Raises:** `InputError` if the file cannot be read, has another suffix, is damaged, lacks a field, or
    does not contain exactly one eigenbasis.
    """
    name = os.fspath(path)
    if is_mat_file(path):
        structs = find_structs(read_variables(path), "evals", "evecs")
        if len(structs) != 1:
            bases = f"{len(structs)} eigenbases ({', '.join(structs)})" if structs else "no evals and evecs"
            raise InputError(f"{path}: contains {bases}: save a single struct with evals and evecs.")
        (struct,) = structs.values()
        areas = [struct[field] for field in ("A", "area") if field in struct]
        areas = [values for values in areas if sp.issparse(values) or np.ndim(values)]
        if not areas:
            raise InputError(f"{name}: contains evecs but no areas: save the mass matrix as A.")
        return make_spectrum(struct["evals"], struct["evecs"], areas[0], name=name)
    if not is_array_file(path):
        raise InputError(
            f"{path}: spectra are read from .npz, .safetensors and .mat files: give a file of one of these "
            "types."
        )
    arrays = read_named_arrays(path)
    fields = "eigenvalues", "eigenvectors", "vertex_areas"
    if missing := [field for field in fields if field not in arrays]:
        raise InputError(f"{path}: lacks {', '.join(missing)}: write the spectrum again.")
    return make_spectrum(*(arrays[field] for field in fields), name=name)


def write_spectrum(path: str | os.PathLike[str], spectrum: Spectrum, mesh: Mesh | None = None) -> None:
    """Write the spectrum of a shape as named arrays, or as a struct `S` to a `.mat` file for MATLAB.

    A `.npz` or `.safetensors` file contains the arrays that `read_spectrum` lists. In a `.mat` file, `S` has
    the following fields.

    - `evals` (k) and `evecs` (n, k) are the eigenvalues and eigenvectors.
    - `A` (n, n) is the lumped mass matrix, as a sparse matrix.
    - `area` is the total area, `sqrt_area` is the square root of the total area, and `nv` is the number of
      vertices.
    - If a mesh is given, `nf` is the number of faces. `surface` is a struct with the coordinates `X`, `Y` and
      `Z` and the 1-based faces `TRIV`. The coordinates are scaled to the area of the spectrum (usually 1), so
      all fields describe the same surface.

    Numbers are written in double precision. To compute the spectrum in double precision, use
    `jax.enable_x64`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix, `.npz`, `.safetensors` or `.mat`, determines the
      format.
    - `spectrum`: a `Spectrum` (n vertices, k eigenvectors), whose positions, normals, mask and descriptors
      are not written.
    - `mesh`: the mesh of the spectrum (n vertices), or None.

    **Raises:** `InputError` for another suffix, a mesh with another number of vertices, or a file that cannot
    be written.
    """
    values, vectors, areas = (
        np.asarray(array, np.float64)
        for array in (spectrum.eigenvalues, spectrum.eigenvectors, spectrum.vertex_areas)
    )
    if mesh is not None and len(mesh.vertices) != len(areas):
        raise InputError(
            f"{path}: the spectrum has {len(areas)} vertices, but {mesh.name} has {len(mesh.vertices)}: "
            "give the mesh of this spectrum."
        )
    check_suffix(path, "spectra", *SPECTRUM_SUFFIXES)
    if not is_mat_file(path):
        write_named_arrays(path, {"eigenvalues": values, "eigenvectors": vectors, "vertex_areas": areas})
        return
    area = areas.sum()
    struct: dict[str, Any] = {
        "evals": values,
        "evecs": vectors,
        "A": sp.diags_array(areas).tocsc(),
        "area": area,
        "sqrt_area": np.sqrt(area),
        "nv": float(len(areas)),
    }
    if mesh is not None:
        position = mesh.vertices * np.sqrt(area / mesh.area)
        surface = dict(zip("XYZ", position.T, strict=True)) | {"TRIV": mesh.faces + 1.0}
        struct |= {"nf": float(len(mesh.faces)), "surface": surface}
    write_variables(path, {"S": struct})


def read_functional_map(
    path: str | os.PathLike[str], spectrum_x: Spectrum, spectrum_y: Spectrum
) -> Float64[np.ndarray, "k_x k_y"]:
    """Read a functional map, a pullback that takes functions on Y to functions on X.

    **Arguments:**

    - `path`: a `.npz`, `.safetensors` or `.mat` file. The file contains either a single matrix, or a matrix
        `functional_map` among other arrays, which is called `C21` in a `.mat` file. The name `C21` means that
        X is shape 1 and Y is shape 2.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum`. The functional map may have fewer
        rows and columns than the spectra have eigenvectors.

    **Returns:** The functional map C (k_X, k_Y), float64, with the values of the file. C fits the spectra of
    this library only if the eigenbases of the file belong to surfaces of area 1. Otherwise, C must be
    multiplied by the factor that `make_spectrum` states.

    **Raises:** `InputError` if the file cannot be read or contains no suitable matrix, or if the matrix is
    too large for the spectra or has entries that are not finite.
    """
    if is_array_file(path):
        with naming(path):
            matrix = real_array(read_named_array(path, _FUNCTIONAL_MAP), "entries of the functional map")
    else:
        matrix = read_matrix(path, FUNCTIONAL_MAP)
    check_functional_map(path, matrix, spectrum_x, spectrum_y)
    return matrix


def check_functional_map(
    name: str | os.PathLike[str], matrix: np.ndarray, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> None:
    """Raise `InputError` if an array is not a finite matrix (at most k_X, at most k_Y)."""
    if matrix.ndim != 2:
        raise InputError(f"{name}: has shape {matrix.shape}: give a functional map, which is a matrix.")
    most = spectrum_x.eigenvalues.shape[0], spectrum_y.eigenvalues.shape[0]
    if np.greater(matrix.shape, most).any():
        cure = "compute more eigenvectors, or remove the last rows and columns of the map"
        if np.less_equal(matrix.shape[::-1], most).all():
            cure = "transpose the map"
        raise InputError(
            f"{name}: the functional map has shape {matrix.shape}, but the shape of a map from "
            f"functions on Y to functions on X can be at most {most}: {cure}."
        )
    if not np.isfinite(matrix).all():
        raise InputError(f"{name}: the functional map is not finite: compute the map again.")


def write_functional_map(
    path: str | os.PathLike[str], functional_map: Float[Array, "k_x k_y"] | Float[np.ndarray, "k_x k_y"]
) -> None:
    """Write a functional map as the array `functional_map`, or as the matrix `C21` to a `.mat` file.

    **Arguments:**

    - `path`: the file to create or to replace, with the suffix `.npz`, `.safetensors` or `.mat`.
    - `functional_map`: the pullback C (k_X, k_Y), without unit. The eigenbases must belong to surfaces of
        area 1, as the spectra of this library do.

    **Raises:** `InputError` for another suffix, entries that are not finite real numbers, or a file that
    cannot be written.
    """
    with naming("functional map"):
        matrix = real_array(functional_map, "entries")
    check_suffix(path, "functional maps", *SPECTRUM_SUFFIXES)
    if is_array_file(path):
        write_named_arrays(path, {_FUNCTIONAL_MAP: matrix})
    else:
        write_variables(path, {FUNCTIONAL_MAP: matrix})
