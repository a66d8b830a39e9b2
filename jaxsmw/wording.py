"""Numbers as text, for messages and reports."""

from __future__ import annotations


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or the plural."""
    if number != 1:
        noun = noun.removesuffix("ex") + "ices" if noun.endswith("ex") else noun + "s"
    return f"{number} {noun}"


def percentage(probability: float) -> str:
    """Return a probability as text, for example `12 %`, `below 1 %` or `above 99 %`."""
    if probability < 0.01:
        return "below 1 %"
    return "above 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"
