"""The check of a filter's controls as C: what the driver's commit.c is made of."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import TORQUE
from kernels import Printed, printed
from rta.backup import homing, turn
from rta.backup.check import ATTITUDE, KEPT, LIMITS, MOTION, RATES_ROUNDED, SHARES, SLACK_ROUNDED, Backup
from rta.backup.flight import CELLS
from rta.backup.haven import thrust
from rta.backup.homing import Homing
from rta.backup.turn import TurnBackup
from rta.backup.turning import Turning
from rta.bounds.prediction import KINDS
from rta.constraints.names import CONSTRAINTS

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

# of the checks within bounds, which are computed for vectors of spacecraft
FOR_VECTORS = "turn_verified", "homing_look", "homing_way"

GIVEN_BOUND = ("x", "control", "error_bound")

Run = Callable[..., Sequence[Tensor]]


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
    b = safety_filter.backup
    named: list[tuple[str, Run, tuple[Tensor, ...], tuple[str, ...], tuple[str, ...]]] = [
        ("flown", lambda x, u: list(b.hold(x, u)), (x, u), ("x", "control"), ("after", "least")),
        ("at_once", lambda x: [b.at_once(x)], (x,), ("x",), ("least",)),
        ("terminal_room", lambda x: [b.terminal.room(x)], (x,), ("x",), ("room",)),
        ("backup_torque", lambda x: [b.torque(x)], (x,), ("x",), ("torque",)),
        (
            "backup_thrust",
            lambda x, torque: [b.thrust(x, torque)],
            (x, u[TORQUE]),
            ("x", "torque"),
            ("thrust",),
        ),
    ]
    return [
        printed(run, *examples, name=name, names=(given, results), long=CELLS[0])
        for name, run, examples, given, results in named
    ]


def turn_checks(backup: TurnBackup, x: Tensor, u: Tensor) -> list[Printed]:
    """The functions that turn.c calls, of a filter that is told of bounds."""
    bound = torch.zeros(KINDS, 1, dtype=torch.float64)
    least = ("least",)
    return [
        printed(
            partial(turn_verified, backup.turning), x, u, bound, name="turn_verified",
            names=(("x", "control", "error_bound"), least),
        ),
        printed(
            partial(turn_kept, backup.turning), x, bound, name="turn_kept", names=(("x", "error_bound"), least)
        ),
        printed(partial(turn_law, backup.turning), x, name="turn_law", names=(("x",), ("torque",))),
    ]  # fmt: skip


def homing_checks(check: Homing, x: Tensor, u: Tensor) -> list[Printed]:
    """The functions that homing.c calls, of a filter that is told of bounds."""
    bound, late = torch.zeros(KINDS, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    named: list[tuple[str, Run, tuple[Tensor, ...], tuple[str, ...], tuple[str, ...]]] = [
        ("homing_look", partial(homing_look, check), (x, u, bound), GIVEN_BOUND, ("after", "bound_after", "least")),
        ("homing_way", partial(homing_way, check), (x, bound, late), ("x", "error_bound", "late"), ("least",)),
        ("homing_kept", partial(homing_kept, check), (x, bound), ("x", "error_bound"), ("least",)),
        ("homing_law", partial(homing_law, check), (x, u), ("x", "control"), ("thrust",)),
    ]  # fmt: skip
    cells = check.haven.free.cells  # looped over
    return [
        printed(run, *examples, name=name, names=(given, results), long=cells)
        for name, run, examples, given, results in named
    ]


def homing_look(check: Homing, x: Tensor, u: Tensor, error_bound: Tensor) -> list[Tensor]:
    """`homing.look`."""
    end, bound, least = homing.look(x, u, error_bound, check.haven, check.r)
    return [end, bound, least[None]]


def homing_way(check: Homing, x: Tensor, error_bound: Tensor, late: Tensor) -> list[Tensor]:
    """`homing.home`."""
    return [homing.home(x, error_bound, late[0], check.haven)[None]]


def homing_kept(check: Homing, x: Tensor, error_bound: Tensor) -> list[Tensor]:
    """`homing.may_be_kept`."""
    return [homing.may_be_kept(x, error_bound, check.haven)[None]]


def homing_law(check: Homing, x: Tensor, u: Tensor) -> list[Tensor]:
    """`haven.thrust`."""
    return [thrust(x, u[TORQUE], check.haven)]


def turn_verified(turning: Turning, x: Tensor, u: Tensor, error_bound: Tensor) -> list[Tensor]:
    """`turn.verified`."""
    return [turn.verified(x, u, error_bound, turning)[None]]


def turn_kept(turning: Turning, x: Tensor, error_bound: Tensor) -> list[Tensor]:
    """`turn.may_be_kept`."""
    return [turn.may_be_kept(x, error_bound, turning)[None]]


def turn_law(turning: Turning, x: Tensor) -> list[Tensor]:
    """`turn.law`."""
    return [turn.law(x, turning)]


def constants(backup: Backup) -> dict[str, tuple[int | float | str, str]]:
    """What commit.c depends on: by name the value and what it is."""
    names = ("SEPARATION", 0), ("ZONE", 2), ("PASSIVE", 3), ("TEMPERATURE", 8), ("BATTERY", 9)
    own: dict[str, tuple[int | float | str, str]] = {
        "LIMITS": (LIMITS, "of which the body rates are one, the last"),
        "KEPT": (KEPT, "in the unit of each limit: what rounding may take"),
        "FLIGHT_HOLDS": (backup.holds, "of a flight at most"),
    }
    return own | {f"{name}_LIMIT": (place, "") for name, place in names} | trials() | limits()


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
