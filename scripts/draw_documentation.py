"""Draws the pictures of the documentation, and prints the table of failures.

    pip install -e ".[report]"
    python scripts/draw_documentation.py [DATA_DIRECTORY]

The script runs the code of the tutorial to draw the tutorial's pictures. The failure cases use procedural
shapes. With a DATA_DIRECTORY (see docs/datasets.md), the script adds two failure cases with real shapes.
The first case is a pair of SHREC'16 topology (`shrec16_topology`). The second case is a non-isometric pair of
TOSCA (`tosca_nonisometric`). The script takes several minutes.
"""

import io
import os
import re
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import igl
import numpy as np
from common import make_parser
from jaxtyping import Float
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.transform import Rotation

import jaxsmw
from jaxsmw.choices import Axis
from jaxsmw.collection import asymmetry, mirror_points
from jaxsmw.creature import creature
from jaxsmw.report.colors import position_colors
from jaxsmw.report.figures import draw_correspondence, draw_mesh, draw_values
from jaxsmw.runtime.files import atomic_write

DOCS = Path(__file__).resolve().parents[1] / "docs"
PICTURES = DOCS / "pictures"
# A palette of 256 dithered colours suffices for smoothly coloured bodies. With this palette, the files are a
# third as large as with full colour.
COLORS = 256


class Case(NamedTuple):
    """A pair of meshes that `jaxsmw.match` does not match correctly with the options `failing`.

    With the options `cure`, if there are any, the match succeeds. `up` is the vertical axis of both shapes.
    """

    name: str
    source: jaxsmw.Mesh
    target: jaxsmw.Mesh
    truth: jaxsmw.evaluation.GroundTruth
    failing: dict[str, Any]
    cure: dict[str, Any] | None
    up: Axis | None = "y"


def procedural_cases() -> Iterator[Case]:
    """Yield the failure cases with procedural shapes, which need no data set."""
    pair = jaxsmw.creature_pair("quadruped", vertices=3000)
    truth = jaxsmw.evaluation.GroundTruth.of_all_vertices(pair.truth)
    yield Case("swapped_limbs", pair.source, pair.target, truth, {"init": "wks"}, {"init": "shot"})

    (source, at_source), (target, at_target) = star(3000, 0), star(2900, 1)
    truth = jaxsmw.evaluation.GroundTruth.of_all_vertices(
        KDTree(at_target).query(at_source)[1].astype(np.int64)
    )
    yield Case("symmetric", source, target, truth, {}, {"init": landmarks_on_arms(at_source, at_target)}, "z")

    part, truth = front_of(pair)
    yield Case("part", part, pair.target, truth, {}, {"partial": True})

    fine = jaxsmw.creature_pair("quadruped", vertices=4000)
    coarse, truth = coarser(fine, 1000)
    yield Case("coarse", fine.source, coarse, truth, {}, {"preset": "accurate"})


def real_cases(data: Path) -> Iterator[Case]:
    """Yield the failure cases with real shapes."""
    for name, directory, names, cure in (
        ("glued", "shrec16_topology", ("kid15", "kid00"), {"preset": "accurate"}),
        ("different_kinds", "tosca_nonisometric", ("8_gorilla_03", "8_woman_04"), {"preset": "accurate"}),
    ):
        (pair,) = (
            pair for pair in jaxsmw.benchmark.open_data_set(data / directory).pairs if pair.names == names
        )
        source, target = jaxsmw.read_mesh(pair.source_file), jaxsmw.read_mesh(pair.target_file)
        yield Case(name, source, target, pair.ground_truth(source, target), {}, cure, None)


def star(vertices: int, seed: int) -> tuple[jaxsmw.Mesh, Float[np.ndarray, "n 3"]]:
    """Deform a sphere into a body with five equal arms. Return the body, and the vertices of the sphere."""
    index = np.arange(vertices) + 0.5
    polar, turn = np.arccos(1 - 2 * index / vertices), np.pi * (1 + 5**0.5) * index
    sphere = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    random = np.random.default_rng(seed)
    sphere = random.permutation(Rotation.from_quat(random.normal(size=4)).apply(sphere))
    angles = 2 * np.pi * np.arange(5) / 5
    arms = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    positions = sphere * (0.4 + 1.2 * np.exp(12 * (sphere @ arms.T - 1)).sum(axis=1, keepdims=True))
    positions[:, 2] -= 0.3 * (positions[:, :2] ** 2).sum(axis=1)
    faces = ConvexHull(sphere).simplices.astype(np.int64)
    inside_out = np.linalg.det(sphere[faces]) < 0
    faces[inside_out] = faces[inside_out][:, ::-1]
    return jaxsmw.make_mesh(positions, faces, name="star"), sphere


