"""What a person sees of work that takes long: a line for a step, a bar where there is a count; from 2 s on.

A terminal has a bar that moves. A log cannot go back in its lines: a plain one says every ten seconds how far it is.
"""

import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from threading import Event, Thread, Timer
from typing import Any, ClassVar, Self

from tqdm import tqdm

from ppo.torchrun import is_first

PATIENCE = 2.0  # s in which nobody wonders what is going on
INTERVAL = 10.0  # s between two lines in a log


@contextmanager
def step(what: str) -> Iterator[None]:
    """Says on stderr what takes longer than PATIENCE, and at its end how long it took; of many ranks, the first one.

    Args:
        what: is done, and how long that takes: "compiling the filter, about a minute, once".
    """
    started, said = time.perf_counter(), []
    begun = f"{what} ..."
    # a log's lines are whole, since a bar's may come between them
    end, again = ("", "") if sys.stderr.isatty() else ("\n", begun)

    def say(text: str, end: str) -> None:
        said.append(text)
        print(text, end=end, file=sys.stderr, flush=True)

    timer = Timer(PATIENCE, say, (begun, end))
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
            say(f"{again} {time.perf_counter() - started:.0f} s", "\n")


class Lines:
    """What a log has for a bar, used like tqdm's: a plain line after PATIENCE and after every INTERVAL, moved or not.

    `16,384 of 507,904 interactions (3 %), 1,170/s, 0:07:00 left, learning from the guidance`

    While there is another within it, only that one speaks.

    Args:
        total: units, of which `initial` are done; desc: what is counted for; iterable: whose items are the units.
        silent: says nothing; leave: has a last line, if it had any.
    """

    open: ClassVar[list["Lines"]] = []  # the innermost is the last

    def __init__(
        self,
        total: int,
        unit: str,
        initial: float = 0,
        desc: str = "",
        iterable: Iterable[Any] = (),
        leave: bool = True,
        silent: bool = False,
    ) -> None:
        self.total, self.unit, self.desc, self.iterable, self.leave = total, unit, desc, iterable, leave
        self.n = self.initial = initial
        self.postfix = ""
        self.started, self.said, self.closed = time.perf_counter(), False, Event()
        self.teller = Thread(target=self.tell, daemon=True)
        self.open.append(self)
        if not silent:
            self.teller.start()

    def tell(self) -> None:
        """Says how far it is, until closed."""
        pause = PATIENCE
        while not self.closed.wait(pause):
            if self.open[-1:] == [self]:
                self.say()
            pause = INTERVAL

    def say(self) -> None:
        self.said = True
        with suppress(OSError, ValueError):  # nobody reads, or it is closed
            sys.stderr.write(f"{self}\n")
            sys.stderr.flush()

    def __str__(self) -> str:
        done = f"{self.n:,.0f} of {self.total:,} {self.unit} ({100.0 * self.n / max(self.total, 1):.0f} %)"
        facts = [f"{self.desc}: {done}" if self.desc else done]
        if rate := (self.n - self.initial) / (time.perf_counter() - self.started):
            left = timedelta(seconds=round((self.total - self.n) / rate))
            facts += [f"{rate:,.0f}/s" if rate >= 10.0 else f"{rate:.2g}/s", f"{left} left"]
        return ", ".join([*facts, self.postfix] if self.postfix else facts)

    def update(self, n: float = 1) -> None:
        """So many more units are done."""
        self.n += n

    def set_postfix_str(self, text: str, refresh: bool = False) -> None:
        """What stands at the end of a line; `refresh`, which is tqdm's, changes nothing."""
        self.postfix = text

    def close(self) -> None:
        """Says no more, except how far it came, where it said anything."""
        if not self.closed.is_set():
            self.closed.set()
            self.open.remove(self)
            if self.teller.is_alive():
                self.teller.join()
            if self.said and self.leave:
                self.say()

    def __iter__(self) -> Iterator[Any]:
        with self:
            for each in self.iterable:
                yield each
                self.update()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def bar(total: int, unit: str, bar_format: str | None = None, **options: Any) -> tqdm | Lines:
    """On stderr how many of so many units are done, from PATIENCE on: a bar on a terminal, `Lines` in a log.

    Of many ranks, the first one's. Within another bar it has a line of its own; in a log it alone speaks.

    Args:
        bar_format: of the bar; options: those of `Lines`.
    """
    if not sys.stderr.isatty():
        return Lines(total, unit, **options, silent=not is_first())
    settings = {"delay": PATIENCE, "mininterval": 1.0, "miniters": 0, "disable": not is_first()}
    return tqdm(total=total, unit=f" {unit}", bar_format=bar_format, **width(), **settings, **options)


def width() -> dict[str, Any]:
    """How wide a bar is: as the terminal, also when that changes; as usual where the terminal does not know.

    On one that says 0 columns (of `script`, `docker run -t` or `ssh -tt` without a window) tqdm draws nothing.
    """
    with suppress(OSError, ValueError, AttributeError):  # no terminal
        if not os.get_terminal_size(sys.stderr.fileno()).columns:
            return {"ncols": 79, "nrows": 24}
    return {"dynamic_ncols": True}
