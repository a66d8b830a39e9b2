"""`jaxsmw transfer`: register the source on the target, and transfer landmarks and attributes."""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from typing import TYPE_CHECKING, get_args

from jaxsmw.choices import CoordinateSystem
from jaxsmw.cli.arguments import (
    MAP_FORMS,
    add_partial,
    add_paths,
    add_reading,
    add_source_and_target,
    add_up,
    path,
    positive_number,
    refuse_without,
)
from jaxsmw.cli.console import Stopwatch, report_progress, say, show
from jaxsmw.cli.inputs import check_inputs, read_maps, report_mesh
from jaxsmw.cli.measurement import show_quality
from jaxsmw.cli.method import add_method, check_method, given_method, match_meshes
from jaxsmw.cli.outputs import check_outputs, report_written, write_match_report
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.io.mesh_data import MeshData
    from jaxsmw.matching.correspondence import Correspondence
    from jaxsmw.transfer.landmarks import TransferredLandmarks
    from jaxsmw.transfer.registered_mesh import RegisteredMesh

HELP = "register the source on the target, and transfer landmarks and attributes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_source_and_target(parser)
    add_paths(
        parser,
        {
            "--map FILE": f"map from the source to the target, instead of a match: {MAP_FORMS}",
            "--registered FILE": "write the registered mesh to this file: the source with all its faces and "
            "attributes, and with positions on the target. The suffix determines the format",
            "--landmarks FILE": "landmarks on the source: .mrk.json and .fcsv of 3D Slicer, .pp of MeshLab, "
            ".mps of MITK, or .csv and .txt with a name and a position per line",
            "--landmarks-output FILE": "write the landmarks on the target to this file, in one of these "
            "formats except .mps",
        },
    )
    parser.add_argument(
        "--coordinates",
        choices=get_args(CoordinateSystem),
        help="coordinate system of both meshes, to which landmarks are converted. By default, the coordinate "
        "system of the landmark file is assumed",
    )
    parser.add_argument(
        "--attributes",
        metavar="FILE",
        type=path,
        help="write the target with the attributes of the source to this file: colours and other data of "
        "vertices and faces, texture coordinates, blend shapes and skin weights. The suffix determines the "
        "format",
    )
    parser.add_argument(
        "--stiffness",
        metavar="LENGTH",
        type=positive_number,
        help="length below which noise of the map is smoothed, in units of the square root of the target's "
        "area (default: 0.005)",
    )
    parser.add_argument(
        "--report",
        metavar="DIR",
        type=path,
        help="write pictures, an interactive 3D page and a summary to this directory, like match --report",
    )
    add_up(parser)
    add_partial(parser, with_scale=True)
    add_method(parser)
    add_reading(parser)


def run(options: argparse.Namespace) -> None:
    """Match two meshes or read a map, write the requested files, and print the quality and the times."""
    stopwatch = Stopwatch()
    with stopwatch.step("loading"):
        _check(options)
    from jaxsmw.io.meshes import read_mesh_data

    with stopwatch.step("reading"):
        source, target = (
            read_mesh_data(file, weld=options.weld) for file in (options.source, options.target)
        )
        for file, data in ((options.source, source), (options.target, target)):
            report_mesh(file, data.mesh)
        if options.attributes and not source.has_attributes:
            raise InputError(
                f"{options.source}: has no attributes (colours, labels, texture coordinates, blend shapes, a "
                "skin or other data) for --attributes: leave the option out, or give a source that has some."
            )
        landmarks = _read_landmarks(options, source) if options.landmarks else None
    correspondence, registered = _register(options, source, target, stopwatch)
    if correspondence is not None:
        show_quality(correspondence)
    for sentence in registered.sentences():
        show(sentence)
    if registered.looks_wrong:
        cure = "look at the registered mesh, or at the map with --report"
        if options.map:
            cure = (
                f"check that {options.map} belongs to these two meshes, in this order, and its --index-base"
            )
        say(
            f"warning: {registered.flipped_faces.mean():.1%} of the triangles are flipped, so the map is "
            f"probably wrong: {cure}."
        )
    if options.registered or options.attributes:
        _write_meshes(options, source, target, registered, stopwatch)
    transferred = None
    if landmarks:
        expected = None if correspondence is None else correspondence.expected_error()
        transferred = _transfer_landmarks(options, landmarks, expected, registered, stopwatch)
    if correspondence is not None and options.report:
        write_match_report(
            options.report,
            correspondence,
            {},
            options,
            stopwatch,
            up=options.up,
            registered=registered,
            landmarks=(landmarks, transferred) if landmarks and transferred else None,
        )
    show(f"time: {stopwatch.summary()}")


