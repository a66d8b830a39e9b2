"""Shaded pictures of meshes in plain NumPy: where the viewer stands, what covers a pixel, how it is lit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import igl
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import uniform_filter

from jaxsmw.choices import Axis
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import linear_to_srgb, srgb_to_linear

# Proper rotations that turn the named axis up. Y-up and z-up files then face the same way: forward is +z in
# the one convention and -y in the other, and x runs across the body in both.
_STAND = {
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-y": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}

# Where the viewer would rather stand: in front, a little to the side. In radians from +z towards +x.
_PREFERRED_AZIMUTH = np.radians(30)
ELEVATION = np.radians(8)
"""How far the viewer looks down on the body, in radians."""

# Directions to the lights in the camera's frame (right, up, towards the viewer) and their strengths.
_LIGHTS = ((-0.45, 0.60, 0.65, 0.72), (0.85, 0.15, 0.50, 0.22))
_AMBIENT, _SKY = 0.32, 0.13

# Samples per pixel and direction; candidate samples tested at a time.
_SUPERSAMPLING = 2
_CHUNK = 100_000


def stand(mesh: Mesh, up: Axis | None = None) -> Mesh:
    """The mesh as it is shown: upright, its bounding box around the origin, its area 1.

    Faces are turned where needed so that neighbours agree on which side is out; vertices keep their numbers.

    **Arguments:**

    - `mesh`: a surface of positive area.
    - `up`: the axis of the file that points up. By default the y axis when the body is slender along it (its
      spread along z is below 0.45 of that along y), as are people in y-up files; otherwise the z axis.

    **Returns:** A `Mesh` in which x is right to left across the body, y up and z forward, as far as the file
    kept to one of the two usual conventions.

    **Raises:** `InputError` if the mesh has no area or `up` is not an axis.
    """
    if not mesh.area > 0:
        raise InputError(
            f"{mesh.name}: there is nothing to draw because its faces have no area; give a surface."
        )
    if up is None:
        center = mesh.vertex_areas @ mesh.vertices / mesh.area
        spread = np.sqrt(mesh.vertex_areas @ (mesh.vertices - center) ** 2)
        up = "z" if spread[2] > 0.45 * spread[1] else "y"
    elif up not in _STAND:
        raise InputError(f"up={up!r} is not an axis; choose one of {', '.join(get_args(Axis))}.")
    vertices = mesh.vertices @ np.array(_STAND[up], dtype=float).T / np.sqrt(mesh.area)
    used = vertices[mesh.used_vertices]
    faces, _ = igl.bfs_orient(mesh.faces)
    return replace(
        mesh,
        vertices=vertices - (used.min(axis=0) + used.max(axis=0)) / 2,
        faces=faces.astype(np.int64),
    )


def stand_pair(mesh_x: Mesh, mesh_y: Mesh, up: Axis | None = None) -> tuple[Mesh, Mesh]:
    """Both meshes standing (`stand`), Y with area 1, and X too unless one is a part of the other.

    An area between 1/16 and 0.6 of the other (or the reverse) is taken for that of a part, which stays in
    proportion to the whole. Nearer to equal it is the same body in another unit; below, units must differ.
    """
    standing_x, standing_y = stand(mesh_x, up), stand(mesh_y, up)
    ratio = mesh_x.area / mesh_y.area
    if 1 / 16 < min(ratio, 1 / ratio) < 0.6:
        standing_x = replace(standing_x, vertices=np.sqrt(ratio) * standing_x.vertices)
    return standing_x, standing_y


def choose_azimuth(meshes: Sequence[Mesh]) -> float:
    """One direction to look from that shows all meshes well.

    The viewer looks along the direction in which the bodies are thin (people are seen from the front, animals
    from the side), but would rather stand in front and a little to the side: with M the horizontal covariance
    of trace 1, summed over the meshes, and r that preference, the least eigenvector of M - 0.8 r r^T.

    **Arguments:**

    - `meshes`: standing (`stand`).

    **Returns:** The viewer's azimuth in radians, from forward (+z) towards +x.
    """
    preferred = np.array([np.sin(_PREFERRED_AZIMUTH), np.cos(_PREFERRED_AZIMUTH)])
    matrix = -0.8 * len(meshes) * np.outer(preferred, preferred)
    for mesh in meshes:
        horizontal = mesh.vertices[:, [0, 2]]
        horizontal = horizontal - mesh.vertex_areas @ horizontal / mesh.area
        covariance = (mesh.vertex_areas * horizontal.T) @ horizontal
        matrix += covariance / max(np.trace(covariance), 1e-12)
    direction = np.linalg.eigh(matrix)[1][:, 0]
    direction *= np.sign(direction @ preferred)
    return float(np.arctan2(*direction))


def camera_axes(azimuth: float) -> Float64[np.ndarray, "3 3"]:
    """The camera's axes (rows: right, up, towards the viewer) at an azimuth in radians."""
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    towards = np.array([sine * np.cos(ELEVATION), np.sin(ELEVATION), cosine * np.cos(ELEVATION)])
    right = np.array([cosine, 0, -sine])
    return np.stack([right, np.cross(towards, right), towards])


