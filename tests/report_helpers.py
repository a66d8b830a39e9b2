"""Meshes, and parsers of pages and tables, that the tests of figures and reports share."""

import base64
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
from synthetic import sphere_mesh

from jaxsmw.geometry.mesh import Mesh


def ellipsoid(*half_axes: float, subdivisions: int = 3, name: str = "ellipsoid") -> Mesh:
    vertices, faces = sphere_mesh(subdivisions)
    return Mesh(vertices * half_axes, faces.astype(np.int64), name)


def renumbered(mesh: Mesh, seed: int = 0) -> tuple[Mesh, np.ndarray]:
    """Return the surface with shuffled vertices and faces, and the new index of each vertex."""
    generator = np.random.default_rng(seed)
    order = generator.permutation(len(mesh.vertices))
    number = np.argsort(order)
    faces = generator.permutation(number[mesh.faces])
    return replace(mesh, vertices=mesh.vertices[order], faces=faces), number


TALL = ellipsoid(0.6, 1.2, 0.3)  # a standing body whose up axis is y


def uniform(mesh: Mesh, *color: float) -> np.ndarray:
    return np.tile(np.array(color, dtype=float), (len(mesh.vertices), 1))


def cells(text: str) -> list[list[str]]:
    """Return the cells of the Markdown tables in a text, by rows."""
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]


def embedded(page: str) -> dict[str, Any]:
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert data
    return json.loads(data[1])


def decode(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)
