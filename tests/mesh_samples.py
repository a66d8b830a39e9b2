"""Meshes with all kinds of data, for the tests of mesh files."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.mesh_data import MeshData, Skeleton, Skin, Texture


def sample(*, seam: bool = True, seed: int = 0) -> MeshData:
    """A tetrahedron strip with every kind of data, an unreferenced vertex and a repeated face."""
    random = np.random.default_rng(seed)
    n = 7
    vertices = random.normal(size=(n, 3))
    faces = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [0, 2, 1], [5, 4, 0]])
    if seam:
        corners = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [6, 5, 7], [0, 2, 1], [7, 6, 8]])
        texture = Texture(random.uniform(size=(10, 2)), corners)
    else:
        texture = Texture(random.uniform(size=(n, 2)), faces)
    weights = random.uniform(size=(n, 6)) * (random.uniform(size=(n, 6)) > 0.3)
    weights[:, 2] += 0.1
    matrices = np.tile(np.eye(4), (6, 1, 1))
    matrices[:, :3, :3] = Rotation.random(6, rng=seed).as_matrix() * [
        [[2.0]],
        [[-1]],
        [[1]],
        [[1]],
        [[1]],
        [[1]],
    ]
    matrices[3, :3, :3] @= [[1, 0.5, 0], [0, 1, 0], [0, 0, 3]]  # is not a rotation with a scale
    matrices[:, :3, 3] = random.normal(size=(6, 3))
    skeleton = Skeleton(np.array([4, 0, -1, 4, -1, 3]), matrices)
    return MeshData(
        make_mesh(vertices, faces, name="sample"),
        faces,
        vertex_data={
            "colors": random.integers(0, 256, (n, 3), dtype=np.uint8),
            "temperature": random.normal(size=n),
            "flow": random.normal(size=(n, 3)).astype(np.float32),
            "index": np.arange(n, dtype=np.int32) - 3,
            "flags": np.array([0, 255, 3, 4, 5, 6, 7], np.uint8),
            "short": np.array([[-5, 7]] * n, np.int16),
            "long": np.arange(n) * 10**6,
        },
        face_data={
            "colors": random.integers(0, 256, (6, 3), dtype=np.uint8),
            "group": np.array([0, 0, 1, 1, 2, 0]),
            "stress": random.normal(size=(6, 6)),
        },
        texture=texture,
        blend_shapes={"smile": random.normal(size=(n, 3)), "blink left": random.normal(size=(n, 3))},
        skin=Skin(
            tuple(f"joint {i}" for i in range(6)), weights / weights.sum(axis=1, keepdims=True), skeleton
        ),
        label_names={"group": ("head", "left arm", "rest")},
    )
