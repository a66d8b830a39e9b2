"""Completes a mesh that is a part of a body, or has holes, by a shape model."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxsmw.choices import DEFAULT_PRESET
from jaxsmw.collection.conditioning import Family, Posterior
from jaxsmw.collection.shape_models import ShapeModel, modes_of
from jaxsmw.errors import InputError, WrongMapWarning
from jaxsmw.geometry.alignment import rigid_fit
from jaxsmw.geometry.eigenbasis import eigenpairs
from jaxsmw.geometry.mesh import Mesh, MeshLike, as_mesh, make_mesh
from jaxsmw.geometry.surface_distance import nearest_facing_points, nearest_surface_points
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.matching.match import match
from jaxsmw.matching.stages import Preset, PresetName
from jaxsmw.wording import percentage

# The number of smooth functions for what the modes leave out, at most a tenth of the vertices. (Entry R52)
_FUNCTIONS = 40
# The number of rounds that align the part and find the nearest points on the part. (Entry R52)
_ROUNDS = 3
# With fewer shapes, no shape can be left out to estimate what a model of the others leaves out.
_FEWEST_SHAPES = 3
# The fewest observed vertices that determine the position of a part.
_FEWEST_OBSERVED = 10
# A closed part probably has a lid if this share of the model's area has no counterpart on it.
_LID = 0.02
# A point lies on an edge if one barycentric weight is smaller.
_ON_EDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Completion:
    """The result of `complete_mesh`: a whole mesh, and how certain each of its vertices is.

    **Attributes:**

    - `mesh`: the completed `Mesh`, in the coordinates and the unit of the part, with the triangulation of the
      model. Its vertices (n, 3) are the posterior mean.
    - `posterior`: the `Posterior` of the vertices, in the same coordinates and unit.
    - `observed`: a mask (n,), True for the vertices of the model that the part shows.
    - `noise`: the standard deviation of the noise of each observed coordinate, in the unit of the part.
    - `probability`: the probability, from 0 to 1, that the map of the part to the model is right as a whole.
    - `calibration`: the factor of all standard deviations. With this factor, the radii hold 90 % of the
      hidden vertices of shapes of the collection, each completed by a model of the other shapes.
    """

    mesh: Mesh
    posterior: Posterior
    observed: Bool[np.ndarray, " n"]
    noise: float
    probability: float
    calibration: float

    def __repr__(self) -> str:
        share = self.observed.mean()
        return f"Completion({len(self.observed)} vertices, {share:.0%} observed)"

    @property
    def standard_deviation(self) -> Float64[np.ndarray, " n"]:
        """The posterior standard deviation of each vertex (n,), in the unit of the part."""
        return self.posterior.standard_deviation


def complete_mesh(
    part: Mesh | MeshLike,
    model: ShapeModel,
    faces: Int[np.ndarray, "f 3"] | ArrayLike,
    *,
    preset: PresetName | Preset = DEFAULT_PRESET,
) -> Completion:
    """Complete a mesh that is a part of a body, or has holes, by a shape model.

    The part is matched to the mean shape, which shows which vertices of the model are observed, and where.
    The shape model becomes a normal distribution of shapes, which is conditioned on the observed positions
    (`jaxsmw.collection.GaussianModel`). Its factors are the modes, and smooth functions on the mean shape for
    what the modes leave out. Rounds of this step alternate with a rigid alignment of the part, and with a
    search for the nearest points on the part. The position of the part is uncertain as well, and its
    uncertainty is part of the posterior.

    The function issues a `WrongMapWarning` if the map of the part is probably wrong as a whole, and a
    `UserWarning` if the part is a closed surface although the body goes on.

    No parameter is chosen by hand: the variances, the noise and the calibration are estimated by leaving out
    one shape of the collection at a time.

    **Arguments:**

    - `part`: the mesh to complete, a `Mesh` or a mesh that `make_mesh` accepts. Its surface must end where
      the body is missing. It needs the unit of length of the model, unless the model removed differences of
      size. A part of the other hand must be mirrored first.
    - `model`: the `ShapeModel` of at least three shapes, such as the result of `Collection.shape_model` or
      `read_shape_model`. All its modes are used, even if the model has been cut to fewer modes.
    - `faces`: the triangles of the model (f, 3), 0-based.
    - `preset`: the method of matching; see `jaxsmw.match`.

    **Returns:** A `Completion`.

    **Raises:** `InputError` if the part or the faces cannot be used, if the model has fewer than three shapes
    or no variation, or if the part shows fewer than ten vertices of the model.
    """
    part = as_mesh(part, "part")
    mean = make_mesh(model.mean, faces, name="mean shape")
    whole = _check_model(model)
    scaled = model.alignment.scaled
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", WrongMapWarning)  # its advice is for two meshes
        correspondence = match(
            part, mean, preset=preset, partial=True, mirror="no", scale="unknown" if scaled else 1.0
        )
    if correspondence.suspicious:
        unit = "the hand" if scaled else "the unit of length and the hand"
        warnings.warn(
            WrongMapWarning(
                f"{part.name}: the map to the mean shape is wrong as a whole with a probability of "
                f"{percentage(correspondence.wrong_probability())}: give a part with {unit} of the model, or "
                "a larger part."
            ),
            stacklevel=2,
        )
    registered = correspondence.registered_mesh()
    points = registered.points_of_target
    _, counterparts = correspondence.overlap()
    observed = counterparts & ~_at_boundary(points, part) & mean.referenced_vertices
    if (count := int(observed.sum())) < _FEWEST_OBSERVED:
        raise InputError(
            f"{part.name}: shows {count} vertices of the model: give a larger part, in the unit of length of "
            "the model, whose surface ends where the body is missing."
        )
    hidden = float(mean.average(~observed))
    if hidden > _LID and not len(part.boundary_edges):
        warnings.warn(
            f"{part.name}: is a closed surface, but {hidden:.0%} of the model has no counterpart on it: if "
            "the body continues beyond a lid, remove the lid, whose points are taken for points of the body.",
            stacklevel=2,
        )
    number = min(_FUNCTIONS, len(mean.referenced_indices) // 10)
    functions = eigenpairs(mean, max(number, 1))[1]
    family = Family(model.mean, whole.modes, whole.scores, model.weights, functions)
    motions, center = _motions(model.mean, observed, scaled=scaled)
    distribution = family.model(motions)
    goals = points[np.flatnonzero(observed)].positions(part)
    place = _first_place(goals, model.mean[observed], scaled=scaled)
    # The errors of the map are measured on the mean shape, in units of the root of its area.
    error = float(correspondence.expected_error().mean() * np.sqrt(mean.area))
    noise, calibration = family.calibrate(motions, observed, error)
    for _ in range(_ROUNDS):
        posterior, means = distribution.condition(observed, place.apply(goals), noise)
        place = place.then_undone(means[-len(motions) :], center)
        posterior, _ = distribution.condition(observed, place.apply(goals), noise)
        goals = _nearest(place.undone(posterior.mean), mean, observed, part)
    posterior, _ = distribution.condition(observed, place.apply(goals), noise)
    size = place.size
    factors = calibration * (posterior.factors @ place.matrix) / size**2
    vertices = place.undone(posterior.mean)
    return Completion(
        make_mesh(vertices, faces, name=f"completed {part.name}"),
        Posterior(vertices, factors, calibration * posterior.residual / size),
        observed,
        noise / size,
        correspondence.probability,
        calibration,
    )


def _check_model(model: ShapeModel) -> ShapeModel:
    """Return the model with all its modes."""
    if (count := len(model.aligned)) < _FEWEST_SHAPES:
        raise InputError(
            f"the model has {count} shape{'s' if count > 1 else ''}: give a model of at least three shapes."
        )
    whole = modes_of(model.alignment)
    if not len(whole.modes):
        raise InputError("the model has no modes, because all its shapes are equal: give different shapes.")
    return whole


def _at_boundary(points: SurfacePoints, mesh: Mesh) -> Bool[np.ndarray, " p"]:
    """Return which points lie on the boundary of a mesh, so that the surface does not continue there."""
    at_boundary = mesh.boundary_vertices[mesh.faces[points.faces]]
    return (at_boundary | (points.weights < _ON_EDGE)).all(axis=1)


def _motions(
    mean: Float64[np.ndarray, "n 3"], observed: Bool[np.ndarray, " n"], *, scaled: bool
) -> tuple[Float64[np.ndarray, "g n 3"], Float64[np.ndarray, " 3"]]:
    """Return the velocities of translations, rotations and perhaps a change of size, and their centre."""
    center = mean[observed].mean(axis=0)
    away = mean - center
    axes = np.eye(3)[:, None]
    moved = [np.broadcast_to(axes, (3, *mean.shape)), np.cross(axes, away), away[None][: int(scaled)]]
    return np.concatenate(moved), center


class _Place(NamedTuple):
    """The similarity that takes the part to the model: a point p moves to `matrix @ p + offset`."""

    matrix: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]

    @property
    def size(self) -> float:
        """The factor of lengths."""
        return float(np.cbrt(np.linalg.det(self.matrix)))

    def apply(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        return points @ self.matrix.T + self.offset

    def undone(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        return (points - self.offset) @ self.matrix / self.size**2

    def then_undone(self, motion: Float64[np.ndarray, " g"], center: Float64[np.ndarray, " 3"]) -> _Place:
        """Remove a small motion of the model, given as the coefficients of `_motions`, from the place."""
        turn = Rotation.from_rotvec(-motion[3:6]).as_matrix() / (1 + motion[6:].sum())
        return _Place(turn @ self.matrix, turn @ (self.offset - center - motion[:3]) + center)


def _first_place(
    goals: Float64[np.ndarray, "o 3"], mean: Float64[np.ndarray, "o 3"], *, scaled: bool
) -> _Place:
    size = 1.0
    if scaled:
        size = float(np.linalg.norm(mean - mean.mean(axis=0)) / np.linalg.norm(goals - goals.mean(axis=0)))
    rotation, offset = rigid_fit(size * goals, mean)
    return _Place(size * rotation, offset)


def _nearest(
    vertices: Float64[np.ndarray, "n 3"], mean: Mesh, observed: Bool[np.ndarray, " n"], part: Mesh
) -> Float64[np.ndarray, "o 3"]:
    """Return the nearest points on the part that face the observed vertices of a whole shape."""
    normals = Mesh(vertices, mean.faces, "completed").vertex_normals[observed]
    nearest, _ = nearest_surface_points(vertices[observed], part)
    return nearest_facing_points(vertices[observed], normals, nearest, part).positions(part)
