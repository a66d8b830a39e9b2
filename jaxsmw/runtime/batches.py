"""Refinement of many pairs in batches on all devices. Shapes are padded to a few common sizes."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import NamedTuple, TypeVar, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int, Int32, Shaped

from jaxsmw.core.arrays import Array
from jaxsmw.core.checks import check_matches
from jaxsmw.core.refinement import Refinement, RefineSettings, refine
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.core.traced_search import BLOCK, queries_per_block
from jaxsmw.errors import InputError
from jaxsmw.runtime.backends import check_devices
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.threads import one_blas_thread

# In scripts/benchmark_batches.py, larger batches save no time on any tested device.
_LARGEST_BATCH = 64
# The assumed memory, in bytes, of a device that does not report its memory.
_USUAL_MEMORY = 8 * 2**30
# A padded size is a multiple of `power / _SUBDIVISION`, where `power` is the largest power of two below the
# number of vertices. Every padded size is also a multiple of the block size of the search. At most 1/8 of the
# vertices of a padded shape are padding if the padded size is at least 1024. Shapes with 4000 to 16 000
# vertices have only 17 different padded sizes.
_SUBDIVISION = 8

Tree = TypeVar("Tree")


def padded_size(number_of_vertices: int) -> int:
    """Return the number of vertices to which a shape is padded.

    One compiled program serves all shapes with the same padded size.
    """
    power = 2 ** max(number_of_vertices - 1, 1).bit_length() // 2
    step = max(power // _SUBDIVISION, BLOCK)
    return -(-number_of_vertices // step) * step


def pad_rows(rows: Shaped[np.ndarray, "n ..."], number_of_rows: int) -> Shaped[np.ndarray, "p ..."]:
    """Return an array (n, ...) extended by rows of zeros to a given number of rows.

    `number_of_rows` must be at least n.
    """
    return np.pad(rows, ((0, number_of_rows - len(rows)), *((0, 0),) * (rows.ndim - 1)))


def stack(spectra: Sequence[Spectrum]) -> Spectrum:
    """Return one `Spectrum` that contains several shapes, for `jax.vmap`.

    Every array of the result has a leading axis, with one entry per shape. All shapes are padded with masked
    vertices to the number of vertices of the largest shape.

    **Raises:** `InputError` if there are no shapes, if the shapes have different numbers of eigenvectors, or
    if only some of them have an optional array.
    """
    if not spectra:
        raise InputError("there are no shapes to stack: give at least one spectrum")
    sizes = {spectrum.eigenvalues.shape[0] for spectrum in spectra}
    if len(sizes) > 1:
        raise InputError(
            f"shapes with {sorted(sizes)} eigenvectors cannot be stacked: truncate them to the same number"
        )
    largest = max(spectrum.mask.shape[0] for spectrum in spectra)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(spectrum.pad(largest) for spectrum in spectra))


def refine_pairs(
    spectra: Sequence[Spectrum],
    pairs: Sequence[tuple[int, int]],
    pointwise_maps: Sequence[Int[Array, " _"] | Int[np.ndarray, " _"]],
    *,
    samples: Sequence[Int[Array, " _"]] | None = None,
    batch_size: int | None = None,
    memory: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    **settings: Unpack[RefineSettings],
) -> Iterator[tuple[int, Refinement]]:
    """Refine many pairs of shapes, of equal or different sizes, in batches on all devices.

    Shapes are padded to a few common sizes, so that pairs of similar sizes share one compiled program. With
    several processes (`jax.distributed`), call this function with the same arguments in each process. It
    divides each batch among the devices of all processes, and every process receives all results.

    The functional maps equal those of `refine` up to rounding errors. A match can differ only if two vertices
    of Y are equally near up to rounding errors.

    **Arguments:**

    - `spectra`: the shapes, each a `Spectrum`. The shapes may have different numbers of eigenvectors, but all
      or none of them must have descriptors, and in the same number.
    - `pairs`: for each pair, the 0-based indices of source X and target Y in `spectra`. A pair may occur
      several times with different initial maps.
    - `pointwise_maps`: for each pair, the initial map T: X -> Y (m,), 0-based vertices of Y.
    - `samples`: for each shape, the samples (s,), as 0-based vertices; s must be the same for all shapes.
    - `batch_size`: the number of pairs that each device receives at the same time. The default on CPUs is 1,
      because CPUs compute the pairs of a batch one after the other. On other devices, it is the number of
      pairs that fit into `memory`, but at most 64.
    - `memory`: the memory in bytes that a batch may use on each device if `batch_size` is None. The default
      is half of the device's memory.
    - `devices`: the JAX devices to use. The default is all devices of the default backend.
    - `settings`: the arguments of `refine` that all pairs share: `refiner`, `iterations`,
      `starts_on_samples`, `ends_on_samples`, `partial`, `stop_when_unchanged` and `history`.

    **Returns:** An iterator over tuples of the 0-based index of a pair in `pairs` and its `Refinement`. Pairs
    are grouped by their padded sizes, so their order differs from the order in `pairs`. Numerical failures
    raise no error, so compare the `result` of each refinement with `RESULTS.successful`.

    **Raises:** `InputError` if an argument is not as described. The errors of `refine` are raised while the
    iterator runs.
    """
    _check_pairs(spectra, pairs, pointwise_maps, samples)
    check_devices(devices)
    if batch_size is not None and batch_size < 1:
        raise InputError(f"batch_size is {batch_size}, but a batch needs at least 1 pair")
    devices = jax.devices() if devices is None else devices
    mesh = Mesh(np.array(devices), ("pairs",))

    def results() -> Iterator[tuple[int, Refinement]]:
        for sizes, positions in _positions_by_size(spectra, pairs):
            needed = bytes_per_pair(
                sizes.m, sizes.n, max(sizes.k_x, sizes.k_y), spectra[0].eigenvectors.dtype.itemsize
            )
            side_by_side = batch_size or _default_batch_size(needed, memory, devices[0])
            per_call = min(side_by_side, -(-len(positions) // len(devices))) * len(devices)
            x, y = (
                _Stack(spectra, samples, [pairs[position][side] for position in positions], size, mesh)
                for side, size in ((0, sizes.m), (1, sizes.n))
            )
            for begin in range(0, len(positions), per_call):
                of_batch = positions[begin : begin + per_call]
                # The last batch is filled with copies of its last pair, because a smaller batch would need
                # another compiled program.
                filled = of_batch + of_batch[-1:] * (per_call - len(of_batch))
                maps = np.stack([pad_rows(np.asarray(pointwise_maps[p]), sizes.m) for p in filled])
                batch = _Batch(
                    x.rows([pairs[p][0] for p in filled]),
                    y.rows([pairs[p][1] for p in filled]),
                    jax.device_put(maps.astype(np.int32), NamedSharding(mesh, _DIVIDED)),
                )
                with one_blas_thread():
                    refined = compiled(_refine_batch)(batch, mesh, settings)
                    refined = multihost_utils.process_allgather(refined, tiled=True)
                for row, position in enumerate(of_batch):
                    of_pair = jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row]), refined)
                    yield position, of_pair.unpadded(len(pointwise_maps[position]))

    return results()


def _check_pairs(
    spectra: Sequence[Spectrum],
    pairs: Sequence[tuple[int, int]],
    pointwise_maps: Sequence[Int[Array, " _"] | Int[np.ndarray, " _"]],
    samples: Sequence[Int[Array, " _"]] | None,
) -> None:
    if len(pairs) != len(pointwise_maps):
        raise InputError(
            f"there are {len(pairs)} pairs and {len(pointwise_maps)} initial maps: give one map per pair"
        )
    if samples is not None and len(samples) != len(spectra):
        raise InputError(
            f"there are {len(spectra)} shapes, but samples of {len(samples)} shapes: give samples of every "
            "shape"
        )
    for position, spectrum in enumerate(spectra):
        if not isinstance(spectrum, Spectrum):
            raise InputError(
                f"shape {position} is a {type(spectrum).__name__}, but a Spectrum is needed: compute it with "
                "compute_spectrum"
            )
    for position, (pair, pointwise_map) in enumerate(zip(pairs, pointwise_maps, strict=True)):
        if len(pair) != 2 or any(shape not in range(len(spectra)) for shape in pair):
            raise InputError(
                f"pair {position} is {tuple(pair)}, but there are {len(spectra)} shapes: give the indices of "
                "two shapes, counted from 0"
            )
        check_matches(f"initial map of pair {position}", pointwise_map, len(spectra[pair[0]].mask))


class _Sizes(NamedTuple):
    """The padded numbers of vertices and the numbers of eigenvectors of a pair."""

    m: int
    n: int
    k_x: int
    k_y: int


def _positions_by_size(
    spectra: Sequence[Spectrum], pairs: Sequence[tuple[int, int]]
) -> list[tuple[_Sizes, list[int]]]:
    """Group pairs that share a program: by their sizes, and by the optional arrays of their spectra."""
    groups: dict[tuple[_Sizes, Hashable, Hashable], list[int]] = {}
    for position, pair in enumerate(pairs):
        x, y = (spectra[shape] for shape in pair)
        (m, k_x), (n, k_y) = x.eigenvectors.shape, y.eigenvectors.shape
        sizes = _Sizes(padded_size(m), padded_size(n), k_x, k_y)
        groups.setdefault((sizes, jax.tree.structure(x), jax.tree.structure(y)), []).append(position)
    return [(sizes, positions) for (sizes, *_), positions in groups.items()]


_DIVIDED, _EVERYWHERE = PartitionSpec("pairs"), PartitionSpec()

Side = tuple[Spectrum, Int[Array, "batch s"] | None]
"""All sources or all targets of a batch of pairs: stacked spectra, and the samples (or None)."""


class _Batch(NamedTuple):
    """A batch of pairs, divided among the devices."""

    x: Side
    y: Side
    initial_maps: Int32[Array, "batch m"]


class _Stack:
    """All sources or all targets of several pairs, padded to one size and copied to all devices."""

    def __init__(
        self,
        spectra: Sequence[Spectrum],
        samples: Sequence[Int[Array, " _"]] | None,
        shapes: Sequence[int],
        size: int,
        mesh: Mesh,
    ):
        different = list(dict.fromkeys(shapes))
        self._place = {shape: row for row, shape in enumerate(different)}
        side = (
            stack([spectra[shape].pad(size) for shape in different]),
            None if samples is None else jnp.stack([samples[shape] for shape in different]),
        )
        self._mesh = mesh
        self._side: Side = jax.device_put(side, NamedSharding(mesh, _EVERYWHERE))

    def rows(self, shapes: Sequence[int]) -> Side:
        """Return the given shapes, divided among the devices. A shape may occur several times."""
        places = jnp.asarray([self._place[shape] for shape in shapes])
        return _take(self._side, places, self._mesh)


@eqx.filter_jit
def _take(tree: Tree, places: Int[Array, " batch"], mesh: Mesh) -> Tree:
    taken = jax.tree.map(lambda leaf: leaf[places], tree)
    return lax.with_sharding_constraint(taken, NamedSharding(mesh, _DIVIDED))


def _refine_batch(batch: _Batch, mesh: Mesh, settings: RefineSettings) -> Refinement:
    def refine_pair(pair: _Batch) -> Refinement:
        (spectrum_x, samples_x), (spectrum_y, samples_y), initial_map = pair
        samples = None if samples_x is None or samples_y is None else (samples_x, samples_y)
        return refine(spectrum_x, spectrum_y, initial_map, samples=samples, **settings)

    # `shard_map` is not used, because the solvers of optimistix do not run within it. The compiler still
    # divides the batch among the devices, because the pairs do not depend on each other.
    return lax.with_sharding_constraint(jax.vmap(refine_pair)(batch), NamedSharding(mesh, _DIVIDED))


def _default_batch_size(bytes_of_a_pair: int, memory: int | None, device: jax.Device) -> int:
    if _one_at_a_time(device):
        return 1
    if memory is None:
        memory = (device.memory_stats() or {}).get("bytes_limit", _USUAL_MEMORY) // 2
    return int(np.clip(memory // bytes_of_a_pair, 1, _LARGEST_BATCH))


def _one_at_a_time(device: jax.Device) -> bool:
    # On CPUs, `jax.vmap` computes the pairs of a batch in a loop; see `jaxsmw.core.traced_batches`.
    return device.platform == "cpu"


def bytes_per_pair(m: int, n: int, k: int, itemsize: int = 4) -> int:
    """Return the approximate memory in bytes that `refine` uses on a device for one pair, with its spectra.

    X has m vertices, Y has n vertices, both have k eigenvectors, and a number has `itemsize` bytes.
    """
    eigenvectors, embeddings, scores = (m + n) * k, 2 * (m + n) * k, 3 * n * queries_per_block(m, n)
    return itemsize * (eigenvectors + embeddings + scores)
