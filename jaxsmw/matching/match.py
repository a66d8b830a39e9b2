"""The function `match`, which computes the correspondence of two meshes."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxsmw.choices import (
    DEFAULT_INITIAL_MAP,
    DEFAULT_MATCH_INIT,
    DEFAULT_MIRROR,
    DEFAULT_PRESET,
    Eigensolver,
    Laplacian,
    MatchInit,
    Mirror,
    Scale,
)
from jaxsmw.core.results import RESULTS, sentence
from jaxsmw.errors import check_choice
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh, MeshLike
from jaxsmw.geometry.scans import SMALL_CLOSED
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.judge import Outcome
from jaxsmw.matching.pair import Pair, paired_spectra
from jaxsmw.matching.preparation import PreparedPair, prepare, program_size
from jaxsmw.matching.presets import Preset, PresetName, choose_preset
from jaxsmw.matching.scores import discontinuous_parts, orientation_reversal
from jaxsmw.matching.search.chirality import Decision, Hands
from jaxsmw.matching.search.rounds import refine_in_stages
from jaxsmw.matching.search.trimming import complete, trimmed_stage
from jaxsmw.matching.settings import WITHOUT_REPAIR, ExpectedErrorSettings, RepairSettings
from jaxsmw.matching.stages import Stage
from jaxsmw.matching.starts import check_initial_map
from jaxsmw.runtime.memory import return_free_memory
from jaxsmw.runtime.progress import timed
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
    - `preset`: the method of refinement, which is one of the following. The number of eigenvectors of a
      preset is limited to half the number of vertices of the smaller mesh. If the number of samples of a
      preset is at least the number of vertices of the smaller mesh, the preset uses all vertices instead of
      samples. If you give stages instead of a preset, `match` uses the stages unchanged.

        - `"accurate"` (the default): four stages, with repair; see `jaxsmw.PRESETS`.
        - `"paper"`: the method of the MWP paper.
        - `"fast"`: the method of the MWP paper on 500 samples of each shape.
        - a `Preset`.
        - a `Stage`, or a list or tuple of stages. An example is
          `Stage(WaveletPreservation(bank=Meyer(8)), number_of_eigenvectors=60)`.

    - `init`: the initial map, which is one of the following.

        - `"auto"` (the default): `"shot"`. For shapes that differ from their own mirror images, such as
          teeth, the initial map `"aligned"` is refined as well. This happens only if `partial` is False and
          the preset has repair. `match` then prefers the map from `"aligned"`. The map from `"shot"` is
          chosen only if its mean expected error is more than 10 % smaller. Both expected errors are computed
          with `ExpectedErrorSettings(area_weight=0)`.
        - `"shot"`, `"wks"`, `"hks"` or `"wavelet"`: the initial map sends each vertex of X to the vertex of Y
          with the nearest descriptor of this kind. Only SHOT distinguishes left from right.
          With `"shot"`, repair also tries alternative maps.
        - `"functional"`: the initial map is computed from the functional map that preserves SHOT and commutes
          with the Laplacian (section 3.2 of the MWP paper). This initial map is smoother than the initial map
          `"shot"` and has smaller errors. After refinement, however, the map often has larger errors than
          with `"shot"` (docs/results.md).
        - `"aligned"`: X is scaled to the area of Y and aligned rigidly. The initial map sends each vertex of
          X to the vertex of Y with the most similar SHOT descriptor and position. Use this map for shapes
          that differ little in pose, such as teeth and bones.
        - an integer array (m,) of 0-based vertices of Y, or a `SurfacePoints` with m points on Y: a given
          pointwise map.
        - an integer array (l, 2) of landmarks, where each row contains a vertex of X and its match on Y, both
          0-based. The initial map then sends each vertex of X to the vertex of Y with the most similar
          features. The features are SHOT and the geodesic distances to the landmarks. Give a few landmarks on
          the left side and on the right side of the body.

    - `laplacian`: the discretization of the Laplacian: `"cotangent"`, `"robust"` or `"auto"` (the default).
      `"robust"` also handles non-manifold and badly shaped meshes. `"auto"` chooses `"robust"` for a mesh
      with degenerate triangles or edges with more than two faces, else `"cotangent"`.
    - `eigensolver`: `"exact"`, `"approximate"` or `"auto"` (the default). `"approximate"` takes less time on
      large meshes. `"auto"` chooses `"approximate"` if one mesh has at least 50 000 referenced vertices, else
      `"exact"`.
    - `partial`: True if one mesh or both meshes are partial shapes of the body; see `paired_spectra`. The
      default is False, for two full shapes. `Correspondence.overlap` predicts which vertices have a
      counterpart on the other mesh.
    - `scale`: for a partial pair, the factor by which lengths on X are multiplied to become lengths in the
      unit of Y. The default is 1, for meshes in the same unit. With `"unknown"`, the factor is estimated; see
      `jaxsmw.geometry.estimate_scale`. Full shapes are always scaled to the same area.
    - `mirror`: whether X and Y are of opposite hands, such as a left and a right tooth. If they are, the
      mirror image of X is matched instead of X. Whether X is mirrored or not, entry i of the map is the match
      of vertex i of X.

        - `"auto"` (the default): decide by a comparison of coarse maps
          (`jaxsmw.matching.search.chirality.Hands`). If
          a coarse map of the mirror image of X preserves distances better than a coarse map of X itself, the
          mirror image is matched. X itself is matched if X and Y are nearly their own mirror images, as
          people and animals are. X itself is also matched if `partial` is True.
        - `"no"`: match X itself.
        - `"yes"`: match the mirror image of X.

    - `history`: whether to record a `History` of the last stage. The result contains the record in its
      attribute `refinement.history`.

    **Returns:** A `Correspondence`, whose attribute `pointwise_map` (m,) is an int64 array of 0-based
    vertices of Y. A `Correspondence` also has the attributes `functional_map`, `spectrum_x`, `spectrum_y`,
    `distortion` and `suspicious`. Small components, such as eyes, move with their surroundings and are
    matched to their counterparts on Y; see `jaxsmw.transfer.match_small_components`. Any other unreferenced
    vertex of X (in no face) receives the match of the nearest vertex. Such vertices of Y are never matched.

    **Raises:** `InputError` if a mesh cannot be used or has too few vertices, if the preset or the initial
    map is unknown or does not fit the meshes, or if another argument is invalid. `ArithmeticError` if the
    computation of the initial map or the refinement fails numerically.
    """
    check_choice(mirror, Mirror, "a mirror setting")
    pair = Pair.make(mesh_x, mesh_y, partial=partial, scale=scale)
    adapts = isinstance(preset, str | Preset)
    chosen = choose_preset(preset)
    surfaces = pair.without_shortcuts() if chosen.cuts_shortcuts else pair
    fewest = surfaces.fewest_vertices()
    if adapts:
        chosen = chosen.fitted(fewest)

    automatic = isinstance(init, str) and init == "auto"
    first_init = DEFAULT_INITIAL_MAP if automatic else init
    check_initial_map(pair, first_init)  # the check runs before the slow computation of the eigenbases
    if isinstance(first_init, SurfacePoints):
        first_init = first_init.nearest_corners(pair.mesh_y)  # cut meshes have other face numbers
    compiling = _compile_ahead(pair, chosen, history)
    seconds: dict[str, float] = {}
    with timed("eigenbases", seconds):
        spectra = paired_spectra(
            surfaces, chosen.number_of_eigenvectors, laplacian=laplacian, eigensolver=eigensolver
        )
    decision = Decision(mirror == "yes")
    aligns = automatic and chosen.repair is not None  # "aligned" is used only for asymmetric shapes
    if (mirror == "auto" or aligns) and not partial:
        with timed("mirror test", seconds):
            decision = Hands(surfaces, *spectra).decide(mirror)
        if decision.mirrored and mirror == "auto":
            logger.info("%s: the mirror image of the source is matched", pair.name)
    prepared = prepare(
        surfaces.mirrored() if decision.mirrored else surfaces,
        number_of_eigenvectors=chosen.number_of_eigenvectors,
        number_of_descriptors=chosen.number_of_descriptors,
        number_of_crease_eigenvectors=chosen.number_of_crease_eigenvectors,
        number_of_samples=chosen.number_of_samples,
        init=first_init,
        laplacian=laplacian,
        eigensolver=eigensolver,
        descriptors_required=not adapts,
        spectra=(spectra[0].reflect(), spectra[1]) if decision.mirrored else spectra,
    )
    seconds |= prepared.seconds
    starts = [prepared]
    if aligns and decision.asymmetric:
        starts.append(prepared.started_from("aligned"))
        _add_seconds(starts[-1], seconds)
    found = match_prepared(
        pair, starts, chosen, decision, history=history, seconds=seconds, compiling=compiling
    )
    found.warn_if_suspicious()
    return found.correspondence


