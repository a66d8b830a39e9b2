"""The function `match`, which computes the correspondence of two meshes."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace

from numpy.typing import ArrayLike

from jaxsmw.choices import (
    DEFAULT_BACKEND,
    DEFAULT_INITIAL_MAP,
    DEFAULT_MATCH_INIT,
    DEFAULT_MIRROR,
    DEFAULT_PRESET,
    Backend,
    Eigensolver,
    Laplacian,
    MatchInit,
    Mirror,
    Scale,
)
from jaxsmw.errors import check_choice
from jaxsmw.geometry.mesh import Mesh, MeshLike
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.advice import advice
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import Judge, Scored, estimate_error
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair, prepare
from jaxsmw.matching.search.chirality import Decision, Hands
from jaxsmw.matching.search.repair import refine_further, repair_map
from jaxsmw.matching.search.trimming import match_trimmed
from jaxsmw.matching.settings import ExpectedErrorSettings
from jaxsmw.matching.stages import Preset, PresetName, Stage, choose_preset
from jaxsmw.matching.starts import check_initial_map, make_starts
from jaxsmw.runtime.progress import Step, no_step, timed
from jaxsmw.runtime.threads import one_blas_thread

logger = logging.getLogger("jaxsmw")


def match(
    mesh_x: Mesh | MeshLike,
    mesh_y: Mesh | MeshLike,
    *,
    preset: PresetName | Preset | Stage | Sequence[Stage] = DEFAULT_PRESET,
    init: MatchInit | ArrayLike | SurfacePoints = DEFAULT_MATCH_INIT,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    partial: bool = False,
    scale: float | Scale = 1.0,
    mirror: Mirror = DEFAULT_MIRROR,
    history: bool = False,
    backend: Backend = DEFAULT_BACKEND,
) -> Correspondence:
    """Find for every vertex of X the vertex of Y at the same point of the body.

    If the preset has repair, each mesh is first cut where its surface is fused with itself, for example a
    hand with a hip; see `jaxsmw.geometry.cut_shortcuts`. The result refers to the given meshes.

    The function issues a `UserWarning` if the final map looks wrong, if X and its mirror image match Y about
    equally well, or if a mesh is too coarse for the descriptors of the preset. It also issues one if small
    components without a counterpart have more than 5 % of X's area.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y (n vertices), in any unit of length. Each
      argument is a `Mesh`, a mesh of trimesh, pyFM, geomfum or PyVista, or a tuple of vertices and faces; see
      `make_mesh`.
    - `preset`: the method of refinement, which is one of the following.

        - `"accurate"` (the default): four stages, with repair; see `jaxsmw.PRESETS`.
        - `"paper"`: the method of the MWP paper.
        - `"fast"`: the method of the MWP paper on 500 samples of each shape.
        - a `Preset`. Its sizes are adapted to small meshes; see `Preset.fitted`.
        - a `Stage`, or a list or tuple of stages, which are used unchanged. An example is
          `Stage(WaveletPreservation(bank=Meyer(8)), number_of_eigenvectors=60)`.

    - `init`: the initial map, which is one of the following.

        - `"auto"` (the default): `"shot"`. If shapes differ from their own mirror images, as teeth do,
          `"aligned"` is refined as well and preferred; see `RepairSettings.aligned_preference`. This happens
          only if `partial` is False and the preset has repair.
        - `"shot"`, `"wks"`, `"hks"`, `"wavelet"`, `"functional"`, `"aligned"`, a given map (m,) or landmarks
          (l, 2): see `initial_map`. With `"shot"`, repair also tries alternative maps. `"functional"` is
          smoother than `"shot"` and has smaller errors, but after refinement, the map often has larger errors
          (docs/results.md).

    - `laplacian`, `eigensolver`: see `compute_spectrum`. `"auto"` chooses `"approximate"` for both meshes if
      one mesh has at least 50 000 referenced vertices, else `"exact"`.
    - `partial`: True if one mesh or both meshes are partial shapes of the body; see `paired_spectra`. The
      default is False, for two full shapes. `Correspondence.overlap` predicts which vertices have a
      counterpart on the other mesh.
    - `scale`: see `Pair.make`. Full shapes are always scaled to the same area.
    - `mirror`: whether X and Y are of opposite hands, such as a left and a right tooth. If they are, the
      mirror image of X is matched instead of X. Whether X is mirrored or not, entry i of the map is the match
      of vertex i of X.

        - `"auto"` (the default): the mirror image is matched if a coarse map of it preserves distances better
          than a coarse map of X itself; see `jaxsmw.matching.search.chirality.Hands`. X itself is matched if
          X and Y are nearly their own mirror images, as people and animals are, or if `partial` is True.
        - `"no"`: match X itself.
        - `"yes"`: match the mirror image of X.

    - `history`: whether to record a `History` of the last stage. The result contains the record in its
      attribute `refinement.history`.
    - `backend`: what runs the stages. `"numpy"` runs them at once, and `"jax"` compiles them for the sizes of
      the meshes first. The maps differ by rounding. Refiners that are written for JAX always run in JAX; see
      `Refiner.uses_namespaces`. `"auto"` (the default) is `"jax"` if JAX has an accelerator, else `"numpy"`.

    **Returns:** A `Correspondence`, whose attribute `pointwise_map` (m,) is an int64 array of 0-based
    vertices of Y. Small components, such as eyes, move with their surroundings and are matched to their
    counterparts on Y; see `jaxsmw.transfer.match_small_components`. Any other unreferenced vertex of X (in no
    face) receives the match of the nearest vertex. Such vertices of Y are never matched.

    **Raises:** `InputError` if a mesh cannot be used or has too few vertices, if the preset or the initial
    map is unknown or does not fit the meshes, or if another argument is invalid. `ArithmeticError` if the
    computation of the initial map or the refinement fails numerically.
    """
    check_choice(mirror, Mirror, "a mirror setting")
    check_choice(backend, Backend, "a backend")
    pair = Pair.make(mesh_x, mesh_y, partial=partial, scale=scale)
    adapts = isinstance(preset, str | Preset)
    method = choose_preset(preset)
    surfaces = pair.without_shortcuts() if method.cuts_shortcuts else pair
    fewest = surfaces.fewest_vertices()
    if adapts:
        method = method.fitted(fewest)
    if history:
        method = method.with_history()
    automatic = isinstance(init, str) and init == "auto"
    # The check runs before the slow computation of the eigenbases.
    first_init = check_initial_map(pair, DEFAULT_INITIAL_MAP if automatic else init)

    seconds: dict[str, float] = {}
    step = functools.partial(timed, seconds=seconds)
    # Searches and preparation use all cores, for which threads of the linear algebra would only wait.
    with one_blas_thread():
        prepared = prepare(
            surfaces,
            method.sizes,
            given=pair,
            laplacian=laplacian,
            eigensolver=eigensolver,
            backend=backend,
            step=step,
        )
        aligns = automatic and method.repair is not None  # "aligned" is used only for asymmetric shapes
        decision = Decision(mirror == "yes")
        if (mirror == "auto" or aligns) and not partial:
            with step("mirror test"):
                decision = Hands(surfaces, *prepared.spectra.both).decide(mirror)
        # SHOT changes in a mirror image, so initial maps and descriptors are computed after this decision.
        if decision.mirrored:
            if mirror == "auto":
                logger.info("%s: the mirror image of the source is matched", pair.name)
            prepared = prepared.mirror()
        with step("initial map"):
            starts = make_starts(prepared, first_init, rigid=aligns and decision.asymmetric)
        if method.number_of_descriptors:
            with step("descriptors"):
                prepared = prepared.describe(method.number_of_descriptors, required=not adapts)
        correspondence = match_prepared(prepared, starts, method, step=step)
    # The advice distinguishes a map that looks wrong from a doubtful hand. The result does not.
    for text in advice(correspondence, decision):
        warnings.warn(text, stacklevel=2)
    return replace(
        correspondence,
        suspicious=correspondence.suspicious or decision.doubtful,
        mirror_evidence=decision.evidence,
        seconds=seconds,
    )


def match_prepared(
    prepared: PreparedPair,
    starts: Sequence[Start],
    preset: Preset,
    *,
    outcomes: Sequence[Outcome] = (),
    step: Step = no_step,
) -> Correspondence:
    """Run all stages and the repair from each start, and return the better map.

    **Arguments:**

    - `prepared`: the prepared pair. If it has no descriptors, the stages use none.
    - `starts`: the initial maps: one map, or `"shot"` and `"aligned"`.
    - `preset`: the stages and the repair.
    - `outcomes`: the outcome of `preset.before_final` for each start, if these stages have already run.
    - `step`: reports and measures the steps. By default, nothing is reported.

    **Returns:** The `Correspondence`.

    **Raises:** `ArithmeticError` if refinement fails numerically from every start, or in the final stages.
    """
    preset = prepared.usable(preset)
    known: Sequence[Outcome | None] = outcomes or [None] * len(starts)
    candidates = []
    with step("refinement"):
        for start, outcome in zip(starts, known, strict=True):
            scored = refine_and_judge(prepared, start, preset, outcome)
            candidates.append((start, repair_map(prepared, start, preset, scored)))
    successful = [(start, scored) for start, scored in candidates if scored.successful]
    start, scored = (successful or candidates)[0]
    if len(successful) > 1:
        with step("choice of start"):
            start, scored = _choose(prepared, preset, successful)
    last = step("final stages") if preset.final or preset.repair else nullcontext()
    with last:
        if trimmed := match_trimmed(prepared, preset, scored):
            prepared, scored = trimmed
        else:
            scored = refine_further(prepared, start, preset, scored)
            scored = _run_final(prepared, preset, scored)
    return Correspondence.of(prepared, start, preset, scored)


def refine_and_judge(
    prepared: PreparedPair, start: Start, preset: Preset, outcome: Outcome | None = None
) -> Scored:
    """Run all stages before the final ones from a start, unless their outcome is given, and judge the map."""
    if outcome is None:
        outcome = run(preset.before_final, prepared.spectra, start)
    return Judge.of(prepared, preset.before_final, preset.criteria).judged(outcome)


def _choose(
    prepared: PreparedPair, preset: Preset, candidates: Sequence[tuple[Start, Scored]]
) -> tuple[Start, Scored]:
    """Choose the start whose map has the smallest mean expected error. Rigid starts are preferred.

    The expected errors have `area_weight` 0. A positive weight would multiply them by a factor that depends
    on the shapes, not on the quality of the map. (Entry R24 of docs/research_log.md)
    """
    repair, mesh_x = preset.repair, prepared.given.mesh_x
    if repair is None:
        return candidates[0]
    settings = ExpectedErrorSettings(area_weight=0.0), repair.judge.scores

    def error(candidate: tuple[Start, Scored]) -> float:
        start, scored = candidate
        errors = estimate_error(prepared.matched, scored.pointwise_map, scored.outcome.last, *settings)
        return (repair.aligned_preference if start.is_rigid else 1.0) * float(mesh_x.average(errors))

    return min(reversed(candidates), key=error)  # of equal errors, that of the last start counts


def _run_final(prepared: PreparedPair, preset: Preset, scored: Scored) -> Scored:
    """Run the final stages from a map. The result is as suspicious as the given map."""
    if not (preset.final and scored.successful):
        return scored
    after = run(preset.final, prepared.spectra, Start(scored.pointwise_map))
    judge = Judge.of(prepared, preset.final, preset.criteria)
    return judge.measured(scored.outcome.followed_by(after), suspicious=scored.suspicious)
