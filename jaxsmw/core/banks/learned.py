"""A Parseval frame whose filters can be learned."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, sample_bank
from jaxsmw.core.checks import as_parameter


class SoftmaxFrame(FilterBank):
    """A filter bank with trainable filters. The bank is a Parseval frame for all finite parameters.

    The squared filters are a softmax: `g_l(lambda)² = exp(z_l(lambda)) / sum_j exp(z_j(lambda))`. Each z_l is
    a piecewise linear function of the eigenvalue lambda, with evenly spaced knots from 0 to lambda_max. With
    enough knots, the softmax can approximate any Parseval frame of positive continuous filters.

    To learn a frame, start from `SoftmaxFrame.like(bank)` for a known bank and optimise the logits by
    gradient descent. If the smallest eigenvalues matter most, use `Warped(SoftmaxFrame(…), Power())`. The
    knots are then evenly spaced in frequency, the square root of the eigenvalue.

    **Arguments:**

    - `logits`: (filters, knots), the values of z_l at the knots, as an array or nested lists. At least 1
      filter and 2 knots are needed. Adding a constant to a column of the logits does not change the filters.

    **Raises:** `ValueError` if the logits are not of shape (filters, knots) with at least 1 filter and 2
    knots.
    """

    logits: Float[Array, "filters knots"] = eqx.field(converter=as_parameter)

    def __check_init__(self) -> None:
        if self.logits.ndim != 2 or self.logits.shape[0] < 1 or self.logits.shape[1] < 2:
            raise ValueError(
                f"the logits of SoftmaxFrame have shape {self.logits.shape}, but (filters, knots) with at "
                "least 2 knots is needed"
            )

    @classmethod
    def like(cls, bank: FilterBank, knots: int = 32, *, floor: float = 0.01) -> SoftmaxFrame:
        """Return a `SoftmaxFrame` that imitates a given filter bank.

        At each knot, the squared filters of the frame are proportional to the squared filters of the bank.
        The bank is evaluated at `knots` evenly spaced points from 0 to 1. The bank also receives these points
        as its argument `eigenvalues`.

        **Arguments:**

        - `bank`: any `FilterBank`. Negative responses of the bank become positive, because all filters of a
          `SoftmaxFrame` are positive.
        - `knots`: the number of knots, at least 2. The default is 32.
        - `floor`: a number in [1e-12, 1), by default 0.01. If the absolute value of a response is below the
          floor, the response is replaced by the floor, because a response of zero cannot be learned.

        **Returns:** A `SoftmaxFrame` with logits (filters, knots).

        **Raises:** `ValueError` if `knots` is below 2, if `floor` is not in [1e-12, 1), or if the bank
        returns responses that are not of shape (filters, knots).
        """
        if knots < 2 or not 1e-12 <= floor < 1:
            raise ValueError(
                "SoftmaxFrame.like needs at least 2 knots and a floor of at least 1e-12 and below 1, not "
                f"knots={knots} and floor={floor}"
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
