"""How commands end badly, and what turns the errors of libraries into bad input."""

from collections.abc import Iterator
from contextlib import contextmanager

from settings import InputError

# what damaged contents raise
MALFORMED = (LookupError, TypeError, ValueError, RuntimeError, AttributeError, ArithmeticError)
LONGEST = 600  # characters of what a library says
NO_MEMORY = "can't allocate memory", "out of memory"  # in what PyTorch raises on a CPU and on a GPU


class ReflyError(Exception):
    """A counter-example does not come out as recorded: one line on stderr and exit code 1."""


class ExportError(Exception):
    """An exported agent does not act as the original: one line on stderr and exit code 1."""


class Stopped(BaseException):
    """A signal ended the work early; the directory holds what is needed to continue, and the message says how.

    Like KeyboardInterrupt it can be raised anywhere, and nothing that handles an Exception may swallow it.

    Attributes:
        number: the signal's.
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
