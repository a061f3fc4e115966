"""What a campaign puts behind the filter, and who chooses the worlds' corners: chance, descent, a trained agent."""

from collections.abc import Callable

import torch
from torch import Tensor

from columns import if_long
from inspection.closed_loop import Controller
from inspection.environment import Compiler, InspectionEnv
from inspection.model.dynamics import step
from inspection.model.parameters import Model
from inspection.model.state import CONTROL_SIZE, THRUST, TORQUE
from inspection.world.corners import ERRORS, displaced
from ppo.network import Policy
from rta.filter import SafetyFilter
from rta.names import ATTITUDE, OWN, TRANSLATIONAL
from study.scales import scales

NEXT_TO_NOTHING = 1e-9  # m, m/s, rad, rad/s; PyTorch has no derivative by a rotation vector at zero
# Rows of the constraints by who holds them, and the controls of theirs.
GROUPS = (
    (slice(0, len(TRANSLATIONAL)), THRUST),
    (slice(len(TRANSLATIONAL), len(TRANSLATIONAL) + len(ATTITUDE)), TORQUE),
)
NO_INFLUENCE = 1e-9  # length, in h's unit per s and actuator limit, of a row that a group does not change
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
        noise = torch.randn(batch, CONTROL_SIZE, generator=generator, dtype=torch.float32)
        noise = noise[first : first + x.shape[1]].to(mean)
        return env.control(policy.shaped(mean + log_std.exp() * noise)[0])

    return control


def adversarial(safety_filter: SafetyFilter, compiler: Compiler | None = None) -> Controller:
    """Full control along the steepest descent of the worst thrust row and of the worst torque row.

    The worst row is the one that zero control comes closest to breaking, in units of the actuators' limits.
    """

    def worst_rows(x: Tensor) -> list[Tensor]:
        """Of each group, the row (3, B) per actuator limit that zero control comes closest to breaking."""
        a, b, *_ = safety_filter.program.evaluated(x)
        a = a * x.new_tensor(safety_filter.c.control_limit)[:, None]
        worst = []
        for own in (THRUST, TORQUE):
            length = a[:, own].norm(dim=1)
            distance = torch.where(length > NO_INFLUENCE, b / length.clamp(min=NO_INFLUENCE), torch.inf)
            worst.append(a[:, own].gather(0, distance.argmin(0).expand(1, 3, -1))[0])
        return worst

    rows_at: Callable[[Tensor], list[Tensor]] = worst_rows
    if compiler:
        rows_at = compiler(worst_rows, safety_filter.probe()[0], long=if_long(len(safety_filter.c.planes)))

    def control(t: float, x: Tensor) -> Tensor:
        halves = [-row / row.abs().amax(0).clamp(min=1e-12) for row in rows_at(x)]
        return torch.cat(halves) * x.new_tensor(safety_filter.c.control_limit)[:, None]

    return control


class Greedy:
    """Lowers the smallest h after the next call, by the model: an `Adversary` of the world, and a `Controller`.

    J(x, e, u) is the smallest h of thrust's attacked constraints and that of torque's, in filter calls
    (`study.scales`), added up, of states that are off by e after a control is held for a period. Then, to first order,

    - the sensors err along dJ/de: what is measured looks safest;
    - a gain is at its upper end where what is commanded along that axis lowers J, and at its lower end where it helps;
    - a call is missed where the last control leads to a smaller J than the new one;
    - as a controller it is full control along -dJ/du, of thrust and of torque apart.

    Args:
        attacked: (constraints, B) bool, the constraints that count in each episode; None: all.
    """

    def __init__(self, safety_filter: SafetyFilter, attacked: Tensor | None = None) -> None:
        self.filter, self.attacked = safety_filter, attacked
        self.scale = scales(safety_filter.c, safety_filter.period)
        self.last: Tensor | None = None

    def ahead(self, x: Tensor, error: Tensor, u: Tensor) -> Tensor:
        """(B,) J of states (16, B), errors (12, B) and controls (6, B)."""
        after = step(displaced(x, error), u, self.filter.period, self.filter.c)
        h = self.filter.values(after) / x.new_tensor(self.scale)[:, None]
        if self.attacked is not None:
            h = h.masked_fill(~self.attacked.to(x.device), torch.inf)
        return h[GROUPS[0][0]].amin(0) + h[GROUPS[1][0]].amin(0)

    def slopes(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """dJ/de (12, B), where the error is next to nothing, and dJ/du (6, B); zero where there is none."""
        error = x.new_full((ERRORS.stop, x.shape[1]), NEXT_TO_NOTHING)
        back = torch.func.vjp(lambda e, control: self.ahead(x, e, control), error, u)[1]
        of_error, of_control = back(torch.ones_like(x[0]))
        return of_error.nan_to_num(), of_control.nan_to_num()

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """See `Adversary`; under the control of the last call."""
        held = torch.zeros_like(x[:CONTROL_SIZE]) if self.last is None else self.last
        return self.slopes(x, held)[0] > 0.0

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """See `Adversary`."""
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
    """(constraints, B) bool: which are attacked in the columns (B,) of a batch.

    One constraint of thrust and one of torque, or all of a group at once, in turns; limits of your own always. A body
    rate is at its limit within seconds and would else be all that is attacked.
    """
    thrust, torque = (rows.stop - rows.start for rows, _ in GROUPS)
    pair = column // 2  # starts of two kinds alternate

    def one_or_all(number: Tensor, count: int) -> Tensor:
        target = number % (count + 1)  # the last one: all
        return (target == torch.arange(count, device=column.device)[:, None]) | (target == count)

    own = torch.ones(len(OWN), len(column), dtype=torch.bool, device=column.device)
    return torch.cat((one_or_all(pair, thrust), one_or_all(pair // (thrust + 1), torque), own))
