"""Common code of the training scripts: the data, training that can be resumed, and the comparison."""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Float64, Int
from tqdm import tqdm

from jaxsmw import InputError, Mesh, Spectrum, WaveletPreservation, geodesic_error, refine
from jaxsmw.benchmark.datasets import DataPair, open_data_set
from jaxsmw.benchmark.intervals import mean_interval
from jaxsmw.benchmark.journal import Journal
from jaxsmw.benchmark.tables import markdown
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
    """The pairs for training and for evaluation.

    **Attributes:**

    - `seen`: the pairs of the first `TRAINING_PEOPLE` people in FAUST's pair list, for training.
    - `seen_further`: further pairs of the same people. These pairs have ground truth, but are not in the pair
      list.
    - `unseen`: the pairs of the other people in FAUST's pair list, for evaluation.
    - `animals`: the pairs of TOSCA, for evaluation.
    """

    seen: list[DataPair]
    seen_further: list[DataPair]
    unseen: list[DataPair]
    animals: list[DataPair]


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
    carried: Callable[[Float[Array, "s p"]], Float[Array, "s p"]],
    positions: Float[Array, "s 3"],
    wanted: Float[Array, "s 3"],
) -> Float[Array, ""]:
    """Return the mean distance between the soft match of each point and its target position.

    A soft match is a set of points with weights, which are the shares of the soft map. The distance from
    a soft match is the weighted root mean square of the distances from the points.

    **Arguments:**

    - `carried`: a function that pulls functions back by one soft map, or by several soft maps in succession.
    - `positions`: the vertex positions of the shape on which these functions are defined.
    - `wanted`: the target position of each point.
    """
    found = carried(jnp.concatenate([positions, jnp.sum(positions**2, axis=1, keepdims=True)], axis=1))
    squares = found[:, 3] - 2 * jnp.sum(found[:, :3] * wanted, axis=1) + jnp.sum(wanted**2, axis=1)
    return jnp.mean(jnp.sqrt(jnp.maximum(squares, 0) + 1e-6))


class State(eqx.Module):
    """The state of a training run, as `train` saves it."""

    model: eqx.Module
    optimizer: optax.OptState
    step: Int[Array, ""]
    losses: Float[Array, " steps"]
    watched: Float[Array, " records"]


class Trained(NamedTuple):
    """The outcome of training.

    **Attributes:**

    - `model`: the trained model.
    - `losses`: the loss of every step.
    - `steps`: the step numbers at which the loss on the watched pairs was evaluated. Step 0 is the start of
      training.
    - `watched`: the mean loss on the watched pairs at each step number in `steps`.
    """

    model: Any
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
) -> Trained:
    """Train a model. Each step uses one pair, which is drawn at random.

    The state is saved regularly as `training_NAME.eqx` in `directory`. If that file exists, training
    continues from it.

    **Arguments:**

    - `name`: the name of the loss, which appears in the name of the file and in the progress bar.
    - `loss`: a function that takes the model and a prepared pair, and returns the loss.
    - `model`: the initial model.
    - `pairs`: the training pairs.
    - `prepare`: a function that prepares a pair for the loss.
    - `optimizer`: the optax optimiser.
    - `steps`: the number of training steps.
    - `seed`: the seed of the random draws.
    - `directory`: an existing directory for the saved state.
    - `unit`: a function that takes a prepared pair, and returns a number. The recorded loss of the pair is
      divided by this number, so losses of different pairs are comparable. If `unit` is None, `train` records
      the losses undivided.
    - `watched`: pairs whose mean loss is recorded at regular intervals. These pairs do not influence
      training.

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

    def watch(state: State) -> State:
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
    state: State,
    pair: Prepared,
    loss: Callable[[Model, Prepared], Float[Array, ""]],
    optimizer: optax.GradientTransformation,
    unit: Callable[[Prepared], Float[Array, ""]] | None,
) -> State:
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
    """Open a file that equinox wrote, and yield it to a `with` block.

    The block must read the whole file.

    **Raises:** `InputError` if the file cannot be opened, if the block raises an error, or if the block ends
    before the end of the file is reached.
    """
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
    found = refine(x, y, initial, refiner=refiner, iterations=ITERATIONS)
    return np.asarray(found.pointwise_map)[:m].astype(np.int64)


def errors(
    pair: DataPair, mesh_x: Mesh, mesh_y: Mesh, maps: Mapping[str, Int[np.ndarray, " m"]], seed: int
) -> dict[str, float]:
    """Return the mean geodesic error x 10³ of each map. All maps are evaluated at the same points."""
    truth = pair.ground_truth(mesh_x, mesh_y)
    options: dict[str, Any] = {"number_of_samples": EVALUATED_POINTS, "seed": seed}
    return {name: 1e3 * geodesic_error(mesh_y, found, truth, **options).mean for name, found in maps.items()}


Measured = dict[str, list[dict[str, float]]]
"""A dictionary from each data set to a list.

