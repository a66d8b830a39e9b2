"""Exports two meshes with a common texture as OBJ files, for other 3D programs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.image import imsave

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.report.standing import visible
from jaxsmw.runtime.files import atomic_write

TEXTURE_FILES = ("texture.png", "texture.mtl", "target.obj", "source.obj")
"""The files that `write_textured_pair` writes."""

_MATERIAL = "newmtl texture\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd texture.png\n"
# Each side of the square picture has `_PIXELS` pixels and `_SQUARES` checkerboard squares.
_PIXELS, _SQUARES = 1024, 32


def write_textured_pair(
    directory: str | os.PathLike[str], mesh_x: Mesh, mesh_y: Mesh, points: SurfacePoints
) -> None:
    """Write `source.obj` and `target.obj` with the same checkerboard picture as texture.

    The picture is projected onto the target along the shortest principal axis of the target. The projection
    has no seams, and the front and the back of the target look the same. Each source vertex receives the
    texture coordinates of its match in `points`, m points on Y. Each of the `TEXTURE_FILES` in the existing
    directory is replaced completely or not at all.

    **Raises:** `InputError` if a file cannot be written.
    """
    on_target = _projection(mesh_y)
    on_source = points.interpolate(on_target, mesh_y)
    picture, material, target, source = (Path(directory) / name for name in TEXTURE_FILES)
    with atomic_write(picture) as temporary:
        imsave(temporary, _checkered(), origin="lower")
    with atomic_write(material) as temporary:
        temporary.write_text(_MATERIAL, "ascii")
    for path, mesh, coordinates in ((target, mesh_y, on_target), (source, mesh_x, on_source)):
        with atomic_write(path) as temporary:
            temporary.write_text(_obj(mesh, coordinates), "ascii")


def _projection(mesh: Mesh) -> Float64[np.ndarray, "n 2"]:
    """Return coordinates (n, 2) along the two longest principal axes, in [0, 1] for referenced vertices."""
    used = visible(mesh)
    _, _, axes = np.linalg.svd(used - used.mean(axis=0), full_matrices=False)
    # The sign of a singular vector is arbitrary. Here, the component with the largest absolute value is
    # positive.
    longest = axes[:2] * np.sign(axes[:2][[0, 1], np.abs(axes[:2]).argmax(axis=1)])[:, None]
    flat, low = mesh.vertices @ longest.T, (used @ longest.T).min(axis=0)
    return (flat - low) / np.ptp(used @ longest.T, axis=0).max()


def _checkered() -> Float64[np.ndarray, "h w 3"]:
    """Return a checkerboard of light and dark squares. The hue of a square shows its position."""
    row, column = np.mgrid[:_PIXELS, :_PIXELS] * _SQUARES // _PIXELS
    across, up = column / (_SQUARES - 1), row / (_SQUARES - 1)
    colors = np.stack([0.25 + 0.75 * across, 0.25 + 0.75 * up, 1 - 0.75 * across], axis=2)
    return np.where((row + column)[..., None] % 2, colors, 0.45 * colors)


def _obj(mesh: Mesh, coordinates: Float64[np.ndarray, "n 2"]) -> str:
    """Return the text of an OBJ file with texture coordinates."""
    lines = ["mtllib texture.mtl", "usemtl texture"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.9f} {v:.9f}" for u, v in coordinates.tolist()]
    lines += [f"f {i}/{i} {j}/{j} {k}/{k}" for i, j, k in (mesh.faces + 1).tolist()]
    return "\n".join([*lines, ""])
