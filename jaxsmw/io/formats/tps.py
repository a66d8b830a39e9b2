"""Text in the format `.tps` of the program tpsDig, which geomorph and Morpho read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64


def write_tps(names: Sequence[str], positions: Float64[np.ndarray, "N k 3"]) -> str:
    """Return the text of a file with the positions of k points on N specimens, which have names."""
    blocks = []
    for name, points in zip(names, positions.tolist(), strict=True):
        rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points)
        blocks.append(f"LM3={len(points)}\n{rows}ID={name}\n")
    return "\n".join(blocks)
