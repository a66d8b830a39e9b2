"""Modules are frozen dataclasses, and pytrees of JAX also if they are older than its import."""

import copy
import dataclasses
import os
import pickle
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_cases import first_always
from synthetic import bumpy_mesh, random_spectrum

from jaxsmw.core import arrays
from jaxsmw.core.banks import CubicSpline, Meyer
from jaxsmw.core.module import Module, field, jitted, leaves
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS


class Base(Module):
    values: jax.Array | np.ndarray = field(converter=np.asarray)
    name: str = field(static=True, default="base")

    def __check_init__(self):
        if self.values.ndim != 1:
            raise ValueError(f"{self.name} needs a vector")

    def total(self):
        return self.values.sum()


class Scaled(Base):
    factor: float = 2.0
    child: Base | None = None

    def __check_init__(self):
        if self.factor == 0:
            raise ValueError("the factor is zero")


def test_modules_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Base([1.0]).name = "other"
    with pytest.raises(dataclasses.FrozenInstanceError):
        del Base([1.0]).name


def test_converters_run_before_the_checks_of_all_classes():
    assert isinstance(Scaled([1, 2]).values, np.ndarray)
    with pytest.raises(ValueError, match="scaled needs a vector"):
        Scaled([[1, 2]], "scaled")
    with pytest.raises(ValueError, match="the factor is zero"):
        Scaled([1, 2], factor=0.0)
    with pytest.raises(ValueError, match="needs a vector"):
        dataclasses.replace(Scaled([1, 2]), values=[[1]])
    assert dataclasses.replace(Scaled([1, 2]), values=(3, 4)).values.tolist() == [3, 4]


def test_modules_are_equal_if_their_fields_are():
    assert Base([1.0, 2.0]) == Base(np.array([1.0, 2.0])) and hash(Base([1.0])) == hash(Base([2.0]))
    assert Base([1.0]) != Base([2.0]) and Base([1.0]) != Base([1]) and Base([1.0]) != Base([1.0], "other")
    assert Base([1.0]) != Scaled([1.0]) and Base([1.0]) != 1
    assert Scaled([1.0], child=Base([2.0])) == Scaled([1.0], child=Base([2.0]))
    assert Scaled([1.0], child=Base([2.0])) != Scaled([1.0], child=None)
    assert FeatureRegression((4, 8)) == FeatureRegression([4, 8]) != FeatureRegression((4,))
    assert CubicSpline(5) == CubicSpline(5) != CubicSpline(5, 10)
    assert WaveletPreservation() == WaveletPreservation(Meyer()) != WaveletPreservation(Meyer(3))


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_are_equal(duplicate):
    for module in (random_spectrum(5, 3), WaveletPreservation(CubicSpline(5)), FeatureRegression((4, 8))):
        assert duplicate(module) == module


def test_the_text_of_a_module_shows_its_fields_but_not_long_arrays():
    assert repr(Base([1.0, 2.0])) == "Base(values=float64[2], name='base')"
    assert repr(FeatureRegression((4, 8))) == "FeatureRegression(levels=(4, 8))"


def test_modules_are_pytrees_without_their_static_fields():
    module = Scaled([1.0], "mine", 3.0, Base([2.0], "child"))
    paths, structure = jax.tree_util.tree_flatten_with_path(module)
    assert [jax.tree_util.keystr(path) for path, _ in paths] == [".values", ".factor", ".child.values"]
    assert list(leaves(module)) == jax.tree.leaves(module)
    assert jax.tree.unflatten(structure, [leaf for _, leaf in paths]) == module
    assert jax.tree.structure(module) != jax.tree.structure(dataclasses.replace(module, name="other"))
    doubled = jax.tree.map(lambda leaf: 2 * leaf, module)
    assert doubled == Scaled([2.0], "mine", 6.0, Base([4.0], "child"))
    # JAX fills trees with other objects than arrays, which no converter or check may see.
    assert jax.tree.map(lambda _: None, module).values is None


def test_abstract_classes_are_not_made():
    with pytest.raises(TypeError, match="abstract"):
        Refiner()


