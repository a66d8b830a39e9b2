"""The script that learns a frame: it lowers its losses, goes on where it was, and keeps what it learned."""

import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from synthetic import random_spectrum

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import learn_frame
import learning
from learn_frame import LOSSES, Sampled, bank_of, like_meyer, load, save, summary

from jaxsmw import Meyer, Spectrum

pytestmark = pytest.mark.study

N, K = 60, 12


def fake_pair(seed: int) -> tuple[SimpleNamespace, Sampled]:
    """A shape and a disturbed copy."""
    generator = np.random.default_rng(seed)
    x = random_spectrum(N, K, seed=seed)
    y = Spectrum(x.eigenvalues, x.eigenvectors + 0.3 * generator.normal(size=(N, K)), x.vertex_areas, x.mask)
    positions = jnp.asarray(generator.normal(size=(N, 3)))
    start = np.where(generator.random(N) < 0.3, generator.integers(0, N, N), np.arange(N)).astype(np.int32)
    starts = jnp.asarray(start), jnp.asarray(start)
    return SimpleNamespace(names=("a", str(seed)), name=f"a to {seed}"), Sampled(
        x, y, positions, positions, *starts, positions
    )


@pytest.fixture
def pairs(monkeypatch):
    # Vertices of random spectra are far from each other.
    monkeypatch.setattr(learn_frame, "TEMPERATURE", 1.0)
    made = [fake_pair(seed) for seed in range(3)]
    with jax.numpy_dtype_promotion("standard"):  # which optax needs
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


@pytest.mark.parametrize("name", LOSSES)
def test_learning_lowers_the_loss(pairs, tmp_path, name):
    listed, prepared = pairs
    frame, losses = train(name, listed[:1], 20, 0, tmp_path, prepared)
    assert losses.shape == (20,) and losses[0] == pytest.approx(1) and losses[-1] < 0.97
    assert float(abs(frame.logits - like_meyer().logits).max()) > 0.1


class Stops(dict):
    """Prepared pairs of which only so many are given out before someone presses Ctrl-C."""

    left = 3

    def __getitem__(self, key):
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return super().__getitem__(key)


def test_goes_on_where_it_was(pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "_SAVED_EVERY", 2)
    listed, prepared = pairs
    frame, losses = train("labels", listed, 6, 1, tmp_path / "whole", prepared)
    with pytest.raises(KeyboardInterrupt):
        train("labels", listed, 6, 1, tmp_path / "parts", Stops(prepared))
    again = Stops(prepared)
    again.left = 4  # the two steps that were saved are not done again
    resumed, resumed_losses = train("labels", listed, 6, 1, tmp_path / "parts", again)
    np.testing.assert_array_equal(resumed.logits, frame.logits)
    np.testing.assert_array_equal(resumed_losses, losses)


def test_whoever_interrupts_is_told_how_to_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "open_data", lambda directory: learning.Data([], [], [], []))
    output = tmp_path / "learned"
    monkeypatch.setattr(sys, "argv", [learn_frame.__file__, str(tmp_path), "--output", str(output)])
    told = pytest.raises(SystemExit, match=r"the same command goes on from what .*learned holds")
    with told, learning.running(learning.parser("", output="", steps=1), {}):
        raise KeyboardInterrupt


def test_frames_are_kept(tmp_path):
    frame, points = like_meyer(), jnp.linspace(0, 7, 40)
    save(frame, tmp_path / "frame.npz")
    bank = load(tmp_path / "frame.npz")
    np.testing.assert_array_equal(bank(points, points), bank_of(frame)(points, points))
    # Learning starts near Meyer's frame.
    np.testing.assert_allclose(bank(points, points), Meyer(6)(points, points), atol=0.2)


def test_the_summary_says_whether_it_helped():
    rows = [
        {"Meyer": 20.0, "learned": 18.0},
        {"Meyer": 10.0, "learned": 9.0},
        {"Meyer": 12.0, "learned": 12.5},
    ]
    page = "\n".join(summary({"people": rows}, 5, 0, "Commit 1."))
    assert "| people | 3 | 14.0 | 13.2 (−0.8 [" in page
