"""Draws the errors of several pairs before and after a change of the code, side by side.

For each pair, the picture shows the source coloured by the errors before, the source coloured by the errors
after, and the target. The two directories contain one map per pair. The map of the pair "a b" is the file
`a__b.npy`, which `jaxsmw match a.off b.off --output a__b.npy` writes. Run

    python scripts/draw_before_after.py DATA_DIRECTORY/smal_r PAIRS.txt BEFORE AFTER PICTURE.png
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import make_parser
from draw_documentation import picture_of, save_small
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import KDTree

import jaxsmw
from jaxsmw import geodesic_error, read_mesh
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.choices import Axis
from jaxsmw.io.maps import read_pointwise_map
from jaxsmw.report.colors import ERROR_LIMIT, error_colors
from jaxsmw.report.figures import draw_mesh

BODY, CAPTION, GAP = 150, 34, 10  # in pixels
PAIRS_PER_ROW = 2
# Errors are measured at this number of vertices. All other vertices have the error of the nearest one.
MEASURED = 1500


def body(
    mesh: jaxsmw.Mesh, colors: Float[np.ndarray, "n 3"] | None, up: Axis | None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture of a body, which fits into a square."""
    picture = picture_of(draw_mesh(mesh, colors, up=up))
    picture.thumbnail((BODY, BODY), Image.Resampling.LANCZOS)
    square = Image.new("RGB", (BODY, BODY), "white")
    square.paste(picture, ((BODY - picture.width) // 2, (BODY - picture.height) // 2))
    return np.asarray(square)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("data_set", metavar="DATA_SET_DIRECTORY", type=Path)
    parser.add_argument("pairs", metavar="PAIRS.txt", help="a list of pairs, one pair per line")
    parser.add_argument("before", metavar="BEFORE", type=Path, help="directory of maps")
    parser.add_argument("after", metavar="AFTER", type=Path, help="directory of maps")
    parser.add_argument("picture", metavar="PICTURE.png", type=Path)
    parser.add_argument("--up", help="the axis that points up, such as y (default: guessed for each mesh)")
    options = parser.parse_args()
    panels = []
    for pair in choose_pairs(open_data_set(options.data_set), options.pairs, 0):
        source, target = (read_mesh(file) for file in pair.meshes)
        truth = pair.ground_truth(source, target)
        pictures, errors = [], []
        for directory in (options.before, options.after):
            pointwise_map = read_pointwise_map(directory / f"{'__'.join(pair.names)}.npy", source, target)
            error = geodesic_error(target, pointwise_map, truth, number_of_samples=MEASURED)
            errors.append(1e3 * error.mean)
            _, nearest = KDTree(source.vertices[error.source_vertices]).query(source.vertices)
            pictures.append(body(source, error_colors(error.errors[nearest], ERROR_LIMIT), options.up))
        panel = Image.new("RGB", (3 * BODY + GAP, BODY + CAPTION), "white")
        panel.paste(Image.fromarray(np.hstack([*pictures, body(target, None, options.up)])), (0, CAPTION))
        words = f"{pair.name}\nbefore: {errors[0]:.0f}, after: {errors[1]:.0f}, target"
        ImageDraw.Draw(panel).text((4, 2), words, fill="black", font=ImageFont.load_default(12))
        panels.append(panel)
        print(words.replace("\n", ": "), flush=True)
    width, height = panels[0].size
    rows = -(-len(panels) // PAIRS_PER_ROW)
    sheet = Image.new("RGB", (PAIRS_PER_ROW * width, rows * height), "white")
    for number, panel in enumerate(panels):
        sheet.paste(panel, (number % PAIRS_PER_ROW * width, number // PAIRS_PER_ROW * height))
    save_small(options.picture, sheet)


if __name__ == "__main__":
    main()
