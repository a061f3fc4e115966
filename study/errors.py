"""Bad input: the exception that the command line turns into one line on stderr and exit code 2."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from difflib import get_close_matches

from setting import joined

MALFORMED = (KeyError, TypeError, ValueError, RuntimeError, AttributeError)  # what damaged contents raise
LONGEST = 600  # characters of what a library says
NEAR = 0.7  # share of letters in common from which on a word may have been meant
FEW = 20  # words that are read at a glance
NO_MEMORY = "can't allocate memory", "out of memory"  # in what PyTorch raises on a CPU and on a GPU


class InputError(ValueError):
    """Bad input from a person: the message says what was wrong, where, and what is allowed."""


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


def instead(word: str, known: Collection[str]) -> str:
    """What ends a message about an unknown word: the known ones nearest to it or, if none is near, all of a few."""
    if meant := nearest(word, known):
        return meant
    return f"; allowed are {', '.join(known)}" if len(known) <= FEW else ""


def nearest(word: str, known: Collection[str]) -> str:
    """A question whether one of the known words was meant; empty where none is near."""
    near = get_close_matches(word, known, 3, NEAR)
    return f"; did you mean {joined(near, 'or')}?" if near else ""


@contextmanager
def refusing(where: str, *exceptions: type[BaseException]) -> Iterator[None]:
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
        else:
            reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{where}: {reason[:LONGEST]}") from None


def in_one_line(text: str) -> str:
    """A message as one line, whatever the names in it hold."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)
