"""Stack, code and time of the filter in C.

    python -m tests.rta.fast.export_sizes

prints the rows of this table of docs/guides/export.md, in some minutes; gcc is needed. Behind a row stands the stack on
ARM, 64 and 32 bit, where there are its compilers for that.
"""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rta.fast.files import sources
from tests.rta.fast.export_states import made, states

GRAPH = ("-fstack-usage", "-fcallgraph-info=su")  # writes what calls what, and the stack of each
ARM = ("aarch64-linux-gnu-gcc", "arm-linux-gnueabihf-gcc")
PARTS = ("safety_filter.h", "safety_filter.c")
KINDS = ("1", "5", "10", "u1")
COUNT, REPEATED = 20_000, 3  # states, and calls of each, of which the shortest counts
TIMED = """#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "safety_filter.h"

int main(void)
{
    double given[22];
    struct safety_filter_input in = {.state = {0.0}};
    while (fread(given, sizeof given, 1, stdin) == 1) {
        double least = 1e9;
        for (int i = 0; i < 16; ++i) {
            in.state[i] = (safety_filter_real)given[i];
        }
        for (int j = 0; j < 6; ++j) {
            in.desired[j] = (safety_filter_real)given[16 + j];
        }
        for (int k = 0; k < REPEATED; ++k) {
            struct safety_filter_output out;
            struct timespec begin, end;
            clock_gettime(CLOCK_MONOTONIC, &begin);
            safety_filter(&in, &out);
            clock_gettime(CLOCK_MONOTONIC, &end);
            double took = 1e6 * (double)(end.tv_sec - begin.tv_sec) + 1e-3 * (double)(end.tv_nsec - begin.tv_nsec);
            least = took < least ? took : least;
        }
        if (fwrite(&least, sizeof least, 1, stdout) != 1) {
            return 1;
        }
    }
    return 0;
}
"""


def deepest(graph: str) -> int:
    """Returns the stack of the deepest chain of calls from safety_filter, in B; fails if a function recurses."""
    sizes = {
        name: int(size) for name, size in re.findall(r'title: "([^"]+)" label: "[^"]*?\\n(\d+) bytes', graph)
    }
    calls: dict[str, set[str]] = {}
    for caller, called in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
        calls.setdefault(caller, set()).add(called)

    def below(name: str, above: tuple[str, ...]) -> int:
        assert name not in above, f"{name} recurses"
        return sizes.get(name, 0) + max((below(n, (*above, name)) for n in calls.get(name, ())), default=0)

    return below("safety_filter", ())


def stack_and_code(directory: Path, compiler: str) -> tuple[int, int]:
    """Returns the deepest stack and the size of code and constants, in B, of a compiler's output, COMPILER.o."""
    own = ("-c", directory / "safety_filter.c", "-o", f"{compiler}.o")
    subprocess.run((compiler, "-std=c99", "-O2", *GRAPH, *own), cwd=directory, check=True)
    size = subprocess.run(
        ("size", directory / f"{compiler}.o"), capture_output=True, text=True, check=True
    ).stdout
    return deepest((directory / f"{compiler}.ci").read_text()), int(size.splitlines()[1].split()[0])


def linked(directory: Path, name: str, text: str, *more: str) -> Path:
    """Returns a program with the filter that `stack_and_code` has made with gcc."""
    (directory / f"{name}.c").write_text(text)
    own = (directory / f"{name}.c", directory / "gcc.o", "-o", directory / name, "-lm")
    subprocess.run(("gcc", "-O2", *more, "-I", directory, *own), check=True)
    return directory / name


def times(program: Path, x: Tensor, desired: Tensor) -> np.ndarray:
    """us of a call, of each state; program: of TIMED."""
    given = torch.cat((x, desired)).T.contiguous().numpy().tobytes()
    return np.frombuffer(subprocess.run([program], input=given, capture_output=True, check=True).stdout)


def main() -> None:
    """Measures and prints."""
    x, desired = states(COUNT, seed=1)
    finite = x.isfinite().all(0)
    x, desired = x[:, finite], desired[:, finite]
    print(f"{x.shape[1]:,} states")
    for kind in KINDS:
        safety_filter = made(kind)
        with tempfile.TemporaryDirectory() as folder:
            directory = Path(folder)
            for name, text in sources(safety_filter, only=PARTS).items():
                (directory / name).write_text(text)
            stack, code = stack_and_code(directory, "gcc")
            arm = [f"{stack_and_code(directory, each)[0]:,}" for each in ARM if shutil.which(each)]
            took = times(linked(directory, "timed", TIMED, f"-DREPEATED={REPEATED}"), x, desired)
        middle, high, longest = (*np.quantile(took, (0.5, 0.99)), took.max())
        print(
            f"| {kind} | {stack:,} | {code / 1e3:.0f} | {middle:.1f}, {high:.1f}, {longest:.1f} |",
            *arm,
            flush=True,
        )


if __name__ == "__main__":
    main()
