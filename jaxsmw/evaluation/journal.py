"""Results on disk that survive an interruption at any moment, and are never mixed with those of others."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from filelock import FileLock, Timeout

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write

Row = dict[str, Any]


class Journal:
    """A CSV file that grows by whole rows: what was appended once is there for good.

    A line that a killed process left half written is cut off when the file is opened again.

    **Arguments:**

    - `path`: the file; it need not be there yet.
    - `key`: the columns that tell rows apart. Of two rows with the same key the first counts.
    """

    def __init__(self, path: Path, key: Sequence[str]):
        self.path = path
        self.key = tuple(key)
        self._fields: list[str] = []
        self._rows: dict[tuple[str, ...], Row] = {}
        if path.exists():
            contents = path.read_bytes()
            whole = contents.rfind(b"\n") + 1
            if whole < len(contents):
                os.truncate(path, whole)
            reader = csv.DictReader(io.StringIO(contents[:whole].decode()))
            self._fields = list(reader.fieldnames or [])
            self._remember(reader)

    @property
    def rows(self) -> list[Row]:
        """All rows, in the order of their keys' first appearance; every value is text."""
        return list(self._rows.values())

    def __contains__(self, key: Sequence[Any]) -> bool:
        return tuple(map(str, key)) in self._rows

    def __getitem__(self, key: Sequence[Any]) -> Row:
        return self._rows[tuple(map(str, key))]

    def append(self, rows: Sequence[Row]) -> None:
        """Add rows, all with the same columns, and return when they are on the disk."""
        if not rows:
            return
        text = io.StringIO()
        header = not self._fields
        self._fields = self._fields or list(rows[0])
        writer = csv.DictWriter(text, self._fields, lineterminator="\n")
        if header:
            writer.writeheader()
        writer.writerows(rows)
        with self.path.open("ab") as file:
            file.write(text.getvalue().encode())
            file.flush()
            os.fsync(file.fileno())
        self._remember({name: str(value) for name, value in row.items()} for row in rows)

    def sort(self, keys: Iterable[Sequence[Any]]) -> None:
        """Rewrite the file with its rows in a given order; workers side by side did not keep one."""
        self._rows = {tuple(map(str, key)): self._rows[tuple(map(str, key))] for key in keys}
        with atomic_write(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._fields, lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)

    def _remember(self, rows: Iterable[Row]) -> None:
        for row in rows:
            self._rows.setdefault(tuple(row[name] for name in self.key), row)


@contextmanager
def claimed_directory(
    directory: Path,
    provenance: Mapping[str, Mapping[str, Any]],
    noted: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[None]:
    """Keep other processes out of a directory while results are added to it.

    What these come from is noted in `provenance.json`, or found there to be the same. `noted` are facts
    about the first time that may differ later.

    **Raises:** `InputError` if the directory holds results that come from something else, or another
    process is adding to it.
    """
    try:
        # The operating system lets go of the lock however the process ends.
        with FileLock(directory / ".lock", timeout=0):
            _check_origin(directory, provenance, noted)
            yield
    except Timeout:
        raise InputError(
            f"{directory}: another run is adding results: wait for its end, or give another --output."
        ) from None


def _check_origin(
    directory: Path, provenance: Mapping[str, Mapping[str, Any]], noted: Mapping[str, Any]
) -> None:
    path = directory / "provenance.json"
    wanted = json.loads(json.dumps(provenance))
    if path.exists():
        try:
            found = json.loads(path.read_text("utf-8"))
        except ValueError:
            raise InputError(f"{path}: is damaged: give another --output, or remove the directory.") from None
        found.pop("noted", None)
        for group in {**found, **wanted}:
            before, now = found.get(group, {}), wanted.get(group, {})
            for name in {**before, **now}:
                if before.get(name) != now.get(name):
                    raise InputError(
                        f"{directory}: holds results for which the {name} in {group} was "
                        f"{before.get(name)} and not {now.get(name)}: give another --output, or remove it."
                    )
    elif any(directory.glob("*.csv")):
        raise InputError(f"{directory}: holds results of unknown origin: give another --output.")
    else:
        contents = {**wanted, "noted": dict(noted)} if noted else wanted
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(contents, indent=2) + "\n", "utf-8")
