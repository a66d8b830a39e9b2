"""The inputs of `jaxsmw collection`: the meshes of a directory, and checks of the options."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsmw.cli.arguments import option_of, refuse_without
from jaxsmw.cli.console import report_progress, say
from jaxsmw.cli.outputs import check_outputs
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import size_of_file
from jaxsmw.wording import count_of

if TYPE_CHECKING:
    from jaxsmw.collection.semilandmarks import Sliders
    from jaxsmw.io.landmarks import Landmarks
    from jaxsmw.io.mesh_data import MeshData

# The options that name one mesh of the directory.
_ONE_MESH = ("template", "landmarks_of", "attributes_of")


class Meshes(NamedTuple):
    """The meshes of the directory that can be read, and the reasons why other files cannot be read.

    The keys are file names. `names` contains unique names for the results, such as `cat` for `cat.ply`, or
    `cat_ply` if there are two cats. `landmarks` belong to the mesh of `--landmarks-of`. `sliders` are among
    these landmarks.
    """

    data: dict[str, MeshData]
    names: dict[str, str]
    unreadable: dict[str, str]
    landmarks: Landmarks | None
    sliders: Sliders | None = None


def check_collection(options: argparse.Namespace) -> dict[str, Path]:
    """Check the options and the output directory, and return the mesh files of the directory by their names.

    The options that name meshes receive the paths of these meshes.
    """
    from jaxsmw.collection.files import RESULT_FILES
    from jaxsmw.io.landmark_files import check_readable_suffix
    from jaxsmw.io.meshes import check_mesh_suffix

    files = _mesh_files(options)
    refuse_without(options, "--landmarks", bool(options.landmarks), "landmarks_of", "sliders")
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
        if options.sliders:
            size_of_file(options.sliders)
        options.landmarks_of = options.landmarks_of or _mesh_of(options.landmarks, suffix, files)
    inputs = [*map(str, files.values()), *filter(None, (options.landmarks, options.sliders))]
    check_outputs(inputs, directories=[(options.output, RESULT_FILES)])
    _refuse_results_as_inputs(options.output, inputs, files)
    if _same(options.output, Path(options.directory)):
        raise InputError(
            f"{options.output}: is the directory of the meshes: choose another directory for the results."
        )
    return files


def _mesh_files(options: argparse.Namespace) -> dict[str, Path]:
    """Return the paths of the mesh files that are not excluded, by their names and in alphabetical order."""
    from jaxsmw.io.meshes import MESH_SUFFIXES
    from jaxsmw.io.overlays import OVERLAY_SUFFIXES

    directory = options.directory
    try:
        names = sorted(entry.name for entry in os.scandir(directory) if entry.is_file())
    except OSError as error:
        raise InputError(
            f"{directory}: cannot be read as a directory ({error.strerror}): give a directory with meshes."
        ) from error
    names = [name for name in names if not name.lower().endswith(OVERLAY_SUFFIXES)]
    files = {name: Path(directory) / name for name in names if name.lower().endswith(MESH_SUFFIXES)}
    for name in {Path(_inside(options, "exclude", file, files)).name for file in options.exclude}:
        del files[name]
    if len(files) < 2:
        raise InputError(
            f"{directory}: contains {count_of(len(files), 'mesh file')}, but a collection needs two: give "
            f"a directory with meshes ({', '.join(MESH_SUFFIXES)})."
        )
    return files


def _inside(options: argparse.Namespace, option: str, file: str, files: Mapping[str, Path]) -> str:
    """Return the path of a mesh in the directory. The user gives either the path or only the file name."""
    for path in (file, os.path.join(options.directory, file)):
        if Path(file).name in files and _same(path, files[Path(file).name]):
            return path
    raise InputError(
        f"{option_of(option)}: {file} is not a mesh file in {options.directory}: give one of its files."
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


def read_collection(options: argparse.Namespace, files: Mapping[str, Path]) -> Meshes:
    """Read the meshes and the landmarks, and check that they fit the options and earlier results."""
    from jaxsmw.collection.files import check_replaceable
    from jaxsmw.collection.semilandmarks import read_sliders
    from jaxsmw.io.landmark_files import read_landmark_file
    from jaxsmw.io.landmarks import check_frame
    from jaxsmw.io.meshes import read_mesh_data

    _note_other_files(options)
    landmarks = read_landmark_file(options.landmarks) if options.landmarks else None
    sliders = None
    if landmarks is not None and options.sliders:
        sliders = read_sliders(options.sliders, landmarks.names)

    data: dict[str, MeshData] = {}
    unreadable = {}
    for name, path in files.items():
        try:
            data[name] = read_mesh_data(path, weld=options.weld)
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
    for option in _ONE_MESH:
        if (file := getattr(options, option)) and Path(file).name not in data:
            raise InputError(f"{option_of(option)}: {file} was left out (see above): choose another mesh.")
    if landmarks is not None:
        check_frame(landmarks, data[Path(options.landmarks_of).name].mesh)
    check_replaceable(Path(options.output), names)
    meshes = Meshes(data, dict(zip(data, names, strict=True)), unreadable, landmarks, sliders)
    _keep_template(options, meshes)
    return meshes


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
    from jaxsmw.io.overlays import OVERLAY_SUFFIXES

    usual = (*MESH_SUFFIXES, *LANDMARK_SUFFIXES, *OVERLAY_SUFFIXES, *_COMPANIONS)
    names = []
    for path in sorted(Path(options.directory).iterdir()):
        if not path.exists():
            names.append(f"{path.name} (a broken link)")
        elif path.is_file() and not path.name.startswith(".") and not path.name.lower().endswith(usual):
            names.append(path.name)
    if names:
        listed = ", ".join(names[:_NAMED_FILES])
        more = f" and {len(names) - _NAMED_FILES} more" if len(names) > _NAMED_FILES else ""
        say(
            f"note: {options.directory}: these files are not read: {listed}{more}. Meshes have the suffixes "
            f"{', '.join(MESH_SUFFIXES)}."
        )


def _keep_template(options: argparse.Namespace, meshes: Meshes) -> None:
    """Keep the template of earlier results, because another one would renumber all registered meshes."""
    from jaxsmw.collection.files import read_template

    earlier = None if options.template else read_template(Path(options.output))
    for file, name in meshes.names.items():
        if name == earlier:
            options.template = str(Path(options.directory) / file)
            report_progress(
                f"The template of the earlier results is kept: {name}. Choose another with --template."
            )
