"""Filters in C that tests share: each is traced and built once in a process, and not optimised.

That takes ten seconds, and many tests fly the same few filters. Processes of one run of pytest-xdist read what another
one has printed. A test that puts something in a part's place has a filter of its own. tests/kernels builds as users do;
`test_optimisation_changes_no_bit_of_a_filter` there says that the compiler's optimisation does not matter.
"""

import hashlib
import os
import pickle
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import rta.filter
import rta.printed.batch
import rta.printed.files
import rta.printed.source
from inspection.model.parameters import Episode
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
    (rta.printed.batch, "now_parts"),
    (rta.printed.batch, "held_parts"),
    (rta.printed.source, "functions"),
    (rta.printed.files, "vectors"),
]
PARTS = "parameters", "known", "extra"  # of a filter, beside the limits
ANSWERS = ("rta.filter", "SafetyFilter", "correct")  # what calls the printed functions is not printed
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
        said = tuple(each for each in more if isinstance(each, str))  # all else is made from the filter
        key = (run, *said, printed_from(safety_filter), own, safety_filter.backup is None)
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


def code() -> dict[tuple[str, ...], object]:
    """All functions, classes and constants of ROOMS, and what the classes hold, by name."""
    found: dict[tuple[str, ...], object] = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(ROOMS):
            for own, value in vars(module).items():
                found[name, own] = value
                if isinstance(value, type) and value.__module__ == name:
                    found |= {(name, own, part): each for part, each in vars(value).items()}
    del found[ANSWERS]
    return found


def share(patch: pytest.MonkeyPatch, directory: Path | None) -> None:
    """Shares what is printed and built from now on, see `Once`."""
    once = Once(directory)
    for module, name in SHARED:
        patch.setattr(module, name, partial(once.call, getattr(module, name)))
    patch.setattr(build, "FLAGS", QUICK)
    once.begin()
