"""Can a tight frame be learned that matches shapes better than Meyer's?

    python scripts/learn_frame.py DATA_DIRECTORY [--output DIRECTORY] [--steps N] [--test-pairs N] [--seed N]
                                  [--quick]

It needs the extra `learn`: `pip install -e ".[learn]"`.

DATA_DIRECTORY holds `faust_r` and `tosca_r` (docs/datasets.md). A `SoftmaxFrame`, a Parseval frame whatever
its parameters are, starts like Meyer's with six filters and is trained on pairs of FAUST's first five people
by Adam (optax), one pair at each step, with gradients through `refine_softly` on samples of both
shapes: once with the truth, once without. What is minimised is how far matches are from the truth, or how far
one is from where one began after going there and back, as the root of the mean square over a soft map.

Then Meyer's frame and both that were learned refine pairs of the five other people and of TOSCA with
`jaxsmw.refine` from the same start. `summary.md` says how they compare, `frames.png` shows them, and
`frame_labels.npz` and `frame_cycles.npz` hold them (`Warped(SoftmaxFrame(logits), Power())`). Interrupted,
it goes on where it was, if started again with the same settings.
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
    measure,
    parser,
    places,
    refined,
    root_mean_square,
    running,
    smoothed,
    train,
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
    prepare,
    read_mesh,
)
from jaxsmw.banks import SoftmaxFrame
from jaxsmw.core.banks import FilterBank, Power, Warped
from jaxsmw.core.soft_maps import Recovery, SoftMap, Softmax, SparseSoftMap
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.geometry import farthest_point_samples
from jaxsmw.learning import refine_softly
from jaxsmw.runtime.files import atomic_write

SAMPLES, KNOTS, FILTERS = 1000, 32, 6
TEMPERATURE, LEARNING_RATE, FLOOR = 0.1, 0.3, 0.05


class Sampled(NamedTuple):
    """A pair on samples of both shapes, which is what is trained on."""

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    positions_x: Float[Array, "s 3"]
    positions_y: Float[Array, "s 3"]
    start: Int[Array, " s"]
    way_back: Int[Array, " s"]
    truth: Float[Array, "s 3"]


def bank_of(frame: SoftmaxFrame) -> FilterBank:
    """Knots evenly spaced in frequency."""
    return Warped(frame, Power())


def like_meyer() -> SoftmaxFrame:
    """Where learning starts."""
    return SoftmaxFrame.like(Warped(Meyer(FILTERS), Power(2.0)), KNOTS, floor=FLOOR)


@cache
def sampled(pair: DataPair) -> Sampled:
    """Samples, starts in both directions and truth of a pair, lengths in square roots of the area."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    pair_of_meshes = Pair(mesh_x, mesh_y)
    spectra = paired_spectra(pair_of_meshes, EIGENVECTORS)
    samples = [farthest_point_samples(mesh, SAMPLES) for mesh in (mesh_x, mesh_y)]
    positions = [places(mesh)[chosen] for mesh, chosen in zip((mesh_x, mesh_y), samples, strict=True)]

    def nearest(pointwise_map: np.ndarray, source: int, mesh: Mesh) -> np.ndarray:
        """Among samples, from a map of all vertices to all."""
        found = places(mesh)[pointwise_map[samples[source]]]
        return KDTree(positions[1 - source]).query(found)[1].astype(np.int32)

    truth = pair.ground_truth(mesh_x, mesh_y).everywhere(mesh_x)[samples[0]]
    return Sampled(
        *(spectrum.sample(jnp.asarray(chosen)) for spectrum, chosen in zip(spectra, samples, strict=True)),
        *(jnp.asarray(place, jnp.float32) for place in positions),
        jnp.asarray(nearest(initial_map(pair_of_meshes, *spectra), 0, mesh_y)),
        jnp.asarray(nearest(initial_map(pair_of_meshes.reversed(), *spectra[::-1]), 1, mesh_x)),
        jnp.asarray(places(mesh_y)[truth], jnp.float32),
    )


def soft_map(
    frame: SoftmaxFrame, spectrum_x: Spectrum, spectrum_y: Spectrum, start: Int[Array, " s"]
) -> SoftMap | SparseSoftMap:
    """What the frame makes of a start."""
    # Samples' eigenvectors are not orthonormal.
    refiner = WaveletPreservation(bank_of(frame), Filtering("least_squares"))
    recovery: Recovery = Softmax(TEMPERATURE)
    options = {"refiner": refiner, "recovery": recovery, "iterations": ITERATIONS - 1}
    return refine_softly(spectrum_x, spectrum_y, start, **options).soft_map


