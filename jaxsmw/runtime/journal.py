"""Result files that remain usable if the program is interrupted at any time.

All results in a directory are measured with the same settings and software versions.
"""

from __future__ import annotations

import csv
import io
import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from filelock import FileLock, Timeout

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write, can_lock

Row = dict[str, Any]
"""A row of a journal: a dictionary from column names to values. In rows from a file, all values are text."""

Columns = Mapping[str, Callable[[str], Any]]
"""A mapping from the names of a journal's columns, in order, to functions that parse the values of a column.

Such a function takes the text of a value, and raises `ValueError` if the text is invalid.
"""


class Journal:
    """A CSV file to which whole rows are appended.

    The key of a row is the tuple of its values in the key columns, compared as text. `key in journal` checks
    whether the journal contains a row with this key, and `journal[key]` returns the row. If a process was
    killed while it wrote a line, the unfinished line is removed when the file is opened again.

    **Arguments:**

    - `path`: the file, which need not exist yet.
    - `key`: the names of the key columns. If two rows have the same key, the second row is ignored.
    - `columns`: a mapping from the name of each required column to the function that checks its values. If
      None, the file must have the key columns, and may have any other columns.
    - `read_only`: whether the file is only read. An unfinished line is then not removed, but ignored with
      a warning.

    **Raises:** `InputError` if the file cannot be read, or does not contain a table with these columns. If
    this error is raised, the file is not changed.
    """

    def __init__(
        self, path: Path, key: Sequence[str], columns: Columns | None = None, *, read_only: bool = False
    ):
        self.path = path
        self.key = tuple(key)
        self._fields: list[str] = [] if columns is None else list(columns)
        self._rows: dict[tuple[str, ...], Row] = {}
        if not path.exists():
            return
        try:
            contents = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}): {self._cure}.") from error
        whole = contents.rfind(b"\n") + 1
        if whole:
            self._read(contents[:whole], columns or {})
        elif not _line(self._fields).encode().startswith(contents) and columns is not None:
            raise self._fault(1, f"is not the header {','.join(self._fields)}")
        if whole == len(contents):
            return
        if read_only:
            warnings.warn(f"{path}: ends in an unfinished line, which is ignored.", stacklevel=2)
        else:
            os.truncate(path, whole)

    @property
    def rows(self) -> list[Row]:
        """All rows, in the order in which their keys first appeared. All values are text."""
        return list(self._rows.values())

    def __contains__(self, key: Sequence[Any]) -> bool:
        return tuple(map(str, key)) in self._rows

    def __getitem__(self, key: Sequence[Any]) -> Row:
        return self._rows[tuple(map(str, key))]

    def append(self, rows: Sequence[Row]) -> None:
        """Append rows to the file, and return after the rows have been written to disk.

        **Arguments:**

        - `rows`: rows with the columns of the file. If the file has no columns yet, the first row defines the
          columns.

        **Raises:** `InputError` if the columns of a row differ from the columns of the file, or if the file
        cannot be written.
        """
        if not rows:
            return
        text = io.StringIO()
        fields = self._fields or list(rows[0])
        if other := [row for row in rows if set(row) != set(fields)]:
            raise InputError(
                f"{self.path}: has the columns {', '.join(fields)}, but a result has {', '.join(other[0])}: "
                "give another --output, or remove the file."
            )
        writer = csv.DictWriter(text, fields, lineterminator="\n")
        try:
            with self.path.open("ab") as file:
                if file.tell() == 0:
                    writer.writeheader()
                writer.writerows(rows)
                file.write(text.getvalue().encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be written ({error.strerror}): check the directory and its free space, "
                "or give another --output."
            ) from error
        self._fields = fields
        self._remember({name: str(value) for name, value in row.items()} for row in rows)

    def sort(self, keys: Iterable[Sequence[Any]]) -> None:
        """Sort the rows of the file in the order of `keys`, and remove all other rows.

        Before this call the order of rows is arbitrary, because workers finish tasks in an arbitrary order.

        **Raises:** `KeyError` if the journal has no row for a key; `InputError` if the file cannot be
        written.
        """
        self._rows = {tuple(map(str, key)): self._rows[tuple(map(str, key))] for key in keys}
        with atomic_write(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._fields, lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)

    def _read(self, contents: bytes, columns: Columns) -> None:
        """Parse complete lines, check their values, and store their rows in memory.

        **Raises:** `InputError` if the contents are not a table with these columns.
        """
        try:
            reader = csv.reader(io.StringIO(contents.decode(), newline=""), strict=True)
            lines = [(reader.line_num, fields) for fields in reader]
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{self.path}: is not a table of results ({error}): {self._cure}.") from error
        _, header = lines[0]
        if columns and header != self._fields:
            raise self._fault(1, f"is not the header {','.join(self._fields)}")
        if len(set(header)) < len(header) or not set(self.key) <= set(header):
            raise self._fault(1, f"is not a header with the columns {', '.join(self.key)}")
        self._fields = header
        for number, fields in lines[1:]:
            if len(fields) != len(header):
                raise self._fault(number, f"has {len(fields)} values for {len(header)} columns")
            for name, value in zip(header, fields, strict=True):
                try:
                    columns.get(name, str)(value)
                except ValueError:
                    raise self._fault(
                        number, f"has {value[:40]!a} in the column {name}, which is not a valid value"
                    ) from None
        self._remember(dict(zip(header, fields, strict=True)) for _, fields in lines[1:])

    def _fault(self, line: int, what: str) -> InputError:
        return InputError(f"{self.path}, line {line}: {what}: {self._cure}.")

    @property
    def _cure(self) -> str:
        return "restore the file, or remove it to measure its rows again"

    def _remember(self, rows: Iterable[Row]) -> None:
        for row in rows:
            self._rows.setdefault(tuple(row[name] for name in self.key), row)


