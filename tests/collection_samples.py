"""A small collection, which the tests of the collection's page share."""

from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsmw.collection.shape_models import shape_model
from jaxsmw.creature import creature
from jaxsmw.report.collection_page import PageEdge

HOSTILE = '</script></title><img src=x onerror="window.hacked=1"><b>\'&{{script}}'
_POSES = ("rest", "stand", "walk", "sit")
NAMES = [*_POSES, "blend"]


@cache
def _meshes() -> tuple[Any, ...]:
    return tuple(creature("quadruped", vertices=600, pose=pose) for pose in _POSES)


def collection() -> dict[str, Any]:
    """The arguments of `write_collection_page` for four poses of a creature and a blend of two poses.

    All shapes but the template are moved.
    """
    generator = np.random.default_rng(0)
    meshes = _meshes()
    shapes = [mesh.vertices for mesh in meshes] + [0.5 * (meshes[1].vertices + meshes[2].vertices)]
    moved = [Rotation.random(rng=generator).apply(shape) + generator.normal(size=3) for shape in shapes]
    registered = [shapes[0], *moved[1:]]
    return {
        "names": list(NAMES),
        "faces": meshes[0].faces,
        "registered": registered,
        "template": 0,
        "edges": [
            PageEdge(0, 1, 4.25, False, ""),
            PageEdge(1, 2, 30.5, True, "Left and right may be exchanged."),
            PageEdge(0, 3, float("nan"), False, ""),
            PageEdge(1, 4, 2.0, False, ""),
        ],
        "model": shape_model(registered, weights=meshes[0].vertex_areas),
        "title": "Five foxes",
        "notes": ["The template is rest."],
        "left_out": {"broken.off": "The mesh has no faces."},
    }
