"""The function `match_collection`, which matches all shapes of a collection consistently."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxsmw.choices import DEFAULT_MIRROR, DEFAULT_PRESET, EDGES_PER_SHAPE, MirrorCollection
from jaxsmw.collection.consistency import Edge, find_outliers
from jaxsmw.collection.consistent_maps import OUTLIER_FROM, ConsistentMaps
from jaxsmw.collection.edges import EdgeMap, EdgeMatcher
from jaxsmw.collection.graph import extended_graph
from jaxsmw.collection.hands import choose_hands, compare_hands
from jaxsmw.collection.result import Collection
from jaxsmw.collection.shapes import describe_shapes, prepare_usable_shapes
from jaxsmw.errors import InputError, check_choice, check_number, check_whole_number
from jaxsmw.geometry.eigenbasis import choose_eigensolver
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh, connected_components
from jaxsmw.geometry.shortcuts import points_on_uncut
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.shape import PreparedShape
from jaxsmw.matching.stages import Preset, PresetName, choose_preset
from jaxsmw.runtime.backends import Device, check_devices
from jaxsmw.runtime.cache import Store
from jaxsmw.runtime.progress import Progress, no_progress, timed
from jaxsmw.transfer.registered_mesh import DEFAULT_STIFFNESS, register_mesh

# The largest number of times that contradicted edges are matched again.
_ROUNDS = 2


def match_collection(
    meshes: Sequence[Mesh | MeshLike],
    *,
    names: Sequence[str] | None = None,
    preset: PresetName | Preset = DEFAULT_PRESET,
    template: int | None = None,
    mirror: MirrorCollection | Sequence[bool] = DEFAULT_MIRROR,
    stiffness: float = DEFAULT_STIFFNESS,
    edges_per_shape: float | int = EDGES_PER_SHAPE,
    seed: int = 0,
    directory: Path | str | None = None,
    executor: Executor | None = None,
    devices: Sequence[Device] | None = None,
    progress: Progress | None = None,
) -> Collection:
    """Match all shapes of a collection, such that the maps of all pairs agree.

    Only some pairs are matched, a few for each shape. These pairs are the edges of a graph, whose nodes are
    the shapes. Cycles of the graph show which maps are wrong. One shape is the template. Each map
    from the template to another shape is a robust mean of estimates from several edges. If the map of an edge
    contradicts these means, the edge is matched again from the map through the template.

    **Arguments:**

    - `meshes`: at least two meshes of the same kind of body, in any poses, units and triangulations. Each is
      a `Mesh`, or a mesh that `make_mesh` accepts.
    - `names`: the new names of the meshes, all different. By default, the meshes keep their names. If two of
      their names are equal, a number is appended to the name of each mesh.
    - `preset`: `"accurate"` (the default), `"fast"`, `"paper"` or a `Preset`; see `match`.
    - `template`: the 0-based position of the template in the argument `meshes`. The default is the shape with
      the smallest sum of errors along the best paths to all other shapes (the medoid).
    - `mirror`: `"auto"` (the default) recognises shapes of opposite hands, such as left and right teeth, and
      matches their mirror images. `"no"` matches all meshes as they are. You can also give a sequence with
      one Boolean per mesh: True for each mesh whose mirror image is matched. Thin shapes, such as left and
      right jaws, need such a sequence.
    - `stiffness`: the stiffness of the registered meshes, a positive length in units of the square root of
      each shape's area; see `register_mesh`.
    - `edges_per_shape`: the number of matched pairs divided by the number of shapes. More pairs cost time,
      but hardly improve the maps beyond the default of 4.
    - `seed`: the seed of the random edges of the graph, an integer of at least 0.
    - `directory`: an existing directory in which finished steps are kept. A second call with the same
      directory continues an interrupted call. If the second call has additional meshes, only edges of the
      additional meshes are matched.
    - `executor`: an executor that matches edges, for example `jaxsmw.runtime.workers.open_executor`. By
      default, edges are matched in this process.
    - `devices`: the JAX devices that match edges in this process; see `match_pairs`. The default is all
      devices of the default backend.
    - `progress`: a function that is called after each part of a step. Its arguments are the name of the step,
      the number of finished parts, and the number of all parts.

    **Returns:** A `Collection`. Meshes that cannot be matched are left out and named in `left_out`. The
    result identifies each shape by its 0-based position in `Collection.meshes`, the list of the kept meshes.

    **Raises:** `InputError` if an argument is not valid, if fewer than two meshes can be matched, or if the
    template is left out.
    `ArithmeticError` if all matches of a mesh fail numerically.
    """
    if names is not None and (len(names) != len(meshes) or len(set(names)) != len(names)):
        raise InputError(
            f"there are {len(set(names))} different names for {len(meshes)} meshes: give each mesh a name of "
            "its own."
        )
    if isinstance(mirror, str):
        check_choice(mirror, MirrorCollection, "a mirror setting of a collection")
    elif len(mirror) != len(meshes):
        raise InputError(
            f"mirror has {len(mirror)} entries for {len(meshes)} meshes: give one Boolean for each mesh."
        )
    if template is not None:
        template = check_whole_number("template", template, 0, len(meshes) - 1)
    check_number("stiffness", stiffness, positive=True)
    check_number("edges_per_shape", edges_per_shape, positive=True)
    seed = check_whole_number("seed", seed, 0)
    check_devices(devices)
    if directory is not None and not Path(directory).is_dir():
        raise InputError(f"{directory}: is not a directory: create it first.")
    named = _named_meshes(meshes, names)
    preset, report = choose_preset(preset), progress or no_progress
    store = Store(None if directory is None else Path(directory))
    eigensolver = choose_eigensolver(*named) if named else "exact"
    seconds: dict[str, float] = {}
    with timed("shapes", seconds):
        usable, left_out = prepare_usable_shapes(named, preset, eigensolver, report)
    _check_usable(named, usable, left_out, template)
    kept, shapes = [named[number] for number in usable], list(usable.values())
    with timed("hands", seconds):
        if mirror == "no":
            mirrored = np.zeros(len(shapes), bool)
        elif mirror == "auto":
            evidence = compare_hands(shapes, preset, eigensolver, seed=seed, store=store, progress=report)
            mirrored = choose_hands(len(shapes), evidence)
        else:
            mirrored = np.array([bool(mirror[number]) for number in usable])
        shapes = [s.mirrored() if other else s for s, other in zip(shapes, mirrored, strict=True)]
    with timed("descriptors", seconds):
        shapes, axes = describe_shapes(shapes, preset, store)
    with timed("graph", seconds):
        edges = extended_graph(shapes, edges_per_shape, seed=seed, store=store)
    matcher = EdgeMatcher(shapes, axes, preset, eigensolver, store, executor, devices, report)
    with timed("edges", seconds):
        maps = matcher.match(dict.fromkeys(edges), "edges")
        _check_connected(maps, shapes)
    with timed("synchronization", seconds):
        first = ConsistentMaps.of(shapes, maps)
        consistent, replaced = _match_contradicted(first, edges, matcher)
        if template is not None:
            consistent = consistent.through(list(usable).index(template))
    points = [
        points_on_uncut(_reflected(of_shape) if other else of_shape, shape.mesh, mesh)
        for of_shape, other, shape, mesh in zip(consistent.points, mirrored, shapes, kept, strict=True)
    ]
    registered = []
    with timed("registered meshes", seconds):
        for mesh, of_shape in zip(kept, points, strict=True):
            registered.append(register_mesh(kept[consistent.template], mesh, of_shape, stiffness=stiffness))
            report("registered meshes", len(registered), len(points))
    described = [consistent.matched_edge(edge, replaced) for edge in edges]
    errors = {(edge.source, edge.target): edge.estimated_error for edge in described}
    return Collection(
        meshes=tuple(kept),
        template=consistent.template,
        points=tuple(points),
        mirrored=mirrored,
        registered=tuple(registered),
        edges=tuple(described),
        axes=axes,
        cycle_errors=(first.cycle_errors, consistent.cycle_errors),
        outliers=find_outliers(errors, OUTLIER_FROM),
        left_out=left_out,
        seconds=seconds,
    )


def _named_meshes(meshes: Sequence[Mesh | MeshLike], names: Sequence[str] | None) -> list[Mesh]:
    """Convert the meshes with `as_mesh`, and give each mesh a different name."""
    if names is not None:
        return [replace(as_mesh(mesh, name), name=name) for mesh, name in zip(meshes, names, strict=True)]
    named = [as_mesh(mesh, f"mesh {number}") for number, mesh in enumerate(meshes)]
    if len({mesh.name for mesh in named}) < len(named):
        named = [replace(mesh, name=f"{mesh.name} {number}") for number, mesh in enumerate(named)]
    return named


def _check_usable(
    meshes: Sequence[Mesh],
    usable: Mapping[int, PreparedShape],
    left_out: Mapping[str, str],
    template: int | None,
) -> None:
    """Raise `InputError` if fewer than two meshes or not the template can be matched."""
    if len(usable) < 2:
        raise InputError(
            f"a collection needs at least two meshes, but only {len(usable)} of {len(meshes)} "
            "can be matched. " + " ".join(f"{name}: {reason}" for name, reason in left_out.items())
        )
    if template is not None and template not in usable:
        raise InputError(f"the template {meshes[template].name} cannot be matched: choose another.")


def _check_connected(maps: Mapping[Edge, EdgeMap], shapes: Sequence[PreparedShape]) -> None:
    """Raise `ArithmeticError` if the matched edges do not connect all shapes."""
    component = connected_components(np.array(list(maps)).reshape(-1, 2), len(shapes))[1]
    largest = np.bincount(component).argmax()
    if (apart := np.flatnonzero(component != largest)).size:
        names = ", ".join(shapes[number].mesh.name for number in apart.tolist())
        raise ArithmeticError(
            f"the matches of these meshes with all other meshes failed numerically: {names}. Repair "
            "these meshes, or leave them out."
        )


def _match_contradicted(
    consistent: ConsistentMaps, edges: Sequence[Edge], matcher: EdgeMatcher
) -> tuple[ConsistentMaps, set[Edge]]:
    """Repeat the match of each edge that contradicts the consistent maps, and synchronise all maps again.

    **Returns:** The final consistent maps, and the edges whose maps were replaced.
    """
    replaced: set[Edge] = set()
    for _ in range(_ROUNDS):
        wrong = consistent.contradicted(edges)
        if not wrong:
            break
        inits = {(i, j): consistent.vertex_map(i, j) for i, j in wrong}
        better = consistent.improvements(matcher.match(inits, "contradicted edges"))
        if not better:
            break
        replaced |= set(better)
        consistent = ConsistentMaps.of(matcher.shapes, {**consistent.maps, **better})
    return consistent, replaced


def _reflected(points: SurfacePoints) -> SurfacePoints:
    """Return points on a mesh, given the points on its mirror image, whose corners have the reverse order."""
    return SurfacePoints(points.faces, np.ascontiguousarray(points.weights[:, ::-1]))
