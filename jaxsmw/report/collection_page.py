"""An interactive web page that shows a collection of shapes in one triangulation, and their shape model."""

from __future__ import annotations

import html
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Float64, Int, Int64, Real
from scipy.spatial.distance import pdist, squareform

from jaxsmw.choices import Axis
from jaxsmw.collection.shape_models import ShapeModel, shape_model
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import PLAIN, position_colors
from jaxsmw.report.page_data import COLOR_SCALES, encode, encode_colors, encode_positions
from jaxsmw.report.rendering import ELEVATION, choose_azimuth
from jaxsmw.report.standing import guess_up, placement, stand
from jaxsmw.report.template import fill_template
from jaxsmw.runtime.files import atomic_write

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


class PageEdge(NamedTuple):
    """A matched pair of shapes on a page.

    **Attributes:**

    - `source`, `target`: the indices of the two shapes.
    - `expected_error`: the expected error of the match, in thousandths of sqrt(area) of the target. NaN and
      infinity count as unknown.
    - `doubtful`: whether the match seems to be wrong.
    - `note`: a sentence about the match; empty if there is nothing to say.
    """

    source: int
    target: int
    expected_error: float
    doubtful: bool
    note: str


def write_collection_page(
    path: str | os.PathLike[str],
    *,
    names: Sequence[str],
    faces: Int[np.ndarray, "f 3"],
    registered: Sequence[Real[np.ndarray, "_ 3"]],
    template: int,
    edges: Sequence[PageEdge],
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
    shapes. The page is one file and needs no network.

    **Arguments:**

    - `path`: the HTML file. The viewer takes about 0.6 MB of the file. Each shape takes 8 bytes per vertex.
    - `names`: the names of the N shapes.
    - `faces`: the faces of the template (f, 3).
    - `registered`: the positions of the template's vertices on each shape, N arrays (n, 3).
    - `template`: the index of the template.
    - `edges`: the matched pairs of shapes.
    - `model`: the shape model of the registered shapes; None for a page without mean shape, modes and scores.
      The model must contain the shapes in the same order, and its reference must be the template.
    - `title`: the heading of the page.
    - `notes`: sentences about decisions, such as the choice of the template.
    - `left_out`: the shapes that the page does not show, as a dictionary from the name of a shape to the
      reason.
    - `warning`: a sentence below the heading, or an empty text.
    - `up`: the axis of the template's coordinates that points up, such as `"y"` or `"-z"`. By default,
      `jaxsmw.report.standing.guess_up` guesses the axis from several shapes.

    A page shows at most 20 000 vertices per shape (`MOST_VERTICES`). If a manifold template has more
    vertices, its triangulation is simplified, and all shapes are shown with the same vertices. The positions
    on the page are rounded to 16 bits per coordinate.

    **Raises:** `InputError` if there is no shape, or if names, faces, edges or the model do not fit the
    shapes. `InputError` is also raised if a coordinate is not finite, the template has no area, `up` is not
    an axis, or the file cannot be written.
    """
    _check(names, faces, registered, template, edges, model)
    corners = np.asarray(faces, dtype=np.int64)
    first = Mesh(np.asarray(registered[template], dtype=np.float64), corners, names[template])
    # If no model is given, a model is computed here only to align the shapes. Its modes are not shown.
    shown_model = model or shape_model(registered, weights=first.vertex_areas, reference=template)
    template_mesh = replace(first, vertices=shown_model.aligned[template])
    some = [
        i
        for i in _some(len(registered), template)
        # On a very bad shape, the template can collapse to a curve, which has no upright position.
        if i == template or replace(first, vertices=shown_model.aligned[i]).area > 0
    ]
    if up is None:
        # The aligned shapes have a common upright axis, so the most frequent guess is used.
        guesses = [guess_up(replace(first, vertices=shown_model.aligned[i])) for i in some]
        up = Counter(guesses).most_common(1)[0][0]
    standing = stand(template_mesh, up)
    matrix, offset = placement(template_mesh, standing)
    to_page = np.linalg.inv(matrix)
    chosen, chosen_faces = simplify(standing, MOST_VERTICES)
    shapes = [(shape[chosen] - offset) @ to_page for shape in shown_model.aligned]
    in_view = [replace(standing, vertices=shapes[i], faces=chosen_faces) for i in some]
    data: dict[str, Any] = {
        "names": [_plain(name) for name in names],
        "template": int(template),
        "faces": encode(chosen_faces, "<u4"),
        "vertices": None if len(chosen) == len(first.vertices) else encode(chosen, "<u4"),
        "colors": encode_colors(position_colors(standing)[chosen]),
        "plain": np.round(255 * PLAIN).astype(int).tolist(),
        "scale": encode_colors(COLOR_SCALES["error"]),
        "shapes": [encode_positions(shape) for shape in shapes],
        "azimuth": choose_azimuth(in_view),
        "elevation": ELEVATION,
        "edges": [
            {
                "source": int(edge.source),
                "target": int(edge.target),
                "error": float(edge.expected_error) if np.isfinite(edge.expected_error) else None,
                "doubtful": bool(edge.doubtful),
                "note": _plain(edge.note),
            }
            for edge in edges
        ],
        "layout": layout(shown_model.aligned, shown_model.weights).tolist(),
        "model": None if model is None else _encode_model(model, chosen, offset, to_page),
    }
    fragments = {
        "title": html.escape(title),
        "lead": html.escape(_lead(names, template, len(first.vertices), len(chosen))),
        "warning": f'<p class="fault">{html.escape(_plain(warning))}</p>' if warning else "",
        "statistics": _statistics(names, edges, left_out, model),
        "notes": _notes(notes, left_out),
        "edges": _edge_table(names, edges),
    }
    page = fill_template("collection.html", "collection.js", data, fragments)
    with atomic_write(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))


def simplify(mesh: Mesh, most: int) -> tuple[Int64[np.ndarray, " q"], Int64[np.ndarray, "g 3"]]:
    """Simplify a mesh: choose some of its vertices and triangulate them.

    The picture of the mesh hardly changes. The shortest edges are collapsed first (`igl.decimate`). If the
    mesh is not manifold, only its unreferenced vertices are removed.

    **Arguments:**

    - `mesh`: a mesh with n vertices.
    - `most`: the largest number of vertices.

    **Returns:** The indices of the chosen vertices (q,), and faces (g, 3) that refer to the chosen vertices.
    A mesh with at most `most` vertices keeps all its vertices and faces.
    """
    n, used = len(mesh.vertices), np.flatnonzero(mesh.referenced_vertices)
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
    """Place shapes as points in the plane. Similar shapes are close to each other.

    The distance between two aligned shapes is the weighted root mean square of the distances between
    corresponding vertices. Classical multidimensional scaling gives the initial places (Torgerson 1952).
    Majorisation then brings the distances in the plane closer to the distances between the shapes (de Leeuw,
    "Applications of convex analysis to multidimensional scaling", 1977).

    **Arguments:**

    - `shapes`: aligned shapes (N, n, 3).
    - `weights`: the weights of the vertices (n,), with the sum 1.

    **Returns:** Places (N, 2), in the unit of the shapes. Both coordinates have the mean 0. The first
    coordinate has the larger variance.
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
    edges: Sequence[PageEdge],
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


def _some(count: int, template: int) -> list[int]:
    """Return the indices of the template and of a few other shapes, which are spread evenly."""
    others = np.linspace(0, count - 1, min(count, _SHAPES_IN_VIEW)).round().astype(int).tolist()
    return list(dict.fromkeys([template, *others]))


def _encode_model(
    model: ShapeModel,
    chosen: Int64[np.ndarray, " q"],
    offset: Float64[np.ndarray, " 3"],
    to_page: Float64[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """Encode the mean shape, the modes and the scores of a model.

    The modes are displacements by one standard deviation. The scores are in units of the standard deviation.
    """
    shares = model.variances[:_MODES] / (model.total_variance or 1.0)
    count = max(np.count_nonzero(shares >= _SMALLEST_SHARE), min(len(shares), 2))
    deviations = np.sqrt(model.variances[:count])
    return {
        "mean": encode_positions((model.mean[chosen] - offset) @ to_page),
        "modes": [
            encode_positions(deviation * mode[chosen] @ to_page)
            for deviation, mode in zip(deviations, model.modes, strict=False)
        ],
        "shares": shares[:count].tolist(),
        "scores": np.round(model.scores[:, :count] / deviations, 4).tolist(),
    }


def _plain(text: str) -> str:
    """Replace bytes that are not valid UTF-8 by question marks. Some file names contain such bytes."""
    return text.encode("utf-8", "replace").decode()


def _lead(names: Sequence[str], template: int, n: int, shown: int) -> str:
    """Return the sentences below the heading."""
    text = (
        f"Every shape has the {n} vertices of the template, {_plain(names[template])}. Equal colours mark "
        f"the same point of the body on every shape."
    )
    return text if shown == n else f"{text} This page shows {shown} of the vertices."


def _statistics(
    names: Sequence[str],
    edges: Sequence[PageEdge],
    left_out: Mapping[str, str],
    model: ShapeModel | None,
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
    rows = "".join(f"<div><dt>{label}</dt><dd>{value}</dd></div>" for label, value in values.items())
    return f"<dl>{rows}</dl>"


def _notes(notes: Sequence[str], left_out: Mapping[str, str]) -> str:
    """Return the HTML of the sentences about decisions, and of the list of shapes that were left out."""
    parts = []
    if notes:
        items = "".join(f"<li>{html.escape(_plain(note))}</li>" for note in notes)
        parts.append(f'<section><h2>Decisions</h2><ul class="notes">{items}</ul></section>')
    if left_out:
        items = "".join(
            f"<li><b>{html.escape(_plain(name))}</b> {html.escape(_plain(reason))}</li>"
            for name, reason in left_out.items()
        )
        parts.append(f'<section><h2>Shapes left out</h2><ul class="notes">{items}</ul></section>')
    return f'<div class="columns">{"".join(parts)}</div>' if parts else ""


def _edge_table(names: Sequence[str], edges: Sequence[PageEdge]) -> str:
    """Return the HTML table of the matched pairs. Doubtful pairs and large errors come first."""
    if not edges:
        return ""
    order = sorted(
        range(len(edges)), key=lambda i: (not edges[i].doubtful, -np.nan_to_num(edges[i].expected_error))
    )
    rows = []
    for i in order:
        edge = edges[i]
        source, target = (html.escape(_plain(names[index])) for index in (edge.source, edge.target))
        error = f"{edge.expected_error:.1f}" if np.isfinite(edge.expected_error) else ""
        doubt = '<span class="doubt">doubtful</span> ' if edge.doubtful else ""
        rows.append(
            f'<tr><th scope="row"><button type="button" class="pair" data-edge="{i}">{source} → {target}'
            f"</button></th><td>{error}</td><td>{doubt}{html.escape(_plain(edge.note))}</td></tr>"
        )
    return (
        "<details><summary>List of all matched pairs</summary>"
        '<div class="table" role="region" aria-label="Matched pairs" tabindex="0"><table><thead><tr>'
        '<th scope="col">pair</th><th scope="col">expected error (‰ of √area)</th><th scope="col">note</th>'
        f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div></details>"
    )
