import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmw import compiler_options
from jaxsmw.functional_maps import nearest_neighbor
from jaxsmw.runtime import compilation
from jaxsmw.runtime.compilation import compiled


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