def landmarks_on_arms(
    at_source: Float[np.ndarray, "m 3"], at_target: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "2 2"]:
    """Return the tips of two neighbouring arms as landmarks."""
    tips = np.array([[1, 0, 0], [np.cos(2 * np.pi / 5), np.sin(2 * np.pi / 5), 0]])
    return np.stack([KDTree(points).query(tips)[1] for points in (at_source, at_target)], axis=1)


def front_of(pair: jaxsmw.creature.CreaturePair) -> tuple[jaxsmw.Mesh, jaxsmw.evaluation.GroundTruth]:
    """Return the front part of the source as a separate mesh, and the ground truth of this mesh."""
    full, ahead = pair.source, pair.source.vertices[:, 2]
    faces = full.faces[(ahead[full.faces] > np.quantile(ahead, 0.45)).all(axis=1)]
    used, numbers = np.unique(faces, return_inverse=True)
    truth = jaxsmw.geometry.SurfacePoints(pair.truth.faces[used], pair.truth.weights[used])
    part = jaxsmw.make_mesh(full.vertices[used], numbers.reshape(-1, 3), name=f"front of {full.name}")
    return part, jaxsmw.evaluation.GroundTruth.of_all_vertices(truth)


def coarser(
    pair: jaxsmw.creature.CreaturePair, vertices: int
) -> tuple[jaxsmw.Mesh, jaxsmw.evaluation.GroundTruth]:
    """Return a decimated target and its ground truth.

    Each true match is replaced by the nearest vertex of the decimated target.
    """
    positions, faces, *_ = igl.decimate(pair.target.vertices, pair.target.faces, 2 * vertices)
    coarse = jaxsmw.make_mesh(positions, faces, name=f"{pair.target.name}, coarser")
    nearest = KDTree(positions).query(pair.truth.positions(pair.target))[1]
    return coarse, jaxsmw.evaluation.GroundTruth.of_all_vertices(nearest.astype(np.int64))


def draw_case(case: Case) -> str:
    """Write the picture of a failure case, and return the table row of this case."""
    cells = []
    for settings in (case.failing, case.cure):
        if settings is None:
            cells += ["", ""]
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = jaxsmw.match(case.source, case.target, **{"preset": "paper"} | settings)
        for warning in caught:
            print(f"{case.name}, {settings}: {warning.message}")
        error = jaxsmw.geodesic_error(case.target, result.pointwise_map, case.truth)
        expected = result.expected_error()
        cells += [f"{error.mean:.3f}", f"{case.source.average(expected):.3f}"]
        if settings is case.failing:
            # A vertex without ground truth is drawn with the error of the nearest vertex with ground truth.
            measured = KDTree(case.source.vertices[error.source_vertices])
            errors = error.errors[measured.query(case.source.vertices)[1]]
            panels = {"Error": errors, "Expected error": expected}
            figure = draw_correspondence(
                case.source, case.target, result.pointwise_map, errors=panels, up=case.up
            )
            save_small(PICTURES / f"failure_{case.name}.png", picture_of(figure))
    return f"| {case.name} | {' | '.join(cells)} |"


