"""Can descriptors be learned that start a refinement better than SHOT does?

    python scripts/learn_descriptors.py DATA_DIRECTORY [--output DIRECTORY] [--steps N] [--test-pairs N]
                                        [--seed N] [--quick]

It needs the extra `learn`: `pip install -e ".[learn]"`.

DATA_DIRECTORY holds `faust_r` and `tosca_r` (docs/datasets.md). A `DescriptorNetwork` makes descriptors of
vertices from SHOT and the wave kernel signature. A `WaveletPreservationLayer` behind it makes of those
of two shapes a functional map and a soft map, and by gradients through both the network is trained by Adam
(optax) on pairs of FAUST's first five people, one at each step: once with the truth, once without.

Then nearest neighbours of SHOT, of the network before learning and of both that were learned are the starts
from which the preset `paper` refines pairs of the other people and of TOSCA. `summary.md` says how they
compare, `curves.png` shows how losses fell, `errors.csv` has the errors of every pair, `provenance.json` what
all comes from, and `descriptors_labels.eqx` and `descriptors_cycles.eqx` hold what was learned:
`load(path)(described(mesh))`. Interrupted, it goes on where it was, if started again with the same settings.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from learning import (
    EIGENVECTORS,
    ITERATIONS,
    Measured,
    Trained,
    comparison,
    errors,
    measure,
    padded,
    parser,
    places,
    reading,
    refined,
    root_mean_square,
    running,
    smoothed,
    train,
)

from jaxsmw import (
    Filtering,
    Mesh,
    Meyer,
    Pair,
    Spectrum,
    WaveletPreservation,
    compute_spectrum,
    prepare,
    read_mesh,
)
from jaxsmw.core.products import product
from jaxsmw.core.signatures import wave_kernel_signature
from jaxsmw.core.soft_maps import SoftMap, SparseSoftMap
from jaxsmw.evaluation.datasets import DataPair
from jaxsmw.functional_maps import nearest_neighbor
from jaxsmw.geometry import farthest_point_samples, shot_descriptors
from jaxsmw.geometry.shot import SHOT_DIMENSION
from jaxsmw.learning import WaveletPreservationLayer
from jaxsmw.runtime.files import atomic_write

SAMPLES, LAYER_EIGENVECTORS, LEARNING_RATE, LARGEST_GRADIENT = 1000, 60, 2e-3, 1.0
# Of the parts of the loss without labels that are no lengths.
WEIGHT = 0.1
WATCHED_PAIRS = 4


@dataclass(frozen=True)
class Sizes:
    """Of a network: what it takes to make another of the same leaves."""

    inputs: int = SHOT_DIMENSION
    waves: int = 32
    width: int = 64
    blocks: int = 3
    filters: int = 6
    outputs: int = 32

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if type(value) is not int or value < 1:
                raise ValueError(f"a network has at least one of its {name}, not {value!r}")


class WaveletBlock(eqx.Module):
    """Features of vertices and of their surroundings, mixed.

    Every channel is filtered on the surface: it keeps of each scale of a tight frame a share that is learned.
    What comes out and what came in go through two dense layers, vertex by vertex, and are added to what came
    in. Signs of eigenvectors cancel in the filters, and renumbering vertices renumbers features.
    """

    shares: Float[Array, "filters width"]
    norm: eqx.nn.LayerNorm
    first: eqx.nn.Linear
    second: eqx.nn.Linear

    def __init__(self, sizes: Sizes, key: PRNGKeyArray):
        keys = jax.random.split(key, 2)
        # Low-pass filters, each channel's with another end.
        scale, ends = jnp.arange(sizes.filters) + 0.5, jnp.linspace(0, sizes.filters, sizes.width)
        self.shares = jax.nn.sigmoid(2 * (ends[None, :] - scale[:, None]))
        self.norm = eqx.nn.LayerNorm(sizes.width)
        self.first = eqx.nn.Linear(2 * sizes.width, 2 * sizes.width, key=keys[0])
        self.second = eqx.nn.Linear(2 * sizes.width, sizes.width, key=keys[1])

    def __call__(self, features: Float[Array, "n width"], spectrum: Spectrum) -> Float[Array, "n width"]:
        normed = jax.vmap(self.norm)(features)
        responses = Meyer(self.shares.shape[0])(spectrum.eigenvalues, spectrum.eigenvalues)
        kept = product((responses**2).T, self.shares)
        areas = jnp.where(spectrum.mask, spectrum.vertex_areas, 0)[:, None]
        filtered = product(spectrum.eigenvectors, kept * product(spectrum.eigenvectors.T, areas * normed))
        hidden = jax.vmap(self.first)(jnp.concatenate([normed, filtered], axis=1))
        return features + jax.vmap(self.second)(jax.nn.gelu(hidden))


class DescriptorNetwork(eqx.Module):
    """Descriptors of the vertices of a shape whose spectrum has SHOT as its own (`Spectrum.descriptors`)."""

    enter: eqx.nn.Linear
    blocks: tuple[WaveletBlock, ...]
    norm: eqx.nn.LayerNorm
    leave: eqx.nn.Linear
    sizes: Sizes = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, sizes: Sizes = Sizes()):
        keys = jax.random.split(key, sizes.blocks + 2)
        self.sizes = sizes
        self.enter = eqx.nn.Linear(sizes.inputs + sizes.waves, sizes.width, key=keys[0])
        self.blocks = tuple(WaveletBlock(sizes, key) for key in keys[2:])
        self.norm = eqx.nn.LayerNorm(sizes.width)
        self.leave = eqx.nn.Linear(sizes.width, sizes.outputs, key=keys[1])

    def __call__(self, spectrum: Spectrum) -> Float[Array, "n outputs"]:
        given = spectrum.descriptors
        if given is None or given.shape[1] != self.sizes.inputs:
            raise ValueError(
                f"the spectrum has {'no' if given is None else given.shape[1]} descriptors, where "
                f"{self.sizes.inputs} are needed: describe it by shot_descriptors"
            )
        waves = wave_kernel_signature(spectrum, dimensions=self.sizes.waves) - 1
        # SHOT has length 1: now every entry has mean square 1.
        inputs = jnp.concatenate([given * self.sizes.inputs**0.5, waves], axis=1)
        features = jax.vmap(self.enter)(inputs)
        for block in self.blocks:
            features = block(features, spectrum)
        return jax.vmap(self.leave)(jax.vmap(self.norm)(features))


def layer() -> WaveletPreservationLayer:
    """What turns descriptors of samples of two shapes into maps; it has nothing to be learned here."""
    # Samples' eigenvectors are not orthonormal.
    refiner = WaveletPreservation(Meyer(6), Filtering("least_squares"))
    return WaveletPreservationLayer(refiner, iterations=2)


class Shape(NamedTuple):
    """A shape with SHOT, on samples of its vertices, which is what is trained on."""

    spectrum: Spectrum
    positions: Float[Array, "s 3"]


class TrainingPair(NamedTuple):
    """Two shapes, and where in Y the samples of X belong."""

    x: Shape
    y: Shape
    truth: Float[Array, "s 3"]


class Source(NamedTuple):
    """What a shape's samples come from."""

    mesh: Mesh
    samples: Int[np.ndarray, " s"]
    shape: Shape


