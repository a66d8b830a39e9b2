"""`jaxsmw collection`: match all meshes of a directory consistently."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from jaxsmw.choices import DEFAULT_MIRROR, DEFAULT_PRESET, EDGES_PER_SHAPE, MirrorCollection, PresetName
from jaxsmw.cli.arguments import add_paths, add_processes, add_seed, add_weld, path, whole_number
from jaxsmw.cli.collection_inputs import Meshes, check_collection, read_collection
from jaxsmw.cli.console import Stopwatch, report_progress, say, show
from jaxsmw.cli.interruption import announce_consequence, quiet_children
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import make_directory, remove_leftovers
from jaxsmw.wording import count_of

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from jaxsmw.collection import Collection
    from jaxsmw.collection.shape_models import ShapeModel

HELP = "match all meshes of a directory consistently; register a template on each; compute a shape model"

# More edges cost time, but hardly improve the maps. (Table R26 of docs/research_log.md)
_MOST_EDGES = 6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "directory",
        metavar="DIRECTORY",
        type=path,
        help="directory with meshes of the same kind of body, each in a file of its own. Meshes that cannot "
        "be read or matched are named and left out",
    )
    parser.add_argument(
        "--output",
        metavar="DIR",
        type=path,
        required=True,
        help="directory for the results. An interrupted run is continued by the same command. If meshes are "
        "added to DIRECTORY, the same command matches only their own pairs",
    )
    add_paths(
        parser,
        {
            "--template FILE": "mesh of DIRECTORY whose triangulation all meshes receive (default: the "
            "template of earlier results in DIR, otherwise the mesh that is most similar to all others)"
        },
    )
    parser.add_argument(
        "--exclude",
        metavar="FILE",
        nargs="+",
        type=path,
        default=[],
        help="meshes of DIRECTORY to leave out, for example other kinds of bodies",
    )
    parser.add_argument(
        "--preset",
        choices=get_args(PresetName),
        default=DEFAULT_PRESET,
        help="method of refinement, as for match (default: %(default)s)",
    )
    parser.add_argument(
        "--mirror",
        choices=get_args(MirrorCollection),
        default=DEFAULT_MIRROR,
        help="auto finds meshes of opposite hands, such as left and right teeth, and matches their mirror "
        "images; no matches all meshes as they are (default: %(default)s)",
    )
    parser.add_argument(
        "--mirrored",
        metavar="FILE",
        nargs="+",
        type=path,
        default=[],
        help="meshes of DIRECTORY whose mirror images are matched, such as all left jaws among right jaws. "
        "Use this option for thin meshes, which --mirror auto cannot tell apart",
    )
    parser.add_argument(
        "--edges",
        metavar="N",
        type=whole_number(1, _MOST_EDGES),
        default=EDGES_PER_SHAPE,
        help=f"number of matched pairs divided by the number of meshes, at most {_MOST_EDGES} (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--scale",
        action="store_true",
        help="remove differences in size from the shape model (default: keep sizes)",
    )
    parser.add_argument(
        "--modes", metavar="N", type=whole_number(1), help="largest number of modes (default: all modes)"
    )
    parser.add_argument(
        "--suffix",
        metavar="SUFFIX",
        default=".ply",
        help="suffix of the written meshes, which determines their format (default: %(default)s)",
    )
    add_paths(
        parser,
        {
            "--landmarks FILE": "landmarks on one mesh, which are transferred to all meshes, in the formats "
            "of transfer --landmarks",
            "--landmarks-of FILE": "mesh of DIRECTORY to which the landmarks belong (default: the mesh with "
            "the name of the landmark file)",
            "--sliders FILE": "table (.csv) with the columns before, slide and after, which contain names of "
            "landmarks: these landmarks slide along curves. In rows with slide alone, they slide on the "
            "surface",
            "--attributes-of FILE": "mesh of DIRECTORY whose colours, labels, texture coordinates and other "
            "attributes are transferred to all meshes",
        },
    )
    add_seed(parser, "seed of the random pairs")
    add_processes(
        parser,
        default=None,
        purpose="number of worker processes that match pairs, each on one core (default: this process alone)",
    )
    add_weld(parser)


def run(options: argparse.Namespace) -> None:
    """Match all meshes of a directory, and write maps, registered meshes, the shape model and a page."""
    stopwatch = Stopwatch()
    with stopwatch.step("loading"):
        files = check_collection(options)
        from jaxsmw.collection.files import RESULT_DIRECTORIES, replace_results
        from jaxsmw.runtime.provenance import claimed_directory
    with stopwatch.step("reading"):
        meshes = read_collection(options, files)
    directory = make_directory(options.output)
    work = make_directory(directory / "work")
    announce_consequence(
        f"finished pairs are kept in {options.output}, and the same command continues from there"
    )
    with claimed_directory(directory, _provenance(options)), _executor(options) as executor:
        # Killed runs leave temporary files.
        for place in (directory, work, *(directory / name for name in RESULT_DIRECTORIES)):
            remove_leftovers(place)
        collection = _match(options, meshes, work, executor)
        collection.left_out.update(meshes.unreadable)
        stopwatch.add(collection.seconds)
        with stopwatch.step("shape model"):
            model = collection.shape_model(scale=options.scale, number_of_modes=options.modes)
            measures = _measures(model)
        with stopwatch.step("writing"):
            # Results of an earlier run are replaced only when all new results are complete.
            new = work / "new"
            shutil.rmtree(new, ignore_errors=True)  # a killed run left this directory
            _write(options, collection, meshes, model, measures, make_directory(new))
            replace_results(new, directory)
    _show(collection, model, scale=options.scale)
    show(f"time: {stopwatch.summary()}")
    report_progress(f"the results are in {options.output}")


@contextmanager
def _executor(options: argparse.Namespace) -> Iterator[Executor | None]:
    from jaxsmw.runtime.workers import open_executor

    if not (options.workers or options.scheduler):
        yield None
        return
    with quiet_children(), open_executor(options.workers or 1, options.scheduler) as executor:
        yield executor


def _provenance(options: argparse.Namespace) -> dict[str, dict[str, object]]:
    """Return the settings and versions that must be equal in all runs with the same output directory."""
    from jaxsmw.runtime.provenance import code_digest, measured_code, versions

    settings = {name: getattr(options, name) for name in ("preset", "mirror", "weld", "seed")}
    return {"settings": settings, "versions": {**versions(), "code": code_digest(measured_code())}}


def _match(options: argparse.Namespace, meshes: Meshes, work: Path, executor: Executor | None) -> Collection:
    from tqdm import tqdm

    from jaxsmw.collection.matching import match_collection

    mirrored = {Path(file).name for file in options.mirrored}
    bars: dict[str, tqdm] = {}

    def progress(step: str, done: int, number: int) -> None:
        if step not in bars:
            bars[step] = tqdm(total=number, desc=step, disable=options.quiet, smoothing=0)
        bars[step].total = number
        bars[step].update(done - bars[step].n)
        if done == number:
            bars.pop(step).close()

    return match_collection(
        [data.mesh for data in meshes.data.values()],
        names=list(meshes.names.values()),
        preset=options.preset,
        template=None if options.template is None else list(meshes.data).index(Path(options.template).name),
        mirror=[name in mirrored for name in meshes.data] if mirrored else options.mirror,
        edges_per_shape=options.edges,
        seed=options.seed,
        directory=work,
        executor=executor,
        progress=progress,
    )


def _measures(model: ShapeModel) -> dict[str, object]:
    """Return the variances and the figures of merit of a shape model, for `collection.json`."""
    count, modes = len(model.scores), len(model.modes)
    numbers = [number for number in _REPORTED_MODES if number <= min(modes, count - 2)]
    measures: dict[str, object] = {
        "variances": model.variances.tolist(),
        "compactness": model.compactness().tolist(),
        "numbers_of_modes": numbers,
    }
    if numbers:
        for name, curve in (
            ("generalisation", model.generalisation(numbers)),
            ("specificity", model.specificity(numbers)),
        ):
            measures[name] = {"mean": curve.mean.tolist(), "standard_error": curve.standard_error.tolist()}
    return measures


# If the sizes of two meshes differ by more than this factor, the meshes probably have different units of
# length.
_DIFFERENT_SIZES = 4

# Generalisation and specificity are reported for these numbers of modes. Numbers that are too large for the
# model are left out.
_REPORTED_MODES = (1, 2, 3, 5, 8, 12, 20, 30, 50)


def _write(
    options: argparse.Namespace,
    collection: Collection,
    meshes: Meshes,
    model: ShapeModel,
    measures: Mapping[str, object],
    directory: Path,
) -> None:
    from jaxsmw.collection.files import (
        write_attributes,
        write_landmarks,
        write_maps,
        write_model,
        write_registered,
        write_semilandmarks,
        write_summary,
    )
    from jaxsmw.collection.semilandmarks import place_semilandmarks
    from jaxsmw.io.landmark_files import check_readable_suffix
    from jaxsmw.report.collection_page import write_collection_page
    from jaxsmw.runtime.provenance import machine

    by_name = {meshes.names[file]: data for file, data in meshes.data.items()}
    kept = [by_name[name] for name in collection.names]

    def number(file: str) -> int:
        name = meshes.names[Path(file).name]
        if name not in collection.names:
            raise InputError(f"{file}: was left out of the collection: choose another mesh.")
        return collection.names.index(name)

    landmarks_of = number(options.landmarks_of) if options.landmarks_of else None
    attributes_of = number(options.attributes_of) if options.attributes_of else None
    files = write_maps(collection, directory)
    files += write_registered(collection, kept[collection.template], directory, options.suffix)
    files += write_model(collection, model, directory, options.suffix)
    if meshes.landmarks is not None and landmarks_of is not None:
        suffix = check_readable_suffix(options.landmarks)
        suffix = ".csv" if suffix == ".mps" else suffix  # no .mps files are written
        written, notes = write_landmarks(collection, landmarks_of, meshes.landmarks, directory, suffix)
        files += written
        for note in notes:
            say(f"note: {note}")
        if meshes.sliders is not None:
            slid = place_semilandmarks(collection, meshes.landmarks, meshes.sliders, source=landmarks_of)
            files += write_semilandmarks(collection, meshes.landmarks.names, slid, meshes.sliders, directory)
    if attributes_of is not None:
        files += write_attributes(collection, attributes_of, kept, directory, options.suffix)
    unlisted = ("directory", "output", "quiet", "run")
    settings = {name: value for name, value in vars(options).items() if name not in unlisted}
    provenance = {**_provenance(options), "settings": settings, "machine": machine()}
    write_summary(collection, measures, directory, provenance, [*files, directory / "index.html"])
    template = collection.meshes[collection.template]
    write_collection_page(
        directory / "index.html",
        names=collection.names,
        faces=template.faces,
        registered=[one.vertices for one in collection.registered],
        template=collection.template,
        edges=collection.edges,
        model=model,
        title=f"Collection {Path(options.directory).resolve().name}",
        notes=collection.decisions(),
        left_out=collection.left_out,
        warning=collection.warning,
    )


def _show(collection: Collection, model: ShapeModel, *, scale: bool) -> None:

    for sentence in collection.sentences():
        show(sentence)
    sizes = [mesh.area**0.5 for mesh in collection.meshes]
    if not scale and (ratio := max(sizes) / min(sizes)) > _DIFFERENT_SIZES:
        show(
            f"the largest mesh is {ratio:.3g} times as large as the smallest, which dominates the shape "
            "model: use --scale, or convert all meshes to one unit of length."
        )
    if len(shares := model.compactness()):
        first = ", ".join(f"{share:.0%}" for share in shares[:3])
        show(
            f"shape model: {count_of(len(shares), 'mode')}; the first modes together have {first} of the "
            "variance."
        )
