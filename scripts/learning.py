"""What the scripts that learn share: the data, training that goes on where it was, the comparison."""

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
from jaxsmw.evaluation.datasets import DataPair, open_data_set
from jaxsmw.evaluation.intervals import mean_interval
from jaxsmw.evaluation.journal import Journal, claimed_directory
from jaxsmw.report.tables import markdown
from jaxsmw.runtime.files import atomic_write, make_directory
from jaxsmw.runtime.provenance import code_digest, commit, machine, made_with, measured_code, versions

EIGENVECTORS, ITERATIONS = 100, 3
TRAINING_PEOPLE, POSES = 5, 10
EVALUATED_POINTS = 500
# Steps between saves, and between looks at pairs that are not trained on.
_SAVED_EVERY, _WATCHED_EVERY = 10, 20
# Shapes of nearly as many vertices are padded to the same number, so that one compiled program serves them.
_SIZES = 512

Model = TypeVar("Model", bound=eqx.Module)
Prepared = TypeVar("Prepared")


class Data(NamedTuple):
    """Pairs to learn from, and pairs to be measured on."""

    seen: list[DataPair]
    seen_further: list[DataPair]
    unseen: list[DataPair]
    animals: list[DataPair]


def person(shape: str) -> int:
    """Whose shape it is: FAUST numbers ten poses of one person after those of another."""
    return int(shape.rsplit("_", 1)[1]) // POSES


def open_data(directory: Path) -> Data:
    """FAUST's people, those who are trained on and the others, and TOSCA.

    `seen_further` are pairs of the same people that are not among those to be matched; their truth is known.

    **Raises:** `InputError` if a set is missing, or has none of the people.
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
            f"{faust.directory}: has no pairs of the first {TRAINING_PEOPLE} people, or of the others: "
            "complete the copy."
        )
    return data


def places(mesh: Mesh) -> Float64[np.ndarray, "n 3"]:
    """Vertices in units of the square root of the area."""
    return mesh.vertices / mesh.area**0.5


def root_mean_square(
    carried: Callable[[Float[Array, "s p"]], Float[Array, "s p"]],
    positions: Float[Array, "s 3"],
    wanted: Float[Array, "s 3"],
) -> Float[Array, ""]:
    """How far from where they should be points are carried: over a soft map, then the mean of all."""
    found = carried(jnp.concatenate([positions, jnp.sum(positions**2, axis=1, keepdims=True)], axis=1))
    squares = found[:, 3] - 2 * jnp.sum(found[:, :3] * wanted, axis=1) + jnp.sum(wanted**2, axis=1)
    return jnp.mean(jnp.sqrt(jnp.maximum(squares, 0) + 1e-6))


class State(eqx.Module):
    """What training goes on from."""

    model: eqx.Module
    optimizer: optax.OptState
    step: Int[Array, ""]
    losses: Float[Array, " steps"]
    watched: Float[Array, " looks"]


class Trained(NamedTuple):
    """The model, the loss of every step, and at some `steps` that of pairs which are not trained on."""

    model: Any
    losses: Float[np.ndarray, " steps"]
    steps: Int[np.ndarray, " looks"]
    watched: Float[np.ndarray, " looks"]


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
    """The model after so many steps, each by another pair, drawn with a seed.

    Saved on the way as `training_NAME.eqx`, from which it goes on if it is there.

    **Arguments:**

    - `prepare`: what the loss wants to know of a pair.
    - `unit`: what losses are noted in units of, as pairs differ more than models do; nothing by default.
    - `watched`: pairs whose mean loss is noted now and then, and serves nothing else.

    **Raises:** `InputError` if what was saved is damaged or of other settings; `ArithmeticError` if a loss is
    not finite.
    """

    looks = np.append(np.arange(0, steps, _WATCHED_EVERY), steps) if watched else np.zeros(0, int)
    dtype = jnp.result_type(float)
    state = State(
        model,
        optimizer.init(eqx.filter(model, eqx.is_inexact_array)),
        jnp.asarray(0, jnp.int32),
        jnp.zeros(steps, dtype),
        jnp.zeros(len(looks), dtype),
    )
    saved = directory / f"training_{name}.eqx"
    if saved.exists():
        with reading(saved) as stream:
            state = eqx.tree_deserialise_leaves(stream, state)

    def watch(state: State) -> State:
        """The loss of pairs not trained on, if this is a step at which it is noted."""
        here = np.flatnonzero(looks == int(state.step))
        if not len(here):
            return state
        mean = np.mean([float(_look(loss, state.model, prepare(pair))) for pair in watched])
        return eqx.tree_at(lambda s: s.watched, state, state.watched.at[here[0]].set(mean))

    order = np.random.default_rng(seed).integers(0, len(pairs), steps)
    begun = int(state.step)
    progress = tqdm(
        range(begun, steps),
        desc=f"learning {name}",
        unit="step",
        initial=begun,
        total=steps,
        disable=begun == steps,
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
    return Trained(state.model, np.asarray(state.losses), looks, np.asarray(state.watched))


# Out here, so that they are compiled once for the same loss and optimiser.
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
def _look(
    loss: Callable[[Model, Prepared], Float[Array, ""]], model: Model, pair: Prepared
) -> Float[Array, ""]:
    return loss(model, pair)


@contextmanager
def reading(path: Path) -> Iterator[BinaryIO]:
    """A file of leaves that equinox wrote, to be read to its end.

    **Raises:** `InputError` if that does not work.
    """
    try:
        with open(path, "rb") as stream:
            yield stream
            if stream.read(1):
                raise ValueError("there is more in it")
    except Exception as error:  # NumPy's and equinox's readers raise all kinds
        raise InputError(
            f"{path}: is damaged, or holds something else than was saved here: remove it, or give another."
        ) from error


def padded(spectrum: Spectrum) -> Spectrum:
    """The shape with masked vertices up to one of few sizes."""
    return spectrum.pad(-(-spectrum.mask.shape[0] // _SIZES) * _SIZES)


def refined(
    spectra: tuple[Spectrum, Spectrum],
    start: Int[Array | np.ndarray, " m"],
    refiner: WaveletPreservation = WaveletPreservation(),  # noqa: B008 (immutable)
) -> Int[np.ndarray, " m"]:
    """What the paper's number of iterations makes of a start."""
    m = len(start)
    x, y = map(padded, spectra)
    start = jnp.asarray(np.pad(np.asarray(start), (0, x.mask.shape[0] - m)), jnp.int32)
    found = refine(x, y, start, refiner=refiner, iterations=ITERATIONS)
    return np.asarray(found.pointwise_map)[:m].astype(np.int64)