@cache
def source(file: Path) -> Source:
    """A shape as training takes it."""
    mesh = read_mesh(file)
    samples = farthest_point_samples(mesh, SAMPLES)
    spectrum = described(mesh).sample(jnp.asarray(samples))
    return Source(mesh, samples, Shape(spectrum, jnp.asarray(places(mesh)[samples], float)))


@cache
def prepared(pair: DataPair) -> TrainingPair:
    """A pair as training takes it."""
    x, y = map(source, pair.meshes)
    truth = pair.ground_truth(x.mesh, y.mesh).everywhere(x.mesh)[x.samples]
    return TrainingPair(x.shape, y.shape, jnp.asarray(places(y.mesh)[truth], float))


def described(mesh: Mesh) -> Spectrum:
    """A spectrum as a `DescriptorNetwork` wants it, of area 1, with SHOT, padded."""
    spectrum = compute_spectrum(mesh, EIGENVECTORS)
    shot = shot_descriptors(mesh).astype(spectrum.eigenvectors.dtype)
    return padded(spectrum.with_descriptors(jnp.asarray(shot)))


class Matched(NamedTuple):
    """What descriptors of a shape and of another come to, by themselves and by the layer."""

    by_descriptors: SoftMap | SparseSoftMap
    by_layer: SoftMap | SparseSoftMap
    functional_map: Float[Array, "k k"]
    energy: Float[Array, ""]


