"""Writes interactive pages: fills their HTML templates, and formats tables and lists of facts."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxsmw.report.colors import PLAIN, error_colors, signed_colors
from jaxsmw.report.page_data import encode_bytes, encode_colors
from jaxsmw.report.rendering import ELEVATION
from jaxsmw.runtime.files import atomic_write

# The colours of each scale (n, 3), evenly spaced. The middle colour of a signed scale belongs to zero.
_COLOR_SCALES = {
    "error": error_colors(np.linspace(0, 1, 256), 1.0),
    "signed": signed_colors(np.linspace(-1, 1, 255), 1.0),
    "signed_dark": signed_colors(np.linspace(-1, 1, 255), 1.0, on_dark=True),
}


def write_html(
    path: str | os.PathLike[str], template: str, data: Mapping[str, Any], fragments: Mapping[str, str]
) -> None:
    """Write a page: a template in `report/assets`, filled with the viewer, its data and HTML fragments.

    `data` is represented as JSON, with the colour scales and the elevation of the camera. `fragments` maps
    each placeholder of the template to its HTML. Question marks replace bytes of file names that are not
    valid UTF-8.
    """
    assets = files("jaxsmw.report") / "assets"
    viewer = (assets / "viewer.js").read_text("utf-8")
    shared = {
        "plain": np.round(255 * PLAIN).astype(int).tolist(),
        "scales": {name: encode_colors(colors) for name, colors in _COLOR_SCALES.items()},
        "elevation": ELEVATION,
    }
    parts = {
        **fragments,
        **{f"{name}_gradient": _gradient(colors) for name, colors in _COLOR_SCALES.items()},
        "plain_color": _gradient(PLAIN[None]),
        "style": (assets / "style.css").read_text("utf-8").rstrip(),
        # An unescaped "<" could end the script element or open a comment in it.
        "data": json.dumps({**data, **shared}, ensure_ascii=False).replace("<", "\\u003c"),
        "script": viewer,
        "script_hash": f"sha256-{encode_bytes(hashlib.sha256(viewer.encode()).digest())}",
    }
    # All placeholders are replaced in one pass, because inserted text must not be searched for placeholders.
    page = re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], (assets / template).read_text("utf-8"))
    with atomic_write(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))


def _gradient(colors: Float64[np.ndarray, "n 3"]) -> str:
    """Return up to nine colours of a colour scale, as text for a CSS gradient."""
    stops = np.unique(np.linspace(0, len(colors) - 1, 9).round().astype(int))
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in np.round(255 * colors[stops]).astype(int))


def facts(values: Mapping[str, str]) -> str:
    """Return an HTML list of labels and values, both given as text."""
    rows = (f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in values.items())
    return f"<dl>{''.join(rows)}</dl>"


def table(label: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table with a label for screen readers. Heads are text; the cells of rows are HTML."""
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>'
        for first, *rest in rows
    )
    return (
        f'<div class="table" role="region" aria-label="{label}" tabindex="0"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )
