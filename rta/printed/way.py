"""The check of a filter's controls as C: what the driver's commit.c is made of."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import TORQUE
from kernels import Printed, if_long, printed
from rta.backup import homing, turn
from rta.backup.check import ATTITUDE, KEPT, LIMITS, MOTION, RATES_ROUNDED, SHARES, SLACK_ROUNDED, Backup
from rta.backup.flight import CELLS
from rta.backup.flight import turn as turn_in
from rta.backup.haven import thrust
from rta.backup.homing import Homing
from rta.backup.turn import TurnBackup
from rta.bounds.prediction import KINDS
from rta.constraints.names import CONSTRAINTS

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

# of the checks within bounds, which are computed for vectors of spacecraft
FOR_VECTORS = "turn_verified", "homing_look", "homing_way"

GIVEN_BOUND = ("x", "control", "error_bound")

# of a function: its name in C, itself, examples, and what it is given and gives
Named = tuple[str, Callable[..., Sequence[Tensor]], tuple[Tensor, ...], Sequence[str], Sequence[str]]


def checks(safety_filter: "SafetyFilter") -> list[Printed]:
    """The functions that either commit.c calls; none where the filter knows no way to rest."""
    x, u = safety_filter.probe("cpu")
    told = homing_checks(safety_filter.homing, x, u) if safety_filter.homing else []
    if safety_filter.turn:
        told += turn_checks(safety_filter.turn, x, u)
    if told:
        return told
    if safety_filter.backup is None:
        return []
    b, planes = safety_filter.backup, if_long(len(safety_filter.c.planes))  # of a hull
    holds = all_printed(
        ("flown", lambda x, u: list(b.hold(x, u)), (x, u), ("x", "control"), ("after", "least")),
        long=planes or CELLS[0],
    )
    return holds + all_printed(
        ("turned", lambda x, u: list(turn_in(x, u, b.flight)), (x, u), ("x", "control"), ("after", "least")),
        ("at_once", lambda x: [b.at_once(x)], (x,), ("x",), ("least",)),
        ("terminal_room", lambda x: [b.terminal.room(x)], (x,), ("x",), ("room",)),
        ("backup_torque", lambda x: [b.torque(x)], (x,), ("x",), ("torque",)),
        ("backup_thrust", lambda x, torque: [b.thrust(x, torque)], (x, u[TORQUE]), ("x", "torque"), ("thrust",)),
        long=planes,
    )  # fmt: skip


def turn_checks(backup: TurnBackup, x: Tensor, u: Tensor) -> list[Printed]:
    """The functions that turn.c calls, of a filter that is told of bounds."""
    w, bound = backup.turning, torch.zeros(KINDS, 1, dtype=torch.float64)
    return all_printed(
        ("turn_verified", lambda x, u, e: [turn.verified(x, u, e, w)[None]], (x, u, bound), GIVEN_BOUND, ("least",)),
        ("turn_kept", lambda x, e: [turn.may_be_kept(x, e, w)[None]], (x, bound), ("x", "error_bound"), ("least",)),
        ("turn_law", lambda x: [turn.law(x, w)], (x,), ("x",), ("torque",)),
    )  # fmt: skip


def homing_checks(check: Homing, x: Tensor, u: Tensor) -> list[Printed]:
    """The functions that homing.c calls, of a filter that is told of bounds."""
    w, r = check.haven, check.r
    bound, late = torch.zeros(KINDS, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    bounded, least = ("x", "error_bound"), ("least",)

    def look(x: Tensor, u: Tensor, error_bound: Tensor) -> list[Tensor]:
        end, after, least = homing.look(x, u, error_bound, w, r)
        return [end, after, least[None]]

    return all_printed(
        ("homing_look", look, (x, u, bound), GIVEN_BOUND, ("after", "bound_after", "least")),
        ("homing_way", lambda x, e, t: [homing.home(x, e, t[0], w)[None]], (x, bound, late), (*bounded, "late"), least),
        ("homing_kept", lambda x, e: [homing.may_be_kept(x, e, w)[None]], (x, bound), bounded, least),
        ("homing_law", lambda x, u: [thrust(x, u[TORQUE], w)], (x, u), ("x", "control"), ("thrust",)),
        long=w.free.cells,
    )  # fmt: skip


def all_printed(*named: Named, long: int = 0) -> list[Printed]:
    """Functions, with examples and names of what they are given and of their results; an axis is `long`."""
    return [
        printed(run, *examples, name=name, names=(given, results), long=long)
        for name, run, examples, given, results in named
    ]


def constants(backup: Backup) -> dict[str, tuple[int | float | str, str]]:
    """What commit.c depends on: by name the value and what it is."""
    names = {
        "SEPARATION": "collision",
        "ZONE": "keep_in_zone",
        "PASSIVE": "passive_safety",
        "TEMPERATURE": "temperature",
        "BATTERY": "battery",
    }
    own: dict[str, tuple[int | float | str, str]] = {
        "LIMITS": (LIMITS, "of which the body rates are one, the last"),
        "KEPT": (KEPT, "in the unit of each limit: what rounding may take"),
        "FLIGHT_HOLDS": (backup.holds, "of a flight at most"),
        "GLANCES": (backup.glances, "holds, between two looks at all that is left of a flight"),
    }
    return (
        own
        | {f"{name}_LIMIT": (CONSTRAINTS.index(limit), "") for name, limit in names.items()}
        | trials()
        | limits()
    )


def trials() -> dict[str, tuple[int | float | str, str]]:
    """What is tried in the place of a control, as `constants`."""
    shares = ", ".join(f"{share:g}" for share in (*SHARES, 1.0))
    return {
        "SLACK_ROUNDED": (SLACK_ROUNDED, "in the unit of slack, up to which it is a solver's rounding"),
        "SHARE_COUNT": (len(SHARES) + 1, ""),
        "SHARES": ("{" + shares + "}", "of the way from what is proposed to the backup law's control"),
    }


def limits() -> dict[str, tuple[int | float | str, str]]:
    """Which limits a way keeps, as `constants`."""
    return {
        "MOTION_LIMITS": (MOTION, "constraints, the first, that a way keeps by thrust"),
        "ATTITUDE_LIMITS": (ATTITUDE, "the next, by torque"),
        "KEPT_LIMITS": (
            len(CONSTRAINTS),
            "the first, the rates being their last; after these the user's own, which it does not know",
        ),
        "RATES_ROUNDED": (RATES_ROUNDED, "rad^2/s^2, by which rates at their limit may be beyond"),
    }
