"""An interactive web page that shows correspondences. The page is one file and needs no network."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsmw.choices import Axis
from jaxsmw.core.arrays import Array
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError, check_number
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import check_pointwise_map
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.report.colors import ERROR_LIMIT, position_colors
from jaxsmw.report.inputs import check_errors
from jaxsmw.report.page_data import (
    encode,
    encode_basis,
    encode_bytes,
    encode_colors,
    encode_functional_map,
    encode_registered,
    encode_shape,
    spectra_on_page,
)
from jaxsmw.report.rendering import choose_azimuth
from jaxsmw.report.standing import stand_pair, visible
from jaxsmw.report.template import facts, table, write_html
from jaxsmw.wording import short_names

# If the bodies are wider than this multiple of their height, narrow screens show one body above the other.
_WIDE = 0.65

EXPECTED_ERROR = "Expected error"
"""The key in `ShownMap.errors` of the errors from which the page suggests places for landmarks."""

_EXPLANATIONS = {
    "transfer": (
        "Equal colours mark matched points: every point of the source has the colour of its match on the "
        "target. If the map is good, corresponding parts of the two bodies have the same colours."
    ),
    "wavelets": (
        "A wavelet is a ripple around one point of a surface. Point at a body: if the map is good, the "
        "ripple around that point and the ripple around its match look similar. Positive values are red, and "
        "negative values are blue."
    ),
    "eigenfunctions": (
        "Eigenfunctions are the vibration patterns of a surface, like the tones of a drum. These two "
        "patterns belong to the chosen entry of the functional map. Positive values are red, and negative "
        "values are blue."
    ),
    "plain": "The two bodies are shown without colours.",
}
_DISTANCES = (
    "Light colours mark small distances, and dark colours mark large distances. Distances are fractions of "
    "√area, the square root of the target's surface area. On an adult person, 0.1 is about 13 cm."
)


@dataclass(frozen=True, eq=False)
class ShownMap:
    """A map on a page, with its errors, its functional map and its statistics.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y.
    - `errors`: a dictionary from the name of each kind of error to an array (m,). The array contains the
      error of each match as a fraction of sqrt(area of Y), or NaN where the error is unknown.
    - `functional_map`: the functional map C, (k_X, k_Y) in the pullback convention and (k_Y, k_X) in the
      pushforward convention, or None.
    - `convention`: the convention of C, `"pullback"` or `"pushforward"`.
    - `statistics`: a dictionary from labels to values as text, for a table with one row per map.
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
    notes: Sequence[str] = (),
    spectra: tuple[Spectrum, Spectrum] | None = None,
    refiner: WaveletPreservation = WaveletPreservation(),  # noqa: B008 (immutable)
    statistics: Mapping[str, str] = MappingProxyType({}),
    error_meanings: Mapping[str, str] = MappingProxyType({}),
    error_limit: float = ERROR_LIMIT,
    figures: Sequence[tuple[str, bytes]] = (),
    up: Axis | None = None,
    registered: Float[np.ndarray, "m 3"] | None = None,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
    overlap: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None = None,
) -> None:
    """Write a web page that shows both bodies in 3D and colours them by one map at a time.

    On the page, a user can see the match of the point under the pointer, place landmarks, and load and save
    landmark files in the coordinates of the mesh files. If spectra are given, the page can show the wavelets
    of a refiner's filter bank. The wavelet of scale l around a vertex y is the function

        psi_{l,y}(x) = sum_i g_l(lambda_i) phi_i(y) phi_i(x),

    where g_l is the filter of scale l, and lambda_i and phi_i are the eigenvalues and eigenvectors of the
    shape. The page shows the wavelet on X around the vertex under the pointer, the wavelet on Y around the
    match of this vertex, and their similarity: the cosine of the angle between the two wavelets, after the
    map has transferred the wavelet on Y to X. If the map preserves wavelets, they look similar.

    **Arguments:**

    - `path`: the HTML file. Any browser with WebGL opens the file from disk. The viewer takes about 0.6 MB of
      the file, and the meshes take 50 bytes per vertex. The spectra take 133 bytes per vertex, but at most 8
      MB in total.
    - `mesh_x`, `mesh_y`: source (m vertices) and target (n vertices), each a `Mesh` in any unit of length.
    - `maps`: a dictionary from the name of each map to a `ShownMap`. The page opens with the first map.
    - `title`: the heading of the page.
    - `notes`: sentences below the heading.
    - `spectra`: a pair with the `Spectrum` of X and of Y; None (the default) for a page without wavelets.
      `jaxsmw.report.page_data.eigenvectors_on_page` limits the number of eigenvectors on the page.
    - `refiner`: a `WaveletPreservation` refiner, whose filter bank defines the wavelets.
    - `statistics`: a dictionary from labels to values as text, which the page shows below the bodies.
    - `error_meanings`: a sentence on the page about each kind of error in `ShownMap.errors`, by its name.
    - `error_limit`: the error at which the colour scale ends, as a fraction of sqrt(area of Y). The colours
      of two pages are comparable if their limits are equal.
    - `figures`: the figures at the end of the page, each a pair of a caption and the bytes of a PNG file.
    - `up`: the axis of the mesh files that points up, such as `"y"` or `"-z"`; by default guessed from each
      mesh (`jaxsmw.report.standing.guess_up`).
    - `registered`: the positions of X's vertices on Y (m, 3), in the coordinates of Y's file. With them, the
      page can draw X on top of Y, and a slider deforms X from its own shape to these positions.
    - `landmarks`: a pair of `Landmarks`, on X and on Y, with which the page opens, in the coordinates of the
      mesh files. Landmarks of the same name correspond.
    - `overlap`: masks of X (m,) and of Y (n,), False for vertices without a counterpart, which are grey. By
      default, all vertices have colours.

    **Raises:** `InputError` if there is no map, or if the maps, errors, spectra or registered positions do
    not fit the meshes. `InputError` is also raised if a functional map is not a matrix of finite numbers, the
    limit is not positive, `up` is not an axis, or the file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to show; give at least one map.")
    check_number("error_limit", error_limit, positive=True)
    encoded = [_encode_map(name, shown, mesh_x, mesh_y) for name, shown in maps.items()]
    error_names = list(dict.fromkeys(of for shown in maps.values() for of in shown.errors))
    first = check_pointwise_map(next(iter(maps.values())).pointwise_map, mesh_x, mesh_y)
    shown_x, shown_y = stand_pair(mesh_x, mesh_y, up, first)
    name_x, name_y = short_names([mesh_x.name, mesh_y.name])
    extent = np.max([np.ptp(visible(mesh), axis=0) for mesh in (shown_x, shown_y)], axis=0)
    data = {
        "x": encode_shape(name_x, mesh_x, shown_x),
        "y": encode_shape(name_y, mesh_y, shown_y),
        "maps": encoded,
        "colors": encode_colors(position_colors(shown_y)),
        "azimuth": choose_azimuth([shown_x, shown_y]),
        "wide": bool(max(extent[0], extent[2]) > _WIDE * extent[1]),
        "limit": error_limit,
        "error_names": error_names,
        "expected": EXPECTED_ERROR,
    }
    if registered is not None:
        data["registered"] = encode_registered(registered, mesh_x, mesh_y, shown_y)
    if overlap is not None:
        data["alone"] = {side: encode(~mask, "u1") for side, mask in zip("xy", overlap, strict=True)}
    if landmarks is not None:
        data["landmarks"] = dict(zip("xy", map(_encode_landmarks, landmarks), strict=True))
    filters = _add_wavelets(data, mesh_x, mesh_y, spectra, refiner)
    modes = _modes(maps, error_names, has_spectra=filters > 0)
    fragments = {
        "title": escape(title),
        "notes": "".join(f'<p class="fault">{escape(note)}</p>' for note in notes),
        "source": escape(f"{name_x} · {len(mesh_x.vertices)} vertices"),
        "target": escape(f"{name_y} · {len(mesh_y.vertices)} vertices"),
        "last_vertex": str(len(mesh_x.vertices) - 1),
        "last_filter": str(max(filters - 1, 0)),
        "map_choices": _choices("map", "Map", dict(enumerate(maps))) if len(maps) > 1 else "",
        "mode_choices": _choices("mode", "Show", modes),
        "explanations": _explanations(modes, error_meanings, has_parts=overlap is not None),
        "error_end": f"{error_limit:g} and above",
        "comparison": _comparison(maps),
        "statistics": f"<h2>Result</h2>{facts(statistics)}" if statistics else "",
        "figures": _figures(figures),
    }
    write_html(path, "page.html", data, fragments)


def _encode_landmarks(landmarks: Landmarks) -> dict[str, Any]:
    return {
        "file": os.path.basename(landmarks.name),
        "names": list(landmarks.names),
        "positions": landmarks.positions.tolist(),
        "system": landmarks.coordinates,
    }


def _encode_map(name: str, shown: ShownMap, mesh_x: Mesh, mesh_y: Mesh) -> dict[str, Any]:
    """Return the data that the viewer needs to show one map."""
    return {
        "name": name,
        "map": encode(check_pointwise_map(shown.pointwise_map, mesh_x, mesh_y), "<u4"),
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
    """Add eigenvectors and filters to the data of both shapes. Return the number of filters."""
    cut = None if spectra is None else spectra_on_page(mesh_x, mesh_y, *spectra)
    if cut is None:
        return 0
    wavelets = refiner.problem(*cut)
    data["x"] |= encode_basis(cut[0], wavelets.responses_x)
    data["y"] |= encode_basis(cut[1], wavelets.responses_y)
    return len(wavelets.responses_x)


def _modes(maps: Mapping[str, ShownMap], error_names: Sequence[str], *, has_spectra: bool) -> dict[str, str]:
    """Return a dictionary from the name of each mode of the viewer to the label of the mode on the page."""
    modes = {"transfer": "Matching colours"} | {f"error-{i}": name for i, name in enumerate(error_names)}
    if has_spectra:
        modes["wavelets"] = "Wavelets"
        if any(shown.functional_map is not None for shown in maps.values()):
            modes["eigenfunctions"] = "Eigenfunctions"
    return modes | {"plain": "Plain"}


def _choices(name: str, label: str, choices: Mapping[Any, str]) -> str:
    """Return the HTML of radio buttons from the values and labels in `choices`. The first is selected."""
    inputs = "".join(
        f'<label><input type="radio" name="{name}" autocomplete="off" value="{value}"'
        f"{'' if position else ' checked'}><span>{escape(text)}</span></label>"
        for position, (value, text) in enumerate(choices.items())
    )
    return (
        f'<div class="choices" role="radiogroup" aria-labelledby="{name}-label">'
        f'<span id="{name}-label">{label}</span><div class="choice">{inputs}</div></div>'
    )


def _explanations(modes: Mapping[str, str], error_meanings: Mapping[str, str], *, has_parts: bool) -> str:
    """Return the HTML of one paragraph per mode. The viewer shows the paragraph of the current mode."""
    paragraphs = []
    for mode, label in modes.items():
        text = _EXPLANATIONS.get(mode)
        if text is None:
            text = f"{error_meanings.get(label, f'{label} of every match.')} {_DISTANCES}"
        if mode == "transfer" and has_parts:
            text += " Grey points probably have no counterpart on the other body."
        paragraphs.append(f'<p data-for="{mode}">{escape(text)}</p>')
    return "".join(paragraphs)


def _comparison(maps: Mapping[str, ShownMap]) -> str:
    """Return the HTML table of the maps' statistics, with one row per map and one column per label."""
    labels = dict.fromkeys(label for shown in maps.values() for label in shown.statistics)
    if not labels:
        return ""
    rows = [
        [escape(name), *(escape(shown.statistics.get(label, "")) for label in labels)]
        for name, shown in maps.items()
    ]
    return f"<h2>Maps</h2>{table('Maps', ('map', *labels), rows)}"


def _figures(figures: Sequence[tuple[str, bytes]]) -> str:
    """Return the HTML of PNG pictures with their captions."""
    if not figures:
        return ""
    shown = "".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{encode_bytes(png)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, png in figures
    )
    return f'<h2>Figures</h2><div class="figures">{shown}</div>'
