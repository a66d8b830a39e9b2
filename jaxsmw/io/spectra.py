"""Spectra and functional maps from other libraries and for them. `docs/exchange.md` has their conventions.

Meshes come through `jaxsmw.make_mesh`, pointwise maps through `read_pointwise_map` and `write_pointwise_map`.
No other library is imported here: what comes is told by its attributes, what goes are arrays.
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

# A shape of another library, told by its attributes, and a matrix that may be sparse; see `make_spectrum`.
SpectrumLike: TypeAlias = Any
MassMatrix: TypeAlias = Any

# Eigenvectors of a lumped mass matrix, in single precision, deviate from orthonormality by less; those of a
# finite-element mass matrix, in lumped areas, by far more.
_ORTHONORMALITY_TOLERANCE = 1e-3
# Rounding of eigenvalues, relative to the largest.
_EIGENVALUE_TOLERANCE = 1e-5


def make_spectrum(
    eigenvalues: ArrayLike | SpectrumLike,
    eigenvectors: ArrayLike | None = None,
    vertex_areas: ArrayLike | MassMatrix | None = None,
    *,
    name: str = "spectrum",
) -> Spectrum:
    """Check an eigenbasis of your own or of another library, and scale its surface to area 1.

    On a surface of area a eigenvalues are multiplied by a, eigenvectors by its square root, and areas divided
    by a: a `Spectrum` as `compute_spectrum` gives it. A functional map between bases of areas a_X and a_Y
    becomes one between these when it is multiplied by sqrt(a_Y / a_X).

    **Arguments:**

    - `eigenvalues`: (k,), ascending and not negative. Or all in one, and then nothing else: a `TriMesh` of
        pyFM after `process` (whatever has `eigenvalues`, `eigenvectors` and `vertex_areas`), or a shape of
        geomfum with its `basis`.
    - `eigenvectors`: (n, k), orthonormal in the areas.
    - `vertex_areas`: (n,), or the lumped mass matrix (n, n), dense or sparse. Vertices without area are
        masked.
    - `name`: how messages call it.

    **Returns:** A `Spectrum` of JAX's default float type, for total area 1.

    **Raises:** `InputError` for arrays that do not fit each other, or are no such eigenbasis.
    """
    if eigenvectors is None and vertex_areas is None:
        eigenvalues, eigenvectors, vertex_areas = _parts(eigenvalues, name)
    values, vectors = _real(eigenvalues, "eigenvalues", name), _real(eigenvectors, "eigenvectors", name)
    areas = _real(_lumped(vertex_areas, vectors.shape, name), "vertex areas", name)
    k, n = values.size, areas.size
    if values.ndim != 1 or areas.ndim != 1 or vectors.shape != (n, k) or not 1 <= k <= n:
        raise InputError(
            f"{name}: eigenvalues {values.shape}, eigenvectors {vectors.shape} and vertex areas "
            f"{areas.shape} do not fit each other: for n vertices give (k,), (n, k) and (n,)."
        )
    total = areas.sum()
    if (areas < 0).any() or not total > 0:
        raise InputError(f"{name}: vertex areas must not be negative, and not all zero: correct the areas.")
    largest = np.abs(values).max()
    if values.min() < -_EIGENVALUE_TOLERANCE * largest:
        raise InputError(
            f"{name}: there are negative eigenvalues, down to {values.min():.3g}: those of the positive "
            "semi-definite Laplacian are needed, so change its sign."
        )
    if (np.diff(values) < -_EIGENVALUE_TOLERANCE * largest).any():
        raise InputError(
            f"{name}: the eigenvalues do not ascend: sort them, and the columns of the eigenvectors likewise."
        )
    vectors = np.where(areas[:, None] > 0, vectors, 0)
    deviation = np.abs(vectors.T @ (areas[:, None] * vectors) - np.eye(k)).max()
    if deviation > _ORTHONORMALITY_TOLERANCE:
        raise InputError(
            f"{name}: the eigenvectors are not orthonormal in the vertex areas (off by {deviation:.2g}): "
            "give the areas of the lumped mass matrix that they were computed with, in the same unit."
        )
    arrays = np.maximum(values, 0) * total, vectors * np.sqrt(total), areas / total, areas > 0
    return Spectrum(*map(jax.device_put, arrays))


def _parts(shape: SpectrumLike, name: str) -> tuple[Any, Any, Any]:
    """The eigenvalues, eigenvectors and areas of a shape of any library, told by its attributes."""
    if hasattr(shape, "eigenvectors") and hasattr(shape, "vertex_areas"):
        if shape.eigenvectors is None:
            raise InputError(f"{name}: it has no eigenvectors yet: call its method process first.")
        return shape.eigenvalues, shape.eigenvectors, shape.vertex_areas
    if hasattr(shape, "basis") and hasattr(shape, "laplacian"):
        return shape.basis.vals, shape.basis.vecs, shape.laplacian.mass_matrix
    raise InputError(
        f"{name}: {type(shape).__name__} has no eigenbasis: give eigenvalues, eigenvectors and vertex areas, "
        "or a shape of pyFM or geomfum that has them."
    )


def _lumped(areas: Any, shape: tuple[int, ...], name: str) -> Any:
    """Vertex areas as a list, also from a mass matrix: the sums of its rows.

    `shape` is that of the eigenvectors, (n, k).
    """
    areas = to_host(areas)
    if hasattr(areas, "to_sparse_coo") and "sparse" in str(areas.layout):  # of PyTorch
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
        raise InputError(f"{name}: its {what} are no numeric array: give one.")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"{name}: its {what} are not all finite: compute them anew.")
    return array


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """Read an eigenbasis from a `.npz` file, as `write_spectrum` writes it, or from MATLAB's `.mat` format.

    **Arguments:**

    - `path`: the file. A `.mat` file holds one struct (or nothing but its fields) with `evals` (k), `evecs`
        (n, k) and the areas: the mass matrix or its diagonal as `A`, or a list `area`. In any unit.

    **Returns:** A `Spectrum` for total area 1; see `make_spectrum`.

    **Raises:** `InputError` that names the file and what is wrong with it.
    """
    name = os.fspath(path)
    if is_mat_file(path):
        structs = find_structs(read_variables(path), "evals", "evecs")
        if len(structs) != 1:
            held = f"{len(structs)} eigenbases, {', '.join(structs)}," if structs else "no evals and evecs"
            raise InputError(f"{path}: holds {held} where one is needed: save one struct with both.")
        (struct,) = structs.values()
        return make_spectrum(struct["evals"], struct["evecs"], _areas_of(struct, name), name=name)
    if Path(path).suffix != ".npz":
        raise InputError(f"{path}: spectra are read from .npz and .mat: give one of these.")
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
    except Exception:  # NumPy answers damaged files with whatever goes wrong first
        raise InputError(f"{path}: is damaged or lacks one of {', '.join(fields)}: write it again.") from None
    return make_spectrum(*arrays, name=name)


def _areas_of(struct: Mapping[str, Any], name: str) -> Any:
    for field in ("A", "area"):
        if field in struct and (sp.issparse(struct[field]) or np.ndim(struct[field])):
            return struct[field]
    raise InputError(f"{name}: has no areas beside its evecs: save the mass matrix as A.")


def write_spectrum(path: str | os.PathLike[str], spectrum: Spectrum, mesh: Mesh | None = None) -> None:
    """Write an eigenbasis as `.npz`, or as `.mat` with a struct `S` as the field's MATLAB code has shapes.

    `S` has `evals`, `evecs`, the sparse mass matrix `A`, `area`, `sqrt_area` and `nv`; of a mesh also `nf`
    and `surface` with `X`, `Y`, `Z` and `TRIV`, counted from 1, scaled to the area of the spectrum (1, as a
    rule) so that all of `S` is of one surface. Numbers are written in double precision; the spectrum is
    computed in it under `jax.enable_x64`.

    **Arguments:**

    - `path`: the file to create or to replace; its suffix, `.npz` or `.mat`, tells the format.
    - `spectrum`: what to write, without descriptors.
    - `mesh`: the surface whose spectrum it is, for `.mat` files.

    **Raises:** `InputError` for another suffix, a mesh of another size, or a place that cannot be written to.
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
                "the mesh whose spectrum it is."
            )
        position = mesh.vertices * np.sqrt(area / mesh.area)
        surface = dict(zip("XYZ", position.T, strict=True)) | {"TRIV": mesh.faces + 1.0}
        struct |= {"nf": float(len(mesh.faces)), "surface": surface}
    write_variables(path, {"S": struct})


