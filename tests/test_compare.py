"""`compare` measures methods of every kind on the same pairs, continues after a kill, and refuses bad input."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import bumpy_mesh

from jaxsmw import (
    CubicSpline,
    InputError,
    LeastSquares,
    Meyer,
    Pair,
    Stage,
    WaveletPreservation,
    initial_map,
    paired_spectra,
    refine,
)
from jaxsmw.benchmark import Comparison, DataPair, compare
from jaxsmw.benchmark.benchmark import Results
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.opponents import baselines
from jaxsmw.benchmark.opponents.baselines import UNREFINED
from jaxsmw.evaluation import GroundTruth, geodesic_error
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import write_mesh

K = 20
MWP = WaveletPreservation()
SPLINE = WaveletPreservation(CubicSpline(), LeastSquares())


def first_match(spectrum_x, spectrum_y, start_map):
    return start_map


def refined(spectrum_x, spectrum_y, start_map):
    assert spectrum_x.eigenvectors.shape[1] == K
    return refine(spectrum_x, spectrum_y, start_map, refiner=SPLINE, iterations=2).pointwise_map


def wrong_length(spectrum_x, spectrum_y, start_map):
    return start_map[1:]


def whole_result(spectrum_x, spectrum_y, start_map):
    return refine(spectrum_x, spectrum_y, start_map, iterations=1)


class WithoutStatus(WaveletPreservation):
    def update(self, prepared, pointwise_map, previous):
        return jnp.eye(K)


def broken(spectrum_x, spectrum_y, start_map):
    raise KeyError("no such thing")


class Misspelled(Meyer):
    def __call__(self, points, eigenvalues):
        return undefined_name


def failing(spectrum_x, spectrum_y, start_map):
    raise ArithmeticError("did not converge")


@pytest.fixture(scope="module")
def meshes():
    """Deformed copies of a bumpy sphere, in which equal vertices correspond."""
    mesh = bumpy_mesh(3)
    stretches = ([1, 1, 1], [1.05, 1, 0.97], [1, 0.95, 1.04], [0.96, 1.02, 1])
    return [
        make_mesh(mesh.vertices * stretch, mesh.faces, name=f"body {number}")
        for number, stretch in enumerate(stretches)
    ]


@pytest.fixture(scope="module")
def pairs(meshes):
    truth = np.arange(len(meshes[0].vertices))
    return [(meshes[0], other, truth) for other in meshes[1:]]


def measured(methods, pairs, **options) -> Comparison:
    options = {"number_of_eigenvectors": K, "iterations": 2, "init": "hks", "evaluated_points": 100} | options
    return compare(methods, pairs, quiet=True, **options)


def test_a_function_equals_its_refiner_and_differences_are_paired(pairs):
    methods = {
        "first": UNREFINED,
        "spline": SPLINE,
        "stage": Stage(SPLINE, number_of_eigenvectors=K, iterations=2),
    }
    comparison = measured({**methods, "function": refined}, pairs)
    assert comparison.methods == ("first", "spline", "stage", "function")
    assert comparison.pairs == tuple(("body 0", f"body {number}") for number in (1, 2, 3))
    errors = {name: comparison.errors(name) for name in comparison.methods}
    np.testing.assert_array_equal(errors["spline"], errors["stage"])
    np.testing.assert_allclose(errors["function"], errors["spline"], atol=0.5)

    for number, (x, y, truth) in enumerate(pairs):
        spectra = paired_spectra(Pair(x, y), K)
        start = initial_map(Pair(x, y), *spectra, init="hks")
        by_hand = refine(*spectra, jnp.asarray(start), refiner=SPLINE, iterations=2).pointwise_map
        for name, pointwise_map in (("first", start), ("spline", by_hand)):
            mean = geodesic_error(
                y, pointwise_map, GroundTruth.of_all_vertices(truth), number_of_samples=100
            ).mean
            assert errors[name][number] == pytest.approx(1e3 * mean, abs=0.5)

    paired = errors["spline"] - errors["first"]
    assert comparison.difference("spline", "first") == mean_interval(paired, 0)
    assert comparison.differences() == {
        name: mean_interval(errors[name] - errors["first"], 0) for name in ("spline", "stage", "function")
    }
    assert str(comparison.differences("spline")["stage"]) == "+0.0 [+0.0, +0.0]"
    table = comparison.table("spline").splitlines()
    assert table[0].startswith("| method | mean error | median | minus spline |") and len(table) == 6
    assert f"| spline | {errors['spline'].mean():.1f} |" in table[3]
    assert str(comparison) == comparison.table()

    row = comparison.rows[0]
    assert (row["source"], row["target"], row["method"]) == ("body 0", "body 1", "first")
    assert 1e3 * row["mean"] == pytest.approx(errors["first"][0])
    few = comparison.select(["function", "first"], comparison.pairs[1:])
    assert few.methods == ("function", "first") and few.pairs == comparison.pairs[1:]
    np.testing.assert_array_equal(few.errors("first"), errors["first"][1:])


def test_results_are_kept_and_methods_can_be_added(pairs, tmp_path):
    output = tmp_path / "results"
    first = measured({"Meyer": MWP}, pairs[:2], output=output)
    lines = (output / "results.csv").read_text().splitlines()
    both = measured({"Meyer": WaveletPreservation(Meyer()), "spline": SPLINE}, pairs, output=output)
    assert (output / "results.csv").read_text().splitlines()[:3] == lines
    np.testing.assert_array_equal(both.errors("Meyer")[:2], first.errors("Meyer"))
    stored = Comparison.read(output)
    assert set(stored.pairs) == set(both.pairs) and stored.select(pairs=both.pairs).table() == both.table()

    with pytest.raises(InputError, match="contains results of another method Meyer"):
        measured({"Meyer": WaveletPreservation(Meyer(5))}, pairs, output=output)
    with pytest.raises(InputError, match="contains results of another method Meyer"):
        measured({"Meyer": first_match}, pairs, output=output)
    x, y, truth = pairs[0]
    moved = make_mesh(1.01 * y.vertices, y.faces, name=y.name)
    with pytest.raises(InputError, match="body 1: has changed since results"):
        measured({"Meyer": MWP}, [(x, moved, truth)], output=output)
    with pytest.raises(InputError, match=r"seed = 0 .*but this run has seed = 1"):
        measured({"Meyer": MWP}, pairs, output=output, seed=1)
    with pytest.raises(InputError, match=r"20 eigenvectors of each shape.* the method large needs 30"):
        measured({"large": Stage(MWP, number_of_eigenvectors=30)}, pairs, output=output)
    measured(["initial"], pairs[:1], output=output, number_of_eigenvectors=10)
    assert "nan" in (output / "shapes.csv").read_text()
    with pytest.raises(InputError, match=r"results\.csv: does not exist"):
        Comparison.read(tmp_path)


def test_a_method_without_results_for_some_pairs_is_visible(pairs, tmp_path):
    measured(["initial"], pairs, output=tmp_path)
    measured({"added": first_match}, pairs[:1], output=tmp_path)
    stored = Comparison.read(tmp_path)
    lines = [line.split(" | ") for line in str(stored).splitlines()]
    at = lines[0].index("pairs")
    assert [line[at] for line in lines[2:]] == ["3", "1 of 3"]
    assert np.isnan(stored.errors("added")).tolist() == [False, True, True]
    assert " of " not in str(stored.select(pairs=stored.pairs[:1]))


def test_a_fault_in_own_code_is_named_at_once_and_can_be_corrected(pairs, tmp_path):
    """The second pair is not measured, and the name of the method remains free until it has a result."""
    called = []

    def counted(spectrum_x, spectrum_y, start_map):
        called.append(spectrum_x)
        raise NameError("no such name")

    for method in (WaveletPreservation(Misspelled()), counted):
        with pytest.raises(InputError, match=r"mine raised NameError at .*test_compare\.py, line") as caught:
            measured({"mine": method}, pairs, output=tmp_path)
        assert isinstance(caught.value.__cause__, NameError)
    assert len(called) == 1
    measured({"mine": first_match}, pairs[:1], output=tmp_path)
    assert (tmp_path / "methods.csv").read_text().count("mine") == 1


def test_a_method_that_fails_has_no_error(pairs):
    comparison = measured({"first": first_match, "failing": failing}, pairs[:2])
    assert np.isnan(comparison.errors("failing")).all() and np.isfinite(comparison.errors("first")).all()
    assert np.isnan(comparison.differences()["failing"].mean)
    assert {row["result"] for row in comparison.rows} == {"successful", "did not converge"}


def test_batches_on_accelerators_give_the_same_table(pairs, monkeypatch, tmp_path):
    """The choice of JAX stands for an accelerator. A pair that cannot be prepared does not spoil its batch."""
    expected = measured({"Meyer": MWP, "function": first_match}, pairs)
    batches = []
    monkeypatch.setattr("jaxsmw.benchmark.benchmark.chosen_backend", lambda backend: "jax")
    monkeypatch.setattr(baselines, "chosen_backend", lambda backend: "jax")
    run_batches = baselines.run_batches

    def counted(stages, tasks):
        batches.append(len(tasks))
        return run_batches(stages, tasks)

    monkeypatch.setattr(baselines, "run_batches", counted)
    found = measured({"Meyer": MWP, "function": first_match}, pairs)
    assert set(batches) == {3}
    np.testing.assert_allclose(found.errors("Meyer"), expected.errors("Meyer"), atol=0.5)
    np.testing.assert_array_equal(found.errors("function"), expected.errors("function"))

    truth = tmp_path / "truth.map"
    truth.write_text("nothing")
    files = [
        write_mesh(tmp_path / f"{name}.off", mesh) or tmp_path / f"{name}.off"
        for name, mesh in zip("xy", pairs[0][:2], strict=True)
    ]
    faulty = DataPair("x", "y", *files, (truth,))
    with pytest.warns(UserWarning, match=r"could not be measured: x to y: .*truth\.map"):
        found = measured({"Meyer": MWP}, [pairs[0], faulty, pairs[1]])
    np.testing.assert_allclose(found.errors("Meyer"), expected.errors("Meyer")[:2], atol=0.5)
    with pytest.raises(InputError, match="could not be measured"):
        measured({"Meyer": MWP}, [faulty])


@pytest.mark.slow
def test_workers_give_the_same_table(pairs):
    methods = {"Meyer": MWP, "function": first_match}
    tables = [
        [{name: value for name, value in row.items() if name != "seconds"} for row in comparison.results.rows]
        for comparison in (measured(methods, pairs), *(measured(methods, pairs, workers=n) for n in (1, 2)))
    ]
    assert tables[0] == tables[1] == tables[2]


SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
from synthetic import bumpy_mesh
import numpy as np
from jaxsmw import WaveletPreservation
from jaxsmw.benchmark import compare
from jaxsmw.geometry.mesh import make_mesh

def slow(x, y, start):
    time.sleep({pause})
    return start

mesh = bumpy_mesh(3)
bodies = [make_mesh(mesh.vertices * [1 + i / 50, 1, 1], mesh.faces, name=str(i)) for i in range(5)]
pairs = [(bodies[0], body, np.arange(len(mesh.vertices))) for body in bodies[1:]]
methods = dict(slow=slow, Meyer=WaveletPreservation())
options = dict(number_of_eigenvectors=20, init="hks", evaluated_points=50, output={output!r}, quiet=True)
print(compare(methods, pairs, **options).select(["Meyer"]).errors("Meyer").tolist())
"""