def render(
    mesh: Mesh, colors: Float64[np.ndarray, "n 3"], *, azimuth: float, scale: float, width: int, height: int
) -> UInt8[np.ndarray, "height width 4"]:
    """A mesh with coloured vertices as a picture, smoothly shaded, on a transparent background.

    Orthographic, the origin in the middle of the picture; a depth buffer with 2 x 2 samples per pixel, so
    that neither cracks nor wrongly sorted triangles can occur. Lit from the upper left and, weaker, from the
    right, both sides of a face alike; what lies behind a nearer part of the body is a little darker near its
    outline.

    **Arguments:**

    - `mesh`: standing (`stand`).
    - `colors`: one sRGB colour in [0, 1] per vertex, interpolated over the faces.
    - `azimuth`: of the viewer, in radians; see `choose_azimuth`.
    - `scale`: pixels per unit of length.
    - `width`, `height`: of the picture, in pixels.

    **Returns:** RGBA pixels, straight alpha, the top row first.
    """
    axes = camera_axes(azimuth)
    positions, normals = mesh.vertices @ axes.T, mesh.vertex_normals @ axes.T
    columns, rows = width * _SUPERSAMPLING, height * _SUPERSAMPLING
    across = positions[:, 0] * scale * _SUPERSAMPLING + columns / 2
    down = rows / 2 - positions[:, 1] * scale * _SUPERSAMPLING
    face, weights, depth = _rasterize(
        np.stack([across, down], axis=1), positions[:, 2], mesh.faces, columns, rows
    )

    covered = face >= 0
    corners, weights = mesh.faces[face[covered]], weights[covered]
    base = np.einsum("pc,pcd->pd", weights, srgb_to_linear(colors)[corners])
    normal = np.einsum("pc,pcd->pd", weights, normals[corners])
    sides = positions[corners[:, 1:]] - positions[corners[:, :1]]
    flat = np.cross(sides[:, 0], sides[:, 1])
    # Where neighbouring normals cancel the face's own has to do; a face seen from behind shows that side.
    normal = np.where(np.any(normal, axis=1, keepdims=True), normal, flat) * np.where(flat[:, 2:] < 0, -1, 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    light = _AMBIENT + _SKY * normal[:, 1]
    for *direction, strength in _LIGHTS:
        light += strength * np.maximum(normal @ (np.array(direction) / np.linalg.norm(direction)), 0)
    light *= _occlusion(depth.reshape(rows, columns), scale).ravel()[covered]

    samples = np.zeros((rows * columns, 4), dtype=np.float32)
    samples[covered, :3] = linear_to_srgb(base * light[:, None])
    samples[covered, 3] = 1
    grid = samples.reshape(rows, columns, 4)
    steps = range(_SUPERSAMPLING)
    picture = np.sum([grid[i::_SUPERSAMPLING, j::_SUPERSAMPLING] for i in steps for j in steps], axis=0)
    picture[..., :3] /= np.maximum(picture[..., 3:], 1)
    picture[..., 3] /= _SUPERSAMPLING**2
    return np.round(255 * picture).astype(np.uint8)


def _rasterize(
    points: Float64[np.ndarray, "n 2"],
    depths: Float64[np.ndarray, " n"],
    faces: Int64[np.ndarray, "f 3"],
    columns: int,
    rows: int,
) -> tuple[Int64[np.ndarray, " p"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, " p"]]:
    """The frontmost face at each sample (-1: none), the barycentric weights there and the depth.

    Every face is tested against the samples in its bounding box, a chunk of faces at a time.
    """
    front = np.full(rows * columns, -1)
    weights = np.zeros((rows * columns, 3))
    nearest = np.full(rows * columns, -np.inf)

    triangles = points[faces]
    origin, first, second = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    determinant = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # Samples lie at half-integer coordinates.
    size = np.array([columns, rows])
    lowest = np.clip(np.ceil(triangles.min(axis=1) - 0.5), 0, size).astype(np.int64)
    highest = np.clip(np.floor(triangles.max(axis=1) - 0.5), -1, size - 1).astype(np.int64)
    box = np.maximum(highest - lowest + 1, 0)
    candidates = np.where(determinant != 0, box.prod(axis=1), 0)

    for chunk in np.split(
        np.arange(len(faces)), np.flatnonzero(np.diff(np.cumsum(candidates) // _CHUNK)) + 1
    ):
        face = np.repeat(chunk, candidates[chunk])
        starts = np.cumsum(candidates[chunk]) - candidates[chunk]
        row, column = np.divmod(np.arange(len(face)) - np.repeat(starts, candidates[chunk]), box[face, 0])
        sample = lowest[face] + np.stack([column, row], axis=1)
        x, y = (sample + 0.5 - origin[face]).T
        weight_1 = (x * second[face, 1] - y * second[face, 0]) / determinant[face]
        weight_2 = (y * first[face, 0] - x * first[face, 1]) / determinant[face]
        weight = np.stack([1 - weight_1 - weight_2, weight_1, weight_2], axis=1)
        inside = (weight >= -1e-9).all(axis=1)
        face, weight, pixel = face[inside], weight[inside], sample[inside] @ [1, columns]
        depth = np.einsum("pc,pc->p", weight, depths[faces[face]])
        np.maximum.at(nearest, pixel, depth)
        wins = depth == nearest[pixel]
        front[pixel[wins]] = face[wins]
        weights[pixel[wins]] = weight[wins]
    return front, weights, nearest


def _occlusion(depth: np.ndarray, scale: float) -> np.ndarray:
    """Light left where something near is in front: unsharp masking of the depth (Luft et al. 2006)."""
    # A blurred depth needs one sample per pixel only.
    image = depth[::_SUPERSAMPLING, ::_SUPERSAMPLING]
    share = np.isfinite(image).astype(float)
    blurred = np.where(share > 0, image, 0)
    for _ in range(2):
        blurred, share = (uniform_filter(values, round(0.05 * scale)) for values in (blurred, share))
    blurred /= np.maximum(share, 1e-3)
    nearer = blurred.repeat(_SUPERSAMPLING, axis=0).repeat(_SUPERSAMPLING, axis=1) - depth
    return np.exp(-6 * np.clip(nearer, 0, 0.2))
