"""Compiler options: what they change, where they are known, and where they are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmw import compilation, compiler_options, nearest_neighbor
from jaxsmw.compilation import compiled


@pytest.fixture
def points():
    generator = np.random.default_rng(0)
    return tuple(jnp.asarray(generator.normal(size=(size, 12)).astype(np.float32)) for size in (300, 400))


def test_the_library_for_products_is_left_out(points):
    if not compiler_options():
        pytest.skip("this XLA, or this device, has no such option")
    plain = jax.jit(nearest_neighbor).lower(*points).compile().as_text()
    ours = jax.jit(nearest_neighbor, compiler_options=compiler_options()).lower(*points).compile().as_text()
    assert "__ynn_fusion" not in ours
    if "__ynn_fusion" not in plain:
        pytest.skip("this XLA does not use it for such products anyway")


def test_compiled_gives_the_same_and_once(points):
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


def test_no_options_where_there_are_none(monkeypatch):
    assert compilation._options_for("gpu") == {}
    monkeypatch.setattr(compilation, "_OPTIONS", {"xla_cpu_no_such_option": ""})
    compilation._options_for.cache_clear()
    assert compiler_options() == {}
    monkeypatch.undo()
    compilation._options_for.cache_clear()
