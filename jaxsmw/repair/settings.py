"""Every number on which the repair of wrong maps and the expected error depend."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScoreSettings:
    """The numbers of `jaxsmw.repair.scores`. Lengths are in square roots of the area.

    **Attributes:**

    - `vertices_per_eigenvector`: energies are measured in at most one eigenvector per this number of
      vertices. On coarse meshes further eigenvectors would measure the distances between vertices.
    - `discontinuity_distance`, `discontinuity_ratio`: an edge is discontinuous if its ends are matched
      farther apart than this distance, and than this multiple of the edge's own length. (Matches of
      neighbours are 0.03 apart on bodies of 5000 vertices.)
    - `orientation_eigenvectors`: the density of signed area is smoothed in the span of this number of
      eigenvectors.
    - `orientation_threshold`: orientation is reversed where the smoothed density is below this value; an
      isometry has density 1.
    - `orientation_weight` (Table R6): the weight of the share of reversed area in the distortion.
    - `same_map_distance`, `same_map_area`: two maps are the same if they differ by more than this distance on
      less than this share of the area.
    """

    vertices_per_eigenvector: int = 10
    discontinuity_distance: float = 0.1
    discontinuity_ratio: float = 3.0
    orientation_eigenvectors: int = 50
    orientation_threshold: float = -0.2
    orientation_weight: float = 4.0
    same_map_distance: float = 0.1
    same_map_area: float = 0.03


@dataclass(frozen=True)
class ExpectedErrorSettings:
    """The numbers of `jaxsmw.repair.expected_error`. Lengths are in square roots of the area.

    **Attributes:**

    - `detour_weight` (Tables R17 and R18): the weight of the distance from a vertex to the reverse map's
      match of its match.
    - `distortion_weight`: the weight of the mean change of the lengths of a vertex's edges. With both weights
      errors on real pairs are 0.8 to 1.4 times the expected errors.
    - `misplaced_weight`: the error expected of a misplaced limb, in square roots of the limb's area.
    - `heat_time`: the time of the heat flow that averages over neighbours: over a disk of radius 0.06.
    """

    detour_weight: float = 0.5
    distortion_weight: float = 2.0
    misplaced_weight: float = 0.5
    heat_time: float = 1e-3


@dataclass(frozen=True)
class ExtremitySettings:
    """The numbers of `jaxsmw.repair.extremities`. Lengths are in square roots of the area.

    **Attributes:**

    - `samples`: this number of evenly spread points represents the surface.
    - `distance`: no two extremities are closer to each other.
    - `most`: the largest number of extremities. More have too many pairings.
    """

    samples: int = 200
    distance: float = 0.35
    most: int = 6


@dataclass(frozen=True)
class RepairSettings:
    """When a map counts as wrong, and how it is repaired. `docs/research_log.md` has the tables and entries
    named here.

    **Attributes:**

    - `stage`: the position among the stages of the stage that repair repeats; its refiner has levels.
    - `fallback_levels` (entry R4): the levels of that stage in the last attempt, which starts coarser.
    - `suspicious` (Table R3): a map with a larger distortion is repaired. Right maps between poses of one
      body have less.
    - `doubtful` (Table R3): after repair a map still counts as right up to this distortion, if no fault is
      left; between non-isometric shapes some right maps have that much.
    - `negligible_area`, `excessive_area`: faults on smaller and on larger shares of the area are not
      repaired. (Fingertips come and go. The rest of a body that is mapped upside down does not help.)
    - `rounds` (Table R5): the number of rounds of repair, with all later stages.
    - `rough_rounds`: the number of rounds for alternative initial maps, without later stages.
    - `finalists`: the number of alternative initial maps that go through all stages.
    - `agreeing` (entry R7): if no map looks right, the map to which this number of initial maps leads is
      taken. (Two wrong maps are sometimes the same, three seldom.)
    - `uncertainty_weight` (Table R13): the weight of the regression's uncertainty beside the logarithm of the
      distortion in the score. Upside-down maps are more uncertain, mirrored maps are more distorted. From 6
      to 12 the choices are nearly the same.
    - `score_tolerance` (entry R4): the fallback is preferred if its score is worse by less than this. Right
      maps mostly differ by less, upside-down maps by more.
    - `alternatives` (Table R13): alternative initial maps by functional maps: SHOT radii in multiples of the
      usual radius, and the weight of the reverse map.
    - `alternative_eigenvectors`: the number of eigenvectors of these functional maps.
    - `extremity_levels`, `extremity_descriptors`, `extremity_samples` (entry R14): the stage that refines
      alternative initial maps from pairings of extremities.
    - `extremity_pairings`: the number of pairings that are tried.
    - `extremity_maps`: the number of pairings that become alternative initial maps.
    - `extremities`: the numbers by which extremities are found.
    - `scores`: the numbers of the scores.
    """

    stage: int = 1
    fallback_levels: tuple[int, ...] = (10, 10, 14, 14, 20, 20, 26, 35)
    suspicious: float = 1.12
    doubtful: float = 1.15
    negligible_area: float = 0.002
    excessive_area: float = 0.5
    rounds: int = 4
    rough_rounds: int = 2
    finalists: int = 2
    agreeing: int = 3
    uncertainty_weight: float = 10.0
    score_tolerance: float = 0.25
    alternatives: tuple[tuple[tuple[int, ...], float], ...] = (((1, 2, 4), 0.5), ((1,), 1.0), ((1,), 0.5))
    alternative_eigenvectors: int = 100
    extremity_levels: tuple[int, ...] = (8, 8, 11, 11, 15, 15, 20, 20)
    extremity_descriptors: int = 30
    extremity_samples: int = 500
    extremity_pairings: int = 16
    extremity_maps: int = 2
    extremities: ExtremitySettings = ExtremitySettings()
    scores: ScoreSettings = ScoreSettings()
