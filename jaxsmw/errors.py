"""The exception for input that cannot be used."""


class InputError(ValueError):
    """The exception that functions raise for input that cannot be used; a subclass of `ValueError`.

    The message is one sentence that names the input, its fault and a remedy. The command line prints this
    sentence and exits with code 2. Commands that match one pair check their input before they write a map. A
    benchmark keeps the results of pairs that are finished.
    """
