"""The interface of filter banks."""

from __future__ import annotations

import abc

from jaxtyping import Float

from jaxsmw.core.arrays import Array, is_tracer, namespace
from jaxsmw.core.checks import check_integer
from jaxsmw.core.module import Module

Points = Float[Array, " p"]
Eigenvalues = Float[Array, " k"]
Responses = Float[Array, "filters p"]


class FilterBank(Module):
    """The base class of filter banks (a scaling function g_0 and wavelet filters g_1 … g_L).

    `jaxsmw.banks` contains ready subclasses, such as `Meyer` (the default of `WaveletPreservation`) and
    `CubicSpline`. A subclass must define `__call__(points, eigenvalues)`. A bank is a frozen dataclass and
    a pytree. The continuous parameters of a bank are arrays, which JAX can trace and differentiate.
    The sizes of a bank, such as the number of filters, are static fields.

    **Raises:** The constructor of a ready bank raises `TypeError` if a size is not an integer, and
    `ValueError` if a parameter is not a single finite number within its limits.
    """

    @abc.abstractmethod
    def __call__(self, points: Points, eigenvalues: Eigenvalues) -> Responses:
        """Return the responses of all filters at the given points of the eigenvalue axis.

        **Arguments:**

        - `points`: (p,), points in [0, lambda_max], in any order.
        - `eigenvalues`: (k,), the eigenvalues of the shape, ascending, in the unit of the points. The last
          eigenvalue is lambda_max. Most banks ignore all other eigenvalues.

        **Returns:** The responses (filters, p), without unit. By convention, row 0 is the scaling function.
        """


def sample_bank(bank: FilterBank, points: Points, eigenvalues: Eigenvalues) -> Responses:
    """Return the responses (filters, p) of a bank, which can be a user's.

    **Raises:** `ValueError` if the responses are not of shape (filters, p).
    """
    responses = bank(points, eigenvalues)
    if not is_tracer(responses):  # a user's bank can return arrays of JAX for arrays of NumPy
        responses = namespace(points, eigenvalues).asarray(responses)
    if responses.ndim != 2 or responses.shape[1] != points.shape[0]:
        raise ValueError(
            f"the bank {type(bank).__name__} returned responses of shape {responses.shape} for "
            f"{points.shape[0]} points, but the shape (filters, {points.shape[0]}) is needed"
        )
    return responses


def check_number_of_filters(bank: FilterBank, filters: int, least: int) -> None:
    """Raise `TypeError` if the number of filters is no integer, or `ValueError` if it is below `least`."""
    check_integer(f"the number of filters of {type(bank).__name__}", filters)
    if filters < least:
        raise ValueError(f"{type(bank).__name__} needs at least {least} filters, not {filters}")