def matched(network: DescriptorNetwork, x: Shape, y: Shape) -> Matched:
    """Soft maps from X to Y, the functional map, and how badly that preserves wavelets, per eigenvector."""
    features = network(x.spectrum), network(y.spectrum)
    spectra = [side.spectrum.truncate(LAYER_EIGENVECTORS) for side in (x, y)]
    of_layer = layer()
    found = of_layer(*features, *spectra)
    by_descriptors = of_layer.recovery_of_features(*features, *(s.vertex_areas for s in spectra))
    energy = of_layer.refiner.problem(*spectra, sampled=True).energy(found.soft_map)(found.functional_map)
    return Matched(by_descriptors, found.soft_map, found.functional_map, energy / LAYER_EIGENVECTORS)


def distance_to_truth(network: DescriptorNetwork, pair: TrainingPair) -> Float[Array, ""]:
    """The loss with labels: how far from the truth the layer takes points, and descriptors by themselves."""
    found = matched(network, pair.x, pair.y)
    by_layer, by_descriptors = (
        root_mean_square(soft_map.pull_back, pair.y.positions, pair.truth)
        for soft_map in (found.by_layer, found.by_descriptors)
    )
    return by_layer + by_descriptors / 2


def inconsistency(network: DescriptorNetwork, pair: TrainingPair) -> Float[Array, ""]:
    """The loss without.

    What of wavelets is lost, how far functional maps there and back are from undoing each other, and how far
    from where it began a point comes back to, by the layer and by descriptors themselves.
    """
    there, back = matched(network, pair.x, pair.y), matched(network, pair.y, pair.x)
    round_trip = product(there.functional_map, back.functional_map)
    bijectivity = jnp.mean(
        jnp.sum((round_trip - jnp.eye(*round_trip.shape, dtype=round_trip.dtype)) ** 2, axis=1)
    )
    by_layer, by_descriptors = (
        root_mean_square(
            lambda f, go=go, come=come: go.pull_back(come.pull_back(f)), pair.x.positions, pair.x.positions
        )
        for go, come in ((there.by_layer, back.by_layer), (there.by_descriptors, back.by_descriptors))
    )
    return WEIGHT * (there.energy + back.energy + bijectivity) + by_layer + by_descriptors / 2


LOSSES: dict[str, Callable[[DescriptorNetwork, TrainingPair], Float[Array, ""]]] = {
    "labels": distance_to_truth,
    "cycles": inconsistency,
}


def save(network: DescriptorNetwork, path: Path) -> None:
    """Write a network: a line of JSON with its sizes and its float type, then its leaves."""
    header = {"sizes": asdict(network.sizes), "dtype": str(network.leave.weight.dtype)}
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(stream, network)


def load(path: Path) -> DescriptorNetwork:
    """Read what `save` wrote.

    **Raises:** `InputError` if it did not write this file, or not all of it.
    """
    with reading(path) as stream:
        header = json.loads(stream.readline(_LONGEST_HEADER))
        sizes, dtype = Sizes(**header["sizes"]), jnp.dtype(header["dtype"])
        outlines = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype),
            eqx.filter_eval_shape(DescriptorNetwork, jax.random.key(0), sizes),
        )
        return eqx.tree_deserialise_leaves(stream, outlines)


_LONGEST_HEADER = 1000


@eqx.filter_jit
def nearest_descriptors(network: DescriptorNetwork, x: Spectrum, y: Spectrum) -> Int[Array, " m"]:
    """The vertices of Y whose descriptors are nearest to those of X's vertices."""
    return nearest_neighbor(network(x), network(y), database_mask=y.mask)