def test_the_functions_of_jax_and_equinox_accept_modules():
    module = Scaled(jnp.asarray([1.0, 2.0]), factor=jnp.asarray(3.0))

    def loss(module):
        return module.factor * jnp.sum(module.values**2)

    assert eqx.filter_jit(loss)(module) == jax.jit(loss)(module) == jitted(loss)(module) == 15
    for gradient in (eqx.filter_grad(loss)(module), jax.grad(loss)(module)):
        assert isinstance(gradient, Scaled)
        np.testing.assert_array_equal(gradient.values, [6, 12])
        assert gradient.factor == 5
    moved = eqx.tree_at(lambda m: m.values, module, jnp.zeros(2))
    assert loss(moved) == 0 and moved.factor == 3 and loss(module) == 15
    several = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), module)
    np.testing.assert_array_equal(eqx.filter_vmap(loss)(several), [15, 120])
    np.testing.assert_array_equal(jax.vmap(loss)(several), [15, 120])
    dynamic, static = eqx.partition(module, eqx.is_array)
    assert eqx.combine(dynamic, static) == module


def test_static_fields_are_constants_of_programs():
    traces = []

    @jitted
    def count(module):
        traces.append(module.name)
        return module.total()

    for name in ("a", "a", "b"):
        assert count(Base(np.array([1.0, 2.0]), name)) == 3
    assert traces == ["a", "b"]


def test_status_codes_can_be_compared_one_by_one():
    codes = jax.vmap(lambda code: RESULTS(code))(jnp.arange(3, dtype=jnp.int32))
    assert (codes == RESULTS.successful).tolist() == [True, False, False]
    assert (codes != RESULTS.successful).tolist() == [False, True, True]
    assert RESULTS.successful != 0
    assert "succeeded" in RESULTS[RESULTS.successful]


def test_a_class_keeps_the_constructor():
    with pytest.raises(TypeError, match="__init__"):

        class Own(Base):
            def __init__(self):
                pass


def test_an_unfinished_import_of_jax_by_another_thread_is_no_fault(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", type(sys)("jax"))
    monkeypatch.delitem(sys.modules, "jax.numpy")
    assert not arrays.is_traced(np.zeros(1)) and arrays.is_array(np.zeros(1))
    assert arrays.namespace(np.zeros(1)) is np
    assert Base([1.0]).total() == 1


def run_program(program, *arguments):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["JAX_PLATFORMS"] = "cpu"
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


_EARLY = """
import sys
import numpy as np
from jaxsmw.core.module import jitted
from jaxsmw.core.spectrum import Spectrum

def make():
    return Spectrum(np.arange(3.0), np.ones((5, 3)), np.ones(5), np.ones(5, bool))

early = make()
assert "jax" not in sys.modules
"""


@pytest.mark.parametrize(
    "then",
    [
        "import jax",
        pytest.param("import jax.numpy; import jax", marks=pytest.mark.sampled),
        "assert jitted(lambda s: s.eigenvalues.sum())(early) == 3; import jax",
        "import threading, importlib; threads = [threading.Thread(target=importlib.import_module, args=(name,)) "
        "for name in ('jax', 'jax', 'jaxsmw.core.refinement')]; [t.start() for t in threads]; "
        "[t.join() for t in threads]; import jax",
    ],
)
def test_modules_that_are_older_than_jax_become_pytrees(then):
    check = "\nassert [leaf.shape for leaf in jax.tree.leaves(early)] == [(3,), (5, 3), (5,), (5,)]"
    check += "\nassert jax.tree.map(lambda leaf: leaf + leaf, early).eigenvalues[2] == 4"
    run_program(_EARLY + then + check)


_MATCH = """
import sys
import numpy as np
import jaxsmw.matching.match
assert "jax" not in sys.modules and "equinox" not in sys.modules
import jaxsmw
with np.load(sys.argv[1]) as meshes:
    x, y = ((meshes[f"vertices_{side}"], meshes[f"faces_{side}"]) for side in "xy")
    found = jaxsmw.match(x, y, preset=sys.argv[2], mirror="no")
assert found.pointwise_map.min() >= 0 and len(found.pointwise_map) == len(x[0])
assert "jax" not in sys.modules and "equinox" not in sys.modules
"""


@pytest.mark.parametrize("preset", first_always(["accurate", "fast", "paper"], always=2))
def test_a_match_does_not_import_jax(tmp_path, preset):
    meshes = {"x": bumpy_mesh(3), "y": bumpy_mesh(number=700)}
    sides = meshes.items()
    saved = {f"vertices_{side}": mesh.vertices for side, mesh in sides}
    np.savez(tmp_path / "meshes.npz", **saved, **{f"faces_{side}": mesh.faces for side, mesh in sides})
    run_program(_MATCH, str(tmp_path / "meshes.npz"), preset)
