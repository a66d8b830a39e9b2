import sys
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import learn_descriptors
import learning
import numpy as np
import optax
import pytest
from learn_descriptors import (
    LOSSES,
    DescriptorNetwork,
    Shape,
    Sizes,
    TrainingPair,
    described,
    draw,
    load,
    nearest_descriptors,
    save,
    summary,
)
from learning import train

from jaxsmw import InputError, creature_pair, make_mesh
from jaxsmw.geometry import farthest_point_samples

pytestmark = pytest.mark.study

SMALL = Sizes(waves=8, width=12, blocks=2, filters=4, outputs=6)
SAMPLES, EIGENVECTORS = 90, 20


@pytest.fixture(autouse=True, scope="module")
def small():
    with (
        pytest.MonkeyPatch.context() as patch,
        jax.numpy_dtype_promotion("standard"),
    ):  # optax and equinox need standard promotion
        patch.setattr(learn_descriptors, "EIGENVECTORS", 30)
        patch.setattr(learn_descriptors, "LAYER_EIGENVECTORS", EIGENVECTORS)
        yield


@pytest.fixture(scope="module")
def creatures():
    return creature_pair(vertices=700)


@pytest.fixture(scope="module")
def spectra(creatures):
    return described(creatures.source), described(creatures.target)


@pytest.fixture(scope="module")
def pair(creatures, spectra):
    """A creature in two poses, as a `TrainingPair`."""
    meshes = creatures.source, creatures.target
    chosen = [farthest_point_samples(mesh, SAMPLES) for mesh in meshes]
    positions = [
        jnp.asarray(mesh.vertices[c] / mesh.area**0.5) for mesh, c in zip(meshes, chosen, strict=True)
    ]
    x, y = (Shape(s.sample(jnp.asarray(c)), p) for s, c, p in zip(spectra, chosen, positions, strict=True))
    targets = creatures.true_map[chosen[0]]
    return TrainingPair(x, y, jnp.asarray(meshes[1].vertices[targets] / meshes[1].area ** 0.5))


@pytest.fixture(scope="module")
def network():
    return DescriptorNetwork(jax.random.key(0), SMALL)


NAMED = [SimpleNamespace(names=("a", letter), name=f"a to {letter}") for letter in "bc"]


OPTIMIZER, STEPS = optax.adam(2e-3), 6


def learn(network, pair, directory, *, loss="labels", prepare=None):
    return train(
        loss,
        LOSSES[loss],
        network,
        NAMED,
        prepare or (lambda _: pair),
        OPTIMIZER,
        steps=STEPS,
        seed=1,
        directory=directory,
        watched=NAMED[1:],
    )


@pytest.mark.sampled
@pytest.mark.parametrize("loss", LOSSES)
def test_learning_lowers_the_loss(network, pair, tmp_path, loss):
    trained = learn(network, pair, tmp_path, loss=loss)
    assert trained.losses.shape == (STEPS,) and trained.losses[-1] < trained.losses[0]
    # The loss on the watched pair, here the training pair, is measured before the first and after the last
    # step.
    np.testing.assert_array_equal(trained.steps, [0, STEPS])
    np.testing.assert_allclose(trained.watched[0], trained.losses[0], rtol=1e-9)
    assert trained.watched[1] < trained.losses[0]


def test_descriptors_do_not_depend_on_signs_of_eigenvectors(network, spectra):
    x, _ = spectra
    signs = jnp.where(jnp.arange(30) % 3 == 1, -1.0, 1.0)[None, :]
    flipped = eqx.tree_at(lambda s: s.eigenvectors, x, x.eigenvectors * signs)
    np.testing.assert_allclose(network(flipped), network(x), atol=1e-12)
    # The network uses the eigenvectors, so fewer eigenvectors give other descriptors.
    assert float(jnp.abs(network(x.truncate(5)) - network(x)).max()) > 1e-3


def test_descriptors_do_not_depend_on_numbering_units_or_padding(network, creatures, spectra):
    mesh = creatures.source
    n = len(mesh.vertices)
    expected = np.asarray(network(spectra[0]))[:n]
    order = np.random.default_rng(0).permutation(n)
    renumbered = make_mesh(7 * mesh.vertices[order], np.argsort(order)[mesh.faces])
    # Rounding errors are large, because renumbering changes the initial vector of the eigensolver and the
    # order of the sums in SHOT.
    np.testing.assert_allclose(np.asarray(network(described(renumbered)))[:n], expected[order], atol=1e-5)
    np.testing.assert_allclose(np.asarray(network(spectra[0].pad(2000)))[:n], expected, atol=1e-12)


def test_nearest_descriptors_are_vertices_of_the_target(network, creatures, spectra):
    x, y = spectra
    found = np.asarray(nearest_descriptors(network, x, y))[: len(creatures.source.vertices)]
    assert found.min() >= 0 and found.max() < len(creatures.target.vertices)
    of_itself = np.asarray(nearest_descriptors(network, x, x))[: len(creatures.source.vertices)]
    np.testing.assert_array_equal(of_itself, np.arange(len(of_itself)))


class InterruptedPreparation:
    """In its first `left` calls, returns the prepared pair; the next call raises KeyboardInterrupt."""

    def __init__(self, pair, left):
        self.pair, self.left = pair, left

    def __call__(self, _):
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return self.pair


