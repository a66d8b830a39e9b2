"""Frames: how evenly a filter bank covers the spectrum, and how to make it cover it evenly."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.filters import FilterBank, sample_bank
from jaxsmw.core.checks import check_choice


def frame_function(responses: Float[Array, "filters k"]) -> Float[Array, " k"]:
    """G(lambda) = sum_l g_l(lambda)^2 (eq. 7); constant for a tight frame, one for a Parseval frame."""
    return jnp.sum(responses**2, axis=0)


class FrameBounds(NamedTuple):
    """The extrema of the frame function: `lower |f|² <= sum of squared coefficients <= upper |f|²`.

    Equal for a tight frame, both one for a Parseval frame; with `lower` zero the bank is no frame.
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
    """The frame bounds of a bank on a shape.

    **Arguments:**

    - `bank`: the filters.
    - `eigenvalues`: (k,) of the shape, ascending.
    - `over`: `"eigenvalues"`, what counts for functions in the span of these eigenfunctions; `"interval"`
      for all of [0, lambda_max], what counts for any shape with that lambda_max.
    - `resolution`: how many evenly spaced points stand for the interval. With their distance h, the lower
      bound comes out too large and the upper one too small by up to `h² max|G''| / 8`, and by up to
      `h max|G'| / 2` at a kink of G. For the banks here with up to 8 filters that is below 1e-5 of G at the
      default.

    **Raises:** `ValueError` if `over` is neither, the resolution is below 2, or the bank's responses have
    another shape than (filters, points).
    """
    check_choice("over", over, ("eigenvalues", "interval"))
    points = eigenvalues
    if over == "interval":
        if resolution < 2:
            raise ValueError(f"an interval needs a resolution of at least 2 points, not {resolution}")
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
        # The largest response cancels from the ratio; without it the squares could underflow.
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(responses), axis=0, keepdims=True))
        # Not `>=`: what is NaN has to stay NaN.
        covered = ~(largest < jnp.finfo(points.dtype).tiny)
        scaled = jnp.where(covered, responses, 0) / jnp.where(covered, largest, 1)
        frame = jnp.where(covered, frame_function(scaled)[None, :], 1)
        return scaled / jnp.sqrt(frame)


def tighten(bank: FilterBank) -> FilterBank:
    """The canonical tight frame `g_l / sqrt(G)`: of all Parseval frames the closest to the bank.

    Where G vanishes (no response is above the smallest normal number) there is nothing to divide: the
    responses are zero there, with zero gradients, and the frame is tight on the rest only. A Parseval bank
    is left as it is.

    **Arguments:**

    - `bank`: any bank; the result is a bank with the same leaves, and differentiable in them.
    """
    return Tightened(bank)
