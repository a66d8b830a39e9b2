"""Banks of a single filter."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmw.core.banks.base import FilterBank
from jaxsmw.core.banks.transitions import meyer_polynomial
from jaxsmw.core.checks import as_parameter, check_between


class ExponentialWindow(FilterBank):
    """A filter bank of one infinitely smooth low-pass filter. The bank is not tight.

    The filter is 1 at the eigenvalue 0, 1/2 at half the edge, and 0 beyond the edge. If the eigenvalue lambda
    is expressed as a fraction of lambda_max, the filter is `e(u) / (e(u) + e(1 - u))`. Here
    `e(u) = exp(-slope / u)` and `u = 1 - lambda / edge`. The filter is from Perraudin et al., "GSPBOX: A
    toolbox for signal processing on graphs", 2014.

    **Arguments:**

    - `edge`: the eigenvalue above which the filter is zero, as a fraction of lambda_max, by default 0.2. The
      value is a single positive number, or an array of shape ().
    - `slope`: the steepness of the filter, by default 1. The value is a single positive number, or an array
      of shape (). At half the edge, the derivative of the filter with respect to `lambda / lambda_max` is
      `-2 slope / edge`.

    **Raises:** `ValueError` if a parameter is not a single positive, finite number.
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.2)
    slope: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge)
        check_between(self, "slope", self.slope)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        edge, slope = (jnp.asarray(leaf, points.dtype) for leaf in (self.edge, self.slope))
        # Clipping excludes u = 0 and u = 1, where an exponent is infinite and has no gradient.
        tiny = jnp.finfo(points.dtype).eps
        u = jnp.clip(1 - points / (eigenvalues[-1] * edge), tiny, 1 - tiny)
        return jax.nn.sigmoid(slope / (1 - u) - slope / u)[None, :]


class LowPass(FilterBank):
    """A filter bank of one low-pass filter, for experiments without wavelets. The bank is not tight.

    The filter is the scaling function of `Meyer` with an adjustable edge. The filter is 1 up to the edge, and
    then falls smoothly to 0 at twice the edge.

    **Arguments:**

    - `edge`: the end of the pass band as a fraction of lambda_max, by default 0.25. The value is a
      single number in (0, 1), or an array of shape ().

    **Raises:** `ValueError` if the edge is not a single number in (0, 1).
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.25)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        edge = eigenvalues[-1] * jnp.asarray(self.edge, points.dtype)
        # Beyond twice the edge, this sine is exactly zero, but the equivalent `cos(pi / 2)` has a rounding
        # error.
        return jnp.sin(jnp.pi / 2 * (1 - meyer_polynomial(jnp.clip(points / edge - 1, 0, 1))))[None, :]


class Identity(FilterBank):
    """A filter bank of one filter that is 1 at every eigenvalue, for experiments without filtering.

    The bank is a Parseval frame and has no arguments. `bank(points, eigenvalues)` returns ones of shape (1,
    p) for points (p,); it ignores the `eigenvalues` (k,) of the shape.
    """

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        return jnp.ones_like(points)[None, :]
