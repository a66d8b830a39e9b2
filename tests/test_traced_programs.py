"""Traced programs are stored on disk, and later calls neither trace nor change results."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import body_with_arms

from jaxsmw.core.refinement import refine
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.registration import Registration
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.core.solutions.closed_form import NearestOrthogonal
from jaxsmw.functional_maps import nearest_neighbor
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.runtime import compilation, traced_programs
from jaxsmw.runtime.compilation import compile_ahead, compiled
from jaxsmw.runtime.traced_programs import UndescribedError, flatten, rebuild

LEVELS = (6, 9)


class UsersRefiner(WaveletPreservation):
    """A refiner whose code is not a part of the library."""


@pytest.fixture(scope="module")
def arguments():
    spectrum = compute_spectrum(body_with_arms(2), 12)
    return spectrum, spectrum, jnp.arange(len(spectrum.mask))[::-1]


@pytest.fixture
def directory(tmp_path, monkeypatch) -> Path:
    """The directory of the cache. JAX stores compiled programs in another directory."""
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path / "cache"))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "compiled"))
    start_anew()
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)
    start_anew()


@pytest.fixture
def traces(monkeypatch) -> list[str]:
    """The names of the refiners that were traced."""
    found = []
    for refiner in (WaveletPreservation, FeatureRegression, Registration):

        def prepare(self, problem, original=refiner.prepare):
            found.append(type(self).__name__)
            return original(self, problem)

        monkeypatch.setattr(refiner, "prepare", prepare)
    return found


def start_anew():
    """Forget all programs in memory, as in a new process."""
    compilation._compiled.cache_clear()
    traced_programs._software.cache_clear()
    jax.clear_caches()


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize(
    ("refiner", "options"),
    [
        (WaveletPreservation(), {"iterations": 2, "history": True}),
        (WaveletPreservation(solution=NearestOrthogonal()), {"iterations": 1}),
        (FeatureRegression(LEVELS), {"iterations": 2, "partial": True}),
        (Registration(LEVELS), {"iterations": 2, "stop_when_unchanged": True}),
    ],
)
def test_a_stored_program_is_not_traced_again_and_returns_the_same(
    directory, traces, arguments, refiner, options
):
    jax.config.update("jax_enable_compilation_cache", False)
    expected = compiled(refine)(*arguments, refiner=refiner, **options)
    assert not list(directory.glob("traced-program-*.npz"))
    jax.config.update("jax_enable_compilation_cache", True)
    start_anew()
    traces.clear()
    first = compiled(refine)(*arguments, refiner=refiner, **options)
    assert traces and len(list(directory.glob("traced-program-*.npz"))) == 1
    traces.clear()
    assert_same(compiled(refine)(*arguments, refiner=refiner, **options), first)
    start_anew()
    again = compiled(refine)(*arguments, refiner=refiner, **options)
    assert traces == []
    assert_same(again, first)
    assert_same(again, expected)


def test_a_program_that_was_stored_ahead_is_used(directory, traces, arguments):
    spectrum, _, start = arguments
    ahead = compile_ahead(refine, lambda: ((spectrum, spectrum, start), {}), iterations=1)
    ahead.result()
    traces.clear()
    compiled(refine)(*arguments, iterations=1)
    assert traces == []


def test_one_program_is_stored_if_many_threads_ask_for_it(directory, traces, arguments):
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: compiled(refine)(*arguments, iterations=1), range(4)))
    assert len(traces) == 1 and len(list(directory.glob("traced-program-*.npz"))) == 1
    for one in found[1:]:
        assert_same(one, found[0])


def test_everything_that_changes_a_program_is_a_part_of_its_key(directory, arguments, monkeypatch, tmp_path):
    """No two of these calls share a program."""
    spectrum, _, start = arguments
    fewer = spectrum.truncate(11)
    calls = [
        (arguments, {"iterations": 1}),
        (arguments, {"iterations": 2}),
        (arguments, {"iterations": 1, "history": True}),
        (arguments, {"iterations": 1, "refiner": FeatureRegression((6,))}),
        (arguments, {"iterations": 1, "refiner": FeatureRegression((7,))}),
        ((fewer, fewer, start), {"iterations": 1}),
        ((spectrum, spectrum, start.astype(jnp.int32)), {"iterations": 1}),
    ]

    def stored() -> int:
        return len(list(directory.glob("traced-program-*.npz")))

    for number, (positional, named) in enumerate(calls, 1):
        compiled(refine)(*positional, **named)
        assert stored() == number
    start_anew()
    changed = tmp_path / "changed.py"
    monkeypatch.setattr(traced_programs, "LIBRARY", tmp_path)
    changed.write_text("x = 1", "utf-8")
    monkeypatch.setattr(traced_programs, "measured_code", lambda: [changed])
    compiled(refine)(*arguments, iterations=1)
    assert stored() == len(calls) + 1
    start_anew()
    with jax.default_matmul_precision("highest"):
        compiled(refine)(*arguments, iterations=1)
    assert stored() == len(calls) + 2


def test_code_of_users_is_never_stored(directory, traces, arguments):
    """The key of a program contains only the code of the library."""
    for _ in range(2):
        found = compiled(refine)(*arguments, refiner=UsersRefiner(), iterations=1)
        assert found.result == RESULTS.successful
    assert traces == ["UsersRefiner"] and not list(directory.glob("traced-program-*.npz"))

    def own(values):
        return 2 * values

    assert float(compiled(own)(jnp.asarray(2.0))) == 4 and not list(directory.glob("traced-program-*.npz"))


def test_nothing_is_stored_without_a_directory_for_compiled_programs(directory, arguments):
    jax.config.update("jax_compilation_cache_dir", None)
    compiled(refine)(*arguments, iterations=1)
    assert not list(directory.glob("traced-program-*.npz"))


def test_damaged_programs_are_traced_again(directory, traces, arguments):
    expected = compiled(refine)(*arguments, iterations=1)
    (entry,) = directory.glob("traced-program-*.npz")
    good = entry.read_bytes()
    for damaged in (good[:-100], good[: len(good) // 2] + b"\xff" * 40 + good[len(good) // 2 + 40 :], b""):
        entry.write_bytes(damaged)
        start_anew()
        traces.clear()
        assert_same(compiled(refine)(*arguments, iterations=1), expected)
        assert traces == ["WaveletPreservation"]
        assert entry.read_bytes() == good


def test_errors_of_the_function_are_raised(directory, arguments):
    spectrum, _, start = arguments
    for _ in range(2):
        with pytest.raises(ValueError, match="the initial map has shape"):
            compiled(refine)(spectrum, spectrum, start[:-1], iterations=1)
        with pytest.raises(ValueError, match="at least 1 iteration"):
            compiled(refine)(*arguments, iterations=0)


def test_batches_are_not_affected(directory):
    """Inside another transformation of JAX, the plain function runs."""
    points = jnp.asarray(np.random.default_rng(0).normal(size=(2, 9, 3)))
    both = jax.vmap(lambda queries: compiled(nearest_neighbor)(queries, points[0]))(points)
    np.testing.assert_array_equal(both[0], np.arange(9))
    assert not list(directory.glob("traced-program-*.npz"))


def test_descriptions_are_rebuilt(arguments):
    spectrum, _, start = arguments
    tree = {
        "spectrum": spectrum,
        "refiners": [Registration(LEVELS), FeatureRegression(), WaveletPreservation()],
        "result": RESULTS.successful,
        "function": refine,
        "class": Registration,
        "values": (None, True, 3, 0.5, "text", ()),
        "arrays": {"b": start, "a": np.zeros((0, 2))},
    }
    structure, arrays = flatten(tree)
    assert json.loads(json.dumps(structure)) == structure
    rebuilt = rebuild(json.loads(json.dumps(structure)), arrays)
    assert jax.tree.structure(rebuilt) == jax.tree.structure(tree)
    jax.tree.map(np.testing.assert_array_equal, rebuilt, tree)
    assert rebuilt["arrays"]["b"] is start


@pytest.mark.parametrize("unknown", [object(), {1: 2}, lambda: 0, Path("a"), UsersRefiner(), UsersRefiner])
def test_unknown_objects_are_not_described(unknown):
    with pytest.raises(UndescribedError):
        flatten([unknown])
