"""Filters in C and initial states that tests share: each is made once in a process, and filters are not optimised.

To trace and build a filter takes ten seconds, and to draw a pool of states that it accepts a quarter of one; many tests
fly the same few filters from the same seeds. Processes of one run of pytest-xdist read what another one has made. A
test that puts something in a part's place has a filter and states of its own. tests/kernels builds as users do;
`test_optimisation_changes_no_bit_of_a_filter` there says that the compiler's optimisation does not matter.
"""

import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial, update_wrapper
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

import rta.filter
import rta.printed.batch
import rta.printed.files
import rta.printed.source
from inspection import initial_state
from inspection.initial_state import sample_initial_state
from inspection.model.parameters import Episode, InspectionParameters
from kernels import build
from rta import SafetyFilter
from rta.printed.batch import Columns
from rta.printed.files import fingerprint

ROOMS = ("inspection.chief", "inspection.model", "kernels", "rta")  # of what a filter is printed from
SHARED = [  # functions of a filter, where they are called from
    (rta.filter, "BatchFilter"),
    *(
        (module, name)
        for module in (rta.printed.batch, rta.printed.files)
        for name in ("functions", "checks")
    ),
    (rta.printed.batch, "printed_attempt"),
    (rta.printed.source, "functions"),
    (rta.printed.files, "vectors"),
]
PARTS = "parameters", "known", "extra"  # of a filter, beside the limits
# of a filter, as they are written: they call what is printed
UNPRINTED = {name: getattr(SafetyFilter, name) for name in ("correct", "can_brake")}
RAND = torch.rand
LIMITS = "MAX_ATTITUDES", "MAX_STATES", "IN_VAIN"  # of how often states are drawn
OPTIMISED = build.FLAGS
QUICK = tuple(flag.replace("-O2", "-O0") for flag in OPTIMISED)


class Once:
    """Functions of a filter that are called once for equal filters, as long as the code is as it was written.

    Args:
        directory: where other processes with the same code leave what they computed, and read it; None: there are none.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self.directory = directory
        self.known: dict[tuple[Any, ...], Any] = {}
        self.written: list[tuple[Mapping[str, object], str, object]] = []

    def begin(self) -> None:
        """Takes the code as it is now for how it was written."""
        self.written = code()

    def call(self, run: Callable[..., Any], safety_filter: SafetyFilter, *more: Any, also: str = "") -> Any:
        """What the function gives, computed or known; `also`: what that depends on beside the filter and texts."""
        if any(names.get(name) is not value for names, name, value in self.written):
            return run(safety_filter, *more)  # a test has put something in a part's place
        own = tuple(map(id, safety_filter.extra))
        said = tuple(each for each in more if isinstance(each, str))  # all else is in filter or `also`
        key = (run, *said, also, printed_from(safety_filter), own, safety_filter.backup is None)
        if key not in self.known:
            compute = partial(run, safety_filter, *more)
            name = f"{run.__module__}.{run.__qualname__}"
            found = compute() if own or self.directory is None else self.kept(compute, repr((name, *key[1:])))
            self.known[key] = found, safety_filter.extra  # kept, so that ids stay theirs
        return self.known[key][0]

    def kept(self, compute: Callable[[], Any], name: str) -> Any:
        """What is in the directory under a name, or is computed and put there; a library that is loaded cannot be."""
        assert self.directory is not None
        path = self.directory / hashlib.sha256(name.encode()).hexdigest()
        if path.exists():
            return pickle.loads(path.read_bytes())
        found = compute()
        if not isinstance(found, Columns):
            own = path.with_suffix(f".{os.getpid()}")
            own.write_bytes(pickle.dumps(found))
            own.replace(path)  # whole or not at all
        return found


def printed_from(safety_filter: SafetyFilter) -> str:
    """What a filter is printed from: its `fingerprint`, less what episodes have beside `Limits`."""
    c, episode = safety_filter.c, Episode()
    if isinstance(c, Episode):
        c = replace(c, **{field.name: getattr(episode, field.name) for field in fields(Episode)})
    given = safety_filter.parameters, safety_filter.known, safety_filter.extra
    return fingerprint(cast(SafetyFilter, SimpleNamespace(c=c, **dict(zip(PARTS, given, strict=True)))))


def drawn(
    safety_filter: SafetyFilter, c: InspectionParameters, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Initial states that a filter accepts, priority vectors, and the state that the generator is left in."""
    x, priority = sample_initial_state(count, generator, c, safety_filter.is_safe)
    return x, priority, generator.get_state()


def draw(
    once: Once,
    count: int,
    generator: torch.Generator,
    c: InspectionParameters,
    is_safe: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """`sample_initial_state`, once for equal generators and filters, of which no part is a test's own."""
    owner = getattr(is_safe, "__self__", None)
    is_own = any(getattr(SafetyFilter, name) is not written for name, written in UNPRINTED.items())
    is_own |= torch.rand is not RAND  # a test watches what is drawn
    if type(owner) is not SafetyFilter or is_own or generator.device.type != "cpu":
        return sample_initial_state(count, generator, c, is_safe)
    known = [part is None for part in (owner.turn, owner.homing)]
    solver, limits = type(owner.solver).__name__, [getattr(initial_state, name) for name in LIMITS]
    own = torch.Generator().set_state(generator.get_state())
    also = repr((count, c, known, solver, limits, own.get_state().numpy().tobytes()))
    x, priority, left = once.call(drawn, owner, c, count, own, also=also)
    generator.set_state(left)
    return x.clone(), priority.clone()


def code() -> list[tuple[Mapping[str, object], str, object]]:
    """All functions, classes and constants of ROOMS, and what the classes hold: in what, by which name, and what.

    That a whole module is put in another's place is not seen.
    """
    found: list[tuple[Mapping[str, object], str, object]] = []
    for name, module in list(sys.modules.items()):
        if name.startswith(ROOMS):
            types = [value for value in vars(module).values() if isinstance(value, type)]
            for each in (module, *(own for own in types if own.__module__ == name)):
                left_out = UNPRINTED if each is SafetyFilter else {}
                found += [(vars(each), own, part) for own, part in vars(each).items() if own not in left_out]
    return found


def share(patch: pytest.MonkeyPatch, directory: Path | None) -> None:
    """Shares what is printed, built and drawn from now on, see `Once`."""
    once = Once(directory)
    for module, name in SHARED:
        patch.setattr(module, name, partial(once.call, getattr(module, name)))
    patch.setattr(build, "FLAGS", QUICK)
    shared = update_wrapper(partial(draw, once), sample_initial_state)  # a package still offers it as its own
    patch.setattr(initial_state, "sample_initial_state", shared)
    once.begin()