def _line(fields: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(fields)
    return text.getvalue()


@contextmanager
def claimed_directory(
    directory: Path,
    provenance: Mapping[str, Mapping[str, Any]],
    noted: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[None]:
    """Lock a directory against other processes while results are added.

    The function is a context manager, and releases the lock at the end of the `with` block. The first call
    for a directory writes `provenance` to the file `provenance.json`. Later calls check that their argument
    `provenance` equals the stored provenance.

    **Arguments:**

    - `directory`: an existing directory.
    - `provenance`: a dictionary from the name of each group, such as `"settings"`, to a dictionary of named
      values. These values must be the same for all results in the directory.
    - `noted`: a dictionary of further information that the first call writes to the file. Later calls ignore
      `noted`.

    **Raises:** `InputError` if the stored provenance differs from `provenance`, or if the directory contains
    results but no `provenance.json`. `InputError` is also raised if `provenance.json` is damaged, if the
    directory cannot be locked, or if another process is adding results.
    """
    if not can_lock(directory):
        # Some versions of `filelock` would report a lock of another process instead.
        raise InputError(
            f"{directory}: cannot be locked, because files cannot be created or locked there: give another "
            "--output, on a file system with locks."
        )
    # The operating system releases the lock even if the process is killed.
    lock = FileLock(directory / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{directory}: another process is adding results: wait until this process ends, or give another "
            "--output."
        ) from None
    except OSError as error:
        raise InputError(
            f"{directory}: cannot be locked ({error.strerror}): give another --output, or remove the "
            "directory."
        ) from error
    try:
        _check_origin(directory, provenance, noted)
        yield
    finally:
        lock.release()


def _check_origin(
    directory: Path, provenance: Mapping[str, Mapping[str, Any]], noted: Mapping[str, Any]
) -> None:
    path = directory / "provenance.json"
    wanted = json.loads(json.dumps(provenance))
    if path.exists():
        found = _read_provenance(path)
        found.pop("noted", None)
        for group in {**found, **wanted}:
            before, now = found.get(group, {}), wanted.get(group, {})
            for name in {**before, **now}:
                if before.get(name) != now.get(name):
                    raise InputError(
                        f"{directory}: contains results with {name} = {before.get(name)} ({group}), but this "
                        f"run has {name} = {now.get(name)}: give another --output, or remove the directory."
                    )
    elif any(directory.glob("*.csv")):
        raise InputError(
            f"{directory}: contains results of unknown origin, because provenance.json is missing: give "
            "another --output."
        )
    else:
        contents = {**wanted, "noted": dict(noted)} if noted else wanted
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(contents, indent=2) + "\n", "utf-8")


def _read_provenance(path: Path) -> dict[str, dict[str, Any]]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not all(isinstance(group, dict) for group in found.values()):
        raise InputError(f"{path}: the file is damaged: give another --output, or remove its directory.")
    return found
