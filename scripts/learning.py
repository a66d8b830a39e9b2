"""Common code of the training scripts: the data, training that can be resumed, and the comparison."""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from common import make_parser, write_text
from jaxtyping import Array, Float, Float64, Int
from tqdm import tqdm

from jaxsmw import InputError, Mesh, Spectrum, WaveletPreservation, geodesic_error, refine
from jaxsmw.benchmark.datasets import DataPair, open_data_set
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.benchmark.tables import markdown
from jaxsmw.core.soft_maps import SoftMap, SparseSoftMap
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.runtime.provenance import (
    claimed_directory,
    code_digest,
    commit,
    machine,
    made_with,
    measured_code,
    versions,
)

EIGENVECTORS, ITERATIONS = 100, 3
TRAINING_PEOPLE, POSES = 5, 10
EVALUATED_POINTS = 500
# The state is saved after every `_SAVED_EVERY` steps. The loss on the watched pairs is evaluated after every
# `_WATCHED_EVERY` steps.
_SAVED_EVERY, _WATCHED_EVERY = 10, 20
# Shapes are padded to a multiple of this number of vertices, so that shapes of similar size share one
# compiled program.
_SIZES = 512

Model = TypeVar("Model", bound=eqx.Module)
Prepared = TypeVar("Prepared")


class Data(NamedTuple):
    """The pairs for training and for evaluation."""

    seen: list[DataPair]  # of the first `TRAINING_PEOPLE` people in FAUST's list of pairs
    seen_further: list[DataPair]  # further pairs of the same people
    unseen: list[DataPair]  # of the other people in FAUST's list of pairs
    animals: list[DataPair]  # of TOSCA


def person(shape: str) -> int:
    """Return the number of a shape's person. FAUST numbers the ten poses of each person consecutively."""
    return int(shape.rsplit("_", 1)[1]) // POSES


def open_data(directory: Path) -> Data:
    """Open FAUST and TOSCA, and divide the pairs of FAUST by person.

    **Raises:** `InputError` if a data set is missing, or if FAUST has no pairs for training or no pairs for
    evaluation.
    """
    faust, tosca = (open_data_set(directory / name) for name in ("faust_r", "tosca_r"))

    def of(pairs: Iterable[DataPair], *, trained_on: bool) -> list[DataPair]:
        return [p for p in pairs if all((person(name) < TRAINING_PEOPLE) == trained_on for name in p.names)]

    data = Data(
        of(faust.pairs, trained_on=True),
        of(faust.others, trained_on=True),
        of(faust.pairs, trained_on=False),
        list(tosca.pairs),
    )
    if not data.seen or not data.unseen:
        raise InputError(
            f"{faust.directory}: has no pairs among the first {TRAINING_PEOPLE} people, or no pairs among "
            "the other people: complete this copy of the data set."
        )
    return data


def unit_area_positions(mesh: Mesh) -> Float64[np.ndarray, "n 3"]:
    """Return the vertex positions in units of the square root of the surface area."""
    return mesh.vertices / mesh.area**0.5


def root_mean_square(
    carried: Callable[[Float[Array, "s p"]], Float[Array | np.ndarray, "s p"]],
    positions: Float[Array, "s 3"],
    wanted: Float[Array, "s 3"],
) -> Float[Array, ""]:
    """Return the mean distance between the soft match of each point and its target position.

    A soft match is a set of weighted points; the distance from it is the weighted root mean square of the
    distances from the points. The function `carried` pulls functions on a shape with these positions back by
    one or several soft maps.
    """
    pulled = carried(jnp.concatenate([positions, jnp.sum(positions**2, axis=1, keepdims=True)], axis=1))
    squares = pulled[:, 3] - 2 * jnp.sum(pulled[:, :3] * wanted, axis=1) + jnp.sum(wanted**2, axis=1)
    return jnp.mean(jnp.sqrt(jnp.maximum(squares, 0) + 1e-6))