@pytest.mark.slow
def test_a_killed_comparison_continues(tmp_path):
    output, script = tmp_path / "results", tmp_path / "script.py"
    script.write_text(SCRIPT.format(tests=str(Path(__file__).parent), pause=0.4, output=str(output)))
    killed = subprocess.Popen([sys.executable, script], start_new_session=True)
    results, deadline = output / "results.csv", time.monotonic() + 120
    while not results.exists() or len(results.read_text().splitlines()) < 3:
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    kept = results.read_text().splitlines()
    assert len(kept) < 1 + 4 * 2
    again = [
        subprocess.run([sys.executable, script], check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    ]
    lines = results.read_text().splitlines()
    assert lines[: len(kept)] == kept and len(lines) == len(set(lines)) == 1 + 4 * 2
    whole = tmp_path / "whole"
    script.write_text(SCRIPT.format(tests=str(Path(__file__).parent), pause=0.4, output=str(whole)))
    once = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True).stdout
    assert again == [once, once]


def test_bad_input_gets_one_sentence(pairs, unchecked):
    x, y, truth = pairs[0]
    one = {"Meyer": MWP}
    for methods, given, message in (
        ({}, pairs, "no methods"),
        ("mwp", pairs, "a dictionary from names to methods"),
        ({1: MWP}, pairs, "the name of a method is 1"),
        ({"Meyer": Meyer()}, pairs, "the method 'Meyer' is Meyer"),
        ({"Meyer": WaveletPreservation}, pairs, "the method 'Meyer' is <class"),
        (["zoomotu"], pairs, "not a method .did you mean 'zoomout'.*fast, paper"),
        ({"f": whole_result}, pairs[:1], "method f is a Refinement: return its .pointwise_map"),
        ({"r": WithoutStatus()}, pairs[:1], "WithoutStatus.update must return a State and a status code"),
        ({"theirs": "no-such-method"}, pairs, "'no-such-method' is not a method"),
        (["mwp", "mwp"], pairs, "'mwp' is listed twice"),
        (one, [], "there are no pairs"),
        (one, 3, "pairs is of type int"),
        (one, "no-such-directory", "is not a directory"),
        (one, [(x, y)], "pair 0 is tuple without ground truth"),
        (one, [(x, y, truth[1:])], "641 true points for the 642 vertices"),
        (one, [pairs[0], pairs[0]], "body 0 to body 1 is listed twice"),
        ({"f": wrong_length}, pairs[:1], "the map of the method f has 641 entries"),
        ({"f": broken}, pairs[:1], "the method f raised KeyError at .*test_compare.py, line"),
    ):
        with pytest.raises(InputError) as caught:
            measured(methods, given)
        text = "\n".join([str(caught.value), *getattr(caught.value, "__notes__", ())])
        assert re.search(message, text), text
    for option, value in (
        ("workers", 0),
        ("number_of_eigenvectors", 0),
        ("iterations", 0),
        ("evaluated_points", 0),
        ("seed", -1),
        ("init", "nothing"),
    ):
        with pytest.raises(InputError, match=f"{option}|nothing"):
            measured(one, pairs, **{option: value})
    with pytest.raises(InputError, match="the method 'f' cannot be sent to worker processes"):
        measured({"f": lambda x, y, start: start}, pairs, workers=2)
    comparison = Comparison(Results([], {}, {}))
    with pytest.raises(InputError, match="'a' is not a method of this comparison"):
        comparison.errors("a")


