"""Runs the tests that rounding could move as other processors round: with other kernels and numbers of threads.

    python -m tests.processors                                      # every setting, twenty minutes
    python -m tests.processors COMPATIBLE/default/1 AVX2/default/2  # these

MKL and PyTorch choose their kernels by the processor, and can be told to take those of another. A setting is
MKL_CBWR/ATEN_CPU_CAPABILITY/threads. Prints a line for each; the exit code is 1 if a test fails under one.
"""

import argparse
import itertools
import os
import subprocess
import sys
import time
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
# tests that fly or train a network, or compare its results with those of other code or another processor
SENSITIVE = (
    "test_golden.py",
    "ppo",
    "experiments/test_benchmark.py",
    "experiments/test_field.py::test_each_seed_is_summed_up_apart",
    "study/export/test_onnx.py",
    "study/export/test_policy.py::test_c_answers_as_pytorch",
    "study/training/test_jump_start.py::test_the_copy_does_what_the_guidance_would_in_states_of_its_own",
    "study/training/test_run.py",
    "study/training/test_study.py::test_each_seed_of_an_arm_equals_that_seed_trained_alone",
    "study/web/test_flight.py::test_an_episode_is_flown_as_in_python",
    "test_docs.py::test_a_page_prints_what_it_says[guides/your_own_policy]",
)
MKL = (
    "unset",
    "COMPATIBLE",
    "AVX2",
    *(["AVX512"] if torch.backends.cpu.get_cpu_capability() == "AVX512" else []),
)
SETTINGS = ["/".join(each) for each in itertools.product(MKL, ("default", "avx2"), "12")]
CORES = 2
THREADS = "TEST_THREADS"  # of each process of tests, one unless this variable says otherwise


def environment(setting: str) -> dict[str, str]:
    """Returns the variables of a process that computes under a setting; its threads do not spin while they wait."""
    names = "MKL_CBWR", "ATEN_CPU_CAPABILITY", THREADS
    own = dict(zip(names, setting.split("/"), strict=True)) | {"OMP_WAIT_POLICY": "passive"}
    return {name: value for name, value in (os.environ | own).items() if value != "unset"}


def passes(setting: str) -> bool:
    """Runs the tests under a setting, prints its line, with what failed below it, and says whether all passed."""
    started = time.perf_counter()
    workers = str(CORES // int(setting[-1]))
    command = [sys.executable, "-m", "pytest", "-n", workers, "--dist", "loadfile", "-rfE"]
    command += [f"tests/{each}" for each in SENSITIVE]
    done = subprocess.run(command, cwd=ROOT, env=environment(setting), capture_output=True, text=True)
    *lines, last = done.stdout.splitlines() or [done.stderr]
    print(f"{setting:24} {time.perf_counter() - started:4.0f} s  {last}", flush=True)
    for line in lines:
        if line.startswith(("FAILED", "ERROR")):
            print(f"    {line}")
    return done.returncode == 0


def main(words: list[str] | None = None) -> int:
    """Tries the settings that are named, or all; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.processors", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("settings", nargs="*", metavar="SETTING", help=f"of {', '.join(SETTINGS)}")
    given = parser.parse_args(words).settings
    for setting in given:
        if setting not in SETTINGS:
            parser.error(f"{setting}: must be one of {', '.join(SETTINGS)}")
    return int(not all([passes(setting) for setting in given or SETTINGS]))


if __name__ == "__main__":
    sys.exit(main())
