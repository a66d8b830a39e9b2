"""A small collection, which the tests of the collection's page share."""

from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsmw.collection.result import MatchedEdge
from jaxsmw.collection.shape_models import shape_model
from jaxsmw.creature import creature

HOSTILE = '</script></title><img src=x onerror="window.hacked=1"><b>\'&{{script}}'
_POSES = ("rest", "stand", "walk", "sit")
NAMES = [*_POSES, "blend"]


@cache
def _meshes() -> tuple[Any, ...]:
    return tuple(creature("quadruped", vertices=600, pose=pose) for pose in _POSES)


def edge(source: int, target: int, thousandths: float, *, doubtful: bool = False) -> MatchedEdge:
    """A matched pair with an expected error in thousandths."""
    error = thousandths / 1000
    return MatchedEdge(source, target, error, 1.1, error, 0.01, "kept", doubtful)


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
            edge(0, 1, 4.25),
            edge(1, 2, 30.5, doubtful=True),
            edge(0, 3, float("inf")),
            edge(1, 4, 2.0),
        ],
        "model": shape_model(registered, weights=meshes[0].vertex_areas),
        "title": "Five foxes",
        "notes": ["The template is rest."],
        "left_out": {"broken.off": "The mesh has no faces."},
    }
