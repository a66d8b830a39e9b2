"""Correspondences as an interactive web page: a single file that needs no other files and no network."""

from __future__ import annotations

import hashlib
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Float64, Int

from jaxsmw.choices import Axis
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.colors import ERROR_LIMIT, PLAIN, position_colors
from jaxsmw.report.inputs import check_error_limit, check_errors, check_map, describe
from jaxsmw.report.page_data import (
    COLOR_SCALES,
    encode,
    encode_basis,
    encode_bytes,
    encode_colors,
    encode_functional_map,
    encode_mesh,
    spectra_on_page,
)
from jaxsmw.report.rendering import ELEVATION, choose_azimuth
from jaxsmw.report.standing import stand_pair
from jaxsmw.runtime.files import atomic_write

# On narrow screens, bodies that are wider than this multiple of their height are shown one above the other.
_WIDE = 0.65

_EXPLANATIONS = {
    "transfer": (
        "Equal colours mark matched points: every point of the source has the colour of its match on the "
        "target. If the map is good, corresponding parts of the two bodies have the same colours."
    ),
    "wavelets": (
        "A wavelet is a ripple around one point of a surface. Point at a body: if the map is good, the "
        "ripple around that point and the ripple around its match look similar. Red is positive, blue is "
        "negative."
    ),
    "eigenfunctions": (
        "Eigenfunctions are the vibration patterns of a surface, like the tones of a drum. These two "
        "patterns belong to the chosen entry of the functional map. Red is positive, blue is negative."
    ),
    "plain": "The two bodies without colours.",
}
_DISTANCES = (
    "Light means close, dark means far. Distances are fractions of √area, the square root of the target's "
    "surface area: on an adult person 0.1 is about 13 cm."
)


@dataclass(frozen=True, eq=False)
class ShownMap:
    """A map on a page, with its errors, its functional map and its statistics.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `errors`: by name, the error of the match of each vertex of X (m,), as a fraction of sqrt(area of Y);
      NaN where the error is unknown. Each entry adds a mode that shows these errors as colours.
    - `functional_map`: C, shown as a picture; (k_X, k_Y) in the pullback convention, (k_Y, k_X) in the
      pushforward convention. None shows no functional map.
    - `convention`: the convention of C.
    - `statistics`: labels and values, shown in the table that compares all maps of the page.
    """

    pointwise_map: Int[np.ndarray | Array, " m"]
    errors: Mapping[str, Float[np.ndarray | Array, " m"]] = field(default_factory=dict)
    functional_map: Float[np.ndarray | Array, "k_out k_in"] | None = None
    convention: Convention = "pullback"
    statistics: Mapping[str, str] = field(default_factory=dict)


