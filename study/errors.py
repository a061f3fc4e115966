"""Errors that end a command, and a context that turns errors of libraries into bad input."""

from collections.abc import Iterator
from contextlib import contextmanager

from settings import InputError

# errors that damaged contents raise
MALFORMED = (LookupError, TypeError, ValueError, RuntimeError, AttributeError, ArithmeticError)
LONGEST = 600  # characters that are shown of a library's message
NO_MEMORY = "can't allocate memory", "out of memory"  # words in PyTorch's errors on a CPU and on a GPU


class ReflyError(Exception):
    """Signals that a counter-example does not end as recorded: one line on stderr and exit code 1."""


class ExportError(Exception):
    """Signals that an exported agent does not act as the original: one line on stderr and exit code 1."""


class Stopped(BaseException):
    """Reports that a signal ended the work early; the directory holds the state to continue from, the message says how.

    Like KeyboardInterrupt it can be raised anywhere, and code that handles an Exception must not catch it.

    Attributes:
        number: the number of the signal.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number


@contextmanager
def as_input_error(where: str, *exceptions: type[BaseException]) -> Iterator[None]:
    """Turns the given exceptions into an InputError that begins with `where`."""
    try:
        yield
    except InputError:
        raise
    except exceptions as error:
        if isinstance(error, OSError) and error.strerror:
            reason = error.strerror
        elif isinstance(error, MemoryError) or any(words in str(error) for words in NO_MEMORY):
            reason = "not enough memory"
        elif isinstance(error, KeyError):
            reason = f"it lacks {error}"
        else:
            reason = (str(error) or type(error).__name__).splitlines()[0].partition("; use sys.")[0]
        raise InputError(f"{where}: {reason[:LONGEST]}") from None
