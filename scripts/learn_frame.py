"""Can a tight frame be learned that matches shapes better than Meyer's?

    python scripts/learn_frame.py DATA_DIRECTORY [--output DIRECTORY] [--steps N] [--test-pairs N] [--seed N]
                                  [--quick]

It needs the extra `learn`: `pip install -e ".[learn]"`.

DATA_DIRECTORY holds `faust_r` and `tosca_r` (docs/datasets.md). A `SoftmaxFrame`, a Parseval frame whatever
its parameters are, starts like Meyer's with six filters and is trained on pairs of FAUST's first five people
by Adam (optax), one pair at each step, with gradients through `jaxsmw.refine_softly` on samples of both
shapes: once with the truth, once without. What is minimised is how far matches are from the truth, or how far
one is from where one began after going there and back, as the root of the mean square over a soft map.

Then Meyer's frame and both that were learned refine pairs of the five other people and of TOSCA with
`jaxsmw.refine` from the same start. `summary.md` says how they compare, `frames.png` shows them, and
`frame_labels.npz` and `frame_cycles.npz` hold them (`Warped(SoftmaxFrame(logits), Power())`). Interrupted,
it goes on where it was, if started again with the same settings.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree
from tqdm import tqdm

from jaxsmw import (
    Filtering,
    InputError,
    Mesh,
    Meyer,
    SoftmaxFrame,
    Spectrum,
    WaveletPreservation,
    farthest_point_samples,
    geodesic_error,
    initial_map,
    paired_spectra,
    read_mesh,
    refine,
    refine_softly,
)
from jaxsmw.core.filters import FilterBank, Power, Warped
from jaxsmw.core.soft_maps import Recovery, SoftMap, Softmax, SparseSoftMap
from jaxsmw.evaluation.datasets import DataPair, open_data_set
from jaxsmw.evaluation.intervals import mean_interval
from jaxsmw.files import atomic_write, make_directory
from jaxsmw.provenance import commit, machine, versions
from jaxsmw.report.tables import markdown

EIGENVECTORS, ITERATIONS, SAMPLES, KNOTS, FILTERS = 100, 3, 1000, 32, 6
TEMPERATURE, LEARNING_RATE, FLOOR = 0.1, 0.3, 0.05
TRAINING_PEOPLE, POSES = 5, 10
# Steps between saves.
_SAVED_EVERY = 10


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


def sampled(pair: DataPair) -> Sampled:
    """Samples, starts in both directions and truth of a pair, lengths in square roots of the area."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    spectra = paired_spectra(mesh_x, mesh_y, EIGENVECTORS)
    samples = [farthest_point_samples(mesh, SAMPLES) for mesh in (mesh_x, mesh_y)]
    positions = [
        mesh.vertices[chosen] / mesh.area**0.5 for mesh, chosen in zip((mesh_x, mesh_y), samples, strict=True)
    ]

    def nearest(pointwise_map: np.ndarray, source: int, mesh: Mesh) -> np.ndarray:
        """Among samples, from a map of all vertices to all."""
        places = mesh.vertices[pointwise_map[samples[source]]] / mesh.area**0.5
        return KDTree(positions[1 - source]).query(places)[1].astype(np.int32)

    truth = pair.ground_truth(mesh_x, mesh_y).everywhere(mesh_x)[samples[0]]
    return Sampled(
        *(spectrum.sample(jnp.asarray(chosen)) for spectrum, chosen in zip(spectra, samples, strict=True)),
        *(jnp.asarray(place, jnp.float32) for place in positions),
        jnp.asarray(nearest(initial_map(mesh_x, mesh_y, *spectra), 0, mesh_y)),
        jnp.asarray(nearest(initial_map(mesh_y, mesh_x, *spectra[::-1]), 1, mesh_x)),
        jnp.asarray(mesh_y.vertices[truth] / mesh_y.area**0.5, jnp.float32),
    )