class Match(NamedTuple):
    """A correspondence, and the data from which its warnings are made.

    **Attributes:**

    - `correspondence`: the `Correspondence`.
    - `prepared`: the prepared pair from which the map was refined. If the mirror image of X was matched, the
      prepared pair contains the mirror image.
    - `outcome`: the `Outcome` of refinement and repair.
    - `decision`: the `Decision` between X and its mirror image.
    """

    correspondence: Correspondence
    prepared: PreparedPair
    outcome: Outcome
    decision: Decision

    def warn_if_suspicious(self) -> None:
        """Issue a `UserWarning` if the map looks wrong or leaves much out, or the hand of X is doubtful."""
        if self.outcome.suspicious:
            repair = self.correspondence.preset.repair
            warning = _warning(self.prepared, repair, self.outcome, mirrored=self.decision.mirrored)
            warnings.warn(warning, stacklevel=3)
        if (share := self.correspondence.left_out) > SMALL_CLOSED:
            warnings.warn(
                f"{self.correspondence.pair.name}: {share:.0%} of the source's area lies in small components "
                "that have no counterpart on the target, so they only move with their surroundings. If they "
                "are parts of one surface, join them, for example by welding (weld=True, --weld).",
                stacklevel=3,
            )
        if self.decision.doubtful:
            warnings.warn(_doubt(self.prepared.pair, self.decision), stacklevel=3)


