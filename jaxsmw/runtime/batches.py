"""Many pairs: shapes of different sizes padded to a few common ones, refined together, on all devices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, Shaped

from jaxsmw.core.refinement import Refinement, refine
from jaxsmw.core.refiner import Refiner
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.threads import one_blas_thread

# Sizes are rounded up to a multiple of an eighth of the power of two below them, and of the search's block:
# at most an eighth of a padded shape is padding, and all shapes from 4000 to 16 000 vertices share 17 sizes.
_SUBDIVISION = 8
_SMALLEST_STEP = 128
# More pairs side by side than this gained nothing on any device measured (scripts/benchmark_batches.py).
_LARGEST_BATCH = 64
# Where a device does not say how much memory it has.
_USUAL_MEMORY = 4 * 2**30


def padded_size(number_of_vertices: int) -> int:
    """The common size that a shape is padded to: one compiled program serves all shapes with the same."""
    power = 2 ** max(number_of_vertices - 1, 1).bit_length() // 2
    step = max(power // _SUBDIVISION, _SMALLEST_STEP)
    return -(-number_of_vertices // step) * step


def pad_rows(rows: Shaped[np.ndarray, "n ..."], number_of_rows: int) -> Shaped[np.ndarray, "p ..."]:
    """The same with zeros up to a number of rows: on the host, what belongs to a spectrum that is padded."""
    return np.pad(rows, ((0, number_of_rows - len(rows)), *((0, 0),) * (rows.ndim - 1)))


def stack(spectra: Sequence[Spectrum]) -> Spectrum:
    """Shapes as one pytree with a leading axis, for `jax.vmap`; padded to the size of the largest.

    **Raises:** `ValueError` if they differ in their number of eigenvectors, or there are none.
    """
    if not spectra:
        raise ValueError("there are no shapes to stack")
    sizes = {spectrum.eigenvalues.shape[0] for spectrum in spectra}
    if len(sizes) > 1:
        raise ValueError(f"shapes with {sorted(sizes)} eigenvectors cannot be stacked: truncate them first")
    largest = max(spectrum.mask.shape[0] for spectrum in spectra)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(spectrum.pad(largest) for spectrum in spectra))


def refine_pairs(
    spectra: Sequence[Spectrum],
    pairs: Sequence[tuple[int, int]],
    pointwise_maps: Sequence[Int[Array, " _"] | Int[np.ndarray, " _"]],
    *,
    refiner: Refiner = WaveletPreservation(),  # noqa: B008 (immutable)
    iterations: int = 3,
    samples: Sequence[Int[Array, " _"]] | None = None,
    partial: bool = False,
    stop_when_unchanged: bool = False,
    history: bool = False,
    batch_size: int | None = None,
    memory: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[tuple[int, Refinement]]:
    """`refine` for many pairs of shapes of any sizes, as fast as the devices allow.

    Shapes are padded to a few common sizes (`padded_size`), so that the program is compiled once for each
    combination of sizes that occurs among the pairs. Each device gets its share of every batch. With several
    processes (`jax.distributed`) call it with the same arguments in each of them: the devices of all take
    part and every process gets all the results.

    A pair's result is that of `refine` up to the rounding of sums over padded arrays and batched products:
    functional maps agree to the precision of the float type, and a match can differ only where two
    vertices of Y are as near as that.

    **Arguments:**

    - `spectra`: the shapes.
    - `pairs`: for each pair the positions of source X and target Y among the shapes. A pair may occur with
      several initial maps.
    - `pointwise_maps`: for each pair its initial T: X -> Y (m,).
    - `refiner`, `iterations`, `partial`, `stop_when_unchanged`, `history`: see `refine`.
    - `samples`: for each shape the vertices to iterate on, as many of each; see `refine`.
    - `batch_size`: pairs side by side on each device. By default one on CPUs, where more would only take
      more memory, elsewhere as many as fit `memory`, at most 64.
    - `memory`: bytes on each device that a batch may take; by default half of what the device has.
    - `devices`: where to compute; by default all of the default backend.

    **Returns:** An iterator over (position among the pairs, its `Refinement`), batch by batch: pairs of equal
    size follow each other. Nothing is raised for bad numbers: check each `result`.

    **Raises:** `ValueError` if the arguments do not fit together.
    """
    if len(pairs) != len(pointwise_maps):
        raise ValueError(f"there are {len(pairs)} pairs and {len(pointwise_maps)} initial maps")
    if samples is not None and len(samples) != len(spectra):
        raise ValueError(f"there are {len(spectra)} shapes and samples of {len(samples)}")
    if strangers := [type(shape).__name__ for shape in spectra if not isinstance(shape, Spectrum)]:
        raise ValueError(f"spectra are wanted, not {strangers[0]}: see compute_spectrum")
    for position, (pair, pointwise_map) in enumerate(zip(pairs, pointwise_maps, strict=True)):
        if len(pair) != 2 or any(shape not in range(len(spectra)) for shape in pair):
            raise ValueError(
                f"pair {position} is {tuple(pair)}, but two positions among {len(spectra)} shapes are wanted"
            )
        if not jnp.issubdtype(pointwise_map.dtype, jnp.integer):
            raise ValueError(f"the initial map of pair {position} is of {pointwise_map.dtype}, not integers")
        vertices = spectra[pair[0]].mask.shape
        if pointwise_map.shape != vertices:
            raise ValueError(
                f"the initial map of pair {position} has shape {pointwise_map.shape}, but its X has "
                f"{vertices[0]} vertices"
            )
    if batch_size is not None and batch_size < 1:
        raise ValueError(f"batch_size is {batch_size}, but at least one pair is needed in a batch")
    settings = dict(
        iterations=iterations, partial=partial, stop_when_unchanged=stop_when_unchanged, history=history
    )
    devices = jax.devices() if devices is None else devices
    mesh = Mesh(np.array(devices), ("pairs",))
    groups: dict[tuple[int, int, int, int], list[int]] = {}
    for position, pair in enumerate(pairs):
        sizes, ranks = zip(*(spectra[shape].eigenvectors.shape for shape in pair), strict=True)
        groups.setdefault((*map(padded_size, sizes), *ranks), []).append(position)

    def results() -> Iterator[tuple[int, Refinement]]:
        for (m, n, k_x, k_y), positions in groups.items():
            side_by_side = batch_size or _default_batch_size(m, n, max(k_x, k_y), spectra, memory, devices)
            per_call = min(side_by_side, -(-len(positions) // len(devices))) * len(devices)
            stacks = tuple(
                _Stack(spectra, samples, [pairs[position][side] for position in positions], size, mesh)
                for side, size in ((0, m), (1, n))
            )
            for begin in range(0, len(positions), per_call):
                chosen = positions[begin : begin + per_call]
                # The last batch is filled up, so that it needs no program of its own.
                filled = chosen + chosen[-1:] * (per_call - len(chosen))
                starts = [pad_rows(np.asarray(pointwise_maps[p]), m) for p in filled]
                batch = (
                    *(stack.rows([pairs[p][side] for p in filled]) for side, stack in enumerate(stacks)),
                    jax.device_put(np.stack(starts).astype(np.int32), NamedSharding(mesh, _DIVIDED)),
                )
                with one_blas_thread():
                    refined = compiled(_refine_batch)(refiner, batch, mesh, settings)
                    refined = multihost_utils.process_allgather(refined, tiled=True)
                for row, position in enumerate(chosen):
                    one = jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row]), refined)
                    yield position, one.unpadded(len(pointwise_maps[position]))

    return results()


_DIVIDED, _EVERYWHERE = PartitionSpec("pairs"), PartitionSpec()


class _Stack:
    """The shapes on one side of some pairs, padded to one size, on all devices."""

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
        leaves = (
            stack([spectra[shape].pad(size) for shape in different]),
            None if samples is None else jnp.stack([samples[shape] for shape in different]),
        )
        self._mesh = mesh
        self._leaves = jax.device_put(leaves, NamedSharding(mesh, _EVERYWHERE))

    def rows(self, shapes: Sequence[int]) -> tuple[Spectrum, Int[Array, "batch s"] | None]:
        """Some of them with repetitions, divided among the devices."""
        places = jnp.asarray([self._place[shape] for shape in shapes])
        return _take(self._leaves, places, self._mesh)


@eqx.filter_jit
def _take(leaves: Any, places: Int[Array, " batch"], mesh: Mesh) -> Any:
    taken = jax.tree.map(lambda leaf: leaf[places], leaves)
    return lax.with_sharding_constraint(taken, NamedSharding(mesh, _DIVIDED))


def _refine_batch(refiner: Refiner, batch: Any, mesh: Mesh, settings: dict[str, Any]) -> Refinement:
    def one(pair: Any) -> Refinement:
        (spectrum_x, samples_x), (spectrum_y, samples_y), start = pair
        return refine(
            spectrum_x, spectrum_y, start,
            refiner=refiner, samples=None if samples_x is None else (samples_x, samples_y), **settings,
        )  # fmt: skip

    # Not `shard_map`: optimistix's solvers do not run within it. Nothing couples the pairs of a batch, so the
    # compiler has no trouble dividing it.
    refined = lax.map(one, batch) if len(batch[-1]) == 1 else jax.vmap(one)(batch)
    return lax.with_sharding_constraint(refined, NamedSharding(mesh, _DIVIDED))


def _default_batch_size(
    m: int, n: int, k: int, spectra: Sequence[Spectrum], memory: int | None, devices: Sequence[jax.Device]
) -> int:
    """One pair at a time on CPUs; elsewhere as many as fit the memory."""
    if _one_at_a_time(devices[0]):
        return 1
    if memory is None:
        known = devices[0].memory_stats() or {}
        memory = known.get("bytes_limit", 2 * _USUAL_MEMORY) // 2
    pair = bytes_per_pair(m, n, k, spectra[0].eigenvectors.dtype.itemsize)
    return int(np.clip(memory // pair, 1, _LARGEST_BATCH))


def _one_at_a_time(device: jax.Device) -> bool:
    """Measured: on CPUs a batch is a third slower than its pairs one by one, and takes its memory."""
    return device.platform == "cpu"


def bytes_per_pair(m: int, n: int, k: int, itemsize: int = 4) -> int:
    """About what `refine` holds on a device for one pair, with the pair itself: linear in m and n."""
    eigenvectors, embeddings, scores = (m + n) * k, 2 * (m + n) * k, 3 * n * _SMALLEST_STEP
    return itemsize * (eigenvectors + embeddings + scores)
