"""STL files, which are lists of separate triangles (https://www.fabbers.com/tech/STL_Format)."""

from __future__ import annotations

import re

import numpy as np

from jaxsmw.geometry.arrays import first_equal_rows
from jaxsmw.geometry.mesh import coincident_vertices
from jaxsmw.io.formats.polygons import Formatted, Polygons, omissions
from jaxsmw.io.formats.text import export_again, numbers, text
from jaxsmw.io.mesh_data import MeshData
from jaxsmw.wording import count_of

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def parse_stl(data: bytes) -> Polygons:
    """Parse a text or binary file. Corners at the same position become one vertex."""
    header = 84
    count = int.from_bytes(data[80:header], "little")
    behind = len(data) - header - count * _FACET.itemsize
    notes = []
    # All text files and some binary files begin with "solid". Therefore a file is treated as binary if its
    # length fits its header.
    is_text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data.lower()
    # Other programs may own the bytes behind the triangles, unless these could be triangles as well.
    has_more = not is_text and count > 0 and behind > 0 and behind % _FACET.itemsize > 0
    if len(data) >= header and (behind == 0 or has_more):
        corners = np.frombuffer(data, _FACET, count, offset=header)["corners"].reshape(-1, 3)
        corners = corners.astype(np.float64)
        if behind:
            notes.append(f"{count_of(behind, 'byte')} behind the last of {count} declared triangles ignored.")
    elif is_text:
        content = text(data).lower()
        corners = numbers(
            [" ".join(words) for words in re.findall(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", content)], 3
        )
        facets = len(re.findall(r"\bendfacet\b", content))
        if len(corners) != 3 * facets:
            raise export_again(
                f"has {count_of(facets, 'complete facet')} and {count_of(len(corners), 'corner')}, but must "
                "have three corners per facet, so the file is truncated or damaged"
            )
        if "endsolid" not in content:
            notes.append("The file does not end with endsolid, so triangles may be missing.")
    elif len(data) >= header:
        raise export_again(
            f"the header declares {count} triangles, which does not fit the file's {len(data)} bytes, so the "
            "file is truncated or not in the STL format"
        )
    else:
        raise export_again("is neither a text nor a binary STL file")
    equal = first_equal_rows(corners)
    same = equal
    if np.isfinite(corners).all():
        same, _ = coincident_vertices(corners, np.arange(len(corners)).reshape(-1, 3))
    appearance, faces = np.unique(same, return_inverse=True)
    notes.append(
        "STL files have no shared vertices: corners at the same position were merged into "
        f"{count_of(len(appearance), 'vertex')}, numbered by first appearance."
    )
    if rounded := int((same != equal).sum()):
        notes.append(f"The positions of {count_of(rounded, 'merged corner')} differ by rounding.")
    return Polygons(corners[appearance], faces, np.full(len(corners) // 3, 3), tuple(notes))


def format_stl(data: MeshData) -> Formatted:
    """Format all triangles as a binary file with float32 positions."""
    corners = data.mesh.vertices[data.faces].astype(np.float32)
    facets = np.zeros(len(corners), _FACET)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    facets["corners"] = corners
    note = "STL files contain only the positions of corners, so the order of the vertices is lost."
    content = b"triangles".ljust(80) + len(facets).to_bytes(4, "little") + facets.tobytes()
    return content, (note, *omissions(data, "STL"))
