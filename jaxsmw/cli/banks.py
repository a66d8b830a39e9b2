"""The filter banks that the command line offers."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from jaxsmw.cli.arguments import whole_number
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jaxsmw.core.banks import FilterBank

# A dictionary from the name of each filter bank to its class name in `jaxsmw.core.banks`. The first entry is
# the filter bank of the MWP paper.
BANKS = {
    "meyer": "Meyer",
    "simple-tight": "SimpleTight",
    "itersine": "Itersine",
    "half-cosine": "HalfCosine",
    "adapted-itersine": "Itersine",
    "adapted-half-cosine": "HalfCosine",
    "held": "Held",
    "simoncelli": "Simoncelli",
    "papadakis": "Papadakis",
    "regular": "Regular",
    "cubic-spline": "CubicSpline",
    "mexican-hat": "MexicanHat",
    "gabor": "Gabor",
    "identity": "Identity",
}
_PAPER_BANK = next(iter(BANKS))
# If the name of a filter bank has this prefix, the bank is warped by the distribution of the eigenvalues.
_ADAPTED = "adapted-"
# The largest accepted number of filters. A bank never needs more filters than there are eigenvalues, and
# spectra contain fewer than 10 000 eigenvalues.
_MOST_FILTERS = 10_000


def add_bank(parser: argparse._ActionsContainer) -> None:
    """Add `--bank` and `--filters`. The value of an omitted option is None."""
    parser.add_argument(
        "--bank",
        choices=tuple(BANKS),
        metavar="BANK",
        help=f"filter bank, one of {', '.join(BANKS)} (default: {_PAPER_BANK})",
    )
    parser.add_argument(
        "--filters",
        metavar="N",
        type=whole_number(2, _MOST_FILTERS),
        help="number of filters; some banks have a fixed number (default: depends on the bank)",
    )


def make_bank(name: str | None, number_of_filters: int | None) -> FilterBank:
    """Return the filter bank with a name in `BANKS`, by default the bank of the MWP paper."""
    from jaxsmw.core import banks

    name = name or _PAPER_BANK
    kind = getattr(banks, BANKS[name])
    if number_of_filters is None:
        bank = kind()
    elif "filters" not in kind.__dataclass_fields__:
        raise InputError(f"--filters: the number of filters of {name} is fixed: leave --filters out.")
    else:
        try:
            bank = kind(number_of_filters)
        except ValueError as error:
            raise InputError(f"--filters {number_of_filters}: {error}: give a larger number.") from error
    return banks.Warped(bank, banks.SpectralDistribution()) if name.startswith(_ADAPTED) else bank


def bounds_unless_tight(bank: FilterBank) -> tuple[float, float] | None:
    """Return the lower and the upper frame bound of a bank, or None for a tight frame."""
    import numpy as np

    from jaxsmw.core.banks import frame_bounds

    # The eigenvalues of a surface are nearly evenly spaced, so the bounds are computed for the eigenvalues 0,
    # 1, ..., 100.
    lower, upper = map(float, frame_bounds(bank, np.arange(101.0), over="interval"))
    return None if upper < _TIGHT * lower else (lower, upper)


# A frame is treated as tight if its upper bound is less than this multiple of its lower bound. The bounds of
# tight frames differ only by rounding errors. For all other banks, the upper bound exceeds the lower bound by
# at least a third.
_TIGHT = 1.01
