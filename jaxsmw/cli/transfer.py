"""`jaxsmw transfer`: register the source on the target, and transfer landmarks and attributes."""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import reduce
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
    from jaxsmw.io.mesh_data import MeshData, Overlay
    from jaxsmw.io.volumes import Volume
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
            ".mps of MITK, .tps, .nts and .pts of morphometrics, .json of Scalismo, or .csv and .txt with a "
            "name and a position per line",
            "--landmarks-output FILE": "write the landmarks on the target to this file, in one of these "
            "formats except .mps",
            "--volume FILE": "tetrahedral mesh inside the source, such as a finite-element model, whose "
            "boundary lies at the surface: .vtu, .vtk, .msh of Gmsh, .mesh of Medit, or .inp of Abaqus",
            "--volume-output FILE": "write the volume inside the target to this file, in one of these "
            "formats",
            "--blend-shapes DIR": "blend shapes of the source: a folder of OBJ files with its vertices in "
            "the same order. They are part of the attributes",
            "--blend-shapes-output DIR": "write the target in each blend shape of the source to this folder, "
            "as OBJ files",
            "--map-output FILE": "write the map that was computed to this file, like match --output",
        },
    )
    parser.add_argument(
        "--overlay",
        metavar="FILE",
        type=path,
        action="append",
        default=[],
        help="data on the vertices of the source, as GIFTI (.func.gii, .shape.gii, .label.gii) or from "
        "FreeSurfer (.annot, lh.curv): part of the attributes. Repeat the option for several files",
    )
    parser.add_argument(
        "--overlay-output",
        metavar="FILE",
        type=path,
        action="append",
        default=[],
        help="write an overlay on the target to this file, in one of these formats. Give as many files as "
        "for --overlay, in the same order",
    )
    parser.add_argument(
        "--coordinates",
        choices=get_args(CoordinateSystem),
        help="coordinate system of both meshes, to which landmarks are converted. By default, the coordinate "
        "system of the landmark file is assumed",
    )
    parser.add_argument(
        "--off-surface",
        action="store_true",
        help="landmarks lie off the surface on purpose, for example inside a skull: the deformation of the "
        "space around the source moves them",
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
    from jaxsmw.io.blend_shapes import read_blend_shapes
    from jaxsmw.io.meshes import read_mesh_data
    from jaxsmw.io.volumes import read_volume

    with stopwatch.step("reading"):
        source, target = (
            read_mesh_data(file, weld=options.weld) for file in (options.source, options.target)
        )
        for file, data in ((options.source, source), (options.target, target)):
            report_mesh(file, data.mesh)
        overlays = _read_overlays(options, source)
        bare, source = source, reduce(lambda data, overlay: overlay.added_to(data), overlays, source)
        if options.blend_shapes:
            source = read_blend_shapes(options.blend_shapes, source)
        if options.blend_shapes_output and not source.blend_shapes:
            raise InputError(
                f"{options.source}: has no blend shapes for --blend-shapes-output: add --blend-shapes DIR."
            )
        if options.attributes and not source.has_attributes:
            raise InputError(
                f"{options.source}: has no attributes (colours, labels, texture coordinates, blend shapes, a "
                "skin or other data) for --attributes: leave the option out, or give a source that has some."
            )
        landmarks = _read_landmarks(options, source) if options.landmarks else None
        volume = read_volume(options.volume) if options.volume else None
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
    if options.registered or options.attributes or options.blend_shapes_output:
        _write_meshes(options, source, target, registered, stopwatch)
    _write_overlays(options, bare, overlays, registered, stopwatch)
    if volume:
        _transfer_volume(options.volume_output, volume, registered, stopwatch)
    transferred = None
    if landmarks:
        expected = None if correspondence is None else correspondence.expected_error()
        transferred = _transfer_landmarks(options, landmarks, expected, registered, stopwatch)
    if correspondence is not None and options.map_output:
        from jaxsmw.io.maps import write_pointwise_map

        write_pointwise_map(options.map_output, correspondence.pointwise_map)
        report_written(options.map_output)
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
    outputs = [options.registered, options.landmarks_output, options.attributes, options.overlay_output]
    outputs += [options.volume_output, options.map_output, options.blend_shapes_output, options.report]
    if not any(outputs):
        raise InputError(
            "nothing to write: give --registered FILE, --attributes FILE, --map-output FILE, --report DIR, "
            "--landmarks FILE with --landmarks-output FILE, --overlay FILE with --overlay-output FILE, or "
            "--volume FILE with --volume-output FILE."
        )
    refuse_without(options, "--volume", bool(options.volume), "volume_output")
    refuse_without(options, "--volume-output", bool(options.volume_output), "volume")
    if options.overlay_output and len(options.overlay_output) != len(options.overlay):
        raise InputError(
            f"--overlay-output is given {len(options.overlay_output)} times and --overlay "
            f"{len(options.overlay)} times: give one output for each overlay."
        )
    carried = bool(options.overlay_output or options.attributes or options.registered)
    refuse_without(options, "--overlay-output or --attributes", carried, "overlay")
    carried = bool(options.blend_shapes_output or options.attributes or options.registered)
    refuse_without(options, "--blend-shapes-output or --attributes", carried, "blend_shapes")
    refuse_without(
        options, "--landmarks", bool(options.landmarks), "landmarks_output", "coordinates", "off_surface"
    )
    written = options.landmarks_output or options.report
    refuse_without(options, "--landmarks-output or --report", bool(written), "landmarks")
    if options.map and (names := given_method(options)):
        raise InputError(f"{names[0]} has no effect with --map: give one of the two.")
    if options.map and options.map_output:
        raise InputError("--map-output: writes a computed map, but --map gives one: leave one of them out.")
    if options.map and options.report:
        raise InputError("--report: describes a match, but --map gives a map: leave one of the two out.")
    refuse_without(options, "--partial", options.partial, "scale")
    refuse_without(options, "--report", bool(options.report), "up")
    check_method(options)
    reads_indices = bool(options.map or options.init.files)
    refuse_without(options, "--map or a file of --init", reads_indices, "index_base")
    from jaxsmw.io.landmark_files import check_landmark_suffix, check_readable_suffix
    from jaxsmw.io.maps import check_map_name
    from jaxsmw.io.meshes import check_attribute_suffix, check_mesh_suffix
    from jaxsmw.io.overlays import check_overlay_name
    from jaxsmw.io.volumes import check_volume_suffix

    if options.registered:
        check_mesh_suffix(options.registered)
    if options.attributes:
        check_attribute_suffix(options.attributes)
    if options.landmarks:
        check_readable_suffix(options.landmarks)
    if options.landmarks_output:
        check_landmark_suffix(options.landmarks_output)
    if options.map_output:
        check_map_name(options.map_output)
    for file in options.overlay_output:
        check_overlay_name(file)
    for file in filter(None, (options.volume, options.volume_output)):
        check_volume_suffix(file)
    inputs = [options.source, options.target, options.map, options.landmarks, *options.init.files]
    inputs += [*options.overlay, options.volume]
    check_inputs(*inputs)
    check_outputs(
        [*inputs, options.blend_shapes],
        directories=[(options.blend_shapes_output, [])] if options.blend_shapes_output else [],
        files=[
            *(options.registered, options.attributes, options.landmarks_output, options.map_output),
            *(*options.overlay_output, options.volume_output),
        ],
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
    if not options.off_surface:
        check_frame(landmarks, source.mesh)
    return landmarks


def _read_overlays(options: argparse.Namespace, source: MeshData) -> list[Overlay]:
    """Read the overlays of the source, and check that they fit it and have different names."""
    from jaxsmw.io.overlays import read_overlay

    overlays = [read_overlay(file) for file in options.overlay]
    for overlay in overlays:
        overlay.added_to(source)
        for note in overlay.notes:
            say(f"note: {overlay.name}: {note}")
    return overlays


def _write_overlays(
    options: argparse.Namespace,
    source: MeshData,
    overlays: list[Overlay],
    registered: RegisteredMesh,
    stopwatch: Stopwatch,
) -> None:
    """Write each overlay on the target."""
    from jaxsmw.io.mesh_data import MeshData
    from jaxsmw.io.overlays import write_overlay
    from jaxsmw.transfer.attributes import transfer_attributes

    bare = MeshData(source.mesh, source.faces)
    for file, overlay in zip(options.overlay_output, overlays, strict=False):
        with stopwatch.step("overlays"):
            carried = transfer_attributes(overlay.added_to(bare), registered)
            notes = write_overlay(file, overlay.with_values_of(carried))
        for note in notes:
            say(f"note: {file}: {note}")
        report_written(file)


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


def _transfer_volume(file: str, volume: Volume, registered: RegisteredMesh, stopwatch: Stopwatch) -> None:
    """Transfer a volume, write it, and warn about inverted tetrahedra."""
    from jaxsmw.io.volumes import write_volume
    from jaxsmw.transfer.volumes import transfer_volume

    with stopwatch.step("volume", announced=True):
        transferred = transfer_volume(volume, registered)
        notes = write_volume(file, transferred.volume)
    for sentence in transferred.sentences():
        show(sentence)
    if transferred.inverted.any():
        say("warning: inverted tetrahedra remain: refine the volume there, or repair it with a mesher.")
    for note in notes:
        say(f"note: {file}: {note}")
    report_written(file)


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
        transferred = transfer_landmarks(
            landmarks, registered, expected_error=expected_error, off_surface=options.off_surface
        )
    for note in transferred.notes:
        say(f"note: {note}")
    _show_landmarks(transferred)
    if options.landmarks_output:
        for note in write_landmark_file(options.landmarks_output, transferred.landmarks):
            say(f"note: {options.landmarks_output}: {note}")
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
    from jaxsmw.io.blend_shapes import write_blend_shapes
    from jaxsmw.transfer.attributes import registered_data, transfer_attributes

    if options.registered:
        _write(options.registered, registered_data(source, registered), stopwatch)
    if not (options.attributes or options.blend_shapes_output):
        return
    with stopwatch.step("attributes", announced=True):
        carried = transfer_attributes(source, registered, target)
    for note in carried.mesh.notes[len(target.mesh.notes) :]:
        say(f"note: {note}")
    if options.attributes:
        _write(options.attributes, carried, stopwatch)
    if options.blend_shapes_output:
        own = replace(
            carried, blend_shapes={name: carried.blend_shapes[name] for name in source.blend_shapes}
        )
        report_written(*write_blend_shapes(options.blend_shapes_output, own))


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
