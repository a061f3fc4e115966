"""How many processor threads to compute with: what is asked for, or what is fastest on this machine now.

Threads that wait for each other spin. Where another process has the core that one of them needs, all wait: on two cores
that others use, two threads can be many times slower than one.
"""

import os
import sys
import time

import torch

from ppo.torchrun import is_first
from study.errors import InputError

ROUNDS = 10  # of the measurement
REPEATS = 20
LONGEST = 0.5  # s, after which no round is begun
WORTH = 0.9  # share of the time of fewer threads, at which more are worth it


class Threads:
    """How many threads this process computes with; nothing changes in a process that never asks.

    Attributes:
        recorded: with how many a run was begun that is to continue bit for bit.
    """

    def __init__(self) -> None:
        self.asked = False
        self.wanted: int | None = None
        self.recorded: int | None = None

    def ask(self, wanted: int | None) -> None:
        """Has `settle` take the number that a person wants, else the recorded one, else the fastest.

        Raises InputError where a person wants more than there are processors.
        """
        if wanted is not None and wanted > (most := os.cpu_count() or 1):
            raise InputError(
                f"--threads {wanted}: must be at most {most}, the number of this machine's processors; more threads "
                "only wait for each other, and very many cannot be started"
            )
        self.asked, self.wanted, self.recorded = True, wanted, None

    def settle(self) -> None:
        """Sets PyTorch's threads if asked to, and says on stderr how many where it measured.

        OMP_NUM_THREADS comes before a measurement.
        """
        asked, self.asked = self.asked, False
        if asked and (given := self.wanted or self.recorded):
            torch.set_num_threads(given)
        elif asked and "OMP_NUM_THREADS" not in os.environ and torch.get_num_threads() > 1:
            times = measured(torch.get_num_threads())
            torch.set_num_threads(fastest(times))
            if is_first():
                print(said(times), file=sys.stderr)


THREADS = Threads()


def measured(most: int) -> dict[int, float]:
    """s of computing by the number of threads, in powers of two up to `most`, stalls included."""
    candidates = sorted({min(2**k, most) for k in range(most.bit_length() + 1)})
    x, weight = torch.ones(256, 256), torch.full((256, 256), 1e-3)
    times = dict.fromkeys(candidates, 0.0)
    for _ in range(ROUNDS):  # in turns, since a machine's load changes
        if sum(times.values()) > LONGEST:
            break
        for threads in candidates:
            torch.set_num_threads(threads)
            started = time.perf_counter()
            for _ in range(REPEATS):  # the learner's layers, and operations as short as the simulator's
                torch.tanh(x @ weight)
            times[threads] += time.perf_counter() - started
    return times


def fastest(times: dict[int, float]) -> int:
    """The number of threads to take: more only where they pay."""
    best = 1
    for threads in sorted(times):
        if times[threads] < WORTH * times[best]:
            best = threads
    return best


def said(times: dict[int, float]) -> str:
    """The choice in a line."""
    chosen, most = fastest(times), max(times)
    other = most if chosen != most else 1
    return (
        f"threads: {chosen} of {most}, which took {times[chosen] / times[other]:.2f} of the time of {other} "
        "in a short measurement; --threads N overrides it"
    )
