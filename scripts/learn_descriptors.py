"""Trains descriptors, and tests whether they give better initial maps for refinement than SHOT.

    python scripts/learn_descriptors.py DATA_DIRECTORY [--output DIRECTORY] [--steps N] [--test-pairs N]
                                        [--seed N] [--quick]

The script needs the extra `learn`: `pip install -e ".[learn]"`.

DATA_DIRECTORY contains `faust_r` and `tosca_r` (docs/datasets.md). A `DescriptorNetwork` computes descriptors
of vertices from SHOT and the wave kernel signature. A `WaveletPreservationLayer` computes a functional map
and a soft map from the descriptors of two shapes. Gradients pass through the layer and the network. Each step
of Adam (optax) uses one pair of the first five people of FAUST. The script trains one network with the loss
`labels`, which needs ground truth, and one network with the loss `cycles`, which needs no ground truth.

The script then tests both networks on pairs of the other five people of FAUST and on pairs of TOSCA. The
preset `paper` refines each pair from four initial maps, which differ in their descriptors. Each initial map
sends each vertex of X to the vertex of Y with the nearest descriptors. The four kinds of descriptors are
SHOT, the output of the untrained network, and the outputs of the two trained networks. The script writes:

- `summary.md`: the comparison;
- `curves.png`: the losses against the training steps;
- `errors.csv`: the errors of every pair;
- `provenance.json`: settings, versions and machine;
- `descriptors_labels.eqx` and `descriptors_cycles.eqx`: the trained networks. The descriptors of a mesh are
  `load(path)(described(mesh))`.

After an interruption, the same command continues from the saved state.
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
    padded,
    parser,
    reading,
    refined,
    root_mean_square,
    round_trip,
    running,
    smoothed,
    unit_area_positions,
)

from jaxsmw import (
    Filtering,
    Mesh,
    Meyer,
    Pair,
    Spectrum,
    WaveletPreservation,
    compute_spectrum,
    initial_map,
    paired_spectra,
    read_mesh,
)
from jaxsmw.benchmark.datasets import DataPair
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.signatures import wave_kernel_signature
from jaxsmw.core.soft_maps import SoftMap, SparseSoftMap
from jaxsmw.functional_maps import nearest_neighbor
from jaxsmw.geometry import farthest_point_samples, shot_descriptors
from jaxsmw.geometry.shot import SHOT_DIMENSION
from jaxsmw.learning import WaveletPreservationLayer
from jaxsmw.runtime.files import atomic_write

SAMPLES, LAYER_EIGENVECTORS, LEARNING_RATE, LARGEST_GRADIENT = 1000, 60, 2e-3, 1.0
# The loss `cycles` multiplies the energies and the squared deviation from the identity by this weight.
WEIGHT = 0.1
WATCHED_PAIRS = 4


@dataclass(frozen=True)
class Sizes:
    """The sizes of a network, which determine the shapes of all its arrays; all are positive integers."""

    inputs: int = SHOT_DIMENSION  # entries of SHOT per vertex
    waves: int = 32  # entries of the wave kernel signature per vertex
    width: int = 64  # channels in each block
    blocks: int = 3
    filters: int = 6  # of the Meyer frame in each block
    outputs: int = 32  # descriptors per vertex

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if type(value) is not int or value < 1:
                raise ValueError(f"Sizes.{name} must be an integer of at least 1, not {value!r}")


class WaveletBlock(eqx.Module):
    """A residual block that combines the features of each vertex with features of its neighbourhood.

    The block filters every channel on the surface. The filter of a channel is a weighted sum of the squared
    filters of a Meyer frame, with learned weights. At each vertex, the normalised features and the filtered
    features are the input of two dense layers. The output of these layers is added to the features. The
    result does not depend on the signs of the eigenvectors. Renumbering the vertices permutes the rows of the
    result.
    """

    shares: Float[Array, "filters width"]
    norm: eqx.nn.LayerNorm
    first: eqx.nn.Linear
    second: eqx.nn.Linear

    def __init__(self, sizes: Sizes, key: PRNGKeyArray):
        keys = jax.random.split(key, 2)
        # Training starts from low-pass filters with a different cutoff for each channel.
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
    """A network that computes descriptors of the n vertices of a shape.

    The spectrum of the shape must contain SHOT descriptors (`Spectrum.descriptors`). `described` computes
    such a spectrum.

    **Raises:** `ValueError` if the spectrum does not have `sizes.inputs` descriptors per vertex.
    """

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
        shot = spectrum.descriptors
        if shot is None or shot.shape[1] != self.sizes.inputs:
            raise ValueError(
                f"the spectrum has {'no' if shot is None else shot.shape[1]} descriptors, but "
                f"{self.sizes.inputs} per vertex are needed: pass the result of shot_descriptors to "
                "Spectrum.with_descriptors"
            )
        waves = wave_kernel_signature(spectrum, dimensions=self.sizes.waves) - 1
        # SHOT descriptors have norm 1. This factor scales their entries to a mean square of 1.
        inputs = jnp.concatenate([shot * self.sizes.inputs**0.5, waves], axis=1)
        features = jax.vmap(self.enter)(inputs)
        for block in self.blocks:
            features = block(features, spectrum)
        return jax.vmap(self.leave)(jax.vmap(self.norm)(features))


def layer() -> WaveletPreservationLayer:
    """Return the layer that computes maps from descriptors. The layer's own parameters are not trained."""
    # Eigenvectors restricted to samples are not orthonormal, so they need a least-squares pseudo-inverse.
    refiner = WaveletPreservation(Meyer(6), Filtering("least_squares"))
    return WaveletPreservationLayer(refiner, iterations=2)