def errors(
    pair: DataPair, mesh_x: Mesh, mesh_y: Mesh, maps: Mapping[str, Int[np.ndarray, " m"]], seed: int
) -> dict[str, float]:
    """Mean geodesic errors x 10³ of maps, all at the same points of the truth."""
    truth = pair.ground_truth(mesh_x, mesh_y)
    options: dict[str, Any] = {"number_of_samples": EVALUATED_POINTS, "seed": seed}
    return {name: 1e3 * geodesic_error(mesh_y, found, truth, **options).mean for name, found in maps.items()}


Measured = dict[str, list[dict[str, float]]]
"""For each data set, for each pair, figures by name."""


def measure(
    data: Data,
    of_pair: Callable[[DataPair], dict[str, float]],
    *,
    number_of_pairs: int,
    seed: int,
    directory: Path,
) -> Measured:
    """Figures of some unseen people's pairs and of TOSCA's, kept in `errors.csv` as they come.

    The first pairs of a larger number are those of a smaller.
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
    """A table of means, with differences from the first name pair by pair and their intervals."""
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
    """Steps, and running means over a tenth of them, to be drawn."""
    window = max(1, len(values) // 10)
    means = np.convolve(values, np.ones(window) / window, "valid")
    return np.arange(len(means)) + window / 2, means


def parser(description: str, *, output: str, steps: int) -> argparse.ArgumentParser:
    """The arguments of a script that learns."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("data", type=Path, help="the directory with faust_r and tosca_r")
    made.add_argument("--output", type=Path, default=Path(output), help=f"default: {output}")
    made.add_argument("--steps", type=int, default=steps, help=f"of training (default: {steps})")
    made.add_argument("--test-pairs", type=int, default=40, help="of each data set (default: 40)")
    made.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    made.add_argument("--quick", action="store_true", help="3 steps, 2 pairs: to see that it works")
    return made


class Run(NamedTuple):
    """What was asked for, where it goes, and what began it, in one line."""

    data: Data
    directory: Path
    steps: int
    test_pairs: int
    seed: int
    begun_with: str


@contextmanager
def running(arguments: argparse.ArgumentParser, settings: Mapping[str, Any]) -> Iterator[Run]:
    """Read the arguments, open the data, and keep other processes and other settings out of the output.

    `provenance.json` there says what results come from; see `jaxsmw.evaluation.journal.claimed_directory`.
    Leaves by the parser's error, with one sentence, on bad input, and with another if interrupted.
    """
    options = arguments.parse_args()
    steps, test_pairs = (3, 2) if options.quick else (options.steps, options.test_pairs)
    if steps < 1 or test_pairs < 1 or options.seed < 0:
        arguments.error("--steps and --test-pairs must be at least 1, --seed at least 0")
    warnings.simplefilter("ignore")  # about meshes, of which each would tell
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
        sys.exit(f"\ninterrupted; the same command goes on from what {options.output} holds")


def _public(options: argparse.Namespace) -> list[str]:
    """The arguments that make a difference, without where things lie on this machine."""
    numbers = [("--steps", options.steps), ("--test-pairs", options.test_pairs), ("--seed", options.seed)]
    given = ["--quick"] if options.quick else [str(part) for pair in numbers[:2] for part in pair]
    return ["DATA_DIRECTORY", *given, *map(str, numbers[2])]
