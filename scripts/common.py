"""Common code of the scripts: command lines, measurements in parts or pairs, and files of scans."""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxsmw.benchmark.datasets import DataPair, DataSet, open_data_set
from jaxsmw.benchmark.journal import Journal
from jaxsmw.errors import InputError
from jaxsmw.io import Landmarks, read_landmark_file
from jaxsmw.runtime.files import atomic_write, make_directory

Part = tuple[str, str, list[list[str]], dict[str, Any]]
"""A tuple of a table's title, a note on the measurement, the rows of the table, and all measured numbers."""

PairT = TypeVar("PairT")
NameT = TypeVar("NameT")


def make_parser(
    description: str | None,
    *,
    data: str | None = None,
    parts: Collection[str] = (),
    faust: bool = False,
    output: str | None = None,
    pairs: int | None = None,
    seed: bool = False,
) -> argparse.ArgumentParser:
    """Return a parser that prints the description as it is, with the options that several scripts share.

    `data` is the name of a directory of data in the help text.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    if data is not None:
        parser.add_argument("data", type=Path, metavar=data)
    if parts:
        parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), metavar="PART")
    if faust:
        text = "the directory of the remeshed FAUST set"
        parser.add_argument("--data", type=Path, metavar="FAUST_R", help=text)
    if output is not None:
        text = "directory of the results (default: %(default)s)"
        parser.add_argument("--output", type=Path, default=Path(output), metavar="DIR", help=text)
    if pairs is not None:
        text = "number of pairs (default: %(default)s)"
        parser.add_argument("--pairs", type=int, default=pairs, metavar="N", help=text)
    if seed:
        text = "seed of the random draws (default: %(default)s)"
        parser.add_argument("--seed", type=int, default=0, help=text)
    return parser


def memory(entry: str) -> float:
    """Return an entry of `/proc/self/status` in GiB: "VmRSS", or its peak so far, "VmHWM"."""
    (kilobytes,) = re.findall(rf"{entry}:\s*(\d+) kB", Path("/proc/self/status").read_text("utf-8"))
    return int(kilobytes) / 2**20


def data_sets(directory: Path) -> Iterator[DataSet]:
    """Yield the data sets in a directory by their names. Other directories are left out."""
    for place in sorted(directory.iterdir()):
        with suppress(InputError):
            yield open_data_set(place)


def evenly_spread(pairs: Sequence[DataPair], number: int) -> list[DataPair]:
    """Return a number of pairs (at most all), evenly spread from the first to the last."""
    places = np.linspace(0, len(pairs) - 1, min(number, len(pairs)))
    return [pairs[int(place)] for place in np.round(places)]


def write_text(path: Path, text: str) -> None:
    """Write a whole text file."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def measure_parts(
    title: str,
    parts: Mapping[str, Callable[[argparse.Namespace], Iterator[Part]]],
    options: argparse.Namespace,
    draw: Callable[[dict[str, Any], Path], object] | None = None,
) -> None:
    """Measure the parts named in `options.only`, and print each table when it is measured.

    The tables and all numbers are written to files in `options.output`, with names made from the title. The
    function `draw` draws the numbers to a file.
    """
    # These modules import JAX, which processes that measure their memory must not do.
    from jaxsmw.benchmark.tables import markdown
    from jaxsmw.report.summary import provenance

    file = make_directory(options.output) / title.lower()
    # Other machines have other paths.
    arguments = [Path(argument).name if os.path.isabs(argument) else argument for argument in sys.argv]
    origin = {"command": shlex.join(["python", *arguments]), **provenance()}
    texts = [f"# {title}\n\n{json.dumps(origin)}"]
    numbers: dict[str, Any] = {"provenance": origin}
    print(texts[0])
    for name in options.only:
        numbers[name] = []
        for heading, note, rows, measured in parts[name](options):
            texts.append(f"## {heading}\n\n{note}\n\n{markdown(rows)}")
            print(f"\n{texts[-1]}", flush=True)
            numbers[name].append(measured)
            file.with_suffix(".md").write_text("\n\n".join(texts), "utf-8")
            file.with_suffix(".json").write_text(json.dumps(numbers, indent=1) + "\n", "utf-8")
            if draw is not None:
                draw(numbers, file.with_suffix(".png"))