class Shape(NamedTuple):
    """A shape at s sampled vertices: the spectrum, which contains SHOT descriptors, and the positions."""

    spectrum: Spectrum
    positions: Float[Array, "s 3"]


class TrainingPair(NamedTuple):
    """Two shapes, and the position of the true match on Y for each of the s samples of X."""

    x: Shape
    y: Shape
    truth: Float[Array, "s 3"]


class Source(NamedTuple):
    """A mesh, the indices of its sampled vertices, and the shape restricted to these vertices."""

    mesh: Mesh
    samples: Int[np.ndarray, " s"]
    shape: Shape


@cache
def source(file: Path) -> Source:
    """Read a mesh, and sample it for training."""
    mesh = read_mesh(file)
    samples = farthest_point_samples(mesh, SAMPLES)
    spectrum = described(mesh).sample(jnp.asarray(samples))
    return Source(mesh, samples, Shape(spectrum, jnp.asarray(unit_area_positions(mesh)[samples], float)))


@cache
def prepared(pair: DataPair) -> TrainingPair:
    """Read and sample both shapes of a pair for training."""
    x, y = map(source, pair.meshes)
    truth = pair.ground_truth(x.mesh, y.mesh).everywhere(x.mesh)[x.samples]
    return TrainingPair(x.shape, y.shape, jnp.asarray(unit_area_positions(y.mesh)[truth], float))


def described(mesh: Mesh) -> Spectrum:
    """Return the input of a `DescriptorNetwork`: the padded spectrum of a mesh, with SHOT descriptors."""
    spectrum = compute_spectrum(mesh, EIGENVECTORS)
    shot = shot_descriptors(mesh).astype(spectrum.eigenvectors.dtype)
    return padded(spectrum.with_descriptors(jnp.asarray(shot)))


class Matched(NamedTuple):
    """The soft maps that a layer recovers from descriptors and from its functional map, and this map.

    `energy` is the wavelet-preservation energy of the functional map, divided by the number of eigenvectors.
    """

    by_descriptors: SoftMap | SparseSoftMap
    by_layer: SoftMap | SparseSoftMap
    functional_map: Float[Array | np.ndarray, "k k"]
    energy: Float[Array, ""]


def matched(network: DescriptorNetwork, x: Shape, y: Shape) -> Matched:
    """Compute the maps from X to Y with a network."""
    features = network(x.spectrum), network(y.spectrum)
    spectra = [side.spectrum.truncate(LAYER_EIGENVECTORS) for side in (x, y)]
    module = layer()
    of_layer = module(*features, *spectra)
    by_descriptors = module.recovery_of_features(*features, *(s.vertex_areas for s in spectra))
    energy = module.refiner.problem(*spectra, sampled=True).energy(of_layer.soft_map)(of_layer.functional_map)
    energy = jnp.asarray(energy / LAYER_EIGENVECTORS)
    return Matched(by_descriptors, of_layer.soft_map, of_layer.functional_map, energy)


def distance_to_truth(network: DescriptorNetwork, pair: TrainingPair) -> Float[Array, ""]:
    """Return the loss `labels`: a weighted sum of the errors of both soft maps of `Matched`."""
    maps = matched(network, pair.x, pair.y)
    by_layer, by_descriptors = (
        root_mean_square(soft_map.pull_back, pair.y.positions, pair.truth)
        for soft_map in (maps.by_layer, maps.by_descriptors)
    )
    return by_layer + by_descriptors / 2


def inconsistency(network: DescriptorNetwork, pair: TrainingPair) -> Float[Array, ""]:
    """Return the loss `cycles`, which needs no ground truth.

    The loss is a weighted sum of the wavelet-preservation energies of both functional maps, of the squared
    deviation of their product from the identity, and of the distances of points of X from their images under
    the forward map followed by the backward map.
    """
    forward, backward = matched(network, pair.x, pair.y), matched(network, pair.y, pair.x)
    there_and_back = product(forward.functional_map, backward.functional_map)
    identity = jnp.eye(len(there_and_back), dtype=there_and_back.dtype)
    bijectivity = jnp.mean(jnp.sum((there_and_back - identity) ** 2, axis=1))
    by_layer = round_trip(forward.by_layer, backward.by_layer, pair.x.positions)
    by_descriptors = round_trip(forward.by_descriptors, backward.by_descriptors, pair.x.positions)
    return WEIGHT * (forward.energy + backward.energy + bijectivity) + by_layer + by_descriptors / 2


