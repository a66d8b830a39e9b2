"""The settings of the repair of wrong maps and of the expected error."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScoreSettings:
    """The settings of `jaxsmw.repair.scores`. Lengths are in units of the square root of the area.

    The tables named here are in `docs/research_log.md`.

    **Attributes:**

    - `vertices_per_eigenvector`: the smallest number of vertices per eigenvector in the computation of
      Dirichlet energies. With more eigenvectors, the energies on a coarse mesh would depend on the distances
      between vertices.
    - `discontinuity_distance`, `discontinuity_ratio`: an edge is discontinuous if the distance between the
      matches of its ends is at least this distance and at least this multiple of the edge's length. (Matches
      of neighbouring vertices are 0.03 apart on bodies of 5000 vertices.)
    - `orientation_eigenvectors`: the number of eigenvectors in whose span the density of signed area is
      smoothed.
    - `orientation_threshold`: the orientation counts as reversed where the smoothed density of signed area is
      below this value. An isometry has density 1.
    - `orientation_weight` (Table R6): the weight in the distortion of the share of X's area with orientation
      reversal.
    - `same_map_distance`: the matches of two maps differ at a vertex if their distance exceeds this distance.
    - `same_map_area`: two maps count as the same if their matches differ on less than this share of X's area.
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
    """The settings of `jaxsmw.repair.expected_error`. Lengths are in units of the square root of the area.

    The tables named here are in `docs/research_log.md`.

    **Attributes:**

    - `detour_weight` (Tables R17 and R18): the weight of the detour of a vertex. The detour is the distance
      between a vertex of X and the vertex that results if the map takes the vertex to Y and the reverse map
      takes the match back to X.
    - `distortion_weight`: the weight of the mean change in length of the edges at a vertex. With the default
      values of both weights, the true errors on real pairs are 0.8 to 1.4 times the expected errors.
    - `misplaced_weight`: the expected error on a misplaced limb, in units of the square root of the limb's
      area.
    - `heat_time`: the time of the heat flow that averages over neighbours. The default value averages over a
      disk of radius 0.06.
    """

    detour_weight: float = 0.5
    distortion_weight: float = 2.0
    misplaced_weight: float = 0.5
    heat_time: float = 1e-3


@dataclass(frozen=True)
class ExtremitySettings:
    """The settings of `jaxsmw.repair.extremities`. Lengths are in units of the square root of the area.

    **Attributes:**

    - `samples`: the number of evenly spread samples from which mean distances to the surface are computed.
    - `distance`: the smallest allowed distance between two extremities.
    - `most`: the largest number of extremities. The limit exists because the number of pairings grows very
      fast with the number of extremities.
    """

    samples: int = 200
    distance: float = 0.35
    most: int = 6


@dataclass(frozen=True)
class RepairSettings:
    """The settings that determine when a map counts as wrong, and how the map is repaired.

    A `Preset` contains these settings. A map is judged by its distortion, which is 1 for isometries and
    larger for worse maps, and by its faults. The faults are vertices with orientation reversal and parts that
    discontinuities separate from the rest of X. The tables and entries named here are in
    `docs/research_log.md`.

    **Attributes:**

    - `stage`: the 0-based position, among the stages of the preset, of the stage that repair repeats. The
      refiner of this stage must have levels.
    - `fallback_levels` (entry R4): the numbers of eigenvectors in the iterations of the repeated stage in the
      fallback, which follows the rounds. The default begins with fewer eigenvectors than the stage itself.
    - `suspicious` (Table R3): the distortion at which a map becomes suspicious and is repaired. Correct maps
      between poses of one body have a smaller distortion.
    - `doubtful` (Table R3): after repair, a map without faults and with a distortion below this value counts
      as correct. Between non-isometric shapes, some correct maps have distortions up to this value.
    - `negligible_area`: a fault with a smaller share of X's area is not repaired. Small faults, as at
      fingertips, appear and disappear by chance.
    - `excessive_area`: a fault with a larger share of X's area is not repaired. If most of a body is mapped
      upside down, the rest of the map does not determine the correct map.
    - `rounds` (Table R5): the number of rounds of repair. Each round runs the repeated stage and all later
      stages.
    - `rough_rounds`: the number of rounds for each alternative initial map. These rounds run the repeated
      stage but no later stages.
    - `finalists`: the largest number of alternative initial maps that are refined by all stages.
    - `agreeing` (entry R7): if no map looks correct, a map to which at least this number of initial maps lead
      is chosen. (Two wrong maps are sometimes the same, but three wrong maps are seldom the same.)
    - `uncertainty_weight` (Table R13): the weight of the feature regression's uncertainty in the score,
      relative to the logarithm of the distortion. Upside-down maps have a higher uncertainty, and mirrored
      maps have a higher distortion. Weights from 6 to 12 lead to nearly the same choices of maps.
    - `score_tolerance` (entry R4): the map of the fallback is preferred if it looks correct and its score is
      worse by less than this value. The scores of two correct maps mostly differ by less than this value, and
      the scores of a correct map and an upside-down map differ by more.
    - `alternatives` (Table R13): the alternative initial maps from functional maps, as a tuple of pairs. Each
      pair has a tuple of SHOT radii, in multiples of the usual radius 0.06, and a weight from 0 to 1. The
      functional map from nearest neighbours of Y's vertices on X has this weight, and the functional map from
      nearest neighbours of X's vertices on Y has the remaining weight.
    - `alternative_eigenvectors`: the number of eigenvectors of these functional maps.
    - `extremity_levels`: the levels (numbers of eigenvectors) of the feature regression that refines maps
      from pairings of extremities (entry R14).
    - `extremity_descriptors`, `extremity_samples`: the number of descriptors and the number of samples of
      this feature regression (entry R14).
    - `extremity_pairings`: the largest number of pairings of extremities that are tried.
    - `extremity_maps`: the largest number of pairings that become alternative initial maps.
    - `extremities`: the settings by which extremities are found, an `ExtremitySettings`.
    - `scores`: the settings of the distortion and of the faults, a `ScoreSettings`.
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
