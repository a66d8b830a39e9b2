"""Damaged result files are refused in one sentence and are not changed."""

import errno
import json
import os
from functools import partial

import numpy as np
import pytest
from messages import refused

from jaxsmw import InputError, Meyer, Stage, WaveletPreservation
from jaxsmw.banks import SoftmaxFrame
from jaxsmw.benchmark.journal import Journal
from jaxsmw.runtime.provenance import claimed_directory, code_digest, value_digest

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
        refused("provenance.json", "damaged", "another output directory"),
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


def row(name: str, value: float) -> dict[str, object]:
    return {"name": name, "value": value}


def test_journal_keeps_only_complete_rows(tmp_path):
    path = tmp_path / "table.csv"
    journal = Journal(path, ["name"])
    journal.append([row("a, with a comma", 1), row("b", 2)])
    whole = path.read_bytes()
    for torn in (b"c", b"c,3", b'"c, wi'):
        path.write_bytes(whole + torn)
        again = Journal(path, ["name"])
        assert again.rows == [{"name": "a, with a comma", "value": "1"}, {"name": "b", "value": "2"}]
        assert ["b"] in again and ["c"] not in again
        again.append([row("c", 3.5)])
        assert [r["value"] for r in Journal(path, ["name"]).rows] == ["1", "2", "3.5"]


def test_journal_survives_an_incomplete_header_and_repeated_rows(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"name,val")
    Journal(path, ["name"]).append([row("a", 1)])
    Journal(path, ["name"]).append([row("a", 2), row("b", 3)])
    journal = Journal(path, ["name"])
    assert [r["value"] for r in journal.rows] == ["1", "3"]


def test_results_of_different_origin_are_never_mixed(tmp_path):
    origin = {"settings": {"seed": 0, "frames": ("Meyer",)}, "versions": {"jax": "1.0"}}
    for _ in range(2):
        claim(tmp_path, origin)
    for group, name, value in (
        ("settings", "seed", 1),
        ("settings", "new", 1),
        ("settings", "frames", ("Meyer", "heat")),
        ("versions", "jax", "1.1"),
    ):
        with pytest.raises(InputError, match=name):
            claim(tmp_path, {**origin, group: {**origin[group], name: value}})
    with (
        claimed_directory(tmp_path, origin),
        pytest.raises(InputError, match="another process is adding results"),
    ):
        claim(tmp_path, origin)
    (tmp_path / "provenance.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        claim(tmp_path, origin)
    (tmp_path / "provenance.json").unlink()
    (tmp_path / "results.csv").touch()
    with pytest.raises(InputError, match="unknown origin"):
        claim(tmp_path, origin)


def claim(directory, origin):
    with claimed_directory(directory, origin):
        pass


def test_code_digest_depends_on_code_but_not_on_comments_or_layout(tmp_path):
    path = tmp_path / "code.py"

    def digest(text: str) -> str:
        path.write_text(text)
        return code_digest([path])

    plain = digest("def f(x):\n    return x + 1\n")
    assert digest('"""Doc."""\n\n# why\ndef f(x):\n    """More."""\n    return (x + 1)  # so\n') == plain
    assert digest("def f(x):\n    return x + 2\n") != plain


def scaled(factor):
    return lambda x: factor * x


def test_value_digest_depends_on_numbers_and_code():
    digests = [
        value_digest(value)
        for value in (
            WaveletPreservation(),
            WaveletPreservation(Meyer(5)),
            WaveletPreservation(SoftmaxFrame(np.zeros((3, 4)))),
            WaveletPreservation(SoftmaxFrame(np.ones((3, 4)))),
            Stage(number_of_eigenvectors=50),
            scaled(1),
            scaled(2),
            partial(max, 1),
            partial(max, 2),
            max,
        )
    ]
    assert len(set(digests)) == len(digests)
    assert value_digest(WaveletPreservation(Meyer(6))) == digests[0]
    assert value_digest(scaled(2)) == digests[6]
    itself: list[object] = []
    itself.append(itself)
    assert value_digest(itself)
