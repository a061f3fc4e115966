"""The machine that a command runs on: what it shows, device, threads, compiler, locks, and what describes it all."""

import errno
import functools
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import Any

import torch
from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout
from tqdm import tqdm

from ppo.distributed import is_first, local_rank, ranks
from ppo.files import naming
from processors import processors
from settings import InputError, in_one_line, to_toml
from study.config import Config
from study.files import ROOT, read_json, write_json, write_text

PATIENCE = 2.0  # s in which nobody needs to be told what is going on
LOCK = ".lock"  # in a directory that a process works in
HELD = ".lock.held"  # beside it where the file system knows no locks: there while a process works
LOCKS = LOCK, HELD
NFS_WITHOUT_LOCKS = 524  # Linux' own ENOTSUPP, which the errno module lacks
WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, NFS_WITHOUT_LOCKS}
# Compiling takes 3 s the first time, which as many filter calls or steps (of a batch each) repay.
WORTH_COMPILING = 150
# A call of a filter that is not compiled flies its check in Python, up to a second; compiling it takes 4 to 10.
WORTH_COMPILING_FILTER = 10
MOST_THREADS = (
    4096  # that any machine was used with; so many more that they cannot be started end the process
)
PACKAGES = ("numpy", "piqp", "scipy", "tensorboard")  # beside PyTorch


# what a person sees of work that takes long


@contextmanager
def step(what: str) -> Iterator[None]:
    """Says on stderr what takes longer than PATIENCE; of many ranks, the first one."""
    timer = Timer(PATIENCE, print, (f"{what} ...",), {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if is_first():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def bar(total: int, unit: str, **options: Any) -> tqdm:
    """Makes a bar on stderr of how many of so many units are done, from PATIENCE on; of many ranks, the first one's."""
    if not sys.stderr.isatty():  # a log, which cannot go back in its lines
        options |= {"mininterval": 10.0, "position": 0}
    return tqdm(total=total, unit=f" {unit}", delay=PATIENCE, disable=not is_first(), **options)


# what computes


def resolve_device(name: str) -> torch.device:
    """Returns the device for auto, cpu or cuda; each rank of a machine has one of its own."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: no CUDA device is available here; allowed are auto and cpu (--device cpu)"
        )
    if name == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    if local_rank() >= torch.cuda.device_count():
        raise InputError(
            f"device cuda: {torch.cuda.device_count()} here, too few for rank {local_rank()} of this machine"
        )
    if local_rank() > 0:
        torch.cuda.set_device(local_rank())
    return torch.device("cuda")


def set_threads(wanted: int | None, recorded: int | None = None) -> None:
    """Sets how many threads this process computes with, never by the load of the machine, so that a seed fixes a run.

    PyTorch adds up in another order with another number of threads, so that it has one by default. A printed function
    has the same bits on any number of threads: it has all processors, unless a person or OMP_NUM_THREADS says less.

    Args:
        wanted: by a person; recorded: with how many of PyTorch's a run was begun that is to continue bit for bit.
    """
    if wanted is not None and wanted > (most := os.cpu_count() or 1):
        raise InputError(
            f"--threads {wanted}: must be at most {most}, the number of this machine's processors; more threads "
            "only wait for each other, and very many cannot be started"
        )
    said = wanted is not None or "OMP_NUM_THREADS" in os.environ
    with suppress(ModuleNotFoundError):
        from kernels import compiled

        compiled.most_threads = None if said else processors()
    if given := wanted or recorded:
        torch.set_num_threads(given)
    elif not said:
        torch.set_num_threads(1)


def wants_compile(choice: str, calls: float, worth: int = WORTH_COMPILING) -> bool:
    """Tells whether to compile for --compile auto, on or off; `calls` are to come, `worth` repay it."""
    return (choice == "on" or (choice == "auto" and calls >= worth)) and finds_compiler()


@functools.cache
def finds_compiler() -> bool:
    """Tells whether there is a C compiler; if not, says so, once."""
    try:
        from kernels.build import NoCompilerError, compiler
    except ModuleNotFoundError:
        print("kernels/ is not here; uncompiled, this is slower", file=sys.stderr)
        return False
    try:
        compiler()
    except NoCompilerError as error:
        print(f"{error}; uncompiled, this is slower", file=sys.stderr)
        return False
    return True


def compile_or_explain(what: str, compile: Callable[[], None]) -> bool:
    """Compiles; where that fails, says so in a line. Returns whether it went well."""
    try:
        with step(f"compiling the {what}, up to a minute"):
            compile()
    except Exception as error:  # a missing or broken compiler, a full or read-only cache: in many ways
        reason = in_one_line(f"{type(error).__name__}: {error}")[:200]
        print(f"the {what} could not be compiled ({reason}); uncompiled, it is slower", file=sys.stderr)
        return False
    return True


# a directory and what describes a run in it


@contextmanager
def directory_lock(directory: Path, flag: str) -> Iterator[None]:
    """Keeps every other process out of a directory; of many ranks, the first one does for all.

    Where the file system knows no locks, a file does that is there as long as the process works, and that a later
    process on the same machine takes over from a dead one.

    Raises InputError, naming the flag, where another process has it or there is no such directory.
    """
    taken: list[BaseFileLock] = []

    def acquire() -> None:
        if not directory.is_dir():
            raise InputError(f"{flag} {directory}: No such file or directory")
        try:
            taken.append(locked(directory))
        except Timeout as held:
            dead = f"; if none is, delete {held.lock_file}" if held.lock_file.endswith(HELD) else ""
            raise InputError(f"{flag} {directory}: is being trained by another process{dead}") from None

    ranks().first_does(acquire)
    try:
        yield
    finally:
        for lock in taken:
            lock.release()


def locked(directory: Path) -> BaseFileLock:
    """Returns the lock of a directory, taken; raises Timeout where another process has it."""
    lock = FileLock(directory / LOCK, timeout=0, fallback_to_soft=False)
    try:
        with naming(directory / LOCK):
            lock.acquire()
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        lock = SoftFileLock(directory / HELD, timeout=0)
        lock.acquire()
    return lock


def git_revision() -> str:
    """Returns the commit of the source tree, marked if modified; "unknown" outside a repository."""
    if not (ROOT / ".git").exists():  # an archive of the sources, maybe below another repository
        return "unknown"
    words = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def provenance(device: torch.device) -> dict[str, Any]:
    """Returns what else determines a run's numbers, beside its configuration."""
    gpu = device.type == "cuda"
    return {
        "git_revision": git_revision(),
        "python": platform.python_version(),
        "packages": {"torch": torch.__version__}  # which says of which build, too
        | {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(device) if gpu else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "ranks": ranks().size,
    }


def write_settings(config: Config, directory: Path, init_from: Path | None = None) -> None:
    """Writes what describes a run or a study: provenance.json, with the file it started from, then config.toml."""
    about = provenance(resolve_device(config.train.device))
    if init_from:
        digest = hashlib.sha256(init_from.read_bytes()).hexdigest()
        about["init_from"] = {"file": str(init_from), "sha256": digest}
    write_json(directory / "provenance.json", about)
    write_text(directory / "config.toml", to_toml(config))


def recorded_threads(directory: Path) -> int | None:
    """Returns the threads that provenance.json says a run was begun with; None where it does not say."""
    try:
        recorded = read_json(directory / "provenance.json", "provenance").get("threads")
    except InputError:
        return None
    return recorded if type(recorded) is int and 0 < recorded <= MOST_THREADS else None
