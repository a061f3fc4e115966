"""C built into shared libraries, which are kept across runs."""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

VARIABLE = "RTA_CACHE_DIR"  # the directory of what was built, instead of the user's cache directory
COMPILERS = ("cc", "gcc", "clang")
# No product is fused with a sum, so that all vector widths, and plain C, give the same bits.
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-w")


class NoCompilerError(OSError):
    """There is no C compiler here, or none that works."""


def library(sources: Mapping[str, str]) -> ctypes.CDLL:
    """C sources, by name, as one shared library: from the cache where it holds the same.

    Raises NoCompilerError where there is no working compiler.
    """
    whole = repr((sorted(sources.items()), command(), version(), processor()))
    fingerprint = hashlib.sha256(whole.encode())
    name = fingerprint.hexdigest()[:32]
    directory = cache_dir()
    found = kept(directory, name)
    if found is None:
        found = built(sources)
        with suppress(OSError):
            return loaded(keep(directory, name, found))
        say(f"{directory}: cannot be written, so that what is compiled is not kept")
        return loaded(found)
    return loaded(found)


def loaded(path: Path) -> ctypes.CDLL:
    """A shared library."""
    return ctypes.CDLL(str(path))


def kept(directory: Path, name: str) -> Path | None:
    """The library of this name in the cache; None where there is none, or one that is not as it was built.

    A truncated library would end the process when it is loaded, so its name holds its contents' digest.
    """
    try:
        for path in directory.glob(f"{name}.*.so"):
            if path.name == f"{name}.{digest(path)}.so":
                return path
            say(f"{path}: damaged, compiled anew")
    except OSError as error:
        say(f"{directory}: {error.strerror or error}; compiled anew")
    return None


def keep(directory: Path, name: str, built: Path) -> Path:
    """Puts a library into the cache, whole or not at all: other processes may be doing the same."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{name}.{digest(built)}.so"
    own = directory / f"{name}.{os.getpid()}.part"
    try:
        shutil.copyfile(built, own)
        os.replace(own, path)
    finally:
        own.unlink(missing_ok=True)
    for other in directory.glob(f"{name}.*.so"):
        if other != path:
            other.unlink(missing_ok=True)
    return path


def digest(path: Path) -> str:
    """Of a file's contents."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def built(sources: Mapping[str, str]) -> Path:
    """Compiles sources, some at once, and links them; the library's directory lasts as long as this process."""
    directory = Path(temporary().name)
    with tempfile.TemporaryDirectory() as work:
        for name, text in sources.items():
            (Path(work) / f"{name}.c").write_text(text, encoding="utf-8")
        with ThreadPoolExecutor(os.cpu_count() or 1) as threads:
            list(threads.map(lambda name: cc(work, "-c", f"{name}.c", "-o", f"{name}.o"), sources))
        result = directory / f"{hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()[:16]}.so"
        cc(work, "-shared", *(f"{name}.o" for name in sources), "-o", str(result), "-lm")
    return result


def cc(work: str, *arguments: str) -> None:
    """Calls the compiler in a directory."""
    done = subprocess.run(
        [*command(), *arguments], cwd=work, capture_output=True, text=True, errors="replace"
    )
    if done.returncode:
        reason = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:200])
        raise NoCompilerError(f"{command()[0]} failed: {reason.strip()}")


@functools.cache
def temporary() -> "tempfile.TemporaryDirectory[str]":
    """A directory until the process ends."""
    return tempfile.TemporaryDirectory(prefix="rta-", ignore_cleanup_errors=True)


def compiler() -> str:
    """The C compiler: $CC, or the first of COMPILERS that is there; NoCompilerError without one."""
    for name in (os.environ.get("CC", ""), *COMPILERS):
        if name and (path := shutil.which(name)):
            return path
    raise NoCompilerError(f"no C compiler was found ({', '.join(COMPILERS)})")


@functools.cache
def command() -> tuple[str, ...]:
    """The compiler and its flags for this processor."""
    native = "-march=native" if platform.machine().lower() in ("x86_64", "amd64", "i686") else "-mcpu=native"
    return (compiler(), *FLAGS, native)


@functools.cache
def version() -> str:
    """What the compiler says of itself."""
    done = subprocess.run([compiler(), "--version"], capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise NoCompilerError(f"{compiler()} --version failed")
    return done.stdout


@functools.cache
def processor() -> str:
    """What compiled code may rely on: the processor's instructions, or its name where Linux does not list them."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        return next((line for line in file if line.startswith(("flags", "Features"))), platform.machine())
    return platform.processor()


@functools.cache
def vector_bytes() -> int:
    """Of the processor's widest vectors; wider ones than these are three times as slow."""
    known = processor().split()
    return 64 if "avx512f" in known else 32 if "avx" in known else 16


def cache_dir() -> Path:
    """Where libraries are kept: $RTA_CACHE_DIR, or the user's cache directory."""
    if chosen := os.environ.get(VARIABLE):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rta-inspection"


def for_vectors(real: str) -> str:
    """What stands before functions that are printed for vectors of numbers, "double" or "float"."""
    lanes = vector_bytes() // (8 if real == "double" else 4)
    whole = "long" if real == "double" else "int"  # what comparisons give
    head = [f"#define W {lanes}", f"typedef {whole} whole;", "#include <stdint.h>", "#include <string.h>"]
    suffix = "" if real == "double" else "f"
    by_lane = [f"BY_LANE({name.upper()}, {name}{suffix}, inline)" for name in QUICK]
    by_lane += [f"BY_LANE({name.upper()}, {name}{suffix}, )" for name in OF_ONE]
    by_lane += [f"BY_LANE_OF_TWO({name.upper()}, {name}{suffix})" for name in OF_TWO]
    return "\n".join([*numbers(real), *head, header("vector.h"), *by_lane, ""])


def for_one(real: str) -> str:
    """What stands before functions that are printed for one column."""
    suffix = "" if real == "double" else "f"
    names = [f"#define {name.upper()} {name}{suffix}" for name in (*QUICK, *OF_ONE, *OF_TWO, "fabs")]
    return "\n".join([*numbers(real), header("scalar.h"), *names, ""])


def numbers(real: str) -> list[str]:
    """The type of numbers, and their functions."""
    return [f"typedef {real} real;", "#include <math.h>"]


def header(name: str) -> str:
    """A file beside this one."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


# functions of math.h
QUICK = ("sqrt", "rint", "floor", "ceil", "trunc")  # single instructions
OF_ONE = ("sin", "cos", "tan", "acos", "asin", "atan", "exp", "log", "tanh", "sinh", "cosh", "asinh", "erf")
OF_TWO = ("atan2", "pow")


def say(line: str) -> None:
    """One line on stderr."""
    print(line, file=sys.stderr)
