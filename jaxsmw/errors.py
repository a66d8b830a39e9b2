"""The exception for input that cannot be used, and a check of arguments that raises it."""

from typing import Any, get_args


class InputError(ValueError):
    """The exception that functions raise for input that cannot be used; a subclass of `ValueError`.

    The message names the input, its fault and a remedy. The command line prints the message and exits with
    code 2.
    """


def check_choice(value: object, choices: Any, kind: str) -> None:
    """Raise an error if a value is not one of the choices.

    `choices` is a `Literal` type. `kind` describes a valid value in the message, with an article, such as "an
    eigensolver".

    **Raises:** `InputError` if the value is not one of the choices; the message lists them.
    """
    if value not in get_args(choices):
        raise InputError(f"{value!r} is not {kind}: choose {', '.join(get_args(choices))}.")
