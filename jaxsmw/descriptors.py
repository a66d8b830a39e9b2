"""Descriptors of a pair: SHOT where vertices are compared, and principal components of SHOT everywhere."""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int64

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.sampling import SurfaceSamples, poisson_disk_samples
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS, shot_descriptors
from jaxsmw.pair import Pair
from jaxsmw.runtime.threads import side_by_side

# Descriptors do not tell vertices apart that are a few hundredths of the square root of the area away from
# each other. Ten thousand vertices are dense enough for that.
_COMPARED, _COMPARED_FROM = 10_000, 15_000
# From this number of vertices on, the smaller neighbourhoods hold ten vertices.
_FINE, _FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS
# Descriptors of larger neighbourhoods vary more slowly, so fewer of them suffice.
_SPREAD = 2000


class SampledShape(NamedTuple):
    """A shape at the vertices where descriptors are compared: all vertices, or samples of a large mesh.

    **Attributes:**

    - `mesh`: the shape.
    - `samples`: the samples; None for all vertices.
    - `spectrum`: the spectrum at these vertices.
    """

    mesh: Mesh
    samples: SurfaceSamples | None
    spectrum: Spectrum

    @classmethod
    def make(cls, mesh: Mesh, samples: SurfaceSamples | None, spectrum: Spectrum) -> SampledShape:
        """**Raises:** `InputError` if the spectrum belongs to another mesh."""
        if (rows := spectrum.eigenvectors.shape[0]) != (n := len(mesh.vertices)):
            raise InputError(
                f"{mesh.name}: the mesh has {n} vertices, but its spectrum has {rows}: give the mesh's own "
                "spectrum."
            )
        if samples is not None:
            spectrum = spectrum.sample(jnp.asarray(samples.vertices))
        return cls(mesh, samples, spectrum)

    def rows(self, vertices: Int64[np.ndarray, " v"]) -> Int64[np.ndarray, " v"]:
        """The rows of vertices, or of the samples nearest to them, in arrays over the compared vertices."""
        return vertices if self.samples is None else self.samples.nearest[vertices]


class SampledPair(NamedTuple):
    """A pair at the vertices where descriptors are compared."""

    pair: Pair
    x: SampledShape
    y: SampledShape

    @property
    def sides(self) -> tuple[SampledShape, SampledShape]:
        """X and Y."""
        return self.x, self.y


def sample_pair(pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum) -> SampledPair:
    """A pair at all vertices, or at 10 000 evenly spread vertices of each mesh with more than 15 000.

    **Raises:** `InputError` if a spectrum belongs to another mesh.
    """
    samples_x, samples_y = side_by_side(_samples, *pair.meshes)
    return SampledPair(
        pair,
        SampledShape.make(pair.mesh_x, samples_x, spectrum_x),
        SampledShape.make(pair.mesh_y, samples_y, spectrum_y),
    )


def _samples(mesh: Mesh) -> SurfaceSamples | None:
    return poisson_disk_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


def describe(
    pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum, number_of_descriptors: int
) -> tuple[Spectrum, Spectrum]:
    """Both spectra with descriptors: principal components of SHOT on both shapes together, of mean square 1.

    SHOT is computed with the usual radius, and on fine meshes also with two thirds of that radius.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: see `paired_spectra`.
    - `number_of_descriptors`: d, from 1 to 352; the components in which the vertices differ most.

    **Returns:** Both spectra with `descriptors`, (m, d) and (n, d).

    **Raises:** `InputError` for another number, or a mesh that is too coarse for SHOT.
    """
    if not 1 <= number_of_descriptors <= SHOT_DIMENSION:
        raise InputError(
            f"{number_of_descriptors} descriptors were requested; SHOT has from 1 to {SHOT_DIMENSION}."
        )
    sampled = sample_pair(pair, spectrum_x, spectrum_y)
    dtype = spectrum_x.eigenvectors.dtype
    shot = np.hstack([np.concatenate(both) for both in _shot_at_all_radii(sampled)], dtype=dtype)
    areas = [np.asarray(side.spectrum.vertex_areas, np.float64) for side in sampled.sides]
    weight = np.concatenate([a / a.sum() / 2 for a in areas]).astype(dtype)
    components = _principal_components(shot, weight, number_of_descriptors)
    described = []
    both = np.split(components, [len(areas[0])])
    for spectrum, side, found in zip((spectrum_x, spectrum_y), sampled.sides, both, strict=True):
        everywhere = found if side.samples is None else found[side.samples.nearest]
        everywhere = everywhere * np.asarray(spectrum.mask)[:, None]
        described.append(spectrum.with_descriptors(jax.device_put(everywhere)))
    return described[0], described[1]


def _shot_at_all_radii(
    sampled: SampledPair,
) -> list[tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]]:
    """SHOT of both shapes with the usual radius, and with a smaller radius if both meshes are fine enough."""
    shot = [paired_shot(sampled)]
    if min(len(mesh.vertices) for mesh in sampled.pair.meshes) >= _FINE:
        with suppress(InputError), warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # the usual radius suffices for a mesh too coarse for the smaller one
            shot.append(paired_shot(sampled, _FINE_RADIUS))
    return shot


def _principal_components(
    values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, " n"], number: int
) -> Float[np.ndarray, "n d"]:
    """The first principal components of weighted rows, scaled to mean square 1."""
    centered = values - weight @ values
    covariance = centered.T @ (weight[:, None] * centered)
    variances, directions = np.linalg.eigh(covariance.astype(np.float64))
    first = slice(None, -number - 1, -1)
    scale = np.sqrt(np.maximum(variances[first], np.finfo(np.float64).tiny))
    return centered @ (directions[:, first] / scale).astype(values.dtype)


def paired_shot(
    sampled: SampledPair, radius: float = SHOT_RADIUS
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT of both shapes at the compared vertices, with a radius in `Pair.units_of_length`.

    **Raises:** `InputError` if a mesh is too coarse for the radius.
    """

    def of_one(argument: tuple[SampledShape, float]) -> Float[np.ndarray, "n d"]:
        (mesh, samples, _), unit = argument
        own_radius = radius * unit / mesh.area**0.5
        if radius <= SHOT_RADIUS or len(mesh.vertices) <= _SPREAD:
            return shot_descriptors(mesh, radius=own_radius, samples=samples)
        fewer = poisson_disk_samples(mesh, _SPREAD)
        nearest = fewer.nearest if samples is None else fewer.nearest[samples.vertices]
        return shot_descriptors(mesh, radius=own_radius, samples=fewer)[nearest]

    unit_x, unit_y = sampled.pair.units_of_length
    return side_by_side(of_one, (sampled.x, unit_x), (sampled.y, unit_y))
