"""Corresponding functions on both shapes, expressed in the eigenbases."""

from __future__ import annotations

import equinox as eqx
import jax
from jaxtyping import Array, Float

from jaxsmw.core.functional_map import dual_eigenvectors
from jaxsmw.core.products import product
from jaxsmw.core.spectrum import Spectrum


class ProjectedDescriptors(eqx.Module):
    """Functions on one shape, expressed in its eigenbasis.

    **Attributes:**

    - `coefficients`: (k, d), `Phi^+ f` of each function f.
    - `operators`: (d, k, k), `Phi^+ diag(f) Phi`, the multiplication by each function f (Nogneng and
      Ovsjanikov 2017); or None.
    """

    coefficients: Float[Array, "k d"]
    operators: Float[Array, "d k k"] | None = None

    @classmethod
    def project(
        cls, descriptors: Float[Array, "n d"], spectrum: Spectrum, *, operators: bool
    ) -> ProjectedDescriptors:
        """Projects the values (n, d) of d functions at the vertices of one shape onto its eigenbasis.

        With `operators` True, the multiplication operators are computed as well. The shapes of the arrays are
        not checked; `DescriptorPair.project` checks them.
        """
        dual = dual_eigenvectors(spectrum, "area")

        def multiply(f: Float[Array, " n"]) -> Float[Array, "k k"]:
            return product((dual * f[:, None]).T, spectrum.eigenvectors)

        # The functions are processed one by one, because all functions at once would need d copies of the
        # eigenvectors.
        made = jax.lax.map(multiply, descriptors.T) if operators else None
        return cls(product(dual.T, descriptors), made)


class DescriptorPair(eqx.Module):
    """Corresponding functions on both shapes, expressed in the eigenbases.

    **Attributes:**

    - `x`, `y`: the functions on X and the corresponding functions on Y.

    **Raises:** `ValueError` if X and Y have different numbers of functions.
    """

    x: ProjectedDescriptors
    y: ProjectedDescriptors

    def __check_init__(self) -> None:
        shape_x, shape_y = self.x.coefficients.shape, self.y.coefficients.shape
        if len(shape_x) != 2 or len(shape_y) != 2 or shape_x[1] != shape_y[1]:
            raise ValueError(
                f"descriptors with coefficients of shapes {shape_x} on X and {shape_y} on Y are not (k_x, d) "
                "and (k_y, d) of the same d functions"
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
    ) -> DescriptorPair:
        """Projects values at vertices onto the eigenbases.

        **Arguments:**

        - `descriptors_x`, `descriptors_y`: the values of d functions on X (m, d) and of the corresponding
          functions on Y (n, d), in any unit.
        - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
        - `operators`: whether to compute the `operators` as well: d matrices of size k x k per shape.

        **Raises:** `ValueError` if the values do not have one row per vertex and one column per function.
        """
        for name, values, spectrum in (("X", descriptors_x, spectrum_x), ("Y", descriptors_y, spectrum_y)):
            n = spectrum.mask.shape[0]
            if values.ndim != 2 or values.shape[0] != n:
                raise ValueError(f"descriptors of {name} have shape {values.shape}, but ({n}, d) is needed")
        return cls(
            ProjectedDescriptors.project(descriptors_x, spectrum_x, operators=operators),
            ProjectedDescriptors.project(descriptors_y, spectrum_y, operators=operators),
        )