def test_meshes_with_equal_names_get_numbers(meshes):
    x, y = (make_mesh(mesh.vertices, mesh.faces) for mesh in meshes[:2])
    truth = np.arange(len(x.vertices))
    comparison = measured(["initial"], [(x, y, truth), (y, x, truth)])
    assert comparison.pairs == (("mesh", "mesh 2"), ("mesh 2", "mesh"))


def test_the_plot_shows_every_difference(pairs, tmp_path):
    comparison = measured({"first": first_match, "Meyer": MWP}, pairs)
    comparison.plot(tmp_path / "differences.png")
    assert (tmp_path / "differences.png").stat().st_size > 1000
    with pytest.raises(InputError, match="'c' is not a method"):
        comparison.plot(tmp_path / "other.png", reference="c")


def test_interval_is_a_confidence_interval_of_the_mean():
    sample = np.random.default_rng(3).normal(2, 1, 400)
    mean, low, high = mean_interval(sample, seed=0)
    half = 1.96 * sample.std() / 20
    assert mean == pytest.approx(sample.mean())
    assert low == pytest.approx(mean - half, abs=0.1 * half) and high == pytest.approx(
        mean + half, abs=0.1 * half
    )
    assert mean_interval(sample, seed=0) == (mean, low, high)
    assert mean_interval(sample, seed=1) != (mean, low, high)
    assert mean_interval(np.full(5, 0.25), seed=0) == (0.25, 0.25, 0.25)
    assert np.isnan(mean_interval(np.full(1, 0.25), seed=0)).tolist() == [False, True, True]
    mean, low, high = mean_interval(np.array([1.0, 2.0]), seed=0)
    assert mean == 1.5 and np.isnan(low) and np.isnan(high)
    assert np.isnan(mean_interval(np.array([]), seed=0)).all()


def test_a_directory_of_maps_is_a_method_of_any_name(tmp_path, pairs):
    """The name of the method differs from that of the directory."""
    source, target, _ = pairs[0]
    (tmp_path / "maps").mkdir()
    file = tmp_path / "maps" / f"{source.name}_{target.name}.map"
    np.savetxt(file, 1 + np.arange(len(source.vertices)), fmt="%d")
    comparison = compare({"identity": str(tmp_path / "maps")}, pairs[:1], init="wks", quiet=True)
    assert comparison.methods == ("identity",) and comparison.errors("identity")[0] == 0
