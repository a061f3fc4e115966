"""The check of a plant that is the model: a control is applied if the flight that would follow keeps all limits.

A control is held, and after it both backup laws are flown, in the plant's own steps, until the spacecraft is in a set
that they never leave. If every limit is kept on this flight, the control is applied; if not, the nearest that leads to
such a flight, on the way from it to the law's; at last the laws' own, whose flight was looked at one call ago. The
state at the next call lies on that flight, so no limit is ever violated in the model (docs/reference/proof.md). A limit
that is violated already is not asked for; the others are.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from columns import call, if_long, loop, when
from inspection.model.parameters import Limits
from inspection.model.state_checks import is_state
from rta.check.attitude_law import Pointing, has_rest, slew
from rta.check.commit import ATTITUDE, LIMITS, MOTION, Check, NoCheckError
from rta.check.early_accept import EarlyAccept
from rta.check.flight import Flight, hold
from rta.check.motion_law import Braking, brake
from rta.check.terminal_set import TerminalSet
from rta.names import PAPERS

KEPT = 1e-9  # in the unit of each limit, m/s, m, rad, deg C, kJ, rad/s: what rounding may take
GLANCE = 4.0  # s of a flight, between two looks `at_once` at all that is left of it
# A group's flight ends where these entries of `TerminalSet.room` are >= 0. An entry is skipped where one of its EXCUSED
# limits is broken already.
ENDS = {0: (0, 3, 4), 1: (0, 1, 2)}  # of thrust, of torque
EXCUSED = {
    entry: tuple(map(PAPERS.index, names))
    for entry, names in {
        1: ("temperature",),
        2: ("battery",),
        4: ("collision", "keep_in_zone", "passive_safety"),
    }.items()
}


class NominalCheck(Check):
    """The check of a filter whose plant is the model.

    Args:
        c: the model and the limits; period: s, that a control is held.

    Attributes:
        max_periods: holds of a flight at most; glances: holds between two looks `at_once`.

    Raises:
        NoCheckError: no terminal set is known. One needs a circular orbit, and an attitude that cools and charges.
    """

    FIXED = ("c", "pointing", "braking", "terminal", "flight", "early_accept", "max_periods", "glances")
    knows = True, True

    def __init__(self, c: Limits, period: float) -> None:
        if c.hill_rotation:
            raise NoCheckError("the turning of Hill's frame must be left out (hill_rotation = false)")
        if not has_rest(c):
            raise NoCheckError(
                "there is no attitude of rest: panels must be on -x, the thermal side across them"
            )
        # A verified hold keeps the body rates itself, so that no flight depends on how the plant holds them.
        self.c = c = replace(c, saturate_rates=False)
        self.pointing = Pointing.of(c, period)
        self.braking = Braking.of(c, period, self.pointing.fastest)
        self.terminal = TerminalSet.of(self.pointing, self.braking)
        self.flight = Flight.of(c, period, self.braking.fastest)
        self.early_accept = EarlyAccept.of(self.pointing, self.braking, self.flight, self.terminal)
        braking = 1.5 * self.braking.fastest / self.braking.straight + self.terminal.leaves
        self.glances = max(1, round(GLANCE / period))
        longest = max(self.early_accept.arrives, braking)
        self.max_periods = self.glances * math.ceil(longest / (self.glances * period))

    # what a flight is made of

    def torque(self, x: Tensor) -> Tensor:
        """The law's torque (3, B) in N m at states (16, B)."""
        return call(slew, x, self.pointing)

    def thrust(self, x: Tensor, torque: Tensor) -> Tensor:
        """The law's thrust (3, B) in N at states (16, B) while torque (3, B) is held."""
        return call(brake, x, torque, self.braking)

    def hold(self, x: Tensor, u: Tensor, asked: Tensor) -> tuple[Tensor, Tensor]:
        """`hold` of the plant's steps."""
        return call(hold, x, u, asked, self.flight)

    def at_once(self, x: Tensor) -> Tensor:
        """A lower bound of each limit on the laws' flight from states (16, B), by one look: (11, B)."""
        return call(at_once, x, self.early_accept, long=if_long(len(self.c.planes)))

    # the check

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """States (16, B) that are not possible cannot be checked."""
        rates = (h[MOTION + ATTITUDE :] >= 0.0).all(0, keepdim=True)
        broken = ~torch.cat((h[: MOTION + ATTITUDE] >= 0.0, rates))
        return broken, is_state(y, self.c).repeat(2, 1)

    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        """(B,) bool: from states (16, B) the laws keep all limits for good."""
        none, both = torch.zeros_like(x[:LIMITS], dtype=torch.bool), torch.ones_like(x[:2], dtype=torch.bool)
        return self.fly(x, none, both).all(0)

    def fly(self, x: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """(2, B) bool: the laws' flight from states (16, B) keeps the limits of thrust, of torque that are not broken.

        Args:
            broken: (11, B) bool, limits that are not asked for.
            asked: (2, B) bool, the groups whose limits matter; of the other one nothing is said.
        """
        alive, found = ended(asked, ~asked, self.kept(self.at_once(x), broken))
        legs = self.max_periods // self.glances
        return loop(self.leg, [x, alive, found], broken, alive=alive.any(0), most=legs, waits=True)[2]

    def leg(self, x: Tensor, alive: Tensor, found: Tensor, broken: Tensor) -> tuple[list[Tensor], Tensor]:
        """Some holds of the laws, and a look at all that is left.

        Args:
            alive: (2, B) flights that have kept their limits and not ended; found: those that ended well.
        """
        state = [x, alive, found]
        x, alive, found = loop(self.held, state, broken, alive=alive.any(0), most=self.glances)
        alive, found = ended(alive, found, self.kept(self.at_once(x), broken))
        return [x, alive, found], alive.any(0)

    def held(self, x: Tensor, alive: Tensor, found: Tensor, broken: Tensor) -> tuple[list[Tensor], Tensor]:
        """Flies a hold of the laws, for flights that have not arrived."""
        alive, found = ended(alive, found, self.arrived(x, broken))
        x, alive = when(alive.any(0), self.hold_of_laws, [x, alive], x, alive, broken)
        return [x, alive, found], alive.any(0)

    def hold_of_laws(self, x: Tensor, alive: Tensor, broken: Tensor) -> list[Tensor]:
        """The states after a hold of both laws, and the flights (2, B) that have kept their limits in it."""
        x, least = self.hold(x, self.law(x), alive[0])
        return [x, alive & self.kept(least, broken)]

    def is_safe(self, x: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """(2, B) bool: a hold of controls (6, B) and the laws' flight after it keep the limits, as `fly`."""
        end, least = self.hold(x, u, asked[0])
        kept = self.kept(least, broken)
        return kept & self.fly(end, broken, asked & kept)

    @staticmethod
    def kept(least: Tensor, broken: Tensor) -> Tensor:
        """(2, B) bool: the least of each limit (11, B) is not negative, of thrust and of torque, or it is broken."""
        fine = (least >= KEPT) | broken  # NaN is not
        return torch.stack((fine[:MOTION].all(0), fine[MOTION:].all(0)))

    def arrived(self, x: Tensor, broken: Tensor) -> Tensor:
        """(2, B) bool: states (16, B) are where the laws stay, of thrust and of torque; `broken` as of `fly`."""
        room = call(self.terminal.room, x, long=if_long(len(self.c.planes)))
        inside = list((room >= 0.0).unbind())
        for entry, limits in EXCUSED.items():
            inside[entry] = inside[entry] | broken[list(limits)].any(0)
        return torch.stack([torch.stack([inside[i] for i in ENDS[group]]).all(0) for group in range(2)])

    def followed(self, x: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """Has both groups follow their laws where that is safe: a call ago it was flown."""
        safe = self.fly(x, broken, torch.ones_like(x[:2], dtype=torch.bool)).all(0)
        return [torch.where(safe, self.law(x), u), safe]


def at_once(x: Tensor, early_accept: EarlyAccept) -> Tensor:
    """A lower bound of each limit on the laws' flight from states (16, B), by one look: (11, B)."""
    return torch.cat((early_accept.motion(x), early_accept.attitude(x)))


def ended(alive: Tensor, found: Tensor, well: Tensor) -> tuple[Tensor, Tensor]:
    """Moves the flights in `well` from `alive` to `found`; returns both, (2, B) bool."""
    found = found | (alive & well)
    return alive & ~found, found
