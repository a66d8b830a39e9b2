"""Frame bounds of filter banks, and the conversion of any bank into a tight frame."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank, sample_bank
from jaxsmw.core.checks import check_option


def frame_function(responses: Float[Array, "filters k"]) -> Float[Array, " k"]:
    """Return the values (k,) of the frame function G of a filter bank at k eigenvalues.

    The frame function `G(lambda) = sum_l g_l(lambda)²` is the sum of the squared filters g_l (equation (7) of
    the MWP paper). G has no unit. G is constant for a tight frame, and 1 for a Parseval frame.

    **Arguments:**

    - `responses`: (filters, k), the dimensionless responses of the bank, such as
      `bank(eigenvalues, eigenvalues)`.
    """
    return jnp.sum(responses**2, axis=0)


class FrameBounds(NamedTuple):
    """The frame bounds of a filter bank: the minimum and the maximum of its frame function.

    For every function f in the span of the eigenvectors, the sum of the squared wavelet coefficients is
    between `lower |f|²` and `upper |f|²`. The bounds are equal for a tight frame, and both are 1 for a
    Parseval frame. A bank with `lower = 0` is not a frame.

    **Attributes:**

    - `lower`, `upper`: the minimum and the maximum of the frame function, as dimensionless arrays of shape
      ().
    """

    lower: Float[Array, ""]
    upper: Float[Array, ""]


def frame_bounds(
    bank: FilterBank,
    eigenvalues: Float[Array, " k"],
    *,
    over: Literal["eigenvalues", "interval"] = "eigenvalues",
    resolution: int = 10_001,
) -> FrameBounds:
    """Return the frame bounds of a filter bank: the minimum and the maximum of its frame function G.

    The frame function `G = sum_l g_l²` is the sum of the squared filters g_l.

    **Arguments:**

    - `bank`: the filter bank, a `FilterBank`.
    - `eigenvalues`: (k,), the eigenvalues of a shape, ascending, in any unit. The last eigenvalue is
      lambda_max.
    - `over`: `"eigenvalues"` (the default) evaluates G at the given eigenvalues. The bounds then apply to
      every linear combination of the corresponding eigenvectors. `"interval"` evaluates G at evenly spaced
      points of [0, lambda_max]. If the bank depends only on lambda_max, these bounds hold for every shape
      with this lambda_max.
    - `resolution`: the number of points at which `"interval"` evaluates G, at least 2, by default 10 001.
      `over="eigenvalues"` ignores this number. Between the points, G can be outside the bounds. With a point
      spacing h, the error of a bound is at most `h² max|G''| / 8`, or `h max|G'| / 2` at a kink of G. With
      the default resolution, the relative error is below 1e-5 for the banks of this package with up to 8
      filters.

    **Returns:** A `FrameBounds`. Its attributes `lower` and `upper` are the smallest and the largest value of
    G, as dimensionless arrays of shape ().

    **Raises:** `ValueError` if `over` is unknown, if `resolution` is below 2 with `over="interval"`, or if
    the bank returns responses that are not of shape (filters, points).
    """
    check_option("over", over, ("eigenvalues", "interval"))
    points = eigenvalues
    if over == "interval":
        if resolution < 2:
            raise ValueError(f"over='interval' needs a resolution of at least 2 points, not {resolution}")
        points = jnp.linspace(0, eigenvalues[-1], resolution, dtype=eigenvalues.dtype)
    covered = frame_function(sample_bank(bank, points, eigenvalues))
    return FrameBounds(jnp.min(covered), jnp.max(covered))


class Tightened(FilterBank):
    """The canonical tight frame of a bank; see `tighten`."""

    bank: FilterBank

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        responses = self.bank(points, eigenvalues)
        # Division by the largest response prevents underflow of the squares. This divisor cancels in
        # `scaled / sqrt(frame)`.
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(responses), axis=0, keepdims=True))
        # `~(largest < tiny)` keeps NaN in the result; `largest >= tiny` would replace NaN by zero.
        covered = ~(largest < jnp.finfo(points.dtype).tiny)
        scaled = jnp.where(covered, responses, 0) / jnp.where(covered, largest, 1)
        frame = jnp.where(covered, frame_function(scaled)[None, :], 1)
        return scaled / jnp.sqrt(frame)


def tighten(bank: FilterBank) -> FilterBank:
    """Return the canonical tight frame of a filter bank: each filter g_l divided by `sqrt(G)`.

    G is the frame function `sum_l g_l²`. At every eigenvalue, the canonical tight frame is the Parseval frame
    closest to the given bank in the least-squares sense. If the given bank is a Parseval frame, its responses
    do not change.

    Where all responses of the bank are zero or subnormal numbers, the new responses and their gradients are
    zero. At such eigenvalues, the new bank is not a Parseval frame.

    **Arguments:**

    - `bank`: any `FilterBank`.

    **Returns:** A `FilterBank` with the dimensionless responses `g_l / sqrt(G)`, (filters, p) for p points.
    The new bank has the same parameters (pytree leaves) as `bank`, and its responses are differentiable with
    respect to these parameters.
    """
    return Tightened(bank)
