"""The scripts that measure speed print complete tables for small shapes."""

import sys
from argparse import Namespace
from pathlib import Path

import jax
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import benchmark_batches
import benchmark_speed

pytestmark = pytest.mark.study


@pytest.fixture(autouse=True)
def single_precision():
    """Use float32, because the scripts measure the library with its default precision."""
    with jax.enable_x64(False):
        yield


def test_every_way_to_refine_a_batch_is_measured(monkeypatch, capsys):
    arguments = ["--quick", "--vertices", "150", "--eigenvectors", "8"]
    monkeypatch.setattr(sys, "argv", ["benchmark_batches.py", *arguments])
    monkeypatch.setenv("JAXSMW_CACHE", "off")
    benchmark_batches.main()
    printed = capsys.readouterr().out
    rows = [line.split(" | ")[0].removeprefix("| ") for line in printed.splitlines() if line.startswith("| ")]
    assert rows[1:] == ["products alone", "loop", "lax.map", "vmap of 2", "vmap of 8", "refine_pairs"]


@pytest.mark.parametrize(
    "part", [benchmark_speed.refinement, benchmark_speed.eigenbasis, benchmark_speed.stages]
)
def test_each_part_of_the_speed_benchmark_measures_positive_times(part, monkeypatch):
    monkeypatch.setattr(benchmark_speed, "EIGENVECTORS", 30)
    monkeypatch.setattr(benchmark_speed, "SAMPLES", 100)
    measured = list(part(Namespace(sizes=[1000], repeats=1, quick=True, data=None)))
    assert measured
    for title, note, (header, *rows), numbers in measured:
        assert title and note and rows and all(len(row) == len(header) for row in rows)
        assert min(numbers["seconds"].values()) > 0
