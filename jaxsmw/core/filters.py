"""Filter banks: the scaling function and the wavelets, sampled at eigenvalues."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class FilterBank(eqx.Module):
    """A scaling function g_0 and wavelets g_1 … g_L, as functions of the eigenvalue.

    A bank is a pytree: continuous parameters are leaves (traced, learnable), sizes are static. To add one,
    subclass and write `__call__`.
    """

    @abc.abstractmethod
    def __call__(
        self, eigenvalues: Float[Array, " k"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "filters k"]:
        """The responses g_l(lambda_i).

        **Arguments:**

        - `eigenvalues`: where to sample, in any order, in [0, lambda_max].
        - `lambda_max`: the upper end of the bank's interval.
        """


class Meyer(FilterBank):
    """The Meyer tight frame: octave bands whose squares sum to one exactly.

    Leonardi and Van De Ville, "Tight wavelet frames on multislice graphs", 2013; the frame of the MWP
    paper's section 4.2. The scaling function passes the lowest band, i.e. the *largest* spatial scale:
    exchanged with the finest wavelet the bank would no longer be tight.

    **Arguments:**

    - `filters`: how many, scaling function included; at least 2.
    """

    filters: int = eqx.field(static=True, default=6)

    def __check_init__(self) -> None:
        if self.filters < 2:
            raise ValueError(f"a Meyer bank needs at least 2 filters, not {self.filters}")

    def __call__(
        self, eigenvalues: Float[Array, " k"], lambda_max: Float[Array, ""]
    ) -> Float[Array, "filters k"]:
        octaves = 2.0 ** jnp.arange(1 - self.filters, 0, dtype=eigenvalues.dtype)
        band_edges = (lambda_max * octaves)[:, None]
        ramp = jnp.clip(eigenvalues[None, :] / band_edges - 1, 0, 1)
        # The smallest polynomial with nu(u) + nu(1 - u) = 1 and three vanishing derivatives at both ends.
        theta = jnp.pi / 2 * ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
        fall, rise = jnp.cos(theta), jnp.sin(theta)
        # Each band rises over one octave and falls over the next; the last one never falls.
        return jnp.concatenate([fall[:1], rise[:-1] * fall[1:], rise[-1:]])


def frame_function(responses: Float[Array, "filters k"]) -> Float[Array, " k"]:
    """G(lambda) = sum_l g_l(lambda)^2 (eq. 7); constant for a tight frame, one for a Parseval frame."""
    return jnp.sum(responses**2, axis=0)
