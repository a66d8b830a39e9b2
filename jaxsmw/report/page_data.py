"""A compact encoding of the arrays of a page: little-endian numbers in base64."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Shaped

from jaxsmw.core.arrays import Array
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.spectral_pair import common_range
from jaxsmw.report.inputs import check_functional_map
from jaxsmw.report.standing import placement

# A page contains between `_FEWEST` and `_EIGENVECTORS` eigenvectors per shape, or no eigenvectors. The
# eigenvectors of both shapes together have at most `_VALUES` entries. Before the encoding in base64, each
# entry takes one byte.
_EIGENVECTORS, _FEWEST, _VALUES = 100, 20, 6_000_000


def eigenvectors_on_page(mesh_x: Mesh, mesh_y: Mesh) -> int:
    """Return the number of eigenvectors per shape on a page that shows two meshes.

    Up to 60 000 vertices of both meshes together, the number is 100, as in the MWP paper. For more vertices,
    the number decreases. Above 300 000 vertices, the number is 0.
    """
    room = _VALUES // (len(mesh_x.vertices) + len(mesh_y.vertices))
    return min(_EIGENVECTORS, room) if room >= _FEWEST else 0


def spectra_on_page(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Spectrum, Spectrum] | None:
    """Return the spectra of both shapes, truncated to the eigenvectors that a page contains, or None.

    The spectra of a partial pair are also truncated to their common range of eigenvalues.

    **Raises:** `InputError` if a spectrum does not have one row per vertex of its mesh.
    """
    for mesh, spectrum in ((mesh_x, spectrum_x), (mesh_y, spectrum_y)):
        if len(spectrum.eigenvectors) != len(mesh.vertices):
            raise InputError(
                f"{mesh.name}: the spectrum has {len(spectrum.eigenvectors)} vertices, but the mesh has "
                f"{len(mesh.vertices)}; give the spectra of these meshes, X first."
            )
    if not (room := eigenvectors_on_page(mesh_x, mesh_y)):
        return None
    cut = spectrum_x.truncate(room), spectrum_y.truncate(room)
    # A partial shape has fewer eigenvectors than the full shape in the same range of eigenvalues.
    return cut if len(spectrum_x.eigenvalues) == len(spectrum_y.eigenvalues) else common_range(*cut)


def encode_bytes(data: bytes) -> str:
    """Encode bytes as base64 text."""
    return base64.b64encode(data).decode()


def encode(array: Shaped[np.ndarray, " *shape"], dtype: str) -> str:
    """Convert an array to a NumPy data type such as `"<f4"`, and encode its entries as base64 text."""
    return encode_bytes(array.astype(dtype).tobytes())


def encode_shape(name: str, mesh: Mesh, standing: Mesh) -> dict[str, Any]:
    """Encode a shape: its name, its upright mesh, and the transformation from the page to its file.

    The page stores the vertices of `standing` in float32, but computes in float64. A point on the page,
    transformed to the coordinates of `mesh`, has an error of at most 1e-7 times the diagonal of the bounding
    box, plus the float64 rounding of the file's own coordinates.
    """
    matrix, offset = placement(mesh, standing)
    return {
        "name": name,
        "vertices": encode(standing.vertices, "<f4"),
        "faces": encode(standing.faces, "<u4"),
        "placement": {"matrix": matrix.tolist(), "offset": offset.tolist()},
    }


def encode_registered(
    registered: Float[np.ndarray, "m 3"], mesh_x: Mesh, mesh_y: Mesh, standing_y: Mesh
) -> str:
    """Encode positions of X's vertices in the file of Y as float32 positions on the page.

    **Raises:** `InputError` if the positions are not three finite numbers for every vertex of X.
    """
    positions = np.asarray(registered, dtype=float)
    if positions.shape != mesh_x.vertices.shape or not np.isfinite(positions).all():
        raise InputError(
            f"the registered positions have shape {positions.shape}, and {np.sum(~np.isfinite(positions))} "
            f"entries are not finite; give three finite numbers for each of the {len(mesh_x.vertices)} "
            f"vertices of {mesh_x.name}."
        )
    matrix, offset = placement(mesh_y, standing_y)
    return encode((positions - offset) @ np.linalg.inv(matrix), "<f4")


def encode_colors(colors: Float64[np.ndarray, "n 3"]) -> str:
    """Encode colours (n, 3) in [0, 1] as base64 text, with three bytes per colour."""
    return encode(np.round(255 * colors), "u1")


def encode_positions(positions: Float64[np.ndarray, "n 3"]) -> dict[str, Any]:
    """Round positions or displacements to 16 bits per coordinate, and encode them in base64.

    Coordinate j of vertex i is `low[j] + step[j] * codes[3 * i + j]`. The rounding error is at most
    1 / 131070 of the extent in each direction.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    step = np.where(high > low, (high - low) / 65535, 1.0)
    codes = np.round((positions - low) / step)
    return {"low": low.tolist(), "step": step.tolist(), "codes": encode(codes, "<u2")}


def encode_basis(spectrum: Spectrum, responses: Float[np.ndarray | Array, "filters k"]) -> dict[str, Any]:
    """Encode the eigenvectors of a shape, and the filter responses at its eigenvalues (filters, k)."""
    return {
        "eigenvectors": encode_rounded(np.asarray(spectrum.eigenvectors).T),
        "responses": encode(np.asarray(responses), "<f4"),
    }


def encode_rounded(rows: Float[np.ndarray, "k n"]) -> dict[str, str]:
    """Round the numbers of a matrix to one byte each, and encode them in base64.

    A byte c encodes the number sign(c) c² times the unit of its row, so small numbers have smaller rounding
    errors than large numbers. An eigenvector can be large on one limb and small on the rest of the body; with
    evenly spaced numbers, the wavelets there would have visible errors. On people and animals, the
    root-mean-square error of wavelets is 0.005 times the length of the colour scale.
    """
    units = np.maximum(np.abs(rows).max(axis=1), np.finfo(np.float32).tiny) / 127**2
    codes = np.sign(rows) * np.round(np.sqrt(np.abs(rows) / units[:, None]))
    return {"codes": encode(codes, "i1"), "units": encode(units, "<f4")}


def encode_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"] | None, convention: Convention
) -> dict[str, Any] | None:
    """Encode the entries of a functional map C (k_out, k_in), row by row, as float32 in base64."""
    if functional_map is None:
        return None
    matrix = check_functional_map(functional_map)
    return {
        "values": encode(matrix, "<f4"),
        "columns": matrix.shape[1],
        "pushforward": convention == "pushforward",
    }
