import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import learn_frame
import learning
import numpy as np
import optax
import pytest
from learn_frame import LOSSES, Sampled, bank_of, like_meyer, load, save, summary
from synthetic import random_spectrum

from jaxsmw import Meyer, Spectrum

pytestmark = pytest.mark.study

N, K = 60, 12


def fake_pair(seed: int) -> tuple[SimpleNamespace, Sampled]:
    """Return the names of a pair, and a training pair: a random spectrum and a perturbed copy."""
    generator = np.random.default_rng(seed)
    x = random_spectrum(N, K, seed=seed)
    y = Spectrum(x.eigenvalues, x.eigenvectors + 0.3 * generator.normal(size=(N, K)), x.vertex_areas, x.mask)
    positions = jnp.asarray(generator.normal(size=(N, 3)))
    initial_map = np.where(generator.random(N) < 0.3, generator.integers(0, N, N), np.arange(N))
    initial_maps = (jnp.asarray(initial_map, jnp.int32),) * 2
    return SimpleNamespace(names=("a", str(seed)), name=f"a to {seed}"), Sampled(
        x, y, positions, positions, *initial_maps, positions
    )


@pytest.fixture
def pairs(monkeypatch):
    # The embedded vertices of random spectra are far from each other, so the soft maps need a high temperature.
    monkeypatch.setattr(learn_frame, "TEMPERATURE", 1.0)
    made = [fake_pair(seed) for seed in range(3)]
    with jax.numpy_dtype_promotion("standard"):  # optax needs standard promotion
        yield [pair for pair, _ in made], {pair.names: sampled for pair, sampled in made}


def train(name, pairs, steps, seed, directory, prepared):
    directory.mkdir(exist_ok=True)
    loss = LOSSES[name]
    trained = learning.train(
        name,
        loss,
        like_meyer(),
        pairs,
        lambda pair: prepared[pair.names],
        optax.adam(optax.cosine_decay_schedule(0.3, steps)),
        steps=steps,
        seed=seed,
        directory=directory,
        unit=lambda pair: loss(like_meyer(), pair),
    )
    assert not len(trained.watched)
    return trained.model, trained.losses


@pytest.mark.sampled
@pytest.mark.parametrize("name", LOSSES)
def test_learning_lowers_the_loss(pairs, tmp_path, name):
    listed, prepared = pairs
    frame, losses = train(name, listed[:1], 20, 0, tmp_path, prepared)
    assert losses.shape == (20,) and losses[0] == pytest.approx(1) and losses[-1] < 0.97
    assert float(abs(frame.logits - like_meyer().logits).max()) > 0.1


class InterruptedPairs(dict):
    """Prepared pairs that raise KeyboardInterrupt after `left` look-ups."""

    left = 3

    def __getitem__(self, key):
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return super().__getitem__(key)


@pytest.mark.sampled
def test_resumed_training_gives_the_same_result(pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "_SAVED_EVERY", 2)
    listed, prepared = pairs
    frame, losses = train("labels", listed, 6, 1, tmp_path / "whole", prepared)
    with pytest.raises(KeyboardInterrupt):
        train("labels", listed, 6, 1, tmp_path / "parts", InterruptedPairs(prepared))
    again = InterruptedPairs(prepared)
    again.left = 4  # the two saved steps are not repeated
    resumed, resumed_losses = train("labels", listed, 6, 1, tmp_path / "parts", again)
    np.testing.assert_array_equal(resumed.logits, frame.logits)
    np.testing.assert_array_equal(resumed_losses, losses)


def test_an_interruption_says_how_to_continue(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "open_data", lambda directory: learning.Data([], [], [], []))
    output = tmp_path / "learned"
    monkeypatch.setattr(sys, "argv", [learn_frame.__file__, str(tmp_path), "--output", str(output)])
    told = pytest.raises(SystemExit, match=r"the same command continues from the results in .*learned")
    with told, learning.running(learning.parser("", output="", steps=1), {}):
        raise KeyboardInterrupt


def test_saved_frames_are_loaded_unchanged(tmp_path):
    frame, points = like_meyer(), jnp.linspace(0, 7, 40)
    save(frame, tmp_path / "frame.npz")
    bank = load(tmp_path / "frame.npz")
    np.testing.assert_array_equal(bank(points, points), bank_of(frame)(points, points))
    # Training begins near the Meyer frame.
    np.testing.assert_allclose(bank(points, points), Meyer(6)(points, points), atol=0.2)


def test_the_summary_states_the_difference_from_meyer():
    rows = [
        {"Meyer": 20.0, "learned": 18.0},
        {"Meyer": 10.0, "learned": 9.0},
        {"Meyer": 12.0, "learned": 12.5},
    ]
    page = "\n".join(summary({"people": rows}, 5, 0))
    assert "| people | 3 | 14.0 | 13.2 (−0.8 [" in page
