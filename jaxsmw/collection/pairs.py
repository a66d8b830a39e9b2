"""Matches any pairs of several shapes, in batches on accelerators."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from jaxsmw.choices import DEFAULT_INITIAL_MAP, DEFAULT_PRESET
from jaxsmw.collection.consistency import check_pairs
from jaxsmw.collection.shapes import fitted_preset, prepare_collection, warned_already
from jaxsmw.errors import check_whole_number
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.executor import run_batches
from jaxsmw.matching.match import match_prepared
from jaxsmw.matching.outcome import Outcome, Start
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset, PresetName, choose_preset
from jaxsmw.matching.starts import make_start
from jaxsmw.runtime.backends import Device, check_devices, chosen_backend
from jaxsmw.runtime.threads import one_blas_thread

# Each device refines this number of pairs before their maps are judged, and others are searched for.
_PAIRS_PER_DEVICE = 64


def match_pairs(
    meshes: Sequence[Mesh | MeshLike],
    pairs: Iterable[tuple[int, int]],
    *,
    preset: PresetName | Preset = DEFAULT_PRESET,
    batch_size: int | None = None,
    devices: Sequence[Device] | None = None,
) -> Iterator[tuple[int, Correspondence]]:
    """Match any pairs of several full shapes.

    Spectra, descriptors and samples are computed once per shape. The descriptors of all shapes have the same
    axes (`DescriptorAxes`), so a map can differ slightly from the map of `match`. On accelerators or several
    devices, pairs are refined in batches. Mirror images are not considered.

    **Arguments:**

    - `meshes`: the meshes of the shapes, each a `Mesh` or a mesh that `make_mesh` accepts. The meshes may
      have different units of length, because each shape is scaled to area 1.
    - `pairs`: a tuple (source X, target Y) for each pair, as 0-based positions in `meshes`.
    - `preset`: `"accurate"` (the default), `"fast"`, `"paper"` or a `Preset`; see `match`.
    - `batch_size`: the number of pairs that each device refines at the same time; see `refine_pairs`.
    - `devices`: the JAX devices. The default is all devices of the default backend.

    **Returns:** An iterator over tuples of the 0-based position of a pair in `pairs`, and its
    `Correspondence`.

    **Raises:** `InputError` if an argument is not as described. The iterator raises `ArithmeticError` if the
    refinement of a pair fails numerically.
    """
    uncut = [as_mesh(mesh, f"mesh {number}") for number, mesh in enumerate(meshes)]
    checked = check_pairs(pairs, len(uncut), "pair")
    check_devices(devices)
    if batch_size is not None:
        check_whole_number("batch_size", batch_size, 1)
    preset = choose_preset(preset)
    shapes, _ = prepare_collection(uncut, preset)

    def results() -> Iterator[tuple[int, Correspondence]]:
        tasks = (prepare_task(shapes[i], shapes[j], given=Pair(uncut[i], uncut[j])) for i, j in checked)
        matched = match_many(tasks, preset, batch_size=batch_size, devices=devices)
        for number, result in enumerate(matched):
            if isinstance(result, ArithmeticError):
                raise result
            yield number, result

    return results()


class Task(NamedTuple):
    """A prepared pair, its initial map, and whether other initial maps are tried if its map is uncertain."""

    prepared: PreparedPair
    start: Start
    hypotheses: bool


def prepare_task(
    x: PreparedShape,
    y: PreparedShape,
    *,
    given: Pair | None = None,
    init: Int64[np.ndarray, " m"] | None = None,
) -> Task:
    """Return the prepared pair of two full shapes, and its initial map.

    **Arguments:**

    - `x`, `y`: the source X (m vertices) and the target Y, with descriptors in common axes.
    - `given`: the pair to whose vertices the result refers. The default is the meshes of the shapes.
    - `init`: the initial map X -> Y (m,), as 0-based vertices of Y; None for `"auto"`, see `match`.
    """
    pair = Pair(x.mesh, y.mesh)
    prepared = PreparedPair.of(pair, x, y, given=given)
    with warned_already(), one_blas_thread():
        start = make_start(prepared, DEFAULT_INITIAL_MAP if init is None else init)
    return Task(prepared, start, init is None)


def match_many(
    tasks: Iterable[Task],
    preset: Preset,
    *,
    batch_size: int | None = None,
    devices: Sequence[Device] | None = None,
) -> Iterator[Correspondence | ArithmeticError]:
    """Match prepared pairs, and yield their results in order, or the error of a failed refinement.

    The stages run in batches, except on one CPU without a batch size. For each pair, the preset is adapted to
    small meshes. The other arguments are those of `match_pairs`.
    """
    batched = batch_size is not None or devices is not None or chosen_backend("auto") == "jax"

    def fitted() -> Iterator[tuple[Preset, Task]]:
        for task in tasks:
            own = fitted_preset(preset, *task.prepared.pair.meshes)
            yield task.prepared.usable(own), task

    if not batched:
        for own, task in fitted():
            yield _matched(task, own)
        return
    if devices is None:
        import jax

        devices = jax.devices()
    # All pairs of a batch run the same stages.
    for own, group in itertools.groupby(fitted(), key=lambda fitted: fitted[0]):
        while waiting := [task for _, task in itertools.islice(group, _PAIRS_PER_DEVICE * len(devices))]:
            flat = [(task.prepared.spectra, task.start) for task in waiting]
            outcomes = run_batches(own.before_final, flat, batch_size=batch_size, devices=devices)
            for task, outcome in zip(waiting, outcomes, strict=True):
                yield _matched(task, own, outcome)


def _matched(task: Task, preset: Preset, outcome: Outcome | None = None) -> Correspondence | ArithmeticError:
    prepared, start, hypotheses = task
    try:
        with one_blas_thread():
            return match_prepared(prepared, start, preset, hypotheses=hypotheses, outcome=outcome)
    except ArithmeticError as error:
        return error