def write_page(
    path: str | os.PathLike[str],
    mesh_x: Mesh,
    mesh_y: Mesh,
    maps: Mapping[str, ShownMap],
    *,
    title: str,
    spectra: tuple[Spectrum, Spectrum] | None = None,
    refiner: WaveletPreservation = WaveletPreservation(),  # noqa: B008 (immutable)
    statistics: Mapping[str, str] = MappingProxyType({}),
    error_meanings: Mapping[str, str] = MappingProxyType({}),
    error_limit: float = ERROR_LIMIT,
    figures: Sequence[tuple[str, bytes]] = (),
    up: Axis | None = None,
) -> None:
    """Writes a web page that shows both bodies in 3D, coloured by a map, and the match under the pointer.

    The page shows one of the maps at a time. If spectra are given, the page also shows the wavelets of a
    refiner's bank,

        psi_{l,y}(x) = sum_i g_l(lambda_i) phi_i(y) phi_i(x),

    on X around the vertex y under the pointer, and on Y around the match of y. If the map preserves wavelets,
    both look similar. The page prints their similarity: the map carries the wavelet on Y to X, and the
    similarity is the cosine of the angle between the result and the wavelet on X.

    **Arguments:**

    - `path`: the HTML file. Any browser with WebGL opens the file from disk. The viewer takes about 0.6 MB.
      Meshes take 50 bytes per vertex, and maps a few bytes per vertex and map. Spectra take 133 bytes per
      vertex, at most 8 MB in total.
    - `mesh_x`, `mesh_y`: source (m vertices) and target (n vertices).
    - `maps`: maps from X to Y by name. The page opens with the first map.
    - `title`: the heading.
    - `spectra`: the spectra of X and Y. The page contains up to
      `jaxsmw.report.page_data.eigenvectors_on_page` eigenvectors, rounded to one byte per number. Wavelets
      are then accurate to about one hundredth.
    - `refiner`: the refiner whose wavelets are shown.
    - `statistics`: labels and values to show below the bodies.
    - `error_meanings`: explanations of errors, one sentence by the name of each error.
    - `error_limit`: the end of the colour scale of errors, in the unit of the errors. The colours of two
      pages are comparable if their limits are equal.
    - `figures`: captions and contents of PNG files, which are shown at the end of the page.
    - `up`: the axis of the files that points up; by default `jaxsmw.report.standing.guess_up`.

    **Raises:** `InputError` if there is no map, if the maps, errors or spectra do not fit the meshes, if the
    limit is not positive, or if the file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to show; give at least one map.")
    check_error_limit(error_limit)
    encoded = [_encode_map(name, shown, mesh_x, mesh_y) for name, shown in maps.items()]
    error_names = list(dict.fromkeys(of for shown in maps.values() for of in shown.errors))
    data = _encode_shapes(*stand_pair(mesh_x, mesh_y, up)) | {
        "maps": encoded,
        "plain": np.round(255 * PLAIN).astype(int).tolist(),
        "scales": {name: encode_colors(colors) for name, colors in COLOR_SCALES.items()},
        "limit": error_limit,
        "error_names": error_names,
    }
    filters = _add_wavelets(data, mesh_x, mesh_y, spectra, refiner)
    modes = _modes(maps, error_names, has_spectra=filters > 0)
    fragments = {
        "title": html.escape(title),
        "source": html.escape(" · ".join(describe(mesh_x))),
        "target": html.escape(" · ".join(describe(mesh_y))),
        "last_vertex": str(len(mesh_x.vertices) - 1),
        "last_filter": str(max(filters - 1, 0)),
        "map_choices": _choices("map", "Map", dict(enumerate(maps))) if len(maps) > 1 else "",
        "mode_choices": _choices("mode", "Show", modes),
        "explanations": _explanations(modes, error_meanings),
        "error_end": f"{error_limit:g} and above",
        "comparison": _comparison(maps),
        "statistics": _statistics(statistics),
        "figures": _figures(figures),
    }
    page = _fill_template(data, fragments)
    with atomic_write(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))


def _encode_shapes(shown_x: Mesh, shown_y: Mesh) -> dict[str, Any]:
    """The data of two upright meshes, and of the camera."""
    reach = np.max(
        [np.ptp(mesh.vertices[mesh.referenced_vertices], axis=0) for mesh in (shown_x, shown_y)], axis=0
    )
    return {
        "x": encode_mesh(shown_x),
        "y": encode_mesh(shown_y),
        "colors": encode_colors(position_colors(shown_y)),
        "azimuth": choose_azimuth([shown_x, shown_y]),
        "elevation": ELEVATION,
        "wide": bool(max(reach[0], reach[2]) > _WIDE * reach[1]),
    }


def _encode_map(name: str, shown: ShownMap, mesh_x: Mesh, mesh_y: Mesh) -> dict[str, Any]:
    """The data of one map."""
    return {
        "name": name,
        "map": encode(check_map(mesh_x, mesh_y, shown.pointwise_map), "<u4"),
        "errors": {of: encode(values, "<f4") for of, values in check_errors(mesh_x, shown.errors).items()},
        "functional": encode_functional_map(shown.functional_map, shown.convention),
    }


def _add_wavelets(
    data: dict[str, Any],
    mesh_x: Mesh,
    mesh_y: Mesh,
    spectra: tuple[Spectrum, Spectrum] | None,
    refiner: WaveletPreservation,
) -> int:
    """Adds eigenvectors and filters to the data of both shapes, and returns the number of filters.

    The number is 0 if the page shows no wavelets.
    """
    cut = None if spectra is None else spectra_on_page(mesh_x, mesh_y, *spectra)
    if cut is None:
        return 0
    wavelets = refiner.problem(*cut)
    data["x"] |= encode_basis(cut[0], wavelets.responses_x)
    data["y"] |= encode_basis(cut[1], wavelets.responses_y)
    return len(wavelets.responses_x)


def _modes(maps: Mapping[str, ShownMap], error_names: Sequence[str], *, has_spectra: bool) -> dict[str, str]:
    """The labels of all modes in which the viewer colours the bodies, by the viewer's names of the modes."""
    modes = {"transfer": "Matching colours"} | {f"error-{i}": name for i, name in enumerate(error_names)}
    if has_spectra:
        modes["wavelets"] = "Wavelets"
        if any(shown.functional_map is not None for shown in maps.values()):
            modes["eigenfunctions"] = "Eigenfunctions"
    return modes | {"plain": "Plain"}


