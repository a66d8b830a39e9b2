"""A CSV file of results that remains usable if the program is interrupted at any time."""

from __future__ import annotations

import csv
import io
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write

Row = dict[str, Any]
"""A row of a journal, by column names. In rows from a file, all values are text."""

Columns = Mapping[str, Callable[[str], Any]]
"""The columns of a journal in order, with functions that parse a value, or raise `ValueError`."""

_CURE = "restore the file, or remove it to measure its rows again"


class Journal:
    """A CSV file to which whole rows are appended.

    The key of a row is the tuple of its values in the key columns, compared as text. `key in journal` checks
    whether the journal contains a row with this key, and `journal[key]` returns the row. If a process was
    killed while it wrote a line, the unfinished line is removed when the file is opened again.

    **Arguments:**

    - `path`: the file, which need not exist yet.
    - `key`: the names of the key columns. If two rows have the same key, the second row is ignored.
    - `columns`: the required columns. If None, the file may have any columns besides the key columns.
    - `optional`: those of the columns that a file of an older version may lack.
    - `read_only`: whether an unfinished line is not removed, but ignored with a warning.

    **Raises:** `InputError` if the file cannot be read, or does not contain a table with these columns.
    """

    def __init__(
        self,
        path: Path,
        key: Sequence[str],
        columns: Columns | None = None,
        *,
        optional: Collection[str] = (),
        read_only: bool = False,
    ):
        self.path = path
        self._optional = optional
        self.key = tuple(key)
        self._fields: list[str] = [] if columns is None else list(columns)
        self._rows: dict[tuple[str, ...], Row] = {}
        if not path.exists():
            return
        try:
            contents = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}): {_CURE}.") from error
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
        """All rows, in the order in which their keys first appeared."""
        return list(self._rows.values())

    def __contains__(self, key: Sequence[Any]) -> bool:
        return tuple(map(str, key)) in self._rows

    def __getitem__(self, key: Sequence[Any]) -> Row:
        return self._rows[tuple(map(str, key))]

    def append(self, rows: Sequence[Row]) -> None:
        """Append rows to the file, and return after they have been written to disk.

        The first row of an empty file defines its columns.

        **Raises:** `InputError` if a row has other columns, or if the file cannot be written.
        """
        if not rows:
            return
        text = io.StringIO()
        fields = self._fields or list(rows[0])
        if other := [row for row in rows if set(row) != set(fields)]:
            raise InputError(
                f"{self.path}: has the columns {', '.join(fields)}, but a result has {', '.join(other[0])}: "
                "give another output directory, or remove the file."
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
                "or give another output directory."
            ) from error
        self._fields = fields
        self._remember({name: str(value) for name, value in row.items()} for row in rows)

    def remove(self, keys: Collection[tuple[str, ...]]) -> None:
        """Replace the file by one without the rows that have one of the keys.

        **Raises:** `InputError` if the file cannot be written.
        """
        if self._rows.keys().isdisjoint(keys):
            return
        self._rows = {key: row for key, row in self._rows.items() if key not in keys}
        with atomic_write(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._fields, lineterminator="\n")
            writer.writeheader()
            writer.writerows(self._rows.values())

    def _read(self, contents: bytes, columns: Columns) -> None:
        """Parse complete lines, check their values, and store their rows in memory."""
        try:
            reader = csv.reader(io.StringIO(contents.decode(), newline=""), strict=True)
            lines = [(reader.line_num, fields) for fields in reader]
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{self.path}: is not a table of results ({error}): {_CURE}.") from error
        _, header = lines[0]
        if columns and header != [name for name in columns if name in header or name not in self._optional]:
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
        return InputError(f"{self.path}, line {line}: {what}: {_CURE}.")

    def _remember(self, rows: Iterable[Row]) -> None:
        for row in rows:
            self._rows.setdefault(tuple(row[name] for name in self.key), row)


def _line(fields: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(fields)
    return text.getvalue()
