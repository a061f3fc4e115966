"""What is flown to be measured: agents, and the states, controls and programs that they meet."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.closed_loop import Correction
from inspection.environment import InspectionEnv
from ppo.checkpoint import CheckpointError
from rta.qp import Problems, Solutions
from study.errors import InputError
from study.experiment import Experiment, load_policy
from study.files import ROOT

TRAINED = ROOT / "runs/reference/study/rta/seed0/policy.pt"
EPISODES, STEPS = 256, 60  # flown to record states, controls and programs, from a typical half of them on
Agent = Callable[[Tensor], Tensor]  # observations (B, n) to actions (B, 6)


class Flight(NamedTuple):
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
    observed = replace(experiment.config.inspection, observed=config.inspection.observed)
    seeing = copy(experiment)  # the filter is shared
    seeing.config = replace(experiment.config, inspection=observed)
    return seeing, lambda observation: policy.mean_action(observation[None])[0]


def record(experiment: Experiment, agent: Agent) -> Flight:
    """Plays EPISODES from the initial distribution, and keeps what the filter meets in the later half of STEPS."""
    met: list[tuple[Tensor, Tensor]] = []
    asked: dict[int, list[Problems]] = {}
    safety_filter, solver = experiment.filter, experiment.filter.solver
    listening = copy(solver)

    def solve(problems: Problems) -> Solutions:
        asked.setdefault(len(problems.a), []).append(problems)
        return solver.solve(problems)

    def correct(x: Tensor, desired: Tensor, **told: Tensor) -> Correction:
        met.append((x, desired))
        return safety_filter.correct(x, desired, **told)

    listening.solve = solve  # type: ignore[method-assign]
    env = experiment.env(EPISODES)
    env.put_behind(replace(experiment.safety, correct=correct))
    safety_filter.solver = listening  # of the filter itself: a copy would not be compiled
    try:
        observation = env.reset()
        for i in range(STEPS):
            if i == STEPS // 2:
                met.clear()
                asked.clear()
            observation = env.step(agent(observation)).observation
    finally:
        safety_filter.solver = solver
    x, desired = (torch.cat(parts, 1) for parts in zip(*met, strict=True))
    order = shuffled(x)
    return Flight(x[:, order], desired[:, order], [join(parts) for parts in asked.values()])


def join(parts: list[Problems]) -> Problems:
    """One batch of the programs of several, shuffled."""
    fields = ([part.desired, part.a, part.b, part.b_bare] for part in parts)
    whole = Problems(*(torch.cat(field, -1) for field in zip(*fields, strict=True)), parts[0].weight)
    return whole[shuffled(whole.desired)]


def shuffled(x: Tensor) -> Tensor:
    """The columns of x in an order that is the same on every device."""
    return torch.randperm(x.shape[-1], generator=torch.Generator().manual_seed(0)).to(x.device)
