"""Draws pairs of many kinds whose first map is wrong, with this map and with the map of the search.

    python scripts/draw_search.py DATA_DIRECTORY PICTURE.png [--pairs N] [--seed SEED]

The script draws N pairs of each kind of `scripts/judged_pairs.py`, and matches them with and without the
search. For the first pair of each kind whose map without the search is wrong, the picture shows the target,
the source with the map without the search, and the source with the map of the search. Equal colours match.
Numbers are mean geodesic errors x10^-3, in units of the square root of the target's area.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import make_parser
from draw_documentation import picture_of, save_small
from jaxtyping import Float
from judged_pairs import is_right, known_pairs
from PIL import Image, ImageDraw, ImageFont

from jaxsmw import PRESETS, Mesh, SearchSettings, match
from jaxsmw.report.colors import position_colors
from jaxsmw.report.figures import draw_mesh

BODY, CAPTION, GAP = 150, 34, 10  # in pixels
PAIRS_PER_ROW = 2


def square(mesh: Mesh, colors: Float[np.ndarray, "n 3"]) -> Image.Image:
    """Return the picture of a mesh, which fits into a square."""
    picture = picture_of(draw_mesh(mesh, colors))
    picture.thumbnail((BODY, BODY), Image.Resampling.LANCZOS)
    canvas = Image.new("RGB", (BODY, BODY), "white")
    canvas.paste(picture, ((BODY - picture.width) // 2, (BODY - picture.height) // 2))
    return canvas


def main() -> None:
    parser = make_parser(__doc__, data="DATA_DIRECTORY", pairs=3, seed=True)
    parser.add_argument("picture", metavar="PICTURE.png", type=Path)
    options = parser.parse_args()
    accurate = PRESETS["accurate"]
    presets = replace(accurate, search=SearchSettings(certain=0.0)), accurate
    drawn: dict[str, Image.Image] = {}
    for known in known_pairs(options.data, options.pairs, options.seed):
        if known.kind in drawn:
            continue
        found = []
        for preset in presets:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found.append(match(known.x, known.y, preset=preset, partial=known.partial))
            if is_right(*known.errors(found[0].pointwise_map)):
                break
        else:
            without, searched = (1e3 * known.errors(one.pointwise_map)[0] for one in found)
            words = f"{known.kind}: target, {without:.0f} without the search,\n{searched:.0f} with it "
            words += f"(probability {found[1].probability:.0%})"
            colors = position_colors(known.y)
            panel = Image.new("RGB", (3 * BODY + GAP, BODY + CAPTION), "white")
            shown = ((known.y, colors), *((known.x, colors[one.pointwise_map]) for one in found))
            for place, (mesh, of_mesh) in enumerate(shown):
                panel.paste(square(mesh, of_mesh), (place * BODY, CAPTION))
            ImageDraw.Draw(panel).text((4, 2), words, fill="black", font=ImageFont.load_default(12))
            drawn[known.kind] = panel
            print(*known.names, words.replace("\n", " "), sep=": ", flush=True)
    panels = list(drawn.values())
    width, height = panels[0].size
    rows = -(-len(panels) // PAIRS_PER_ROW)
    sheet = Image.new("RGB", (PAIRS_PER_ROW * width, rows * height), "white")
    for number, panel in enumerate(panels):
        sheet.paste(panel, (number % PAIRS_PER_ROW * width, number // PAIRS_PER_ROW * height))
    save_small(options.picture, sheet)


if __name__ == "__main__":
    main()
