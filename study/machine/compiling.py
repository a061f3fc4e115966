"""Whether to compile what a run calls again and again, and what is said where that fails."""

import functools
import sys
from collections.abc import Callable

from kernels.build import NoCompilerError, compiler
from settings import in_one_line
from study.machine.progress import step

# Compiling takes 3 s the first time, which as many filter calls or steps (of a batch each) repay.
WORTH_COMPILING_FILTER = 150
WORTH_COMPILING_SIMULATOR = 150
# Where controls are held a call takes 0.5 to 1.4 s (32 to 256 spacecraft), compiled some ms; compiling takes 4 to 10.
WORTH_COMPILING_HELD = 30


def repaid_after(holds: bool) -> int:
    """Filter calls that repay compiling it.

    Args:
        holds: the filter's rows are of a control that is held, see `Uncertainty.holds`.
    """
    return WORTH_COMPILING_HELD if holds else WORTH_COMPILING_FILTER


def wants_compile(choice: str, repaid: bool) -> bool:
    """Whether to compile for --compile auto, on or off, given whether the run is long enough to repay it."""
    return (choice == "on" or (choice == "auto" and repaid)) and finds_compiler()


@functools.cache
def finds_compiler() -> bool:
    """Whether there is a C compiler; if not, says so, once."""
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
        reason = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
        reason = in_one_line(str(error)) if isinstance(error, NotImplementedError) else reason
        where = f": {error.filename}" if isinstance(error, OSError) and error.filename else ""
        print(
            f"the {what} could not be compiled ({reason}{where}); uncompiled, it is slower",
            file=sys.stderr,
        )
        return False
    return True
