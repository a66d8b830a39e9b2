"""Converters to and from objects of PyTorch, pyFM and geomfum. `docs/exchange.md` explains the conventions.

A function imports another library only when it makes an object of this library.
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from jaxsmw.core.arrays import Array, float_type, is_array
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.spectra import (
    SpectrumLike,
    check_functional_map,
    eigenbasis_arrays,
    make_spectrum,
    real_array,
)

# Objects of other libraries, which need not be installed.
Tensors: TypeAlias = Any
TriMesh: TypeAlias = Any
TriangleMesh: TypeAlias = Any
FunctionalMapping: TypeAlias = Any

# The arrays of a result, and its spectra.
_PARTS = ("pointwise_map", "functional_map", "spectrum_x", "spectrum_y")


def to_torch(result: Any) -> Tensors:
    """Convert the arrays of a result to PyTorch tensors, which share the memory of the arrays (DLPack).

    A tensor must not be changed in place, because the result would change too; use `tensor.clone()`.
    `jax.numpy.from_dlpack(tensor)` converts in the opposite direction, and shares memory if JAX has the type
    of the tensor (float64 needs `jax_enable_x64`).

    **Arguments:** `result`: an array of NumPy or JAX; a `Spectrum`; or a `Correspondence`, a `Refinement` or
    another object with the attributes `pointwise_map` and `functional_map`.

    **Returns:** A tensor for an array, and otherwise a dictionary. That of a `Spectrum` contains its arrays
    by the names of its attributes, and those of further bases as `eigenvalues_of_basis_NAME` and
    `eigenvectors_of_basis_NAME`. That of a result contains `pointwise_map` (m,) and `functional_map`, and
    that of a `Correspondence` also the dictionaries `spectrum_x` and `spectrum_y`.

    **Raises:** `InputError` if PyTorch is not installed, or the object has no such arrays.
    """
    torch = _library("torch", "torch")

    def convert(value: Any) -> Tensors:
        if is_array(value):
            return torch.from_dlpack(value)
        if isinstance(value, Spectrum):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            for basis in fields.pop("bases"):
                fields[f"eigenvalues_of_basis_{basis.name}"] = basis.eigenvalues
                fields[f"eigenvectors_of_basis_{basis.name}"] = basis.eigenvectors
        elif hasattr(value, "pointwise_map") and hasattr(value, "functional_map"):
            fields = {name: getattr(value, name, None) for name in _PARTS}
        else:
            raise InputError(
                f"{type(value).__name__} contains no map and no spectrum: give an array, a Spectrum or the "
                "result of match or refine."
            )
        return {name: convert(part) for name, part in fields.items() if part is not None}

    return convert(result)


def to_pyfm(mesh: Mesh, spectrum: Spectrum | None = None) -> TriMesh:
    """Convert a mesh and its spectrum to a `TriMesh` of pyFM.

    **Arguments:**

    - `mesh`: the mesh, n vertices.
    - `spectrum`: its `Spectrum` (k eigenvectors), or None.

    **Returns:** A `TriMesh` in the unit of the mesh. Its attributes `eigenvalues` (k,), `eigenvectors` (n, k)
    and `mass` (n, n) are scaled to this unit. It has no stiffness matrix `W`.

    **Raises:** `InputError` if pyFM is not installed, or the spectrum has another number of vertices.
    """
    shape = _library("pyFM.mesh", "pyfmaps").TriMesh(mesh.vertices, mesh.faces)
    if spectrum is not None:
        shape.eigenvalues, shape.eigenvectors, areas = _arrays_in_unit(mesh, spectrum)
        shape.mass = sp.dia_matrix((areas, 0), shape=2 * areas.shape)
    return shape


def to_geomfum(mesh: Mesh, spectrum: Spectrum | None = None) -> TriangleMesh:
    """Convert a mesh and its spectrum to a `TriangleMesh` of geomfum, with its Laplace eigenbasis.

    The arguments and the units are those of `to_pyfm`. geomfum must use its NumPy backend.

    **Returns:** A `TriangleMesh`. Its attribute `basis` contains the eigenvalues `vals` (k,) and eigenvectors
    `vecs` (n, k), and `laplacian.mass_matrix` the vertex areas.

    **Raises:** `InputError` if geomfum is not installed, or the spectrum has another number of vertices.
    """
    shape = _library("geomfum.shape", "geomfum").TriangleMesh(mesh.vertices, mesh.faces)
    if spectrum is not None:
        values, vectors, areas = _arrays_in_unit(mesh, spectrum)
        operator = importlib.import_module("geomfum.operator").Laplacian
        shape.laplacian = operator(shape, mass_matrix=sp.dia_matrix((areas, 0), shape=2 * areas.shape))
        shape.set_basis(importlib.import_module("geomfum.basis").LaplaceEigenBasis(shape, values, vectors))
    return shape


def to_pyfm_mapping(
    shape_x: TriMesh, shape_y: TriMesh, functional_map: Float[np.ndarray, "k_x k_y"]
) -> FunctionalMapping:
    """Return a `FunctionalMapping` of pyFM with a pullback that fits the eigenbases of the shapes."""
    mapping = _library("pyFM.functional", "pyfmaps").FunctionalMapping(shape_y, shape_x)
    mapping.FM_12 = functional_map
    return mapping


def unit_factor(mesh: Mesh, spectrum: Spectrum) -> float:
    """Return the area of a mesh, in its own unit, divided by the area to which its spectrum belongs.

    **Raises:** `InputError` if the spectrum has another number of vertices than the mesh.
    """
    areas, n = np.asarray(spectrum.vertex_areas, np.float64), len(mesh.vertices)
    if len(areas) != n:
        raise InputError(
            f"{mesh.name}: has {n} vertices, but its spectrum has {len(areas)}, because the mesh was cut: "
            "compute the spectrum of this mesh, and encode the pointwise map."
        )
    return float(mesh.vertex_areas[areas > 0].sum() / areas.sum())


def _arrays_in_unit(mesh: Mesh, spectrum: Spectrum) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the eigenvalues, eigenvectors and vertex areas in the unit of the mesh, in float64."""
    factor = unit_factor(mesh, spectrum)
    values, vectors, areas = (
        np.asarray(array, np.float64)
        for array in (spectrum.eigenvalues, spectrum.eigenvectors, spectrum.vertex_areas)
    )
    return values / factor, vectors / np.sqrt(factor), areas * factor