def of_pair(pair: DataPair, networks: Mapping[str, DescriptorNetwork], seed: int) -> dict[str, float]:
    """Mean geodesic errors x 10³ of each start, and of what refinement makes of it."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    x, y = described(mesh_x), described(mesh_y)
    m = len(mesh_x.vertices)
    spectra = x.with_descriptors(None), y.with_descriptors(None)
    prepared = prepare(Pair(mesh_x, mesh_y), number_of_eigenvectors=EIGENVECTORS)
    starts = {REFERENCE: prepared.initial_map}
    for name, network in networks.items():
        starts[name] = np.asarray(nearest_descriptors(network, x, y))[:m].astype(np.int64)
    maps = {f"{name}{START}": found for name, found in starts.items()}
    maps |= {f"{name}{REFINED}": refined(spectra, found) for name, found in starts.items()}
    return errors(pair, mesh_x, mesh_y, maps, seed)


REFERENCE, START, REFINED = "SHOT", ", start", ", refined"


def summary(measured: Measured, steps: int, seed: int, begun_with: str) -> Iterator[str]:
    """The page, in parts."""
    yield "# Learned descriptors\n"
    yield (
        f"{steps} steps of Adam for each loss, each of one pair on {SAMPLES} samples. Mean geodesic errors x "
        "10⁻³ √area of nearest neighbours of descriptors, and of what the preset `paper` makes of them "
        f"(k = {EIGENVECTORS}, {ITERATIONS} iterations); in brackets 95 % bootstrap intervals of the mean "
        "difference from SHOT, pair by pair.\n"
    )
    of_pairs = next(iter(measured.values()))[0]
    names = [name.removesuffix(START) for name in of_pairs if name.endswith(START)]
    for title, suffix in (("start", START), ("refined", REFINED)):
        here = {
            f"{data_set}, {title}": [{name: pair[name + suffix] for name in names} for pair in pairs]
            for data_set, pairs in measured.items()
        }
        yield comparison(here, names, seed)
    yield begun_with + "\n"


def draw(curves: Mapping[str, Trained], path: Path) -> None:
    """How losses fell, on pairs trained on and on others."""
    figure, axes = plt.subplots(1, len(curves), figsize=(5 * len(curves), 3.4), layout="constrained")
    for axis, (name, curve) in zip(axes, curves.items(), strict=True):
        axis.plot(*smoothed(curve.losses), label="pairs trained on, running mean")
        axis.plot(curve.steps, curve.watched, "o-", label=f"{WATCHED_PAIRS} pairs of people not seen")
        axis.set(title=f"loss, {name}", xlabel="step", ylim=(0, None))
        axis.legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    plt.close(figure)


def main() -> None:
    constants = {"samples": SAMPLES, "eigenvectors": EIGENVECTORS, **asdict(Sizes())}
    arguments = parser((__doc__ or "").splitlines()[0], output="learned-descriptors", steps=300)
    with running(arguments, constants) as run:
        key = jax.random.key(run.seed)
        networks = {"before learning": DescriptorNetwork(key)}
        steps = optax.cosine_decay_schedule(LEARNING_RATE, run.steps)
        optimizer = optax.chain(optax.clip_by_global_norm(LARGEST_GRADIENT), optax.adam(steps))
        curves = {}
        for name, loss in LOSSES.items():
            curves[name] = train(
                name,
                loss,
                DescriptorNetwork(key),
                run.data.seen + run.data.seen_further,
                prepared,
                optimizer,
                steps=run.steps,
                seed=run.seed,
                directory=run.directory,
                watched=run.data.unseen[: min(WATCHED_PAIRS, run.test_pairs)],
            )
            path = run.directory / f"descriptors_{name}.eqx"
            save(curves[name].model, path)
            networks[f"learned from {name}"] = load(path)
        measured = measure(
            run.data,
            lambda pair: of_pair(pair, networks, run.seed),
            number_of_pairs=run.test_pairs,
            seed=run.seed,
            directory=run.directory,
        )
        page = "\n".join(summary(measured, run.steps, run.seed, run.begun_with))
        with atomic_write(run.directory / "summary.md") as temporary:
            temporary.write_text(page, "utf-8")
        draw({f"from {name}": curve for name, curve in curves.items()}, run.directory / "curves.png")
    print(page)


if __name__ == "__main__":
    main()
