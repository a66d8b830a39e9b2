"""The spectra of a pair, on which stages run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from jaxsmw.core.arrays import Array, is_traced
from jaxsmw.core.refiner import Samples
from jaxsmw.core.spectrum import Basis, Spectrum
from jaxsmw.matching.stages import Stage

Eigenpairs = TypeVar("Eigenpairs", Spectrum, Basis)


@dataclass(frozen=True, eq=False)
class SpectralPair:
    """Two spectra in comparable units, on which stages run.

    **Attributes:**

    - `x`, `y`: the spectra of X (m vertices) and Y (n vertices), each a `Spectrum`.
    - `samples`: samples of X (s,) and of Y (s,) in farthest-point order, as 0-based vertices; None if no
      stage iterates on samples.
    - `partial`: whether one of the shapes is a partial shape.
    - `common_limit`: whether both spectra must end at a common eigenvalue; see `common_range`.
    """

    x: Spectrum
    y: Spectrum
    samples: Samples | None = None
    partial: bool = False
    common_limit: bool = False

    @property
    def both(self) -> tuple[Spectrum, Spectrum]:
        """The spectra of X and Y."""
        return self.x, self.y

    @property
    def on_host(self) -> bool:
        """Whether the arrays are of NumPy, so that refiners with namespaces run at once."""
        return not is_traced(self.x.eigenvectors, self.y.eigenvectors)

    def seen_by(self, stage: Stage) -> SpectralPair:
        """Return the pair, restricted to the eigenvectors, bases, descriptors and samples that a stage uses.

        If one of the spectra has no crease eigenvectors, the result has none either. This happens in a
        collection if only one of two meshes is large.
        """
        spectra = self.x, self.y
        creased = all(spectrum.crease_eigenvectors is not None for spectrum in spectra)
        number_of_creases = stage.number_of_crease_eigenvectors if creased else 0
        x, y = (
            spectrum.with_bases(_named(spectrum.bases, stage.refiner.further_bases))
            .truncate(stage.number_of_eigenvectors)
            .with_descriptors(_first(spectrum.descriptors, stage.number_of_descriptors))
            .with_crease_eigenvectors(_first(spectrum.crease_eigenvectors, number_of_creases))
            for spectrum in spectra
        )
        fewer = any(
            now.eigenvalues.shape != all_.eigenvalues.shape for now, all_ in zip((x, y), spectra, strict=True)
        )
        if self.common_limit and fewer:
            x, y = common_range(x, y)
        samples = None
        if stage.number_of_samples is not None and self.samples is not None:
            samples = (
                self.samples[0][: stage.number_of_samples],
                self.samples[1][: stage.number_of_samples],
            )
        return replace(self, x=x, y=y, samples=samples)


def _first(columns: Float[Array, "n d"] | None, number: int) -> Float[Array, "n c"] | None:
    """Return the first columns of an array; None if there is no array, or if the number is 0."""
    return columns[:, :number] if number and columns is not None else None


def common_range(spectrum_x: Spectrum, spectrum_y: Spectrum) -> tuple[Spectrum, Spectrum]:
    """Cut two spectra at a common limit.

    The limit is the largest eigenvalue of X or the largest eigenvalue of Y, whichever is smaller. Eigenpairs
    with eigenvalues above this limit are removed. The MWP paper truncates the spectra of partial shapes in
    the same way. Each further basis has its own limit.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, each a `Spectrum`, in the same unit of length.

    **Returns:** The spectra of X and Y with k_X and k_Y eigenvectors, in the same unit. One of the spectra is
    unchanged.
    """
    bases = [_common_range(*both) for both in zip(spectrum_x.bases, spectrum_y.bases, strict=True)]
    x, y = _common_range(spectrum_x, spectrum_y)
    return x.with_bases(tuple(of_x for of_x, _ in bases)), y.with_bases(tuple(of_y for _, of_y in bases))


def _common_range(x: Eigenpairs, y: Eigenpairs) -> tuple[Eigenpairs, Eigenpairs]:
    last = min(float(side.eigenvalues[-1]) for side in (x, y))
    cut = [side.truncate(int((np.asarray(side.eigenvalues) <= last).sum())) for side in (x, y)]
    return cut[0], cut[1]


def _named(bases: Sequence[Basis], names: Sequence[str]) -> tuple[Basis, ...]:
    """Return the bases with some names, in the order of these names."""
    return tuple(basis for name in names for basis in bases if basis.name == name)
