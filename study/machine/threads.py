"""How many processor threads to compute with: never by the load of the machine, so that a seed fixes a run.

PyTorch adds up in another order with another number of threads, so that it has one by default. More would also wait for
each other: where another process has the core that one of them needs, two threads can be many times slower than one. A
printed function computes columns apart, with the same bits on any number of threads: it has all processors.
"""

import os

import torch

from kernels import compiled
from settings import InputError

DEFAULT = 1  # of PyTorch's


class Threads:
    """How many threads this process computes with; nothing changes in a process that never asks.

    Attributes:
        recorded: with how many of PyTorch's a run was begun that is to continue bit for bit.
    """

    def __init__(self) -> None:
        self.asked = False
        self.wanted: int | None = None
        self.recorded: int | None = None

    def ask(self, wanted: int | None) -> None:
        """Has `settle` take the number that a person wants, else the recorded one, else DEFAULT.

        Raises InputError where a person wants more than there are processors.
        """
        if wanted is not None and wanted > (most := os.cpu_count() or 1):
            raise InputError(
                f"--threads {wanted}: must be at most {most}, the number of this machine's processors; more threads "
                "only wait for each other, and very many cannot be started"
            )
        self.asked, self.wanted, self.recorded = True, wanted, None

    def settle(self) -> None:
        """Sets the threads if asked to; what a person wants, or OMP_NUM_THREADS, is for printed functions, too."""
        asked, self.asked = self.asked, False
        if not asked:
            return
        said = self.wanted is not None or "OMP_NUM_THREADS" in os.environ
        compiled.most_threads = None if said else processors()
        if given := self.wanted or self.recorded:
            torch.set_num_threads(given)
        elif not said:
            torch.set_num_threads(DEFAULT)


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = Threads()
