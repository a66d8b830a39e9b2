"""Other maps of a pair that could be right, and in what they differ from the map that was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64
from scipy.spatial.transform import Rotation

from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.mesh import extend_to_unreferenced
from jaxsmw.matching.search.evidence import probability
from jaxsmw.matching.search.search import Judged

# One map is another one, turned, if a rotation explains all but this share of the squared distances between
# their matches.
_TURNED = 0.2


class Alternative(NamedTuple):
    """Another map that could be right.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), int64, as 0-based vertices of Y.
    - `probability`: the probability that this map is right, from 0 to 1.
    - `difference`: in what it differs from the chosen map, such as `"mirrored"` or `"turned by 180° about the
      axis (0.0, 0.0, 1.0) of the target"`.
    """

    pointwise_map: Int64[np.ndarray, " m"]
    probability: float
    difference: str


def alternatives(best: Judged, others: Sequence[Judged]) -> tuple[float, tuple[Alternative, ...]]:
    """Return the probability that the best map is right, and the other maps, the most probable first."""
    any_right = probability(best.log_odds)
    return best.share * any_right, tuple(
        Alternative(
            extend_to_unreferenced(other.reading.prepared.given.mesh_x, other.pointwise_map),
            other.share * any_right,
            difference(best, other),
        )
        for other in others
    )


def difference(best: Judged, other: Judged) -> str:
    """Describe in what a map differs from the best map."""
    first, second = best.reading, other.reading
    if first.prepared.mirrored != second.prepared.mirrored:
        return "mirrored"
    if first.prepared.pair.partial != second.prepared.pair.partial:
        return "matched as a part and a whole" if second.prepared.pair.partial else "matched as full shapes"
    matches = best.matches, other.matches
    areas, (placed, elsewhere) = first.x.areas, (first.y.positions[chosen] for chosen in matches)
    turn = rigid_fit(placed, elsewhere, areas)
    left, apart = (areas @ ((points - elsewhere) ** 2).sum(axis=1) for points in (turn.apply(placed), placed))
    if left < _TURNED * apart:
        vector = Rotation.from_matrix(turn.rotation).as_rotvec(degrees=True)
        angle = np.linalg.norm(vector)
        # Zero is added because -0.0 + 0.0 is 0.0.
        axis = ", ".join(f"{part:.1f}" for part in np.round(vector / max(angle, 1e-9), 1) + 0.0)
        return f"turned by {angle:.0f}° about the axis ({axis}) of the target"
    return f"different on {first.difference(*matches):.0%} of the source"