def picture_of(figure: Figure) -> Image.Image:
    """Return a figure as an image."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    return Image.open(buffer).convert("RGB")


def save_small(path: Path, image: Image.Image) -> None:
    """Write an image as a PNG at most 1200 pixels wide, with few colours."""
    if image.width > 1200:
        image = image.resize((1200, round(image.height * 1200 / image.width)), Image.Resampling.LANCZOS)
    few = image.quantize(palette=image.quantize(COLORS), dither=Image.Dither.FLOYDSTEINBERG)
    palette = np.array(few.getpalette()).reshape(-1, 3)
    palette[(palette >= 248).all(axis=1)] = 255  # keep the background purely white
    few.putpalette(palette.ravel().tolist())
    with atomic_write(path) as temporary:
        few.save(temporary, format="png", optimize=True)


def draw_tutorial() -> None:
    """Run the code of the tutorial, and save the pictures that the tutorial shows."""
    page = (DOCS / "tutorial.md").read_text("utf-8")
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL))
    previous_directory = Path.cwd()
    with tempfile.TemporaryDirectory() as directory:
        os.chdir(directory)
        try:
            exec(compile(code, "docs/tutorial.md", "exec"), {})
        finally:
            os.chdir(previous_directory)
        for name in re.findall(r"\]\(pictures/(\w+\.png)\)", page):
            save_small(PICTURES / name, Image.open(Path(directory) / name).convert("RGB"))


def draw_transfers() -> None:
    """Draw landmarks, a registered mesh and a transferred texture on a pair of creatures."""
    pair = jaxsmw.creature_pair("quadruped", vertices=3000)
    mesh_x, mesh_y = pair.source, pair.target
    registered = jaxsmw.match(mesh_x, mesh_y).registered_mesh()
    samples = jaxsmw.geometry.farthest_point_samples(mesh_x, 40)
    points = jaxsmw.io.Landmarks(tuple(map(str, range(40))), mesh_x.vertices[samples])
    carried = jaxsmw.transfer.transfer_landmarks(points, registered).landmarks
    hues = hsv_to_rgb(np.stack([np.arange(40) / 40, np.ones(40), np.full(40, 0.85)], axis=1))
    marked = {"Source": (mesh_x, points), "Target": (mesh_y, carried)}
    draw_side_by_side(
        "landmarks", {t: (mesh, spots(mesh, p.positions, hues)) for t, (mesh, p) in marked.items()}
    )
    folded = fold_lines(mesh_x)
    draw_side_by_side(
        "registered",
        {
            "Source": (mesh_x, folded),
            "Source registered on the target": (registered.mesh, folded),
            "Target": (mesh_y, fold_lines(mesh_y)),
        },
    )
    size = np.ptp(mesh_x.vertices, axis=0).max()
    checks = np.floor(20 * mesh_x.vertices / size).sum(axis=1) % 2
    stripes = np.where(checks[:, None] > 0, [0.95, 0.75, 0.3], [0.2, 0.4, 0.65])
    data = jaxsmw.io.MeshData(mesh_x, mesh_x.faces, vertex_data={"colors": stripes})
    moved = jaxsmw.transfer.transfer_attributes(data, registered).vertex_data["colors"]
    draw_side_by_side("attributes", {"Source": (mesh_x, stripes), "Target": (mesh_y, moved)})


def draw_completion() -> None:
    """Draw a part, the completed mesh with its standard deviations, and the true shape."""
    body = creature("biped", vertices=1500)
    random = np.random.default_rng(0)
    waves = np.sin(3 * body.vertices @ random.normal(size=(3, 8)))
    shapes = [
        body.vertices * random.uniform(0.9, 1.1, 3) + 0.02 * waves @ random.normal(size=(8, 3))
        for _ in range(13)
    ]
    shown = body.vertices[:, 0] < np.quantile(body.vertices[:, 0], 0.75)
    whole = jaxsmw.make_mesh(shapes[-1], body.faces)
    part = jaxsmw.make_mesh(shapes[-1], body.faces[shown[body.faces].all(axis=1)])
    model = jaxsmw.collection.shape_model(shapes[:-1], weights=body.vertex_areas)
    completed = jaxsmw.collection.complete_mesh(part, model, body.faces)
    deviation = completed.standard_deviation
    share = ((deviation - deviation.min()) / np.ptp(deviation))[:, None]
    grey = np.full((len(body.vertices), 3), 0.8)
    draw_side_by_side(
        "completed",
        {
            "Part": (part, grey),
            "Completed": (completed.mesh, (1 - share) * grey + share * np.array([0.8, 0.2, 0.1])),
            "True shape": (whole, grey),
        },
    )


def draw_another_kind() -> None:
    """Draw a collection of quadrupeds and one biped, each with the colours of the template."""
    kinds = [
        ("quadruped", pose, seed) for pose, seed in (("rest", 0), ("stand", 1), ("walk", 2), ("rest", 7))
    ]
    meshes = [
        creature(kind, vertices=1500 + 30 * number, pose=pose, seed=seed)
        for number, (kind, pose, seed) in enumerate([*kinds, ("biped", "rest", 0)])
    ]
    collection = jaxsmw.match_collection(meshes, mirror="no")
    print(*collection.sentences(), sep="\n")
    colors = position_colors(collection.meshes[collection.template])
    shown = [collection.template, *(n for n in (2, 3, 4) if n != collection.template)]
    panels = {str(n): (collection.meshes[n], colors[collection.to_template(n)]) for n in shown}
    draw_side_by_side("failure_another_kind", panels)


def draw_asymmetry() -> None:
    """Draw the directional and the fluctuating asymmetry of five synthetic animals."""
    meshes = [creature("mammal", vertices=1500 + 20 * seed, seed=seed) for seed in range(5)]
    collection = jaxsmw.match_collection(meshes, mirror="no")
    template = meshes[collection.template]
    points = mirror_points(template)
    shapes = [one.vertices for one in collection.registered]
    counterparts = [points.interpolate(shape, template) for shape in shapes]
    found = asymmetry(shapes, counterparts, weights=template.vertex_areas)
    mean = replace(template, vertices=found.symmetric.mean(axis=0), name="mean of both sides")
    panels = {
        "Directional asymmetry": np.linalg.norm(found.directional, axis=1),
        "Fluctuating asymmetry": np.sqrt((found.fluctuating**2).sum(axis=2).mean(axis=0)),
    }
    save_small(
        PICTURES / "asymmetry.png", picture_of(draw_values(mean, panels, "unit of the meshes", up="y"))
    )


def draw_without_search() -> None:
    """Match a collection by `paper` and by `accurate`, and draw its template and one other quadruped."""
    meshes = [creature("quadruped", vertices=800 + 20 * seed, seed=seed) for seed in range(5)]
    collections = {
        preset: jaxsmw.match_collection(meshes, preset=preset, template=0, mirror="no")
        for preset in ("paper", "accurate")
    }
    errors = np.zeros(len(meshes))
    for edge in collections["paper"].edges:
        if edge.source == 0:
            errors[edge.target] = edge.estimated_error
    shape = int(errors.argmax())
    colors = position_colors(meshes[0])
    panels = {"template": (meshes[0], colors)}
    for preset, collection in collections.items():
        print(preset, *collection.sentences(), sep="\n")
        panels[preset] = meshes[shape], colors[collection.to_template(shape)]
    draw_side_by_side("failure_collection", panels)


def spots(
    mesh: jaxsmw.Mesh, points: Float[np.ndarray, "l 3"], hues: Float[np.ndarray, "l 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the colours of a grey mesh with a coloured spot at each point."""
    distances, nearest = KDTree(points).query(mesh.vertices)
    near = distances < 0.025 * np.sqrt(mesh.area)
    return np.where(near[:, None], hues[nearest], 0.8)


