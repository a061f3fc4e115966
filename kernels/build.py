"""C code built into shared libraries, which are kept across runs."""

import ctypes
import functools
import hashlib
import itertools
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from processors import processors

R = TypeVar("R")
VARIABLE = "RTA_CACHE_DIR"  # names a directory for built libraries, instead of the user's cache directory
COMPILERS = ("clang", "gcc", "cc")  # clang's code takes 10 % less time, with the same bits
# No product is fused with a sum, so that all vector widths, and plain C, give the same bits. Code printed for one
# spacecraft is not vectorised: the search for vectors takes clang a third of its time and finds none.
FLAGS = (
    "-std=gnu11",
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fPIC",
    "-w",
    "-fno-tree-slp-vectorize",
)
# Additional flags; the first set that the compiler knows is used. They allow all instructions of this processor and its
# widest vectors. They turn off searches for computations shared by branches: these searches take half of the time, and
# code without branches has none.
NATIVE = "-march=native" if platform.machine().lower() in ("x86_64", "amd64", "i686") else "-mcpu=native"
CHOICES = ([NATIVE, "-mprefer-vector-width=512", "-fno-tree-pre", "-fno-code-hoisting"], [NATIVE])
WORK = "build-"  # the beginning of the names of directories for unfinished builds
ABANDONED = 3600.0  # s after which such a directory is removed, because its process must have been killed

# functions of math.h
QUICK = ("sqrt", "rint", "floor", "ceil", "trunc")  # single instructions
OF_ONE = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "exp2",
          "expm1", "log", "log2", "log10", "log1p", "erf", "erfc")  # fmt: skip
OWN = ("sin", "cos", "acos")  # in double precision, see functions.h
OF_TWO = ("atan2", "pow", "fmod", "hypot", "copysign")


class NoCompilerError(OSError):
    """Signals that no C compiler exists here, or that none works; says which and why in a line."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.strerror = reason  # code that catches any OSError shows this


def library(sources: Mapping[str, str]) -> ctypes.CDLL:
    """Returns C sources, by name, as one shared library; the cache provides it if it holds the same sources.

    If the cache cannot be used, a line on stderr says so, and the library lasts as long as this process.

    Raises:
        NoCompilerError: no compiler works.
    """
    whole = repr((sorted(sources.items()), FLAGS, CHOICES, versions(), processor()))
    name = hashlib.sha256(whole.encode()).hexdigest()[:32]
    directory = cache_dir()
    if directory is None:
        say(f"there is no home directory: what is compiled is not kept; ${VARIABLE} may say where to")
        return made(sources)
    if found := kept(directory, name, ".so", lambda path: ctypes.CDLL(str(path))):
        return found
    try:
        return ctypes.CDLL(str(keep(directory, name, ".so", lambda work: built(sources, work))))
    except OSError as error:
        result = made(sources)
        say(f"{directory}: {error.strerror or error}; what is compiled is not kept")
        return result


# the cache


def cache_dir() -> Path | None:
    """Returns where libraries are kept: $RTA_CACHE_DIR, or the user's cache directory; None without a home."""
    if chosen := os.environ.get(VARIABLE):
        return Path(chosen)
    with suppress(RuntimeError):  # the user has no home
        directory = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        if directory.is_absolute():
            return directory / "rta-inspection"
    return None


def kept(directory: Path, name: str, suffix: str, load: Callable[[Path], R]) -> R | None:
    """Returns what a file in the cache holds, None if it is missing or damaged.

    A truncated library would end the process when it is loaded, so a file's name holds its contents' digest.
    """
    for path in directory.glob(f"{name}.*{suffix}"):
        try:
            if path.name == f"{name}.{digest(path)}{suffix}":
                return load(path)
            say(f"{path}: damaged, made anew")
        except OSError as error:
            say(f"{path}: {error.strerror or error}; made anew")
    return None


def keep(directory: Path, name: str, suffix: str, make: Callable[[Path], Path]) -> Path:
    """Puts a file that `make` writes into a given directory into the cache, and returns its path there.

    It comes whole or not at all, since other processes may do the same.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for work in directory.glob(f"{WORK}*"):
        with suppress(OSError):
            if time.time() - work.stat().st_mtime > ABANDONED:
                shutil.rmtree(work)
    with tempfile.TemporaryDirectory(prefix=WORK, dir=directory) as folder:
        own = make(Path(folder))
        path = directory / f"{name}.{digest(own)}{suffix}"
        os.replace(own, path)
    for other in directory.glob(f"{name}.*{suffix}"):
        if other != path:
            with suppress(OSError):
                other.unlink()
    return path


def digest(path: Path) -> str:
    """Returns the digest of a file's contents."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


# the compiler


def made(sources: Mapping[str, str]) -> ctypes.CDLL:
    """Builds a library of which no file remains; raises NoCompilerError if that fails."""
    try:
        with tempfile.TemporaryDirectory(prefix=WORK, ignore_cleanup_errors=True) as work:
            path = built(sources, Path(work))
            try:
                return ctypes.CDLL(str(path))
            except OSError as error:
                raise NoCompilerError(f"what {compilers()[0][0]} built cannot be loaded: {error}") from error
    except NoCompilerError:
        raise
    except OSError as error:
        raise NoCompilerError(f"nothing can be built here: {error.strerror or error}") from error