def round_trip(
    forward: SoftMap | SparseSoftMap, backward: SoftMap | SparseSoftMap, positions: Float[Array, "m 3"]
) -> Float[Array, ""]:
    """Return the `root_mean_square` distance of points of X from their images on a round trip via Y."""
    return root_mean_square(
        lambda functions: forward.pull_back(backward.pull_back(functions)), positions, positions
    )


class State(eqx.Module, Generic[Model]):
    """The state of a training run, as `train` saves it."""

    model: Model
    optimizer: optax.OptState
    step: Int[Array, ""]
    losses: Float[Array, " steps"]
    watched: Float[Array, " records"]


class Trained(NamedTuple, Generic[Model]):
    """The trained model, the loss of every step, and the mean loss on watched pairs at some `steps`."""

    model: Model
    losses: Float[np.ndarray, " steps"]
    steps: Int[np.ndarray, " records"]
    watched: Float[np.ndarray, " records"]


def train(
    name: str,
    loss: Callable[[Model, Prepared], Float[Array, ""]],
    model: Model,
    pairs: Sequence[DataPair],
    prepare: Callable[[DataPair], Prepared],
    optimizer: optax.GradientTransformation,
    *,
    steps: int,
    seed: int,
    directory: Path,
    unit: Callable[[Prepared], Float[Array, ""]] | None = None,
    watched: Sequence[DataPair] = (),
) -> Trained[Model]:
    """Train a model. Each step uses one pair, which is drawn at random.

    The state is saved regularly as `training_NAME.eqx` in `directory`. If that file exists, training
    continues from it. The recorded loss of each prepared pair is divided by its `unit`, so that losses of
    different pairs are comparable. The mean loss on `watched` pairs, which do not influence training, is
    recorded at regular intervals.

    **Raises:** `InputError` if the saved state is damaged or has other settings; `ArithmeticError` if a loss
    is not finite.
    """
    records = np.append(np.arange(0, steps, _WATCHED_EVERY), steps) if watched else np.zeros(0, int)
    dtype = jnp.result_type(float)
    state = State(
        model,
        optimizer.init(eqx.filter(model, eqx.is_inexact_array)),
        jnp.asarray(0, jnp.int32),
        jnp.zeros(steps, dtype),
        jnp.zeros(len(records), dtype),
    )
    saved = directory / f"training_{name}.eqx"
    if saved.exists():
        with reading(saved) as stream:
            state = eqx.tree_deserialise_leaves(stream, state)

    def watch(state: State[Model]) -> State[Model]:
        """Record the mean loss on the watched pairs if a record is due at the current step."""
        here = np.flatnonzero(records == int(state.step))
        if not len(here):
            return state
        mean = np.mean([float(_evaluate(loss, state.model, prepare(pair))) for pair in watched])
        return eqx.tree_at(lambda s: s.watched, state, state.watched.at[here[0]].set(mean))

    order = np.random.default_rng(seed).integers(0, len(pairs), steps)
    first_step = int(state.step)
    progress = tqdm(
        range(first_step, steps),
        desc=f"learning {name}",
        unit="step",
        initial=first_step,
        total=steps,
        disable=first_step == steps,
    )
    for step in progress:
        pair = pairs[order[step]]
        state = _improve(watch(state), prepare(pair), loss, optimizer, unit)
        value = float(state.losses[step])
        if not np.isfinite(value):
            raise ArithmeticError(f"the loss became {value} at step {step} ({pair.name})")
        progress.set_postfix(loss=f"{value:.3g}", refresh=False)
        if (step + 1) % _SAVED_EVERY == 0 or step + 1 == steps:
            if step + 1 == steps:
                state = watch(state)
            with atomic_write(saved) as temporary, open(temporary, "wb") as stream:
                eqx.tree_serialise_leaves(stream, state)
    return Trained(state.model, np.asarray(state.losses), records, np.asarray(state.watched))


