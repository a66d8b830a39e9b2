"""An interactive web page that shows a collection of shapes in one triangulation, and their shape model."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from types import MappingProxyType
from typing import Any

import igl
import numpy as np
from jaxtyping import Float64, Int, Int64, Real
from scipy.spatial.distance import pdist, squareform

from jaxsmw.choices import Axis
from jaxsmw.collection.result import MatchedEdge
from jaxsmw.collection.shape_models import ShapeModel, shape_model
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import position_colors
from jaxsmw.report.page_data import encode, encode_colors, encode_positions
from jaxsmw.report.rendering import choose_azimuth
from jaxsmw.report.standing import guess_up, placement, stand
from jaxsmw.report.template import facts, table, write_html

MOST_VERTICES = 20_000
"""The largest number of vertices of each shape on a page. Larger manifold triangulations are simplified."""

# The page has sliders and scores for at most `_MODES` modes. Modes whose share of the variance is smaller
# than `_SMALLEST_SHARE` are left out, because their effect is not visible. The first two modes are always
# kept.
_MODES, _SMALLEST_SHARE = 10, 0.002
# The template and at most this number of other shapes determine the upright position and the direction of
# view.
_SHAPES_IN_VIEW = 8
_ROUNDS_OF_LAYOUT = 200


def write_collection_page(
    path: str | os.PathLike[str],
    *,
    names: Sequence[str],
    faces: Int[np.ndarray, "f 3"],
    registered: Sequence[Real[np.ndarray, "_ 3"]],
    template: int,
    edges: Sequence[MatchedEdge],
    model: ShapeModel | None,
    title: str,
    notes: Sequence[str] = (),
    left_out: Mapping[str, str] = MappingProxyType({}),
    warning: str = "",
    up: Axis | None = None,
) -> None:
    """Write a web page that shows all shapes of a collection, their matches and their shape model.

    On the page, each point of the body has the same colour on every shape. A user can compare any two shapes,
    and deform the mean shape along the modes of the model. Plots show the matched pairs and the scores of the
    shapes. The page is one file and needs no network. The viewer takes about 0.6 MB of it, and each shape
    takes 8 bytes per vertex.

    **Arguments:**

    - `path`: the HTML file.
    - `names`: the names of the N shapes.
    - `faces`: the faces of the template (f, 3).
    - `registered`: the positions of the template's vertices on each shape, N arrays (n, 3).
    - `template`: the index of the template.
    - `edges`: the matched pairs of shapes.
    - `model`: the shape model of the registered shapes, in the same order and with the template as reference;
      None for a page without mean shape, modes and scores.
    - `title`: the heading of the page.
    - `notes`: sentences about decisions, such as the choice of the template.
    - `left_out`: the reasons why the page does not show some shapes, by their names.
    - `warning`: a sentence below the heading, or an empty text.
    - `up`: the axis of the template's coordinates that points up, such as `"y"` or `"-z"`; by default guessed
      from several shapes (`jaxsmw.report.standing.guess_up`).

    A page shows at most 20 000 vertices per shape (`MOST_VERTICES`). If a manifold template has more
    vertices, its triangulation is simplified. Positions are rounded to 16 bits per coordinate.

    **Raises:** `InputError` if there is no shape, if names, faces, edges or the model do not fit the shapes,
    if a coordinate is not finite, the template has no area, `up` is not an axis, or the file cannot be
    written.
    """
    _check(names, faces, registered, template, edges, model)
    corners = np.asarray(faces, dtype=np.int64)
    first = Mesh(np.asarray(registered[template], dtype=np.float64), corners, names[template])
    # Without a model, one is computed here only to align the shapes. Its modes are not shown.
    shown_model = model or shape_model(registered, weights=first.vertex_areas, reference=template)
    aligned = [replace(first, vertices=positions) for positions in shown_model.aligned]
    # On a very bad shape, the template can collapse to a curve, which has no upright position.
    in_view = [i for i in _spread(len(aligned), template) if i == template or aligned[i].area > 0]
    if up is None:
        # The aligned shapes have a common upright axis, so the most frequent guess is used.
        up = Counter(guess_up(aligned[i]) for i in in_view).most_common(1)[0][0]
    standing = stand(aligned[template], up)
    matrix, offset = placement(aligned[template], standing)
    to_page = np.linalg.inv(matrix)
    kept, kept_faces = simplify(standing, MOST_VERTICES)
    shapes = [(shape[kept] - offset) @ to_page for shape in shown_model.aligned]
    seen = [replace(standing, vertices=shapes[i], faces=kept_faces) for i in in_view]
    data: dict[str, Any] = {
        "names": list(names),
        "template": int(template),
        "faces": encode(kept_faces, "<u4"),
        "vertices": None if len(kept) == len(first.vertices) else encode(kept, "<u4"),
        "colors": encode_colors(position_colors(standing)[kept]),
        "shapes": [encode_positions(shape) for shape in shapes],
        "azimuth": choose_azimuth(seen),
        "edges": [
            {
                "source": edge.source,
                "target": edge.target,
                "error": 1e3 * edge.expected_error if np.isfinite(edge.expected_error) else None,
                "doubtful": edge.doubtful,
                "note": edge.sentence(names),
            }
            for edge in edges
        ],
        "layout": layout(shown_model.aligned, shown_model.weights).tolist(),
        "model": None if model is None else _encode_model(model, kept, offset, to_page),
    }
    lead = (
        f"Every shape has the {len(first.vertices)} vertices of the template, {names[template]}. Equal "
        "colours mark the same point of the body on every shape."
    )
    if len(kept) < len(first.vertices):
        lead += f" This page shows {len(kept)} of the vertices."
    fragments = {
        "title": escape(title),
        "lead": escape(lead),
        "warning": f'<p class="fault">{escape(warning)}</p>' if warning else "",
        "statistics": _statistics(names, edges, left_out, model),
        "notes": _notes(notes, left_out),
        "edges": _edge_table(names, edges) if edges else "",
    }
    write_html(path, "collection.html", data, fragments)


def simplify(mesh: Mesh, most: int) -> tuple[Int64[np.ndarray, " q"], Int64[np.ndarray, "g 3"]]:
    """Simplify a mesh to at most `most` of its n vertices, such that its picture hardly changes.

    The shortest edges are collapsed first (`igl.decimate`). If the mesh is not manifold, only its
    unreferenced vertices are removed. Return the indices of the chosen vertices (q,), and faces (g, 3) that
    refer to the chosen vertices. A mesh with at most `most` vertices keeps all its vertices and faces.
    """
    n, used = len(mesh.vertices), mesh.referenced_indices
    if n <= most:
        return np.arange(n), mesh.faces
    numbers = np.full(n, -1)
    numbers[used] = np.arange(len(used))
    faces = numbers[mesh.faces]
    if len(used) <= most or not igl.is_edge_manifold(faces)[0]:
        return used, faces
    # Each collapse of an edge removes one vertex and up to two faces.
    target = max(len(faces) - 2 * (len(used) - most), 4)
    _, coarse, _, births = igl.decimate(
        np.asfortranarray(mesh.vertices[used]), np.asfortranarray(faces, dtype=np.int32), target
    )
    if len(coarse) == 0:
        return used, faces
    return used[np.asarray(births).ravel()], coarse.astype(np.int64, order="C")


def layout(
    shapes: Float64[np.ndarray, "N n 3"], weights: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "N 2"]:
    """Place N aligned shapes (N, n, 3) as points in the plane (N, 2). Similar shapes are close to each other.

    The distance between two shapes is the weighted root mean square of the distances between corresponding
    vertices. The weights have the sum 1. Classical multidimensional scaling gives the initial places
    (Torgerson 1952). Majorisation then brings the distances in the plane closer to the distances between the
    shapes (de Leeuw, "Applications of convex analysis to multidimensional scaling", 1977). Both coordinates
    have the mean 0. The first coordinate has the larger variance.
    """
    count = len(shapes)
    centered = (shapes - shapes.mean(axis=0)) * np.sqrt(weights)[:, None]
    products = np.einsum("ivc,jvc->ij", centered, centered, optimize=True)
    values, vectors = np.linalg.eigh(products)
    order = np.argsort(-values)
    points = vectors[:, order] * np.sqrt(np.maximum(values[order], 0))
    # The sign of an eigenvector is arbitrary. The entry with the largest absolute value is made positive.
    points *= np.where(points[np.abs(points).argmax(axis=0), np.arange(count)] < 0, -1, 1)
    distances = squareform(pdist(points))
    places = np.zeros((count, 2))
    places[:, : min(count, 2)] = points[:, :2]
    for _ in range(_ROUNDS_OF_LAYOUT):
        current = squareform(pdist(places))
        ratios = np.divide(distances, current, out=np.zeros_like(distances), where=current > 0)
        places = (ratios.sum(axis=1)[:, None] * places - ratios @ places) / count
    return places


def _check(
    names: Sequence[str],
    faces: Int[np.ndarray, "f 3"],
    registered: Sequence[Real[np.ndarray, "_ 3"]],
    template: int,
    edges: Sequence[MatchedEdge],
    model: ShapeModel | None,
) -> None:
    """Check that the arguments of `write_collection_page` fit each other."""
    count = len(registered)
    if count == 0:
        raise InputError("there is no shape to show; give at least one shape.")
    if len(names) != count:
        raise InputError(f"there are {len(names)} names, but {count} shapes; give one name per shape.")
    if not 0 <= template < count:
        raise InputError(f"the template is shape {template}, but the shapes are 0 to {count - 1}.")
    n = len(registered[template])
    for name, shape in zip(names, registered, strict=True):
        if len(shape) != n:
            raise InputError(
                f"{name}: there are {len(shape)} positions, but the template has {n} vertices; give one "
                f"position per vertex of the template."
            )
        if not np.isfinite(shape).all():
            raise InputError(f"{name}: some coordinates are not finite; leave the shape out.")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= n:
        raise InputError(f"the faces do not fit the {n} vertices of the template; give the template's faces.")
    for edge in edges:
        if not (0 <= edge.source < count and 0 <= edge.target < count):
            raise InputError(
                f"an edge joins the shapes {edge.source} and {edge.target}, but the shapes are 0 to "
                f"{count - 1}."
            )
    if model is not None and model.aligned.shape != (count, n, 3):
        raise InputError(
            f"the model has {len(model.aligned)} shapes with {len(model.mean)} vertices, but the page has "
            f"{count} shapes with {n} vertices; give the model of these shapes."
        )


def _spread(count: int, template: int) -> list[int]:
    """Return the indices of the template and of a few other shapes, which are spread evenly."""
    others = np.linspace(0, count - 1, min(count, _SHAPES_IN_VIEW)).round().astype(int).tolist()
    return list(dict.fromkeys([template, *others]))


def _encode_model(
    model: ShapeModel,
    kept: Int64[np.ndarray, " q"],
    offset: Float64[np.ndarray, " 3"],
    to_page: Float64[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """Encode the mean shape, the modes (displacements by one standard deviation) and the scores."""
    shares = model.variances[:_MODES] / (model.total_variance or 1.0)
    count = max(np.count_nonzero(shares >= _SMALLEST_SHARE), min(len(shares), 2))
    deviations = np.sqrt(model.variances[:count])
    return {
        "mean": encode_positions((model.mean[kept] - offset) @ to_page),
        "modes": [
            encode_positions(deviation * mode[kept] @ to_page)
            for deviation, mode in zip(deviations, model.modes, strict=False)
        ],
        "shares": shares[:count].tolist(),
        "scores": np.round(model.scores[:, :count] / deviations, 4).tolist(),
    }


def _statistics(
    names: Sequence[str], edges: Sequence[MatchedEdge], left_out: Mapping[str, str], model: ShapeModel | None
) -> str:
    """Return the HTML list of the numbers of shapes, pairs and modes."""
    values = {"Shapes": str(len(names))}
    if left_out:
        values["Left out"] = str(len(left_out))
    if edges:
        values["Matched pairs"] = str(len(edges))
        values["Doubtful pairs"] = str(sum(edge.doubtful for edge in edges))
    if model is not None and len(model.modes):
        enough = np.flatnonzero(model.compactness() >= 0.9)
        if len(enough):
            values["Modes for 90 % of variance"] = str(enough[0] + 1)
    return facts(values)


def _notes(notes: Sequence[str], left_out: Mapping[str, str]) -> str:
    """Return the HTML of the decisions and of the shapes that were left out."""
    lists = {
        "Decisions": [escape(note) for note in notes],
        "Shapes left out": [f"<b>{escape(name)}</b> {escape(reason)}" for name, reason in left_out.items()],
    }
    sections = ""
    for heading, items in lists.items():
        if items:
            listed = "".join(f"<li>{item}</li>" for item in items)
            sections += f'<section><h2>{heading}</h2><ul class="notes">{listed}</ul></section>'
    return f'<div class="columns">{sections}</div>' if sections else ""


def _edge_table(names: Sequence[str], edges: Sequence[MatchedEdge]) -> str:
    """Return the HTML table of the matched pairs. Doubtful pairs and large errors come first."""
    order = sorted(range(len(edges)), key=lambda i: (not edges[i].doubtful, -edges[i].expected_error))
    rows = []
    for i in order:
        edge = edges[i]
        pair = escape(f"{names[edge.source]} → {names[edge.target]}")
        error = f"{1e3 * edge.expected_error:.1f}" if np.isfinite(edge.expected_error) else ""
        doubt = '<span class="doubt">doubtful</span> ' if edge.doubtful else ""
        button = f'<button type="button" class="pair" data-edge="{i}">{pair}</button>'
        rows.append((button, error, doubt + escape(edge.sentence(names))))
    listed = table("Matched pairs", ("pair", "expected error (‰ of √area)", "note"), rows)
    return f"<details><summary>List of all matched pairs</summary>{listed}</details>"
