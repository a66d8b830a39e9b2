"""`jaxsmw complete`: complete a part of a body, or a mesh with holes, by the shape model of a collection."""

from __future__ import annotations

import argparse
import os
from typing import get_args

from jaxsmw.choices import DEFAULT_PRESET, PresetName
from jaxsmw.cli.arguments import add_paths, add_weld, path, refuse_without, whole_number
from jaxsmw.cli.console import Stopwatch, say, show
from jaxsmw.cli.inputs import check_inputs, read_meshes
from jaxsmw.cli.outputs import check_outputs, report_written
from jaxsmw.errors import InputError
from jaxsmw.wording import percentage

HELP = "complete a part of a body, or a mesh with holes, by the shape model of a collection"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("part", metavar="PART", type=path, help="mesh to complete")
    parser.add_argument(
        "--model",
        metavar="DIRECTORY",
        type=path,
        required=True,
        help="results of jaxsmw collection, whose meshes have the unit of length and the hand of PART. With "
        "a model of collection --scale, the unit does not matter",
    )
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=path,
        required=True,
        help="the completed mesh in the coordinates of PART, with the attributes standard_deviation, radius "
        "and observed of each vertex. The suffix determines the format",
    )
    add_paths(parser, {"--sample FILE": "write a random shape of the posterior to this file"})
    parser.add_argument("--seed", metavar="N", type=whole_number(0), help="seed of --sample (default: 0)")
    parser.add_argument(
        "--preset",
        choices=get_args(PresetName),
        default=DEFAULT_PRESET,
        help="method of refinement, as for match (default: %(default)s)",
    )
    add_weld(parser)


def run(options: argparse.Namespace) -> None:
    """Complete a mesh, write it, and print how certain it is."""
    stopwatch = Stopwatch()
    with stopwatch.step("loading"):
        _check(options)
        from jaxsmw.collection.completion import complete_mesh
        from jaxsmw.collection.files import read_shape_model
    with stopwatch.step("reading"):
        (part,) = read_meshes(options.part, weld=options.weld)
        model, mean = read_shape_model(options.model)
    with stopwatch.step("completing", announced=True):
        completed = complete_mesh(part, model, mean.faces, preset=options.preset)
    from jaxsmw.geometry.mesh import make_mesh
    from jaxsmw.io.mesh_data import MeshData
    from jaxsmw.io.meshes import write_mesh, write_mesh_data

    data = {
        "standard_deviation": completed.standard_deviation,
        "radius": completed.posterior.radii(),
        "observed": completed.observed.astype("uint8"),
    }
    for note in write_mesh_data(options.output, MeshData(completed.mesh, mean.faces, vertex_data=data)):
        say(f"note: {options.output}: {note}")
    report_written(options.output)
    if options.sample:
        vertices = completed.posterior.sample(options.seed or 0)
        write_mesh(options.sample, make_mesh(vertices, mean.faces, name="sample"))
        report_written(options.sample)
    deviation, observed = completed.standard_deviation, completed.observed
    show(f"map of the part: right with probability {percentage(completed.probability)}.")
    show(
        f"observed: {observed.mean():.0%} of the model's vertices, with a noise of {completed.noise:.3g} in "
        "the unit of the part."
    )
    if not observed.all():
        show(
            f"standard deviation of the others: mean {deviation[~observed].mean():.3g}, largest "
            f"{deviation[~observed].max():.3g}, in the unit of the part."
        )
    show(f"time: {stopwatch.summary()}")


def _check(options: argparse.Namespace) -> None:
    from jaxsmw.io.meshes import check_attribute_suffix, check_mesh_suffix

    refuse_without(options, "--sample", bool(options.sample), "seed")
    check_attribute_suffix(options.output)
    if options.sample:
        check_mesh_suffix(options.sample)
    check_inputs(options.part)
    stored = os.path.join(options.model, "modes.npz")
    if not os.path.isfile(stored):
        raise InputError(
            f"{options.model}: contains no modes.npz: give the output directory of `jaxsmw collection`."
        )
    check_outputs([options.part, stored], files=[options.output, options.sample])
