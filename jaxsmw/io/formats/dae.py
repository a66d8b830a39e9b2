"""A reader of COLLADA files (`.dae`) by pycollada: all geometries of the scene, joined to one surface."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Part, Polygons, joined, placed
from jaxsmw.io.formats.text import export_again, refuse_entities


def parse_dae(data: bytes) -> Polygons:
    """Parse a `.dae` file. If it has several geometries, the face data `group` numbers them."""
    try:
        from collada import Collada
        from collada.common import DaeBrokenRefError, DaeUnsupportedError
    except ImportError:
        raise InputError(
            "is a COLLADA file, which needs the package pycollada: run pip install 'jaxsmw[collada]', or "
            "export the mesh as glTF."
        ) from None
    unimportant = [DaeUnsupportedError, DaeBrokenRefError]  # pictures and materials
    try:
        refuse_entities(data)
        scene = Collada(io.BytesIO(data), ignore=unimportant).scene
        skins = (skin.geometry for skin in scene.objects("controller") if hasattr(skin, "geometry"))
        return joined(part for geometry in (*scene.objects("geometry"), *skins) for part in _part(geometry))
    except InputError:
        raise
    except Exception:  # pycollada can raise any exception for damaged files
        raise export_again("is not a complete COLLADA file") from None


def _part(geometry: Any) -> Iterator[Part]:
    """Yield the parts of a geometry of the scene: the primitives that use the same list of vertices."""
    matrix, original = np.asarray(geometry.matrix, float), geometry.original
    parts: dict[int, list[Any]] = {}
    for one in original.primitives:
        triangles = one.triangleset() if hasattr(one, "triangleset") else one
        if hasattr(triangles, "ntriangles") and triangles.ntriangles:  # lines have none
            parts.setdefault(id(triangles.vertex), []).append(triangles)
    for primitives in parts.values():
        faces = np.concatenate([one.vertex_index for one in primitives]).astype(np.int64)
        vertices = np.asarray(primitives[0].vertex, float)
        yield str(original.name or original.id), *placed(vertices, faces, matrix)
