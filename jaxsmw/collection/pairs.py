"""The function `match_pairs`, which matches any pairs of several shapes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import jax

from jaxsmw.choices import DEFAULT_PRESET
from jaxsmw.collection.consistency import check_pairs
from jaxsmw.collection.shapes import fitted_preset, prepare_pair, prepare_shapes
from jaxsmw.errors import check_whole_number
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh
from jaxsmw.matching.batches import refine_batch
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.judge import Outcome
from jaxsmw.matching.match import match_prepared
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.presets import Preset, PresetName, choose_preset
from jaxsmw.runtime.batches import check_devices
from jaxsmw.runtime.compilation import release_programs

# Each device refines this number of pairs before their maps are judged and repaired.
_PAIRS_PER_DEVICE = 64


def match_pairs(
    meshes: Sequence[Mesh | MeshLike],
    pairs: Iterable[tuple[int, int]],
    *,
    preset: PresetName | Preset = DEFAULT_PRESET,
    alternatives: bool = True,
    batch_size: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[tuple[int, Correspondence]]:
    """Match any pairs of several full shapes.

    Spectra, descriptors and samples are computed once per shape. The descriptors of all shapes have the same
    axes (`DescriptorAxes`), so a map can differ slightly from the map of `match`. On accelerators or on
    several devices, pairs are refined in batches (`jaxsmw.refine_pairs`). On one CPU, pairs are refined one
    after another. Maps are repaired as in `match`. Mirror images are not considered.

    **Arguments:**

    - `meshes`: the meshes of the shapes, each a `Mesh` or a mesh that `make_mesh` accepts. The meshes may
      have different units of length, because each shape is scaled to area 1.
    - `pairs`: a tuple (source X, target Y) for each pair, as 0-based positions in `meshes`.
    - `preset`: `"accurate"` (the default), `"fast"`, `"paper"` or a `Preset`; see `match`.
    - `alternatives`: whether repair tries alternative maps.
    - `batch_size`: the number of pairs that each device refines at the same time; see `refine_pairs`.
    - `devices`: the JAX devices. The default is all devices of the default backend.

    **Returns:** An iterator over tuples. Each tuple contains the 0-based position of a pair in `pairs`, and
    the `Correspondence` of this pair.

    **Raises:** `InputError` if a mesh or an argument cannot be used, or if a pair contains a number that
    belongs to no shape. The iterator raises `ArithmeticError` if the refinement of a pair fails numerically.
    """
    given = [as_mesh(mesh, f"mesh {number}") for number, mesh in enumerate(meshes)]
    checked = check_pairs(pairs, len(given), "pair")
    check_devices(devices)
    if batch_size is not None:
        check_whole_number("batch_size", batch_size, 1)
    chosen = choose_preset(preset)
    shapes, _ = prepare_shapes(given, chosen)

    def results() -> Iterator[tuple[int, Correspondence]]:
        prepared = ([prepare_pair(shapes[i], shapes[j])] for i, j in checked)
        outcomes = refined_starts(prepared, chosen, batch_size=batch_size, devices=devices)
        for number, (starts, fitted, refined) in enumerate(outcomes):
            i, j = checked[number]
            pair = Pair(given[i], given[j])
            found = match_prepared(pair, starts, fitted, refined=refined, alternatives=alternatives)
            yield number, found.correspondence

    return results()


def refined_starts(
    starts: Iterator[list[PreparedPair]],
    preset: Preset,
    *,
    batch_size: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[tuple[list[PreparedPair], Preset, list[Outcome]]]:
    """Refine the initial maps of many pairs in batches, if batches save time on the given devices.

    **Arguments:**

    - `starts`: for each pair, a list with one `PreparedPair` for each initial map.
    - `preset`: the preset with the stages of refinement. For each pair, the preset is adapted to small
      meshes.
    - `batch_size`, `devices`: see `refine_pairs`.

    **Returns:** An iterator over tuples, one for each pair in the given order. A tuple contains the prepared
    pairs, the adapted preset, and the outcomes before repair. On one CPU there are no outcomes, because
    `match_prepared` then runs the stages itself.
    """
    devices = jax.devices() if devices is None else devices
    fitted = ((one, fitted_preset(preset, *one[0].pair.meshes)) for one in starts)
    if len(devices) == 1 and devices[0].platform == "cpu" and batch_size is None:
        for one, own in fitted:
            release_programs()
            yield one, own, []
        return
    # All pairs of a batch run the same stages.
    for own, group in itertools.groupby(fitted, key=lambda pair: pair[1]):
        while waiting := [one for one, _ in itertools.islice(group, _PAIRS_PER_DEVICE * len(devices))]:
            flat = [start for one in waiting for start in one]
            release_programs()
            described = flat[0].spectrum_x.descriptors is not None
            stages = (own if described else own.without_descriptors()).judged_stages
            outcomes = iter(refine_batch(flat, stages, batch_size=batch_size, devices=devices))
            for one in waiting:
                yield one, own, [next(outcomes) for _ in one]
