"""The files of a collection: maps, registered meshes, the shape model, landmarks and a summary."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsmw.collection.matching import Collection
from jaxsmw.collection.shape_models import ShapeModel
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.landmark_files import write_landmark_file
from jaxsmw.io.landmarks import Landmarks
from jaxsmw.io.map_files import write_pointwise_map
from jaxsmw.io.mesh_data import MeshData, write_mesh_data
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.transfer.attributes import registered_data, transfer_attributes
from jaxsmw.transfer.landmarks import transfer_landmarks


def write_maps(collection: Collection, directory: Path) -> None:
    """Write the maps between the template and all shapes, as 0-based vertices.

    The file `NAME_from_template.txt` has one vertex of the shape NAME for each vertex of the template. The
    file `NAME_to_template.txt` has one vertex of the template for each vertex of the shape.

    **Raises:** `InputError` if a file cannot be written.
    """
    folder = make_directory(directory / "maps")
    for shape, name in enumerate(collection.names):
        write_pointwise_map(folder / f"{name}_from_template.txt", collection.from_template(shape))
        write_pointwise_map(folder / f"{name}_to_template.txt", collection.to_template(shape))


def write_registered(collection: Collection, template: MeshData, directory: Path, suffix: str) -> None:
    """Write the registered mesh of each shape: the template's triangulation, with positions on the shape.

    **Arguments:**

    - `collection`: the collection.
    - `template`: the template with its attributes, which all registered meshes receive.
    - `directory`: the directory of the results.
    - `suffix`: the suffix of the files, such as `.ply`.

    **Raises:** `InputError` if a file cannot be written.
    """
    folder = make_directory(directory / "registered")
    for name, registered in zip(collection.names, collection.registered, strict=True):
        write_mesh_data(folder / f"{name}{suffix}", registered_data(template, registered))


def write_attributes(
    collection: Collection, source: int, data: Sequence[MeshData], directory: Path, suffix: str
) -> None:
    """Write each mesh with the attributes of one mesh; see `jaxsmw.transfer.transfer_attributes`.

    **Arguments:**

    - `collection`: the collection.
    - `source`: the number of the mesh whose attributes are transferred.
    - `data`: all meshes with their data.
    - `directory`: the directory of the results.
    - `suffix`: the suffix of the files.

    **Raises:** `InputError` if a file cannot be written.
    """
    folder = make_directory(directory / "attributes")
    for target, name in enumerate(collection.names):
        if target != source:
            registered = collection.registered_mesh(source, target)
            carried = transfer_attributes(data[source], registered, data[target])
            write_mesh_data(folder / f"{name}{suffix}", carried)


def write_landmarks(
    collection: Collection, source: int, landmarks: Landmarks, directory: Path, suffix: str
) -> None:
    """Write the landmarks of one shape on all other shapes.

    **Arguments:**

    - `collection`: the collection.
    - `source`: the number of the shape with the landmarks.
    - `landmarks`: the landmarks.
    - `directory`: the directory of the results.
    - `suffix`: the suffix of the files, such as `.mrk.json`.

    **Raises:** `InputError` if a landmark is not on the shape, or a file cannot be written.
    """
    folder = make_directory(directory / "landmarks")
    for target, name in enumerate(collection.names):
        if target != source:
            found = transfer_landmarks(landmarks, collection.registered_mesh(source, target))
            write_landmark_file(folder / f"{name}{suffix}", found.landmarks)


def write_model(collection: Collection, model: ShapeModel, directory: Path, suffix: str) -> None:
    """Write the mean shape, the modes (`modes.npz`) and the scores (`scores.csv`).

    The file `modes.npz` contains `mean` (n, 3), `modes` (k, n, 3), `variances` (k,), `faces` (f, 3) and
    `weights` (n,). The file `scores.csv` has one row per mesh and one column per mode.

    **Raises:** `InputError` if a file cannot be written.
    """
    template = collection.meshes[collection.template]
    mean = Mesh(model.mean, template.faces, "mean")
    write_mesh_data(directory / f"mean{suffix}", MeshData(mean, template.faces))
    with atomic_write(directory / "modes.npz") as temporary:
        np.savez_compressed(
            temporary,
            mean=model.mean,
            modes=model.modes,
            variances=model.variances,
            faces=template.faces,
            weights=model.weights,
        )
    with atomic_write(directory / "scores.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["mesh", *(f"mode_{number + 1}" for number in range(len(model.modes)))])
        for name, scores in zip(collection.names, model.scores, strict=True):
            writer.writerow([name, *map(repr, scores.tolist())])


def write_summary(
    collection: Collection,
    measures: Mapping[str, Any],
    directory: Path,
    provenance: Mapping[str, Any],
) -> None:
    """Write `collection.json`: the graph, the decisions, the errors, the times and the provenance.

    **Arguments:**

    - `collection`: the collection.
    - `measures`: the figures of merit of the shape model.
    - `directory`: the directory of the results.
    - `provenance`: versions, settings and the machine.

    **Raises:** `InputError` if the file cannot be written.
    """
    names = collection.names
    contents = {
        "template": names[collection.template],
        "shapes": [
            {"name": name, "vertices": len(mesh.vertices), "mirrored": bool(mirrored)}
            for name, mesh, mirrored in zip(names, collection.meshes, collection.mirrored, strict=True)
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
                "cycle_error": _finite(edge.cycle_error),
                "distance_from_consistent_map": _finite(edge.residual),
            }
            for edge in collection.edges
        ],
        "cycle_error": {
            name: float(errors.mean()) if len(errors) else None
            for name, errors in zip(("first", "final"), collection.cycle_errors or (), strict=False)
        },
        "shape_model": measures,
        "seconds": collection.seconds,
        "provenance": provenance,
    }
    with atomic_write(directory / "collection.json") as temporary:
        temporary.write_text(json.dumps(contents, indent=2, allow_nan=False) + "\n", "utf-8")


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
