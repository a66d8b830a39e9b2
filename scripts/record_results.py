"""Writes hashes of results, so that a change of the code can be shown to keep every result bit for bit.

    python scripts/record_results.py --data DATA_DIRECTORY --output after.csv --compare before.csv
    python scripts/record_results.py --programs --output programs.csv

The first command writes a row for each case of `recorded_cases.py`: a match, a collection, a batch or a
command. A row contains hashes of the maps, of the expected errors and of further results (`other`), such as
the number of iterations, the history and the overlap. The second command writes hashes of the
StableHLO of the stages of all presets. Symbols are numbered, so that other names of functions do not matter.

`--only PATTERN` chooses cases by name, such as `"quadruped *"`. A second call continues an interrupted one.
Cases that OUTPUT contains are not run again. `--compare` names the cases and columns that differ, and returns
exit status 1 if there are any. All cases run on one thread. Compare only files from one machine with the
same versions of the software, which a JSON file next to OUTPUT states.
"""

from __future__ import annotations

import csv
import fnmatch
import hashlib
import json
import multiprocessing
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest.mock import patch

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from common import make_parser
from recorded_cases import (
    ACCURATE,
    COMMANDS,
    FOUR,
    MATCHES,
    MIRRORED,
    PEOPLE,
    SETTINGS,
    TEETH,
    changed,
    creatures,
    read,
)
from scipy.spatial import KDTree

import jaxsmw
from jaxsmw import FeatureRegression, Registration, Stage
from jaxsmw.geometry import farthest_point_samples

