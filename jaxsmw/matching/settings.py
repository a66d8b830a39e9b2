"""The settings of the repair, of the judge, and of the expected error."""

from __future__ import annotations

from dataclasses import dataclass

from jaxsmw.errors import InputError, check_number, check_whole_number


@dataclass(frozen=True)
class ScoreSettings:
    """The settings of the distortion and of the faults of a map.

    Lengths are in units of the square root of the area. The tables with numbers R1, R2, … are in
    `docs/research_log.md`.

    **Attributes:**

    - `vertices_per_eigenvector`: the smallest number of vertices per eigenvector in the computation of
      Dirichlet energies. With more eigenvectors, the energies on a coarse mesh would depend on the mesh
      resolution.
    - `discontinuity_distance`, `discontinuity_ratio`: the limits for discontinuous edges. An edge is
      discontinuous if the distance between the matches of its ends is at least `discontinuity_distance` and
      at least `discontinuity_ratio` times the length of the edge. On bodies of 5000 vertices, the distance
      between the matches of neighbouring vertices is 0.03 times the square root of the area.
    - `orientation_eigenvectors`: the number of eigenvectors that smooth the density of signed area. The
      density is projected onto the span of these eigenvectors.
    - `orientation_threshold`: a map reverses the orientation where the smoothed density of signed area is
      below this value. For an isometry, the density is 1.
    - `orientation_weight` (Table R6): the weight of orientation reversal in the distortion. This weight
      multiplies the share of X's area in which the orientation is reversed.
    - `area_eigenvectors`: the number of eigenvectors on which the area-based shape difference is computed.
    """

    vertices_per_eigenvector: int = 10
    discontinuity_distance: float = 0.1
    discontinuity_ratio: float = 3.0
    orientation_eigenvectors: int = 50
    orientation_threshold: float = -0.2
    orientation_weight: float = 4.0
    area_eigenvectors: int = 20


@dataclass(frozen=True)
class ExpectedErrorSettings:
    """The settings of `jaxsmw.matching.judge.expected_error`.

    Lengths are in units of the square root of the area. The tables with numbers R1, R2, … are in
    `docs/research_log.md`.

    **Attributes:**

    - `detour_weight` (Tables R17 and R18): the weight of the detour of a vertex. The detour is the distance
      between the vertex and its image under the map followed by the reverse map.
    - `distortion_weight`: the weight of the mean change in length of the edges at a vertex. With all default
      settings, the mean error of each tested data set is 0.9 to 1.6 times its mean expected error (Table
      R30).
    - `misplaced_weight`: the increase of the expected error on a limb that looks swapped, in units of the
      square root of the limb's area.
    - `heat_time`: the time of the heat flow that averages over neighbouring vertices, in units of the area.
      The default value averages over a disk of radius 0.06.
    - `area_weight`, `isometric_difference` (Table R30): for two full shapes with the area-based shape
      difference d, the expected error is multiplied by `1 + area_weight * log(d / isometric_difference)`. If
      d is smaller than `isometric_difference`, the factor is 1.
    """

    detour_weight: float = 0.5
    distortion_weight: float = 2.0
    misplaced_weight: float = 0.5
    heat_time: float = 1e-3
    area_weight: float = 0.7
    isometric_difference: float = 0.09


@dataclass(frozen=True)
class WrongProbabilitySettings:
    """The coefficients of `jaxsmw.matching.judge.wrong_probability`, a logistic regression. (Table R31)

    **Attributes:**

    - `intercept`: the log-odds that a map is wrong if its distortion and its mean expected error are both 1.
    - `distortion_weight`: the weight of the logarithm of the distortion.
    - `expected_error_weight`: the weight of the logarithm of the mean expected error.
    """

    intercept: float = 4.9
    distortion_weight: float = 2.5
    expected_error_weight: float = 2.1