def check_spectrum_path(path: str | os.PathLike[str]) -> None:
    """**Raises:** `InputError` if a spectrum cannot be written under such a name."""
    if Path(path).suffix != ".npz" and not is_mat_file(path):
        raise InputError(
            f"{path}: spectra are written as .npz or .mat; choose a name that ends in one of these."
        )


def read_functional_map(
    path: str | os.PathLike[str], spectrum_x: Spectrum, spectrum_y: Spectrum
) -> Float64[np.ndarray, "k_x k_y"]:
    """Read a functional map, functions on Y to functions on X, from MATLAB's `.mat` format.

    **Arguments:**

    - `path`: the file. It holds a single matrix, or among others one called `C21` (X is 1, Y is 2).
    - `spectrum_x`, `spectrum_y`: the bases that the map is between; it may be between the first few of each.

    **Returns:** C (k_X, k_Y), as it stands there.

    **Raises:** `InputError` that names the file and what is wrong with it.
    """
    matrix = read_matrix(path, FUNCTIONAL_MAP)
    most = spectrum_x.eigenvalues.shape[0], spectrum_y.eigenvalues.shape[0]
    if np.greater(matrix.shape, most).any():
        cure = "compute more eigenvectors, or leave out its last rows and columns"
        if np.less_equal(matrix.shape[::-1], most).all():
            cure = "transpose it"
        raise InputError(
            f"{path}: the functional map is {matrix.shape}, but from functions on Y to functions on X it can "
            f"be at most {most}: {cure}."
        )
    if not np.isfinite(matrix).all():
        raise InputError(f"{path}: the functional map is not finite: compute it anew.")
    return matrix


def write_functional_map(
    path: str | os.PathLike[str], functional_map: Float[Array, "k_x k_y"] | Float[np.ndarray, "k_x k_y"]
) -> None:
    """Write a functional map as the matrix `C21` in MATLAB's `.mat` format; never half of it.

    **Arguments:**

    - `path`: the file to create or to replace; its name ends in `.mat`.
    - `functional_map`: C (k_X, k_Y), functions on Y to functions on X. Between the bases of area 1 that
        `write_spectrum` writes.

    **Raises:** `InputError` for another suffix, what is not finite, or a place that cannot be written to.
    """
    matrix = _real(functional_map, "entries", "functional map")
    if not is_mat_file(path):
        raise InputError(f"{path}: functional maps are written as .mat; choose a name that ends in it.")
    write_variables(path, {FUNCTIONAL_MAP: matrix})