LOSSES: dict[str, Callable[[DescriptorNetwork, TrainingPair], Float[Array, ""]]] = {
    "labels": distance_to_truth,
    "cycles": inconsistency,
}


def save(network: DescriptorNetwork, path: Path) -> None:
    """Write a network to a file, as a line of JSON (sizes and float type) followed by the arrays."""
    header = {"sizes": asdict(network.sizes), "dtype": str(network.leave.weight.dtype)}
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(stream, network)


def load(path: Path) -> DescriptorNetwork:
    """Read a network that `save` wrote; `InputError` if the file is damaged."""
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
def nearest_descriptors(
    network: DescriptorNetwork, x: Spectrum, y: Spectrum
) -> Int[Array | np.ndarray, " m"]:
    """Return, for each vertex of X, the vertex of Y with the nearest descriptors."""
    return nearest_neighbor(network(x), network(y), database_mask=y.mask)


def descriptor_errors(
    pair: DataPair, networks: Mapping[str, DescriptorNetwork], seed: int
) -> dict[str, float]:
    """Return the mean geodesic error x 10³ of each initial map and of each refined map."""
    mesh_x, mesh_y = (read_mesh(file) for file in pair.meshes)
    x, y = described(mesh_x), described(mesh_y)
    m = len(mesh_x.vertices)
    spectra = x.with_descriptors(None), y.with_descriptors(None)
    pair_of_meshes = Pair(mesh_x, mesh_y)
    first = initial_map(pair_of_meshes, *paired_spectra(pair_of_meshes, EIGENVECTORS))
    initial_maps = {REFERENCE: first}
    for name, network in networks.items():
        initial_maps[name] = np.asarray(nearest_descriptors(network, x, y))[:m].astype(np.int64)
    maps = {f"{name}{START}": T for name, T in initial_maps.items()}
    maps |= {f"{name}{REFINED}": refined(spectra, T) for name, T in initial_maps.items()}
    return errors(pair, mesh_x, mesh_y, maps, seed)


REFERENCE, START, REFINED = "SHOT", ", start", ", refined"


def summary(measured: Measured, steps: int, seed: int) -> Iterator[str]:
    """Yield the parts of `summary.md`."""
    yield "# Learned descriptors\n"
    yield (
        f"Training takes {steps} steps of Adam for each loss. Each step uses one pair with {SAMPLES} samples "
        "per shape. The numbers are mean geodesic errors x 10⁻³ √area. The initial map takes nearest "
        f"neighbours of descriptors. The preset `paper` (k = {EIGENVECTORS}, {ITERATIONS} iterations) "
        "refines this map. Parentheses contain the mean paired difference from SHOT with its 95 % bootstrap "
        "interval.\n"
    )
    first_pair = next(iter(measured.values()))[0]
    names = [name.removesuffix(START) for name in first_pair if name.endswith(START)]
    for title, suffix in (("initial map", START), ("refined", REFINED)):
        here = {
            f"{data_set}, {title}": [{name: pair[name + suffix] for name in names} for pair in pairs]
            for data_set, pairs in measured.items()
        }
        yield comparison(here, names, seed)


def draw(curves: Mapping[str, Trained], path: Path) -> None:
    """Plot losses against the training steps, for the training pairs and for pairs of other people."""
    figure, axes = plt.subplots(1, len(curves), figsize=(5 * len(curves), 3.4), layout="constrained")
    for axis, (name, curve) in zip(axes, curves.items(), strict=True):
        axis.plot(*smoothed(curve.losses), label="training pairs, running mean")
        axis.plot(curve.steps, curve.watched, "o-", label=f"{WATCHED_PAIRS} pairs of other people")
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
            curves[name] = run.train(
                name,
                loss,
                DescriptorNetwork(key),
                run.data.seen + run.data.seen_further,
                prepared,
                optimizer,
                watched=run.data.unseen[: min(WATCHED_PAIRS, run.test_pairs)],
            )
            path = run.directory / f"descriptors_{name}.eqx"
            save(curves[name].model, path)
            networks[f"learned from {name}"] = load(path)
        measured = run.measure(lambda pair: descriptor_errors(pair, networks, run.seed))
        run.write_summary(summary(measured, run.steps, run.seed))
        draw({f"from {name}": curve for name, curve in curves.items()}, run.directory / "curves.png")


if __name__ == "__main__":
    main()
