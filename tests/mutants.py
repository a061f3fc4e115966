"""Plants faults in a copy of the code, one at a time, and runs the test that has to fail then.

    python -m tests.mutants [--workers N] [--log FILE] [WORDS]

Each of `tests.faults` that a test finds is killed; one that no test finds survives: a test is missing. The exit code is
1 unless all are killed. The checkout is left as it is. What is compiled is kept in a directory that is new for every
run of a test, so that no fault in C or in what is printed as C is hidden by a library of before.
"""

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import groupby
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import NamedTuple

from tests.faults import FAULTS, Fault

ROOT = Path(__file__).parents[1]
PASSED, FAILED, LATE = 0, 1, -1  # exit codes of pytest, and of a run that took too long
# only a test that ran and failed, or did not end, has killed a fault
VERDICTS = {PASSED: "survived", FAILED: "killed", LATE: "killed, the test does not end"}
SLOWER, MORE = 4.0, 60.0  # a test may take so many times as long as without a fault, and so many s more
PYTEST = ("-m", "pytest", "-x", "-rfE", "-p", "no:xdist", "-p", "no:cacheprovider")
ALL = ("-m", "campaign or not campaign")  # of the tests


class Run(NamedTuple):
    """What a test came to: pytest's exit code, or LATE; how long it took in s; the first test that failed."""

    code: int
    seconds: float
    failed: str


class Log:
    """What each fault came to, a line each on stdout and in a file, in which a run that stopped finds it again."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.lock = path, Lock()
        lines = path.read_text().splitlines() if path and path.exists() else []
        parts = [line.split("\t") for line in lines]
        self.known = {digest: outcome for outcome, _, digest, *_ in parts if outcome in VERDICTS.values()}

    def note(self, fault: Fault, outcome: str, run: Run) -> None:
        """Adds a fault's line."""
        line = "\t".join((outcome, f"{run.seconds:.0f} s", digest_of(fault), str(fault), run.failed))
        with self.lock:
            self.known[digest_of(fault)] = outcome
            print(line, flush=True)
            if self.path:
                with self.path.open("a") as file:
                    print(line, file=file)


@cache  # as it was when faults were chosen, however long they take
def digest_of(fault: Fault) -> str:
    """What tells a fault from others, and from itself in other code: its texts, its file and its test's."""
    files = (ROOT / name for name in (fault.path, fault.test_file))
    parts = repr(fault).encode(), *(path.read_bytes() for path in files)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]


def copy_of_the_code(directory: Path) -> Path:
    """A copy of all files but those that git ignores."""
    command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():  # it may have been deleted and not committed
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, directory / name)
    return directory


@contextmanager
def planted(fault: Fault, tree: Path) -> Iterator[None]:
    """Has a copy of the code hold a fault; raises ValueError where its line is not there once."""
    path = tree / fault.path
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault}: stands {text.count(fault.old)} times there, must stand once")
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(text, encoding="utf-8")


def tested(test: str, tree: Path, patience: float | None = None) -> Run:
    """Runs a test in a copy of the code, for so many s at most.

    No bytecode is kept: a fault of the same length, planted in the same second, would be taken for the file before.
    """
    file, _, names = test.partition(" -k ")
    command = [sys.executable, *PYTEST, *ALL, f"tests/{file}", *(["-k", names] if names else [])]
    own = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
        environment = os.environ | own | {"RTA_CACHE_DIR": cache}
        try:
            done = subprocess.run(
                command, cwd=tree, env=environment, capture_output=True, text=True, timeout=patience
            )
        except subprocess.TimeoutExpired:
            return Run(LATE, time.perf_counter() - started, "")
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return Run(done.returncode, time.perf_counter() - started, found[1] if found else "")


def tried(faults: Sequence[Fault], tree: Path, log: Log) -> None:
    """Tries faults that the same test has to find, once it passes without any."""
    sound = tested(faults[0].test, tree)
    if sound.code != PASSED:
        for fault in faults:
            log.note(fault, f"no verdict, the test fails without it (exit code {sound.code})", sound)
        return
    print(f"{faults[0].test}: passes without a fault in {sound.seconds:.0f} s", flush=True)
    for fault in faults:
        try:
            with planted(fault, tree):
                run = tested(fault.test, tree, SLOWER * sound.seconds + MORE)
        except ValueError as error:
            log.note(fault, f"no verdict, {error}", sound)
        else:
            log.note(fault, VERDICTS.get(run.code, f"no verdict, exit code {run.code}"), run)


def main(arguments: Sequence[str] | None = None) -> int:
    """Tries the faults that are asked for; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Plant faults in a copy of the code; a test has to find each."
    )
    parser.add_argument("words", nargs="?", default="", help="only faults whose file, line or test has these")
    parser.add_argument("--workers", type=int, default=1, help="tests at once")
    parser.add_argument("--log", type=Path, help="file of outcomes, which a later run goes on with")
    given = parser.parse_args(arguments)
    log = Log(given.log)
    faults = [fault for fault in FAULTS if given.words in f"{fault}\t{fault.test}"]
    todo = sorted(
        (fault for fault in faults if digest_of(fault) not in log.known), key=lambda each: each.test
    )
    trees: SimpleQueue[Path] = SimpleQueue()
    with tempfile.TemporaryDirectory() as directory:
        for i in range(given.workers):
            trees.put(copy_of_the_code(Path(directory) / str(i)))

        def in_a_tree(group: Sequence[Fault]) -> None:
            tree = trees.get()
            try:
                tried(group, tree, log)
            finally:
                trees.put(tree)

        groups = [list(group) for _, group in groupby(todo, key=lambda fault: fault.test)]
        with ThreadPoolExecutor(given.workers) as workers:
            list(workers.map(in_a_tree, groups))
    left = [fault for fault in faults if not log.known[digest_of(fault)].startswith("killed")]
    print(f"{len(faults) - len(left)} of {len(faults)} faults killed")
    for fault in left:
        print(f"{log.known[digest_of(fault)]}: {fault}, by {fault.test}")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
