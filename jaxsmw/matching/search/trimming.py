"""Trims the larger shape of a partial pair to the region that the smaller shape covers, and matches again."""

from __future__ import annotations

import logging
import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.choices import Backend
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, connected_components, extend_to_unreferenced
from jaxsmw.geometry.scans import in_small_components
from jaxsmw.matching.executor import run
from jaxsmw.matching.judge import detours
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.shape import prepare_shapes
from jaxsmw.matching.stages import Preset, Stage

logger = logging.getLogger("jaxsmw")


def trimmed(
    pair: Pair,
    pointwise_map: Int64[np.ndarray, " m"],
    reverse: Int64[np.ndarray, " n"],
    area: float,
) -> Pair:
    """Trim the larger shape of a partial pair to the region that the smaller shape covers.

    A vertex of the larger shape probably has a counterpart if its detour is small; see
    `jaxsmw.matching.judge.detours`. The vertices with the smallest detours are kept, until their area is
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


def trimmed_stage(pair: Pair, preset: Preset) -> Stage | None:
    """Return the stage that runs after trimming: the last stage of the preset, with `trimmed_levels`.

    **Returns:** The stage, or None if the pair is not trimmed. A pair is trimmed only if it is a partial pair
    and the larger area is at least `trimmed_from` times the smaller area.
    """
    settings = preset.search
    if settings is None or settings.trims == 0 or not pair.partial:
        return None
    if max(pair.areas) < settings.trimmed_from * min(pair.areas):
        return None
    return preset.stages[-1].coarsened(settings.trimmed_levels)


def match_trimmed(
    prepared: PreparedPair, preset: Preset, outcome: Outcome
) -> tuple[PreparedPair, Outcome] | None:
    """Trim the larger shape of a partial pair, and match the pair again by the last stage.

    After trimming, both shapes cover nearly the same region, so their eigenfunctions are similar; see
    docs/how_it_works.md. The last stage of the preset runs with `trimmed_levels`. (Table R46)

    **Arguments:**

    - `prepared`: the prepared pair.
    - `preset`: the stages and the settings of the search.
    - `outcome`: the successful outcome of the search.

    **Returns:** The trimmed pair and its outcome, or None if the pair is not trimmed.
    """
    settings, following = preset.search, trimmed_stage(prepared.pair, preset)
    if settings is None or following is None:
        return None
    trimmed_match, given = None, prepared.pair
    for _ in range(settings.trims):
        reverse = extend_to_unreferenced(prepared.pair.mesh_y, outcome.last.reverse_map())
        pair = trimmed(given, _everywhere(prepared, outcome), reverse, settings.trimmed_area)
        again = _matched_again(prepared, pair, following, outcome)
        if again is None:
            break
        prepared, outcome = trimmed_match = again
    return trimmed_match


def _everywhere(prepared: PreparedPair, outcome: Outcome) -> Int64[np.ndarray, " m"]:
    return extend_to_unreferenced(prepared.pair.mesh_x, outcome.pointwise_map)


def _matched_again(
    prepared: PreparedPair, pair: Pair, stage: Stage, outcome: Outcome
) -> tuple[PreparedPair, Outcome] | None:
    """Run a stage on a trimmed pair from a map. Return None after a failure."""
    logger.info("the larger shape is trimmed and matched again ...")
    try:
        stage = stage.fitted(pair.fewest_vertices())
        trimmed_pair = _prepared_again(prepared, pair, stage)
    except InputError as error:  # the kept region can be too small or too coarse
        logger.info("the map is kept as it was before trimming: %s", error)
        return None
    nearest = extend_to_unreferenced(pair.mesh_y, np.arange(len(pair.mesh_y.vertices)))
    again = run([stage], trimmed_pair.spectra, Start(nearest[_everywhere(prepared, outcome)]))
    return (trimmed_pair, outcome.followed_by(again)) if again.successful else None


def _prepared_again(prepared: PreparedPair, pair: Pair, stage: Stage) -> PreparedPair:
    """Prepare a trimmed pair.

    Both shapes have equal numbers of eigenvectors, so all trimmed pairs of similar sizes share a program.

    **Raises:** `InputError` if the kept region is too small or too coarse.
    """
    sizes = stage.sizes._replace(number_of_crease_eigenvectors=0)
    laplacian, eigensolver = prepared.laplacian, prepared.eigensolver
    backend: Backend = "numpy" if prepared.spectra.on_host else "jax"
    shapes = prepare_shapes(pair.meshes, sizes, laplacian=laplacian, eigensolver=eigensolver, backend=backend)
    # The first trim changes the descriptors near the new boundary. Later trims hardly change them.
    kept = (
        replace(shape, spectrum=_with_columns_of(before.spectrum, shape.spectrum))
        for shape, before in zip(shapes, prepared.shapes, strict=True)
    )
    again = PreparedPair.of(
        pair,
        *kept,
        given=prepared.given,
        mirrored=prepared.mirrored,
        trimmed=True,
        laplacian=laplacian,
        eigensolver=eigensolver,
    )
    if stage.number_of_descriptors and not prepared.trimmed:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the given meshes have already caused the same warnings
            again = again.describe(stage.number_of_descriptors, required=True)
    return again


def _with_columns_of(before: Spectrum, spectrum: Spectrum) -> Spectrum:
    """Return a spectrum with the descriptors and crease eigenvectors of an earlier spectrum."""
    described = spectrum.with_descriptors(before.descriptors)
    return described.with_crease_eigenvectors(before.crease_eigenvectors)
