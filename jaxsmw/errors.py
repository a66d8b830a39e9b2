"""The one exception that means "what you gave me cannot be used"."""


class InputError(ValueError):
    """Bad input: one sentence that names the culprit, the fault and the cure.

    The command line prints the sentence and exits with code 2; no map has been written by then (a benchmark
    keeps what is finished).
    """
