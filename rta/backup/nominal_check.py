"""The check without error bounds: a control is applied if the flight that would follow keeps all limits.

A control is held, and after it both backup laws are flown, in the plant's own steps, until the spacecraft is in a set
that they never leave. If every limit is kept on this flight, the control is applied; if not, the nearest that leads to
such a flight, on the way from it to the law's; at last the laws' own, whose flight was looked at one call ago. The
state at the next call lies on that flight, so no limit is ever violated in the model (docs/reference/proof.md). A limit
that is violated already is not asked for; the others are.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state_checks import is_state
from rta.backup.attitude_law import Pointing, has_rest, slew
from rta.backup.commit import ATTITUDE, LIMITS, MOTION, Check
from rta.backup.early_accept import EarlyAccept
from rta.backup.flight import Flight, hold
from rta.backup.motion_law import Braking, brake
from rta.backup.terminal import NoTerminalSetError, TerminalSet
from rta.constraints.names import PAPERS
from rta.qp.programs import pick, put

KEPT = 1e-9  # in the unit of each limit, m/s, m, rad, deg C, kJ: what rounding may take
RATES_ROUNDED = 1e-9  # rad^2/s^2, by which rates at their limit may be beyond, where the plant holds them
GLANCE = 4.0  # s of a flight, between two looks at all that is left of it at once
# Where a flight ends, by the entries of `TerminalSet.room`, and the limits that, once broken, excuse from each.
ENDS = {0: (0, 3, 4), 1: (0, 1, 2)}  # of thrust, of torque
EXCUSED = {
    entry: tuple(map(PAPERS.index, names))
    for entry, names in {
        1: ("temperature",),
        2: ("battery",),
        4: ("collision", "keep_in_zone", "passive_safety"),
    }.items()
}


class NominalBackup(Check):
    """The check of a filter whose plant is the model.

    Args:
        c: the model and the limits; period: s, that a control is held.

    Attributes:
        max_periods: of a flight at most; glances: between two looks at all that is left of it at once.
        flights: `fly` of states on a CPU, compiled; None: it is not.

    Raises:
        NoTerminalSetError: the laws leave every set that is known.
    """

    FIXED = ("c", "pointing", "braking", "terminal", "flight", "early_accept", "max_periods", "glances")
    knows = True, True

    def __init__(self, c: Limits, period: float) -> None:
        self.c = c
        self.pointing = Pointing.of(c, period)
        self.braking = Braking.of(c, period, self.pointing.fastest)
        self.terminal = TerminalSet.of(self.pointing, self.braking)
        self.flight = Flight.of(c, period, self.braking.fastest)
        if self.flight.spin * self.flight.seconds * 2 * math.sqrt(3.0) * c.max_rate > 0.2:  # see `peak`
            raise NoTerminalSetError("gyroscopic torque")
        self.early_accept = EarlyAccept.of(self.pointing, self.braking, self.flight, self.terminal)
        braking = 1.5 * self.braking.fastest / self.braking.straight + self.terminal.leaves
        self.glances = max(1, round(GLANCE / period))
        longest = max(self.early_accept.arrives, braking)
        self.max_periods = self.glances * math.ceil(longest / (self.glances * period))
        self.flights: Callable[[Tensor, Tensor, Sequence[int]], Tensor] | None = None

    @classmethod
    def of(cls, c: Limits, period: float) -> "NominalBackup | None":
        """None: no set is known in which flights end. It is on a circle, cools and charges."""
        if c.orbit != "clohessy-wiltshire" or c.hill_rotation or not has_rest(c):
            return None
        try:
            return cls(c, period)
        except NoTerminalSetError:
            return None

    # what a flight is made of

    def torque(self, x: Tensor) -> Tensor:
        """The law's torque (3, B) in N m at states (16, B)."""
        return slew(x, self.pointing)

    def thrust(self, x: Tensor, torque: Tensor) -> Tensor:
        """The law's thrust (3, B) in N at states (16, B) while torque (3, B) is held."""
        return brake(x, torque, self.braking)

    def hold(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The states after a hold of controls (6, B) at states (16, B), and the least of each limit in it (11, B)."""
        return hold(x, u, self.flight)

    def at_once(self, x: Tensor) -> Tensor:
        """A lower bound of each limit on the laws' flight from states (16, B), by one look: (11, B)."""
        return torch.cat((self.early_accept.motion(x), self.early_accept.attitude(x)))

    # the check

    def seen(self, x: Tensor, error_bound: Tensor) -> Tensor:
        """The states."""
        return x

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """States (16, B) that are not possible cannot be checked. Rates may be at their limit."""
        rates = (h[MOTION + ATTITUDE :] >= -RATES_ROUNDED).all(0, keepdim=True)
        broken = ~torch.cat((h[: MOTION + ATTITUDE] >= 0.0, rates))
        return broken, is_state(y, self.c).repeat(2, 1)

    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        """(B,) bool: from states (16, B) the laws keep all limits for good."""
        return self.has_trajectories(x, torch.zeros_like(x[:LIMITS], dtype=torch.bool)).all(0)

    def has_trajectories(self, x: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        """`fly`, in C where it can be."""
        flights = self.flights if x.device.type == "cpu" else None
        return (flights or self.fly)(x, broken, asked)

    def fly(self, x: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        """(2, B) bool: the laws' flight from states (16, B) keeps the limits of thrust, of torque that are not broken.

        Args:
            broken: (11, B) bool, limits that are not asked for.
            asked: the groups whose limits matter; of the other one nothing is said.
        """
        found = torch.zeros_like(x[:2], dtype=torch.bool)
        found[[group for group in range(2) if group not in asked]] = True
        flying, alive = torch.arange(x.shape[1], device=x.device), ~found
        for k in range(self.max_periods):
            if not flying.numel():
                break
            arrived = self.arrived(x, broken)
            if k % self.glances == 0:
                arrived = arrived | self.kept(self.at_once(x), broken)
            arrived = alive & arrived
            put(found, flying, pick(found, flying) | arrived)
            alive = alive & ~arrived
            x, least = self.hold(x, self.law(x))
            alive = alive & self.kept(least, broken)
            on = torch.nonzero(alive.any(0)).flatten()
            flying, x, broken, alive = flying[on], pick(x, on), pick(broken, on), pick(alive, on)
        return found

    def is_safe(self, x: Tensor, u: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        """(2, B) bool: a hold of controls (6, B) and the laws' flight after it keep the limits, as `fly`."""
        end, least = self.hold(x, u)
        kept = self.kept(least, broken)
        columns = torch.nonzero(kept[list(asked)].any(0)).flatten()
        if columns.numel():
            found = self.has_trajectories(pick(end, columns), pick(broken, columns), asked)
            put(kept, columns, pick(kept, columns) & found)
        return kept

    @staticmethod
    def kept(least: Tensor, broken: Tensor) -> Tensor:
        """(2, B) bool: the least of each limit (11, B) is not negative, of thrust and of torque, or it is broken."""
        fine = (least >= KEPT) | broken  # NaN is not
        return torch.stack((fine[:MOTION].all(0), fine[MOTION:].all(0)))

    def arrived(self, x: Tensor, broken: Tensor) -> Tensor:
        """(2, B) bool: states (16, B) are where the laws stay, of thrust and of torque; `broken` as of `fly`."""
        inside = self.terminal.room(x) >= 0.0
        for entry, limits in EXCUSED.items():
            inside[entry] |= broken[list(limits)].any(0)
        return torch.stack([inside[list(ENDS[group])].all(0) for group in range(2)])

    def follow(self, x: Tensor, u: Tensor, safe: Tensor, changed: Tensor, broken: Tensor) -> None:
        """Puts both laws' controls where no other control is safe, if the laws' are: a call ago they were flown."""
        columns = torch.nonzero(changed.any(0) & ~safe.all(0)).flatten()
        if not columns.numel():
            return
        found = self.has_trajectories(pick(x, columns), pick(broken, columns)).all(0)
        columns = columns[found]
        put(u, columns, self.law(pick(x, columns)))
        for part in (safe, changed):
            put(part, columns, torch.ones_like(part[:, : columns.numel()]))
