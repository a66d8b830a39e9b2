"""Correspondences as one interactive web page: a single file that needs nothing else, not even a network."""

from __future__ import annotations

import base64
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
from jaxtyping import Array, Float, Int

from jaxsmw.core.functional_map import Convention
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.pair import common_range
from jaxsmw.report.colors import PLAIN, error_colors, position_colors, signed_colors
from jaxsmw.report.inputs import check_errors, check_functional_map, check_map, describe
from jaxsmw.report.rendering import ELEVATION, Axis, choose_azimuth, stand_pair
from jaxsmw.runtime.files import atomic_write

# Of both shapes together a page holds so many values of eigenvectors, a byte each and a third more in
# base64: as many eigenvectors as the paper has up to 60 000 vertices, and beyond 300 000 none.
_EIGENVECTORS, _FEWEST, _VALUES = 100, 20, 6_000_000
# On a narrow screen bodies wider than this, for their height, are shown larger one above the other.
_WIDE = 0.65


@dataclass(frozen=True, eq=False)
class ShownMap:
    """One of the maps that a page shows, and what is known of it.

    **Attributes:**

    - `pointwise_map`: for every vertex of X a vertex of Y, (m,).
    - `errors`: by name, for every vertex of X the error of its match (m,), as a fraction of sqrt(area of Y);
      NaN where it is not known. Each adds a colouring.
    - `functional_map`: C, to be shown as a picture; (k_X, k_Y) in the pullback convention, (k_Y, k_X) in the
      pushforward.
    - `convention`: which of the two.
    - `statistics`: what to state of this map beside the others, a label and a value each.
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
    error_limit: float | None = None,
    figures: Sequence[tuple[str, bytes]] = (),
    up: Axis | None = None,
) -> None:
    """Write a page with both bodies to turn in 3D, coloured by a map, each point's match under the pointer.

    Of several maps one is shown at a time. With spectra it also shows the wavelets of a refiner's bank,

        psi_{l,y}(x) = sum_i g_l(lambda_i) phi_i(y) phi_i(x),

    on X around the vertex y under the pointer, and on Y around its match: a map that preserves wavelets makes
    both look alike. The cosine of the angle between the one on X and the other carried over by the map says
    how much.

    **Arguments:**

    - `path`: the HTML file. It holds everything it needs and opens from disk in any browser with WebGL: about
      0.6 MB for the viewer, 50 bytes per vertex, a few per vertex and map, and with spectra 133 bytes per
      vertex, of all at most 8 MB.
    - `mesh_x`, `mesh_y`: source (m vertices) and target (n vertices).
    - `maps`: from X to Y, by name; the first is the one shown at first.
    - `title`: the heading.
    - `spectra`: of X and Y. The page shows the eigenvectors it has room for, `eigenvectors_on_page`,
      rounded to a byte for each number, so that wavelets are right within about a hundredth.
    - `refiner`: whose wavelets.
    - `statistics`: what to state below the bodies, a label and a value each.
    - `error_limit`: where the scale of errors ends; by default at the largest 98th percentile of the map
      where that is least.
    - `figures`: captions and PNG files to show at the end.
    - `up`: the axis of the meshes that points up; see `jaxsmw.report.rendering.stand` for the default.

    **Raises:** `InputError` if there is no map, the maps, errors or spectra do not fit the meshes, or the
    file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to show; give at least one.")
    indices = {name: check_map(mesh_x, mesh_y, shown.pointwise_map) for name, shown in maps.items()}
    found = {name: check_errors(mesh_x, shown.errors, error_limit) for name, shown in maps.items()}
    errors = {name: of_map for name, (of_map, _) in found.items()}
    # As for the best of the maps: on the scale of a bad one all others would look the same.
    limit = min((end for of_map, end in found.values() if of_map), default=1.0)
    error_names = list(dict.fromkeys(of for of_map in errors.values() for of in of_map))
    shown_x, shown_y = stand_pair(mesh_x, mesh_y, up)
    reach = np.max([np.ptp(mesh.vertices[mesh.used_vertices], axis=0) for mesh in (shown_x, shown_y)], axis=0)
    data: dict[str, Any] = {
        "x": _encode_mesh(shown_x),
        "y": _encode_mesh(shown_y),
        "maps": [
            {
                "name": name,
                "map": _encode(indices[name], "<u4"),
                "errors": {of: _encode(values, "<f4") for of, values in errors[name].items()},
                "functional": _encode_functional_map(shown),
            }
            for name, shown in maps.items()
        ],
        "colors": _encode_colors(position_colors(shown_y)),
        "plain": np.round(255 * PLAIN).astype(int).tolist(),
        "scales": {name: _encode_colors(colors) for name, colors in _SCALES.items()},
        "limit": limit,
        "error_names": error_names,
        "azimuth": choose_azimuth([shown_x, shown_y]),
        "elevation": ELEVATION,
        "wide": bool(max(reach[0], reach[2]) > _WIDE * reach[1]),
    }
    filters = 0
    if spectra is not None and (cut := _cut(mesh_x, mesh_y, *spectra)):
        wavelets = refiner.problem(*cut)
        filters = len(wavelets.responses_x)
        for side, spectrum, responses in zip(
            "xy", cut, (wavelets.responses_x, wavelets.responses_y), strict=True
        ):
            data[side] |= {
                "eigenvectors": _encode_rounded(np.asarray(spectrum.eigenvectors).T),
                "responses": _encode(np.asarray(responses), "<f4"),
            }

    assets = files("jaxsmw.report") / "assets"
    script = (assets / "viewer.js").read_text("utf-8")
    beyond = any(np.any(values > limit) for of_map in errors.values() for values in of_map.values())
    colorings = {"transfer": "Colour transfer"} | {f"error-{i}": of for i, of in enumerate(error_names)}
    colorings |= {"wavelets": "Wavelets"} if filters else {}
    parts = {
        "title": html.escape(title),
        "source": html.escape(" · ".join(describe(mesh_x))),
        "target": html.escape(" · ".join(describe(mesh_y))),
        "last_vertex": str(len(mesh_x.vertices) - 1),
        "last_filter": str(max(filters - 1, 0)),
        "map_choices": _choices("map", "Map", dict(enumerate(maps))) if len(maps) > 1 else "",
        "coloring_choices": _choices("coloring", "Colours", colorings | {"plain": "Plain"}),
        **{f"{name}_gradient": _gradient(colors) for name, colors in _SCALES.items()},
        "error_end": f"{'≥ ' if beyond else ''}{limit:.3g} √area",
        "comparison": _comparison(maps),
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


def eigenvectors_on_page(mesh_x: Mesh, mesh_y: Mesh) -> int:
    """How many eigenvectors of two meshes a page has room for: 100, less for large ones, 0 for very large."""
    room = _VALUES // (len(mesh_x.vertices) + len(mesh_y.vertices))
    return min(_EIGENVECTORS, room) if room >= _FEWEST else 0


def _cut(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Spectrum, Spectrum] | None:
    """What the page shows of spectra; None if it has no room for them."""
    for mesh, spectrum in ((mesh_x, spectrum_x), (mesh_y, spectrum_y)):
        if len(spectrum.eigenvectors) != len(mesh.vertices):
            raise InputError(
                f"the spectrum of {mesh.name} is one of {len(spectrum.eigenvectors)} vertices, but it has "
                f"{len(mesh.vertices)}."
            )
    if not (room := eigenvectors_on_page(mesh_x, mesh_y)):
        return None
    cut = spectrum_x.truncate(room), spectrum_y.truncate(room)
    # Of a part and the whole fewer eigenvectors of the part reach as far.
    return cut if len(spectrum_x.eigenvalues) == len(spectrum_y.eigenvalues) else common_range(*cut)


# Colours at even steps between the ends of a scale; the middle one of a signed scale is that of zero.
_SCALES = {
    "error": error_colors(np.linspace(0, 1, 256), 1.0),
    "signed": signed_colors(np.linspace(-1, 1, 255), 1.0),
    "signed_dark": signed_colors(np.linspace(-1, 1, 255), 1.0, on_dark=True),
}


def _gradient(colors: np.ndarray) -> str:
    stops = np.round(255 * colors[np.linspace(0, len(colors) - 1, 9).round().astype(int)]).astype(int)
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in stops)