def distance_to_truth(frame: SoftmaxFrame, pair: Sampled) -> Float[Array, ""]:
    """The loss with labels."""
    found = soft_map(frame, pair.spectrum_x, pair.spectrum_y, pair.start)
    return root_mean_square(found.pull_back, pair.positions_y, pair.truth)


def distance_there_and_back(frame: SoftmaxFrame, pair: Sampled) -> Float[Array, ""]:
    """The loss without: how far from where it began a point of X comes back to."""
    there = soft_map(frame, pair.spectrum_x, pair.spectrum_y, pair.start)
    back = soft_map(frame, pair.spectrum_y, pair.spectrum_x, pair.way_back)
    return root_mean_square(
        lambda values: there.pull_back(back.pull_back(values)), pair.positions_x, pair.positions_x
    )


LOSSES: dict[str, Callable[[SoftmaxFrame, Sampled], Float[Array, ""]]] = {
    "labels": distance_to_truth,
    "cycles": distance_there_and_back,
}


def save(frame: SoftmaxFrame, path: Path) -> None:
    """As what NumPy reads."""
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, logits=np.asarray(frame.logits))


def load(path: Path) -> FilterBank:
    """The bank of a saved frame."""
    with np.load(path) as arrays:
        return bank_of(SoftmaxFrame(arrays["logits"]))


def of_pair(pair: DataPair, banks: Mapping[str, FilterBank], seed: int) -> dict[str, float]:
    """Mean geodesic errors x 10³ of refinement with each bank, from the same start."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    prepared = prepare(Pair(mesh_x, mesh_y), number_of_eigenvectors=EIGENVECTORS)
    spectra, start = (prepared.spectrum_x, prepared.spectrum_y), prepared.initial_map
    maps = {name: refined(spectra, start, WaveletPreservation(bank)) for name, bank in banks.items()}
    return errors(pair, mesh_x, mesh_y, maps, seed)


def summary(measured: Measured, steps: int, seed: int, begun_with: str) -> Iterator[str]:
    """The page, in parts."""
    yield "# Learned frames\n"
    yield (
        f"Frames of {FILTERS} filters and {KNOTS} knots, {steps} steps of Adam; k = {EIGENVECTORS}, "
        f"{ITERATIONS} iterations from SHOT. Mean geodesic errors x 10⁻³ √area; in brackets 95 % bootstrap "
        "intervals of the mean difference from Meyer's frame, pair by pair.\n"
    )
    yield comparison(measured, list(next(iter(measured.values()))[0]), seed)
    yield begun_with + "\n"


def draw(banks: Mapping[str, FilterBank], losses: Mapping[str, np.ndarray], path: Path) -> None:
    """The filters of each bank, and how losses fell."""
    figure, axes = plt.subplots(1, len(banks) + 1, figsize=(4 * len(banks) + 4, 3.2), layout="constrained")
    points = jnp.linspace(0, 1, 500)
    for axis, (name, bank) in zip(axes[:-1], banks.items(), strict=True):
        axis.plot(np.sqrt(points), np.asarray(bank(points, points)).T)
        axis.set(title=name, xlabel="√(λ / λ_max)", ylim=(0, 1.05))
    for name, values in losses.items():
        axes[-1].plot(*smoothed(values), label=name)
    axes[-1].set(title="loss, of that before learning", xlabel="step")
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
            trained = train(
                name,
                loss,
                like_meyer(),
                run.data.seen,
                sampled,
                optimizer,
                steps=run.steps,
                seed=run.seed,
                directory=run.directory,
                # Pairs differ more than frames do.
                unit=lambda pair, loss=loss: loss(like_meyer(), pair),
            )
            losses[name] = trained.losses
            save(trained.model, run.directory / f"frame_{name}.npz")
            banks[f"learned from {name}"] = load(run.directory / f"frame_{name}.npz")
        measured = measure(
            run.data,
            lambda pair: of_pair(pair, banks, run.seed),
            number_of_pairs=run.test_pairs,
            seed=run.seed,
            directory=run.directory,
        )
        page = "\n".join(summary(measured, run.steps, run.seed, run.begun_with))
        with atomic_write(run.directory / "summary.md") as temporary:
            temporary.write_text(page, "utf-8")
        draw(banks, losses, run.directory / "frames.png")
    print(page)


if __name__ == "__main__":
    main()
