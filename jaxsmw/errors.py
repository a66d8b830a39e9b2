"""The one exception for input that cannot be used."""


class InputError(ValueError):
    """Bad input. The message is one sentence that names the culprit, the fault and the cure.

    The command line prints the sentence and exits with code 2 before it writes a map. (A benchmark keeps the
    pairs that are finished.)
    """
