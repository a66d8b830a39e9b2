"""Descriptors of both shapes, expressed in the eigenbases, for `RegularizedLeastSquares`."""

from __future__ import annotations

from functools import partial

import jax
from jaxtyping import Float

from jaxsmw.core.arrays import Array
from jaxsmw.core.functional_map import PseudoInverse, dual_eigenvectors
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.module import Module
from jaxsmw.core.spectrum import Spectrum


class ProjectedDescriptors(Module):
    """Functions f on one shape: their coefficients `Phi^+ f` (k, d), in the unit of f times length.

    The `operators` (d, k, k) are the matrices `Phi^+ diag(f) Phi`, which multiply other functions by f
    (Nogneng and Ovsjanikov 2017); None if they were not computed.
    """

    coefficients: Float[Array, "k d"]
    operators: Float[Array, "d k k"] | None = None

    @classmethod
    def project(
        cls,
        descriptors: Float[Array, "n d"],
        spectrum: Spectrum,
        *,
        operators: bool,
        pseudo_inverse: PseudoInverse,
    ) -> ProjectedDescriptors:
        """Project d functions on one shape (n, d); see `DescriptorPair.project`."""
        dual = dual_eigenvectors(spectrum, pseudo_inverse)

        def multiply(f: Float[Array, " n"]) -> Float[Array, "k k"]:
            return product((dual * f[:, None]).T, spectrum.eigenvectors)

        # The functions are processed one by one. Processing all d functions together would need memory for d
        # copies of the eigenvectors.
        made = jax.lax.map(multiply, descriptors.T) if operators else None
        return cls(product(dual.T, descriptors), made)


class DescriptorPair(Module):
    """Corresponding functions on X and Y, such as descriptors, for the terms of `RegularizedLeastSquares`.

    `DescriptorPair.project` computes a pair from the values of functions at the vertices.

    **Attributes:**

    - `x`, `y`: the coefficients (k, d) of d functions on each shape, and their operators (d, k, k) or None.

    **Raises:** `ValueError` if `coefficients` does not have two dimensions on each shape, or if X and Y have
    different numbers of functions.
    """

    x: ProjectedDescriptors
    y: ProjectedDescriptors

    def __check_init__(self) -> None:
        shape_x, shape_y = self.x.coefficients.shape, self.y.coefficients.shape
        if len(shape_x) != 2 or len(shape_y) != 2 or shape_x[1] != shape_y[1]:
            raise ValueError(
                f"the coefficients of the descriptors have the shapes {shape_x} on X and {shape_y} on Y, but "
                "(k_x, d) and (k_y, d) with the same number d are needed"
            )

    @classmethod
    def project(
        cls,
        descriptors_x: Float[Array, "m d"],
        descriptors_y: Float[Array, "n d"],
        spectrum_x: Spectrum,
        spectrum_y: Spectrum,
        *,
        operators: bool = False,
        pseudo_inverse: PseudoInverse = "area",
    ) -> DescriptorPair:
        """Return a `DescriptorPair` from the values of corresponding functions at the vertices of X and Y.

        **Arguments:**

        - `descriptors_x`, `descriptors_y`: the values of d functions on X (m, d) and of the corresponding
          functions on Y (n, d), in any unit.
        - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices), in
          the same unit of length.
        - `operators`: whether to compute the multiplication operators of both shapes, which the term of
          descriptor commutativity needs. The default is False.
        - `pseudo_inverse`: the form of the pseudo-inverse; see `encode`.

        **Raises:** `ValueError` if the pseudo-inverse is unknown, if the values do not have one row per
        vertex and one column per function, or if X and Y have different numbers of functions.
        """
        for name, values, spectrum in (("X", descriptors_x, spectrum_x), ("Y", descriptors_y, spectrum_y)):
            n = spectrum.mask.shape[0]
            if values.ndim != 2 or values.shape[0] != n:
                raise ValueError(f"descriptors of {name} have shape {values.shape}, but ({n}, d) is needed")
        project = partial(ProjectedDescriptors.project, operators=operators, pseudo_inverse=pseudo_inverse)
        return cls(project(descriptors_x, spectrum_x), project(descriptors_y, spectrum_y))
