"""One command repeats the comparisons of the paper, derives data sets, and reports failures."""

import argparse
import re
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import reproduce_paper
from synthetic import bumpy_mesh

from jaxsmw.benchmark.datasets import open_data_set
from jaxsmw.benchmark.opponents.registry import METHODS
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import read_mesh, write_mesh

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Three deformed bumpy spheres in the layout of a remeshed set, next to a directory without a data set."""
    directory = tmp_path_factory.mktemp("data")
    (directory / "papers").mkdir()
    (directory / "bumps" / "off").mkdir(parents=True)
    (directory / "bumps" / "corres").mkdir()
    mesh = bumpy_mesh(4)
    for number, factors in enumerate(([1, 1, 1], [1.05, 1, 0.97], [1, 0.95, 1.04])):
        name = f"bump{number}"
        moved = make_mesh(mesh.vertices * factors, mesh.faces)
        write_mesh(directory / "bumps" / "off" / f"{name}.off", moved)
        np.savetxt(directory / "bumps" / "corres" / f"{name}.vts", np.arange(1, 2563), fmt="%d")
    return directory


def test_every_changed_setting_belongs_to_its_method():
    found = reproduce_paper.other_settings()
    (stage,) = found["mwp: k = 200, iterations = 10"].stages
    assert (stage.number_of_eigenvectors, stage.iterations) == (200, 10)
    assert found["zoomout: first = 50"].first == 50 and found["zoomout: step = 1"].step == 1
    assert len(set(found.values())) == len(found) > 20


def test_smooth_shells_has_a_table_of_its_own(data):
    """SmoothShells takes as long per pair as all other methods together."""
    options = argparse.Namespace(pairs=1, seed=0, quick=False)
    sets = [open_data_set(data / "bumps")]
    (first,), (second,) = (
        list(table(sets, options)) for table in (reproduce_paper.table1, reproduce_paper.table2)
    )
    assert {"mwp", "zoomout", "cpd"} < first.methods.keys() and "smooth-shells" not in first.methods
    assert list(second.methods) == ["mwp", "accurate", "smooth-shells"]
    assert [pair.name for pair in first.pairs] == [pair.name for pair in second.pairs]


@pytest.mark.sampled
@pytest.mark.parametrize("name", reproduce_paper.MESHINGS)
def test_other_meshes_keep_the_ground_truth(data, tmp_path, name):
    data_set = open_data_set(data / "bumps")
    pair = data_set.pairs[0]
    derived = reproduce_paper.derive(tmp_path, [pair], name, reproduce_paper.MESHINGS[name])
    (found,) = derived.pairs
    (mesh_x, mesh_y), (same_x, other_y) = (
        [read_mesh(file) for file in both.meshes] for both in (pair, found)
    )
    np.testing.assert_array_equal(mesh_x.vertices, same_x.vertices)
    faces = {"finer": 4.0, "coarser": 0.25, "uneven": 0.5}[name] * len(mesh_y.faces)
    assert len(other_y.faces) == pytest.approx(faces, rel=0.01)
    before, after = pair.ground_truth(mesh_x, mesh_y), found.ground_truth(same_x, other_y)
    np.testing.assert_array_equal(before.source_vertices, after.source_vertices)
    moved = np.linalg.norm(mesh_y.vertices[before.targets] - other_y.vertices[after.targets], axis=1)
    edge = np.sqrt(2.3 * mesh_y.area / len(mesh_y.faces))
    assert (moved <= (0 if name == "finer" else 3 * edge)).all()


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs the command in this process with two methods, and returns its exit code."""
    some = {name: METHODS[name] for name in ("initial", "mwp")}
    monkeypatch.setattr(reproduce_paper, "methods", lambda *_: some)
    monkeypatch.setattr(reproduce_paper, "open_executor", lambda *_: ThreadPoolExecutor(1))

    def run(*arguments: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["reproduce_paper.py", *map(str, arguments)])
        try:
            reproduce_paper.main()
        except SystemExit as ended:
            return ended.code
        return 0

    return run


@pytest.mark.sampled
def test_one_command_gives_all_tables(command, data, tmp_path, capsys):
    assert command(data, "--output", tmp_path / "paper", "--quick", "--only", "table1", "fig7") == 0
    overview = (tmp_path / "paper" / "README.md").read_text()
    assert "## table1" in overview and re.search(r"\| mwp \| \d+\.\d, \d\.\d\d s \|", overview)
    assert "fig7" not in overview and "left out: " in capsys.readouterr().out
    assert "2 of 6 pairs" in (tmp_path / "paper" / "table1" / "bumps" / "summary.md").read_text()
    assert (tmp_path / "paper" / "table1" / "bumps" / "curves.png").stat().st_size > 1000


@pytest.mark.sampled
def test_failures_are_reported_at_the_end(command, data, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(data / "bumps", tmp_path / "data" / name)
    for file in (tmp_path / "data" / "a" / "off").iterdir():
        file.write_text("OFF\n1")
    call = [tmp_path / "data", "--output", tmp_path / "paper", "--quick", "--only", "table1"]
    assert command(*call) == 2
    printed = capsys.readouterr()
    assert "table1, a, bump" in printed.err and ".off" in printed.err
    assert "| mwp | — | " in (tmp_path / "paper" / "README.md").read_text()
    assert command(tmp_path / "nowhere", *call[1:]) == 2