def _check(options: argparse.Namespace) -> None:
    """Check the options and outputs before the long computation, and import the libraries."""
    if not (options.registered or options.landmarks_output or options.attributes or options.report):
        raise InputError(
            "nothing to write: give --registered FILE, --attributes FILE, --report DIR, or --landmarks FILE "
            "with --landmarks-output FILE."
        )
    refuse_without(options, "--landmarks", bool(options.landmarks), "landmarks_output", "coordinates")
    written = options.landmarks_output or options.report
    refuse_without(options, "--landmarks-output or --report", bool(written), "landmarks")
    if options.map and (names := given_method(options)):
        raise InputError(f"{names[0]} has no effect with --map: give one of the two.")
    if options.map and options.report:
        raise InputError("--report: describes a match, but --map gives a map: leave one of the two out.")
    refuse_without(options, "--partial", options.partial, "scale")
    refuse_without(options, "--report", bool(options.report), "up")
    check_method(options)
    reads_indices = bool(options.map or options.init.files)
    refuse_without(options, "--map or a file of --init", reads_indices, "index_base")
    from jaxsmw.io.landmark_files import check_landmark_suffix, check_readable_suffix
    from jaxsmw.io.meshes import check_attribute_suffix, check_mesh_suffix

    if options.registered:
        check_mesh_suffix(options.registered)
    if options.attributes:
        check_attribute_suffix(options.attributes)
    if options.landmarks:
        check_readable_suffix(options.landmarks)
    if options.landmarks_output:
        check_landmark_suffix(options.landmarks_output)
    inputs = [options.source, options.target, options.map, options.landmarks, *options.init.files]
    check_inputs(*inputs)
    check_outputs(
        inputs,
        files=[options.registered, options.attributes, options.landmarks_output],
        report=options.report,
    )
    import jaxsmw.matching.match  # noqa: F401 (imported here because loading is timed separately)


def _read_landmarks(options: argparse.Namespace, source: MeshData) -> Landmarks:
    """Read the landmarks of the source, convert them to the coordinates of the meshes, and check them."""
    from jaxsmw.io.landmark_files import check_known_system, read_landmark_file
    from jaxsmw.io.landmarks import check_frame

    landmarks = read_landmark_file(options.landmarks)
    for note in landmarks.notes:
        report_progress(f"{options.landmarks}: {note}")
    if options.coordinates and landmarks.coordinates is None:
        report_progress(
            f"{options.landmarks}: the file states no coordinate system, so its positions are used as "
            f"{options.coordinates} coordinates without a conversion."
        )
        landmarks = landmarks.stated(options.coordinates)
    elif options.coordinates:
        landmarks = landmarks.in_coordinates(options.coordinates)
    elif landmarks.coordinates:
        report_progress(
            f"{options.landmarks}: the landmarks are in {landmarks.coordinates} coordinates; the meshes are "
            "assumed to be in the same coordinates."
        )
    if landmarks.unit is not None:
        report_progress(
            f"{options.landmarks}: the unit is {landmarks.unit[:40]!a}; the target is assumed to have the "
            "same unit."
        )
    # Errors in the landmarks are found before the long computation.
    if options.landmarks_output:
        check_known_system(options.landmarks_output, landmarks)
    check_frame(landmarks, source.mesh)
    return landmarks


