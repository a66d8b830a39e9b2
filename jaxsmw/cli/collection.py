"""`jaxsmw collection`: match all meshes of a directory consistently."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, get_args

from jaxsmw.choices import DEFAULT_MIRROR, DEFAULT_PRESET, EDGES_PER_SHAPE, MirrorCollection, PresetName
from jaxsmw.cli.arguments import (
    add_paths,
    add_processes,
    add_seed,
    add_weld,
    option_of,
    path,
    refuse_without,
    whole_number,
)
from jaxsmw.cli.console import Stopwatch, report_progress, say, show
from jaxsmw.cli.interruption import announce_consequence, quiet_children
from jaxsmw.cli.outputs import check_outputs
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from jaxsmw.collection import Collection
    from jaxsmw.collection.shape_models import ShapeModel
    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.io.mesh_data import MeshData

HELP = "match all meshes of a directory consistently; register a template on each; compute a shape model"

# The options that name one mesh of the directory.
_ONE_MESH = ("template", "landmarks_of", "attributes_of")
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
        files = _mesh_files(options)
        _check(options, files)
        from jaxsmw.collection.files import RESULT_DIRECTORIES, check_replaceable, replace_results
        from jaxsmw.io.landmark_files import read_landmark_file
        from jaxsmw.io.landmarks import check_frame
        from jaxsmw.runtime.files import make_directory, remove_leftovers
        from jaxsmw.runtime.provenance import claimed_directory
    with stopwatch.step("reading"):
        _note_other_files(options)
        landmarks = read_landmark_file(options.landmarks) if options.landmarks else None
        meshes = _read(files, weld=options.weld)
    for option in _ONE_MESH:
        if (file := getattr(options, option)) and Path(file).name not in meshes.data:
            raise InputError(f"{option_of(option)}: {file} was left out (see above): choose another mesh.")
    if landmarks is not None:
        check_frame(landmarks, meshes.data[Path(options.landmarks_of).name].mesh)
    check_replaceable(Path(options.output), list(meshes.names.values()))
    _keep_template(options, meshes)
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
            _write(options, collection, meshes, landmarks, model, measures, make_directory(new))
            replace_results(new, directory)
    _show(collection, model, scale=options.scale)
    show(f"time: {stopwatch.summary()} (compilation included)")
    report_progress(f"the results are in {options.output}")


class _Meshes(NamedTuple):
    """The meshes of the directory that can be read, and the reasons why other files cannot be read.

    The keys are file names. `names` contains unique names for the results, such as `cat` for `cat.ply`, or
    `cat_ply` if there are two cats.
    """

    data: dict[str, MeshData]
    names: dict[str, str]
    unreadable: dict[str, str]


def _mesh_files(options: argparse.Namespace) -> dict[str, Path]:
    """Return the paths of the mesh files that are not excluded, by their names and in alphabetical order."""
    from jaxsmw.io.meshes import MESH_SUFFIXES
    from jaxsmw.wording import count_of

    directory = options.directory
    try:
        found = sorted(
            entry.name
            for entry in os.scandir(directory)
            if entry.is_file() and entry.name.lower().endswith(MESH_SUFFIXES)
        )
    except OSError as error:
        raise InputError(
            f"{directory}: cannot be read as a directory ({error.strerror}): give a directory with meshes."
        ) from error
    files = {name: Path(directory) / name for name in found}
    for name in {Path(_inside(options, "exclude", file, files)).name for file in options.exclude}:
        del files[name]
    if len(files) < 2:
        raise InputError(
            f"{directory}: contains {count_of(len(files), 'mesh file')}, but a collection needs two: give "
            f"a directory with meshes ({', '.join(MESH_SUFFIXES)})."
        )
    return files


# Files with these suffixes often accompany meshes: documents, tables, materials and pictures.
_COMPANIONS = (
    *(".txt", ".json", ".csv", ".md", ".pdf", ".mtl", ".bin"),
    *(".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".tga"),
)
# A note names at most this number of files.
_NAMED_FILES = 8


def _note_other_files(options: argparse.Namespace) -> None:
    """Print a note that names the files that are neither meshes nor usual companions of meshes."""
    from jaxsmw.io.landmark_files import LANDMARK_SUFFIXES
    from jaxsmw.io.meshes import MESH_SUFFIXES

    known = (*MESH_SUFFIXES, *LANDMARK_SUFFIXES, *_COMPANIONS)
    names = []
    for name in sorted(os.listdir(options.directory)):
        path = os.path.join(options.directory, name)
        if not os.path.exists(path):
            names.append(f"{name} (a broken link)")
        elif os.path.isfile(path) and not name.startswith(".") and not name.lower().endswith(known):
            names.append(name)
    if names:
        listed = ", ".join(names[:_NAMED_FILES])
        more = f" and {len(names) - _NAMED_FILES} more" if len(names) > _NAMED_FILES else ""
        say(
            f"note: {options.directory}: these files are not read: {listed}{more}. Meshes have the suffixes "
            f"{', '.join(MESH_SUFFIXES)}."
        )


def _inside(options: argparse.Namespace, option: str, file: str, files: Mapping[str, Path]) -> str:
    """Return the path of a mesh in the directory. The user gives either the path or only the file name."""
    for given in (file, os.path.join(options.directory, file)):
        if Path(file).name in files and _same(given, files[Path(file).name]):
            return given
    raise InputError(
        f"{option_of(option)}: {file} is not a mesh file in {options.directory}: give one of its files."
    )


def _check(options: argparse.Namespace, files: Mapping[str, Path]) -> None:
    """Check the options and the output directory before the long computation."""
    from jaxsmw.collection.files import RESULT_FILES
    from jaxsmw.io.landmark_files import check_readable_suffix
    from jaxsmw.io.meshes import check_mesh_suffix
    from jaxsmw.runtime.files import size_of_file

    refuse_without(options, "--landmarks", bool(options.landmarks), "landmarks_of")
    if not options.suffix.startswith("."):
        options.suffix = f".{options.suffix}"
    check_mesh_suffix(f"mesh{options.suffix}")
    if options.mirrored and options.mirror == "no":
        raise InputError("--mirrored needs --mirror auto: leave --mirror out.")
    options.mirrored = [_inside(options, "mirrored", file, files) for file in options.mirrored]
    if options.suffix.count(".") != 1 or "/" in options.suffix:
        raise InputError(f"--suffix: {options.suffix!r} is not a suffix: give for example .ply or .obj.")
    for option in _ONE_MESH:
        if file := getattr(options, option):
            setattr(options, option, _inside(options, option, file, files))
    if options.landmarks:
        size_of_file(options.landmarks)
        suffix = check_readable_suffix(options.landmarks)
        options.landmarks_of = options.landmarks_of or _mesh_of(options.landmarks, suffix, files)
    inputs = [*map(str, files.values()), *([options.landmarks] if options.landmarks else [])]
    check_outputs(inputs, directories=[(options.output, RESULT_FILES)])
    _refuse_results_as_inputs(options.output, inputs, files)
    if _same(options.output, Path(options.directory)):
        raise InputError(
            f"{options.output}: is the directory of the meshes: choose another directory for the results."
        )


# The longest file name that usual file systems allow, in bytes.
_LONGEST_NAME = 255


def _refuse_results_as_inputs(output: str, inputs: Iterable[str], names: Iterable[str]) -> None:
    """Refuse inputs that the results would replace, and mesh names that are too long for result files."""
    from jaxsmw.collection.files import RESULT_DIRECTORIES

    root = Path(os.path.realpath(output))
    for file in inputs:
        path = Path(os.path.realpath(file))
        inside = path.relative_to(root).parts if path.is_relative_to(root) else ()
        if inside and (inside[0] in (*RESULT_DIRECTORIES, "work") or path.stem == "mean"):
            raise InputError(
                f"{file}: lies among the results in {output}, which would replace it: choose another "
                "directory for the results."
            )
    for name in names:
        if len(os.fsencode(f".{'x' * 16}{name}_from_template.txt")) > _LONGEST_NAME:
            raise InputError(f"{name}: the file name is too long for the names of the results: shorten it.")


def _same(file: str, other: Path) -> bool:
    return os.path.realpath(file) == os.path.realpath(other)


def _mesh_of(landmarks: str, suffix: str, files: Mapping[str, Path]) -> str:
    """Return the mesh file that has the same name as a landmark file, apart from the suffix."""
    stem = Path(landmarks).name[: -len(suffix)]
    of_stem = [str(file) for name, file in files.items() if Path(name).stem == stem]
    if len(of_stem) != 1:
        raise InputError(
            f"{landmarks}: no single mesh is named {stem}: give --landmarks-of FILE, the mesh with these "
            "landmarks."
        )
    return of_stem[0]


def _read(files: Mapping[str, Path], *, weld: bool) -> _Meshes:
    from jaxsmw.io.meshes import read_mesh_data

    data: dict[str, MeshData] = {}
    unreadable = {}
    for name, file in files.items():
        try:
            data[name] = read_mesh_data(file, weld=weld)
            if notes := data[name].mesh.notes:
                report_progress(f"{name}: {' '.join(notes)}")
        except InputError as error:
            unreadable[name] = str(error)
            say(f"{name} is left out: {error}")
    if len(data) < 2:
        raise InputError(f"only {len(data)} of {len(files)} meshes can be read: a collection needs two.")
    for names in ([Path(name).stem for name in data], [name.replace(".", "_") for name in data], list(data)):
        if len(set(names)) == len(names):
            break
    return _Meshes(data, dict(zip(data, names, strict=True)), unreadable)


def _keep_template(options: argparse.Namespace, meshes: _Meshes) -> None:
    """Keep the template of earlier results, because another one would renumber all registered meshes."""
    from jaxsmw.collection.files import read_template

    earlier = None if options.template else read_template(Path(options.output))
    for file, name in meshes.names.items():
        if name == earlier:
            options.template = str(Path(options.directory) / file)
            report_progress(
                f"The template of the earlier results is kept: {name}. Choose another with --template."
            )


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


def _match(options: argparse.Namespace, meshes: _Meshes, work: Path, executor: Executor | None) -> Collection:
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
    meshes: _Meshes,
    landmarks: Landmarks | None,
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
        write_summary,
    )
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
    if landmarks is not None and landmarks_of is not None:
        suffix = check_readable_suffix(options.landmarks)
        suffix = ".csv" if suffix == ".mps" else suffix  # no .mps files are written
        written, notes = write_landmarks(collection, landmarks_of, landmarks, directory, suffix)
        files += written
        for note in notes:
            say(f"note: {note}")
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
    from jaxsmw.wording import count_of

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
