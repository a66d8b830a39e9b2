"""Checks of messages that look for what a message must name, and not for its words."""

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

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


def refusal(read: Callable[[Path], object], path: Path, *, most_memory: float) -> str:
    """Return why a file is refused, in one sentence that names the file, the fault and the cure.

    Reading may take at most `most_memory` bytes.
    """
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and message.endswith(".") and message.count(": ") >= 2, message
    assert "\n" not in message and len(message) < 400 + len(str(path))
    assert peak < most_memory
    return message.removeprefix(f"{path}: ")
