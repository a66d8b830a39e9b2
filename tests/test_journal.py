"""Damaged result files are refused in one sentence and are not changed."""

import errno
import json
import os

import pytest
from messages import refused

from jaxsmw import InputError
from jaxsmw.benchmark.journal import Journal
from jaxsmw.runtime.provenance import claimed_directory

COLUMNS = {"name": str, "value": float}


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ("name,value\na,1\nb\n", "line 3: has 1 values for 2 columns"),
        ("name,value\na,1,2\n", "line 2: has 3 values for 2 columns"),
        ("name,value,name\na,1,a\n", "line 1: is not a header with the columns name"),
        ("value\n1\n", "line 1: is not a header with the columns name"),
        ("\n", "line 1: is not a header with the columns name"),
        ('name,value\n"a,1\n', "is not a table of results"),
    ],
)
def test_malformed_tables_are_refused(tmp_path, contents, message):
    path = tmp_path / "table.csv"
    path.write_text(contents)
    with pytest.raises(InputError, match=message):
        Journal(path, ["name"])
    assert path.read_text() == contents


def test_tables_with_wrong_columns_or_values_are_refused(tmp_path):
    path = tmp_path / "table.csv"
    for contents, message in (
        ("name,other\na,1\n", "line 1: is not the header name,value"),
        ("value,name\n1,a\n", "line 1: is not the header name,value"),
        ("name,value\na,1\nb,two\n", "line 3: has 'two' in the column value"),
        ("some text", "line 1: is not the header name,value"),
    ):
        path.write_text(contents)
        with pytest.raises(InputError, match=message):
            Journal(path, ["name"], COLUMNS)
        assert path.read_text() == contents
    path.write_text("name,va")
    journal = Journal(path, ["name"], COLUMNS)
    journal.append([{"name": "a", "value": 1}])
    assert path.read_text() == "name,value\na,1\n"
    with refused("columns name, value", "name, other"):
        journal.append([{"name": "b", "other": 1}])
    assert path.read_text() == "name,value\na,1\n"


def test_files_of_older_versions_may_lack_optional_columns(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("name\na\n")
    assert Journal(path, ["name"], COLUMNS, optional=["value"]).rows == [{"name": "a"}]
    with refused("line 1: is not the header name,value"):
        Journal(path, ["name"], COLUMNS)
    path.write_text("name,other\na,1\n")
    with refused("line 1: is not the header name,value"):
        Journal(path, ["name"], COLUMNS, optional=["value"])


def test_unreadable_and_unwritable_files_are_named(tmp_path):
    (tmp_path / "table.csv").mkdir()
    with refused("table.csv", "cannot be read", "Is a directory"):
        Journal(tmp_path / "table.csv", ["name"])
    with refused("table.csv", "cannot be written", "No such file or directory"):
        Journal(tmp_path / "nowhere" / "table.csv", ["name"]).append([{"name": "a"}])


@pytest.mark.parametrize(
    "contents", ["", "{", "[]", "5", "null", '{"settings": 5}', '{"noted": []}', "[" * 100_000, "\0"]
)
def test_damaged_provenance_is_refused(tmp_path, contents):
    origin = {"settings": {"seed": 0}}
    (tmp_path / "provenance.json").write_text(contents)
    with (
        refused("provenance.json", "damaged", "another --output"),
        claimed_directory(tmp_path, origin),
    ):
        pass
    assert (tmp_path / "provenance.json").read_text() == contents
    (tmp_path / "provenance.json").write_text(json.dumps(origin))
    with claimed_directory(tmp_path, origin):
        pass


def test_a_directory_that_cannot_be_locked_is_named(tmp_path):
    (tmp_path / ".lock").mkdir()
    with pytest.raises(InputError, match="cannot be locked"), claimed_directory(tmp_path, {}):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS])
def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch, number):
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(InputError, match="on a file system with locks"), claimed_directory(tmp_path, {}):
        pass
    assert not list(tmp_path.iterdir())
