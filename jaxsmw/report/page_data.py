"""The arrays of a page, encoded compactly: base64 of little-endian numbers."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Float64, Shaped

from jaxsmw.core.functional_map import Convention
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.pair import common_range
from jaxsmw.report.colors import error_colors, signed_colors
from jaxsmw.report.inputs import check_functional_map

# The largest number of eigenvector entries of both shapes together, at one byte each and a third more in
# base64. Up to 60 000 vertices in all a page has room for the paper's 100 eigenvectors, beyond 300 000 for
# none.
_EIGENVECTORS, _FEWEST, _VALUES = 100, 20, 6_000_000

COLOR_SCALES = {
    "error": error_colors(np.linspace(0, 1, 256), 1.0),
    "signed": signed_colors(np.linspace(-1, 1, 255), 1.0),
    "signed_dark": signed_colors(np.linspace(-1, 1, 255), 1.0, on_dark=True),
}
"""Colours at even steps between the ends of each scale. The middle colour of a signed scale means zero."""


def eigenvectors_on_page(mesh_x: Mesh, mesh_y: Mesh) -> int:
    """The number of eigenvectors of two meshes for which a page has room: 100, or fewer for large meshes."""
    room = _VALUES // (len(mesh_x.vertices) + len(mesh_y.vertices))
    return min(_EIGENVECTORS, room) if room >= _FEWEST else 0


def spectra_on_page(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Spectrum, Spectrum] | None:
    """The part of both spectra for which a page has room; None if it has no room.

    **Raises:** `InputError` if a spectrum does not fit its mesh.
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
    # A partial shape has fewer eigenvectors in the same range of eigenvalues.
    return cut if len(spectrum_x.eigenvalues) == len(spectrum_y.eigenvalues) else common_range(*cut)


def encode_bytes(data: bytes) -> str:
    """Base64."""
    return base64.b64encode(data).decode()


def encode(array: Shaped[np.ndarray, " *shape"], dtype: str) -> str:
    """The entries of an array, converted to a NumPy data type."""
    return encode_bytes(array.astype(dtype).tobytes())


def encode_mesh(mesh: Mesh) -> dict[str, Any]:
    """The vertices and faces of a mesh."""
    return {"vertices": encode(mesh.vertices, "<f4"), "faces": encode(mesh.faces, "<u4")}


def encode_colors(colors: Float64[np.ndarray, "n 3"]) -> str:
    """Colours in [0, 1], three bytes each."""
    return encode(np.round(255 * colors), "u1")


def encode_basis(spectrum: Spectrum, responses: Float[np.ndarray | Array, "filters k"]) -> dict[str, Any]:
    """The eigenvectors of a shape, and the responses of all filters at the eigenvalues."""
    return {
        "eigenvectors": encode_rounded(np.asarray(spectrum.eigenvectors).T),
        "responses": encode(np.asarray(responses), "<f4"),
    }


def encode_rounded(rows: Float[np.ndarray, "k n"]) -> dict[str, str]:
    """One byte per number and one unit per row; the code c stands for sign(c) c² units.

    Small numbers get finer levels. The eigenvectors of limbs are large on the limbs and small elsewhere,
    where even levels would give wavelets false spots. The rounding changes wavelets by half a hundredth of
    the colour scale (root mean square, on people and animals), as even levels of 10 bits would.
    """
    units = np.maximum(np.abs(rows).max(axis=1), np.finfo(np.float32).tiny) / 127**2
    codes = np.sign(rows) * np.round(np.sqrt(np.abs(rows) / units[:, None]))
    return {"codes": encode(codes, "i1"), "units": encode(units, "<f4")}


def encode_functional_map(
    functional_map: Float[np.ndarray | Array, "k_out k_in"] | None, convention: Convention
) -> dict[str, Any] | None:
    """The matrix C, row by row; None if there is none.

    **Raises:** `InputError` if C is not a finite matrix.
    """
    if functional_map is None:
        return None
    matrix = check_functional_map(functional_map)
    return {
        "values": encode(matrix, "<f4"),
        "columns": matrix.shape[1],
        "pushforward": convention == "pushforward",
    }
