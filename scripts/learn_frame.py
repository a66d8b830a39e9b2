"""Trains tight frames, and tests whether they match shapes better than the Meyer frame.

    python scripts/learn_frame.py DATA_DIRECTORY [--output DIRECTORY] [--steps N] [--test-pairs N] [--seed N]
                                  [--quick]

The script needs the extra `learn`: `pip install -e ".[learn]"`.

DATA_DIRECTORY contains `faust_r` and `tosca_r` (docs/datasets.md). The script trains a `SoftmaxFrame`, which
is a Parseval frame for all values of its parameters. Training starts close to the Meyer frame with six
filters. Each step of Adam (optax) uses one pair of shapes of the first five people of FAUST. Gradients pass
through `refine_softly` on samples of both shapes. The script trains one frame with each of these losses:

- `labels`: the distance between matches and the ground truth;
- `cycles`: the distance between each point and its image under the forward map followed by the backward map.
  This loss needs no ground truth.

A soft match is a set of points, weighted with the shares of the soft map. In both losses, the distance from a
soft match is the weighted root mean square of the distances from the points.

The script then tests the frames on pairs of the other five people of FAUST and on pairs of TOSCA. From the
same initial map, `jaxsmw.refine` refines each pair with the Meyer frame, with the untrained frame and with
both trained frames. The script writes `summary.md` with the errors, and `frames.png` with the filters and
losses. The script also writes the logits of the trained frames to `frame_labels.npz` and `frame_cycles.npz`.
A trained frame is `Warped(SoftmaxFrame(logits), Power())`. After an interruption, the same command continues
from the saved state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from learning import (
    EIGENVECTORS,
    ITERATIONS,
    Measured,
    comparison,
    errors,
    parser,
    refined,
    root_mean_square,
    round_trip,
    running,
    smoothed,
    unit_area_positions,
)
from scipy.spatial import KDTree

from jaxsmw import (
    Filtering,
    Mesh,
    Meyer,
    Pair,
    Spectrum,
    WaveletPreservation,
    initial_map,
    paired_spectra,
    read_mesh,
)
from jaxsmw.banks import SoftmaxFrame
from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.core.banks import FilterBank, Power, Warped
from jaxsmw.core.soft_maps import SoftMap, Softmax, SparseSoftMap
from jaxsmw.geometry import farthest_point_samples
from jaxsmw.learning import refine_softly
from jaxsmw.runtime.files import atomic_write

SAMPLES, KNOTS, FILTERS = 1000, 32, 6
TEMPERATURE, LEARNING_RATE, FLOOR = 0.1, 0.3, 0.05


class Sampled(NamedTuple):
    """A training pair, restricted to s samples of each shape, with initial maps between the samples.

    Positions are in units of the square root of the shape's area. `truth` contains the position of the true
    match on Y for each sample of X.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    positions_x: Float[Array, "s 3"]
    positions_y: Float[Array, "s 3"]
    initial_map: Int[Array, " s"]
    reverse_initial_map: Int[Array, " s"]
    truth: Float[Array, "s 3"]


def bank_of(frame: SoftmaxFrame) -> FilterBank:
    """Return the frame as a filter bank whose knots are evenly spaced in frequency."""
    return Warped(frame, Power())


def like_meyer() -> SoftmaxFrame:
    """Return the initial frame of training. It resembles the Meyer frame, but has positive filters."""
    return SoftmaxFrame.like(Warped(Meyer(FILTERS), Power(np.asarray(2.0))), KNOTS, floor=FLOOR)


