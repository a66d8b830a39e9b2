"""Measures a random part of stored benchmark results again, and compares the errors."""

from __future__ import annotations

import json
import os
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, get_args

import numpy as np

from jaxsmw.benchmark.benchmark import run_benchmark
from jaxsmw.benchmark.datasets import DataPair, DataSet
from jaxsmw.benchmark.journal import Journal, Row
from jaxsmw.benchmark.measurement import OPTIONAL_FIGURES, RESULT_COLUMNS, Settings
from jaxsmw.benchmark.opponents.base import Method
from jaxsmw.choices import MatchInit
from jaxsmw.errors import InputError

# This share of the stored pairs is measured again.
_SHARE = 0.1
# A stored error holds if the new error differs by at most this share of the stored error, or by at most this
# absolute difference, in units of the square root of the area. Rounding differs between processors, and can
# change single matches.
_RELATIVE, _ABSOLUTE = 0.02, 0.0005


class Comparison(NamedTuple):
    """A stored error and the error of a new measurement of the same method on the same pair.

    **Attributes:**

    - `source`, `target`, `method`: the names of the shapes and of the method.
    - `stored`, `measured`: the mean geodesic errors; NaN if the method failed.
    """

    source: str
    target: str
    method: str
    stored: float
    measured: float

    @property
    def difference(self) -> float:
        """The absolute difference of both errors, or inf if the method failed in only one measurement."""
        failed = np.isnan([self.stored, self.measured])
        if failed.any():
            return 0.0 if failed.all() else np.inf
        return abs(self.measured - self.stored)

    @property
    def holds(self) -> bool:
        """Whether the errors differ by at most 2 % of the stored error, or by at most 0.0005."""
        return self.difference <= max(_ABSOLUTE, _RELATIVE * self.stored) or self.difference == 0


class StoredResults:
    """The stored results of a benchmark, with the settings under which they were measured.

    **Arguments:**

    - `path`: the file `results.csv` of a benchmark, beside its `provenance.json`.
    - `init`: the directory with initial maps, if the results were measured from such a directory.

    **Attributes:**

    - `settings`: the `Settings` of the stored results.
    - `rows`: the stored rows.
    - `methods`: the names of the methods, in the order of the file.

    **Raises:** `InputError` if a file cannot be read, or the results were measured from other initial maps.
    """

    def __init__(self, path: Path, init: str | None = None):
        if not path.is_file():
            raise InputError(f"{path}: is not a file: give the results.csv of a benchmark.")
        self.path = path
        key = ["source", "target", "method"]
        journal = Journal(path, key, RESULT_COLUMNS, optional=OPTIONAL_FIGURES, read_only=True)
        self.rows: list[Row] = journal.rows
        if not self.rows:
            raise InputError(f"{path}: contains no results: give the results.csv of a benchmark.")
        self.methods = list(dict.fromkeys(row["method"] for row in self.rows))
        stored = _stored_settings(path.with_name("provenance.json"))
        init = stored["init"] if init is None else init
        if Path(init).name != stored["init"] or not (init in get_args(MatchInit) or os.path.isdir(init)):
            raise InputError(
                f"{path}: was measured with the initial maps {stored['init']}: give them with --init."
            )
        kept = ("mirrored", "evaluated_points", "seed")
        self.settings = Settings(init, **{name: stored[name] for name in kept})

    def chosen_methods(self, requested: Sequence[str] | None, available: Container[str]) -> list[str]:
        """Return the methods to measure again, as names or directories with maps of stored methods.

        By default, these are all stored methods, which must be `available` methods that need no directory.

        **Raises:** `InputError` if there are no stored results of a method, or a stored method needs a
        directory.
        """
        if requested is None:
            if unknown := [name for name in self.methods if name not in available]:
                raise InputError(
                    f"{self.path}: contains the method {unknown[0]}, whose maps come from a directory: give "
                    "--methods, with this directory or without this method."
                )
            return self.methods
        if missing := [name for name in requested if Path(name).name not in self.methods]:
            raise InputError(
                f"{self.path}: has no results of the method {missing[0]}: choose from "
                f"{', '.join(self.methods)}."
            )
        return list(requested)

    def draw(self, data_set: DataSet, seed: int) -> list[DataPair]:
        """Draw a tenth of the stored pairs at random, but at least one pair.

        **Raises:** `InputError` if the data set lacks a stored pair.
        """
        by_names = data_set.known_pairs
        stored = list(dict.fromkeys(_key(row)[:2] for row in self.rows))
        if unknown := [names for names in stored if names not in by_names]:
            raise InputError(
                f"{self.path}: contains the pair {' to '.join(unknown[0])}, which is not in "
                f"{data_set.directory}: give the data set of these results."
            )
        count = max(1, round(_SHARE * len(stored)))
        drawn = np.random.default_rng(seed).permutation(len(stored))[:count]
        return [by_names[stored[number]] for number in np.sort(drawn)]

    def measure_again(
        self,
        data_set: DataSet,
        pairs: Sequence[DataPair],
        methods: Mapping[str, Method],
        executor: Executor,
        *,
        quiet: bool = False,
    ) -> list[Comparison]:
        """Measure pairs again as `run_benchmark` does, and return a `Comparison` for each stored error.

        **Raises:** `InputError` if a pair cannot be measured.
        """
        with TemporaryDirectory() as directory:
            results = run_benchmark(
                data_set, pairs, Path(directory), methods, self.settings, executor, quiet=quiet
            )
        results.check()
        stored = {_key(row): float(row["mean"]) for row in self.rows}
        measured = {_key(row): float(row["mean"]) for row in results.rows}
        return [Comparison(*key, stored[key], error) for key, error in measured.items() if key in stored]


def _key(row: Row) -> tuple[str, str, str]:
    return row["source"], row["target"], row["method"]


def _stored_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a file `provenance.json`, or raise `InputError`."""
    try:
        settings = json.loads(path.read_text("utf-8"))["settings"]
        return {name: settings[name] for name in ("init", "mirrored", "evaluated_points", "seed")}
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}): restore the file, which a benchmark writes "
            "beside its results."
        ) from error
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: does not contain the settings of a benchmark: restore the file, which a benchmark "
            "writes beside its results."
        ) from None
