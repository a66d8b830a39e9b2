"""The function `match`, which computes the correspondence of two meshes."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Sequence
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
    Template,
)
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.advice import advice
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.executor import run
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair, prepare
from jaxsmw.matching.search.alternatives import alternatives
from jaxsmw.matching.search.search import search
from jaxsmw.matching.search.trimming import match_trimmed
from jaxsmw.matching.stages import Preset, PresetName, Stage, choose_preset
from jaxsmw.matching.starts import check_initial_map, make_start
from jaxsmw.matching.template import join, scales_to_template
from jaxsmw.runtime.memory import release_freed_memory
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
    template: Mesh | MeshLike | Template | None = None,
    mirror: Mirror = DEFAULT_MIRROR,
    history: bool = False,
    backend: Backend = DEFAULT_BACKEND,
) -> Correspondence:
    """Find for every vertex of X the vertex of Y at the same point of the body.

    If the preset has a search, each mesh is first cut where its surface is fused with itself, for example a
    hand with a hip; see `jaxsmw.geometry.cut_shortcuts`. The result refers to the given meshes.

    The function issues a `WrongMapWarning` if the map is probably wrong as a whole. It issues a `UserWarning`
    if one mesh was recognised as a part of the other, if a mesh is too coarse for the descriptors of the
    preset, or if small components without a counterpart have more than 5 % of X's area.

    **Arguments:**

    - `mesh_x`, `mesh_y`: the source X (m vertices) and the target Y (n vertices), in any unit of length. Each
      argument is a `Mesh`, a mesh of trimesh, pyFM, geomfum or PyVista, or a tuple of vertices and faces; see
      `make_mesh`.
    - `preset`: the method of refinement, which is one of the following.

        - `"accurate"` (the default): four stages, with a search; see `jaxsmw.PRESETS`.
        - `"paper"`: the method of the MWP paper.
        - `"fast"`: the method of the MWP paper on 500 samples of each shape.
        - a `Preset`. Its sizes are adapted to small meshes; see `Preset.fitted`.
        - a `Stage`, or a list or tuple of stages, which are used unchanged. An example is
          `Stage(WaveletPreservation(bank=Meyer(8)), number_of_eigenvectors=60)`.

    - `init`: the initial map, which is one of the following.

        - `"auto"` (the default): `"shot"`. If its map is uncertain and the preset has a search, many other
          initial maps are tried; see docs/how_it_works.md.
        - `"shot"`, `"wks"`, `"hks"`, `"wavelet"`, `"functional"`, `"aligned"`, `"positions"`, a given map
          (m,) or landmarks (l, 2): see `initial_map`. No other initial maps are tried. `"functional"` is
          smoother than `"shot"` and has smaller errors, but after refinement, the map often has larger errors
          (docs/results.md).

    - `laplacian`, `eigensolver`: see `compute_spectrum`. `"auto"` chooses `"approximate"` for both meshes if
      one mesh has at least 50 000 referenced vertices, else `"exact"`.
    - `partial`: True if one mesh or both meshes are partial shapes of the body; see `paired_spectra`. The
      default is False, for two full shapes. `Correspondence.overlap` predicts which vertices have a
      counterpart on the other mesh.
    - `scale`: see `Pair.make`. Full shapes are always scaled to the same area.
    - `template`: a full shape of the same kind of body, for two partial shapes that share only a region. Both
      are matched to the template as its parts, and through it to each other; see docs/how_it_works.md. A
      template makes `partial` True. The default is None, to match X to Y directly.

        - a mesh in the unit of length of Y.
        - `"mammal"`: a built-in synthetic body for parts of four-legged animals; see `jaxsmw.creature`. Its
          scale is estimated.

    - `mirror`: whether X and Y are of opposite hands, such as a left and a right tooth. If they are, the
      mirror image of X is matched instead of X. Whether X is mirrored or not, entry i of the map is the match
      of vertex i of X.

        - `"auto"` (the default): if the preset has a search and both shapes differ from their own mirror
          images, as teeth do, maps of the mirror image are tried as well. The better map is chosen.
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
    matched = functools.partial(
        _matched,
        preset=preset,
        laplacian=laplacian,
        eigensolver=eigensolver,
        mirror=mirror,
        history=history,
        backend=backend,
    )
    if template is None:
        correspondence = matched(_pair(mesh_x, mesh_y, partial, scale), init=init)
    elif not isinstance(init, str):
        raise InputError(
            "an initial map from X to Y cannot be used with a template: leave out the one or the other."
        )
    else:
        parts = as_mesh(mesh_x, "source mesh"), as_mesh(mesh_y, "target mesh")
        seconds: dict[str, float] = {}
        with timed("scale of the template", seconds):
            whole, *scales = scales_to_template(*parts, template, scale)
        pairs = [_pair(part, whole, True, unit) for part, unit in zip(parts, scales, strict=True)]
        with timed("source to template", seconds):
            x_to_template = matched(pairs[0], init=init, history=False)
        with timed("target to template", seconds):
            y_to_template = matched(pairs[1], init=init, history=False)
        with timed("source to target", seconds), one_blas_thread():
            method = choose_preset(preset)
            correspondence = join(
                x_to_template,
                y_to_template,
                method.with_history() if history else method,
                laplacian=laplacian,
                eigensolver=eigensolver,
                backend=backend,
            )
        correspondence = replace(correspondence, seconds=seconds)
    for warning in advice(correspondence, partial=partial or template is not None):
        warnings.warn(warning, stacklevel=2)
    return correspondence


