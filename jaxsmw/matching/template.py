"""Joins the matches of two partial shapes with one full shape, the template."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int64
from scipy.spatial import KDTree

from jaxsmw.choices import Backend, Eigensolver, Laplacian, Scale, Template
from jaxsmw.creature import creature
from jaxsmw.errors import InputError, check_choice
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh, extend_to_unreferenced
from jaxsmw.geometry.scale import estimate_scale
from jaxsmw.matching.correspondence import Correspondence, Overlap
from jaxsmw.matching.executor import run
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair, prepare
from jaxsmw.matching.search.alternatives import Alternative
from jaxsmw.matching.search.fitting import fitted_scale
from jaxsmw.matching.search.proxies import Proxy
from jaxsmw.matching.search.reading import COMMON, DIFFERENT
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset, Stage

# Beside positions in units of the square root of the template's area, normals have this weight. It keeps the
# two sides of a thin part apart.
_NORMALS = 0.1
# Less probable alternatives are left out, because both parts have several.
_LEAST_PROBABILITY = 0.01
# The number of vertices of a built-in template.
_VERTICES = 3000


def scales_to_template(
    mesh_x: Mesh, mesh_y: Mesh, template: Mesh | MeshLike | Template, scale: float | Scale
) -> tuple[Mesh, float | Scale, float | Scale]:
    """Return the template, and the scales of X and of Y to the template; see `Pair.make`.

    The scale to a built-in template is unknown. Estimates from similar points (`estimate_scale`) are the
    starting points of estimates from fits (`fitted_scale`). If the scale of X to Y is known, both parts are
    fitted together.

    **Arguments:**

    - `mesh_x`, `mesh_y`, `template`, `scale`: see `jaxsmw.match`.

    **Raises:** `InputError` if the template is not a mesh or a name, or if no scale can be estimated.
    """
    if not isinstance(template, str):
        return as_mesh(template, "template"), scale, "unknown" if isinstance(scale, str) else 1.0
    check_choice(template, Template, "a template")
    whole = creature(template, vertices=_VERTICES)
    of_x, of_y = (estimate_scale(mesh, whole) for mesh in (mesh_x, mesh_y))
    x, y, proxy = (
        Proxy(PreparedShape.of(mesh, compute_spectrum(mesh, 1)), 1.0) for mesh in (mesh_x, mesh_y, whole)
    )
    if isinstance(scale, str):
        scale_x, scale_y = (
            estimate.scale * fitted_scale([(part, proxy, estimate.scale)])
            for part, estimate in ((x, of_x), (y, of_y))
        )
        return whole, scale_x, scale_y
    logarithms, supports = np.log([of_x.scale / scale, of_y.scale]), [of_x.support, of_y.support]
    unit = float(np.exp(np.average(logarithms, weights=supports)))
    unit *= fitted_scale([(x, proxy, scale * unit), (y, proxy, unit)])
    return whole, scale * unit, unit


def join(
    x_to_template: Correspondence,
    y_to_template: Correspondence,
    preset: Preset,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    backend: Backend = "auto",
) -> Correspondence:
    """Join the maps of two parts to a template, and refine the map in the region that the parts share.

    A vertex of X is matched to the vertex of Y whose point on the template is nearest. Both shapes are then
    trimmed to the region that they share, and the last stage of the preset refines the map there, as in
    `jaxsmw.matching.search.trimming`.

    **Arguments:**

    - `x_to_template`, `y_to_template`: the matches of X (m vertices) and Y (n vertices) with the template.
    - `preset`: the preset, adapted to the meshes.
    - `laplacian`, `eigensolver`, `backend`: see `jaxsmw.match`.

    **Returns:** The `Correspondence` from X to Y. Its probability is that of both maps to the template being
    right, or of alternatives that lead to the same map.

    **Raises:** `ArithmeticError` if the refinement fails numerically.
    """
    pair = Pair(
        x_to_template.mesh_x,
        y_to_template.mesh_x,
        partial=True,
        scale=x_to_template.pair.scale / y_to_template.pair.scale,
    )
    initial_map = _composed(x_to_template.mesh_y, x_to_template.pointwise_map, y_to_template.pointwise_map)
    shared = _overlap(x_to_template, y_to_template)
    prepared, stage = _prepared(pair, shared, preset, laplacian, eigensolver, backend)
    if x_to_template.mirrored != y_to_template.mirrored:
        prepared = prepared.mirror()
    if stage.number_of_descriptors:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the given meshes have already caused the same warnings
            prepared = prepared.describe(stage.number_of_descriptors)
    stage = prepared.usable(Preset((stage,))).stages[0]
    nearest = extend_to_unreferenced(prepared.pair.mesh_y, np.arange(len(pair.mesh_y.vertices)))
    outcome = run([stage], prepared.spectra, Start(nearest[initial_map]))
    best, *others = _alternatives(x_to_template, y_to_template, initial_map, shared)
    joined = Correspondence.of(
        prepared,
        Start(initial_map, origin="template"),
        preset,
        outcome,
        best.probability,
        tuple(others),
    )
    return replace(joined, shared=shared)


def _composed(
    template: Mesh, x_to_template: Int64[np.ndarray, " m"], y_to_template: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, " m"]:
    """Return the map X -> Y (m,) that matches vertices with the nearest points on the template."""
    features = np.hstack([template.vertices / template.area**0.5, _NORMALS * template.vertex_normals])
    return KDTree(features[y_to_template]).query(features[x_to_template])[1]


def _overlap(x_to_template: Correspondence, y_to_template: Correspondence) -> Overlap:
    """Return how probably each vertex lies in the region of the template that the other shape covers."""
    covered_by_x, covered_by_y = (
        match.overlap_probabilities().of_y for match in (x_to_template, y_to_template)
    )
    return Overlap(covered_by_y[x_to_template.pointwise_map], covered_by_x[y_to_template.pointwise_map])


def _prepared(
    pair: Pair,
    shared: Overlap,
    preset: Preset,
    laplacian: Laplacian,
    eigensolver: Eigensolver,
    backend: Backend,
) -> tuple[PreparedPair, Stage]:
    """Prepare the pair, trimmed to the shared region, for the last stage.

    If the shared region is too small or too coarse, the pair is not trimmed.
    """
    stage = preset.stages[-1]
    if preset.search is not None:
        stage = stage.coarsened(preset.search.trimmed_levels)
    mesh_x, mesh_y = (_kept(mesh, mask) for mesh, mask in zip(pair.meshes, shared.masks, strict=True))
    trimmed = replace(pair, mesh_x=mesh_x, mesh_y=mesh_y)

    def prepared(surfaces: Pair) -> tuple[PreparedPair, Stage]:
        fitted = stage.fitted(surfaces.fewest_vertices())
        sizes = fitted.sizes._replace(number_of_crease_eigenvectors=0)
        ready = prepare(
            surfaces,
            sizes,
            given=pair,
            laplacian=laplacian,
            eigensolver=eigensolver,
            backend=backend,
            trimmed=surfaces is trimmed,
        )
        return ready, fitted

    try:
        return prepared(trimmed)
    except InputError:
        warnings.warn(
            f"{pair.name}: on the template, the two shapes share too small a region to refine the map there.",
            stacklevel=4,
        )
        return prepared(pair)


def _kept(mesh: Mesh, mask: Bool[np.ndarray, " n"]) -> Mesh:
    """Return the part of a mesh whose faces touch the mask. All vertices keep their numbers."""
    return mesh.without_faces(~mask[mesh.faces].any(axis=1))


def _alternatives(
    x_to_template: Correspondence,
    y_to_template: Correspondence,
    joined: Int64[np.ndarray, " m"],
    shared: Overlap,
) -> list[Alternative]:
    """Return the joined map, and the maps that result if an alternative replaces a map to the template.

    A map that agrees with a more probable one in the overlap adds its probability to that one.
    """
    template, map_x, map_y = x_to_template.mesh_y, x_to_template.pointwise_map, y_to_template.pointwise_map
    replaced = [
        ("source", other, y_to_template.probability, (other.pointwise_map, map_y))
        for other in x_to_template.alternatives
    ]
    replaced += [
        ("target", other, x_to_template.probability, (map_x, other.pointwise_map))
        for other in y_to_template.alternatives
    ]
    others = [
        Alternative(
            _composed(template, *maps),
            other.probability * probability,
            f"{name} on the template: {other.difference.replace('the source', f'the {name}')}",
        )
        for name, other, probability, maps in replaced
        if other.probability * probability >= _LEAST_PROBABILITY
    ]
    areas = x_to_template.mesh_x.vertex_areas * shared.masks[0]
    positions = y_to_template.mesh_x.vertices * y_to_template.pair.scale / template.area**0.5

    def agree(one: Alternative, other: Alternative) -> bool:
        apart = np.linalg.norm(positions[one.pointwise_map] - positions[other.pointwise_map], axis=1)
        return bool(areas @ (apart >= DIFFERENT) < COMMON * areas.sum())

    found: list[Alternative] = []
    first = Alternative(joined, x_to_template.probability * y_to_template.probability, "")
    for one in (first, *sorted(others, key=lambda other: -other.probability)):
        twin = next((number for number, known in enumerate(found) if agree(known, one)), None)
        if twin is None:
            found.append(one)
        else:
            found[twin] = found[twin]._replace(probability=found[twin].probability + one.probability)
    return found
