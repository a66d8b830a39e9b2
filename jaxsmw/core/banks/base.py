"""The interface of filter banks."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float


class FilterBank(eqx.Module):
    """A scaling function g_0 and wavelets g_1 … g_L, as functions of the eigenvalue.

    A bank is a pytree. Its continuous parameters are leaves, which can be traced and learned; its sizes are
    static. A new bank is a subclass that defines `__call__`.
    """

    @abc.abstractmethod
    def __call__(
        self, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
    ) -> Float[Array, "filters p"]:
        """Returns the responses g_l at the given points. On a shape, call `bank(eigenvalues, eigenvalues)`.

        **Arguments:**

        - `points`: (p,), points in [0, lambda_max], in any order.
        - `eigenvalues`: (k,), the eigenvalues of the shape, ascending, in the same unit as the points. The
          last eigenvalue is lambda_max. A bank may also adapt to the other eigenvalues.

        **Returns:** The responses (filters, p), without unit, scaling function first.
        """


def sample_bank(
    bank: FilterBank, points: Float[Array, " p"], eigenvalues: Float[Array, " k"]
) -> Float[Array, "filters p"]:
    """Returns the responses of a bank after a check of their shape, because users write banks of their own.

    The arguments and the result (filters, p) are those of `FilterBank.__call__`.

    **Raises:** `ValueError` if the responses are not of shape (filters, p).
    """
    responses = bank(points, eigenvalues)
    if responses.ndim != 2 or responses.shape[1] != points.shape[0]:
        raise ValueError(
            f"the bank {type(bank).__name__} gave responses of shape {responses.shape} at {points.shape[0]} "
            f"points, where (filters, {points.shape[0]}) is needed"
        )
    return responses


def check_number_of_filters(bank: FilterBank, filters: int, least: int) -> None:
    """Checks the number of filters of a bank.

    **Raises:** `TypeError` if the number is not an integer; `ValueError` if the number is below `least`.
    """
    if not isinstance(filters, int | np.integer):
        raise TypeError(f"{type(bank).__name__} needs a whole number of filters, not {filters!r}")
    if filters < least:
        raise ValueError(f"{type(bank).__name__} needs at least {least} filters, not {filters}")