def medians(
    candidates: Mapping[NameT, Callable[[], object]],
    repeats: int,
    clock: Callable[[], Any] = time.perf_counter,
    *,
    warm: bool = True,
) -> dict[NameT, Any]:
    """Run the candidates alternately, and return the median time of each candidate in seconds.

    **Arguments:**

    - `candidates`: the functions to time, by name.
    - `repeats`: the number of timed runs of each candidate.
    - `clock`: a function that returns the current time in seconds, or an array of times in seconds.
    - `warm`: whether each candidate first runs once without timing, so that JAX compiles it.
    """
    seconds: dict[NameT, list[Any]] = {name: [] for name in candidates}
    for turn in range(repeats + warm):
        for name, candidate in candidates.items():
            start = clock()
            result = candidate()
            if jax := sys.modules.get("jax"):
                jax.block_until_ready(result)
            if turn >= warm:
                seconds[name].append(clock() - start)
    return {name: np.median(times, axis=0).tolist() for name, times in seconds.items()}


def measure_pairs(
    file: Path,
    pairs: Iterable[PairT],
    names: Callable[[PairT], tuple[str, str]],
    measure: Callable[[PairT], dict[str, Any]],
) -> Journal:
    """Measure the pairs that a CSV file does not contain yet, and append and print each row."""
    make_directory(file.parent)
    journal = Journal(file, ("source", "target"))
    for pair in pairs:
        source, target = names(pair)
        if (source, target) not in journal:
            row = {"source": source, "target": target, **measure(pair)}
            journal.append([row])
            print(row, flush=True)
    return journal


def scan_files(directory: Path) -> list[Path]:
    """Return all mesh files of a data set below a directory."""
    return sorted(file for file in directory.rglob("*") if file.suffix in (".off", ".ply", ".vtk"))


def draw_scans(directory: Path, number: int) -> list[tuple[Path, Path]]:
    """Return at most `number` pairs of meshes of a data set, in random order.

    If there are fewer pairs, the same pairs in the reverse direction follow.
    """
    listing = directory / "test_pairs.txt"
    if listing.exists():
        by_name = {file.stem: file for file in directory.rglob("*.off")}
        lines = (line.split() for line in listing.read_text("utf-8").splitlines())
        pairs = [(by_name[Path(x).stem], by_name[Path(y).stem]) for x, y, *_ in lines]
    else:
        pairs = list(itertools.combinations(scan_files(directory), 2))
    if not pairs:
        raise InputError(f"{directory}: contains no meshes: give the directory of the data sets.")
    drawn = [pairs[i] for i in np.random.default_rng(0).permutation(len(pairs))]
    return [*drawn, *((y, x) for x, y in drawn)][:number]


def side_of(scan: Path) -> str:
    """Return the side of a tooth that `chirality.csv` states; an empty text for scans without a side."""
    table = scan.with_name("chirality.csv")
    if not table.exists():
        return ""
    with open(table, encoding="utf-8") as rows:
        sides = {row["name"]: row["side"] for row in csv.DictReader(rows)}
    return sides.get(scan.stem, sides.get(scan.stem.removesuffix("_sas"), ""))


def common_landmarks(*scans: Path) -> list[Landmarks]:
    """Return the manual landmarks that all scans have, for each scan."""
    landmarks = [_read_landmarks(scan) for scan in scans]
    names = [name for name in landmarks[0].names if all(name in of_scan.names for of_scan in landmarks)]
    return [of_scan.select(names) for of_scan in landmarks]


def _read_landmarks(scan: Path) -> Landmarks:
    """Read the manual landmarks of a scan from `SCAN.mrk.json`, `SCAN.csv` or `landmarks.csv`."""
    for file in (scan.with_suffix(".mrk.json"), scan.with_suffix(".csv")):
        if file.exists():
            return read_landmark_file(file)
    with open(scan.with_name("landmarks.csv"), encoding="utf-8") as rows:
        own = [row for row in csv.DictReader(rows) if row["mesh"] == scan.name]
    positions = np.array([[float(row[axis]) for axis in "xyz"] for row in own])
    return Landmarks(tuple(row["landmark"] for row in own), positions, name=str(scan))
