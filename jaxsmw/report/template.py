"""Fills the HTML templates of the interactive pages."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxsmw.report.colors import PLAIN
from jaxsmw.report.page_data import COLOR_SCALES, encode_bytes


def fill_template(template: str, script: str, data: Mapping[str, Any], fragments: Mapping[str, str]) -> str:
    """Return the HTML of a page: a template, filled with the data, the fragments and a script.

    **Arguments:**

    - `template`, `script`: names of files in `report/assets`.
    - `data`: the data of the script. JSON must be able to represent the data.
    - `fragments`: a dictionary from each placeholder of the template to its HTML. Texts in the HTML must be
      escaped.
    """
    assets = files("jaxsmw.report") / "assets"
    code = (assets / script).read_text("utf-8")
    parts = {
        **fragments,
        **{f"{name}_gradient": _gradient(colors) for name, colors in COLOR_SCALES.items()},
        "plain_color": _gradient(PLAIN[None]),
        "style": (assets / "style.css").read_text("utf-8").rstrip(),
        # An unescaped "<" could end the script element or open a comment in it.
        "data": json.dumps(data).replace("<", "\\u003c"),
        "script": code,
        "script_hash": f"sha256-{encode_bytes(hashlib.sha256(code.encode()).digest())}",
    }
    # All placeholders are replaced in one pass, because inserted text must not be searched for placeholders.
    return re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], (assets / template).read_text("utf-8"))


def _gradient(colors: Float64[np.ndarray, "n 3"]) -> str:
    """Return up to nine colours of a colour scale, as text for a CSS gradient."""
    chosen = np.unique(np.linspace(0, len(colors) - 1, 9).round().astype(int))
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in np.round(255 * colors[chosen]).astype(int))