def _register(
    options: argparse.Namespace, source: MeshData, target: MeshData, stopwatch: Stopwatch
) -> tuple[Correspondence | None, RegisteredMesh]:
    """Return the match with its expected error, or None if a map is given, and the registered mesh."""
    from jaxsmw.matching.pair import Pair
    from jaxsmw.runtime.threads import one_blas_thread
    from jaxsmw.transfer.registered_mesh import DEFAULT_STIFFNESS, points_of_map, register_mesh

    meshes, index_base = (source.mesh, target.mesh), options.index_base
    stiffness = options.stiffness or DEFAULT_STIFFNESS
    if not options.map:
        correspondence = match_meshes(options, *meshes, stopwatch)
        with (
            stopwatch.step("registered mesh and expected error", announced=True),
            one_blas_thread(),
            ThreadPoolExecutor(1) as executor,
        ):
            expected = executor.submit(correspondence.expected_error)
            registered = correspondence.registered_mesh(stiffness=stiffness)
            expected.result()
            return correspondence, registered
    with stopwatch.step("registered mesh", announced=True):
        (pointwise_map,) = read_maps([options.map], *meshes, index_base=index_base).values()
        pair = Pair.make(*meshes, partial=options.partial, scale=options.scale or 1.0)
        scale = pair.scale if pair.partial else None
        points = points_of_map(*meshes, pointwise_map, scale=scale)
        return None, register_mesh(*meshes, points, stiffness=stiffness, scale=scale)


def _transfer_landmarks(
    options: argparse.Namespace,
    landmarks: Landmarks,
    expected_error: Float[np.ndarray, " m"] | None,
    registered: RegisteredMesh,
    stopwatch: Stopwatch,
) -> Landmarks:
    """Transfer the landmarks, print their expected errors, write them if requested, and return them."""
    from jaxsmw.io.landmark_files import write_landmark_file
    from jaxsmw.transfer.landmarks import transfer_landmarks

    with stopwatch.step("landmarks"):
        transferred = transfer_landmarks(landmarks, registered, expected_error=expected_error)
    for note in transferred.notes:
        say(f"note: {note}")
    _show_landmarks(transferred)
    if options.landmarks_output:
        write_landmark_file(options.landmarks_output, transferred.landmarks)
        report_written(options.landmarks_output)
    return transferred.landmarks


def _show_landmarks(transferred: TransferredLandmarks) -> None:
    """Print the expected error of each landmark, and mark large errors."""
    if transferred.expected_errors is None:
        return
    show("expected errors of landmarks, in the unit of the target:")
    errors = transferred.expected_errors.tolist()
    for name, error in zip(transferred.landmarks.names, errors, strict=True):
        is_large = error > _LARGE * median(errors)
        show(
            f"  {name}: {error:.3g}{' (more than twice the median: check this landmark)' if is_large else ''}"
        )


# A landmark is marked if its expected error exceeds this multiple of the median expected error.
_LARGE = 2


def _write_meshes(
    options: argparse.Namespace,
    source: MeshData,
    target: MeshData,
    registered: RegisteredMesh,
    stopwatch: Stopwatch,
) -> None:
    """Write the registered mesh, and the target with the attributes of the source."""
    from jaxsmw.transfer.attributes import registered_data, transfer_attributes

    if options.registered:
        _write(options.registered, registered_data(source, registered), stopwatch)
    if options.attributes:
        with stopwatch.step("attributes", announced=True):
            carried = transfer_attributes(source, registered, target)
        for note in carried.mesh.notes[len(target.mesh.notes) :]:
            say(f"note: {note}")
        _write(options.attributes, carried, stopwatch)


def _write(file: str, data: MeshData, stopwatch: Stopwatch) -> None:
    """Write a mesh with its data, and print notes about data that the file does not contain."""
    from jaxsmw.io.meshes import write_mesh_data

    with stopwatch.step("writing"):
        notes = write_mesh_data(file, data)
    if data.texture is not None and not any("texture coordinates" in note for note in notes):
        notes += (
            "the file contains texture coordinates, but no picture and no material: assign those of the "
            "source in your program.",
        )
    for note in notes:
        say(f"note: {file}: {note}")
    report_written(file)
