"""Transfer of data from the source to the target or to the registered mesh."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from scipy.sparse import csr_array

from jaxsmw.errors import InputError
from jaxsmw.geometry.arrays import ratio
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_distance import nearest_surface_points
from jaxsmw.io.mesh_data import COLORS, NORMALS, MeshData, Skin, Texture
from jaxsmw.transfer.registered_mesh import RegisteredMesh
from jaxsmw.transfer.skeletons import with_moved_skeleton
from jaxsmw.transfer.textures import transfer_texture
from jaxsmw.wording import count_of

# A vertex of the target is far from the registered mesh above this distance. The unit of the distance is the
# square root of the target's area. A far vertex probably belongs to a part that the source lacks.
_FAR = 0.03
# The data of a target face are computed from the data at four points of the face. One point is the centroid
# of the face. Each other point is the centroid of a triangle between a corner and the midpoints of the two
# edges at this corner. If two labels have two points each, the label at the face's centroid wins.
_SAMPLES = np.vstack([np.full((1, 3), 1 / 3), np.full((3, 3), 1 / 6) + np.eye(3) / 2])
_VOTES = np.array([1.5, 1, 1, 1])
_Value = TypeVar("_Value")


class _Corners(NamedTuple):
    """For each of p results: k rows of an array, and the weights of these rows."""

    rows: Int64[np.ndarray, "p k"]
    weights: Float64[np.ndarray, "p k"]

    def matrix(self, n: int) -> csr_array:
        """The matrix (p, n) that computes weighted means of n rows."""
        p, k = self.rows.shape
        return csr_array((self.weights.ravel(), self.rows.ravel(), np.arange(p + 1) * k), shape=(p, n))


def transfer_attributes(
    data: MeshData, registered: RegisteredMesh, target: MeshData | Mesh | None = None
) -> MeshData:
    """Transfer all data on the vertices and faces of X to Y.

    The value of a vertex of Y comes from the nearest point of the registered mesh. The value of a face of Y
    is computed from the values at four points of the face. Each kind of data has its own rule:

    - Floats and colours are interpolated. If the vertex with the largest weight has a value that is not
      finite, this value is the result. Otherwise, values that are not finite are left out. Components of
      vectors are interpolated without a rotation.
    - Integers, such as labels, are never averaged. The value with the most votes is chosen. For a vertex,
      each corner of the nearest face votes with its barycentric weight. For a face, each of the four points
      votes. A row of several integers is one label. Labels are not smoothed, so a region that is thinner than
      a face of Y may break up into single faces.
    - Texture coordinates jump at the seams of X. All corners of a face of Y therefore receive coordinates
      from the same side of a seam: the side on which the face's centroid lies. If the nearest face of X has
      no texture, the face of Y has no texture either.
    - Skin weights are interpolated. Let k be the largest number of joints at a vertex of X. Each vertex of Y
      keeps only the k largest weights. The weights of a vertex sum to 1, unless all weights of the nearest
      face are 0. The joints move to the place that they have in Y, and turn with the vertices around them.
    - Blend shapes are displacements of the vertices of X. They are first rotated and scaled in the same way
      as the neighbourhoods of the vertices (`RegisteredMesh.similarities`), and then interpolated.
    - Normals describe the shape of X, so they are not transferred.

    Data of Y are kept if X has no data of the same name. Face data of X also replace vertex data of Y with
    the same name, and vice versa. If both arrays were kept, they would share one list of label names.

    **Arguments:**

    - `data`: the `MeshData` of X. Its `mesh` is `registered.mesh_x`.
    - `registered`: the `RegisteredMesh` of X on Y.
    - `target`: `registered.mesh_y` (the default), or a `MeshData` that contains it.

    **Returns:** The `MeshData` of Y with the vertices and faces of `target`, in the unit of Y. The notes in
    `mesh.notes` name the data of Y that were replaced. They also count the vertices of Y whose distance to
    the registered mesh is above 3 % of the square root of Y's area.

    **Raises:** `InputError` if `data` or `target` do not belong to the registered meshes.
    """
    numbers = _face_numbers(data, registered.mesh_x)
    whole = _as_data(registered.mesh_y if target is None else target)
    _check_mesh(whole.mesh, registered.mesh_y)
    points = registered.points_of_target
    corners = _Corners(data.faces[numbers[points.faces]], points.weights)
    own = {name: values for name, values in data.vertex_data.items() if name != NORMALS}
    vertex_data = {name: _mixed(name, values, corners) for name, values in own.items()}
    face_data: dict[str, np.ndarray] = {}
    if data.face_data:
        sampled = _sampled_faces(registered, whole.faces, numbers)
        face_data = {name: _mixed(name, values, sampled, _VOTES) for name, values in data.face_data.items()}
    matrix = corners.matrix(len(data.mesh.vertices))
    blend_shapes = {
        name: matrix @ registered.similarities.of_vectors(moves) for name, moves in data.blend_shapes.items()
    }
    texture = whole.texture
    if data.texture is not None:
        coordinates, texture_corners = data.texture
        texture = transfer_texture(Texture(coordinates, texture_corners[numbers]), registered, whole.faces)
    taken = {*vertex_data, *face_data}
    return replace(
        whole,
        mesh=replace(whole.mesh, notes=(*whole.mesh.notes, *_notes(data, whole, registered))),
        vertex_data=_without(whole.vertex_data, taken) | vertex_data,
        face_data=_without(whole.face_data, taken) | face_data,
        blend_shapes=_without(whole.blend_shapes, blend_shapes) | blend_shapes,
        texture=texture,
        skin=whole.skin if data.skin is None else _mixed_skin(data.skin, matrix, registered),
        label_names=_without(whole.label_names, taken) | dict(data.label_names),
    )


def registered_data(data: MeshData, registered: RegisteredMesh) -> MeshData:
    """Return the `MeshData` of X at the positions of the registered mesh, in the unit of Y.

    All data keep their order and values, but two kinds of vectors follow the neighbourhood of their vertex
    (`RegisteredMesh.similarities`): the displacements of blend shapes are rotated and scaled, and normals are
    rotated. The joints of a skeleton move as in `transfer_attributes`.

    **Raises:** `InputError` if `data` does not belong to the registered mesh.
    """
    _check_mesh(data.mesh, registered.mesh_x)
    similarities = registered.similarities
    vertex_data = dict(data.vertex_data)
    normals = vertex_data.get(NORMALS)
    if normals is not None and normals.dtype.kind == "f" and normals.shape[1:] == (3,):
        rotated = np.einsum("mij,mj->mi", similarities.rotations, normals.astype(np.float64))
        vertex_data[NORMALS] = rotated.astype(normals.dtype)
    return replace(
        data,
        mesh=replace(registered.mesh, notes=data.mesh.notes, dropped_faces=data.mesh.dropped_faces),
        vertex_data=vertex_data,
        blend_shapes={name: similarities.of_vectors(moves) for name, moves in data.blend_shapes.items()},
        skin=None if data.skin is None else with_moved_skeleton(data.skin, registered),
    )


def _as_data(target: MeshData | Mesh) -> MeshData:
    """Return the target as a `MeshData`. Faces that cleaning dropped from a `Mesh` are not included."""
    if isinstance(target, MeshData):
        return target
    return MeshData(replace(target, dropped_faces=np.empty(0, np.int64)), target.faces)


def _check_mesh(mesh: Mesh, expected: Mesh) -> None:
    """Refuse a mesh that differs from a registered mesh."""
    if not (np.array_equal(mesh.vertices, expected.vertices) and np.array_equal(mesh.faces, expected.faces)):
        raise InputError(
            f"{mesh.name}: the vertices or faces differ from those of {expected.name}, which was registered: "
            "give the data of the registered mesh, or register the mesh of these data."
        )


def _face_numbers(data: MeshData, mesh_x: Mesh) -> Int64[np.ndarray, " f"]:
    """Return the row of `MeshData.faces` for each face of the mesh."""
    _check_mesh(data.mesh, mesh_x)
    numbers = np.arange(len(mesh_x.faces))
    if len(data.faces) != len(numbers):
        numbers = data.mesh.face_numbers
    fits = len(numbers) == 0 or numbers[-1] < len(data.faces)
    # Welding can change which vertices are the corners of a face. The positions of the corners do not change.
    if not fits or not np.array_equal(mesh_x.vertices[data.faces[numbers]], mesh_x.vertices[data.mesh.faces]):
        raise InputError(
            f"{data.mesh.name}: the faces of the data are not those of their mesh: make the data with "
            "read_mesh_data, or give the faces from which the mesh was made."
        )
    return numbers


def _sampled_faces(
    registered: RegisteredMesh, faces: Int64[np.ndarray, "f 3"], numbers: Int64[np.ndarray, " g"]
) -> _Corners:
    """Find the nearest row of the source's `MeshData.faces` for each of four points per target face."""
    samples = np.einsum("sk,fkx->fsx", _SAMPLES, registered.mesh_y.vertices[faces])
    found, _ = nearest_surface_points(samples.reshape(-1, 3), registered.mesh)
    weights = np.full(samples.shape[:2], 1 / len(_SAMPLES))
    return _Corners(numbers[found.faces].reshape(weights.shape), weights)


