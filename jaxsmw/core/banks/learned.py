"""A tight frame with filters that can be learned."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, sample_bank
from jaxsmw.core.checks import as_parameter


class SoftmaxFrame(FilterBank):
    """Filters whose squares are a softmax, so the squares sum to one for all finite parameters.

    `g_l(lambda)² = exp(z_l) / sum_j exp(z_j)`. Each z_l is linear in lambda between evenly spaced knots.
    Every Parseval frame of positive filters has this form, up to the resolution of the knots. To learn a
    frame, start from `SoftmaxFrame.like(bank)` for a known bank and optimise the logits by gradient descent.
    If the smallest eigenvalues matter most, `Warped(SoftmaxFrame(…), Power())` spaces the knots evenly in
    frequency.

    **Arguments:**

    - `logits`: (filters, knots), the values of z at the knots, which run from 0 to lambda_max; at least 2
      knots. A constant added to a column changes nothing.

    **Raises:** `ValueError` if the logits do not have this shape.
    """

    logits: Float[Array, "filters knots"] = eqx.field(converter=as_parameter)

    def __check_init__(self) -> None:
        if self.logits.ndim != 2 or self.logits.shape[0] < 1 or self.logits.shape[1] < 2:
            raise ValueError(
                f"the logits of SoftmaxFrame have shape {self.logits.shape}, where (filters, knots) with at "
                "least 2 knots is needed"
            )

    @classmethod
    def like(cls, bank: FilterBank, knots: int = 32, *, floor: float = 0.01) -> SoftmaxFrame:
        """Returns the frame whose squares at the knots are proportional to the squares of a bank.

        A bank that adapts to the spectrum is sampled for evenly spaced eigenvalues.

        **Arguments:**

        - `bank`: any bank. The signs of its filters do not matter.
        - `knots`: the number of knots, at least 2.
        - `floor`: the smallest value of a filter, at least 1e-12 and below 1. Smaller values are raised to
          the floor, because a filter that is zero cannot be learned.

        **Returns:** A frame with logits (filters, knots).

        **Raises:** `ValueError` for fewer than 2 knots, or a floor below 1e-12 or not below 1.
        """
        if knots < 2 or not 1e-12 <= floor < 1:
            raise ValueError(
                f"SoftmaxFrame.like needs at least 2 knots and a floor from 1e-12 to 1, not {knots}, {floor}"
            )
        points = jnp.linspace(0, 1, knots)
        return cls(2 * jnp.log(jnp.maximum(jnp.abs(sample_bank(bank, points, points)), floor)))

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        knots = jnp.linspace(0, 1, self.logits.shape[1], dtype=points.dtype)
        relative, logits = points / eigenvalues[-1], self.logits.astype(points.dtype)
        heights = jax.vmap(lambda z: jnp.interp(relative, knots, z))(logits)
        return jnp.exp(jax.nn.log_softmax(heights, axis=0) / 2)
