"""Collections whose maps are known, because all meshes have the same triangulation."""

import numpy as np

from jaxsmw.collection import Collection
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.transfer.registered_mesh import register_mesh


def known_collection(shapes: np.ndarray, faces: np.ndarray, mirrored: np.ndarray) -> Collection:
    """Return the collection of shapes (N, n, 3). The mesh of a mirrored shape is the shape's mirror image."""
    n = shapes.shape[1]
    of_vertex = np.zeros(n, np.int64)
    of_vertex[faces] = np.arange(len(faces))[:, None]
    points = SurfacePoints(of_vertex, (faces[of_vertex] == np.arange(n)[:, None]).astype(float))
    meshes = []
    for i, (shape, other) in enumerate(zip(shapes, mirrored, strict=True)):
        mesh = make_mesh(shape, faces, name=f"shape{i}")
        meshes.append(make_mesh(shape * [-1.0, 1.0, 1.0], faces, name=f"shape{i}") if other else mesh)
    return Collection(
        tuple(meshes),
        0,
        (points,) * len(meshes),
        mirrored,
        tuple(register_mesh(meshes[0], mesh, points) for mesh in meshes),
        (),
        (np.zeros(0), np.zeros(0)),
    )