def _mixed(
    name: str, values: Shaped[np.ndarray, "n ..."], corners: _Corners, votes: np.ndarray | None = None
) -> Shaped[np.ndarray, "p ..."]:
    """Return the interpolated values, or the values with the most votes. Types do not change."""
    if values.dtype.kind == "f":
        return _interpolated(values, corners).astype(values.dtype)
    if name == COLORS and values.dtype == np.uint8:
        mean = corners.matrix(len(values)) @ values.astype(np.float64)
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    labels = values if values.ndim == 1 else np.unique(values, axis=0, return_inverse=True)[1].ravel()
    at = labels[corners.rows]
    weights = corners.weights if votes is None else np.broadcast_to(votes, at.shape)
    totals = np.stack([((at == at[:, [k]]) * weights).sum(axis=1) for k in range(at.shape[1])], axis=1)
    return values[corners.rows[np.arange(len(at)), totals.argmax(axis=1)]]


def _interpolated(values: Shaped[np.ndarray, "n ..."], corners: _Corners) -> Float64[np.ndarray, "p ..."]:
    """Return weighted means of floats; `transfer_attributes` explains values that are not finite."""
    matrix, values = corners.matrix(len(values)), values.astype(np.float64)
    finite = np.isfinite(values)
    if finite.all():
        return matrix @ values
    total, share = matrix @ np.where(finite, values, 0), matrix @ finite.astype(np.float64)
    means = ratio(total, share)
    heaviest = values[corners.rows[np.arange(len(corners.rows)), corners.weights.argmax(axis=1)]]
    return np.where(np.isfinite(heaviest), means, heaviest)