def root_mean_square(
    carried: Callable[[Float[Array, "s p"]], Float[Array, "s p"]],
    positions: Float[Array, "s 3"],
    wanted: Float[Array, "s 3"],
) -> Float[Array, ""]:
    """How far from where they should be points are carried: over a soft map, then the mean of all."""
    places = carried(jnp.concatenate([positions, jnp.sum(positions**2, axis=1, keepdims=True)], axis=1))
    squares = places[:, 3] - 2 * jnp.sum(places[:, :3] * wanted, axis=1) + jnp.sum(wanted**2, axis=1)
    return jnp.mean(jnp.sqrt(jnp.maximum(squares, 0) + 1e-6))


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


class State(eqx.Module):
    """What training goes on from."""

    frame: SoftmaxFrame
    optimizer: optax.OptState
    step: Int[Array, ""]
    losses: Float[Array, " steps"]


def train(
    name: str, pairs: list[DataPair], steps: int, seed: int, directory: Path, prepared: dict
) -> tuple[SoftmaxFrame, np.ndarray]:
    """The frame after so many steps, each by another pair, and the losses on the way.

    Pairs differ more than frames do: losses are in units of that of the frame before learning, pair by pair.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, steps))

    @eqx.filter_jit
    def improve(state: State, pair: Sampled) -> State:
        loss, gradient = jax.value_and_grad(LOSSES[name])(state.frame, pair)
        change, following = optimizer.update(gradient, state.optimizer)
        losses = state.losses.at[state.step].set(loss / LOSSES[name](like_meyer(), pair))
        return State(optax.apply_updates(state.frame, change), following, state.step + 1, losses)

    frame = like_meyer()
    state = State(frame, optimizer.init(frame), jnp.asarray(0, jnp.int32), jnp.zeros(steps))
    saved = make_directory(directory) / f"training_{name}_{steps}_{seed}.eqx"
    if saved.exists():
        state = eqx.tree_deserialise_leaves(saved, state)
    order = np.random.default_rng(seed).integers(0, len(pairs), steps)
    for step in tqdm(range(int(state.step), steps), desc=f"learning from {name}", unit="step"):
        pair = pairs[order[step]]
        if pair.names not in prepared:
            prepared[pair.names] = sampled(pair)
        state = improve(state, prepared[pair.names])
        if not np.isfinite(state.losses[step]):
            raise ArithmeticError(f"the loss became {state.losses[step]} at step {step} ({pair.name})")
        if (step + 1) % _SAVED_EVERY == 0 or step + 1 == steps:
            with atomic_write(saved) as temporary, open(temporary, "wb") as stream:
                eqx.tree_serialise_leaves(stream, state)
    return state.frame, np.asarray(state.losses)


def save(frame: SoftmaxFrame, path: Path) -> None:
    """As what NumPy reads."""
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, logits=np.asarray(frame.logits))


def load(path: Path) -> FilterBank:
    """The bank of a saved frame."""
    with np.load(path) as arrays:
        return bank_of(SoftmaxFrame(arrays["logits"]))


def errors(pair: DataPair, banks: Mapping[str, FilterBank], seed: int) -> dict[str, float]:
    """Mean geodesic errors x 10³ of refinement with each bank, from the same start."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    spectra = paired_spectra(mesh_x, mesh_y, EIGENVECTORS)
    start = jnp.asarray(initial_map(mesh_x, mesh_y, *spectra))
    truth = pair.ground_truth(mesh_x, mesh_y)
    found = {}
    for name, bank in banks.items():
        refined = refine(*spectra, start, refiner=WaveletPreservation(bank), iterations=ITERATIONS)
        pointwise_map = np.asarray(refined.pointwise_map).astype(np.int64)
        found[name] = (
            1e3 * geodesic_error(mesh_y, pointwise_map, truth, number_of_samples=500, seed=seed).mean
        )
    return found


def person(shape: str) -> int:
    return int(shape.rsplit("_", 1)[1]) // POSES


