"""Triangle meshes on the host: what they are, what is wrong with them, reading and writing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh whose vertices keep the numbers they had in the file.

    Nothing ever renumbers vertices: cleaning changes faces only, and a vertex that no face uses stays
    where it is (`used_vertices` tells). So vertex i here is vertex i of the user's file, always.

    **Attributes:**

    - `vertices`: positions (n, 3), float64, in the file's unit.
    - `faces`: vertex indices (f, 3), 0-based.
    - `name`: how messages call this mesh (for a file: its path).
    - `notes`: what was noticed and what was mended on the way in, one sentence each.
    """

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "f 3"]
    name: str = "mesh"
    notes: tuple[str, ...] = ()

    @cached_property
    def face_areas(self) -> Float64[np.ndarray, " f"]:
        """Triangle areas, in the squared unit of the vertices."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return 0.5 * np.linalg.norm(normals, axis=1)

    @cached_property
    def area(self) -> float:
        """Total surface area."""
        return float(self.face_areas.sum())

    @cached_property
    def used_vertices(self) -> Bool[np.ndarray, " n"]:
        """True for vertices that at least one face uses."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        return used
