"""`jaxsmw match`: match two meshes."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from jaxsmw.choices import Template
from jaxsmw.cli.arguments import (
    add_partial,
    add_paths,
    add_reading,
    add_source_and_target,
    add_up,
    path,
    refuse_without,
    whole_number,
)
from jaxsmw.cli.console import Stopwatch, report_progress, show
from jaxsmw.cli.inputs import check_inputs, read_meshes, read_truth
from jaxsmw.cli.measurement import (
    add_evaluation,
    add_ground_truth,
    check_evaluation,
    estimate_error,
    measure_errors,
    show_match,
)
from jaxsmw.cli.method import add_method, check_method, match_meshes, preset_name
from jaxsmw.cli.outputs import check_outputs, report_written, write_match_report
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write, make_directory

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int64, Shaped

    from jaxsmw.geometry.surface_points import SurfacePoints
    from jaxsmw.matching.correspondence import Correspondence

HELP = "match two meshes and write the map"

# A search leaves fewer maps than this.
_MOST_ALTERNATIVES = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_source_and_target(parser)
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=path,
        required=True,
        help="write the map to this file: the target vertex of each source vertex, one per line, counted "
        "from 0; if the suffix is .npy, .npz or .safetensors, an array, counted from 0; if the suffix is "
        ".mat, the column vector T12 for MATLAB, counted from 1",
    )
    add_paths(
        parser,
        {
            "--surface-points FILE.baryc_gt": "write to this file, for each source vertex, a point on the "
            "target surface: a face, counted from 1, and the barycentric weights of the face's corners",
            "--expected-error FILE": "write to this file the expected error of each match, one per line: an "
            "estimate of the geodesic error without ground truth, divided by the square root of the target's "
            "area",
            "--overlap FILE": "with --partial or --template: write to this file a line for each source "
            "vertex, the probability that the vertex has a counterpart on the target; the probabilities of "
            "the target's vertices are written beside it, for example to overlap_target.txt",
            "--one-to-one FILE": "write to this file a map in which no two source vertices share a target "
            "vertex, in the formats of --output; use this map only for meshes with the same triangulation, "
            "because it is much less accurate for other meshes",
            "--texture DIR": "write both meshes to this directory as OBJ files with a common texture, which "
            "is projected onto the target and transferred to the source by the map",
            "--report DIR": "write pictures, an interactive 3D page and a summary to this directory",
        },
    )
    parser.add_argument(
        "--alternatives",
        metavar="K",
        type=whole_number(1, _MOST_ALTERNATIVES),
        help="write up to K other maps that could be right beside --output, the most probable first, for "
        "example map_alternative_1.txt beside map.txt",
    )
    add_up(parser)
    add_ground_truth(
        parser, required=False, purpose="true map, for errors of the map before and after refinement"
    )
    add_partial(parser, with_scale=True)
    add_paths(
        parser,
        {
            "--template FILE": "for two partial shapes that share only a region: a full shape of the same "
            "kind of body, to which both are matched, and through it to each other; a mesh file in the "
            f"target's unit of length, or {' or '.join(get_args(Template))} for a built-in body",
        },
    )
    add_method(parser)
    add_reading(parser)
    add_evaluation(parser)


def run(options: argparse.Namespace) -> None:
    """Match two meshes, write the requested files, and print the quality, the errors and the times."""
    stopwatch = Stopwatch()
    with stopwatch.step("loading"):
        _check(options)
    with stopwatch.step("reading"):
        files = [options.source, options.target, *_template_file(options)]
        mesh_x, mesh_y, *template = read_meshes(*files, weld=options.weld)
        truth = None
        if options.ground_truth:
            truth = read_truth(options.ground_truth, mesh_x, mesh_y, index_base=options.index_base)
    if options.one_to_one:
        from jaxsmw.geometry.assignment import check_one_to_one

        check_one_to_one(len(mesh_x.referenced_indices), len(mesh_y.referenced_indices))
    whole = template[0] if template else options.template
    correspondence = match_meshes(options, mesh_x, mesh_y, stopwatch, whole)
    maps = _write_files(options, correspondence, stopwatch)
    expected = estimate_error(correspondence, stopwatch)
    if options.expected_error:
        with stopwatch.step("writing"):
            _write_numbers(options.expected_error, expected)
    if options.overlap:
        _write_overlap(options.overlap, correspondence, stopwatch)
    errors = {}
    if truth is not None:
        with stopwatch.step("geodesic errors"):
            errors = measure_errors(options, correspondence.mesh_y, maps, truth)
    if options.report:
        write_match_report(options.report, correspondence, errors, options, stopwatch, up=options.up)
    show_match(correspondence, errors, stopwatch)


def _check(options: argparse.Namespace) -> None:
    """Check the options and outputs before the long computation, and import the libraries."""
    check_method(options)
    check_evaluation(options)
    searches = preset_name(options) == "accurate"
    refuse_without(options, "--preset accurate", searches, "alternatives")
    are_parts = options.partial or bool(options.template)
    refuse_without(options, "--partial or --template", are_parts, "scale", "overlap")
    if options.template and options.init.files:
        raise InputError(
            "--template: cannot be used with a file of --init, which refers to source and target: leave out "
            "the one or the other."
        )
    refuse_without(options, "--report", bool(options.report), "up")
    reads_indices = bool(options.ground_truth or options.init.files)
    refuse_without(options, "--ground-truth or a file of --init", reads_indices, "index_base")
    points, expected, overlap = options.surface_points, options.expected_error, options.overlap
    if points and Path(points).suffix != ".baryc_gt":
        raise InputError(
            f"{points}: surface points are written as .baryc_gt: choose a name that ends in .baryc_gt."
        )
    for file, contents in ((expected, "expected errors are"), (overlap, "the overlap is")):
        if file and Path(file).suffix.lower() in (".npy", ".npz", ".safetensors", ".mat"):
            raise InputError(f"{file}: {contents} written as text: choose another suffix, such as .txt.")
    alternatives = [_alternative_file(options.output, k + 1) for k in range(options.alternatives or 0)]
    beside = _beside(overlap, "target") if overlap else None
    inputs = _inputs(options)
    check_inputs(*inputs)
    check_outputs(
        inputs,
        files=[options.output, points, options.one_to_one, expected, overlap, beside, *alternatives],
        report=options.report,
        texture=options.texture,
    )
    from jaxsmw.io.maps import check_map_name

    for file in filter(None, (options.output, options.one_to_one)):
        check_map_name(file)
    import jaxsmw.matching.match  # noqa: F401 (imported here because loading is timed separately)


def _inputs(options: argparse.Namespace) -> list[str]:
    """Return all files that the command reads."""
    files = [options.source, options.target, *_template_file(options)]
    return [*files, *options.init.files, *(options.ground_truth or ())]


def _template_file(options: argparse.Namespace) -> list[str]:
    """Return the file of the template, in a list that is empty if there is none."""
    is_file = options.template and options.template not in get_args(Template)
    return [options.template] if is_file else []


def _write_files(
    options: argparse.Namespace, correspondence: Correspondence, stopwatch: Stopwatch
) -> dict[str, Int64[np.ndarray, " m"] | SurfacePoints]:
    """Write all maps. Return the initial map, the maps that were written, and the refined map."""
    from jaxsmw.io.maps import write_pointwise_map

    maps: dict[str, Int64[np.ndarray, " m"] | SurfacePoints] = {"initial": correspondence.initial_map}
    with stopwatch.step("writing"):
        write_pointwise_map(options.output, correspondence.pointwise_map)
    report_written(options.output)
    others = correspondence.alternatives[: options.alternatives or 0]
    for number, other in enumerate(others, 1):
        file = _alternative_file(options.output, number)
        with stopwatch.step("writing"):
            write_pointwise_map(file, other.pointwise_map)
        report_written(file)
    _remove_earlier_alternatives(options, len(others))
    if options.alternatives and not others:
        report_progress("alternatives: no other map was found that could be right")
    if options.one_to_one:
        with stopwatch.step("one-to-one map", announced=True):
            maps["one-to-one"] = one_to_one = correspondence.one_to_one()
            write_pointwise_map(options.one_to_one, one_to_one)
        report_written(options.one_to_one)
    if options.surface_points or options.texture:
        report_progress("points on the surface ...")
        with stopwatch.step("surface points"):
            points = correspondence.surface_points()
        with stopwatch.step("writing"):
            _write_points(options, correspondence, points)
        if options.surface_points:
            maps["surface"] = points
    return maps | {"refined": correspondence.pointwise_map}


def _alternative_file(output: str, number: int) -> str:
    """Return the name of the file of an alternative map, beside the output."""
    return _beside(output, f"alternative_{number}")


def _beside(file: str, what: str) -> str:
    """Return the name of a further file beside a file, such as `map_target.txt` beside `map.txt`."""
    root, suffix = os.path.splitext(file)
    return f"{root}_{what}{suffix}"


def _remove_earlier_alternatives(options: argparse.Namespace, written: int) -> None:
    """Remove alternatives that an earlier run wrote beside the same output, except inputs of this run."""
    read = {os.path.realpath(file) for file in _inputs(options)}
    for number in range(written + 1, _MOST_ALTERNATIVES + 1):
        file = _alternative_file(options.output, number)
        if os.path.isfile(file) and os.path.realpath(file) not in read:
            os.remove(file)
            report_progress(f"removed {file}, which an earlier run has written")


def _write_points(options: argparse.Namespace, correspondence: Correspondence, points: SurfacePoints) -> None:
    """Write the surface points and the texture."""
    if options.surface_points:
        from jaxsmw.evaluation.ground_truth import GroundTruth, write_ground_truth

        truth = GroundTruth.of_all_vertices(points)
        write_ground_truth(options.surface_points, truth, correspondence.mesh_y)
        report_written(options.surface_points)
    if options.texture:
        from jaxsmw.report.texture import TEXTURE_FILES, write_textured_pair

        directory = make_directory(options.texture)
        write_textured_pair(directory, correspondence.mesh_x, correspondence.mesh_y, points)
        report_written(*(directory / name for name in TEXTURE_FILES))


def _write_overlap(file: str, correspondence: Correspondence, stopwatch: Stopwatch) -> None:
    """Write the probabilities that vertices have a counterpart, and print the shares of both areas."""
    with stopwatch.step("overlap"):
        probabilities = correspondence.overlap_probabilities()
        _write_numbers(file, probabilities.of_x, "%.3f")
        _write_numbers(_beside(file, "target"), probabilities.of_y, "%.3f")
    mask_x, mask_y = probabilities.masks
    share_x, share_y = correspondence.mesh_x.average(mask_x), correspondence.mesh_y.average(mask_y)
    show(
        f"overlap:     predicted on {share_x:.0%} of the source's area and {share_y:.0%} of the target's area"
    )


def _write_numbers(file: str, numbers: Shaped[np.ndarray, " m"], form: str = "%.6f") -> None:
    """Write one number per line."""
    from numpy import savetxt

    with atomic_write(file) as temporary:
        savetxt(temporary, numbers, form)
    report_written(file)
