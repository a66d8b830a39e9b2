"""Matches any pairs of several shapes, in batches on accelerators."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

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
from jaxsmw.matching.starts import make_starts
from jaxsmw.runtime.backends import Device, check_devices, chosen_backend
from jaxsmw.runtime.threads import one_blas_thread

# Each device refines this number of pairs before their maps are judged and repaired.
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
    - `preset`: `"accurate"` (the default), `"fast"`, `"paper"` or a `Preset`; see `match`. Without
      alternative maps (`Preset.without_alternatives`), suspicious maps take less time.
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


Task = tuple[PreparedPair, list[Start]]
"""A prepared pair and the starts from which it is matched."""


def prepare_task(
    x: PreparedShape,
    y: PreparedShape,
    *,
    given: Pair | None = None,
    init: Int64[np.ndarray, " m"] | None = None,
    aligned: bool = False,
) -> Task:
    """Return the prepared pair of two full shapes, and its starts.

    **Arguments:**

    - `x`, `y`: the source X (m vertices) and the target Y, with descriptors in common axes.
    - `given`: the pair to whose vertices the result refers. The default is the meshes of the shapes.
    - `init`: the initial map X -> Y (m,), as 0-based vertices of Y; None for `"shot"`.
    - `aligned`: whether a pair without an initial map also starts from `"aligned"`.
    """
    pair = Pair(x.mesh, y.mesh)
    prepared = PreparedPair.of(pair, x, y, given=given)
    with warned_already(), one_blas_thread():
        starts = make_starts(
            prepared, DEFAULT_INITIAL_MAP if init is None else init, rigid=aligned and init is None
        )
    return prepared, starts


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

    def fitted() -> Iterator[tuple[Preset, PreparedPair, list[Start]]]:
        for prepared, starts in tasks:
            own = fitted_preset(preset, *prepared.pair.meshes)
            yield prepared.usable(own), prepared, starts

    if not batched:
        for own, prepared, starts in fitted():
            yield _matched(prepared, starts, own)
        return
    if devices is None:
        import jax

        devices = jax.devices()
    # All pairs of a batch run the same stages.
    for own, group in itertools.groupby(fitted(), key=lambda task: task[0]):
        while waiting := list(itertools.islice(group, _PAIRS_PER_DEVICE * len(devices))):
            flat = [(pair.spectra, start) for _, pair, starts in waiting for start in starts]
            outcomes = iter(run_batches(own.before_final, flat, batch_size=batch_size, devices=devices))
            for _, prepared, starts in waiting:
                of_pair = list(itertools.islice(outcomes, len(starts)))
                yield _matched(prepared, starts, own, of_pair)


def _matched(
    prepared: PreparedPair,
    starts: Sequence[Start],
    preset: Preset,
    outcomes: Sequence[Outcome] = (),
) -> Correspondence | ArithmeticError:
    try:
        with one_blas_thread():
            return match_prepared(prepared, starts, preset, outcomes=outcomes)
    except ArithmeticError as error:
        return error