Row = dict[str, str]
RESULTS = (
    *("status", "pointwise_map", "initial_map", "functional_map", "distortion", "suspicious", "mirrored"),
    *("expected_error", "expected_error_raw", "other"),
)
PROGRAMS = "status", "program"
CASES_PER_PROCESS = 45
ONE_THREAD = {
    **dict.fromkeys(("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
    "JAXSMW_CACHE": "off",
}


def cases() -> dict[str, Callable[[Path], Row]]:
    """Return the function that runs each case, in the order in which the cases run."""
    found: dict[str, Callable[[Path], Row]] = {}
    for line in re.sub(r"\n +", " ", MATCHES.strip()).splitlines():
        pair, meshes, settings = line.split(": ")
        source, target = meshes.split(" -> ")
        for name in settings.split():
            found[f"{pair} {name}"] = partial(match, source, target, SETTINGS[name])
    return {
        **found,
        "further results": partial(further, FOUR[1], FOUR[0]),
        "collection creatures": partial(collection, FOUR),
        "collection paper": partial(collection, FOUR, preset="paper", template=1, seed=3),
        "collection mirrored": partial(collection, MIRRORED, mirror=[False, True, False, False]),
        "collection teeth": partial(collection, TEETH),
        "collection people": partial(collection, PEOPLE, mirror="no"),
        "pairs": partial(pairs, FOUR),
        "pairs in batches": partial(pairs, FOUR, batch_size=2),
        "pairs fast": partial(pairs, FOUR, batch_size=3, preset="fast"),
        "batch": partial(batch, history=True),
        "batch samples": partial(batch, samples=150, batch_size=2),
        "batch partial": partial(batch, partial=True, batch_size=3, stop_when_unchanged=True),
        "batch regression": partial(batch, refiner=FeatureRegression(levels=(20, 30, 40)), iterations=3),
        "batch registration": partial(
            batch, refiner=Registration(levels=(20, 40)), iterations=2, samples=150, starts_on_samples=True
        ),
        "vmap": vmapped,
        **{f"command {name}": partial(command, line) for name, line in COMMANDS.items()},
    }


def digest(*values: object) -> str:
    """Return 16 digits of the sha256 hash of arrays, with their types and shapes, and of other values."""
    found = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray | jax.Array):
            array = np.ascontiguousarray(value)
            found.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            found.update(repr(value).encode())
    return found.hexdigest()[:16]


def expected(errors: Iterable[np.ndarray]) -> Row:
    """Return the hashes of expected errors, and of the errors rounded to 9 significant digits."""
    arrays = [np.asarray(error, np.float64) for error in errors]
    rounded = [f"{value:.9g}" for array in arrays for value in array.ravel()]
    return {"expected_error": digest(rounded), "expected_error_raw": digest(*arrays)}


def described(*found: Any) -> Row:
    """Return the hashes of correspondences."""
    other: list[Any] = []
    for one in found:
        points = one.surface_points()
        other += [one.iterations, one.init, one.wrong_probability(), one.reverse_map()]
        other += [points.faces, points.weights]
        other += jax.tree.leaves(one.refinement.history)
        other += one.overlap() if one.pair.partial else ()
    return {
        "pointwise_map": digest(*(one.pointwise_map.astype(np.int64) for one in found)),
        "initial_map": digest(*(one.initial_map.astype(np.int64) for one in found)),
        "functional_map": digest(*(one.functional_map for one in found)),
        "distortion": " ".join(repr(one.distortion) for one in found),
        "suspicious": " ".join(repr(bool(one.suspicious)) for one in found),
        "mirrored": " ".join(repr(one.mirrored) for one in found),
        **expected(one.expected_error() for one in found),
        "other": digest(*other),
    }


def match(source: str, target: str, settings: dict[str, Any], data: Path) -> Row:
    """Match two meshes."""
    meshes, init = (read(source, data), read(target, data)), settings.get("init", "auto")
    if init in ("map", "points", "landmarks"):
        truth, true_map = creatures(source).truth, creatures(source).true_map
        marked = np.arange(0, len(true_map), 90)
        landmarks = np.stack([marked, true_map[marked]], axis=1)
        init = {"map": true_map, "points": truth, "landmarks": landmarks}[init]
    elif init.endswith(".map"):
        init = jaxsmw.read_pointwise_map(data / init, *meshes, index_base=1)
    return described(jaxsmw.match(*meshes, **{**settings, "init": init}))


def further(source: str, target: str, data: Path) -> Row:
    """Compute further results of a match."""
    found = jaxsmw.match(read(source, data), read(target, data))
    points, soft = found.reverse_surface_points(), found.soft_map()
    maps = found.one_to_one(), soft.pointwise_map(), points.faces, points.weights
    return {"other": digest(*maps, *jax.tree.leaves(soft), found.registered_mesh().vertices)}


def collection(places: list[str], data: Path, **settings: Any) -> Row:
    """Match a collection."""
    meshes = [read(place, data) for place in places]
    found = jaxsmw.match_collection(meshes, names=[f"shape {i}" for i in range(len(meshes))], **settings)
    shapes, edges = range(len(found.meshes)), [astuple(edge) for edge in found.edges]
    return {
        "pointwise_map": digest(*(found.pointwise_map(i, j) for i in shapes for j in shapes if i != j)),
        "distortion": digest([edge.distortion for edge in found.edges]),
        "suspicious": repr(found.outliers),
        "mirrored": repr(found.mirrored.tolist()),
        **expected(np.array([edge.expected_error]) for edge in found.edges),
        "other": digest(
            found.template, edges, dict(found.left_out), *(one.vertices for one in found.registered)
        ),
    }


def pairs(places: list[str], data: Path, **settings: Any) -> Row:
    """Match some pairs of several meshes."""
    meshes = [read(place, data) for place in places]
    found = dict(jaxsmw.match_pairs(meshes, [(0, 1), (2, 0), (3, 1)], **settings))
    return described(*(found[number] for number in sorted(found)))


def problem(data: Path, chosen: list[tuple[int, int]]) -> tuple[list[jaxsmw.Mesh], list[Any], list[Any]]:
    """Return meshes of different sizes, their spectra, and an initial map for each pair."""
    meshes = [read(place, data) for place in (*FOUR[:2], "quadruped 1300 0 source")]
    starts = [KDTree(meshes[j].vertices).query(meshes[i].vertices)[1] for i, j in chosen]
    return meshes, [jaxsmw.compute_spectrum(mesh, 40) for mesh in meshes], starts


def refined(*found: jaxsmw.Refinement) -> Row:
    """Return the hashes of refinements."""
    return {
        "pointwise_map": digest(*(one.pointwise_map for one in found)),
        "functional_map": digest(*(one.functional_map for one in found)),
        "other": digest(
            *(value for one in found for value in (one.iterations, *jax.tree.leaves(one.history)))
        ),
    }


def batch(data: Path, samples: int | None = None, **settings: Any) -> Row:
    """Refine pairs of different sizes, which are padded."""
    chosen = [(0, 1), (1, 0), (2, 0), (1, 2), (0, 1)]
    meshes, spectra, starts = problem(data, chosen)
    if samples:
        settings["samples"] = [jnp.asarray(farthest_point_samples(mesh, samples)) for mesh in meshes]
    found = dict(jaxsmw.refine_pairs(spectra, chosen, starts, **settings))
    return refined(*(found[number] for number in sorted(found)))


def vmapped(data: Path) -> Row:
    """Refine two pairs at the same time."""
    _, spectra, starts = problem(data, [(0, 1), (0, 2)])
    x, y = jaxsmw.stack([spectra[0], spectra[0]]), jaxsmw.stack(spectra[1:])
    return refined(jax.vmap(jaxsmw.refine)(x, y, jnp.asarray(np.stack(starts))))


def command(line: str, data: Path) -> Row:
    """Run a command, and return the hash of the files that it writes."""
    with tempfile.TemporaryDirectory() as directory:
        place, pair = Path(directory), creatures(FOUR[0])
        (place / "one.txt").write_text("cuts_wolf_shape_4 wolf\n")
        (place / "scape").mkdir()
        meshes = {"source": pair.source, "target": pair.target, "part": changed(pair.source, "part", 0.6)}
        for number, stretch in enumerate(([1, 1, 1], [1.05, 1, 0.97], [1, 0.95, 1.04])):
            stretched = jaxsmw.make_mesh(pair.source.vertices * stretch, pair.source.faces)
            meshes[f"scape/mesh{number:03}"] = stretched
        for name, mesh in meshes.items():
            jaxsmw.write_mesh(place / f"{name}.off", mesh)
        given, words = set(place.rglob("*")), line.replace("DATA", str(data)).split()
        call = [sys.executable, "-m", "jaxsmw", *words]
        done = subprocess.run(call, cwd=place, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(done.stderr.replace(directory, "."))
        kinds = ".csv", ".txt", ".ply", ".off"
        written = [file for file in sorted({*place.rglob("*")} - given) if file.suffix in kinds]
        return {"other": digest([(file.name, without_times(file)) for file in written])}


def without_times(file: Path) -> bytes | list[Row]:
    """Return the contents of a file. Tables are returned without the columns of times and of the machine."""
    if file.suffix != ".csv":
        return file.read_bytes()
    with file.open(newline="") as table:
        rows = list(csv.DictReader(table))
    return [{k: v for k, v in row.items() if not k.startswith(("seconds", "machine"))} for row in rows]


# ---------------------------------------------------------------------------------------------- the programs


def programs() -> dict[str, Callable[[Path], Row]]:
    """Return the function that traces each program of a stage."""
    search, large, last = ACCURATE.search, ACCURATE.large, ACCURATE.stages[-1]
    assert search is not None and large is not None
    stages = {
        **{f"{name} {i}": s for name, preset in jaxsmw.PRESETS.items() for i, s in enumerate(preset.stages)},
        **{f"accurate large {i}": stage for i, stage in enumerate(large.stages)},
        "accurate trimmed": last.with_levels(search.trimmed_levels),
        **{f"accurate coarse {i}": last.with_levels(levels) for i, levels in enumerate(search.coarse_levels)},
    }
    names = "{}, {}{}{}".format
    return {
        names(name, size, ", partial" * part, ", history" * history): partial(
            program, stage, *sizes, part, history
        )
        for name, stage in stages.items()
        for size, sizes in {"padded": (1152, 1152), "not padded": (1100, 1050)}.items()
        for part in (False, True)
        for history in (False, True)
    }


def program(stage: Stage, m: int, n: int, part: bool, history: bool, data: Path) -> Row:
    """Trace a stage for m and n vertices. A partial shape has fewer eigenvectors than the full shape."""
    k, samples = stage.number_of_eigenvectors, stage.number_of_samples
    x, y = outline(stage, m, k - k // 4 if part else k), outline(stage, n, k)
    refine: Any = eqx.filter_jit(jaxsmw.refine)  # its type does not state the method `lower`
    traced = refine.lower(
        x,
        y,
        jnp.zeros(m, jnp.int32),
        samples=None if samples is None else (jnp.zeros(samples, int),) * 2,
        **{**stage.settings(partial=part), "history": history},
    )
    return {"program": digest(without_names(traced.as_text()))}


def outline(stage: Stage, n: int, k: int) -> jaxsmw.Spectrum:
    """Return a spectrum of zeros with the data that a stage uses."""
    d, c = stage.number_of_descriptors, stage.number_of_crease_eigenvectors
    spectrum = jaxsmw.Spectrum(jnp.zeros(k), jnp.zeros((n, k)), jnp.zeros(n), jnp.zeros(n, bool))
    spectrum = spectrum.with_descriptors(jnp.zeros((n, d)) if d else None)
    spectrum = spectrum.with_crease_eigenvectors(jnp.zeros((n, c)) if c else None)
    return spectrum.with_positions(jnp.zeros((n, 3)), jnp.zeros((n, 3)))


def without_names(text: str) -> str:
    """Return StableHLO in which the module and the functions are numbered, and results have no names."""
    defined = re.findall(r"(?:module|func\.func)[^@\n]*@([\w.$]+)", text)
    numbers = {name: f"@{number}" for number, name in enumerate(dict.fromkeys(defined))}
    text = re.sub(r"@([\w.$]+)", lambda found: numbers.get(found[1], found[0]), text)
    return re.sub(r'jax\.result_info = "[^"]*"', "", text)


# --------------------------------------------------------------------------------------------------- the run


def run_case(name: str, data: Path, kind: Callable[[], dict[str, Callable[[Path], Row]]] = cases) -> Row:
    """Run a case, and return its row."""
    begin = time.perf_counter()
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        try:
            found = {"status": "", **kind()[name](data)}
        except Exception as error:  # a row states the error, and the other cases follow
            found = {"status": f"{type(error).__name__}: {error}"}
    sentence = " ".join(found["status"].replace(str(data), "DATA").split())
    found["status"] = sentence or f"ok, {len(issued)} warnings"
    return {"name": name, **found, "seconds": f"{time.perf_counter() - begin:.1f}"}


def recorded(path: Path) -> dict[str, Row]:
    """Return the rows of a file by their names. Remove a line that a killed process has left unfinished."""
    if not path.exists():
        return {}
    contents = path.read_bytes()
    whole = contents.rfind(b"\n") + 1
    if whole < len(contents):
        os.truncate(path, whole)
    return {row["name"]: row for row in csv.DictReader(contents[:whole].decode().splitlines())}


def differences(before: Row, after: Row) -> list[str]:
    """Return the names of the columns, except the time, in which two rows differ."""
    columns = [column for column in {**before, **after} if column != "seconds"]
    return [column for column in columns if before.get(column) != after.get(column)]


def provenance() -> dict[str, Any]:
    """Return the commit that last changed the library, the machine and the versions of the software."""
    call = ["git", "-C", jaxsmw.__path__[0], "log", "-1", "--format=%H", "--", "."]
    commit = subprocess.run(call, capture_output=True, text=True).stdout.strip()
    numerical = "jax", "jaxlib", "numpy", "scipy", "equinox", "lineax", "optimistix"
    packages = *numerical, "libigl", "robust-laplacian"
    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return {
        "commit": commit,
        "machine": f"{platform.platform()}, {model[1] if model else ''}, {os.cpu_count()} cores",
        "versions": {"python": platform.python_version(), **{p: metadata.version(p) for p in packages}},
        "environment": ONE_THREAD,
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the chosen cases, and return the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument("--data", type=Path, default=Path(), help="directory of the data sets")
    parser.add_argument("--output", type=Path, required=True, help="table of the hashes")
    parser.add_argument("--programs", action="store_true", help="hash the programs of all stages instead")
    parser.add_argument("--only", metavar="PATTERN", default="*", help="names of cases, with wildcards")
    parser.add_argument("--workers", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--compare", type=Path, metavar="CSV", help="table to compare with")
    options = parser.parse_args(arguments)
    kind, columns = (programs, PROGRAMS) if options.programs else (cases, RESULTS)
    names = fnmatch.filter(kind(), options.only)
    found = recorded(options.output)
    if not found:
        options.output.with_suffix(".json").write_text(json.dumps(provenance(), indent=2) + "\n")
        options.output.write_text(",".join(["name", *columns, "seconds"]) + "\n")
    context, data = multiprocessing.get_context("spawn"), options.data.resolve()
    missing = [name for name in names if name not in found]
    # New processes release the memory of compiled programs.
    for begin in range(0, len(missing), CASES_PER_PROCESS * options.workers):
        chosen = missing[begin : begin + CASES_PER_PROCESS * options.workers]
        pool = ProcessPoolExecutor(options.workers, mp_context=context)
        with patch.dict(os.environ, ONE_THREAD), pool as executor:
            for future in as_completed([executor.submit(run_case, name, data, kind) for name in chosen]):
                row = future.result()
                with options.output.open("a", newline="", encoding="utf-8") as file:
                    csv.DictWriter(file, ["name", *columns, "seconds"], lineterminator="\n").writerow(row)
                print(f"{row['name']}: {row['status'][:200]}, {row['seconds']} s", flush=True)
    if options.compare is None:
        return 0
    before, after = recorded(options.compare), recorded(options.output)
    different = {name: differences(before.get(name, {}), after[name]) for name in names}
    for name, where in different.items():
        if where:
            print(f"{name}: {', '.join(where)}" if name in before else f"{name}: not in {options.compare}")
    print(f"{sum(map(bool, different.values()))} of {len(names)} cases differ")
    return int(any(different.values()))


if __name__ == "__main__":
    sys.exit(main())