def _pair(mesh_x: Mesh | MeshLike, mesh_y: Mesh | MeshLike, partial: bool, scale: float | Scale) -> Pair:
    """Make a pair, and report the scale if it was estimated."""
    pair = Pair.make(mesh_x, mesh_y, partial=partial, scale=scale)
    if pair.scale != scale:
        logger.info("scale: lengths on %s are multiplied by %.4g", pair.mesh_x.name, pair.scale)
    return pair


def _matched(
    pair: Pair,
    *,
    preset: PresetName | Preset | Stage | Sequence[Stage],
    init: MatchInit | ArrayLike | SurfacePoints,
    laplacian: Laplacian,
    eigensolver: Eigensolver,
    mirror: Mirror,
    history: bool,
    backend: Backend,
) -> Correspondence:
    """Match a pair without a template, and without advice; see `match`."""
    adapts = isinstance(preset, str | Preset)
    method = choose_preset(preset)
    surfaces = pair.without_shortcuts() if method.cuts_shortcuts else pair
    fewest = surfaces.fewest_vertices()
    if adapts:
        method = method.fitted(fewest)
    if history:
        method = method.with_history()
    # The check runs before the slow computation of the eigenbases.
    automatic = isinstance(init, str) and init == "auto"
    first_init = check_initial_map(pair, DEFAULT_INITIAL_MAP if automatic else init)

    seconds: dict[str, float] = {}
    step = functools.partial(timed, seconds=seconds)
    release_freed_memory()
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
        # SHOT changes in a mirror image, so initial maps and descriptors are computed after this decision.
        if mirror == "yes":
            prepared = prepared.mirror()
        with step("initial map"):
            start = make_start(prepared, first_init)
        if method.number_of_descriptors:
            with step("descriptors"):
                prepared = prepared.describe(method.number_of_descriptors, required=not adapts)
        correspondence = match_prepared(
            prepared, start, method, mirror=mirror, hypotheses=automatic, step=step
        )
    return replace(correspondence, seconds=seconds)


def match_prepared(
    prepared: PreparedPair,
    start: Start,
    preset: Preset,
    *,
    mirror: Mirror = "no",
    hypotheses: bool = True,
    outcome: Outcome | None = None,
    step: Step = no_step,
) -> Correspondence:
    """Search for the right map, and run the final stages.

    **Arguments:**

    - `prepared`: the prepared pair. If it has no descriptors, the stages use none.
    - `start`, `mirror`, `hypotheses`, `outcome`: see `jaxsmw.matching.search.search`.
    - `preset`: the stages and the settings of the search.
    - `step`: reports and measures the steps. By default, nothing is reported.

    **Returns:** The `Correspondence`.

    **Raises:** `ArithmeticError` if refinement fails numerically from every start, or in the final stages.
    """
    preset = prepared.usable(preset)
    with step("refinement"):
        best, *others = search(prepared, start, preset, mirror=mirror, hypotheses=hypotheses, outcome=outcome)
    prepared, outcome = best.reading.prepared, best.outcome
    if outcome.successful and (preset.final or preset.search):
        with step("final stages"):
            if trimmed := match_trimmed(prepared, preset, outcome):
                prepared, outcome = trimmed
            elif preset.final:
                final = run(preset.final, prepared.spectra, Start(outcome.pointwise_map))
                outcome = outcome.followed_by(final)
    return Correspondence.of(prepared, start, preset, outcome, *alternatives(best, others))
