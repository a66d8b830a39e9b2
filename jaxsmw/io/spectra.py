"""Spectra and functional maps of files and of other libraries; `docs/exchange.md` explains the conventions.

No other library is imported here. Objects of other libraries are recognized by their attributes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Float64
from numpy.typing import ArrayLike

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, to_host
from jaxsmw.io.mat_files import (
    FUNCTIONAL_MAP,
    find_structs,
    is_mat_file,
    read_matrix,
    read_variables,
    write_variables,
)
from jaxsmw.runtime.files import atomic_write, largest_contents, size_of_file

# A shape of another library, and a matrix that may be sparse; see `make_spectrum`.
SpectrumLike: TypeAlias = Any
MassMatrix: TypeAlias = Any

# In single precision, eigenvectors of a lumped mass matrix deviate less from orthonormality. Eigenvectors of
# a finite-element mass matrix deviate far more when they are measured in lumped areas.
_ORTHONORMALITY_TOLERANCE = 1e-3
# Allowance for rounding errors of eigenvalues, relative to the largest.
_EIGENVALUE_TOLERANCE = 1e-5


def make_spectrum(
    eigenvalues: ArrayLike | SpectrumLike,
    eigenvectors: ArrayLike | None = None,
    vertex_areas: ArrayLike | MassMatrix | None = None,
    *,
    name: str = "spectrum",
) -> Spectrum:
    """Check an eigenbasis of your own or of another library, and scale its surface to area 1.

    For a surface of area a, eigenvalues are multiplied by a, eigenvectors by the square root of a, and areas
    are divided by a. The result is a `Spectrum` like those of `compute_spectrum`. A functional map between
    bases on areas a_X and a_Y becomes a map between the scaled bases when it is multiplied by sqrt(a_Y /
    a_X).

    **Arguments:**

    - `eigenvalues`: (k,), ascending and not negative. Or, as the only argument, a shape of another library:
        a `TriMesh` of pyFM after `process` (any object with `eigenvalues`, `eigenvectors` and
        `vertex_areas`), or a shape of geomfum with its `basis`.
    - `eigenvectors`: (n, k), orthonormal with respect to the areas.
    - `vertex_areas`: (n,), or the lumped mass matrix (n, n), dense or sparse. Vertices without area are
      masked.
    - `name`: the name of the spectrum in messages.

    **Returns:** A `Spectrum` of JAX's default float type, for total area 1.

    **Raises:** `InputError` if the arrays do not fit each other or are not an eigenbasis.
    """
    if eigenvectors is None and vertex_areas is None:
        eigenvalues, eigenvectors, vertex_areas = _parts(eigenvalues, name)
    values, vectors = _real(eigenvalues, "eigenvalues", name), _real(eigenvectors, "eigenvectors", name)
    areas = _real(_lumped(vertex_areas, vectors.shape, name), "vertex areas", name)
    k, n = values.size, areas.size
    if values.ndim != 1 or areas.ndim != 1 or vectors.shape != (n, k) or not 1 <= k <= n:
        raise InputError(
            f"{name}: eigenvalues {values.shape}, eigenvectors {vectors.shape} and vertex areas "
            f"{areas.shape} do not fit each other: for n vertices give shapes (k,), (n, k) and (n,)."
        )
    total = areas.sum()
    if (areas < 0).any() or not total > 0:
        raise InputError(f"{name}: vertex areas are negative, or all zero: correct the areas.")
    largest = np.abs(values).max()
    if values.min() < -_EIGENVALUE_TOLERANCE * largest:
        raise InputError(
            f"{name}: some eigenvalues are negative, down to {values.min():.3g}, but the Laplacian must be "
            "positive semi-definite: change its sign."
        )
    if (np.diff(values) < -_EIGENVALUE_TOLERANCE * largest).any():
        raise InputError(
            f"{name}: the eigenvalues do not ascend: sort them together with the columns of the eigenvectors."
        )
    vectors = np.where(areas[:, None] > 0, vectors, 0)
    deviation = np.abs(vectors.T @ (areas[:, None] * vectors) - np.eye(k)).max()
    if deviation > _ORTHONORMALITY_TOLERANCE:
        raise InputError(
            f"{name}: the eigenvectors are not orthonormal in the vertex areas (off by {deviation:.2g}): "
            "give the lumped mass matrix with which the eigenvectors were computed, in the same unit."
        )
    arrays = np.maximum(values, 0) * total, vectors * np.sqrt(total), areas / total, areas > 0
    return Spectrum(*map(jax.device_put, arrays))


def _parts(shape: SpectrumLike, name: str) -> tuple[Any, Any, Any]:
    """The eigenvalues, eigenvectors and areas of a shape of another library."""
    if hasattr(shape, "eigenvectors") and hasattr(shape, "vertex_areas"):
        if shape.eigenvectors is None:
            raise InputError(f"{name}: the shape has no eigenvectors yet: call its method process first.")
        return shape.eigenvalues, shape.eigenvectors, shape.vertex_areas
    if hasattr(shape, "basis") and hasattr(shape, "laplacian"):
        return shape.basis.vals, shape.basis.vecs, shape.laplacian.mass_matrix
    raise InputError(
        f"{name}: {type(shape).__name__} has no eigenbasis: give eigenvalues, eigenvectors and vertex areas, "
        "or a shape of pyFM or geomfum with an eigenbasis."
    )


def _lumped(areas: Any, shape: tuple[int, ...], name: str) -> Any:
    """Vertex areas as a list, also from a mass matrix: the sums of its rows.

    `shape` is that of the eigenvectors, (n, k).
    """
    areas = to_host(areas)
    if hasattr(areas, "to_sparse_coo") and "sparse" in str(areas.layout):  # a tensor of PyTorch
        matrix = areas.to_sparse_coo().coalesce()
        areas = sp.coo_array((np.asarray(matrix.values()), np.asarray(matrix.indices())), shape=matrix.shape)
    if sp.issparse(areas) or np.ndim(areas) == 2:
        # A sparse matrix of a hostile file can have so many rows that their sums would fill the memory.
        if sp.issparse(areas) and areas.shape != 2 * shape[:1]:
            raise InputError(
                f"{name}: eigenvectors {shape} and a mass matrix {areas.shape} do not fit each "
                "other: for n vertices give an (n, n) matrix."
            )
        return np.asarray(areas.sum(axis=1)).ravel()
    return areas


def _real(values: Any, what: str, name: str) -> np.ndarray:
    """Values as a finite float64 array of any shape."""
    try:
        array = np.asarray(to_host(values))
    except (TypeError, ValueError, RuntimeError):
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name}: its {what} are not an array of real numbers: give such an array.")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"{name}: its {what} are not all finite: compute them again.")
    return array


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """Read an eigenbasis from a `.npz` file of `write_spectrum`, or from MATLAB's `.mat` format.

    **Arguments:**

    - `path`: the file. A `.mat` file holds one struct, or the fields of one struct as variables: `evals`
        (k), `evecs` (n, k) and the areas, as the mass matrix or its diagonal `A`, or as a list `area`. Any
        unit will do.

    **Returns:** A `Spectrum` for total area 1; see `make_spectrum`.

    **Raises:** `InputError` that names the file and the fault.
    """
    name = os.fspath(path)
    if is_mat_file(path):
        structs = find_structs(read_variables(path), "evals", "evecs")
        if len(structs) != 1:
            held = f"{len(structs)} eigenbases, {', '.join(structs)}," if structs else "no evals and evecs"
            raise InputError(f"{path}: holds {held} but needs one: save a single struct with both.")
        (struct,) = structs.values()
        return make_spectrum(struct["evals"], struct["evecs"], _areas_of(struct, name), name=name)
    if Path(path).suffix != ".npz":
        raise InputError(f"{path}: spectra are read from .npz and .mat files: give one of these.")
    fields = "eigenvalues", "eigenvectors", "vertex_areas"
    limit = largest_contents(size_of_file(path))
    try:
        with np.load(path, allow_pickle=False) as file:
            if sum(member.file_size for member in file.zip.infolist()) > limit:
                raise InputError(
                    f"{path}: would take more than 1 GiB of memory and more than four times its own size: "
                    "write it again, with nothing but a spectrum in it."
                )
            arrays = [file[field] for field in fields]
    except InputError:
        raise
    except Exception:  # damaged files can raise any exception in NumPy
        raise InputError(f"{path}: is damaged or lacks one of {', '.join(fields)}: write it again.") from None
    return make_spectrum(*arrays, name=name)


def _areas_of(struct: Mapping[str, Any], name: str) -> Any:
    for field in ("A", "area"):
        if field in struct and (sp.issparse(struct[field]) or np.ndim(struct[field])):
            return struct[field]
    raise InputError(f"{name}: has evecs but no areas: save the mass matrix as A.")


def write_spectrum(path: str | os.PathLike[str], spectrum: Spectrum, mesh: Mesh | None = None) -> None:
    """Write an eigenbasis as `.npz`, or as `.mat` with a struct `S` in the layout of MATLAB code for shapes.

    `S` has the fields `evals`, `evecs`, the sparse mass matrix `A`, `area`, `sqrt_area` and `nv`. If a mesh
    is given, `S` also has `nf` and `surface` with `X`, `Y`, `Z` and `TRIV`, counted from 1. The surface is
    scaled to the area of the spectrum (usually 1), so that all fields describe one surface. Numbers are
    written in double precision; to compute the spectrum in double precision, use `jax.enable_x64`.

    **Arguments:**

    - `path`: the file to create or to replace. The suffix, `.npz` or `.mat`, tells the format.
    - `spectrum`: the eigenbasis. Positions and normals are not written.
    - `mesh`: the surface of the spectrum, for `.mat` files.

    **Raises:** `InputError` for another suffix, a mesh of another size, or a file that cannot be written.
    """
    values, vectors, areas = (
        np.asarray(array, np.float64)
        for array in (spectrum.eigenvalues, spectrum.eigenvectors, spectrum.vertex_areas)
    )
    if not is_mat_file(path):
        check_spectrum_path(path)
        with atomic_write(path) as temporary:
            np.savez(temporary, eigenvalues=values, eigenvectors=vectors, vertex_areas=areas)
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
        if len(mesh.vertices) != len(areas):
            raise InputError(
                f"{path}: the spectrum has {len(areas)} vertices and {mesh.name} {len(mesh.vertices)}: give "
                "the mesh of this spectrum."
            )
        position = mesh.vertices * np.sqrt(area / mesh.area)
        surface = dict(zip("XYZ", position.T, strict=True)) | {"TRIV": mesh.faces + 1.0}
        struct |= {"nf": float(len(mesh.faces)), "surface": surface}
    write_variables(path, {"S": struct})


def check_spectrum_path(path: str | os.PathLike[str]) -> None:
    """Check that a name has a suffix of a spectrum.

    **Raises:** `InputError` if not.
    """
    if Path(path).suffix != ".npz" and not is_mat_file(path):
        raise InputError(
            f"{path}: spectra are written as .npz or .mat: choose a name that ends in one of these."
        )


def read_functional_map(
    path: str | os.PathLike[str], spectrum_x: Spectrum, spectrum_y: Spectrum
) -> Float64[np.ndarray, "k_x k_y"]:
    """Read a functional map, from functions on Y to functions on X, in MATLAB's `.mat` format.

    **Arguments:**

    - `path`: the file. It holds a single matrix, or a matrix `C21` among others (X is shape 1, Y is shape 2).
    - `spectrum_x`, `spectrum_y`: the bases of the map. The map may use only the first few functions of each.

    **Returns:** C (k_X, k_Y), as stored.

    **Raises:** `InputError` that names the file and the fault.
    """
    matrix = read_matrix(path, FUNCTIONAL_MAP)
    most = spectrum_x.eigenvalues.shape[0], spectrum_y.eigenvalues.shape[0]
    if np.greater(matrix.shape, most).any():
        cure = "compute more eigenvectors, or remove the last rows and columns of the map"
        if np.less_equal(matrix.shape[::-1], most).all():
            cure = "transpose the map"
        raise InputError(
            f"{path}: the functional map is {matrix.shape}, but from functions on Y to functions on X it can "
            f"be at most {most}: {cure}."
        )
    if not np.isfinite(matrix).all():
        raise InputError(f"{path}: the functional map is not finite: compute it again.")
    return matrix


def write_functional_map(
    path: str | os.PathLike[str], functional_map: Float[Array, "k_x k_y"] | Float[np.ndarray, "k_x k_y"]
) -> None:
    """Write a functional map as the matrix `C21` in MATLAB's `.mat` format.

    The file appears whole or not at all.

    **Arguments:**

    - `path`: the file to create or to replace; the name ends in `.mat`.
    - `functional_map`: C (k_X, k_Y), from functions on Y to functions on X, between the bases on area 1 that
        `write_spectrum` writes.

    **Raises:** `InputError` for another suffix, entries that are not finite, or a file that cannot be
    written.
    """
    matrix = _real(functional_map, "entries", "functional map")
    if not is_mat_file(path):
        raise InputError(f"{path}: functional maps are written as .mat: choose a name that ends in .mat.")
    write_variables(path, {FUNCTIONAL_MAP: matrix})
