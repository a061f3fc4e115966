"""The machine that a command runs on: progress bars, device, threads, compiler, locks, and the record of all these."""

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

from ppo.distributed import is_first, ranks
from ppo.files import naming
from processors import processors
from settings import InputError, in_one_line, to_toml
from study.config import Config
from study.files import ROOT, read_json, write_json, write_text

PATIENCE = 2.0  # s, work that is done within this time shows no progress
LOCK = ".lock"  # file in a directory that a process works in
HELD = ".lock.held"  # file beside LOCK if the file system has no locks: it exists while a process works
LOCKS = LOCK, HELD
NFS_WITHOUT_LOCKS = 524  # Linux' own ENOTSUPP, which the errno module lacks
WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, NFS_WITHOUT_LOCKS}
# Compiling takes 3 s the first time. It saves time after this many filter calls or steps of a batch.
WORTH_COMPILING = 150
# An uncompiled filter flies its check in Python, up to 1 s a call; compiling the filter takes 4 to 10 s.
WORTH_COMPILING_FILTER = 10
MOST_THREADS = 4096  # the most used so far; numbers of threads that cannot be started end the process
PACKAGES = ("numpy", "piqp", "scipy", "tensorboard")  # beside PyTorch


# progress of long work


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Prints on stderr what takes longer than PATIENCE; with many ranks, only the first one prints."""
    timer = Timer(PATIENCE, print, (f"{what} ...",), {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if is_first():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def bar(total: int, unit: str, **options: Any) -> tqdm:
    """Makes a bar on stderr that shows, after PATIENCE, how many of `total` units are done; only on the first rank."""
    if not sys.stderr.isatty():  # a log file, in which the bar cannot be redrawn
        options |= {"mininterval": 10.0, "position": 0}
    return tqdm(total=total, unit=f" {unit}", delay=PATIENCE, disable=not is_first(), **options)


# device, threads and compiler


def resolve_device(name: str) -> torch.device:
    """Returns the device for auto, cpu or cuda; each rank of a machine has its own GPU."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: no CUDA device is available here; allowed are auto and cpu (--device cpu)"
        )
    if name == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    number = int(os.environ.get("LOCAL_RANK", 0))  # of this process on this machine, from torchrun
    if number >= torch.cuda.device_count():
        raise InputError(
            f"device cuda: {torch.cuda.device_count()} here, too few for rank {number} of this machine"
        )
    if number > 0:
        torch.cuda.set_device(number)
    return torch.device("cuda")


def set_threads(wanted: int | None, recorded: int | None = None) -> None:
    """Sets the number of threads of this process, whatever the machine's load, so that a seed determines a run.

    PyTorch sums in another order with another number of threads, so it has one by default. A printed function returns
    the same bits with any number of threads, so it uses all processors unless a person or OMP_NUM_THREADS sets fewer.

    Args:
        wanted: number from a person; recorded: PyTorch's number in the run that is to continue bit for bit.
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
    """Tells whether to compile for --compile auto, on or off; auto means on if the expected `calls` reach `worth`."""
    return (choice == "on" or (choice == "auto" and calls >= worth)) and finds_compiler()


@functools.cache
def finds_compiler() -> bool:
    """Tells whether there is a C compiler; if there is none, prints this once."""
    try:
        from kernels.build import NoCompilerError, compilers
    except ModuleNotFoundError:
        print("kernels/ is not here; uncompiled, this is slower", file=sys.stderr)
        return False
    try:
        compilers()
    except NoCompilerError as error:
        print(f"{error}; uncompiled, this is slower", file=sys.stderr)
        return False
    return True


def compile_or_explain(what: str, compile: Callable[[], None]) -> bool:
    """Compiles and returns whether this succeeded; if not, prints the reason in a line."""
    try:
        with announced(f"compiling the {what}, up to a minute"):
            compile()
    except Exception as error:  # many types: compiler missing or broken, cache full or read-only
        reason = in_one_line(f"{type(error).__name__}: {error}")[:200]
        print(f"the {what} could not be compiled ({reason}); uncompiled, it is slower", file=sys.stderr)
        return False
    return True


# the directory of a run: its lock and its description


@contextmanager
def directory_lock(directory: Path, flag: str) -> Iterator[None]:
    """Locks a directory against every other process; with many ranks, the first one locks it for all.

    If the file system has no locks, a file replaces the lock. The file exists as long as the process works, and a later
    process on the same machine takes it over if the process has died.

    Raises InputError, naming the flag, if another process holds the lock or the directory does not exist.
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
    """Acquires and returns the lock of a directory; raises Timeout if another process holds it."""
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
    if not (ROOT / ".git").exists():  # an archive of the sources, maybe inside another repository
        return "unknown"
    words = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def provenance(device: torch.device) -> dict[str, Any]:
    """Returns what determines a run's numbers besides the configuration: commit, versions, device, threads, ranks."""
    gpu = device.type == "cuda"
    return {
        "git_revision": git_revision(),
        "python": platform.python_version(),
        "packages": {"torch": torch.__version__}  # the version also names the build
        | {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(device) if gpu else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "ranks": ranks().size,
    }


def write_settings(config: Config, directory: Path, init_from: Path | None = None) -> None:
    """Writes the description of a run or study: provenance.json, with `init_from` and its digest, then config.toml."""
    about = provenance(resolve_device(config.train.device))
    if init_from:
        digest = hashlib.sha256(init_from.read_bytes()).hexdigest()
        about["init_from"] = {"file": str(init_from), "sha256": digest}
    write_json(directory / "provenance.json", about)
    write_text(directory / "config.toml", to_toml(config))


def recorded_threads(directory: Path) -> int | None:
    """Returns the number of threads of a run according to its provenance.json; None if the file does not say."""
    try:
        recorded = read_json(directory / "provenance.json", "provenance").get("threads")
    except InputError:
        return None
    return recorded if type(recorded) is int and 0 < recorded <= MOST_THREADS else None
