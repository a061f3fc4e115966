"""States for the filter in C and in Python back to back, and what each answers."""

import subprocess
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rta.fast.filter import batched
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.robust.filter import RobustFilter
from settings import load
from study.config import Config
from study.verification.limits import barriers, near_limits
from study.verification.starts import initial_states
from tests.rta.test_filter import CONFLICTS, commands, near_the_limits

CHUNK = 4096  # states that PyTorch filters at once
PROGRAM = """#include <stdio.h>
#include "safety_filter.h"

int main(void)
{
    double given[22];
    struct safety_filter_input in = {.state = {0.0}};
    while (fread(given, sizeof given, 1, stdin) == 1) {
        struct safety_filter_output out;
        double found[9 + (3 * SAFETY_FILTER_CONSTRAINTS)];
        for (int i = 0; i < 16; ++i) {
            in.state[i] = (safety_filter_real)given[i];
        }
        for (int j = 0; j < 6; ++j) {
            in.desired[j] = (safety_filter_real)given[16 + j];
        }
        safety_filter(&in, &out);
        for (int j = 0; j < 6; ++j) {
            found[j] = (double)out.control[j];
        }
        found[6] = out.status;
        found[7] = out.verified;
        found[8] = out.backup;
        for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
            found[9 + k] = (double)out.h[k];
            found[9 + SAFETY_FILTER_CONSTRAINTS + k] = (double)out.slack[k];
            found[9 + (2 * SAFETY_FILTER_CONSTRAINTS) + k] = out.active[k];
        }
        if (fwrite(found, sizeof found, 1, stdout) != 1) {
            return 1;
        }
    }
    return 0;
}
"""


class Answers(NamedTuple):
    """Holds the answers of N calls: control (6, N), status (1, N), check (2, N), h, slack, active (constraints, N).

    Attributes:
        check: verified, and another control is applied for that.
    """

    control: Tensor
    status: Tensor
    check: Tensor
    h: Tensor
    slack: Tensor
    active: Tensor


def made(kind: str, **more: object) -> SafetyFilter:
    """Returns the filter that is called every so many s, or the filter of a file in configs/plants."""
    if kind.isdigit():
        return SafetyFilter(parameters=RtaParameters(period=float(kind)), **more)
    config = load(Path(f"configs/plants/{kind}.toml"), Config())
    return RobustFilter(config.inspection, config.rta, uncertainty=config.uncertainty, **more)


def states(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Returns states (16, N) and desired controls (6, N), some beyond the actuators' limits.

    Of each 20, 6 are the paper's starts and of the safe set, 3 next to limits, 6 within some limits and beyond others,
    where many conflict, 3 far beyond, 1 recorded conflict, and 1 with a number that is none.
    """
    nominal = batched(SafetyFilter())
    part = -(-count // 20)
    recorded = torch.tensor([each["state"] for each in CONFLICTS], dtype=torch.float64).T
    wanted = torch.tensor([each["control_desired"] for each in CONFLICTS], dtype=torch.float64).T
    again = torch.arange(part) % recorded.shape[1]
    beyond = near_the_limits(3 * part, seed + 1)
    rng = np.random.default_rng(seed)
    beyond[:3] *= rng.uniform(0.3, 1.5, 3 * part)
    beyond[3:6] *= rng.uniform(0, 3, 3 * part)
    beyond[10:13] *= rng.uniform(0, 3, 3 * part)
    beyond[13], beyond[14] = rng.uniform(-10, 60, 3 * part), rng.uniform(-1, 5, 3 * part)
    hostile = near_the_limits(part, seed + 2)
    hostile[rng.integers(0, 16, part), range(part)] = rng.choice([np.nan, np.inf, -np.inf], part)
    x = [
        initial_states(6 * part, seed, nominal)[0],
        near_limits(3 * part, seed, nominal, partial(barriers, safety_filter=nominal), "cpu").state,
        *map(torch.from_numpy, (near_the_limits(6 * part, seed), beyond)),
        recorded[:, again],
        torch.from_numpy(hostile),
    ]
    desired = 1.1 * commands(20 * part, seed)
    vertex = torch.from_numpy(rng.random(20 * part) < 0.3)
    desired = torch.where(vertex, desired.sign() * desired.abs().amax(1, keepdim=True), desired)
    desired[:, 18 * part : 19 * part] = wanted[:, again]
    order = torch.from_numpy(rng.permutation(20 * part))[:count]
    return torch.cat(x, 1)[:, order].contiguous(), desired[:, order].contiguous()


@torch.no_grad()
def in_python(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> Answers:
    """Returns PyTorch's answers, by operations in batches, uncompiled."""
    other = batched(safety_filter)
    answers = []
    for pair in zip(x.split(CHUNK, 1), desired.split(CHUNK, 1), strict=True):
        r = other.correct(*pair)
        check = torch.stack((r.verified, r.backup))
        answers.append(Answers(r.control, r.status[None], check, r.h, r.slack, r.active))
    return Answers(*(torch.cat(each, 1) for each in zip(*answers, strict=True)))


def in_c(program: list[str | Path], x: Tensor, desired: Tensor) -> Answers:
    """Returns the answers of a program made from PROGRAM and the filter."""
    given = torch.cat((x, desired)).T.contiguous().numpy()
    done = subprocess.run(program, input=given.tobytes(), capture_output=True, timeout=3600)
    assert done.returncode == 0, done.stderr.decode(errors="replace")[:3000]
    found = torch.from_numpy(np.frombuffer(done.stdout).reshape(len(given), -1).T.copy())
    count = (len(found) - 9) // 3
    control, status, check, h, slack, active = found.split([6, 1, 2, count, count, count])
    return Answers(control, status.long(), check > 0, h, slack, active > 0)
