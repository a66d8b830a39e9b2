"""The maps between the matched pairs of a collection (the edges of its graph), in both directions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Int64

from jaxsmw.collection.pairs import match_many, prepare_task
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.preparation import PreparedShape
from jaxsmw.matching.stages import Preset


@dataclass(frozen=True, eq=False)
class EdgeMap:
    """The maps between the source X (m vertices) and the target Y (n vertices) of an edge.

    **Attributes:**

    - `forward`: the match of every vertex of X, as `SurfacePoints` on Y with m entries.
    - `backward`: the match of every vertex of Y, as `SurfacePoints` on X with n entries.
    - `expected_error`: the mean expected error, in units of the square root of the area; see
      `jaxsmw.matching.judge.expected_error`.
    - `distortion`: the distortion of the map; see `jaxsmw.matching.judge.distortion`.
    - `suspicious`: whether the map looks wrong, judged without the maps of other edges.
    """

    forward: SurfacePoints
    backward: SurfacePoints
    expected_error: float
    distortion: float
    suspicious: bool

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> EdgeMap:
        """Return the maps, given the result of the method `arrays`."""
        forward, backward = (
            SurfacePoints(arrays[f"{name}_faces"].astype(np.int64), arrays[f"{name}_weights"])
            for name in ("forward", "backward")
        )
        expected, distortion, suspicious = arrays["scores"].tolist()
        return cls(forward, backward, expected, distortion, bool(suspicious))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the maps as arrays, for a file."""
        return {
            "forward_faces": self.forward.faces.astype(np.int32),
            "forward_weights": self.forward.weights,
            "backward_faces": self.backward.faces.astype(np.int32),
            "backward_weights": self.backward.weights,
            "scores": np.array([self.expected_error, self.distortion, self.suspicious], np.float64),
        }

    @classmethod
    def of(cls, found: Correspondence) -> EdgeMap:
        """Return the maps of a correspondence of `match` in both directions."""
        assert found.distortion is not None
        return cls(
            found.surface_points(),
            found.reverse_surface_points(),
            float(found.mesh_x.average(found.expected_error())),
            found.distortion,
            found.suspicious,
        )


@dataclass(frozen=True, eq=False)
class EdgeTask:
    """The inputs for the match of one edge.

    **Attributes:**

    - `x`, `y`: the source X (m vertices) and the target Y.
    - `init`: the initial map X -> Y (m,), as 0-based vertices of Y; None for `"shot"`.
    - `aligned`: whether an edge without an initial map is also matched from `"aligned"`. The better map is
      kept; see `jaxsmw.match`.
    """

    x: PreparedShape
    y: PreparedShape
    init: Int64[np.ndarray, " m"] | None = None
    aligned: bool = False


def match_edges(
    tasks: Iterable[EdgeTask], preset: Preset, devices: Sequence[jax.Device] | None = None
) -> Iterator[EdgeMap | ArithmeticError]:
    """Match the edges of a graph, in batches on accelerators; see `match_pairs`.

    A map that looks wrong is repaired, but no alternative maps are tried, because the maps of other
    edges provide a better initial map later.

    **Arguments:**

    - `tasks`: the edges.
    - `preset`: the stages and the repair.
    - `devices`: the JAX devices. The default is all devices of the default backend.

    **Returns:** An iterator with one `EdgeMap` per edge, in the order of `tasks`. If the refinement of an
    edge fails numerically, the iterator yields an `ArithmeticError` for this edge instead.
    """
    prepared = (prepare_task(task.x, task.y, init=task.init, aligned=task.aligned) for task in tasks)
    matched = match_many(prepared, preset, False, devices=devices)
    for found in matched:
        try:
            yield found if isinstance(found, ArithmeticError) else EdgeMap.of(found)
        except ArithmeticError as error:
            yield error