def match_prepared(
    pair: Pair,
    starts: Sequence[PreparedPair],
    preset: Preset,
    decision: Decision = Decision(False),  # noqa: B008 (immutable)
    *,
    history: bool = False,
    seconds: dict[str, float] | None = None,
    compiling: Sequence[Future[object]] = (),
    alternatives: bool = True,
    refined: Sequence[Outcome | None] = (),
) -> Match:
    """Refine the initial maps of a prepared pair, and return the better match.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `starts`: a prepared pair for each initial map. If there are two initial maps, the first is `"shot"` and
      the second is `"aligned"`. If `decision.mirrored` is True, the prepared pairs contain the mirror image
      of X instead of X.
    - `preset`: the stages and the repair.
    - `decision`: the decision between X and its mirror image.
    - `history`: whether to record a `History` of the last stage.
    - `seconds`: a dictionary to which the times of the steps are added. With None, the steps are not timed,
      and no progress is reported.
    - `compiling`: background compilations that refinement waits for.
    - `alternatives`: whether repair tries alternative maps.
    - `refined`: one entry for each element of `starts`; see `jaxsmw.matching.batches`. The entry is the
      outcome
      of all stages, or None if the stages have not run yet. An empty sequence (the default) means that no
      stages have run yet.

    **Returns:** The `Match`.

    **Raises:** `ArithmeticError` if refinement fails numerically from every initial map.
    """
    if starts[0].spectrum_x.descriptors is None:
        preset = preset.without_descriptors()
    return_free_memory()
    with _step("refinement", seconds), one_blas_thread():
        if not starts[0].pair.partial:
            wait(compiling)
        outcomes = [
            refine_in_stages(
                start,
                preset.judged_stages,
                preset.repair,
                alternatives=None if alternatives else (),
                history=history,
                refined=known,
            )
            for start, known in zip(starts, refined or [None] * len(starts), strict=True)
        ]
        jax.block_until_ready([outcome.refinements[-1] for outcome in outcomes])
    times = {} if seconds is None else seconds

    def found(start: PreparedPair, outcome: Outcome, used: Preset) -> Match:
        return Match(_correspondence(pair, start, used, outcome, times, decision), start, outcome, decision)

    candidates = [one for one in zip(starts, outcomes, strict=True) if one[1].successful]
    start, outcome = candidates[0] if candidates else (starts[0], outcomes[0])
    if len(candidates) > 1:
        assert preset.repair is not None
        with _step("expected error", seconds):
            judged = replace(
                preset, stages=preset.judged_stages, repair=replace(preset.repair, final_stages=0)
            )
            from_shot, from_aligned = (_inconsistency(found(*one, judged)) for one in candidates)
        start, outcome = candidates[int(from_shot >= preset.repair.aligned_preference * from_aligned)]
    begin = time.perf_counter()
    wait(compiling)  # for a partial pair, only the program that runs after trimming is compiled in advance
    with one_blas_thread():
        start, outcome = complete(
            start, preset.judged_stages, preset.final_stages, preset.repair, outcome, history=history
        )
        jax.block_until_ready(outcome.refinements[-1])
    if seconds is not None:
        seconds["refinement"] += time.perf_counter() - begin
    return found(start, outcome, preset)