def summary(measured: Mapping[str, list[dict[str, float]]], steps: int, seed: int) -> Iterator[str]:
    """The page, in parts."""
    yield "# Learned frames\n"
    yield (
        f"Frames of {FILTERS} filters and {KNOTS} knots, {steps} steps of Adam; k = {EIGENVECTORS}, "
        f"{ITERATIONS} iterations from SHOT. Mean geodesic errors x 10⁻³ √area; in brackets 95 % bootstrap "
        "intervals of the mean difference from Meyer's frame, pair by pair.\n"
    )
    names = list(next(iter(measured.values()))[0])
    rows = [["", "pairs", *names]]
    for data_set, pairs in measured.items():
        values = {name: np.array([pair[name] for pair in pairs]) for name in names}
        cells = [f"{values['Meyer'].mean():.1f}"]
        for name in names[1:]:
            difference = mean_interval(values[name] - values["Meyer"], seed)
            cells.append(f"{values[name].mean():.1f} ({difference})")
        rows.append([data_set, str(len(pairs)), *cells])
    yield markdown(rows)
    yield f"Commit {commit()}, {machine()}, " + ", ".join(f"{k} {v}" for k, v in versions().items()) + ".\n"


def draw(banks: Mapping[str, FilterBank], losses: Mapping[str, np.ndarray], path: Path) -> None:
    """The filters of each bank, and how losses fell."""
    figure, axes = plt.subplots(1, len(banks) + 1, figsize=(4 * len(banks) + 4, 3.2), layout="constrained")
    points = jnp.linspace(0, 1, 500)
    for axis, (name, bank) in zip(axes[:-1], banks.items(), strict=True):
        axis.plot(np.sqrt(points), np.asarray(bank(points, points)).T)
        axis.set(title=name, xlabel="√(λ / λ_max)", ylim=(0, 1.05))
    for name, values in losses.items():
        window = max(1, len(values) // 10)
        smooth = np.convolve(values, np.ones(window) / window, "valid")
        axes[-1].plot(np.arange(len(smooth)) + window / 2, smooth, label=name)
    axes[-1].set(title="loss, of that before learning", xlabel="step")
    axes[-1].legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="the directory with faust_r and tosca_r")
    parser.add_argument("--output", type=Path, default=Path("learned-frame"), help="default: learned-frame")
    parser.add_argument("--steps", type=int, default=200, help="of training (default: 200)")
    parser.add_argument("--test-pairs", type=int, default=40, help="of each data set (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    parser.add_argument("--quick", action="store_true", help="3 steps, 2 pairs: to see that it works")
    options = parser.parse_args()
    steps, test_pairs = (3, 2) if options.quick else (options.steps, options.test_pairs)
    if steps < 1 or test_pairs < 1:
        parser.error("--steps and --test-pairs must be at least 1")
    warnings.simplefilter("ignore")  # about meshes, of which each would tell
    try:
        directory = make_directory(options.output)
        faust, tosca = (open_data_set(options.data / name) for name in ("faust_r", "tosca_r"))
    except InputError as error:
        parser.error(str(error))

    seen = [p for p in faust.pairs if all(person(name) < TRAINING_PEOPLE for name in p.names)]
    unseen = [p for p in faust.pairs if all(person(name) >= TRAINING_PEOPLE for name in p.names)]
    if not seen or not unseen:
        parser.error(f"{options.data / 'faust_r'}: no pairs of the first or of the last five people.")
    prepared: dict[tuple[str, str], Sampled] = {}
    banks: dict[str, FilterBank] = {"Meyer": Meyer(FILTERS), "before learning": bank_of(like_meyer())}
    losses = {}
    for name in LOSSES:
        frame, losses[name] = train(name, seen, steps, options.seed, directory, prepared)
        save(frame, directory / f"frame_{name}.npz")
        banks[f"learned from {name}"] = load(directory / f"frame_{name}.npz")

    generator = np.random.default_rng(options.seed)
    measured = {}
    for title, pairs in (("people not seen", unseen), ("TOSCA", list(tosca.pairs))):
        chosen = np.sort(generator.permutation(len(pairs))[:test_pairs])
        measured[title] = [
            errors(pairs[index], banks, options.seed) for index in tqdm(chosen, desc=title, unit="pair")
        ]
    page = "\n".join(summary(measured, steps, options.seed))
    with atomic_write(directory / "summary.md") as temporary:
        temporary.write_text(page, "utf-8")
    draw(banks, losses, directory / "frames.png")
    print(page)


if __name__ == "__main__":
    main()