def _encode_bytes(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _encode(array: np.ndarray, dtype: str) -> str:
    return _encode_bytes(array.astype(dtype).tobytes())


def _encode_mesh(mesh: Mesh) -> dict[str, Any]:
    return {"vertices": _encode(mesh.vertices, "<f4"), "faces": _encode(mesh.faces, "<u4")}


def _encode_colors(colors: np.ndarray) -> str:
    return _encode(np.round(255 * colors), "u1")


def _encode_rounded(rows: np.ndarray) -> dict[str, str]:
    """A byte for each number, and for each row a unit: a code c says sign(c) c² units.

    So levels are the finer the smaller a number is. The eigenvectors of limbs are large on these and small
    elsewhere; even levels would give wavelets elsewhere false spots there. Rounded like this they are off by
    half a hundredth of the colour scale (root mean square, on people and animals), as with even levels of 10
    bits.
    """
    units = np.maximum(np.abs(rows).max(axis=1), np.finfo(np.float32).tiny) / 127**2
    codes = np.sign(rows) * np.round(np.sqrt(np.abs(rows) / units[:, None]))
    return {"codes": _encode(codes, "i1"), "units": _encode(units, "<f4")}


def _encode_functional_map(shown: ShownMap) -> dict[str, Any] | None:
    if shown.functional_map is None:
        return None
    matrix = check_functional_map(shown.functional_map)
    return {
        "values": _encode(matrix, "<f4"),
        "columns": matrix.shape[1],
        "pushforward": shown.convention == "pushforward",
    }


def _choices(name: str, label: str, choices: Mapping[Any, str]) -> str:
    """Radio buttons by value, the first of them chosen."""
    inputs = "".join(
        f'<label><input type="radio" name="{name}" value="{value}"{"" if position else " checked"}>'
        f"<span>{html.escape(text)}</span></label>"
        for position, (value, text) in enumerate(choices.items())
    )
    return f'<fieldset class="choice"><legend>{label}</legend>{inputs}</fieldset>'


def _comparison(maps: Mapping[str, ShownMap]) -> str:
    """A table of what is stated of each map; a row for each."""
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
