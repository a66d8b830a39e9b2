"""Matches many edges, in worker processes if requested, and keeps the finished maps in a store."""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int64

from jaxsmw.collection.consistency import Edge
from jaxsmw.collection.edges import EdgeMap, EdgeTask, match_edges
from jaxsmw.collection.shapes import preset_key, shape_key
from jaxsmw.errors import InputError
from jaxsmw.matching.preparation import DescriptorAxes, PreparedShape
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress, no_progress
from jaxsmw.runtime.workers import run_tasks

logger = logging.getLogger("jaxsmw")

InitialMaps = Mapping[Edge, Int64[np.ndarray, " m"] | None]
"""The initial map (m,) of each edge, as 0-based vertices of its target; None for `"shot"`."""


@dataclass(frozen=True, eq=False)
class EdgeMatcher:
    """The settings with which all edges of a collection are matched.

    **Attributes:**

    - `shapes`: the prepared shapes, with descriptors.
    - `axes`: the axes of the descriptors; None without descriptors.
    - `preset`: the stages and the repair.
    - `aligned`: whether edges without an initial map also start from `"aligned"`; see `EdgeTask`.
    - `store`: the store in which finished maps are kept.
    - `executor`: the executor of the worker processes. With None, this process matches all edges.
    - `devices`: the JAX devices of this process; see `match_edges`.
    - `progress`: a function that is called after each edge.
    """

    shapes: Sequence[PreparedShape]
    axes: DescriptorAxes | None
    preset: Preset
    aligned: bool = False
    store: Store = Store()  # noqa: RUF009 (immutable)
    executor: Executor | None = None
    devices: Sequence[jax.Device] | None = None
    progress: Progress = no_progress

    def match(self, inits: InitialMaps, step: str) -> dict[Edge, EdgeMap]:
        """Match edges.

        **Arguments:**

        - `inits`: the initial map of each edge.
        - `step`: the name of the step in reports of progress.

        **Returns:** The maps, in the order of `inits`. An edge whose match fails is left out and named in the
        log.
        """
        # Workers finish edges in any order, but later rounding errors depend on the order of the maps.
        found = dict(self._found(inits, step))
        return {edge: found[edge] for edge in inits if edge in found}

    def _found(self, inits: InitialMaps, step: str) -> Iterator[tuple[Edge, EdgeMap]]:
        missing = {}
        for edge, init in inits.items():
            stored = self.store.load("edge", self._key(edge, init))
            if stored is None:
                missing[edge] = init
            else:
                yield edge, EdgeMap.from_arrays(stored)
        done = len(inits) - len(missing)
        self.progress(step, done, len(inits))
        for edge, found in self._computed(missing):
            done += 1
            self.progress(step, done, len(inits))
            if isinstance(found, BaseException):
                if not isinstance(found, InputError | ArithmeticError):
                    raise found
                logger.warning("%s", found)
                continue
            self.store.save("edge", self._key(edge, inits[edge]), found.arrays())
            yield edge, found

    def _computed(self, inits: InitialMaps) -> Iterator[tuple[Edge, EdgeMap | BaseException]]:
        if self.executor is not None:
            yield from self._computed_by_workers(inits, self.executor)
            return
        tasks = (
            EdgeTask(self.shapes[i], self.shapes[j], init, self.aligned) for (i, j), init in inits.items()
        )
        yield from zip(inits, match_edges(tasks, self.preset, self.devices), strict=True)

    def _computed_by_workers(
        self, inits: InitialMaps, executor: Executor
    ) -> Iterator[tuple[Edge, EdgeMap | BaseException]]:
        kept = self.store.directory
        with TemporaryDirectory() if kept is None else nullcontext(kept) as directory:
            place = Path(directory).resolve()
            keys = self._save_shapes(Store(place), inits)
            edges = {f"{i} {j}": (i, j) for i, j in inits}
            tasks = {
                name: _StoredTask(
                    place,
                    (keys[i], keys[j]),
                    (self.shapes[i].mesh.name, self.shapes[j].mesh.name),
                    self.preset,
                    inits[i, j],
                    self.aligned,
                )
                for name, (i, j) in edges.items()
            }
            for name, found in run_tasks(_match_stored, tasks, executor):
                yield edges[name], found

    def _save_shapes(self, store: Store, edges: Iterable[Edge]) -> dict[int, tuple[str, ...]]:
        """Save the prepared shapes of edges for workers, and return the key of each shape."""
        keys: dict[int, tuple[str, ...]] = {}
        for number in sorted({shape for edge in edges for shape in edge}):
            arrays = self.shapes[number].arrays()
            digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays.values()))
            keys[number] = (digest.hexdigest(),)
            if store.load("shape", keys[number]) is None:
                store.save("shape", keys[number], arrays)
        return keys

    def _key(self, edge: Edge, init: Int64[np.ndarray, " m"] | None) -> tuple[Any, ...]:
        x, y = (shape_key(self.shapes[number], self.preset) for number in edge)
        axes = () if self.axes is None else (self.axes.principal.axes,)
        first = "shot" if init is None else init
        return (*x, *y, *axes, *preset_key(self.preset), str(self.aligned), first)


class _StoredTask(NamedTuple):
    """The task of matching one edge in a worker. The worker reads both shapes from a store."""

    directory: Path
    keys: tuple[tuple[Any, ...], tuple[Any, ...]]
    names: tuple[str, str]
    preset: Preset
    init: Int64[np.ndarray, " m"] | None
    aligned: bool


@functools.lru_cache(maxsize=16)
def _stored_shape(directory: Path, key: tuple[Any, ...], name: str) -> PreparedShape:
    arrays = Store(directory).load("shape", key)
    if arrays is None:
        raise InputError(f"{directory}: the prepared shape {name} is missing: run the same command again.")
    return PreparedShape.from_arrays(arrays, name)


def _match_stored(task: _StoredTask) -> EdgeMap:
    x, y = (_stored_shape(task.directory, key, name) for key, name in zip(task.keys, task.names, strict=True))
    (found,) = match_edges([EdgeTask(x, y, task.init, task.aligned)], task.preset, jax.devices()[:1])
    if isinstance(found, ArithmeticError):
        raise found
    return found
