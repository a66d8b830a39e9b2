"""Prepares pairs of shapes for refinement: spectra, samples and descriptors in common units."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxsmw.choices import DEFAULT_BACKEND, Backend, Eigensolver, Laplacian
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError, check_whole_number
from jaxsmw.geometry.shot import SHOT_DIMENSION, SHOT_RADIUS
from jaxsmw.matching.descriptors import DescriptorAxes
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.shape import PreparedShape, prepare_shapes
from jaxsmw.matching.spectral_pair import SpectralPair, common_range
from jaxsmw.matching.stages import Preset, Sizes
from jaxsmw.runtime.progress import Step, no_step
from jaxsmw.runtime.threads import side_by_side

# In a partial pair, the smaller area must be at least this share of the larger area. A part with less than a
# thousandth of a body's area shows too little of the body's shape.
_SMALLEST_PART = 1e-3


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """A pair with everything that stages need.

    **Attributes:**

    - `given`: the `Pair` as it was given, to whose vertices the result refers.
    - `pair`: the `Pair` that is matched. Its meshes may be cut, mirrored or trimmed, but have the same
      vertices.
    - `x`, `y`: the shapes X (m vertices) and Y (n vertices), each a `PreparedShape` in
      `Pair.units_of_length`.
    - `mirrored`: whether the mirror image of X is matched instead of X.
    - `trimmed`: whether the larger shape of a partial pair was trimmed; see
      `jaxsmw.matching.search.trimming`.
      The spectra of such a pair have equal numbers of eigenvectors, and need no common limit.
    - `laplacian`, `eigensolver`: how the spectra were computed; see `jaxsmw.compute_spectrum`.
    - `known_shot`: SHOT at the compared vertices, if it has already been computed for these meshes.
    """

    given: Pair
    pair: Pair
    x: PreparedShape
    y: PreparedShape
    mirrored: bool = False
    trimmed: bool = False
    laplacian: Laplacian = "auto"
    eigensolver: Eigensolver = "auto"
    known_shot: tuple[Float[np.ndarray, "a c"], Float[np.ndarray, "b c"]] | None = None

    @classmethod
    def of(
        cls,
        pair: Pair,
        x: PreparedShape,
        y: PreparedShape,
        *,
        given: Pair | None = None,
        mirrored: bool = False,
        trimmed: bool = False,
        laplacian: Laplacian = "auto",
        eigensolver: Eigensolver = "auto",
    ) -> PreparedPair:
        """Return the prepared pair of two shapes, each in units in which its area is 1.

        Two full shapes keep their own units. This compensates for a difference in size. The shapes of a
        partial pair are scaled by one common factor, so that the larger shape has area 1. Unless the pair is
        trimmed, their spectra are then cut at a common limit; see `common_range`. The shapes of a trimmed
        pair cover nearly the same region, so they have about as many eigenvalues below any limit.

        The arguments are the attributes. `given` is `pair` by default.
        """
        if pair.partial:
            area_x, area_y = pair.areas
            scaled = x.spectrum.scale(area_x), y.spectrum.scale(area_y)
            of_x, of_y = scaled if trimmed else common_range(*scaled)
            x, y = replace(x, spectrum=of_x), replace(y, spectrum=of_y)
        return cls(given or pair, pair, x, y, mirrored, trimmed, laplacian, eigensolver)

    @classmethod
    def from_spectra(cls, pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum) -> PreparedPair:
        """Return the prepared pair of meshes whose spectra are known, in `Pair.units_of_length`.

        **Raises:** `InputError` if a spectrum and its mesh have different numbers of vertices.
        """
        x, y = PreparedShape.of(pair.mesh_x, spectrum_x), PreparedShape.of(pair.mesh_y, spectrum_y)
        return cls(pair, pair, x, y)

    @property
    def shapes(self) -> tuple[PreparedShape, PreparedShape]:
        """The shapes X and Y."""
        return self.x, self.y

    @cached_property
    def spectra(self) -> SpectralPair:
        """The spectra and samples of both shapes, on which stages run."""
        samples = None
        if self.x.samples is not None and self.y.samples is not None:
            samples = self.x.samples, self.y.samples
        partial = self.pair.partial
        return SpectralPair(self.x.spectrum, self.y.spectrum, samples, partial, partial and not self.trimmed)

    @cached_property
    def shot(self) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]:
        """SHOT of X and Y at the compared vertices, with the usual radius."""
        return self.known_shot or self.shot_of_radius(SHOT_RADIUS)

    def shot_of_radius(self, radius: float) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]:
        """Compute SHOT of X and Y at the compared vertices, with a radius in `Pair.units_of_length`."""

        def of_one(side: tuple[PreparedShape, float]) -> Float[np.ndarray, "a d"]:
            shape, unit = side
            return shape.shot(radius * unit / shape.mesh.area**0.5)

        of_x, of_y = side_by_side(of_one, *zip(self.shapes, self.pair.units_of_length, strict=True))
        return of_x, of_y

    @property
    def matched(self) -> Pair:
        """The given pair, with the mirror image of X in place of X if it is matched."""
        return self.given.mirrored() if self.mirrored else self.given

    def usable(self, preset: Preset) -> Preset:
        """Return the preset, without descriptors if the pair has none."""
        return preset.without_descriptors() if self.x.spectrum.descriptors is None else preset

    def mirror(self) -> PreparedPair:
        """Return the prepared pair with the mirror image of X in place of X. There are no descriptors yet."""
        x, y = self.x.mirrored(), self.y.without_descriptors()
        pair = self.pair.mirrored()
        return replace(self, pair=pair, x=x, y=y, mirrored=not self.mirrored, known_shot=None)

    def as_part(self, pair: Pair) -> PreparedPair:
        """Return the prepared pair of the same meshes in which one full shape is a part of the other.

        There are no descriptors yet, because their radii are in other units.

        **Arguments:**

        - `pair`: the partial pair of the meshes of `pair`.
        """
        x, y = (shape.without_descriptors() for shape in self.shapes)
        given = replace(self.given, partial=True, scale=pair.scale)
        return PreparedPair.of(
            pair,
            x,
            y,
            given=given,
            mirrored=self.mirrored,
            laplacian=self.laplacian,
            eigensolver=self.eigensolver,
        )

    def describe(self, number_of_descriptors: int, *, required: bool = False) -> PreparedPair:
        """Return the prepared pair with descriptors of both shapes in the same axes.

        **Arguments:**

        - `number_of_descriptors`: the number d of descriptors, from 1 to 352.
        - `required`: whether to raise `InputError` if a mesh is too coarse for descriptors. If False, the
          function issues a `UserWarning` instead, and the result has no descriptors.
        """
        check_whole_number("number_of_descriptors", number_of_descriptors, 1, SHOT_DIMENSION)
        try:
            usual = self.shot
        except InputError as error:
            if required:
                raise
            warnings.warn(f"refinement continues without descriptors: {error}", stacklevel=3)
            return self

        @functools.cache
        def shot(radius: float) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, "b d"]]:
            return usual if radius == SHOT_RADIUS else self.shot_of_radius(radius)

        axes = DescriptorAxes.of(self.shapes, number_of_descriptors, shot)
        x, y = axes.describe(self.shapes, shot)
        return replace(self, x=x, y=y, known_shot=usual)


def prepare(
    pair: Pair,
    sizes: Sizes,
    *,
    given: Pair | None = None,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
    backend: Backend = DEFAULT_BACKEND,
    trimmed: bool = False,
    step: Step = no_step,
) -> PreparedPair:
    """Prepare both shapes of a pair, and pair them.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices).
    - `sizes`: the numbers of eigenvectors, crease eigenvectors and samples of each shape, and its bases.
    - `given`: the pair to whose vertices the result refers, if `pair` is cut; by default `pair`.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`.
    - `backend`: see `jaxsmw.match`.
    - `trimmed`: see `PreparedPair`.
    - `step`: reports and measures the steps.

    **Returns:** A `PreparedPair` without descriptors.

    **Raises:** `InputError` if a shape cannot be prepared (see `prepare_shapes`). For a partial pair,
    `InputError` is also raised if the area of one mesh is less than a thousandth of the other area.
    """
    if min(pair.areas) < _SMALLEST_PART:
        raise InputError(
            f"{pair.mesh_x.name} has area {pair.mesh_x.area * pair.scale**2:.3g} and {pair.mesh_y.name} has "
            f"area {pair.mesh_y.area:.3g}, so their units of length probably differ: scale one of the "
            'meshes, or set scale="unknown".'
        )
    x, y = prepare_shapes(
        pair.meshes, sizes, laplacian=laplacian, eigensolver=eigensolver, backend=backend, step=step
    )
    return PreparedPair.of(
        pair, x, y, given=given, trimmed=trimmed, laplacian=laplacian, eigensolver=eigensolver
    )


def paired_spectra(
    pair: Pair,
    number_of_eigenvectors: int,
    *,
    laplacian: Laplacian = "auto",
    eigensolver: Eigensolver = "auto",
) -> tuple[Spectrum, Spectrum]:
    """Compute the spectra of the two meshes of a pair in comparable units.

    Two full shapes are each scaled to area 1. The shapes of a partial pair are scaled by one common factor,
    and their spectra are cut at a common limit; see
    `PreparedPair.of`.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a `Pair`.
    - `number_of_eigenvectors`: the number k of eigenvectors that are computed for each mesh. It must be at
      least 1, and less than the number of referenced vertices of each mesh.
    - `laplacian`, `eigensolver`: see `jaxsmw.compute_spectrum`. Both meshes get the same eigensolver.

    **Returns:** Two spectra, each a `Spectrum` with positions and normals, in `Pair.units_of_length`. The
    spectrum of X has m vertices and k_X eigenvectors. The spectrum of Y has n vertices and k_Y eigenvectors.
    For two full shapes, k_X = k_Y = k. For a partial pair, k_X and k_Y usually differ.

    **Raises:** `InputError` if a spectrum cannot be computed (see `jaxsmw.compute_spectrum`), or if all
    eigenvalues of a mesh are zero. For a partial pair, `InputError` is also raised if the area of one mesh is
    less than a thousandth of the other area.
    """
    sizes = Sizes(number_of_eigenvectors)
    prepared = prepare(pair, sizes, laplacian=laplacian, eigensolver=eigensolver, backend="jax")
    return prepared.x.spectrum, prepared.y.spectrum


def describe(
    pair: Pair, spectrum_x: Spectrum, spectrum_y: Spectrum, number_of_descriptors: int
) -> tuple[Spectrum, Spectrum]:
    """Add vertex descriptors, which are principal components of SHOT, to the spectra of both shapes.

    SHOT is computed with a radius of 0.06 times the square root of the area. If both meshes have at least
    2000 vertices and are fine enough for a smaller radius, SHOT is also computed with two thirds of this
    radius. The principal components are computed for both shapes together. Each component is scaled so that
    its mean square over the areas of both shapes is 1.

    **Arguments:**

    - `pair`: the source X (m vertices) and the target Y (n vertices), a `Pair`.
    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum` from `paired_spectra`.
    - `number_of_descriptors`: the number d of components, from 1 to 352. The d components of largest variance
      are used.

    **Returns:** The spectra of X and Y, with dimensionless `descriptors` of shapes (m, d) and (n, d). The
    function issues a `UserWarning` if a mesh is too coarse for SHOT at more than 1 % of its vertices.

    **Raises:** `InputError` if `number_of_descriptors` is not from 1 to 352, if a mesh is too coarse for SHOT
    at more than half of its vertices, or if a spectrum and its mesh have different numbers of vertices.
    """
    prepared = PreparedPair.from_spectra(pair, spectrum_x, spectrum_y).describe(
        number_of_descriptors, required=True
    )
    return prepared.x.spectrum, prepared.y.spectrum