def _inconsistency(found: Match) -> float:
    """Return the mean expected error of a map, with `area_weight` 0.

    With a positive `area_weight`, the expected error would contain a factor that depends on the shapes, not
    on the quality of the map. (Entry R24 of docs/research_log.md)
    """
    settings = ExpectedErrorSettings(area_weight=0.0)
    return float(found.correspondence.mesh_x.average(found.correspondence.estimate_error(settings)))


def _step(name: str, seconds: dict[str, float] | None) -> AbstractContextManager[None]:
    return nullcontext() if seconds is None else timed(name, seconds)


def _add_seconds(prepared: PreparedPair, seconds: dict[str, float]) -> None:
    """Add the times of the steps of a preparation to `seconds`."""
    seconds |= {step: seconds[step] + time for step, time in prepared.seconds.items()}


def _compile_ahead(pair: Pair, preset: Preset, history: bool) -> list[Future[object]]:
    """Compile in the background the programs of all stages, or of the trimmed stage of a partial pair.

    The other programs of a partial pair are not compiled, because its numbers of eigenvectors are not known
    yet. If a mesh has too few vertices for the preset, nothing is compiled, because `paired_spectra` then
    raises an error.
    """
    if preset.number_of_eigenvectors >= min(len(mesh.vertices) for mesh in pair.meshes):
        return []
    # The last stage is compiled first, because its compilation takes the longest time.
    stages = [*reversed(preset.stages)]
    if pair.partial:
        trimmed = trimmed_stage(pair, preset.stages, preset.repair)
        stages = [] if trimmed is None else [trimmed]
    sizes = program_size(pair.mesh_x), program_size(pair.mesh_y)
    return [stage.compile_ahead(*sizes, partial=pair.partial, history=history) for stage in stages]


