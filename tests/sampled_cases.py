"""Parametrizations of which CI always runs the first cases, and another twentieth of all other cases for each commit."""

from collections.abc import Iterable
from typing import Any

import pytest


def first_always(cases: Iterable[Any], *, always: int = 1, names: int = 1) -> list[Any]:
    """Return the cases of a parametrization, all but the first of them with the marker `sampled`.

    **Arguments:** the cases, the number of cases that CI always runs, and the number of parametrized names. With
    several names, each case is a tuple.
    """
    return [
        case
        if number < always
        else pytest.param(*(case if names > 1 else (case,)), marks=pytest.mark.sampled)
        for number, case in enumerate(cases)
    ]
