import logging
from concurrent.futures import wait
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import body_with_arms

from jaxsmw import compiler_options
from jaxsmw.core.refinement import refine
from jaxsmw.functional_maps import nearest_neighbor
from jaxsmw.geometry.eigenbasis import compute_spectrum
from jaxsmw.matching.executor import compile_stage, run
from jaxsmw.matching.outcome import Start
from jaxsmw.matching.spectral_pair import SpectralPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime import compilation
from jaxsmw.runtime.compilation import compile_ahead, compiled, release_programs


@pytest.fixture
def points():
    generator = np.random.default_rng(0)
    return tuple(jnp.asarray(generator.normal(size=(size, 12)).astype(np.float32)) for size in (300, 400))


def test_the_options_disable_the_library_for_matrix_products(points):
    plain, ours = (
        jax.jit(nearest_neighbor, compiler_options=options).lower(*points).compile().as_text()
        for options in ({}, compiler_options())
    )
    assert "__ynn_fusion" not in ours or not compiler_options()
    if jax.default_backend() == "cpu" and jax.__version_info__[:2] == (0, 10):
        # In this version of JAX, XLA uses the library YNN unless these options disable it.
        assert "__ynn_fusion" in plain and compiler_options()


def test_sums_compile_to_one_loop_and_stay_accurate():
    values = np.random.default_rng(0).random((50_000, 3), np.float32)

    def total(values):
        return jnp.sum(values, axis=0)

    program = jax.jit(total, compiler_options=compiler_options()).lower(values).compile()
    if jax.default_backend() == "cpu":
        assert "reduce-window" not in program.as_text()
        without_library = {n: v for n, v in compiler_options().items() if "ynn" in n}
        assert "reduce-window" in jax.jit(total).lower(values).compile(without_library).as_text()
    np.testing.assert_allclose(program(values), values.astype(np.float64).sum(axis=0), rtol=1e-5)


@pytest.mark.slow
def test_compiled_functions_are_traced_once_and_return_the_same_results(points):
    traced = []

    def search(queries, database, *, reverse):
        traced.append(reverse)
        return nearest_neighbor(*((database, queries) if reverse else (queries, database)))

    for _ in range(2):
        for reverse in (False, True):
            found = compiled(search)(*points, reverse=reverse)
            expected = nearest_neighbor(*(points[::-1] if reverse else points))
            np.testing.assert_array_equal(found, expected)
    assert traced == [False, True]


@pytest.mark.parametrize("x64", [False, True])
def test_a_program_that_was_compiled_ahead_is_not_compiled_again(caplog, x64):
    def total(values, *, weights, power):
        return jnp.sum(weights * values**power)

    with jax.enable_x64(x64):
        ahead = compile_ahead(total, lambda: ((jnp.zeros(9),), {"weights": jnp.zeros(9)}), power=3)
        ahead.result()
        arguments = jax.device_put((np.arange(9.0), np.ones(9)))
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            assert float(compiled(total)(arguments[0], weights=arguments[1], power=3)) == 1296
            assert "XLA compilation of jit(total)" not in caplog.text
            assert float(compiled(total)(arguments[0], weights=arguments[1], power=2)) == 204
            assert "XLA compilation of jit(total)" in caplog.text


def test_the_call_raises_the_errors_of_compiling_ahead(points):
    def refusing(queries):
        raise ValueError("no such search")

    with pytest.raises(TypeError):
        compile_ahead(refusing, lambda: ((jnp.zeros((-1, 2)),), {}))
    wait([compile_ahead(refusing, lambda: ((jnp.zeros((1, 2)),), {}))])
    with pytest.raises(ValueError, match="no such search"):
        compiled(refusing)(points[0])


def test_unknown_options_are_omitted(monkeypatch):
    assert compilation._options_for("gpu") == {}
    known = "xla_disable_hlo_passes"
    monkeypatch.setattr(compilation, "_OPTIONS", {"xla_cpu_no_such_option": "", known: "dce"})
    assert compiler_options() == ({known: "dce"} if jax.default_backend() == "cpu" else {})


def test_the_options_do_not_raise_the_level_that_the_user_lowered():
    """Level 1 takes four times as long to compile as the level of `jax_disable_most_optimizations`."""
    level = "xla_backend_optimization_level"
    assert jax.config.read("jax_disable_most_optimizations") and level not in compiler_options()
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        assert (level in compiler_options()) == (jax.default_backend() == "cpu")
    finally:
        jax.config.update("jax_disable_most_optimizations", True)


def test_changes_to_the_returned_options_have_no_effect():
    compiler_options()["xla_something"] = True
    assert "xla_something" not in compiler_options()


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="memory maps are counted on Linux only")
def test_programs_are_released_when_they_use_many_memory_maps(monkeypatch):
    traced = []

    def total(values):
        traced.append(values)
        return jnp.sum(values)

    for part, times in ((0.25, 1), (0.0, 2), (0.25, 2)):
        monkeypatch.setattr(compilation, "_LARGEST_SHARE", part)
        compiled(total)(jnp.zeros(7))
        release_programs()
        compiled(total)(jnp.zeros(7))
        assert len(traced) == times


def test_a_stage_that_was_compiled_ahead_is_not_compiled_again():
    mesh = body_with_arms(2)
    spectrum = compute_spectrum(mesh, 12)
    stage, n = Stage(number_of_eigenvectors=10, iterations=1), len(mesh.vertices)
    programs = compilation._compiled(refine, jax.default_backend())._programs
    before = set(programs)
    compile_stage(stage, n, n)
    outcome = run([stage], SpectralPair(spectrum, spectrum), Start(np.arange(n)))
    assert outcome.successful and len(set(programs) - before) == 1
