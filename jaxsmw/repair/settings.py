"""The settings of the repair of wrong maps and of the expected error."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScoreSettings:
    """The settings of `jaxsmw.repair.scores`. Lengths are in square roots of the area.

    Tables are in `docs/research_log.md`.

    **Attributes:**

    - `vertices_per_eigenvector`: the smallest number of vertices per eigenvector in the computation of
      Dirichlet energies. On a coarse mesh, more eigenvectors would measure the distances between vertices.
    - `discontinuity_distance`, `discontinuity_ratio`: an edge is discontinuous if the distance between the
      matches of its ends exceeds both this distance and this multiple of the edge's length. (Matches of
      neighbours are 0.03 apart on bodies of 5000 vertices.)
    - `orientation_eigenvectors`: the number of eigenvectors in whose span the density of signed area is
      smoothed.
    - `orientation_threshold`: the orientation is reversed where the smoothed density is below this value. An
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
    """The settings of `jaxsmw.repair.expected_error`. Lengths are in square roots of the area.

    Tables are in `docs/research_log.md`.

    **Attributes:**

    - `detour_weight` (Tables R17 and R18): the weight of the distance between a vertex of X and the vertex to
      which the reverse map takes its match.
    - `distortion_weight`: the weight of the mean change of the lengths of a vertex's edges. With both
      weights, errors on real pairs are 0.8 to 1.4 times the expected errors.
    - `misplaced_weight`: the expected error of a misplaced limb, in square roots of the limb's area.
    - `heat_time`: the time of the heat flow that averages over neighbours. The default averages over a disk
      of radius 0.06.
    """

    detour_weight: float = 0.5
    distortion_weight: float = 2.0
    misplaced_weight: float = 0.5
    heat_time: float = 1e-3


@dataclass(frozen=True)
class ExtremitySettings:
    """The settings of `jaxsmw.repair.extremities`. Lengths are in square roots of the area.

    **Attributes:**

    - `samples`: the number of evenly spread samples that represent the surface in mean distances.
    - `distance`: the smallest distance between two extremities.
    - `most`: the largest number of extremities. The limit exists because the number of pairings grows very
      fast with the number of extremities.
    """

    samples: int = 200
    distance: float = 0.35
    most: int = 6


@dataclass(frozen=True)
class RepairSettings:
    """The settings that determine when a map counts as wrong, and how the map is repaired.

    Tables and entries are in `docs/research_log.md`.

    **Attributes:**

    - `stage`: the position (0-based) of the stage that repair repeats. The refiner of this stage must have
      levels.
    - `fallback_levels` (entry R4): the levels of this stage in the fallback. The fallback begins with fewer
      eigenvectors than the stage itself.
    - `suspicious` (Table R3): the distortion above which a map is repaired. Correct maps between poses of one
      body have a smaller distortion.
    - `doubtful` (Table R3): the distortion up to which a map without remaining faults counts as correct after
      repair. Between non-isometric shapes, some correct maps have distortions up to this value.
    - `negligible_area`, `excessive_area`: the smallest and the largest share of the area at which a fault is
      repaired. Small faults, as at fingertips, appear and disappear by chance. If most of a body is mapped
      upside down, the rest of the map does not determine the correct map.
    - `rounds` (Table R5): the number of rounds of repair. Each round includes all later stages.
    - `rough_rounds`: the number of rounds for alternative initial maps. These rounds omit all later stages.
    - `finalists`: the number of alternative initial maps that are refined by all stages.
    - `agreeing` (entry R7): the number of initial maps that must lead to the same map before this map is
      chosen although no map looks correct. (Two wrong maps are sometimes the same, three wrong maps seldom.)
    - `uncertainty_weight` (Table R13): the weight of the regression's uncertainty in the score, relative to
      the logarithm of the distortion. Upside-down maps have a higher uncertainty, mirrored maps have a higher
      distortion. Weights from 6 to 12 lead to nearly the same choices.
    - `score_tolerance` (entry R4): the fallback is preferred if its score is worse by less than this value.
      The scores of correct maps mostly differ by less, and those of upside-down maps differ by more.
    - `alternatives` (Table R13): the alternative initial maps from functional maps. Each entry gives the SHOT
      radii in multiples of the usual radius, and the weight of the map from Y to X.
    - `alternative_eigenvectors`: the number of eigenvectors of these functional maps.
    - `extremity_levels`, `extremity_descriptors`, `extremity_samples` (entry R14): the levels, the number of
      descriptors and the number of samples of the stage that refines maps from pairings of extremities.
    - `extremity_pairings`: the largest number of pairings that are tried.
    - `extremity_maps`: the largest number of pairings that become alternative initial maps.
    - `extremities`: the settings by which extremities are found.
    - `scores`: the settings of the scores.
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
