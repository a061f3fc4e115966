"""Standard output as it may be: closed, on a full disk, or read by somebody who has left."""

import os
import sys
from typing import Any, TextIO

from ppo.files import naming

CLOSED = "standard output is closed; send it to /dev/null if nobody is to read it"
NAME = "standard output"


class Output:
    """A stream whose errors name standard output, as those of a file name the file."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        with naming(NAME):
            return self.stream.write(text)

    def flush(self) -> None:
        with naming(NAME):
            self.stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def discard(self) -> None:
        """Sends what is left, and what follows, nowhere: Python would try it again as it ends."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())


def open_error_output() -> None:
    """Sends what is said on a standard error that is closed nowhere, not into the next file that is opened."""
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # for as long as the process lives
