"""The function `match_collection`, which matches all shapes of a collection consistently."""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxsmw.choices import DEFAULT_PRESET
from jaxsmw.collection.consistency import Edge, estimate_edge_errors, find_outliers
from jaxsmw.collection.edges import EdgeMap, EdgeTask, compare_hands, match_edges
from jaxsmw.collection.graph import choose_edges, shape_distances
from jaxsmw.collection.hands import choose_hands
from jaxsmw.collection.result import Collection, MatchedEdge
from jaxsmw.collection.settings import CollectionSettings
from jaxsmw.collection.shapes import (
    PreparedShape,
    describe_shape,
    descriptor_axes,
    prepare_shape,
)
from jaxsmw.collection.synchronization import Network, synchronize, vertex_map_between
from jaxsmw.descriptors import DescriptorAxes, PrincipalAxes
from jaxsmw.errors import InputError, check_number, check_whole_number
from jaxsmw.geometry.eigenbasis import choose_eigensolver
from jaxsmw.geometry.geodesics import SurfacePoints
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh, connected_components
from jaxsmw.presets import Preset, PresetName, choose_preset
from jaxsmw.repair.chirality import Decision
from jaxsmw.runtime.batches import check_devices
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import timed
from jaxsmw.runtime.workers import run_tasks
from jaxsmw.transfer.registered_mesh import DEFAULT_STIFFNESS, RegisteredMesh, register_mesh

logger = logging.getLogger("jaxsmw")

Progress = Callable[[str, int, int], None]
"""A function that is called with the name of a step, the number of finished parts and the number of parts."""


def match_collection(
    meshes: Sequence[Mesh | MeshLike],
    *,
    names: Sequence[str] | None = None,
    preset: PresetName | Preset = DEFAULT_PRESET,
    template: int | None = None,
    mirror: bool = True,
    stiffness: float = DEFAULT_STIFFNESS,
    settings: CollectionSettings = CollectionSettings(),  # noqa: B008 (immutable)
    seed: int = 0,
    directory: Path | str | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
    progress: Progress | None = None,
) -> Collection:
    """Match all shapes of a collection, such that the maps of all pairs agree.

    Only the edges of a graph are matched, a few for each shape. Cycles of the graph show which maps are
    wrong. The maps from a template to all shapes are the robust means of the maps along all edges. Maps that
    contradict these means are matched again, from the consistent maps.

    **Arguments:**

    - `meshes`: at least two meshes of the same kind of body, in any poses, units and triangulations. Each is
      a `Mesh`, or a mesh that `make_mesh` accepts.
    - `names`: the new names of the meshes. By default, the meshes keep their names. If two of these names are
      equal, all names are numbered.
    - `preset`: see `match`.
    - `template`: the number of the template. The default is the shape with the smallest sum of errors along
      the best paths to all other shapes (the medoid).
    - `mirror`: True to recognise shapes of opposite hands, such as left and right teeth, and to match their
      mirror images. False to match all meshes as they are.
    - `stiffness`: see `register_mesh`.
    - `settings`: the `CollectionSettings`.
    - `seed`: the seed of the random edges of the graph.
    - `directory`: an existing directory in which finished steps are kept. A second call with the same
      directory continues an interrupted call. If meshes are added, only their own edges are matched.
    - `executor`: an executor that matches edges, for example `jaxsmw.runtime.workers.open_executor`. By
      default, edges are matched in this process.
    - `devices`: the JAX devices that match edges in this process, by default all; see `match_pairs`.
    - `progress`: a function that is called after each part of a step with the name of the step, the number of
      finished parts, and the number of parts.

    **Returns:** A `Collection`. Meshes that cannot be matched are left out and named in `left_out`.

    **Raises:** `InputError` if an argument is not valid, if fewer than two meshes can be matched, or if the
    template is left out.
    `ArithmeticError` if all matches of a mesh fail numerically.
    """
    if names is not None and (len(names) != len(meshes) or len(set(names)) != len(names)):
        raise InputError(
            f"there are {len(set(names))} different names for {len(meshes)} meshes: give each mesh a name of "
            "its own."
        )
    if not isinstance(mirror, bool | np.bool):
        raise InputError(f"mirror is {mirror!r}: give True or False.")
    if template is not None:
        template = check_whole_number("template", template, 0, len(meshes) - 1)
    check_number("stiffness", stiffness, positive=True)
    if not isinstance(settings, CollectionSettings):
        raise InputError(f"settings is {settings!r}: give CollectionSettings.")
    seed = check_whole_number("seed", seed, 0)
    check_devices(devices)
    if directory is not None and not Path(directory).is_dir():
        raise InputError(f"{directory}: is not a directory: create it first.")
    given = [_named_mesh(mesh, number, names) for number, mesh in enumerate(meshes)]
    if len({mesh.name for mesh in given}) < len(given):
        given = [replace(mesh, name=f"{mesh.name} {number}") for number, mesh in enumerate(given)]
    return _Matcher(given, choose_preset(preset), settings, seed, directory, executor, devices, progress).run(
        template, mirror, stiffness
    )


