"""`jaxsmw demo`: match two poses of a procedural creature."""

from __future__ import annotations

import argparse

from jaxsmw.cli.arguments import add_seed, path, whole_number
from jaxsmw.cli.console import Stopwatch, report_progress, show
from jaxsmw.cli.measurement import estimate_error, show_match
from jaxsmw.cli.method import add_method, check_method, match_meshes
from jaxsmw.cli.outputs import check_outputs, report_written, write_match_report
from jaxsmw.runtime.files import make_directory

HELP = "generate a creature in two poses, match the poses and write a report"

_FILES = ("source.off", "target.off", "truth.baryc_gt", "map.txt")
# The largest accepted number of vertices. A creature with 100 000 vertices takes 0.6 GiB of memory.
_MOST_VERTICES = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "--output",
        metavar="DIR",
        type=path,
        default="jaxsmw-demo",
        help="directory for the meshes, the map and the report (default: %(default)s)",
    )
    parser.add_argument("--kind", default="quadruped", help="kind of creature (default: %(default)s)")
    parser.add_argument(
        "--vertices",
        metavar="N",
        type=whole_number(1, _MOST_VERTICES),
        default=5000,
        help="number of vertices of the source mesh (default: %(default)s)",
    )
    add_seed(parser, "seed of the creature; creatures with different seeds have different shapes")
    add_method(parser)


def run(options: argparse.Namespace) -> None:
    """Generate a creature in two poses, match the poses, and write the meshes, the map and the report."""
    stopwatch = Stopwatch()
    with stopwatch.step("loading"):
        check_method(options)
        check_outputs(options.init.files, report=options.output, directories=[(options.output, _FILES)])
        from jaxsmw.creature import creature_pair
        from jaxsmw.evaluation.ground_truth import GroundTruth, write_ground_truth
        from jaxsmw.evaluation.metrics import geodesic_error
        from jaxsmw.io.maps import write_pointwise_map
        from jaxsmw.io.meshes import write_mesh
    report_progress("generating the creature ...")
    with stopwatch.step("creature"):
        pair = creature_pair(options.kind, vertices=options.vertices, seed=options.seed)
    truth = GroundTruth.of_all_vertices(pair.truth)
    correspondence = match_meshes(options, pair.source, pair.target, stopwatch)
    with stopwatch.step("writing"):
        directory = make_directory(options.output)
        source, target, true_points, found_map = (directory / name for name in _FILES)
        write_mesh(source, pair.source)
        write_mesh(target, pair.target)
        write_ground_truth(true_points, truth, pair.target)
        write_pointwise_map(found_map, correspondence.pointwise_map)
    report_written(source, target, true_points, found_map)
    maps = {"initial": correspondence.initial_map, "refined": correspondence.pointwise_map}
    report_progress("geodesic errors ...")
    with stopwatch.step("geodesic errors"):
        errors = {name: geodesic_error(pair.target, vertices, truth) for name, vertices in maps.items()}
    estimate_error(correspondence, stopwatch)
    write_match_report(options.output, correspondence, errors, options, stopwatch, up="y")
    show_match(correspondence, errors, stopwatch)
    show(f"Open {directory / 'report.html'} or {directory / 'correspondence.png'} to see the result.")
