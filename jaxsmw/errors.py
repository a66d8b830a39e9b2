"""The exception for input that cannot be used."""


class InputError(ValueError):
    """The error for input that cannot be used.

    The message is one sentence that names the input, its fault and a remedy. The command line prints this
    sentence and exits with code 2 before it writes a map. (A benchmark keeps the pairs that are finished.)
    """