def _named_mesh(mesh: Mesh | MeshLike, number: int, names: Sequence[str] | None) -> Mesh:
    if names is None:
        return as_mesh(mesh, f"mesh {number}")
    return replace(as_mesh(mesh, names[number]), name=names[number])


class _StoredTask(NamedTuple):
    """The match of an edge in a worker, which reads both shapes from a store."""

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


class _Matcher:
    """The steps of `match_collection`, with the settings that they share."""

    def __init__(
        self,
        meshes: Sequence[Mesh],
        preset: Preset,
        settings: CollectionSettings,
        seed: int,
        directory: Path | str | None,
        executor: Executor | None,
        devices: Sequence[jax.Device] | None,
        progress: Progress | None,
    ):
        self.given, self.preset, self.settings, self.seed = list(meshes), preset, settings, seed
        self.store = None if directory is None else Store(Path(directory))
        self.executor, self.devices = executor, devices
        self.progress = progress or (lambda *_: None)
        self.left_out: dict[str, str] = {}
        self.seconds: dict[str, float] = {}

    def run(self, template: int | None, mirror: bool, stiffness: float) -> Collection:
        with timed("shapes", self.seconds):
            kept = self._prepare()
        if len(kept) < 2:
            raise InputError(
                f"a collection needs at least two meshes, but only {len(kept)} of {len(self.given)} can be "
                "matched. " + " ".join(f"{name}: {reason}" for name, reason in self.left_out.items())
            )
        if template is not None:
            if template not in kept:
                raise InputError(
                    f"the template {self.given[template].name} cannot be matched: choose another."
                )
            template = kept.index(template)
        with timed("hands", self.seconds):
            decisions = self._compare_hands() if mirror else {}
            mirrored = choose_hands(len(self.shapes), decisions)
            asymmetric = any(decision.asymmetric for decision in decisions.values())
            # Asymmetric shapes are matched from two initial maps, and expected errors decide between the two
            # results. Without repair, expected errors do not lead to the correct choice.
            self.aligned = asymmetric and self.preset.repair is not None
            if mirrored.any():
                self._mirror(mirrored)
        with timed("descriptors", self.seconds):
            self._describe()
        with timed("graph", self.seconds):
            edges = self._edges()
        with timed("edges", self.seconds):
            found = dict(self._match(dict.fromkeys(edges), "edges"))
            # Workers finish edges in any order. The order of the maps is fixed here, because it determines
            # rounding errors.
            self.maps = {edge: found[edge] for edge in edges if edge in found}
            self._check_connected()
        replaced: set[Edge] = set()
        with timed("synchronization", self.seconds):
            network, chosen, points = self._synchronize(template)
            first_cycles = self.cycles
            for _ in range(self.settings.rounds):
                wrong = self._contradicted(edges, network, points)
                if not wrong:
                    break
                inits = {(i, j): self._through(chosen, points, i, j) for i, j in wrong}
                again = dict(self._match(inits, "contradicted edges"))
                better = self._better(again, network, points)
                if not better:
                    break
                self.maps |= better
                replaced |= set(better)
                network, chosen, points = self._synchronize(template)
        described = [self._describe_edge(edge, network, points, replaced) for edge in edges]
        meshes = [self.given[number] for number in kept]
        # The mirror image of a mesh has the same faces, with the corners in reverse order.
        points = [
            SurfacePoints(of_shape.faces, np.ascontiguousarray(of_shape.weights[:, ::-1]))
            if other
            else of_shape
            for of_shape, other in zip(points, mirrored, strict=True)
        ]
        with timed("registered meshes", self.seconds):
            registered = self._register(meshes, chosen, points, stiffness)
        return Collection(
            meshes=tuple(meshes),
            template=chosen,
            points=tuple(points),
            mirrored=mirrored,
            registered=tuple(registered),
            edges=tuple(described),
            axes=self.axes,
            cycle_errors=(first_cycles, self.cycles),
            outliers=find_outliers(
                {(edge.source, edge.target): edge.estimated_error for edge in described},
                self.settings.outlier_from,
            ),
            left_out=self.left_out,
            seconds=self.seconds,
        )

    @property
    def meshes(self) -> list[Mesh]:
        """The matched meshes: mirror images for shapes of the other hand."""
        return [shape.mesh for shape in self.shapes]

    def _prepare(self) -> list[int]:
        """Prepare all shapes, and return the numbers of the shapes that can be matched."""
        eigensolver = choose_eigensolver(*self.given) if self.given else "exact"
        self.shapes: list[PreparedShape] = []
        kept = []
        for number, mesh in enumerate(self.given):
            try:
                self.shapes.append(prepare_shape(mesh, self.preset, eigensolver=eigensolver))
                kept.append(number)
            except (InputError, ArithmeticError) as error:
                self.left_out[mesh.name] = str(error)
                logger.warning("%s is left out: %s", mesh.name, error)
            self.progress("shapes", number + 1, len(self.given))
        return kept

    def _compare_hands(self) -> dict[Edge, Decision]:
        """Compare the hands along the edges of a sparse graph, if the first comparisons show asymmetry."""
        edges = choose_edges(shape_distances(self.shapes), edges_per_shape=_HANDS_PER_SHAPE, seed=self.seed)
        first = edges[:: max(1, len(edges) // _FIRST_HANDS)][:_FIRST_HANDS]
        decisions = {edge: self._hand(edge) for edge in first}
        if not any(decision.asymmetric for decision in decisions.values()):
            return decisions
        for number, edge in enumerate(edges):
            if edge not in decisions:
                decisions[edge] = self._hand(edge)
            self.progress("hands", number + 1, len(edges))
        return decisions

    def _hand(self, edge: Edge) -> Decision:
        i, j = edge

        def compute() -> dict[str, np.ndarray]:
            found = compare_hands(self.shapes[i], self.shapes[j])
            evidence = np.nan if found.evidence is None else found.evidence
            return {"decision": np.array([found.mirrored, evidence, found.doubtful, found.asymmetric], float)}

        arrays = self._stored("hand", (*self._key(i), *self._key(j)), compute)
        mirrored, evidence, doubtful, asymmetric = arrays["decision"].tolist()
        return Decision(
            bool(mirrored), None if np.isnan(evidence) else evidence, bool(doubtful), bool(asymmetric)
        )

    def _mirror(self, mirrored: Bool[np.ndarray, " N"]) -> None:
        for number in np.flatnonzero(mirrored).tolist():
            shape = self.shapes[number]
            self.shapes[number] = replace(
                shape, mesh=shape.mesh.mirrored(), spectrum=shape.spectrum.reflect()
            )

    def _describe(self) -> None:
        """Add descriptors along common axes. The axes are kept, so that added meshes change no edge."""
        self.axes: DescriptorAxes | None = None
        if not self.preset.number_of_descriptors:
            return

        def compute() -> dict[str, np.ndarray]:
            axes = descriptor_axes(self.shapes, self.preset)
            return {
                "radii": np.array(axes.radii),
                "mean": axes.principal.mean,
                "axes": axes.principal.axes,
            }

        arrays = self._stored("descriptor-axes", _preset_key(self.preset), compute)
        self.axes = DescriptorAxes(
            tuple(arrays["radii"].tolist()), PrincipalAxes(arrays["mean"], arrays["axes"])
        )
        self.shapes = [describe_shape(shape, self.axes) for shape in self.shapes]

    def _edges(self) -> list[Edge]:
        """Choose the edges. Edges between shapes of an earlier call with the same directory are kept."""
        names = [mesh.name for mesh in self.meshes]
        settings = self.settings
        inputs = (repr(settings.edges_per_shape), settings.random_share, self.seed)
        stored = None if self.store is None else self.store.load("graph", inputs)
        given: list[Edge] = []
        if stored is not None:
            row = {name: number for number, name in enumerate(names)}
            pairs = [(row.get(a), row.get(b)) for a, b in stored["edges"].reshape(-1, 2).tolist()]
            given = [(min(a, b), max(a, b)) for a, b in pairs if a is not None and b is not None]
        edges = choose_edges(
            shape_distances(self.shapes),
            edges_per_shape=settings.edges_per_shape,
            random_share=settings.random_share,
            given=given,
            seed=self.seed,
        )
        if self.store is not None:
            listed = np.array([[names[i], names[j]] for i, j in edges])
            self.store.save("graph", inputs, {"edges": listed})
        return edges

    def _stored(
        self, kind: str, inputs: tuple[Any, ...], compute: Callable[[], dict[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Return a result of an earlier call with the same directory, or compute and keep it."""
        found = None if self.store is None else self.store.load(kind, inputs)
        if found is None:
            found = compute()
            if self.store is not None:
                self.store.save(kind, inputs, found)
        return found

    def _key(self, number: int) -> tuple[Any, ...]:
        mesh = self.shapes[number].mesh
        return mesh.vertices, mesh.faces, self.preset.number_of_eigenvectors

    def _edge_key(self, edge: Edge, init: Int64[np.ndarray, " m"] | None) -> tuple[Any, ...]:
        axes = () if self.axes is None else (self.axes.principal.axes,)
        first = "shot" if init is None else init
        keys = (*self._key(edge[0]), *self._key(edge[1]))
        return (*keys, *axes, *_preset_key(self.preset), str(self.aligned), first)

    def _match(
        self, inits: Mapping[Edge, Int64[np.ndarray, " m"] | None], step: str
    ) -> Iterator[tuple[Edge, EdgeMap]]:
        """Match edges from given initial maps, or from `"shot"`. Edges whose match fails are left out."""
        missing: dict[Edge, Int64[np.ndarray, " m"] | None] = {}
        for edge, init in inits.items():
            stored = None if self.store is None else self.store.load("edge", self._edge_key(edge, init))
            if stored is None:
                missing[edge] = init
            else:
                yield edge, EdgeMap.from_arrays(stored)
        done = len(inits) - len(missing)
        self.progress(step, done, len(inits))
        for edge, found in self._matched(missing):
            done += 1
            self.progress(step, done, len(inits))
            if isinstance(found, BaseException):
                if not isinstance(found, InputError | ArithmeticError):
                    raise found
                logger.warning("%s", found)
                continue
            if self.store is not None:
                self.store.save("edge", self._edge_key(edge, inits[edge]), found.arrays())
            yield edge, found

    def _matched(
        self, inits: Mapping[Edge, Int64[np.ndarray, " m"] | None]
    ) -> Iterator[tuple[Edge, EdgeMap | BaseException]]:
        if self.executor is None:
            tasks = (
                EdgeTask(self.shapes[i], self.shapes[j], init, self.aligned) for (i, j), init in inits.items()
            )
            yield from zip(inits, match_edges(tasks, self.preset, self.devices), strict=True)
            return
        place = TemporaryDirectory() if self.store is None else nullcontext(self.store.directory)
        with place as directory:
            store = Store(Path(directory))
            keys = self._save_shapes(store, inits)
            edges = {f"{i} {j}": (i, j) for i, j in inits}
            stored = {
                name: _StoredTask(
                    store.directory.resolve(),
                    (keys[i], keys[j]),
                    (self.meshes[i].name, self.meshes[j].name),
                    self.preset,
                    inits[i, j],
                    self.aligned,
                )
                for name, (i, j) in edges.items()
            }
            for name, found in run_tasks(_match_stored, stored, self.executor):
                yield edges[name], found

    def _save_shapes(self, store: Store, edges: Iterable[Edge]) -> dict[int, tuple[str, ...]]:
        """Save the prepared shapes of edges for workers, and return their keys."""
        keys: dict[int, tuple[str, ...]] = {}
        for number in sorted({shape for edge in edges for shape in edge}):
            arrays = self.shapes[number].arrays()
            digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays.values()))
            keys[number] = (digest.hexdigest(),)
            if store.load("shape", keys[number]) is None:
                store.save("shape", keys[number], arrays)
        return keys

    def _check_connected(self) -> None:
        """Check that the matched edges connect all shapes.

        **Raises:** `ArithmeticError` if not. The message names the shapes that most shapes cannot reach.
        """
        component = connected_components(np.array(list(self.maps)).reshape(-1, 2), len(self.shapes))[1]
        largest = np.bincount(component).argmax()
        if (apart := np.flatnonzero(component != largest)).size:
            names = ", ".join(self.meshes[number].name for number in apart)
            raise ArithmeticError(
                f"the matches of these meshes with all other meshes failed numerically: {names}. Repair "
                "these meshes, or leave them out."
            )

    def _synchronize(self, template: int | None) -> tuple[Network, int, list[SurfacePoints]]:
        """Estimate the errors of all edges from cycles, choose the template, and synchronise the maps."""
        edges = list(self.maps)
        meshes, units = self.meshes, [mesh.area**0.5 for mesh in self.meshes]
        points = _both_directions(self.maps)
        vertex_maps = {(i, j): found.nearest_corners(meshes[j]) for (i, j), found in points.items()}
        prior = np.array([found.expected_error for found in self.maps.values()])
        prior += self.settings.distortion_weight * self._distortions()
        estimated, self.cycles, _ = estimate_edge_errors(
            edges,
            vertex_maps,
            [mesh.vertices / unit for mesh, unit in zip(meshes, units, strict=True)],
            [self._cycle_samples(number) for number in range(len(meshes))],
            prior,
        )
        # A small cycle error can arise by chance, so the error of a map is at least half of its prior. Wrong
        # maps can be consistent with each other. Their distortions are then larger.
        errors = np.maximum(estimated, prior / 2) + self.settings.distortion_weight * self._distortions()
        network = Network(
            meshes, points, dict(zip(edges, errors.tolist(), strict=True)), self.settings.synchronization
        )
        chosen = network.medoid() if template is None else template
        return network, chosen, synchronize(network, chosen)

    def _distortions(self) -> Float64[np.ndarray, " e"]:
        """Return the squared logarithm of the distortion of each edge's map; zero for isometries."""
        return np.log([max(found.distortion, 1.0) for found in self.maps.values()]) ** 2

    def _cycle_samples(self, number: int) -> Int64[np.ndarray, " s"]:
        samples = self.shapes[number].samples
        mesh = self.shapes[number].mesh
        if samples is None:
            used = np.flatnonzero(mesh.referenced_vertices)
            return used[:: max(1, len(used) // self.settings.cycle_samples)]
        return np.asarray(samples, np.int64)[: self.settings.cycle_samples]

    def _contradicted(
        self, edges: Iterable[Edge], network: Network, points: Sequence[SurfacePoints]
    ) -> list[Edge]:
        """Return the edges whose match failed or whose maps contradict the consistent maps."""
        limit = self.settings.contradicted_from
        return [
            (i, j)
            for i, j in edges
            if (i, j) not in self.maps or self._residual(network, points, i, j) >= limit
        ]

    @staticmethod
    def _residual(network: Network, points: Sequence[SurfacePoints], i: int, j: int) -> float:
        return max(network.residual(points, i, j), network.residual(points, j, i))

    def _through(
        self, template: int, points: Sequence[SurfacePoints], i: int, j: int
    ) -> Int64[np.ndarray, " m"]:
        meshes = self.meshes
        return vertex_map_between(points[i], points[j], meshes[template], meshes[i], meshes[j])

    def _better(
        self, again: Mapping[Edge, EdgeMap], network: Network, points: Sequence[SurfacePoints]
    ) -> dict[Edge, EdgeMap]:
        """Return the new maps that are closer to the consistent maps than the old, and not more distorted.

        If the consistent map is wrong, a new map that follows it has a larger distortion than the old map.
        """
        better = {}
        errors = {edge: found.expected_error for edge, found in again.items()}
        new = Network(self.meshes, _both_directions(again), errors, network.settings)
        for (i, j), found in again.items():
            before = self._residual(network, points, i, j) if (i, j) in self.maps else np.inf
            now = self._residual(new, points, i, j)
            old = self.maps[i, j].distortion if (i, j) in self.maps else np.inf
            if now < before and found.distortion <= old * self.settings.distortion_tolerance:
                better[i, j] = found
        return better

    def _register(
        self, meshes: Sequence[Mesh], template: int, points: Sequence[SurfacePoints], stiffness: float
    ) -> list[RegisteredMesh]:
        registered = []
        for number, (mesh, known) in enumerate(zip(meshes, points, strict=True)):
            registered.append(register_mesh(meshes[template], mesh, known, stiffness=stiffness))
            self.progress("registered meshes", number + 1, len(points))
        return registered

    def _describe_edge(
        self, edge: Edge, network: Network, points: Sequence[SurfacePoints], replaced: set[Edge]
    ) -> MatchedEdge:
        if edge not in self.maps:
            return MatchedEdge(*edge, np.inf, np.inf, np.inf, np.inf, "contradicted", True)
        found, residual = self.maps[edge], self._residual(network, points, *edge)
        wrong = residual >= self.settings.contradicted_from
        decision = "contradicted" if wrong else "replaced" if edge in replaced else "kept"
        error = network.error(*edge)
        doubtful = wrong or error >= self.settings.outlier_from
        return MatchedEdge(*edge, found.expected_error, found.distortion, error, residual, decision, doubtful)


def _preset_key(preset: Preset) -> tuple[Any, ...]:
    """Return a preset as a part of a key of `Store`: its text, and the arrays that its text abbreviates."""
    refiners = [stage.refiner for stage in preset.stages]
    return repr(preset), *(np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(refiners, eqx.is_array)))


def _both_directions(maps: Mapping[Edge, EdgeMap]) -> dict[tuple[int, int], SurfacePoints]:
    """Return the maps of all edges (i, j) with the keys (i, j) and (j, i)."""
    forward = {edge: found.forward for edge, found in maps.items()}
    return forward | {(j, i): found.backward for (i, j), found in maps.items()}


# The number of pairs whose hands are compared, divided by the number of shapes.
_HANDS_PER_SHAPE = 1.5
# The number of pairs whose hands are compared first. If none of these pairs is asymmetric, as with bodies,
# no further hands are compared.
_FIRST_HANDS = 5