def _correspondence(
    pair: Pair,
    prepared: PreparedPair,
    preset: Preset,
    outcome: Outcome,
    seconds: dict[str, float],
    decision: Decision,
) -> Correspondence:
    """Make the result of `match`.

    **Raises:** `ArithmeticError` if refinement failed.
    """
    m = len(pair.mesh_x.vertices)
    last = outcome.refinements[-1].unpadded(m)
    if last.result != RESULTS.successful:
        cure = (
            ' If the units of length differ, set scale="unknown" (--scale unknown).' if pair.partial else ""
        )
        raise ArithmeticError(f"{pair.name}: {sentence(last.result)}{cure}")
    spectrum_x, spectrum_y = prepared.view(preset.stages[-1], padded=False)
    pointwise_map, left_out = pair.with_small_components(np.asarray(last.pointwise_map).astype(np.int64))
    return Correspondence(
        pair=pair,
        pointwise_map=pointwise_map,
        initial_map=np.asarray(outcome.initial_map)[:m].astype(np.int64),
        init=prepared.init if isinstance(prepared.init, str) else None,
        preset=preset,
        spectrum_x=spectrum_x.reflect() if decision.mirrored else spectrum_x,
        spectrum_y=spectrum_y,
        refinement=last,
        iterations=sum(int(refinement.iterations) for refinement in outcome.refinements),
        distortion=outcome.distortion,
        suspicious=outcome.suspicious or decision.doubtful,
        mirrored=decision.mirrored,
        mirror_evidence=decision.evidence,
        left_out=left_out,
        seconds=seconds,
    )


def _doubt(pair: Pair, decision: Decision) -> str:
    """Return the text of the warning that X and its mirror image match Y about equally well."""
    took = "the mirror image of the source" if decision.mirrored else "the source itself"
    return (
        f"{pair.name}: the source and its mirror image match the target about equally well (evidence "
        f"{decision.evidence:.2f} for the mirror image). {took.capitalize()} was matched. If both meshes are "
        'of the same hand, set mirror="no" (--mirror no); if not, set mirror="yes" (--mirror yes).'
    )


# If the map reverses the orientation of more than this share of the area, one shape may be a mirror image.
_MOSTLY = 0.5


def _warning(
    prepared: PreparedPair, repair: RepairSettings | None, outcome: Outcome, *, mirrored: bool
) -> str:
    """Return the text of the warning that a map looks wrong.

    `mirrored` is True if the mirror image of X was matched.
    """
    pair, spectrum_x, init = prepared.pair, prepared.spectrum_x, prepared.init
    settings = repair or WITHOUT_REPAIR
    found = outcome.unpadded_map(pair)
    reversed_ = pair.mesh_x.average(orientation_reversal(pair, found, spectrum_x, settings.scores))
    cut_off = pair.mesh_x.average(discontinuous_parts(pair, found, settings.scores))
    more = not isinstance(init, str | SurfacePoints) and np.ndim(init) == 2
    cure = f"use {'more' if more else 'a few'} landmarks as the initial map"
    if repair is None:
        cure = f'use preset="accurate" (--preset accurate), which repairs such maps, or {cure}'
    if reversed_ > _MOSTLY:
        cure += (
            '; if both meshes are of the same hand, set mirror="no" (--mirror no)'
            if mirrored
            else '; if one mesh is a mirror image of the other, set mirror="yes" (--mirror yes)'
        )
    if pair.partial:
        cure += (
            ", and check that both meshes have the same unit of length, or estimate the scale with "
            'scale="unknown" (--scale unknown)'
        )
    else:
        cure += "; if one mesh is a partial shape, set partial=True (--partial)"
    return (
        f"{pair.name}: limbs may be swapped or mirrored, or the body may be upside down. The map has "
        f"distortion {outcome.distortion:.3f}, reverses the orientation of {reversed_:.0%} of the source's "
        f"area, and separates {cut_off:.0%} of the source's area by discontinuities. Correct maps between "
        f"poses of one body have distortions up to {settings.suspicious}. Correct maps can have larger "
        "distortions between non-isometric shapes, with topological noise, or if one shape is mirrored. "
        "Look at the map with the option --report or, in Python, with jaxsmw.report.summary.write_report. If "
        f"the map is wrong, {cure}."
    )
