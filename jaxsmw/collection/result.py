"""The result of `match_collection`: the consistent maps, the registered meshes and the graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxsmw.collection.shape_models import ShapeModel, shape_model
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.descriptors import DescriptorAxes
from jaxsmw.transfer.registered_mesh import RegisteredMesh, register_mesh
from jaxsmw.wording import count_of

# If the share of outliers is larger than this, the maps are probably wrong.
_MANY_OUTLIERS = 1 / 3


@dataclass(frozen=True)
class MatchedEdge:
    """An edge of the graph of a collection: a matched pair of shapes, and the errors of the map between them.

    Each distance is divided by the square root of the area of the shape on which it is measured. Errors and
    residuals therefore have no unit.

    **Attributes:**

    - `source`, `target`: the 0-based numbers of the two shapes in `Collection.meshes`, as integers.
    - `expected_error`: the mean expected error of the map, computed without the other maps; infinite if the
      match failed. The distances are measured on the target.
    - `distortion`: the distortion of the map (`jaxsmw.matching.judge.distortion`), a number of at least 1
      without unit. The distortion is 1 for isometries, larger for worse maps, and infinite if the match
      failed.
    - `estimated_error`: an estimate of the error of the map, which determines the weight of the map. The
      estimate is `penalty + max(cycle_error, (expected_error + penalty) / 2)`. The penalty is twice
      the squared logarithm of the distortion. The cycle error is estimated from the cycles of the graph
      (`edge_errors`). The estimate is infinite if the match failed.
    - `residual`: the mean distance between this map and the consistent map, which goes through the template.
      The mean is at most 0.5. The mean is also computed for the reverse map, and the residual is the larger
      mean. If the match failed, the residual is infinite.
    - `decision`: `"kept"`, `"replaced"` or `"contradicted"`. `"replaced"` means that the first map
      contradicted the other maps, and a second match, started from the consistent map, replaced it.
      `"contradicted"` means that the map contradicts the other maps and has little weight, or that the match
      failed.
    - `doubtful`: whether the map contradicts the other maps, or its estimated error is at least 0.1.
    """

    source: int
    target: int
    expected_error: float
    distortion: float
    estimated_error: float
    residual: float
    decision: str
    doubtful: bool

    def sentence(self, names: Sequence[str]) -> str:
        """Return a sentence about the edge, given the names of all shapes."""
        errors = (
            f"expected error {1e3 * self.expected_error:.0f}, estimated error "
            f"{1e3 * self.estimated_error:.0f}, "
            f"distance from the consistent map {1e3 * self.residual:.0f} thousandths"
        )
        return f"{names[self.source]} to {names[self.target]}: {self.decision} ({errors})"


@dataclass(frozen=True, eq=False)
class Collection:
    """The result of `match_collection`: consistent maps between all shapes of a collection.

    The number of a shape is its 0-based position in `meshes`, which contains only the meshes that were
    matched. The methods raise `InputError` if a number is not the number of a shape.

    **Attributes:**

    - `meshes`: the meshes of the N shapes, each a `Mesh` in its own unit of length.
    - `template`: the number of the template, which has n vertices.
    - `points`: for each shape, one `SurfacePoints` on its mesh, with an entry per vertex of the template.
    - `mirrored`: a mask (N,), True for the shapes whose mirror images were matched, such as right teeth among
      left teeth. All points and positions refer to the meshes, not to the mirror images.
    - `registered`: for each shape, the `RegisteredMesh` of the template on the shape.
    - `edges`: the matched pairs, each a `MatchedEdge`.
    - `cycle_errors`: the errors of all triangles of the graph, of the first maps (c,) and of the final maps
      (d,). Each error is the mean over the three shapes, in units of the square root of their areas.
    - `axes`: the `DescriptorAxes` of the descriptors; None if the preset uses no descriptors.
    - `outliers`: the numbers of the shapes whose maps all have large errors or distortions. Such a shape may
      be another kind of body.
    - `left_out`: the reasons why meshes could not be matched, by the names of the meshes.
    - `seconds`: the wall time of each step in seconds, by the name of the step.
    """

    meshes: tuple[Mesh, ...]
    template: int
    points: tuple[SurfacePoints, ...]
    mirrored: Bool[np.ndarray, " N"]
    registered: tuple[RegisteredMesh, ...]
    edges: tuple[MatchedEdge, ...]
    cycle_errors: tuple[Float64[np.ndarray, " c"], Float64[np.ndarray, " d"]]
    axes: DescriptorAxes | None = None
    outliers: tuple[int, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        wrong = sum(edge.decision == "contradicted" for edge in self.edges)
        return (
            f"Collection({len(self.meshes)} shapes, template {self.names[self.template]}, "
            f"{len(self.edges)} edges, {wrong} contradicted)"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the shapes."""
        return tuple(mesh.name for mesh in self.meshes)

    def sentences(self) -> tuple[str, ...]:
        """Return all `decisions`, and sentences about outliers and about meshes that were left out."""
        warning = [self.warning] if self.warning else []
        left_out = [f"Left out: {name} ({reason})" for name, reason in self.left_out.items()]
        return (*self.decisions(), *warning, *left_out)

    def decisions(self) -> tuple[str, ...]:
        """Return sentences about the template, the edges, the registered meshes and mirrored shapes."""
        decisions = Counter(edge.decision for edge in self.edges)
        sentences = [
            f"{count_of(len(self.meshes), 'shape')}, {count_of(len(self.edges), 'matched pair')}; the "
            f"template is {self.names[self.template]}."
        ]
        if len(self.cycle_errors[0]):
            sentences.append(
                f"Maps that agree with the other maps: {decisions['kept']}. Wrong maps that were replaced: "
                f"{decisions['replaced']}. Maps that still contradict the others and hardly count: "
                f"{decisions['contradicted']}."
            )
        else:
            sentences.append("The graph has no cycles, so no map could be compared with other maps.")
        distance = np.mean([mesh.distances.mean() / np.sqrt(mesh.mesh_y.area) for mesh in self.registered])
        flipped = [float(mesh.flipped_faces.mean()) for mesh in self.registered]
        sentences.append(
            f"Registered meshes: the mean distance to the meshes is {distance:.2%} of the square root of the "
            f"area. Flipped triangles: {np.mean(flipped):.2%} in the mean, at most {max(flipped):.2%} "
            f"({self.names[int(np.argmax(flipped))]})."
        )
        if self.mirrored.any():
            names = ", ".join(name for name, other in zip(self.names, self.mirrored, strict=True) if other)
            sentences.append(f"Of the other hand, so that their mirror images were matched: {names}.")
        return tuple(sentences)

    @property
    def warning(self) -> str:
        """A sentence about the outliers; an empty text if there are none."""
        if not self.outliers:
            return ""
        names = ", ".join(self.names[shape] for shape in self.outliers)
        if len(self.outliers) > _MANY_OUTLIERS * len(self.meshes):
            return (
                f"No good map was found for {len(self.outliers)} of {len(self.meshes)} shapes: {names}. Look "
                "at their colours. The preset accurate matches different bodies best, and all meshes must be "
                "of one kind of body."
            )
        return (
            f"These shapes differ much from all others, so their maps are uncertain: {names}. Look at their "
            "colours, and leave out other kinds of bodies."
        )

    def _check_number(self, *shapes: int) -> None:
        for shape in shapes:
            if not 0 <= shape < len(self.meshes):
                raise InputError(
                    f"there is no shape {shape}: give a number from 0 to {len(self.meshes) - 1}, in the "
                    "order of `Collection.names`."
                )

    def from_template(self, shape: int) -> Int64[np.ndarray, " n"]:
        """Return the map from the template to a shape, as 0-based vertices of the shape (n,)."""
        self._check_number(shape)
        return self.registered[shape].surface_points.nearest_corners(self.meshes[shape])

    def to_template(self, shape: int) -> Int64[np.ndarray, " m"]:
        """Return the map from a shape (m vertices) to the template, as 0-based template vertices (m,)."""
        self._check_number(shape)
        return self.registered[shape].points_of_target.nearest_corners(self.meshes[self.template])

    def pointwise_map(self, source: int, target: int) -> Int64[np.ndarray, " m"]:
        """Return the map from `source` (m vertices) to `target`, as 0-based vertices of `target` (m,).

        The map goes through the template, so a vertex that is carried around a cycle returns to itself, up
        to the rounding to vertices.
        """
        self._check_number(source, target)
        return self._surface_points(source, target).nearest_corners(self.meshes[target])

    def _surface_points(self, source: int, target: int) -> SurfacePoints:
        return self.registered[target].project(self.registered[source].points_of_target)

    def registered_mesh(self, source: int, target: int) -> RegisteredMesh:
        """Register one shape on another, by the map through the template; see `register_mesh`.

        The positions are in the unit of `target`. With the registered mesh, `jaxsmw.transfer` transfers
        landmarks and attributes from `source` to `target`.
        """
        self._check_number(source, target)
        if source == self.template:
            return self.registered[target]
        points = self._surface_points(source, target)
        return register_mesh(self.meshes[source], self.meshes[target], points)

    @property
    def signs(self) -> Float64[np.ndarray, "N 3"]:
        """The factors (N, 3) of the coordinates in the shape model; -1 for x if a shape is mirrored there."""
        other_hand = self.mirrored != self.mirrored[self.template]
        return np.where(other_hand[:, None], [-1.0, 1.0, 1.0], 1.0)

    def shape_model(self, *, scale: bool = False, number_of_modes: int | None = None) -> ShapeModel:
        """Compute the mean and the modes of the registered meshes; see `jaxsmw.collection.shape_model`.

        The weight of each vertex is its vertex area on the template. Shapes of the other hand than the
        template enter the model as mirror images. If the meshes have different units, `scale` must be True.
        """
        return shape_model(
            [mesh.vertices * sign for mesh, sign in zip(self.registered, self.signs, strict=True)],
            scale=scale,
            weights=self.meshes[self.template].vertex_areas,
            reference=self.template,
            number_of_modes=number_of_modes,
        )
