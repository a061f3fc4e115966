"""What a campaign puts behind the filter: random controls, the steepest descent, an agent that was trained for it."""

import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.model.parameters import Model
from inspection.model.state import CONTROL_SIZE
from ppo.network import Policy
from rta.filter import SafetyFilter

LONGEST_ACTION = 60  # s that the random policy holds an action


def held_at_random(c: Model, generator: torch.Generator, batch: int, first: int = 0) -> Controller:
    """Uniformly random controls, each held for a uniformly random time of whole seconds.

    Numbers are drawn for a whole batch, of which the states are the columns from `first` on.
    """
    held: dict[str, Tensor] = {}

    def control(t: float, x: Tensor) -> Tensor:
        draw = torch.rand(CONTROL_SIZE + 1, batch, generator=generator, dtype=torch.float64)
        draw = draw[:, first : first + x.shape[1]].to(x)
        fresh = (2.0 * draw[:CONTROL_SIZE] - 1.0) * x.new_tensor(c.control_limit)[:, None]
        until = t + (draw[CONTROL_SIZE] * LONGEST_ACTION).ceil()
        if held:
            keep = held["until"] > t
            fresh = torch.where(keep, held["u"], fresh)
            until = torch.where(keep, held["until"], until)
        held.update(u=fresh, until=until)
        return fresh

    return control


def learned(
    policy: Policy, env: InspectionEnv, generator: torch.Generator, batch: int, first: int = 0
) -> Controller:
    """Controls drawn from a policy of one seed, for `env`, flown by `inspect`; numbers as in `held_at_random`."""

    @torch.no_grad()
    def control(t: float, x: Tensor) -> Tensor:
        mean, log_std = policy(env.observation(x)[None])
        noise = torch.randn(batch, CONTROL_SIZE, generator=generator)[first : first + x.shape[1]].to(mean)
        return env.control(policy.shaped(mean + log_std.exp() * noise)[0])

    return control


def adversarial(safety_filter: SafetyFilter) -> Controller:
    """Full control along the steepest descent of the worst thrust row and of the worst torque row.

    The worst row is the one that zero control comes closest to breaking, in units of the actuators' limits.
    """

    def control(t: float, x: Tensor) -> Tensor:
        halves = []
        for group, rows in zip(safety_filter.groups, safety_filter.rows(x), strict=True):
            a = rows.a * group.limit
            worst = (rows.b / a.norm(dim=1).clamp(min=1e-9)).argmin(0)
            descent = -a.gather(0, worst.expand(1, 3, -1))[0]
            halves.append(group.limit * descent / descent.abs().amax(0).clamp(min=1e-12))
        return torch.cat(halves)

    return control