class ImportedMap(NamedTuple):
    """A functional map of another library with its spectra, as `make_functional_map` returns them.

    `jaxsmw.decode(*imported)` returns the pointwise map.

    **Attributes:**

    - `functional_map`: the pullback C (k_X, k_Y), which takes functions on Y to functions on X, without unit.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, scaled to area 1, with k_X and k_Y eigenvectors.
    """

    functional_map: Float[Array, "k_x k_y"]
    spectrum_x: Spectrum
    spectrum_y: Spectrum


def make_functional_map(
    functional_map: Any, shape_x: SpectrumLike | None = None, shape_y: SpectrumLike | None = None
) -> ImportedMap:
    """Convert a functional map of another library, and the spectra of its shapes.

    **Arguments:**

    - `functional_map`: a `FunctionalMapping` of pyFM after `fit`, without further arguments; its `mesh1` is
      Y, and its `mesh2` is X. Otherwise the pullback C (k_X, k_Y), as an array or a tensor, for example
      `fmap_matrix` of geomfum, where shape `a` is Y and shape `b` is X.
    - `shape_x`, `shape_y`: the shapes X and Y as objects that `make_spectrum` accepts, in any unit of length.

    **Returns:** An `ImportedMap`, in which C and both spectra are scaled to surfaces of area 1.

    **Raises:** `InputError` if the mapping was not fitted, a shape is missing or has no eigenbasis, or C is
    not a finite matrix that fits the eigenbases.
    """
    if hasattr(functional_map, "FM_12"):
        shape_x, shape_y = functional_map.mesh2, functional_map.mesh1
        functional_map = functional_map.FM_12
        if functional_map is None:
            raise InputError("the FunctionalMapping has no functional map yet: call its method fit first.")
    if shape_x is None or shape_y is None:
        raise InputError("a functional map needs the eigenbases of both shapes: give shape_x and shape_y.")
    (spectrum_x, area_x), (spectrum_y, area_y) = map(_spectrum_and_area, (shape_x, shape_y))
    matrix = real_array(functional_map, "entries of the functional map")
    check_functional_map("the map", matrix, spectrum_x, spectrum_y)
    k_x, k_y = matrix.shape
    import jax

    scaled = jax.device_put((matrix * np.sqrt(area_y / area_x)).astype(float_type()))
    return ImportedMap(scaled, spectrum_x.truncate(k_x), spectrum_y.truncate(k_y))


def _spectrum_and_area(shape: SpectrumLike) -> tuple[Spectrum, float]:
    values, vectors, areas = eigenbasis_arrays(shape)
    return make_spectrum(values, vectors, areas), float(areas.sum())


def _library(module: str, package: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{package} is not installed: run pip install {package}.") from None
