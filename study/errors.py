"""The one exception that the command line turns into a line on stderr and exit code 2."""


class InputError(ValueError):
    """Bad input from a person: the message says what was wrong, where, and what is allowed."""