@dataclass(frozen=True)
class AlternativeSettings:
    """The settings of the alternative maps, which docs/how_it_works.md explains.

    Lengths are in units of the square root of the area. Tables R1, R2, … are in `docs/research_log.md`.

    **Attributes:**

    - `samples`: the number of samples of each shape, at least 1.
    - `radii`: the radii of SHOT in units of 0.06, as one tuple of positive integers per initial map from SHOT
      alone.
    - `compared_pairings`: the largest number of pairings of extremities whose features are compared.
    - `pairings` (Tables R27 and R40): the number of initial maps from pairings of extremities, at least 0.
    - `distance_weight`: the weight of the distances to extremities in features. SHOT has the weight 1.
    - `position_weight`: the weight of the positions along the principal axes in features.
    - `levels`, `descriptors`: the levels and the number of descriptors of the feature regression that refines
      the initial maps.
    - `crease_eigenvectors` (Table R45): the number of crease eigenvectors in the second attempt. With 0,
      there is no second attempt.
    - `repaired`: the number of refined maps whose faults are repaired, at least 0.
    - `fine_levels` (Table R40): the levels of the second refinement of promising maps. As many levels as in
      `levels` need no further program.
    - `coarse_margin`: a map is promising if its score exceeds the best score by at most this number.
    - `promising`: the largest number of promising maps, at least 1.
    - `eigenvectors`: the number of eigenvectors from which the distortion of refined maps is computed.
    - `patch_radius` (Table R28): the radius of the patches on which the deformation is measured.
    - `different_distance`: two maps differ at a sample if the distance between its two matches along the
      surface exceeds this value. Between connected components, the Euclidean distance counts.
    - `different_areas` (Table R27): shares of X's area, each above 0. The second alternative map must differ
      from all earlier ones on the first share, the third map on the second share, and so on. The last share
      also applies to all further maps.
    - `margin` (Table R28): the largest difference of scores between the best map and a returned map, after
      the second refinement. Several maps are returned, because a wrong map can have the best score.

    **Raises:** `InputError` if a number is out of its range, or if a tuple is empty.
    """

    samples: int = 1000
    radii: tuple[tuple[int, ...], ...] = ((1,), (1, 2, 4), (2, 4))
    compared_pairings: int = 64
    pairings: int = 12
    distance_weight: float = 2.25
    position_weight: float = 10.0
    levels: tuple[int, ...] = (8, 8, 11, 11, 15, 15, 20, 20, 26, 35)
    descriptors: int = 30
    crease_eigenvectors: int = 20
    repaired: int = 3
    fine_levels: tuple[int, ...] = (20, 20, 26, 26, 35, 35, 35, 35, 35, 35)
    coarse_margin: float = 1.5
    promising: int = 6
    eigenvectors: int = 50
    patch_radius: float = 0.2
    different_distance: float = 0.2
    different_areas: tuple[float, ...] = (0.03, 0.03, 0.2)
    margin: float = 1.5

    def __post_init__(self) -> None:
        least = {"samples": 1, "pairings": 0, "crease_eigenvectors": 0, "repaired": 0, "promising": 1}
        for name, number in least.items():
            check_whole_number(name, getattr(self, name), number)
        for name in ("levels", "fine_levels", "different_areas"):
            values = getattr(self, name)
            if not values or min(values) <= 0:
                raise InputError(f"{name} is {values}: give at least one number, and only positive numbers.")


@dataclass(frozen=True)
class JudgeSettings:
    """The settings by which maps are judged without ground truth.

    docs/how_it_works.md explains distortions, faults and scores. Areas are shares of X's area, from 0 to 1.

    **Attributes:**

    - `suspicious` (Table R3): a positive number, usually above 1. A map with a distortion of at least this
      value is suspicious and is repaired. Correct maps between poses of one body have smaller distortions.
    - `suspicious_area` (Table R28): a map is also suspicious if a fault covers at least this share.
    - `doubtful` (Table R3): after repair, a map without faults looks right if its distortion is below this
      value. A value below `suspicious` has no effect. Between non-isometric shapes, some correct maps have
      distortions up to this value.
    - `negligible_area`: faults up to this share are not repaired. Small faults, such as at fingertips, appear
      and disappear by chance.
    - `excessive_area`: faults from this share on are not repaired. If most of a body is mapped upside down,
      the rest of the map does not suffice to find the correct map.
    - `uncertainty_weight`, `deformation_weight` (Table R28): the weights of the uncertainty and of the
      deformation in the score, at least 0. The logarithm of the distortion has the weight 1.
    - `scores`: the settings of the distortion and of the faults, a `ScoreSettings`.

    **Raises:** `InputError` if a number is out of its range.
    """

    suspicious: float = 1.12
    suspicious_area: float = 0.02
    doubtful: float = 1.15
    negligible_area: float = 0.002
    excessive_area: float = 0.5
    uncertainty_weight: float = 30.0
    deformation_weight: float = 5.0
    scores: ScoreSettings = ScoreSettings()

    def __post_init__(self) -> None:
        for name in ("suspicious_area", "negligible_area", "excessive_area"):
            check_number(name, getattr(self, name), most=1.0)
        for name in ("uncertainty_weight", "deformation_weight"):
            check_number(name, getattr(self, name))
        for name in ("suspicious", "doubtful"):
            check_number(name, getattr(self, name), positive=True)


WITHOUT_REPAIR = JudgeSettings(suspicious=1.25, suspicious_area=1.0, doubtful=1.25)
"""The settings by which `match` judges the map of a preset that has no repair. (Entry R25)"""


