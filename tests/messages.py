"""Checks of messages that look for what a message must name, and not for its words."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from jaxsmw.errors import InputError


def assert_names(message: str, *facts: str) -> None:
    """Check that a message names each fact: the file or argument, the fault, and the cure."""
    missing = [fact for fact in facts if fact.casefold() not in message.casefold()]
    assert not missing, f"{message!r} does not name {', '.join(missing)}"


@contextmanager
def refused(*facts: str, error: type[Exception] = InputError) -> Iterator[None]:
    """Check that the block raises an error whose message names each fact."""
    with pytest.raises(error) as caught:
        yield
    assert_names(str(caught.value), *facts)