For each pair, the list contains a dictionary from map names to errors.
"""


def measure(
    data: Data,
    of_pair: Callable[[DataPair], dict[str, float]],
    *,
    number_of_pairs: int,
    seed: int,
    directory: Path,
) -> Measured:
    """Measure the errors of random test pairs of FAUST and TOSCA.

    The errors of each pair are appended to `errors.csv` as soon as the pair is measured. Pairs that the file
    already contains are not measured again. If the seed stays the same, the pairs for a smaller
    `number_of_pairs` are a subset of the pairs for a larger number.

    **Arguments:**

    - `data`: the pairs for training and for evaluation.
    - `of_pair`: a function that takes a pair, and returns a dictionary from map names to errors.
    - `number_of_pairs`: the maximum number of pairs from each data set.
    - `seed`: the seed of the random draws.
    - `directory`: the directory of `errors.csv`.
    """
    generator, journal = np.random.default_rng(seed), Journal(directory / "errors.csv", ["source", "target"])
    measured: Measured = {}
    for title, pairs in (("people not seen", data.unseen), ("TOSCA", data.animals)):
        chosen = [pairs[i] for i in np.sort(generator.permutation(len(pairs))[:number_of_pairs])]
        for pair in tqdm(chosen, desc=title, unit="pair"):
            if pair.names not in journal:
                names = {"source": pair.source, "target": pair.target}
                journal.append([{"data": title, **names, **of_pair(pair)}])
        labels = "data", "source", "target"
        measured[title] = [
            {name: float(value) for name, value in journal[pair.names].items() if name not in labels}
            for pair in chosen
        ]
    return measured


def comparison(measured: Measured, names: Sequence[str], seed: int) -> str:
    """Return a Markdown table of the mean errors of the maps `names`.

    For every map except the first, the table also contains the mean difference from the error of the first
    map, with a confidence interval.
    """
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
    made = argparse.ArgumentParser(description=description)
    made.add_argument("data", type=Path, help="directory that contains faust_r and tosca_r")
    made.add_argument(
        "--output", type=Path, default=Path(output), help=f"output directory (default: {output})"
    )
    made.add_argument("--steps", type=int, default=steps, help=f"number of training steps (default: {steps})")
    made.add_argument(
        "--test-pairs", type=int, default=40, help="number of test pairs from each data set (default: 40)"
    )
    made.add_argument("--seed", type=int, default=0, help="seed of the random draws (default: 0)")
    made.add_argument(
        "--quick", action="store_true", help="run 3 steps and 2 test pairs, to check that the script works"
    )
    return made


class Run(NamedTuple):
    """The settings of a run.

    **Attributes:**

    - `data`: the pairs for training and for evaluation.
    - `directory`: the output directory.
    - `steps`, `test_pairs`, `seed`: see the command-line options.
    - `begun_with`: a line of text that states commit, machine and versions at the start of the run.
    """

    data: Data
    directory: Path
    steps: int
    test_pairs: int
    seed: int
    begun_with: str


@contextmanager
def running(arguments: argparse.ArgumentParser, settings: Mapping[str, Any]) -> Iterator[Run]:
    """Read the arguments, open the data, and reserve the output directory for this process.

    `jaxsmw.runtime.provenance.claimed_directory` writes the provenance of the results to `provenance.json` in
    the output directory. After bad input or an interruption, the process prints one sentence and ends.

    **Arguments:**

    - `arguments`: the parser that the function `parser` returned.
    - `settings`: further settings that all results in the output directory must share.
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
    given = ["--quick"] if options.quick else [str(part) for pair in numbers[:2] for part in pair]
    return ["DATA_DIRECTORY", *given, *map(str, numbers[2])]
