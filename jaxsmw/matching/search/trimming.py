"""Trims the larger shape of a partial pair to the region that the smaller shape covers, and matches again."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.core.refiner import Problem, reverse_map
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, connected_components, extend_to_unreferenced
from jaxsmw.geometry.scans import in_small_components
from jaxsmw.matching.descriptors import describe
from jaxsmw.matching.judge import Outcome
from jaxsmw.matching.pair import Pair, paired_spectra
from jaxsmw.matching.preparation import PreparedPair, paired_samples
from jaxsmw.matching.scores import detours
from jaxsmw.matching.search.rounds import finish, refine_in_stages, with_coarse_levels
from jaxsmw.matching.settings import RepairSettings
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.compilation import compiled

logger = logging.getLogger("jaxsmw")


def trimmed(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    reverse: Int64[np.ndarray, " n"],
    area: float,
) -> Pair:
    """Trim the larger shape of a partial pair to the region that the smaller shape covers.

    A vertex of the larger shape probably has a counterpart if its detour is small; see
    `jaxsmw.matching.scores.detours`. The vertices with the smallest detours are kept, until their area is
    `area` times the area of the smaller shape. All faces around them are kept as well, except those of small
    components.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a partial pair.
    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `reverse`: a map Y -> X (n,), 0-based vertices of X.
    - `area`: the area of the kept vertices, as a multiple of the smaller area.

    **Returns:** A partial pair, in which all vertices keep their numbers.
    """
    area_x, area_y = pair.areas
    if area_y > area_x:
        far = detours(pair.reversed(), reverse, pointwise_map)
        return replace(pair, mesh_y=_kept(pair.mesh_y, far, area * area_x / area_y))
    far = detours(pair, pointwise_map, reverse)
    return replace(pair, mesh_x=_kept(pair.mesh_x, far, area * area_y / area_x))


def _kept(mesh: Mesh, far: Float[np.ndarray, " n"], share: float) -> Mesh:
    """Return the part of a mesh around the vertices with the smallest detours, on a share of the area."""
    order = np.argsort(far, kind="stable")
    number = int(np.searchsorted(np.cumsum(mesh.vertex_areas[order]), share * mesh.area)) + 1
    near = np.zeros(len(far), bool)
    near[order[:number]] = True
    kept = mesh.without_faces(~near[mesh.faces].any(axis=1))
    component = connected_components(kept.edges, len(far))[1][kept.faces[:, 0]]
    small, _ = in_small_components(component, kept.face_areas, np.ones(len(kept.faces), bool))
    return kept.without_faces(small)


def trimmed_stage(pair: Pair, stages: Sequence[Stage], repair: RepairSettings | None) -> Stage | None:
    """Return the stage that runs after trimming: the last stage, with `repair.trimmed_levels`.

    **Returns:** The stage, or None if the pair is not trimmed. A pair is trimmed only if it is a partial pair
    and the larger area is at least `repair.trimmed_from` times the smaller area.
    """
    if repair is None or repair.trims == 0 or not pair.partial:
        return None
    if max(pair.areas) < repair.trimmed_from * min(pair.areas):
        return None
    return with_coarse_levels(stages[-1], repair.trimmed_levels)


def complete(
    prepared: PreparedPair,
    stages: Sequence[Stage],
    final_stages: Sequence[Stage],
    repair: RepairSettings | None,
    outcome: Outcome,
    *,
    history: bool = False,
) -> tuple[PreparedPair, Outcome]:
    """Finish the refinement of a pair, and match a partial pair again after trimming its larger shape.

    The eigenfunctions of a part differ from those of the full shape. After trimming, both shapes cover nearly
    the same region of the body, so their eigenfunctions are similar. The last of all stages then runs on the
    trimmed pair, with `repair.trimmed_levels`. The final stages run only if nothing was trimmed. (Table R46)

    **Arguments:** see `jaxsmw.matching.search.rounds.finish`.

    **Returns:** The prepared pair on which the last stage ran, and its `Outcome`. The prepared pair is
    `prepared` itself if nothing was trimmed. If all stages succeeded, each unreferenced vertex of X has the
    match of the nearest referenced vertex. The attribute `suspicious` is copied from the given outcome.
    """
    start, last = prepared, stages[-1]
    following = trimmed_stage(prepared.pair, [*stages, *final_stages], repair)
    if repair is not None and following is not None and outcome.successful:
        for _ in range(repair.trims):
            reverse = _reversed(prepared, last, outcome)
            pair = trimmed(start.pair, _extended(prepared, outcome), reverse, repair.trimmed_area)
            again = _matched_again(prepared, pair, following, outcome, history)
            if again is None:
                break
            (prepared, outcome), last = again, following
    if prepared is start:
        outcome = finish(prepared, stages, final_stages, repair, outcome, history=history)
    if not outcome.successful:
        return prepared, outcome
    found = prepared.padded_map(_extended(prepared, outcome))
    *before, end = outcome.refinements
    end = eqx.tree_at(lambda tree: tree.pointwise_map, end, found)
    return prepared, outcome._replace(refinements=[*before, end])


def _extended(prepared: PreparedPair, outcome: Outcome) -> Int64[np.ndarray, " m"]:
    """Return the map of an outcome (m,). Unreferenced vertices have the match of the nearest vertex."""
    return extend_to_unreferenced(prepared.pair.mesh_x, outcome.unpadded_map(prepared.pair))


def _reversed(prepared: PreparedPair, last: Stage, outcome: Outcome) -> Int64[np.ndarray, " n"]:
    """Return the map Y -> X (n,) from the state of the last stage."""
    problem = Problem(*prepared.view(last), partial=prepared.pair.partial)
    padded = compiled(reverse_map)(last.refiner, problem, outcome.refinements[-1].state)
    found = np.asarray(padded)[: len(prepared.pair.mesh_y.vertices)].astype(np.int64)
    return extend_to_unreferenced(prepared.pair.mesh_y, found)


def _matched_again(
    prepared: PreparedPair, pair: Pair, stage: Stage, outcome: Outcome, history: bool
) -> tuple[PreparedPair, Outcome] | None:
    """Run a stage on a trimmed pair from the map of an outcome. Return None after a failure."""
    logger.info("the larger shape is trimmed and matched again ...")
    try:
        stage = stage.fitted(pair.fewest_vertices())
        start = _prepared_again(prepared, pair, stage, outcome)
    except InputError as error:  # the kept region can be too small or too coarse
        logger.info("the map is kept as it was before trimming: %s", error)
        return None
    again = refine_in_stages(start, [stage], history=history)
    if not again.successful:
        return None
    return start, again._replace(
        refinements=[*outcome.refinements, *again.refinements],
        initial_map=outcome.initial_map,
        suspicious=outcome.suspicious,
    )


def _prepared_again(prepared: PreparedPair, pair: Pair, stage: Stage, outcome: Outcome) -> PreparedPair:
    """Compute spectra, descriptors and samples of a trimmed pair, which starts from the map of an outcome.

    **Raises:** `InputError` if they cannot be computed.
    """
    # Both shapes cover nearly the same region, so they have about as many eigenvalues below any limit.
    # Equal numbers of eigenvectors let all trimmed pairs of similar sizes share a compiled program.
    spectra = paired_spectra(
        pair,
        stage.number_of_eigenvectors,
        laplacian=prepared.laplacian,
        eigensolver=prepared.eigensolver,
        common_limit=False,
    )
    # The first trim changes the descriptors near the new boundary. Later trims hardly change them.
    before = (prepared.spectrum_x, prepared.spectrum_y)
    of_x, of_y = (
        spectrum.with_descriptors(old.descriptors).with_crease_eigenvectors(old.crease_eigenvectors)
        for spectrum, old in zip(spectra, before, strict=True)
    )
    if stage.number_of_descriptors and not prepared.trimmed:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the given meshes have already caused the same warnings
            of_x, of_y = describe(pair, of_x, of_y, stage.number_of_descriptors)
    samples = None
    if stage.number_of_samples is not None:
        samples = paired_samples(pair, stage.number_of_samples)
    nearest = extend_to_unreferenced(pair.mesh_y, np.arange(len(pair.mesh_y.vertices)))
    return replace(
        prepared,
        pair=pair,
        spectrum_x=of_x,
        spectrum_y=of_y,
        initial_map=nearest[_extended(prepared, outcome)],
        samples=samples,
        trimmed=True,
    )
