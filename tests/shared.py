"""Filters in C that tests share: each is traced and built once in a process, and not optimised.

That takes ten seconds, and many tests fly the same few filters. A test that puts something in a part's place has a
filter of its own. tests/kernels builds as users do; `test_optimisation_changes_no_bit_of_a_filter` there says that the
compiler's optimisation does not matter.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

import rta.filter
import rta.printed.batch
import rta.printed.files
import rta.printed.source
from kernels import build
from rta import SafetyFilter
from rta.printed.files import fingerprint

ROOMS = ("inspection.chief", "inspection.model", "kernels", "rta")  # of what a filter is printed from
SHARED = [  # functions of a filter, where they are called from
    (rta.filter, "BatchFilter"),
    *(
        (module, name)
        for module in (rta.printed.batch, rta.printed.files)
        for name in ("functions", "checks")
    ),
    (rta.printed.source, "functions"),
    (rta.printed.files, "vectors"),
]
OPTIMISED = build.FLAGS
QUICK = tuple(flag.replace("-O2", "-O0") for flag in OPTIMISED)


class Once:
    """Functions of a filter that are called once for equal filters, as long as the code is as it was written."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, ...], Any] = {}
        self.written: dict[tuple[str, ...], object] = {}

    def begin(self) -> None:
        """Takes the code as it is now for how it was written."""
        self.written = code()

    def call(self, run: Callable[..., Any], safety_filter: SafetyFilter, *more: Any) -> Any:
        """What the function gives, computed or known."""
        now = code()
        if any(now.get(name) is not value for name, value in self.written.items()):
            return run(safety_filter, *more)  # a test has put something in a part's place
        own = tuple(map(id, safety_filter.extra))
        key = (run, *more, fingerprint(safety_filter), own, safety_filter.backup is None)
        if key not in self.known:
            self.known[key] = run(safety_filter, *more), safety_filter.extra  # kept, so that ids stay theirs
        return self.known[key][0]


def code() -> dict[tuple[str, ...], object]:
    """All functions, classes and constants of ROOMS, and what the classes hold, by name."""
    found: dict[tuple[str, ...], object] = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(ROOMS):
            for own, value in vars(module).items():
                found[name, own] = value
                if isinstance(value, type) and value.__module__ == name:
                    found |= {(name, own, part): each for part, each in vars(value).items()}
    return found


def share(patch: pytest.MonkeyPatch) -> None:
    """Shares what is printed and built from now on."""
    once = Once()
    for module, name in SHARED:
        patch.setattr(module, name, partial(once.call, getattr(module, name)))
    patch.setattr(build, "FLAGS", QUICK)
    once.begin()
