"""The settings of `match_collection`."""

from __future__ import annotations

from dataclasses import dataclass

from jaxsmw.collection.synchronization import SynchronizationSettings
from jaxsmw.errors import InputError, check_number, check_whole_number


@dataclass(frozen=True)
class CollectionSettings:
    """The settings of the graph and of the consistency of a collection.

    Lengths are in units of the square root of the area of each shape. Table R26 is in
    `docs/research_log.md`.

    **Attributes:**

    - `edges_per_shape` (Table R26): the number of matched pairs divided by the number of shapes.
    - `random_share` (Table R26): the share of random edges, from 0 to 1; see `choose_edges`.
    - `cycle_samples`: the number of samples of each shape at which cycles are compared.
    - `contradicted_from` (Table R26): an edge contradicts the collection if the mean distance between its
      maps and the maps through the template is at least this value. The edge is then matched again, from the
      consistent map.
    - `distortion_weight` (Table R26): the error of an edge grows by this number times the squared logarithm
      of the distortion of its map.
    - `distortion_tolerance`: a new map replaces the old map of an edge only if the distortion of the new map
      is at most this multiple of the old distortion.
    - `outlier_from`: a shape is an outlier if the errors of all its edges are at least this value. In
      collections of one kind of body, every shape had an edge with an error of at most 0.04.
    - `rounds`: the largest number of times that contradicted edges are matched again.
    - `synchronization`: the settings of `synchronize`, a `SynchronizationSettings`.

    **Raises:** `InputError` if a setting is not valid.
    """

    edges_per_shape: float | int = 4
    random_share: float = 0.25
    cycle_samples: int = 200
    contradicted_from: float = 0.05
    distortion_weight: float = 2.0
    distortion_tolerance: float = 1.02
    outlier_from: float = 0.1
    rounds: int = 2
    synchronization: SynchronizationSettings = SynchronizationSettings()  # noqa: RUF009 (immutable)

    def __post_init__(self) -> None:
        check_number("edges_per_shape", self.edges_per_shape, positive=True)
        check_number("random_share", self.random_share, most=1.0)
        check_whole_number("cycle_samples", self.cycle_samples, 1)
        check_number("contradicted_from", self.contradicted_from)
        check_number("distortion_weight", self.distortion_weight)
        check_number("distortion_tolerance", self.distortion_tolerance, positive=True)
        check_number("outlier_from", self.outlier_from, positive=True)
        check_whole_number("rounds", self.rounds, 0)
        if not isinstance(self.synchronization, SynchronizationSettings):
            raise InputError(f"synchronization is {self.synchronization!r}: give SynchronizationSettings.")