# The next two functions are at module level, so JAX compiles them only once for each loss and optimiser.
@eqx.filter_jit
def _improve(
    state: State[Model],
    pair: Prepared,
    loss: Callable[[Model, Prepared], Float[Array, ""]],
    optimizer: optax.GradientTransformation,
    unit: Callable[[Prepared], Float[Array, ""]] | None,
) -> State[Model]:
    value, gradient = eqx.filter_value_and_grad(loss)(state.model, pair)
    change, following = optimizer.update(gradient, state.optimizer)
    losses = state.losses.at[state.step].set(value / (1 if unit is None else unit(pair)))
    return State(eqx.apply_updates(state.model, change), following, state.step + 1, losses, state.watched)


@eqx.filter_jit
def _evaluate(
    loss: Callable[[Model, Prepared], Float[Array, ""]], model: Model, pair: Prepared
) -> Float[Array, ""]:
    return loss(model, pair)


@contextmanager
def reading(path: Path) -> Iterator[BinaryIO]:
    """Open a file that equinox wrote for a `with` block; `InputError` if the block cannot read all of it."""
    try:
        with open(path, "rb") as stream:
            yield stream
            if stream.read(1):
                raise ValueError("the file has trailing data")
    except Exception as error:  # NumPy and equinox raise errors of many types for damaged files
        raise InputError(
            f"{path}: is damaged, or was written by other code or with other settings: remove it, or give "
            "another file."
        ) from error


