"""A correspondence as one interactive web page: a single file that needs nothing else, not even a network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType

import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmw.files import atomic_write
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import PLAIN, error_colors, position_colors
from jaxsmw.report.inputs import check_errors, check_map, describe
from jaxsmw.report.rendering import ELEVATION, Axis, choose_azimuth, stand_pair


def write_page(
    path: str | os.PathLike[str],
    mesh_x: Mesh,
    mesh_y: Mesh,
    pointwise_map: Int[np.ndarray | Array, " m"],
    *,
    title: str,
    statistics: Mapping[str, str] = MappingProxyType({}),
    errors: Mapping[str, Float[np.ndarray | Array, " m"]] = MappingProxyType({}),
    error_limit: float | None = None,
    figures: Sequence[tuple[str, bytes]] = (),
    up: Axis | None = None,
) -> None:
    """Write a page with both bodies to turn in 3D, coloured by the map, each point's match under the pointer.

    **Arguments:**

    - `path`: the HTML file. It holds everything it needs and opens from disk in any browser with WebGL: about
      0.6 MB for the viewer and 50 bytes per vertex.
    - `mesh_x`, `mesh_y`: source (m vertices) and target (n vertices).
    - `pointwise_map`: for every vertex of X a vertex of Y.
    - `title`: the heading.
    - `statistics`: what to state below the bodies, a label and a value each.
    - `errors`: by name, for every vertex of X the error of its match, as a fraction of sqrt(area of Y); NaN
      where it is not known. Each adds a colouring.
    - `error_limit`: where the scale of errors ends; by default at the largest 98th percentile.
    - `figures`: captions and PNG files to show at the end.
    - `up`: the axis of the meshes that points up; see `jaxsmw.report.rendering.stand` for the default.

    **Raises:** `InputError` if the map or the errors do not fit the meshes, or the file cannot be written.
    """
    indices = check_map(mesh_x, mesh_y, pointwise_map)
    shown_x, shown_y = stand_pair(mesh_x, mesh_y, up)
    reach = np.max([np.ptp(mesh.vertices[mesh.used_vertices], axis=0) for mesh in (shown_x, shown_y)], axis=0)
    data = {
        "x": _encode_mesh(shown_x),
        "y": _encode_mesh(shown_y),
        "map": _encode(indices, "<u4"),
        "colors": _encode_colors(position_colors(shown_y)),
        "plain": np.round(255 * PLAIN).astype(int).tolist(),
        "azimuth": choose_azimuth([shown_x, shown_y]),
        "elevation": ELEVATION,
        "wide": bool(max(reach[0], reach[2]) > reach[1]),
    }
    error_choices, scale_end = "", ""
    if errors:
        checked, limit = check_errors(mesh_x, errors, error_limit)
        data["errors"] = [
            {
                "name": name,
                "values": _encode(values, "<f4"),
                "colors": _encode_colors(error_colors(values, limit)),
            }
            for name, values in checked.items()
        ]
        scale_end = f"{'≥ ' if any(np.any(v > limit) for v in checked.values()) else ''}{limit:.3g} √area"
        error_choices = "".join(
            f'<label><input type="radio" name="coloring" value="error-{number}">{html.escape(name)}</label>'
            for number, name in enumerate(checked)
        )

    assets = files("jaxsmw.report") / "assets"
    script = (assets / "viewer.js").read_text("utf-8")
    parts = {
        "title": html.escape(title),
        "source": html.escape(" · ".join(describe(mesh_x))),
        "target": html.escape(" · ".join(describe(mesh_y))),
        "last_vertex": str(len(indices) - 1),
        "error_choices": error_choices,
        "scale_colors": ", ".join(
            f"rgb({r} {g} {b})"
            for r, g, b in np.round(255 * error_colors(np.linspace(0, 1, 9), 1.0)).astype(int)
        ),
        "scale_end": scale_end,
        "statistics": _statistics(statistics),
        "figures": _figures(figures),
        # "<" could end the script element or open a comment in it.
        "data": json.dumps(data).replace("<", "\\u003c"),
        "script": script,
        "script_hash": f"sha256-{_encode_bytes(hashlib.sha256(script.encode()).digest())}",
    }
    # All at once, so that no part is searched for the marks of another.
    page = re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], (assets / "page.html").read_text("utf-8"))
    with atomic_write(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))


def _encode_bytes(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _encode(array: np.ndarray, dtype: str) -> str:
    return _encode_bytes(array.astype(dtype).tobytes())


def _encode_mesh(mesh: Mesh) -> dict[str, str]:
    return {"vertices": _encode(mesh.vertices, "<f4"), "faces": _encode(mesh.faces, "<u4")}


def _encode_colors(colors: np.ndarray) -> str:
    return _encode(np.round(255 * colors), "u1")


def _statistics(statistics: Mapping[str, str]) -> str:
    if not statistics:
        return ""
    rows = "".join(
        f"<div><dt>{html.escape(label)}</dt><dd>{html.escape(value)}</dd></div>"
        for label, value in statistics.items()
    )
    return f"<h2>Result</h2><dl>{rows}</dl>"


def _figures(figures: Sequence[tuple[str, bytes]]) -> str:
    if not figures:
        return ""
    shown = "".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{_encode_bytes(png)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, png in figures
    )
    return f'<h2>Figures</h2><div class="figures">{shown}</div>'