@dataclass(frozen=True)
class RepairSettings:
    """The settings that determine how maps are repaired, and when a repaired map looks wrong.

    The settings are passed as `Preset(first, repeated, repair=RepairSettings(...))` and take effect in
    `jaxsmw.match`. docs/how_it_works.md explains the steps of the repair. Tables and entries R1, R2, … are in
    `docs/research_log.md`.

    **Attributes:**

    - `compared` (Table R40): a positive number, usually above 1. A map of two full shapes with a distortion
      of at least this value is compared with alternative maps, even if it is not suspicious.
    - `rounds` (Table R5): the largest number of rounds of repair, at least 0.
    - `finalists`: the largest number of alternative maps that are refined at all vertices, at least 0.
    - `non_isometric` (Table R29): a number of at least 0. Two full shapes whose map has an area-based shape
      difference of at least this value are refined by further passes.
    - `passes` (Table R29): the number of usual passes, at least 0.
    - `pass_tolerance` (Table R40): a number of at least 0. If all passes together increase the score without
      the deformation by more than this value, the map before the passes is kept.
    - `rival_margin` (entries R36 and R48): a number of at least 0. An outcome of repair whose score is worse
      by at most this value is a rival, from which the passes also run. To replace a map that still looks
      wrong after repair, the score of a rival must be better by more than this value.
    - `without_creases_from` (entry R47): a number of at least 0. From this area-based shape difference on,
      the passes use no crease eigenvectors.
    - `coarse_from` (Table R32): a number of at least 0. From this area-based shape difference on, coarse
      passes and a single usual pass run instead. A value below `non_isometric` has the same effect as
      `non_isometric`. For two full shapes with the initial map `"aligned"`, coarse passes always run
      (entry R24).
    - `coarse_levels` (Table R32): the levels of the last repeated stage in each coarse pass, as one tuple per
      pass. Tuples with the same length and the same maximum share a compiled program.
    - `aligned_preference` (entry R24): a number of at least 0. With `init="auto"`, asymmetric shapes are
      matched from the initial maps `"shot"` and `"aligned"`. The map from `"shot"` is chosen if its mean
      expected error is below this multiple of the other map's. Both expected errors are computed with
      `ExpectedErrorSettings(area_weight=0)`, and before further passes.
    - `cut_shortcuts` (Table R41): whether a mesh is cut before it is matched, where its surface is fused with
      itself; see `jaxsmw.geometry.cut_shortcuts`.
    - `trims` (Table R46): the number of times that the larger shape of a partial pair is trimmed to the
      region of the smaller shape and matched again, at least 0.
    - `trimmed_from` (Table R46): a positive number. A pair is trimmed if the larger area is at least this
      multiple of the smaller area. If the areas of two partial shapes are more similar, each shape often
      lacks a part of the other shape.
    - `trimmed_area` (Table R46): a positive number. The larger shape is trimmed to this multiple of the
      smaller area. The faces at the boundary of the kept region add to this area.
    - `trimmed_levels` (Table R46): the levels of the last stage on a trimmed pair, if its refiner has levels.
    - `alternatives`: the settings of the alternative maps, an `AlternativeSettings`.
    - `judge`: the settings by which maps are judged, a `JudgeSettings`.

    **Raises:** `InputError` if a number is out of its range.
    """

    compared: float = 1.05
    rounds: int = 4
    finalists: int = 4
    non_isometric: float = 0.14
    passes: int = 2
    pass_tolerance: float = 0.35
    rival_margin: float = 0.35
    without_creases_from: float = 0.18
    coarse_from: float = 0.3
    coarse_levels: tuple[tuple[int, ...], ...] = ((12, 20, 35, 60), (20, 35, 60, 60))
    aligned_preference: float = 0.9
    cut_shortcuts: bool = True
    trims: int = 2
    trimmed_from: float = 1.25
    trimmed_area: float = 1.05
    trimmed_levels: tuple[int, ...] = (10, 30, 80, 200)
    alternatives: AlternativeSettings = AlternativeSettings()
    judge: JudgeSettings = JudgeSettings()

    def __post_init__(self) -> None:
        for name in ("rounds", "finalists", "passes", "trims"):
            check_whole_number(name, getattr(self, name), 0)
        for name in (
            "non_isometric",
            "pass_tolerance",
            "rival_margin",
            "without_creases_from",
            "coarse_from",
            "aligned_preference",
        ):
            check_number(name, getattr(self, name))
        for name in ("compared", "trimmed_from", "trimmed_area"):
            check_number(name, getattr(self, name), positive=True)
        if not isinstance(self.cut_shortcuts, bool):
            raise InputError(f"cut_shortcuts is {self.cut_shortcuts!r}: give True or False.")
