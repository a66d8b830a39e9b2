"""Shaded pictures of meshes, rendered with NumPy: the camera, the visible surface and the light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import uniform_filter

from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import linear_to_srgb, srgb_to_linear
from jaxsmw.report.standing import facing

# The preferred azimuth of the viewer in radians, measured from +z towards +x. At this azimuth, the viewer is
# in front of the body and a little to the side.
_PREFERRED_AZIMUTH = np.radians(30)
ELEVATION = np.radians(8)
"""The angle at which the viewer looks down on the body, in radians."""

# An open surface is seen from its outside rather than from the preferred side if the projected area of the
# outside exceeds the projected area of the inside by more than about a tenth of the surface area.
_OUTSIDE_WEIGHT = 10.0

# The first three numbers of each light are its direction in camera coordinates (right, up, towards the
# viewer). The last number is the strength of the light.
_LIGHTS = ((-0.45, 0.60, 0.65, 0.72), (0.85, 0.15, 0.50, 0.22))
_AMBIENT, _SKY = 0.32, 0.13

# `_SUPERSAMPLING` is the number of samples per pixel in each direction. Faces are drawn in chunks. In each
# chunk, the bounding boxes of all faces together contain about `_CHUNK` samples.
_SUPERSAMPLING = 2
_CHUNK = 100_000


def choose_azimuth(meshes: Sequence[Mesh]) -> float:
    """Return the azimuth, in radians from forward (+z) towards +x, from which a camera shows all meshes well.

    The best direction of view is the horizontal direction in which the bodies are thin. This direction shows
    people from the front and animals from the side. Directions close to a preferred direction r, from the
    front and a little from the side, are favoured. Let M be the sum of the horizontal covariance matrices of
    all n upright meshes, each scaled to trace 1. The chosen direction is the eigenvector of M - 0.8 n r r^T
    with the smallest eigenvalue. Its sign is chosen such that the viewer is in front of the bodies, unless
    they are open surfaces whose outside faces the other way.
    """
    preferred = np.array([np.sin(_PREFERRED_AZIMUTH), np.cos(_PREFERRED_AZIMUTH)])
    matrix = -0.8 * len(meshes) * np.outer(preferred, preferred)
    for mesh in meshes:
        horizontal = mesh.vertices[:, [0, 2]]
        horizontal = horizontal - mesh.vertex_areas @ horizontal / mesh.area
        covariance = (mesh.vertex_areas * horizontal.T) @ horizontal
        matrix += covariance / max(np.trace(covariance), 1e-12)
    direction = np.linalg.eigh(matrix)[1][:, 0]
    outside = np.mean([facing(mesh)[[0, 2]] for mesh in meshes], axis=0)
    direction *= np.sign(direction @ (preferred + _OUTSIDE_WEIGHT * outside))
    return float(np.arctan2(*direction))


def camera_axes(azimuth: float) -> Float64[np.ndarray, "3 3"]:
    """Return an orthogonal matrix (3, 3), whose rows point right, up and towards the viewer at an azimuth."""
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    towards = np.array([sine * np.cos(ELEVATION), np.sin(ELEVATION), cosine * np.cos(ELEVATION)])
    right = np.array([cosine, 0, -sine])
    return np.stack([right, np.cross(towards, right), towards])


def render(
    mesh: Mesh, colors: Float64[np.ndarray, "n 3"], *, azimuth: float, scale: float, width: int, height: int
) -> UInt8[np.ndarray, "height width 4"]:
    """Render an upright mesh with coloured vertices and smooth shading on a transparent background.

    The projection is orthographic, with the origin at the centre of the picture. A depth buffer with 2 x 2
    samples per pixel prevents cracks and wrongly sorted triangles. A strong light comes from the upper left,
    and a weak light comes from the right. Each light illuminates the front and the back of a face equally.
    Where one part of the body is in front of another part, the rear part is slightly darker near the outline
    of the front part.

    `colors` contains one sRGB colour in [0, 1] per vertex (n, 3). `azimuth` is in radians; see
    `choose_azimuth`. `scale` is the number of pixels per unit of length.

    **Returns:** RGBA pixels (height, width, 4) with straight alpha, the top row first.
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
    # Where the normals of the corners cancel out, the normal of the face is used. If the back of a face is
    # visible, the normal is reversed, because lights illuminate both sides of a face equally.
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
    """Return the frontmost face of each sample (-1 for none), the barycentric weights, and the depth."""
    # Each face is tested against all samples in its bounding box. One chunk of faces is processed at a time.
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
    # Samples have half-integer coordinates.
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
    """Return the share of light at each sample, by unsharp masking of the depth (Luft et al. 2006)."""
    # One sample per pixel is enough, because the depth is blurred.
    image = depth[::_SUPERSAMPLING, ::_SUPERSAMPLING]
    share = np.isfinite(image).astype(float)
    blurred = np.where(share > 0, image, 0)
    for _ in range(2):
        blurred, share = (uniform_filter(values, round(0.05 * scale)) for values in (blurred, share))
    blurred /= np.maximum(share, 1e-3)
    nearer = blurred.repeat(_SUPERSAMPLING, axis=0).repeat(_SUPERSAMPLING, axis=1) - depth
    return np.exp(-6 * np.clip(nearer, 0, 0.2))
