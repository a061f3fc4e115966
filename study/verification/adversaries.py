"""Controllers that a campaign corrects by the filter, and adversaries that choose the corners of a plant's errors."""

from collections.abc import Callable

import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.model.dynamics import step
from inspection.model.parameters import Model
from inspection.model.state import CONTROL_SIZE, THRUST, TORQUE
from inspection.world.corners import ERRORS, displaced
from ppo.network import Policy
from rta.filter import SafetyFilter
from rta.names import ATTITUDE, OWN, TRANSLATIONAL
from study.scales import scales

NEXT_TO_NOTHING = 1e-9  # m, m/s, rad, rad/s; not zero, where PyTorch has no derivative by a rotation vector
# rows of the constraints that thrust and that torque satisfies, each with its controls
GROUPS = (
    (slice(0, len(TRANSLATIONAL)), THRUST),
    (slice(len(TRANSLATIONAL), len(TRANSLATIONAL) + len(ATTITUDE)), TORQUE),
)
NO_INFLUENCE = 1e-9  # in h's unit per s and actuator limit; a group does not change shorter rows
Rows = Callable[[Tensor], list[Tensor]]
LONGEST_ACTION = 60  # s, longest hold of an action of the random policy


def held_at_random(c: Model, generator: torch.Generator, batch: int, first: int = 0) -> Controller:
    """Returns a controller of uniformly random controls, each held for a uniformly random time of whole seconds.

    Numbers are drawn for a whole batch; the states are its columns from `first` on.
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
    """Returns a controller that draws from a policy of one seed, for `env`; numbers as in `held_at_random`."""

    @torch.no_grad()
    def control(t: float, x: Tensor) -> Tensor:
        mean, log_std = policy(env.observation(x)[None])
        noise = torch.randn(batch, CONTROL_SIZE, generator=generator, dtype=torch.float32)
        noise = noise[first : first + x.shape[1]].to(mean)
        return env.control(policy.shaped(mean + log_std.exp() * noise)[0])

    return control


def adversarial(
    safety_filter: SafetyFilter, compiled: Callable[[Rows], Rows] = lambda rows: rows
) -> Controller:
    """Returns a controller of full control along the steepest descent of the worst thrust row and worst torque row.

    The worst row is the one that zero control is closest to violating, in units of the actuators' limits.

    Args:
        compiled: compiles a function of states, see `Experiment.of_states`.
    """

    def worst_rows(x: Tensor) -> list[Tensor]:
        """Returns for each group the row (3, B) per actuator limit that zero control is closest to violating."""
        a, b, *_ = safety_filter.program.evaluated(x)
        a = a * x.new_tensor(safety_filter.c.control_limit)[:, None]
        worst = []
        for own in (THRUST, TORQUE):
            length = a[:, own].norm(dim=1)
            distance = torch.where(length > NO_INFLUENCE, b / length.clamp(min=NO_INFLUENCE), torch.inf)
            worst.append(a[:, own].gather(0, distance.argmin(0).expand(1, 3, -1))[0])
        return worst

    rows_at = compiled(worst_rows)

    def control(t: float, x: Tensor) -> Tensor:
        halves = [-row / row.abs().amax(0).clamp(min=1e-12) for row in rows_at(x)]
        return torch.cat(halves) * x.new_tensor(safety_filter.c.control_limit)[:, None]

    return control


class Greedy:
    """Lowers the smallest h after the next call, by the model: an `Adversary` of the plant, and a `Controller`.

    J(x, e, u) is the sum of the smallest h of thrust's attacked constraints and the smallest h of torque's, in filter
    calls (`study.scales`), of states with error e after a hold of control u for a period. Then, to first order,

    - the sensors err along dJ/de, so that the measured state looks safest;
    - a gain is at its upper end if the command along its axis lowers J, else at its lower end;
    - a call is missed if the last control leads to a smaller J than the new one;
    - the controller commands full control along -dJ/du, for thrust and for torque separately.

    Args:
        attacked: (constraints, B) bool, the constraints that enter J in each episode; None: all.
    """

    def __init__(self, safety_filter: SafetyFilter, attacked: Tensor | None = None) -> None:
        self.filter, self.attacked = safety_filter, attacked
        self.scale = scales(safety_filter.c, safety_filter.period)
        self.last: Tensor | None = None

    def ahead(self, x: Tensor, error: Tensor, u: Tensor) -> Tensor:
        """Returns J (B,) of states (16, B), errors (12, B) and controls (6, B)."""
        after = step(displaced(x, error), u, self.filter.period, self.filter.c)
        h = self.filter.values(after) / x.new_tensor(self.scale)[:, None]
        if self.attacked is not None:
            h = h.masked_fill(~self.attacked.to(x.device), torch.inf)
        return h[GROUPS[0][0]].amin(0) + h[GROUPS[1][0]].amin(0)

    def slopes(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Returns dJ/de (12, B) at an error of almost zero, and dJ/du (6, B); zero where a derivative is NaN."""
        error = x.new_full((ERRORS.stop, x.shape[1]), NEXT_TO_NOTHING)
        back = torch.func.vjp(lambda e, control: self.ahead(x, e, control), error, u)[1]
        of_error, of_control = back(torch.ones_like(x[0]))
        return of_error.nan_to_num(), of_control.nan_to_num()

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns which errors are positive, see `Adversary`, under the control of the last call."""
        held = torch.zeros_like(x[:CONTROL_SIZE]) if self.last is None else self.last
        return self.slopes(x, held)[0] > 0.0

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """Returns the gains and whether the call is missed, see `Adversary`."""
        nothing = x.new_zeros(ERRORS.stop, x.shape[1])
        missed = self.ahead(x, nothing, held) < self.ahead(x, nothing, u)
        self.last = torch.where(missed, held, u)
        harms = self.slopes(x, self.last)[1] * self.last < 0.0
        return torch.cat((harms, missed[None]))

    def __call__(self, t: float, x: Tensor) -> Tensor:
        slope = self.slopes(x, torch.zeros_like(x[:CONTROL_SIZE]))[1]
        limit = x.new_tensor(self.filter.c.control_limit)[:, None]
        tiny = torch.finfo(x.dtype).tiny
        slope = slope * limit
        parts = [-slope[own] / slope[own].abs().amax(0).clamp(min=tiny) for _, own in GROUPS]
        return limit * torch.cat(parts)


def attacked(column: Tensor) -> Tensor:
    """Returns (constraints, B) bool: which constraints are attacked in the columns (B,) of a batch.

    In turns these are one constraint of thrust and one of torque, or all of a group at once; limits of your own always.
    If all were attacked in every column, the body rates would dominate, since they reach their limits within seconds.
    """
    thrust, torque = (rows.stop - rows.start for rows, _ in GROUPS)
    pair = column // 2  # starts of two kinds alternate

    def one_or_all(number: Tensor, count: int) -> Tensor:
        target = number % (count + 1)  # the last number means all
        return (target == torch.arange(count, device=column.device)[:, None]) | (target == count)

    own = torch.ones(len(OWN), len(column), dtype=torch.bool, device=column.device)
    return torch.cat((one_or_all(pair, thrust), one_or_all(pair // (thrust + 1), torque), own))
