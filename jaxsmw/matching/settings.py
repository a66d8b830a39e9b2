"""The settings of the search, of measures of maps, and of the expected error."""

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
class SearchSettings:
    """The settings that determine how the right map is searched for.

    The settings are passed as `Preset(first, repeated, search=SearchSettings(...))` and take effect in
    `jaxsmw.match`. docs/how_it_works.md explains the search. Tables and entries R1, R2, ... are in
    `docs/research_log.md`.

    **Attributes:**

    - `certain` and `certain_distortion` (entry R49): a probability and a positive number. If the map of the
      first start is right with at least this probability, and has at most this distortion, no other map is
      tried. If `certain` is 0, the first map is always taken.
    - `finalists`: the largest number of maps that are refined at all vertices after the race, at least 1.
    - `likely`: a share. A map of the race is refined at all vertices only if its probability is at least this
      share of the best one.
    - `non_isometric` (Table R29): a number of at least 0. Two full shapes whose map has an area-based shape
      difference of at least this value are refined by further passes.
    - `passes` (Table R29): the number of usual passes, at least 0.
    - `pass_tolerance`: a number of at least 0. If all passes together lower the log-odds that the map is
      right by more than this value, the map before the passes is kept.
    - `without_creases_from` (entry R47): a number of at least 0. From this area-based shape difference on,
      maps of the race and further passes are refined without crease eigenvectors.
    - `coarse_from` (Table R32): a number of at least 0. From this area-based shape difference on, coarse
      passes and a single usual pass run instead. A value below `non_isometric` has the same effect as
      `non_isometric`.
    - `coarse_levels` (Table R32): the levels of the last repeated stage in each coarse pass, as one tuple per
      pass. Tuples with the same length and the same maximum share a compiled program.
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

    **Raises:** `InputError` if a number is out of its range.
    """

    certain: float = 0.75
    certain_distortion: float = 1.06
    finalists: int = 3
    likely: float = 0.05
    non_isometric: float = 0.14
    passes: int = 2
    pass_tolerance: float = 1.0
    without_creases_from: float = 0.18
    coarse_from: float = 0.3
    coarse_levels: tuple[tuple[int, ...], ...] = ((12, 20, 35, 60), (20, 35, 60, 60))
    cut_shortcuts: bool = True
    trims: int = 2
    trimmed_from: float = 1.25
    trimmed_area: float = 1.05
    trimmed_levels: tuple[int, ...] = (10, 30, 80, 200)

    def __post_init__(self) -> None:
        check_whole_number("finalists", self.finalists, 1)
        for name in ("passes", "trims"):
            check_whole_number(name, getattr(self, name), 0)
        for name in ("certain", "likely"):
            check_number(name, getattr(self, name), most=1.0)
        for name in ("non_isometric", "pass_tolerance", "without_creases_from", "coarse_from"):
            check_number(name, getattr(self, name))
        for name in ("certain_distortion", "trimmed_from", "trimmed_area"):
            check_number(name, getattr(self, name), positive=True)
        if not isinstance(self.cut_shortcuts, bool):
            raise InputError(f"cut_shortcuts is {self.cut_shortcuts!r}: give True or False.")
