"""The paper's program for a whole batch at once, and in C: `PaperFilter.correct` by the active-set method.

Thrust and torque enter disjoint conditions, so the program of six controls is two of three. Only a limit of your own
may depend on both: it belongs to the group that changes it more, and the other group's control is taken as given.
Torque comes first.
"""

from functools import reduce

import torch
from torch import Tensor

from columns import call, if_long
from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE
from rta.fast.active_set import ATTEMPTED, solve, total
from rta.limits import Limit
from rta.own import influence
from rta.paper import PaperFilter
from rta.result import FilterResult, Status

REDUNDANT = 2.0  # no control violates a row of length 1 with b >= sqrt(3)
HOPELESS = -100.0  # keeps the slack of a condition that no control satisfies in a range that float64 resolves
HEAVIEST = 1e6  # largest weight, per slack squared of a row of length 1; a larger one leaves no digits
FEASIBLE = 1e-7  # a smaller violation of a row of length 1 is rounding
NO_INFLUENCE = 1e-9  # no control changes a row of this length, in h's unit per s and actuator limit


class FastProgram(PaperFilter):
    """Solves the program of `PaperFilter` by the active-set method.

    Attributes:
        rows: indices of conditions on thrust, and of conditions on torque; coupled: some depend on both.
        attempted: as in `solve`.
    """

    def __init__(self, c: Limits, limits: dict[str, Limit], attempted: int = ATTEMPTED) -> None:
        super().__init__(c, limits)
        by = [influence(limit, c) for limit in limits.values()]
        by_torque = [torque > thrust for thrust, torque in by]
        self.rows = tuple(
            [i for i, torque in enumerate(by_torque) if torque is group] for group in (False, True)
        )
        self.coupled = any(thrust > 0.0 and torque > 0.0 for thrust, torque in by)
        self.attempted = attempted

    def correct(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters as `PaperFilter.correct`."""
        limit = x.new_tensor(self.c.control_limit)[:, None]
        long = if_long(len(self.c.planes))
        a, b = call(self.conditions, x, long=long)
        h = call(self.values, x, long=long, name="limit_values")
        wanted = desired / limit
        control = wanted.clamp(-1.0, 1.0)
        status = torch.where((control != wanted).any(0), Status.HARD, Status.UNTOUCHED)
        torque, code = self.solved(1, a, b, wanted, control)
        control, status = torch.cat((control[THRUST], torque)), torch.maximum(status, code)
        thrust, code = self.solved(0, a, b, wanted, control)
        control, status = torch.cat((thrust, torque)), torch.maximum(status, code)
        found = call(concluded, a, b, desired, control, limit, status)
        control, changed, active, slack, status = found
        no = torch.zeros_like(changed)
        return FilterResult(control, changed, no, no, active, slack, status, h)

    def conditions(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Returns a (R, 6, B) per actuator limit and b (R, B) of `barrier_conditions` at states (16, B)."""
        a, b, *_ = self.evaluated(x)
        return a * x.new_tensor(self.c.control_limit)[:, None], b

    def solved(
        self, group: int, a: Tensor, b: Tensor, wanted: Tensor, control: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns controls (3, B) of thrust (group 0) or torque in units of limits, and `Status` (B,).

        The status is UNTOUCHED where no condition is violated.

        Args:
            a, b: (R, 6, B) and (R, B) of all conditions; wanted: (6, B); control: (6, B), `wanted` clipped.
        """
        rows, own, other = self.rows[group], (THRUST, TORQUE)[group], (TORQUE, THRUST)[group]
        weights = [list(self.limits.values())[i].weight or 0.0 for i in rows]
        a, b = (torch.stack([part[i] for i in rows]) for part in (a, b))
        if self.coupled:
            b = b + total(a[:, other] * control[other], 1)
        name = ("thrust", "torque")[group]
        unit, side, weight = call(scaled, a[:, own], b, weights, name=f"{name}_program")
        lowest = reduce(torch.minimum, (total(unit * control[own], 1) + side).unbind())
        broken = ~(lowest >= 0.0)  # NaN must not pass
        u, status = solve(wanted[own], *self.padded(unit, side, weight), broken, self.attempted)
        return torch.where(broken, u, control[own]), torch.where(broken, status, Status.UNTOUCHED)

    def padded(self, a: Tensor, b: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns equally many rows for both groups, by rows that always hold, so that one C function solves both."""
        more = max(map(len, self.rows)) - len(a)
        if not more:
            return a, b, weight
        none = b.new_zeros(more, b.shape[1])
        a = torch.cat((a, a.new_zeros(more, *a.shape[1:])))
        return a, torch.cat((b, none + REDUNDANT)), torch.cat((weight, none))


def scaled(a: Tensor, b: Tensor, weights: list[float]) -> tuple[Tensor, Tensor, Tensor]:
    """Returns rows (k, 3, B) of length 1, their sides and the weights of their slack (k, B), zero: rows that must hold.

    A condition that must hold requires no more than full thrust gives: beyond its limit it could require many times
    that.
    """
    most = total(a.abs(), 1)
    b = torch.stack(
        [side if weight else side.maximum(-all_) for side, all_, weight in zip(b, most, weights, strict=True)]
    )
    length = total(a * a, 1).sqrt()
    fixed = length <= NO_INFLUENCE
    length = torch.where(fixed, 1.0, length)
    side = torch.where(fixed & ~b.isnan(), REDUNDANT, (b / length).clamp(HOPELESS, REDUNDANT))
    weight = (b.new_tensor(weights)[:, None] * length**2).clamp(max=HEAVIEST)
    return a / length[:, None], side, weight


def concluded(
    a: Tensor, b: Tensor, desired: Tensor, control: Tensor, limit: Tensor, status: Tensor
) -> list[Tensor]:
    """Returns the applied control, changed, active, slack and status for controls (6, B) in units of limits (6, 1)."""
    reached, length = total(a * control, 1) + b, total(a * a, 1).sqrt()
    changed = status > Status.UNTOUCHED
    is_solution = changed & (status < Status.UNSOLVED)
    short = (reached < -FEASIBLE * length) & is_solution
    status = torch.where(short.any(0), status.clamp(min=Status.SLACK), status)
    applied = torch.where(changed, control * limit, desired)
    applied = torch.where(status == Status.UNSOLVED, 0.0, applied)
    active = (reached <= FEASIBLE * length) & is_solution
    return [applied, changed, active, torch.where(short, -reached, 0.0), status]
