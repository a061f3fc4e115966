"""What is flown to be measured: agents, and the states, controls and programs that they meet."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.closed_loop import Correction
from inspection.environment import InspectionEnv
from ppo.errors import CheckpointError
from rta.filter import SafetyFilter
from rta.propose import demanded
from rta.qp.programs import Problems
from rta.qp.scaled import prepared, problems
from settings import InputError
from study.experiment import Experiment, load_policy
from study.files import ROOT

TRAINED = ROOT / "runs/reference/study/rta/seed0/policy.pt"
RECORDED = 16_384  # states whose programs are kept
EPISODES, STEPS = 256, 60  # flown to record states, controls and programs, from a typical half of them on
Agent = Callable[[Tensor], Tensor]  # observations (B, n) to actions (B, 6)


class Sample(NamedTuple):
    """What a closed loop met, shuffled: states (16, N), desired controls (6, N), programs by actuator group."""

    x: Tensor
    desired: Tensor
    programs: list[Problems]

    def take(self, count: int) -> tuple[Tensor, Tensor]:
        """The first `count` states and desired controls, repeated as often as needed."""
        return cycled(self.x, count), cycled(self.desired, count)

    def start(self, env: InspectionEnv) -> Tensor:
        """Puts states met in flight into every episode; returns the observations."""
        count = env.time.numel()
        return env.start(cycled(self.x, count), cycled(torch.eye(3).to(self.x), count))


def cycled(x: Tensor, count: int) -> Tensor:
    """The first `count` columns of x, repeated as often as needed."""
    return x[..., torch.arange(count, device=x.device) % x.shape[-1]].contiguous()


def untrained(experiment: Experiment) -> Agent:
    """A policy as training begins with it, exploring."""
    generators = experiment.generators()
    policy = experiment.policy(generators)
    return lambda observation: policy.shaped(policy.sample(observation[None], generators)[0])[0]


def trained(experiment: Experiment) -> tuple[Experiment, Agent] | None:
    """The shipped agent, and the experiment with what it observes.

    None, and a line that says so, where it cannot be loaded.
    """
    try:
        policy, config = load_policy(TRAINED)
    except (CheckpointError, InputError) as error:
        print(f"no trained agent, so only programs of the untrained one are solved: {error}", flush=True)
        return None
    policy = policy.to(experiment.device)
    seeing = copy(experiment)  # the filter is shared
    seeing.task = replace(experiment.task, observed=config.inspection.observed)
    return seeing, lambda observation: policy.mean_action(observation[None])[0]


def record(experiment: Experiment, agent: Agent) -> Sample:
    """Plays EPISODES from the initial distribution, and keeps what the filter meets in the later half of STEPS.

    Of a filter whose rows are of the rate of now also programs that it must solve.
    """
    met: list[tuple[Tensor, Tensor]] = []

    def correct(x: Tensor, desired: Tensor, **told: Tensor) -> Correction:
        met.append((x, desired))
        return experiment.filter.correct(x, desired, **told)

    env = experiment.env(EPISODES, compiled=experiment.compiled)
    env.put_behind(replace(experiment.safety, correct=correct))
    observation = env.reset()
    for i in range(STEPS):
        if i == STEPS // 2:
            met.clear()
        observation = env.step(agent(observation)).observation
    x, desired = (torch.cat(parts, 1) for parts in zip(*met, strict=True))
    order = shuffled(x)
    x, desired = x[:, order], desired[:, order]
    some = (
        () if experiment.filter.holds else programs(experiment.filter, x[:, :RECORDED], desired[:, :RECORDED])
    )
    return Sample(x, desired, [part for part in some if part.desired.numel()])


def programs(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> list[Problems]:
    """What must be solved at states (16, B) where these controls (6, B) are desired, by actuator group."""
    wish, control, _ = demanded(desired, safety_filter.groups)
    found = []
    for group in safety_filter.groups:
        rows = prepared(group, x, control)
        unsafe = torch.nonzero(~(rows.lowest[0] >= 0.0)).flatten()
        found.append(problems(group, rows, wish[group.controls] / group.limit)[unsafe])
    return found


def shuffled(x: Tensor) -> Tensor:
    """The columns of x in an order that is the same on every device."""
    return torch.randperm(x.shape[-1], generator=torch.Generator().manual_seed(0)).to(x.device)
