"""What a person sees of work that takes long: a line for a step, a bar where there is a count; from 2 s on."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Timer
from typing import Any

from tqdm import tqdm

from ppo.torchrun import is_first

PATIENCE = 2.0  # s in which nobody wonders what is going on


@contextmanager
def step(what: str) -> Iterator[None]:
    """Says on stderr what takes longer than PATIENCE, and at its end how long it took; of many ranks, the first one.

    Args:
        what: is done, and how long that takes: "compiling the filter, about a minute, once".
    """
    started, said = time.perf_counter(), []

    def say(text: str, end: str) -> None:
        said.append(text)
        print(text, end=end, file=sys.stderr, flush=True)

    timer = Timer(PATIENCE, say, (f"{what} ...", ""))
    timer.daemon = True
    if is_first():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
        if timer.is_alive():  # maybe saying it just now
            timer.join()
        if said:
            say(f" {time.perf_counter() - started:.0f} s", "\n")


def bar(total: int, unit: str, **options: Any) -> tqdm:
    """A bar on stderr of so many units, shown from PATIENCE on, also while only what stands beside it changes.

    Of many ranks, the first one's. Within another bar it has a line of its own, which a log cannot have.
    """
    interval = 1.0 if sys.stderr.isatty() else 10.0  # s; a log shows every state of it
    settings = {
        **width(),
        "delay": PATIENCE,
        "mininterval": interval,
        "miniters": 0,
        "disable": not is_first(),
        "position": None if sys.stderr.isatty() else 0,  # a log's lines cannot be gone back to
    }
    return tqdm(total=total, unit=f" {unit}", **settings | options)


def width() -> dict[str, Any]:
    """How wide a bar is: as the terminal, also when that changes; as usual where the terminal does not know.

    On one that says 0 columns (of `script`, `docker run -t` or `ssh -tt` without a window) tqdm draws nothing.
    """
    with suppress(OSError, ValueError, AttributeError):  # no terminal
        if not os.get_terminal_size(sys.stderr.fileno()).columns:
            return {"ncols": 79, "nrows": 24}
    return {"dynamic_ncols": True}