@cache
def sampled(pair: DataPair) -> Sampled:
    """Sample both shapes of a pair, and compute the initial maps and the ground truth between the samples."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    pair_of_meshes = Pair(mesh_x, mesh_y)
    spectra = paired_spectra(pair_of_meshes, EIGENVECTORS)
    samples = [farthest_point_samples(mesh, SAMPLES) for mesh in (mesh_x, mesh_y)]
    positions = [
        unit_area_positions(mesh)[of_mesh] for mesh, of_mesh in zip((mesh_x, mesh_y), samples, strict=True)
    ]

    def nearest(pointwise_map: np.ndarray, source: int, mesh: Mesh) -> np.ndarray:
        """Restrict a map between all vertices to the samples, and move each match to the nearest sample."""
        images = unit_area_positions(mesh)[pointwise_map[samples[source]]]
        return KDTree(positions[1 - source]).query(images)[1].astype(np.int32)

    truth = pair.ground_truth(mesh_x, mesh_y).everywhere(mesh_x)[samples[0]]
    return Sampled(
        spectra[0].sample(jnp.asarray(samples[0])),
        spectra[1].sample(jnp.asarray(samples[1])),
        jnp.asarray(positions[0], jnp.float32),
        jnp.asarray(positions[1], jnp.float32),
        jnp.asarray(nearest(initial_map(pair_of_meshes, *spectra), 0, mesh_y)),
        jnp.asarray(nearest(initial_map(pair_of_meshes.reversed(), *spectra[::-1]), 1, mesh_x)),
        jnp.asarray(unit_area_positions(mesh_y)[truth], jnp.float32),
    )


def soft_map(
    frame: SoftmaxFrame, spectrum_x: Spectrum, spectrum_y: Spectrum, initial: Int[Array, " s"]
) -> SoftMap | SparseSoftMap:
    """Refine an initial map by `refine_softly` with the frame, and return the soft map."""
    # Eigenvectors restricted to samples are not orthonormal, so they need a least-squares pseudo-inverse.
    refiner = WaveletPreservation(bank_of(frame), Filtering("least_squares"))
    recovery = Softmax(np.asarray(TEMPERATURE))
    return refine_softly(
        spectrum_x, spectrum_y, initial, refiner=refiner, recovery=recovery, iterations=ITERATIONS - 1
    ).soft_map


def distance_to_truth(frame: SoftmaxFrame, pair: Sampled) -> Float[Array, ""]:
    """Return the loss `labels`: the mean distance between soft matches and the ground truth."""
    matched = soft_map(frame, pair.spectrum_x, pair.spectrum_y, pair.initial_map)
    return root_mean_square(matched.pull_back, pair.positions_y, pair.truth)


def round_trip_distance(frame: SoftmaxFrame, pair: Sampled) -> Float[Array, ""]:
    """Return the loss `cycles`: the mean distance from points of X to their images on a round trip via Y."""
    forward = soft_map(frame, pair.spectrum_x, pair.spectrum_y, pair.initial_map)
    backward = soft_map(frame, pair.spectrum_y, pair.spectrum_x, pair.reverse_initial_map)
    return round_trip(forward, backward, pair.positions_x)


LOSSES: dict[str, Callable[[SoftmaxFrame, Sampled], Float[Array, ""]]] = {
    "labels": distance_to_truth,
    "cycles": round_trip_distance,
}


def save(frame: SoftmaxFrame, path: Path) -> None:
    """Write the logits of a frame to an `.npz` file."""
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, logits=np.asarray(frame.logits))


def load(path: Path) -> FilterBank:
    """Read the logits that `save` wrote, and return the frame as a filter bank."""
    with np.load(path) as arrays:
        return bank_of(SoftmaxFrame(arrays["logits"]))


def refinement_errors(pair: DataPair, banks: Mapping[str, FilterBank], seed: int) -> dict[str, float]:
    """Return a dictionary from the name of each bank to the mean geodesic error x 10³ after refinement."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    both = Pair(mesh_x, mesh_y)
    spectra = paired_spectra(both, EIGENVECTORS)
    initial = initial_map(both, *spectra)
    maps = {name: refined(spectra, initial, WaveletPreservation(bank)) for name, bank in banks.items()}
    return errors(pair, mesh_x, mesh_y, maps, seed)


def summary(measured: Measured, steps: int, seed: int) -> Iterator[str]:
    """Yield the parts of `summary.md`."""
    yield "# Learned frames\n"
    yield (
        f"The frames have {FILTERS} filters and {KNOTS} knots. Training takes {steps} steps of Adam. "
        f"Refinement uses k = {EIGENVECTORS} and {ITERATIONS} iterations from SHOT. The numbers are mean "
        "geodesic errors x 10⁻³ √area. Parentheses contain the mean paired difference from the Meyer frame "
        "with its 95 % bootstrap interval.\n"
    )
    yield comparison(measured, list(next(iter(measured.values()))[0]), seed)


def draw(banks: Mapping[str, FilterBank], losses: Mapping[str, np.ndarray], path: Path) -> None:
    """Plot the filters of each bank, and the losses against the training steps."""
    figure, axes = plt.subplots(1, len(banks) + 1, figsize=(4 * len(banks) + 4, 3.2), layout="constrained")
    points = jnp.linspace(0, 1, 500)
    for axis, (name, bank) in zip(axes[:-1], banks.items(), strict=True):
        axis.plot(np.sqrt(points), np.asarray(bank(points, points)).T)
        axis.set(title=name, xlabel="√(λ / λ_max)", ylim=(0, 1.05))
    for name, values in losses.items():
        axes[-1].plot(*smoothed(values), label=name)
    axes[-1].set(title="loss / loss before training", xlabel="step")
    axes[-1].legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    plt.close(figure)


def main() -> None:
    arguments = parser((__doc__ or "").splitlines()[0], output="learned-frame", steps=200)
    with running(arguments, {"samples": SAMPLES, "knots": KNOTS, "filters": FILTERS}) as run:
        banks: dict[str, FilterBank] = {"Meyer": Meyer(FILTERS), "before learning": bank_of(like_meyer())}
        optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, run.steps))
        losses = {}
        for name, loss in LOSSES.items():
            trained = run.train(
                name,
                loss,
                like_meyer(),
                run.data.seen,
                sampled,
                optimizer,
                # The loss varies more between pairs than between frames, so each pair's loss is normalised.
                unit=lambda pair, loss=loss: loss(like_meyer(), pair),
            )
            losses[name] = trained.losses
            save(trained.model, run.directory / f"frame_{name}.npz")
            banks[f"learned from {name}"] = load(run.directory / f"frame_{name}.npz")
        measured = run.measure(lambda pair: refinement_errors(pair, banks, run.seed))
        run.write_summary(summary(measured, run.steps, run.seed))
        draw(banks, losses, run.directory / "frames.png")


if __name__ == "__main__":
    main()
