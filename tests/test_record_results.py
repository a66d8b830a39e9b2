"""Hashes of results are equal in every run, and show which result has changed."""

import dataclasses

import jax
import numpy as np
import pytest
import record_results

import jaxsmw

pytestmark = pytest.mark.study


def test_two_runs_agree_and_an_interrupted_run_continues(tmp_path, capsys):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    call = ["--data", str(tmp_path), "--only", "coarse [pf]*-wks", "--output"]
    assert record_results.main([*call, str(first)]) == 0
    header, row, _ = first.read_text().splitlines()
    second.write_text(f"{header}\n{row}\ncoarse fast-w")  # as after a kill
    assert record_results.main([*call, str(second), "--compare", str(first)]) == 0
    assert "0 of 2 cases differ" in capsys.readouterr().out
    rows = record_results.recorded(second)
    assert list(rows) == ["coarse paper-wks", "coarse fast-wks"]
    for found in rows.values():
        assert found["status"].startswith("ok") and all(found[name] for name in record_results.RESULTS)
    *others, last = second.read_text().splitlines(keepends=True)
    second.write_text("".join([*others, last.replace(rows["coarse fast-wks"]["pointwise_map"], "0" * 16)]))
    assert record_results.main([*call, str(second), "--compare", str(first)]) == 1
    assert "coarse fast-wks: pointwise_map\n1 of 2 cases differ" in capsys.readouterr().out


def test_one_changed_match_is_found(tmp_path, monkeypatch):
    def row() -> record_results.Row:
        return record_results.run_case("coarse paper-wks", tmp_path)

    with jax.enable_x64(False):
        before = row()
        assert record_results.differences(before, row()) == []
        match = jaxsmw.match

        def changed(*meshes, **settings):
            found = match(*meshes, **settings)
            start = found.initial_map.copy()
            start[0] = (start[0] + 1) % len(found.mesh_y.vertices)
            return dataclasses.replace(found, initial_map=start)

        monkeypatch.setattr(jaxsmw, "match", changed)
        assert record_results.differences(before, row()) == ["initial_map"]
        monkeypatch.setattr(jaxsmw, "match", lambda *meshes, **settings: 1 / 0)
        assert "ZeroDivisionError: division by zero" in row()["status"]


def test_programs_are_compared_without_names():
    def lowered(function):
        function.__name__ = name
        return record_results.without_names(jax.jit(function).lower(np.zeros(3)).as_text())

    name = "first"
    before = lowered(lambda x: jax.jit(lambda y: y @ y)(x) + 1)
    name = "second"
    assert lowered(lambda x: jax.jit(lambda y: y @ y)(x) + 1) == before
    assert lowered(lambda x: jax.jit(lambda y: y @ y)(x) + 2) != before
    assert "@0" in before and "second" not in before and "first" not in before
