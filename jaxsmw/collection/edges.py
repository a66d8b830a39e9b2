"""Matches the edges of a collection's graph, in worker processes if requested, and stores their maps."""

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

import numpy as np
from jaxtyping import Int64

from jaxsmw.choices import DEFAULT_INITIAL_MAP, Eigensolver
from jaxsmw.collection.consistency import Edge
from jaxsmw.collection.pairs import match_many, prepare_task
from jaxsmw.collection.shapes import preset_key, shape_key
from jaxsmw.errors import InputError
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.descriptors import DescriptorAxes
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset
from jaxsmw.runtime.backends import Device
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress, no_progress
from jaxsmw.runtime.workers import run_tasks

logger = logging.getLogger("jaxsmw")

InitialMap = Int64[np.ndarray, " m"] | None
"""The initial map X -> Y (m,) of an edge, as 0-based vertices of Y; None for `"shot"`."""


@dataclass(frozen=True, eq=False)
class EdgeMap:
    """The maps between the source X (m vertices) and the target Y (n vertices) of an edge.

    **Attributes:**

    - `forward`: the match of every vertex of X, as `SurfacePoints` on Y with m entries.
    - `backward`: the match of every vertex of Y, as `SurfacePoints` on X with n entries.
    - `expected_error`: the mean expected error, in units of the square root of the area; see
      `jaxsmw.matching.judge.expected_error`.
    - `distortion`: the distortion of the map; see `jaxsmw.matching.judge.distortion`.
    """

    forward: SurfacePoints
    backward: SurfacePoints
    expected_error: float
    distortion: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> EdgeMap:
        """Return the maps, given the result of the method `arrays`."""
        forward, backward = (
            SurfacePoints(arrays[f"{name}_faces"].astype(np.int64), arrays[f"{name}_weights"])
            for name in ("forward", "backward")
        )
        return cls(forward, backward, *arrays["scores"].tolist())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the maps as arrays, for a file."""
        return {
            "forward_faces": self.forward.faces.astype(np.int32),
            "forward_weights": self.forward.weights,
            "backward_faces": self.backward.faces.astype(np.int32),
            "backward_weights": self.backward.weights,
            "scores": np.array([self.expected_error, self.distortion], np.float64),
        }

    @classmethod
    def of(cls, matched: Correspondence) -> EdgeMap:
        """Return the maps of a correspondence of `match` in both directions."""
        return cls(
            matched.surface_points(),
            matched.reverse_surface_points(),
            float(matched.mesh_x.average(matched.expected_error())),
            matched.distortion,
        )


class EdgeTask(NamedTuple):
    """The inputs for the match of one edge; see `jaxsmw.collection.pairs.prepare_task`."""

    x: PreparedShape
    y: PreparedShape
    init: InitialMap = None


def match_edges(
    tasks: Iterable[EdgeTask], preset: Preset, devices: Sequence[Device] | None = None
) -> Iterator[EdgeMap | ArithmeticError]:
    """Match edges as `match_many` does, and yield their maps, or the error of a failed refinement."""
    prepared = (prepare_task(task.x, task.y, init=task.init) for task in tasks)
    for matched in match_many(prepared, preset, devices=devices):
        try:
            yield matched if isinstance(matched, ArithmeticError) else EdgeMap.of(matched)
        except ArithmeticError as error:
            yield error


@dataclass(frozen=True, eq=False)
class EdgeMatcher:
    """The settings with which all edges of a collection are matched.

    **Attributes:**

    - `shapes`: the prepared shapes, with descriptors in the common `axes` if the preset uses descriptors.
    - `preset`, `eigensolver`: the preset and the eigensolver with which the shapes were prepared.
    - `store`: the store in which finished maps are kept.
    - `executor`: the executor of the worker processes. With None, this process matches all edges.
    - `devices`: the JAX devices of this process; see `jaxsmw.refine_pairs`.
    - `progress`: a function that is called after each edge.
    """

    shapes: Sequence[PreparedShape]
    axes: DescriptorAxes | None
    preset: Preset
    eigensolver: Eigensolver
    store: Store
    executor: Executor | None = None
    devices: Sequence[Device] | None = None
    progress: Progress = no_progress

    def match(self, inits: Mapping[Edge, InitialMap], step: str) -> dict[Edge, EdgeMap]:
        """Match edges, given the initial map of each edge and the name of the step for reports of progress.

        The maps are in the order of `inits`. An edge whose match fails is left out and named in the log.
        """
        # Workers finish edges in any order, but later rounding errors depend on the order of the maps.
        maps = dict(self._matched(inits, step))
        return {edge: maps[edge] for edge in inits if edge in maps}

    def _matched(self, inits: Mapping[Edge, InitialMap], step: str) -> Iterator[tuple[Edge, EdgeMap]]:
        missing = {}
        for edge, init in inits.items():
            stored = self.store.load("edge", self._key(edge, init))
            if stored is None:
                missing[edge] = init
            else:
                yield edge, EdgeMap.from_arrays(stored)
        done = len(inits) - len(missing)
        self.progress(step, done, len(inits))
        for edge, result in self._computed(missing):
            done += 1
            self.progress(step, done, len(inits))
            if isinstance(result, BaseException):
                if not isinstance(result, InputError | ArithmeticError):
                    raise result
                logger.warning("%s", result)
                continue
            self.store.save("edge", self._key(edge, inits[edge]), result.arrays())
            yield edge, result

    def _computed(self, inits: Mapping[Edge, InitialMap]) -> Iterator[tuple[Edge, EdgeMap | BaseException]]:
        if self.executor is None:
            tasks = (EdgeTask(self.shapes[i], self.shapes[j], init) for (i, j), init in inits.items())
            yield from zip(inits, match_edges(tasks, self.preset, self.devices), strict=True)
            return
        kept = self.store.directory
        with TemporaryDirectory() if kept is None else nullcontext(kept) as directory:
            place = Path(directory).resolve()
            keys = self._save_shapes(Store(place), {shape for edge in inits for shape in edge})
            names = [shape.mesh.name for shape in self.shapes]
            edges = {f"{i} {j}": (i, j) for i, j in inits}
            stored_tasks = {
                name: _StoredTask(place, (keys[i], keys[j]), (names[i], names[j]), self.preset, inits[i, j])
                for name, (i, j) in edges.items()
            }
            for name, result in run_tasks(_match_stored, stored_tasks, self.executor):
                yield edges[name], result

    def _save_shapes(self, store: Store, numbers: Iterable[int]) -> dict[int, str]:
        """Save prepared shapes for workers, and return the key of each shape."""
        keys = {}
        for number in sorted(numbers):
            arrays = self.shapes[number].arrays()
            digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays.values()))
            keys[number] = digest.hexdigest()
            if store.load("shape", (keys[number],)) is None:
                store.save("shape", (keys[number],), arrays)
        return keys

    def _key(self, edge: Edge, init: InitialMap) -> tuple[Any, ...]:
        x, y = (shape_key(self.shapes[number], self.preset, self.eigensolver) for number in edge)
        axes = () if self.axes is None else (self.axes.principal.axes,)
        first = DEFAULT_INITIAL_MAP if init is None else init
        return (*x, *y, *axes, *preset_key(self.preset), first)


class _StoredTask(NamedTuple):
    """The task of matching one edge in a worker. The worker reads both shapes from a store."""

    directory: Path
    keys: tuple[str, str]
    names: tuple[str, str]
    preset: Preset
    init: InitialMap


@functools.lru_cache(maxsize=16)
def _stored_shape(directory: Path, key: str, name: str) -> PreparedShape:
    arrays = Store(directory).load("shape", (key,))
    if arrays is None:
        raise InputError(f"{directory}: the prepared shape {name} is missing: run the same command again.")
    return PreparedShape.from_arrays(arrays, name)


def _match_stored(task: _StoredTask) -> EdgeMap:
    x, y = (_stored_shape(task.directory, key, name) for key, name in zip(task.keys, task.names, strict=True))
    (result,) = match_edges([EdgeTask(x, y, task.init)], task.preset)
    if isinstance(result, ArithmeticError):
        raise result
    return result
