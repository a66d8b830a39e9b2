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
    """One infinitely smooth low-pass filter: 1 at zero, 1/2 at half the edge, and 0 beyond the edge.

    The filter is `e(u) / (e(u) + e(1 - u))` with `e(u) = exp(-slope / u)` and `u = 1 - lambda / edge`
    (Perraudin et al., "GSPBOX: A toolbox for signal processing on graphs", 2014).

    **Arguments:**

    - `edge`: the edge relative to lambda_max, positive.
    - `slope`: the steepness, positive. The derivative at half the edge is `-2 slope / edge`.

    **Raises:** `ValueError` if a parameter is not one positive, finite number.
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
        # At u = 0 and u = 1 the exponents are infinite and have no gradient.
        tiny = jnp.finfo(points.dtype).eps
        u = jnp.clip(1 - points / (eigenvalues[-1] * edge), tiny, 1 - tiny)
        return jax.nn.sigmoid(slope / (1 - u) - slope / u)[None, :]


class LowPass(FilterBank):
    """One low-pass filter and no wavelets: a control experiment that smooths at a single scale.

    This is the scaling function of `Meyer` with an adjustable edge. The bank is not tight.

    **Arguments:**

    - `edge`: the end of the pass band relative to lambda_max, in (0, 1). The filter is 1 up to the edge and 0
      beyond twice the edge.

    **Raises:** `ValueError` if the edge is not one number in (0, 1).
    """

    edge: Float[Array, ""] = eqx.field(converter=as_parameter, default=0.25)

    def __check_init__(self) -> None:
        check_between(self, "edge", self.edge, high=1.0)

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        edge = eigenvalues[-1] * jnp.asarray(self.edge, points.dtype)
        # Beyond twice the edge this sine is exactly zero. The equivalent cosine of pi/2 has a rounding error.
        return jnp.sin(jnp.pi / 2 * (1 - meyer_polynomial(jnp.clip(points / edge - 1, 0, 1))))[None, :]


class Identity(FilterBank):
    """One filter that passes everything: a Parseval frame for control experiments without filtering."""

    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        return jnp.ones_like(points)[None, :]