def fold_lines(mesh: jaxsmw.Mesh) -> Float[np.ndarray, "n 3"]:
    """Return colours that show the triangulation of a mesh. Every fourth vertex is dark."""
    dark = np.zeros(len(mesh.vertices), bool)
    dark[::4] = True
    return np.where(dark[:, None], [0.25, 0.3, 0.4], [0.85, 0.87, 0.9])


def draw_side_by_side(name: str, panels: dict[str, tuple[jaxsmw.Mesh, Float[np.ndarray, "n 3"]]]) -> None:
    """Write a picture with one coloured mesh per panel."""
    images = [picture_of(draw_mesh(mesh, colors, up="y")) for mesh, colors in panels.values()]
    height = max(image.height for image in images)
    sheet = Image.new("RGB", (sum(image.width for image in images), height), "white")
    left = 0
    for image in images:
        sheet.paste(image, (left, height - image.height))
        left += image.width
    save_small(PICTURES / f"{name}.png", sheet)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("data", nargs="?", type=Path, metavar="DATA_DIRECTORY")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="NAME",
        help="draw only these: `tutorial`, `transfers`, `completion`, `another_kind`, `collection`, "
        "`asymmetry`, or names of cases",
    )
    options = parser.parse_args()
    PICTURES.mkdir(exist_ok=True)
    for name, draw in (
        ("tutorial", draw_tutorial),
        ("transfers", draw_transfers),
        ("completion", draw_completion),
        ("another_kind", draw_another_kind),
        ("collection", draw_without_search),
        ("asymmetry", draw_asymmetry),
    ):
        if not options.only or name in options.only:
            draw()
    cases = [*procedural_cases(), *(real_cases(options.data) if options.data else ())]
    print("| case | error | expected | error, cured | expected, cured |\n| --- | --- | --- | --- | --- |")
    for case in cases:
        if not options.only or case.name in options.only:
            print(draw_case(case), flush=True)


if __name__ == "__main__":
    main()