@pytest.mark.sampled
def test_resumed_training_gives_the_same_result(network, pair, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "_SAVED_EVERY", 2)
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = learn(network, pair, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        # Training prepares one watched pair and one pair for each of three steps before the interruption.
        learn(network, pair, tmp_path / "parts", prepare=InterruptedPreparation(pair, 4))
    assert [file.name for file in (tmp_path / "parts").iterdir()] == ["training_labels.eqx"]
    again = InterruptedPreparation(pair, 5)  # enough pairs for four steps and one watched pair
    resumed = learn(network, pair, tmp_path / "parts", prepare=again)
    assert again.left == 0
    for found, expected in zip(jax.tree.leaves(resumed), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(found, expected)
    # A third run prepares no pair, because training is complete.
    learn(network, pair, tmp_path / "parts", prepare=InterruptedPreparation(pair, 0))


def test_saved_networks_are_loaded_bit_for_bit(network, spectra, tmp_path):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), network)
    for number, kept in enumerate((network, single)):
        save(kept, tmp_path / f"{number}.eqx")
        again = load(tmp_path / f"{number}.eqx")
        assert again.sizes == SMALL and again.leave.weight.dtype == kept.leave.weight.dtype
        np.testing.assert_array_equal(again(spectra[0]), kept(spectra[0]))


def test_an_interrupted_save_keeps_the_existing_file(network, tmp_path, monkeypatch):
    save(network, tmp_path / "kept.eqx")
    before = (tmp_path / "kept.eqx").read_bytes()

    def interrupted(stream, _):
        stream.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(learn_descriptors.eqx, "tree_serialise_leaves", interrupted)
    for name in ("kept.eqx", "new.eqx"):
        with pytest.raises(KeyboardInterrupt):
            save(network, tmp_path / name)
    assert [file.name for file in tmp_path.iterdir()] == ["kept.eqx"]
    assert (tmp_path / "kept.eqx").read_bytes() == before


def test_damaged_files_are_named(network, pair, tmp_path):
    path = tmp_path / "descriptors.eqx"
    save(network, path)
    whole = path.read_bytes()
    header, leaves = whole.split(b"\n", 1)
    for contents in (
        b"",
        b"\x93NUMPY",
        whole[:-20],
        whole + b"more",
        header.replace(b'"width": 12', b'"width": 13') + b"\n" + leaves,
        header.replace(b'"width": 12', b'"width": -1') + b"\n" + leaves,
        header.replace(b'"blocks": 2', b'"layers": 2') + b"\n" + leaves,
        header.replace(b"float64", b"object") + b"\n" + leaves,
    ):
        path.write_bytes(contents)
        with pytest.raises(InputError, match=r"descriptors\.eqx: is damaged"):
            load(path)
    with pytest.raises(InputError, match=r"nowhere\.eqx"):
        load(tmp_path / "nowhere.eqx")
    (tmp_path / "training_labels.eqx").write_bytes(whole)
    with pytest.raises(InputError, match=r"training_labels\.eqx: is damaged"):
        learn(network, pair, tmp_path)


def test_invalid_inputs_are_refused(network, pair, spectra, tmp_path):
    x, _ = spectra
    with pytest.raises(ValueError, match="no descriptors, but 352 per vertex are needed"):
        network(x.with_descriptors(None))
    with pytest.raises(ValueError, match="10 descriptors, but 352"):
        network(x.with_descriptors(x.descriptors[:, :10]))
    for wrong in ({"width": 0}, {"blocks": 1.5}, {"filters": True}):
        with pytest.raises(ValueError, match=f"Sizes.{next(iter(wrong))} must be an integer"):
            Sizes(**wrong)
    nowhere = pair._replace(truth=pair.truth.at[0, 0].set(jnp.nan))
    with pytest.raises(ArithmeticError, match=r"the loss became nan at step 0 \(a to"):
        learn(network, nowhere, tmp_path)
    assert not list(tmp_path.iterdir())


def test_invalid_arguments_are_refused_in_one_sentence(tmp_path, monkeypatch, capsys):
    for arguments, sentence in (
        ([str(tmp_path / "nothing")], "is not a directory"),
        ([str(tmp_path), "--steps", "0"], "must be at least 1"),
        ([str(tmp_path), "--seed", "-1"], "--seed at least 0"),
    ):
        monkeypatch.setattr(sys, "argv", ["learn_descriptors.py", *arguments])
        with pytest.raises(SystemExit) as stopped:
            learn_descriptors.main()
        assert stopped.value.code == 2
        assert sentence in capsys.readouterr().err


def test_the_summary_states_the_differences_and_the_figure_is_written(tmp_path):
    rows = [
        {"SHOT, start": 200.0, "learned, start": 100.0, "SHOT, refined": 20.0, "learned, refined": 21.0},
        {"SHOT, start": 220.0, "learned, start": 110.0, "SHOT, refined": 10.0, "learned, refined": 10.5},
        {"SHOT, start": 210.0, "learned, start": 120.0, "SHOT, refined": 12.0, "learned, refined": 11.0},
    ]
    page = "\n".join(summary({"people": rows}, 5, 0))
    assert "| people, initial map | 3 | 210.0 | 110.0 (−100.0 [" in page
    assert "| people, refined | 3 | 14.0 | 14.2 (+0.2 [" in page
    curve = learning.Trained(None, np.linspace(1, 0.5, 30), np.array([0, 20, 30]), np.array([1.0, 0.8, 0.7]))
    draw({"from labels": curve, "from cycles": curve}, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
