"""Every vector form of Gymnasium flies, in processes too, after PyTorch has computed with several threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from study.files import ROOT

PROGRAM = """
import sys

import gymnasium
import numpy as np
import torch

from interfaces import RunTimeAssurance
from kernels.compiled import in_shares


def compute():
    torch.ones(2**17).exp(), torch.ones(300, 300) @ torch.ones(300, 300)
    assert in_shares(lambda first, last: last - first, 1000, 1.0) == 1000


class Computing(gymnasium.Wrapper):
    def step(self, action):
        compute()  # as an episode does that is large enough to share its work among threads
        return super().step(action)


def behind_filter(env):
    return RunTimeAssurance(env, period=10.0)


def flown(mode, wrappers, compile, **options):
    env = gymnasium.make_vec(
        "interfaces:Inspection6DoF-v0", 2, mode, options, [Computing, *wrappers], compile=compile
    )
    frames = [env.reset(seed=3)[0]] + [env.step(np.full((2, 6), 0.1))[0] for _ in range(2)]
    env.close()
    return np.stack(frames)


if __name__ == "__main__":
    forked, spawned = [{}, {"context": "fork", "shared_memory": False}], {"context": "spawn"}
    wrappers, compile, contexts = {
        "bare": ([], False, forked[1:]),
        "compiled": ([], True, forked),
        "behind the filter": ([behind_filter], False, [*forked, spawned]),
    }[sys.argv[1]]
    torch.set_num_threads(1)  # two may wait long for each other on a busy machine
    expected = flown("sync", wrappers, compile)
    torch.set_num_threads(2)
    compute()
    for options in contexts:
        found = flown("async", wrappers, compile, **options)
        assert np.array_equal(found, expected), (wrappers, compile, options)
    print("flown with", torch.get_num_threads())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
@pytest.mark.parametrize(
    "form",
    ["bare", *(pytest.param(form, marks=pytest.mark.campaign) for form in ("compiled", "behind the filter"))],
)
def test_gymnasiums_processes_fly_as_one_does(form: str, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(
        [sys.executable, str(program), form], env=environment, capture_output=True, text=True, timeout=120
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split()[-1] == "2"
