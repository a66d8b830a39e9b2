"""`jaxsmw evaluate`: measure the geodesic errors of maps against the ground truth."""

from __future__ import annotations

import argparse
import json

from jaxsmw.cli.arguments import (
    MAP_FORMS,
    add_partial,
    add_paths,
    add_reading,
    add_source_and_target,
    add_up,
    path,
    refuse_without,
)
from jaxsmw.cli.console import show
from jaxsmw.cli.inputs import check_inputs, read_maps, read_meshes, read_truth
from jaxsmw.cli.measurement import add_evaluation, add_ground_truth, check_evaluation, measure_errors
from jaxsmw.cli.outputs import check_outputs, write_comparison_page, write_figure, write_text
from jaxsmw.errors import check_suffix

HELP = "measure the geodesic errors of maps against the ground truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_source_and_target(parser)
    parser.add_argument("map", type=path, metavar="MAP", nargs="+", help=f"maps to measure: {MAP_FORMS}")
    add_ground_truth(parser, required=True, purpose="true map")
    add_paths(
        parser,
        {
            "--output FILE": "write the errors and quality curves to this file (.json)",
            "--figure FILE": "draw the correspondence quality curves to this file (.png, .pdf or .svg)",
            "--page FILE.html": "write an interactive page to this file; the page shows one map at a time "
            "with its errors",
        },
    )
    add_partial(parser, with_scale=False)
    add_up(parser)
    add_reading(parser)
    add_evaluation(parser)


def run(options: argparse.Namespace) -> None:
    """Print the errors of all maps, and write the requested files."""
    check_evaluation(options)
    refuse_without(options, "--page", bool(options.page), "partial", "up")
    inputs = [options.source, options.target, *options.map, *options.ground_truth]
    check_inputs(*inputs)
    check_outputs(inputs, files=[options.output], figures=[options.figure], pages=[options.page])
    if options.output:
        check_suffix(options.output, "errors", ".json")
    mesh_x, mesh_y = read_meshes(options.source, options.target, weld=options.weld)
    truth = read_truth(options.ground_truth, mesh_x, mesh_y, index_base=options.index_base)
    maps = read_maps(options.map, mesh_x, mesh_y, index_base=options.index_base)
    errors = measure_errors(options, mesh_y, maps, truth)
    if options.page:
        write_comparison_page(
            options.page, mesh_x, mesh_y, maps, errors, partial=options.partial, up=options.up
        )
    for name, error in errors.items():
        show(f"{name}: {error}")
    if options.figure:
        from jaxsmw.report.summary import draw_errors

        write_figure(options.figure, draw_errors(errors))
    if options.output:
        results = {name: error.as_dictionary() for name, error in errors.items()}
        write_text(options.output, json.dumps(results, indent=2) + "\n")