def built(sources: Mapping[str, str], work: Path) -> Path:
    """Compiles sources in a directory of their own, in parallel, and links them, by the first compiler that can."""
    for name, text in sources.items():
        (work / f"{name}.c").write_text(text, encoding="utf-8")
    result, failures = work / "library.so", []
    for command, options in itertools.product(compilers(), (*CHOICES, [])):

        def call(*arguments: str, start: Sequence[str] = (*command, *FLAGS, *options)) -> str:
            return output((*start, *arguments), work)

        try:
            with ThreadPoolExecutor(processors()) as threads:
                list(threads.map(lambda name: call("-c", f"{name}.c", "-o", f"{name}.o"), sources))
            call("-shared", *(f"{name}.o" for name in sources), "-o", result.name, "-lm")
            return result
        except NoCompilerError as error:  # this compiler may not know the options
            failures.append(error)
    raise failures[0]


def output(command: Sequence[str], work: Path | None = None) -> str:
    """Returns what a call of the compiler prints; raises NoCompilerError if it fails."""
    own = {"LC_ALL": "C"} | ({"TMPDIR": str(work)} if work else {})
    try:
        done = subprocess.run(
            command, cwd=work, env=os.environ | own, capture_output=True, text=True, errors="replace"
        )
    except OSError as error:
        raise NoCompilerError(f"{command[0]}: {error.strerror or error}") from error
    if done.returncode:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        reason = next((line for line in said if "error" in line), said[-1] if said else "no reason given")
        raise NoCompilerError(f"{command[0]} failed ({done.returncode}): {reason}")
    return done.stdout


def compilers() -> list[tuple[str, ...]]:
    """Returns the C compilers' commands, the best first: $CC alone, perhaps with arguments, or the COMPILERS found.

    Raises:
        NoCompilerError: no compiler is found.
    """
    chosen = os.environ.get("CC", "").strip()
    found = []
    for name in [chosen] if chosen else COMPILERS:
        with suppress(ValueError):  # raised for quotes that are not closed
            for words in ([name], shlex.split(name)):
                if path := shutil.which(words[0]):
                    found.append((path, *words[1:]))
                    break
    if not found and chosen:
        raise NoCompilerError(f"$CC is {chosen}: there is no such compiler")
    if not found:
        raise NoCompilerError(f"no C compiler was found ({', '.join(COMPILERS)})")
    return found


def versions() -> list[str]:
    """Returns the compilers' commands, and the version text of the first one that works."""
    failures = []
    for command in compilers():
        try:
            return [*map(shlex.join, compilers()), version(command)]
        except NoCompilerError as error:
            failures.append(error)
    raise failures[0]


@functools.cache
def version(command: tuple[str, ...]) -> str:
    """Returns a compiler's version text."""
    return output((*command, "--version"))


@functools.cache
def processor() -> str:
    """Returns the processor's instructions, on which compiled code relies, or its name if Linux does not list them."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        return next((line for line in file if line.startswith(("flags", "Features"))), platform.machine())
    return platform.processor()


# text before printed functions


@functools.cache
def vector_bytes() -> int:
    """Returns the size in bytes of the processor's widest vectors; wider ones would be three times slower."""
    known = processor().split()
    return 64 if "avx512f" in known else 32 if "avx" in known else 16


def for_vectors(real: str) -> str:
    """Returns the text before functions printed for vectors of numbers, "double" or "float"."""
    lanes = vector_bytes() // (8 if real == "double" else 4)
    whole = "long" if real == "double" else "int"  # the type of comparisons' results
    head = [f"#define W {lanes}", f"typedef {whole} whole;", "#include <stdint.h>"]
    head += ["#include <stdlib.h>", "#include <string.h>"]
    head.append(f"#define LANES(f) {', '.join(f'f(a[{lane}])' for lane in range(lanes))}")
    head.append(f"#define LANES_OF_TWO(f) {', '.join(f'f(a[{lane}], b[{lane}])' for lane in range(lanes))}")
    head.append(f"#define OF_RECORDS(place) {', '.join(f'at[{lane}]->place' for lane in range(lanes))}")
    suffix = "" if real == "double" else "f"
    by_lane = [f"BY_LANE({name.upper()}, {name}{suffix}, inline)" for name in QUICK]
    by_lane += [f"BY_LANE({macro(name, real)}, {name}{suffix}, )" for name in OF_ONE]
    by_lane += [f"BY_LANE_OF_TWO({name.upper()}, {name}{suffix})" for name in OF_TWO]
    functions = [header("functions.h")] if real == "double" else []
    numbers = [f"typedef {real} real;", "#include <math.h>"]
    return "\n".join([*numbers, *head, header("vector.h"), *by_lane, *functions, ""])


def macro(name: str, real: str) -> str:
    """Returns the name of a math.h function in C before `functions.h`.

    Names of OWN belong to the functions of `functions.h`.
    """
    return f"LIBRARY_{name.upper()}" if real == "double" and name in OWN else name.upper()


def header(name: str) -> str:
    """Returns the text of a file beside this one."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


@functools.cache
def say(line: str) -> None:
    """Prints a line on stderr, once."""
    print(line, file=sys.stderr)
