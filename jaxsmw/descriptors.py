"""Descriptors of two shapes: SHOT where vertices are compared, and its principal components everywhere."""

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
from jaxsmw.geometry.mesh import Mesh, units_of_length
from jaxsmw.geometry.sampling import Samples, spread_samples
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS, shot_descriptors
from jaxsmw.runtime.threads import side_by_side


class Compared(NamedTuple):
    """A shape, or where it has too many vertices to compare all, samples of it; `spectrum` is theirs."""

    mesh: Mesh
    samples: Samples | None
    spectrum: Spectrum

    @classmethod
    def make(cls, mesh: Mesh, samples: Samples | None, spectrum: Spectrum) -> Compared:
        if (rows := spectrum.eigenvectors.shape[0]) != (n := len(mesh.vertices)):
            raise InputError(
                f"{mesh.name}: it has {n} vertices, but the spectrum given for it is of {rows}: give its own."
            )
        if samples is not None:
            spectrum = spectrum.sample(jnp.asarray(samples.vertices))
        return cls(mesh, samples, spectrum)

    def rows(self, vertices: Int64[np.ndarray, " v"]) -> Int64[np.ndarray, " v"]:
        """Where what is known of vertices, or of the samples nearest to them, stands."""
        return vertices if self.samples is None else self.samples.nearest[vertices]


# Descriptors tell no more apart than what is a few hundredths of the square root of the area away, for which
# ten thousand vertices are plenty.
_COMPARED, _COMPARED_FROM = 10_000, 15_000
# The smaller neighbourhoods hold ten vertices from this many on.
_FINE, _FINE_RADIUS = 2000, 2 / 3 * SHOT_RADIUS
# Descriptors of wider neighbourhoods vary more slowly.
_SPREAD = 2000


def compared(
    mesh_x: Mesh, mesh_y: Mesh, spectrum_x: Spectrum, spectrum_y: Spectrum
) -> tuple[Compared, Compared]:
    """Both shapes, thinned where they have too many vertices."""
    samples_x, samples_y = side_by_side(_samples, mesh_x, mesh_y)
    return Compared.make(mesh_x, samples_x, spectrum_x), Compared.make(mesh_y, samples_y, spectrum_y)


def _samples(mesh: Mesh) -> Samples | None:
    return spread_samples(mesh, _COMPARED) if len(mesh.vertices) > _COMPARED_FROM else None


def describe(
    mesh_x: Mesh,
    mesh_y: Mesh,
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    number_of_descriptors: int,
    *,
    partial: bool = False,
) -> tuple[Spectrum, Spectrum]:
    """The spectra with descriptors: principal components of SHOT on both shapes together, of mean square 1.

    SHOT with the usual radius, and on meshes that are fine enough with one of two thirds, too, side by side.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`, `partial`: see `paired_spectra`.
    - `number_of_descriptors`: d, from 1 to 352; the components in which the shapes' vertices differ most.

    **Returns:** Both spectra with `descriptors`, (m, d) and (n, d).

    **Raises:** `InputError` for another number, or a mesh that is too coarse for SHOT.
    """
    if not 1 <= number_of_descriptors <= SHOT_DIMENSION:
        raise InputError(
            f"{number_of_descriptors} descriptors were asked for; SHOT gives from 1 to {SHOT_DIMENSION}."
        )
    sides = compared(mesh_x, mesh_y, spectrum_x, spectrum_y)
    of_radii = [paired_shot(*sides, partial)]
    if min(len(side.mesh.vertices) for side in sides) >= _FINE:
        with suppress(InputError), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # where a mesh is too coarse for it, the usual one is enough
            of_radii.append(paired_shot(*sides, partial, _FINE_RADIUS))
    dtype = spectrum_x.eigenvectors.dtype
    both = np.hstack([np.concatenate(of_radius) for of_radius in of_radii], dtype=dtype)
    areas = [np.asarray(side.spectrum.vertex_areas, np.float64) for side in sides]
    weight = np.concatenate([a / a.sum() / 2 for a in areas]).astype(dtype)
    centered = both - weight @ both
    covariance = centered.T @ (weight[:, None] * centered)
    variances, directions = np.linalg.eigh(covariance.astype(np.float64))
    first = slice(None, -number_of_descriptors - 1, -1)
    scale = np.sqrt(np.maximum(variances[first], np.finfo(np.float64).tiny))
    components = np.split(centered @ (directions[:, first] / scale).astype(dtype), [len(areas[0])])
    described = []
    for spectrum, side, found in zip((spectrum_x, spectrum_y), sides, components, strict=True):
        everywhere = found if side.samples is None else found[side.samples.nearest]
        everywhere = everywhere * np.asarray(spectrum.mask)[:, None]
        described.append(spectrum.with_descriptors(jax.device_put(everywhere)))
    return described[0], described[1]


def paired_shot(
    x: Compared, y: Compared, partial: bool, radius: float = SHOT_RADIUS
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "n d"]]:
    """SHOT of both shapes at one scale."""

    def of_one(side: tuple[Compared, float]) -> Float[np.ndarray, "n d"]:
        (mesh, samples, _), unit = side
        own_radius = radius * unit / mesh.area**0.5
        if radius <= SHOT_RADIUS or len(mesh.vertices) <= _SPREAD:
            return shot_descriptors(mesh, radius=own_radius, samples=samples)
        fewer = spread_samples(mesh, _SPREAD)
        nearest = fewer.nearest if samples is None else fewer.nearest[samples.vertices]
        return shot_descriptors(mesh, radius=own_radius, samples=fewer)[nearest]

    units = units_of_length(x.mesh, y.mesh, partial)
    return side_by_side(of_one, (x, units[0]), (y, units[1]))
