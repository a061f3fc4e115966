"""Errors for people: one line that begins with the place."""

import errno
import os

import pytest

from settings import InputError, instead
from study.errors import refusing


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ValueError("too large"), "too large"),
        (ValueError("first\nsecond"), "first"),
        (ValueError(), "ValueError"),
        (ValueError("x" * 1000), "x" * 600),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES), "file"), "Permission denied"),
        (OSError("by hand"), "by hand"),
    ],
)
def test_an_exception_becomes_one_line(error: Exception, reason: str) -> None:
    with pytest.raises(InputError) as caught, refusing("here", ValueError, OSError):
        raise error
    assert str(caught.value) == f"here: {reason}"
    assert caught.value.__cause__ is None and caught.value.__suppress_context__


def test_what_is_refused_already_keeps_its_words() -> None:
    with pytest.raises(InputError, match=r"^there: no$"), refusing("here", ValueError):
        raise InputError("there: no")


def test_other_exceptions_pass() -> None:
    with pytest.raises(KeyError), refusing("here", ValueError, OSError):
        raise KeyError("x")


@pytest.mark.parametrize(
    ("word", "known", "said"),
    [
        ("evalute", ["train", "evaluate"], "; did you mean evaluate?"),
        ("rate", ["rate_gain", "rates", "rare", "mass"], "; did you mean rates or rare?"),
        ("fly", ["train", "evaluate"], "; allowed are train, evaluate"),
        ("fly", [f"gain_{i}" for i in range(60)], ""),
    ],
)
def test_an_unknown_word_is_answered_by_the_nearest_or_by_all_of_a_few(
    word: str, known: list[str], said: str
) -> None:
    assert instead(word, known) == said
