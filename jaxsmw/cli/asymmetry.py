"""`jaxsmw asymmetry`: compare bodies with their mirror images, or left bones with right bones."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from jaxsmw.choices import DEFAULT_PRESET, PresetName
from jaxsmw.cli.arguments import add_seed, add_up, add_weld, path, whole_number
from jaxsmw.cli.console import report_progress, show
from jaxsmw.cli.inputs import check_inputs
from jaxsmw.cli.outputs import check_outputs, report_written, write_figure
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float64

    from jaxsmw.collection.bilateral import Asymmetry
    from jaxsmw.geometry.mesh import Mesh

HELP = "measure the asymmetry of bodies, or of left and right bones"

_PICTURE, _TABLE, _VARIANCE, _MEAN = "asymmetry.png", "asymmetry.csv", "variance.csv", "mean.ply"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "meshes",
        metavar="MESH",
        nargs="+",
        type=path,
        help="one body, or several in one triangulation, such as the files registered/*.ply of collection",
    )
    parser.add_argument(
        "--other-side",
        metavar="MESH",
        nargs="+",
        type=path,
        help="the bones of the other side of the same individuals, in the same order and triangulation. By "
        "default, each MESH is a symmetric body, which is compared with its own mirror image",
    )
    parser.add_argument(
        "--output", metavar="DIR", type=path, required=True, help="directory for tables, meshes and a picture"
    )
    parser.add_argument(
        "--scale", action="store_true", help="remove differences in size, also between both sides"
    )
    parser.add_argument(
        "--permutations",
        metavar="N",
        type=whole_number(1),
        default=999,
        help="number of random exchanges of both sides, from which the probability of the directional "
        "asymmetry is computed (default: %(default)s)",
    )
    parser.add_argument(
        "--preset",
        choices=get_args(PresetName),
        default=DEFAULT_PRESET,
        help="method by which a body is matched to its mirror image, as for match (default: %(default)s)",
    )
    add_seed(parser, "seed of the random exchanges")
    add_up(parser)
    add_weld(parser)


def run(options: argparse.Namespace) -> None:
    """Measure the asymmetry, and write tables, meshes with values at their vertices, and a picture."""
    others = options.other_side or []
    inputs = [*options.meshes, *others]
    check_inputs(*inputs)
    names = [Path(file).stem for file in options.meshes]
    if len(set(names)) < len(names):
        raise InputError(f"two meshes are named {_first_twice(names)}: give meshes with different names.")
    if others and len(others) != len(names):
        raise InputError(
            f"--other-side: there are {len(others)} meshes of the other side, but {len(names)} of the first "
            "side: give both sides of each individual, in the same order."
        )
    written = [_PICTURE, _TABLE, _MEAN, *(f"{name}_asymmetry.ply" for name in names)]
    check_outputs(inputs, directories=[(options.output, [*written, _VARIANCE])])
    from jaxsmw.collection.bilateral import asymmetry, mirror_points
    from jaxsmw.collection.shape_models import align
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.io.meshes import read_mesh

    meshes = [read_mesh(file, weld=options.weld) for file in options.meshes]
    opposite = [read_mesh(file, weld=options.weld) for file in others]
    _check_triangulations([*meshes, *opposite])
    shapes, weights = [mesh.vertices for mesh in meshes], meshes[0].vertex_areas
    if opposite:
        counterparts = [mesh.vertices for mesh in opposite]
    else:
        report_progress("matching the mean shape to its mirror image ...")
        mean = align(shapes, scale=options.scale, weights=weights).mean
        points = mirror_points(Mesh(mean, meshes[0].faces, "mean"), preset=options.preset)
        counterparts = [points.interpolate(shape, meshes[0]) for shape in shapes]
    found = asymmetry(
        shapes,
        counterparts,
        scale=options.scale,
        weights=weights,
        permutations=options.permutations,
        seed=options.seed,
    )
    _write(options, meshes, dict(zip(names, found.differences, strict=True)), found)
    _show(found)


def _first_twice(names: Sequence[str]) -> str:
    return next(name for number, name in enumerate(names) if name in names[:number])


def _check_triangulations(meshes: Sequence[Mesh]) -> None:
    """Check that all meshes have the faces of the first mesh, in either orientation."""
    import numpy as np

    first, *others = meshes
    wanted = np.sort(first.faces, axis=1)
    for mesh in others:
        same = len(mesh.vertices) == len(first.vertices) and mesh.faces.shape == wanted.shape
        if not (same and np.array_equal(np.sort(mesh.faces, axis=1), wanted)):
            raise InputError(
                f"{mesh.name}: has another triangulation than {first.name}: run `jaxsmw collection` first, "
                "and give the meshes in its directory registered."
            )


def _write(
    options: argparse.Namespace,
    meshes: Sequence[Mesh],
    differences: Mapping[str, Float64[np.ndarray, "n 3"]],
    found: Asymmetry,
) -> None:
    import numpy as np

    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.io.mesh_data import MeshData
    from jaxsmw.io.meshes import write_mesh_data
    from jaxsmw.report.figures import draw_values
    from jaxsmw.runtime.files import make_directory, write_csv

    directory = make_directory(options.output)
    weights, faces = found.alignment.weights, meshes[0].faces
    lengths = {name: np.linalg.norm(field, axis=1) for name, field in differences.items()}
    fluctuating = np.linalg.norm(found.fluctuating, axis=2)
    several = len(meshes) > 1
    rows: list[list[object]] = [["mesh", "mean", "root_mean_square", "largest"]]
    rows += [
        [name, weights @ values, np.sqrt(weights @ values**2), values.max()]
        for name, values in lengths.items()
    ]
    if several:  # one individual has no fluctuating asymmetry
        for row, value in zip(rows, ["mean_fluctuating", *(fluctuating @ weights)], strict=True):
            row.append(value)
    write_csv(directory / _TABLE, rows)
    report_written(directory / _TABLE)
    if several:
        effects = found.analysis_of_variance()
        write_csv(directory / _VARIANCE, [effects[0]._fields, *effects])
        report_written(directory / _VARIANCE)
    for mesh, (name, values) in zip(meshes, lengths.items(), strict=True):
        data = {"asymmetry": values, "difference": differences[name]}
        file = directory / f"{name}_asymmetry.ply"
        write_mesh_data(file, MeshData(mesh, mesh.faces, vertex_data=data))
        report_written(file)
    directional = np.linalg.norm(found.directional, axis=1)
    panels = {"Asymmetry": directional}
    if several:
        panels = {
            "Directional asymmetry": directional,
            "Fluctuating asymmetry": np.sqrt(np.mean(fluctuating**2, axis=0)),
        }
    mean = Mesh(found.symmetric.mean(axis=0), faces, "mean of both sides")
    data = {name.lower().replace(" ", "_"): values for name, values in panels.items()}
    write_mesh_data(directory / _MEAN, MeshData(mean, faces, vertex_data=data))
    report_written(directory / _MEAN)
    write_figure(str(directory / _PICTURE), draw_values(mean, panels, "unit of the meshes", up=options.up))


def _show(found: Asymmetry) -> None:
    import numpy as np

    squares = found.mean_squares(found.differences)
    show(f"asymmetry, root mean square over the surface: {np.sqrt(squares.mean()):.4g}, in the meshes' unit.")
    if len(squares) > 1:
        directional = np.sqrt(found.mean_squares(found.directional))
        fluctuating = np.sqrt(found.mean_squares(found.fluctuating).mean())
        show(
            f"directional: {directional:.4g} (probability without directional asymmetry: "
            f"{found.probability:.3g}); fluctuating, with the errors of the maps: {fluctuating:.4g}."
        )