def padded(spectrum: Spectrum) -> Spectrum:
    """Pad a spectrum with masked vertices up to the next multiple of `_SIZES`."""
    return spectrum.pad(-(-spectrum.mask.shape[0] // _SIZES) * _SIZES)


def refined(
    spectra: tuple[Spectrum, Spectrum],
    initial: Int[Array | np.ndarray, " m"],
    refiner: WaveletPreservation = WaveletPreservation(),  # noqa: B008 (immutable)
) -> Int[np.ndarray, " m"]:
    """Refine an initial map with `ITERATIONS` iterations, and return the pointwise map."""
    m = len(initial)
    x, y = map(padded, spectra)
    initial = jnp.asarray(np.pad(np.asarray(initial), (0, x.mask.shape[0] - m)), jnp.int32)
    refinement = refine(x, y, initial, refiner=refiner, iterations=ITERATIONS)
    return np.asarray(refinement.pointwise_map)[:m].astype(np.int64)


def errors(
    pair: DataPair, mesh_x: Mesh, mesh_y: Mesh, maps: Mapping[str, Int[np.ndarray, " m"]], seed: int
) -> dict[str, float]:
    """Return the mean geodesic error x 10³ of each map. All maps are evaluated at the same points."""
    truth = pair.ground_truth(mesh_x, mesh_y)
    options: dict[str, Any] = {"number_of_samples": EVALUATED_POINTS, "seed": seed}
    return {name: 1e3 * geodesic_error(mesh_y, T, truth, **options).mean for name, T in maps.items()}


Measured = dict[str, list[dict[str, float]]]
"""For each data set, the errors of each pair by the names of the maps."""


def comparison(measured: Measured, names: Sequence[str], seed: int) -> str:
    """Return a Markdown table of the mean errors of maps, and of their mean differences from the first."""
    rows = [["", "pairs", *names]]
    for data_set, pairs in measured.items():
        values = {name: np.array([pair[name] for pair in pairs]) for name in names}
        first = values[names[0]]
        cells = [f"{first.mean():.1f}"]
        for name in names[1:]:
            cells.append(f"{values[name].mean():.1f} ({mean_interval(values[name] - first, seed)})")
        rows.append([data_set, str(len(pairs)), *cells])
    return markdown(rows)


def smoothed(values: Float[np.ndarray, " steps"]) -> tuple[np.ndarray, np.ndarray]:
    """Return step numbers and running means of a curve. The running window covers 10 % of the values."""
    window = max(1, len(values) // 10)
    means = np.convolve(values, np.ones(window) / window, "valid")
    return np.arange(len(means)) + window / 2, means


def parser(description: str, *, output: str, steps: int) -> argparse.ArgumentParser:
    """Return the parser for the arguments of a training script."""
    made = make_parser(description, output=output, seed=True)
    made.add_argument("data", type=Path, help="directory that contains faust_r and tosca_r")
    made.add_argument("--steps", type=int, default=steps, help=f"number of training steps (default: {steps})")
    made.add_argument(
        "--test-pairs", type=int, default=40, help="number of test pairs from each data set (default: 40)"
    )
    made.add_argument(
        "--quick", action="store_true", help="run 3 steps and 2 test pairs, to check that the script works"
    )
    return made


class Run(NamedTuple):
    """The data and options of a run, and a line with commit, machine and versions at its start."""

    data: Data
    directory: Path
    steps: int
    test_pairs: int
    seed: int
    begun_with: str

    def train(self, *arguments: Any, **options: Any) -> Trained:
        """Train a model as `train` does, with the options of this run."""
        return train(*arguments, steps=self.steps, seed=self.seed, directory=self.directory, **options)

    def measure(self, of_pair: Callable[[DataPair], dict[str, float]]) -> Measured:
        """Measure the errors of random test pairs of FAUST and TOSCA, by the names of the maps.

        The errors of each pair are appended to `errors.csv` as soon as the pair is measured. Pairs that the
        file already contains are not measured again. A smaller number of pairs gives a subset of the pairs of
        a larger number.
        """
        generator = np.random.default_rng(self.seed)
        journal = Journal(self.directory / "errors.csv", ["source", "target"])
        measured: Measured = {}
        for title, pairs in (("people not seen", self.data.unseen), ("TOSCA", self.data.animals)):
            drawn = [pairs[i] for i in np.sort(generator.permutation(len(pairs))[: self.test_pairs])]
            for pair in tqdm(drawn, desc=title, unit="pair"):
                if pair.names not in journal:
                    names = {"source": pair.source, "target": pair.target}
                    journal.append([{"data": title, **names, **of_pair(pair)}])
            labels = "data", "source", "target"
            measured[title] = [
                {name: float(value) for name, value in journal[pair.names].items() if name not in labels}
                for pair in drawn
            ]
        return measured

    def write_summary(self, parts: Iterable[str]) -> None:
        """Write and print `summary.md`."""
        page = "\n".join([*parts, self.begun_with + "\n"])
        write_text(self.directory / "summary.md", page)
        print(page)


@contextmanager
def running(arguments: argparse.ArgumentParser, settings: Mapping[str, Any]) -> Iterator[Run]:
    """Read the arguments, open the data, and claim the output directory for results with these settings.

    After bad input or an interruption, the process prints one sentence and ends.
    """
    options = arguments.parse_args()
    steps, test_pairs = (3, 2) if options.quick else (options.steps, options.test_pairs)
    if steps < 1 or test_pairs < 1 or options.seed < 0:
        arguments.error("--steps and --test-pairs must be at least 1, and --seed at least 0")
    warnings.simplefilter("ignore")  # hides warnings about the quality of each mesh
    script = Path(sys.argv[0])
    try:
        data, directory = open_data(options.data), make_directory(options.output)
        asked = {"steps": steps, "seed": options.seed, **settings}
        code = code_digest([*measured_code(), Path(__file__), script])
        origin = {"settings": asked, "versions": versions() | {"code": code}}
        command = shlex.join(["python", f"scripts/{script.name}", *_public(options)])
        noted = {"commit": commit(), "machine": machine(), "command": command}
        with claimed_directory(directory, origin, noted):
            yield Run(data, directory, steps, test_pairs, options.seed, made_with())
    except InputError as error:
        arguments.error(str(error))
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted; the same command continues from the results in {options.output}")


def _public(options: argparse.Namespace) -> list[str]:
    """Return the options that affect the results, without the paths on this machine."""
    numbers = [("--steps", options.steps), ("--test-pairs", options.test_pairs), ("--seed", options.seed)]
    counts = ["--quick"] if options.quick else [str(part) for pair in numbers[:2] for part in pair]
    return ["DATA_DIRECTORY", *counts, *map(str, numbers[2])]
