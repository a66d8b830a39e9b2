"""The files of a collection: maps, registered meshes, the shape model, landmarks and a summary."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxsmw.collection.result import Collection
from jaxsmw.collection.semilandmarks import TITLES, Semilandmarks, Sliders
from jaxsmw.collection.shape_models import ProcrustesAlignment, ShapeModel, modes_of
from jaxsmw.errors import InputError, naming
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.io.formats.morphometrics import format_specimens
from jaxsmw.io.formats.npz import read_arrays
from jaxsmw.io.landmark_files import write_landmark_file
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.io.maps import write_pointwise_map
from jaxsmw.io.mesh_data import MeshData
from jaxsmw.io.meshes import read_mesh, write_mesh_data
from jaxsmw.runtime.files import atomic_write, check_writable, make_directory, read_bytes, write_csv
from jaxsmw.transfer.attributes import registered_data, transfer_attributes
from jaxsmw.transfer.landmarks import transfer_landmarks

logger = logging.getLogger("jaxsmw")

# Factors of size that differ from 1 by less are rounding errors.
_ROUNDING = 1e-9

# The files and directories that contain results. The mean shape is not listed, because users choose its
# suffix.
RESULT_FILES = ("collection.json", "index.html", "modes.npz", "scores.csv")
RESULT_DIRECTORIES = ("maps", "registered", "landmarks", "attributes", "semilandmarks")


def write_maps(collection: Collection, directory: Path) -> list[Path]:
    """Write the maps between the template and all shapes, as 0-based vertices."""
    folder = make_directory(directory / "maps")
    written = []
    for shape, name in enumerate(collection.names):
        files = [folder / f"{name}_{way}_template.txt" for way in ("from", "to")]
        write_pointwise_map(files[0], collection.from_template(shape))
        write_pointwise_map(files[1], collection.to_template(shape))
        written += files
    return written


def write_registered(collection: Collection, template: MeshData, directory: Path, suffix: str) -> list[Path]:
    """Write the registered mesh of each shape, with the attributes of the template."""
    folder = make_directory(directory / "registered")
    other_hand = collection.mirrored != collection.mirrored[collection.template]

    def meshes() -> Iterator[tuple[Path, MeshData]]:
        for name, registered, turned in zip(collection.names, collection.registered, other_hand, strict=True):
            data = registered_data(template, registered)
            yield folder / f"{name}{suffix}", _turned(data) if turned else data

    return _write_meshes(meshes())


def _write_meshes(meshes: Iterable[tuple[Path, MeshData]]) -> list[Path]:
    """Write meshes, and log the data that the file format cannot contain for the first mesh alone."""
    written: list[Path] = []
    for path, data in meshes:
        warnings = write_mesh_data(path, data)
        for warning in () if written else warnings:
            logger.warning("%s", warning)
        written.append(path)
    return written


def _turned(data: MeshData) -> MeshData:
    """Reverse the faces, so that the normals of a mirror image point outward."""
    texture = None if data.texture is None else data.texture._replace(corners=data.texture.corners[:, ::-1])
    mesh = replace(data.mesh, faces=np.ascontiguousarray(data.mesh.faces[:, ::-1]))
    return replace(data, mesh=mesh, faces=data.faces[:, ::-1], texture=texture)


def write_attributes(
    collection: Collection, source: int, data: Sequence[MeshData], directory: Path, suffix: str
) -> list[Path]:
    """Transfer the attributes of the mesh `source` to all other meshes, and write these meshes."""
    folder = make_directory(directory / "attributes")
    return _write_meshes(
        (
            folder / f"{name}{suffix}",
            transfer_attributes(data[source], collection.registered_mesh(source, target), data[target]),
        )
        for target, name in enumerate(collection.names)
        if target != source
    )


def write_landmarks(
    collection: Collection, source: int, landmarks: Landmarks, directory: Path, suffix: str
) -> tuple[list[Path], tuple[str, ...]]:
    """Transfer the landmarks of the shape `source` to all other shapes, and write them.

    **Returns:** The written files, and a sentence about each landmark far from the surface.
    """
    folder = make_directory(directory / "landmarks")
    written: list[Path] = []
    notes: tuple[str, ...] = ()
    for target, name in enumerate(collection.names):
        if target != source:
            carried = transfer_landmarks(landmarks, collection.registered_mesh(source, target))
            notes = carried.notes  # the same for all targets, because the notes describe the source
            written.append(folder / f"{name}{suffix}")
            write_landmark_file(written[-1], carried.landmarks)
    return written, notes


def write_semilandmarks(
    collection: Collection, names: Sequence[str], found: Semilandmarks, sliders: Sliders, directory: Path
) -> list[Path]:
    """Write semilandmarks on all shapes as `.tps` and `.csv`, and the sliders, counted from 1."""
    folder = make_directory(directory / "semilandmarks")
    title = ["mesh", *(f"{name}_{axis}" for name in names for axis in "XYZ")]
    flat = found.positions.reshape(len(found.positions), -1).tolist()
    positions = ([name, *row] for name, row in zip(collection.names, flat, strict=True))
    tables: dict[str, Iterable[Sequence[object]]] = {
        "semilandmarks.csv": [title, *positions],
        "curves.csv": [TITLES, *(sliders.curves + 1).tolist()],
        "surfaces.csv": [["surface"], *([number + 1] for number in sliders.surfaces.tolist())],
    }
    for name, rows in tables.items():
        write_csv(folder / name, rows)
    text = format_specimens(collection.names, found.positions)
    with atomic_write(folder / "semilandmarks.tps") as temporary:
        temporary.write_text(text, "utf-8", errors="surrogateescape")
    return [folder / name for name in (*tables, "semilandmarks.tps")]


def write_model(collection: Collection, model: ShapeModel, directory: Path, suffix: str) -> list[Path]:
    """Write the mean shape, the modes and the scores; see `docs/how_to/match_collection.md`."""
    template = collection.meshes[collection.template]
    mean, motion = Mesh(model.mean, template.faces, "mean"), model.alignment
    write_mesh_data(directory / f"mean{suffix}", MeshData(mean, template.faces))
    with atomic_write(directory / "modes.npz") as temporary:
        np.savez_compressed(
            temporary,
            mean=model.mean,
            modes=model.modes,
            variances=model.variances,
            faces=template.faces,
            weights=model.weights,
            matrices=motion.scales[:, None, None] * motion.rotations * collection.signs[:, None, :],
            translations=motion.translations,
        )
    rows = [["mesh", *(f"mode_{number + 1}" for number in range(len(model.modes)))]]
    rows += [[name, *scores] for name, scores in zip(collection.names, model.scores.tolist(), strict=True)]
    write_csv(directory / "scores.csv", rows)
    return [directory / f"mean{suffix}", directory / "modes.npz", directory / "scores.csv"]


def read_shape_model(directory: str | os.PathLike[str]) -> tuple[ShapeModel, Mesh]:
    """Read the shape model that `jaxsmw collection` wrote to a directory.

    The model has all modes of the registered meshes, even if `--modes` left some out of the files.

    **Returns:** The `ShapeModel`, and the mean shape as a `Mesh` with the triangles of the template.

    **Raises:** `InputError` if the directory does not contain the complete results of a collection.
    """
    folder = Path(directory)
    with naming(folder / "modes.npz"):
        stored = read_arrays(read_bytes(folder / "modes.npz", largest=None))
        if missing := {"faces", "weights", "matrices", "translations"} - set(stored):
            raise InputError(f"contains no array called {min(missing)}: run `jaxsmw collection` again.")
    faces, weights, matrices, moves = (
        stored[name] for name in ("faces", "weights", "matrices", "translations")
    )
    registered = [
        file for file in _listed_files(folder / "collection.json") if file.startswith("registered/")
    ]
    by_name = {Path(file).stem: folder / file for file in registered}
    names = [
        str(shape.get("name")) for shape in _in_summary(folder / "collection.json", "shapes", list) or []
    ]
    if len(names) != len(matrices) or set(names) - set(by_name):
        raise InputError(
            f"{folder / 'collection.json'}: does not list the registered meshes of modes.npz: run `jaxsmw "
            "collection` again."
        )
    aligned = []
    for name, matrix, move in zip(names, matrices, moves, strict=True):
        mesh = read_mesh(by_name[name])
        if len(mesh.vertices) != len(weights):
            raise InputError(
                f"{by_name[name]}: has {len(mesh.vertices)} vertices, but modes.npz has {len(weights)}: run "
                "`jaxsmw collection` with --suffix .ply, which keeps the vertices."
            )
        aligned.append(mesh.vertices @ matrix.T + move)
    hands = np.sign(np.linalg.det(matrices))
    scales = np.cbrt(np.abs(np.linalg.det(matrices)))
    alignment = ProcrustesAlignment(
        np.array(aligned),
        np.mean(aligned, axis=0),
        # The matrices include the reflection of shapes of the other hand.
        matrices * np.where(hands[:, None] < 0, [-1.0, 1.0, 1.0], 1.0)[:, None] / scales[:, None, None],
        moves,
        scales,
        weights,
        bool(np.abs(scales - 1).max() > _ROUNDING),
    )
    return modes_of(alignment), make_mesh(alignment.mean, faces, name=str(folder / "mean"))


def write_summary(
    collection: Collection,
    measures: Mapping[str, Any],
    directory: Path,
    provenance: Mapping[str, Any],
    files: Sequence[Path] = (),
) -> None:
    """Write `collection.json`, with the figures of merit of the shape model and the other written files."""
    names = collection.names
    listed = sorted(file.relative_to(directory).as_posix() for file in files)
    contents = {
        "template": names[collection.template],
        "shapes": [
            {
                "name": name,
                "vertices": len(registered.mesh_y.vertices),
                "mirrored": bool(mirrored),
                "distance_of_registered_mesh": float(registered.distances.mean()),
                "flipped_triangles": float(registered.flipped_faces.mean()),
                "notes": list(registered.mesh_y.notes),
            }
            for name, registered, mirrored in zip(
                names, collection.registered, collection.mirrored, strict=True
            )
        ],
        "outliers": [names[shape] for shape in collection.outliers],
        "left_out": collection.left_out,
        "edges": [
            {
                "source": names[edge.source],
                "target": names[edge.target],
                "decision": edge.decision,
                "expected_error": _finite(edge.expected_error),
                "distortion": _finite(edge.distortion),
                "estimated_error": _finite(edge.estimated_error),
                "distance_from_consistent_map": _finite(edge.residual),
            }
            for edge in collection.edges
        ],
        "cycle_error": {
            name: float(errors.mean()) if len(errors) else None
            for name, errors in zip(("first", "final"), collection.cycle_errors, strict=True)
        },
        "shape_model": measures,
        "seconds": collection.seconds,
        "provenance": provenance,
        "files": listed,
    }
    with atomic_write(directory / "collection.json") as temporary:
        temporary.write_text(json.dumps(contents, indent=2, allow_nan=False) + "\n", "utf-8")


def read_template(directory: Path) -> str | None:
    """Return the name of the template of earlier results in a directory; None if there are no results."""
    return _in_summary(directory / "collection.json", "template", str)


def check_replaceable(directory: Path, names: Sequence[str]) -> None:
    """Refuse a directory with files of other origin, or with results for none of the meshes `names`."""
    if not (directory / "provenance.json").exists():
        if taken := [name for name in RESULT_FILES + RESULT_DIRECTORIES if (directory / name).exists()]:
            raise InputError(
                f"{directory}: contains {taken[0]}, but no results of a collection: choose another directory "
                "for the results."
            )
        return
    shapes = _in_summary(directory / "collection.json", "shapes", list) or []
    before = [str(shape.get("name")) for shape in shapes if isinstance(shape, dict)]
    if before and not set(before) & set(names):
        raise InputError(
            f"{directory}: contains the results of other meshes, such as {before[0]}: choose another "
            "directory for the results, or remove this directory."
        )


def replace_results(new: Path, directory: Path) -> None:
    """Move the complete results in `new` to a directory, and remove the results of an earlier run.

    An earlier result is removed if only the earlier `collection.json` lists it. The new `collection.json` is
    moved first, so that it lists all results even if the process is killed.
    """
    summary = new / "collection.json"
    for file in set(_listed_files(directory / "collection.json")) - set(_listed_files(summary)):
        with suppress(OSError):  # the list may be damaged
            (directory / file).unlink()
    for path in [summary, *sorted(new.rglob("*"))]:
        if path.is_file():
            target = directory / path.relative_to(new)
            make_directory(target.parent)
            check_writable(target)
            shutil.move(path, os.path.realpath(target))
    shutil.rmtree(new)


def _listed_files(summary: Path) -> list[str]:
    """Return the files that a summary lists, if they lie within the directory of the summary."""
    listed = _in_summary(summary, "files", list) or []
    return [file for file in listed if isinstance(file, str) and _LISTED.fullmatch(file)]


Kind = TypeVar("Kind")


def _in_summary(path: Path, name: str, kind: type[Kind]) -> Kind | None:
    """Return a value in a `collection.json`; None if the file is damaged or the value is of another kind."""
    with suppress(OSError, ValueError, RecursionError):
        summary = json.loads(path.read_text("utf-8"))
        if isinstance(summary, dict) and isinstance(summary.get(name), kind):
            return summary[name]
    return None


# `replace_results` removes only files that match this pattern. All matching paths lie inside the directory of
# the results.
_LISTED = re.compile(rf"(?:(?:{'|'.join(RESULT_DIRECTORIES)})/(?!\.\.)[^/\0]+|mean\.\w+)")


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