def _mixed_skin(skin: Skin, matrix: csr_array, registered: RegisteredMesh) -> Skin:
    """Return interpolated weights, with at most as many joints per vertex as the source has."""
    own = np.maximum(skin.weights, 0)
    most = int((own > 0).sum(axis=1).max(initial=0))
    weights = matrix @ own
    if 0 < most < weights.shape[1]:
        # A stable sort makes the choice between equal weights independent of the machine.
        omitted = np.argsort(-weights, axis=1, kind="stable")[:, most:]
        np.put_along_axis(weights, omitted, 0, axis=1)
    totals = weights.sum(axis=1, keepdims=True)
    return with_moved_skeleton(skin, registered)._replace(weights=ratio(weights, totals))


def _without(values: Mapping[str, _Value], names: Collection[str]) -> dict[str, _Value]:
    return {name: value for name, value in values.items() if name not in names}


def _notes(data: MeshData, target: MeshData, registered: RegisteredMesh) -> list[str]:
    """Return sentences about data that were not transferred, were replaced, or come from far away."""
    notes = []
    if NORMALS in data.vertex_data:
        notes.append("normals were not transferred, because they describe the shape of the source.")
    own = {*data.vertex_data, *data.face_data} - {NORMALS}
    replaced = [name for name in (*target.vertex_data, *target.face_data) if name in own]
    replaced += [name for name in target.blend_shapes if name in data.blend_shapes]
    named = [repr(name) for name in dict.fromkeys(replaced)]
    for what in ("texture", "skin"):
        if getattr(data, what) is not None and getattr(target, what) is not None:
            named.append(f"the {what}")
    if named:
        notes.append(f"the data of the target were replaced by those of the source: {', '.join(named)}.")
    far = int((registered.target_distances > _FAR * np.sqrt(registered.mesh_y.area)).sum())
    if far:
        notes.append(
            f"{count_of(far, 'vertex')} of {len(registered.mesh_y.vertices)} farther from the registered "
            f"source than {_FAR:.0%} of the square root of the target's area: the data there are those of "
            "the nearest point, and the source may lack this part."
        )
    return notes
