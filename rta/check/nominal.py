"""The check of a plant that is the model: a control is applied if the trajectory after it satisfies all limits.

The control is held. Then both backup laws are simulated, in the plant's own steps, until the spacecraft is in a set
that they never leave. If every limit is satisfied on this trajectory, the control is applied. If not, the first control
on the way to the law's with such a trajectory is applied. The last candidate is the laws' own control, whose trajectory
was checked one call ago. The state at the next call lies on the checked trajectory, so no limit is ever violated in the
model (docs/reference/proof.md). A limit that is violated already is not checked; the others are.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from columns import call, if_long, loop, when
from inspection.model.parameters import Limits
from inspection.model.state_checks import is_state
from rta.check.attitude_law import Pointing, check_rest, slew
from rta.check.commit import ATTITUDE, LIMITS, MOTION, Check, check_frame
from rta.check.early_accept import EarlyAccept
from rta.check.flight import Flight, hold
from rta.check.motion_law import Braking, brake
from rta.check.terminal_set import TerminalSet
from rta.names import PAPERS

KEPT = 1e-9  # margin for rounding in the unit of each limit: m/s, m, rad, deg C, kJ, rad/s
GLANCE = 4.0  # s of a simulated trajectory between two tests `at_once` of the rest of it
# A group's trajectory ends where these entries of `TerminalSet.room` are >= 0. An entry is skipped where one of its
# EXCUSED limits is violated already.
ENDS = {0: (0, 3, 4), 1: (0, 1, 2)}  # for thrust, for torque
EXCUSED = {
    entry: tuple(map(PAPERS.index, names))
    for entry, names in {
        1: ("temperature",),
        2: ("battery",),
        4: ("collision", "keep_in_zone", "passive_safety"),
    }.items()
}


class NominalCheck(Check):
    """Checks controls for a plant that is the model.

    Args:
        c: the model and the limits; period: s, that a control is held.

    Attributes:
        max_periods: the most holds of a trajectory; glances: holds between two tests `at_once`.

    Raises:
        NoCheckError: no terminal set is known. One needs Hill's rotation left out, and an attitude that cools and
            charges.
    """

    FIXED = ("c", "pointing", "braking", "terminal", "flight", "early_accept", "max_periods", "glances")
    knows = True, True

    def __init__(self, c: Limits, period: float) -> None:
        check_frame(c)
        check_rest(c)
        # A verified hold satisfies the rate limits, so no trajectory depends on the plant's clamp of the rates.
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

    # parts of a trajectory

    def torque(self, x: Tensor) -> Tensor:
        """Returns the law's torque (3, B) in N m at states (16, B)."""
        return call(slew, x, self.pointing)

    def thrust(self, x: Tensor, torque: Tensor) -> Tensor:
        """Returns the law's thrust (3, B) in N at states (16, B) while torque (3, B) is held."""
        return call(brake, x, torque, self.braking)

    def hold(self, x: Tensor, u: Tensor, asked: Tensor) -> tuple[Tensor, Tensor]:
        """Returns `hold` in the plant's steps."""
        return call(hold, x, u, asked, self.flight)

    def at_once(self, x: Tensor) -> Tensor:
        """Returns a lower bound of each limit on the backup trajectory from states (16, B), by one test: (11, B)."""
        return call(at_once, x, self.early_accept, long=if_long(len(self.c.planes)))

    # the check

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Returns violated limits (11, B) and checkable groups (2, B), see `Check`: impossible states have none."""
        rates = (h[MOTION + ATTITUDE :] >= 0.0).all(0, keepdim=True)
        broken = ~torch.cat((h[: MOTION + ATTITUDE] >= 0.0, rates))
        return broken, is_state(y, self.c).repeat(2, 1)

    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        """Checks whether the laws satisfy all limits for good from states (16, B), (B,) bool."""
        none, both = torch.zeros_like(x[:LIMITS], dtype=torch.bool), torch.ones_like(x[:2], dtype=torch.bool)
        return self.fly(x, none, both).all(0)

    def fly(self, x: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """Checks whether the laws' trajectory from states (16, B) satisfies the limits of each group, (2, B) bool.

        Args:
            broken: (11, B) bool, limits that are violated already and not checked.
            asked: (2, B) bool, the groups whose limits are checked; the result is undefined for the others.
        """
        alive, found = ended(asked, ~asked, self.kept(self.at_once(x), broken))
        legs = self.max_periods // self.glances
        return loop(self.leg, [x, alive, found], broken, alive=alive.any(0), most=legs, waits=True)[2]

    def leg(self, x: Tensor, alive: Tensor, found: Tensor, broken: Tensor) -> tuple[list[Tensor], Tensor]:
        """Simulates some holds of the laws, and tests the rest of the trajectory at once.

        Args:
            alive: (2, B) trajectories that satisfied their limits and have not ended; found: those that ended safely.
        """
        state = [x, alive, found]
        x, alive, found = loop(self.held, state, broken, alive=alive.any(0), most=self.glances)
        alive, found = ended(alive, found, self.kept(self.at_once(x), broken))
        return [x, alive, found], alive.any(0)

    def held(self, x: Tensor, alive: Tensor, found: Tensor, broken: Tensor) -> tuple[list[Tensor], Tensor]:
        """Simulates a hold of the laws, for trajectories that have not arrived."""
        alive, found = ended(alive, found, self.arrived(x, broken))
        x, alive = when(alive.any(0), self.hold_of_laws, [x, alive], x, alive, broken)
        return [x, alive, found], alive.any(0)

    def hold_of_laws(self, x: Tensor, alive: Tensor, broken: Tensor) -> list[Tensor]:
        """Returns the states after a hold of both laws, and the trajectories (2, B) within their limits in it."""
        x, least = self.hold(x, self.law(x), alive[0])
        return [x, alive & self.kept(least, broken)]

    def is_safe(self, x: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """Checks a hold of controls (6, B) and the laws' trajectory after it, (2, B) bool, as `fly`."""
        end, least = self.hold(x, u, asked[0])
        kept = self.kept(least, broken)
        return kept & self.fly(end, broken, asked & kept)

    @staticmethod
    def kept(least: Tensor, broken: Tensor) -> Tensor:
        """Checks per group whether all bounds (11, B) are at least KEPT or their limit is `broken`, (2, B) bool."""
        fine = (least >= KEPT) | broken  # NaN fails
        return torch.stack((fine[:MOTION].all(0), fine[MOTION:].all(0)))

    def arrived(self, x: Tensor, broken: Tensor) -> Tensor:
        """Checks for each group whether states (16, B) are in the terminal set, (2, B) bool; `broken` as in `fly`."""
        room = call(self.terminal.room, x, long=if_long(len(self.c.planes)))
        inside = list((room >= 0.0).unbind())
        for entry, limits in EXCUSED.items():
            inside[entry] = inside[entry] | broken[list(limits)].any(0)
        return torch.stack([torch.stack([inside[i] for i in ENDS[group]]).all(0) for group in range(2)])

    def followed(self, x: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """Returns both laws' controls where they are safe, as checked a call ago, else u; and where they are safe."""
        safe = self.fly(x, broken, torch.ones_like(x[:2], dtype=torch.bool)).all(0)
        return [torch.where(safe, self.law(x), u), safe]


def at_once(x: Tensor, early_accept: EarlyAccept) -> Tensor:
    """Returns a lower bound of each limit on the laws' trajectory from states (16, B), by one test: (11, B)."""
    return torch.cat((early_accept.motion(x), early_accept.attitude(x)))


def ended(alive: Tensor, found: Tensor, well: Tensor) -> tuple[Tensor, Tensor]:
    """Moves the trajectories in `well` from `alive` to `found`; returns both, (2, B) bool."""
    found = found | (alive & well)
    return alive & ~found, found
