"""The exception for input that cannot be used."""


class InputError(ValueError):
    """The exception that functions raise for input that cannot be used; a subclass of `ValueError`.

    The message names the input, its fault and a remedy. The command line prints the message and exits with
    code 2.
    """