def _fill_template(data: Mapping[str, Any], fragments: Mapping[str, str]) -> str:
    """The page: the template, filled with data, fragments of HTML and the viewer's script."""
    assets = files("jaxsmw.report") / "assets"
    script = (assets / "viewer.js").read_text("utf-8")
    parts = {
        **fragments,
        **{f"{name}_gradient": _gradient(colors) for name, colors in COLOR_SCALES.items()},
        "plain_color": _gradient(PLAIN[None]),
        # A "<" could end the script element or open a comment in it.
        "data": json.dumps(data).replace("<", "\\u003c"),
        "script": script,
        "script_hash": f"sha256-{encode_bytes(hashlib.sha256(script.encode()).digest())}",
    }
    # All placeholders are replaced in one pass, so that inserted text is not searched for placeholders.
    return re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], (assets / "page.html").read_text("utf-8"))


def _gradient(colors: Float64[np.ndarray, "n 3"]) -> str:
    """The colours of a CSS gradient: up to nine colours of a scale."""
    chosen = np.unique(np.linspace(0, len(colors) - 1, 9).round().astype(int))
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in np.round(255 * colors[chosen]).astype(int))


def _choices(name: str, label: str, choices: Mapping[Any, str]) -> str:
    """Radio buttons with the given labels by value. The first button is selected."""
    inputs = "".join(
        f'<label><input type="radio" name="{name}" autocomplete="off" value="{value}"'
        f"{'' if position else ' checked'}><span>{html.escape(text)}</span></label>"
        for position, (value, text) in enumerate(choices.items())
    )
    return (
        f'<div class="choices" role="radiogroup" aria-labelledby="{name}-label">'
        f'<span id="{name}-label">{label}</span><div class="choice">{inputs}</div></div>'
    )


def _explanations(modes: Mapping[str, str], error_meanings: Mapping[str, str]) -> str:
    """One paragraph per mode. The viewer shows the paragraph of the current mode."""
    paragraphs = []
    for mode, label in modes.items():
        text = _EXPLANATIONS.get(mode)
        if text is None:
            text = f"{error_meanings.get(label, f'{label} of every match.')} {_DISTANCES}"
        paragraphs.append(f'<p data-for="{mode}">{html.escape(text)}</p>')
    return "".join(paragraphs)


def _comparison(maps: Mapping[str, ShownMap]) -> str:
    """A table of the maps' statistics, with one row per map and one column per label."""
    labels = dict.fromkeys(label for shown in maps.values() for label in shown.statistics)
    if not labels:
        return ""
    heads = "".join(f'<th scope="col">{html.escape(label)}</th>' for label in labels)
    rows = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th>'
        + "".join(f"<td>{html.escape(shown.statistics.get(label, ''))}</td>" for label in labels)
        + "</tr>"
        for name, shown in maps.items()
    )
    return (
        '<h2>Maps</h2><div class="table" role="region" aria-label="Maps" tabindex="0"><table>'
        f'<thead><tr><th scope="col">map</th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _statistics(statistics: Mapping[str, str]) -> str:
    """Labels and values, with one card per label."""
    if not statistics:
        return ""
    rows = "".join(
        f"<div><dt>{html.escape(label)}</dt><dd>{html.escape(value)}</dd></div>"
        for label, value in statistics.items()
    )
    return f"<h2>Result</h2><dl>{rows}</dl>"


def _figures(figures: Sequence[tuple[str, bytes]]) -> str:
    """PNG pictures with their captions."""
    if not figures:
        return ""
    shown = "".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{encode_bytes(png)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, png in figures
    )
    return f'<h2>Figures</h2><div class="figures">{shown}</div>'
