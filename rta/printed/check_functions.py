"""The check of a filter's controls as C: what its driver is made of."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import SIZE, TORQUE
from inspection.model.state_checks import LARGEST, state_room
from kernels.printer import Printed, if_long, printed
from rta.backup import robust_attitude_check, robust_motion_check
from rta.backup.commit import ATTITUDE, LIMITS, MOTION, SHARES, SLACK_ROUNDED, Check
from rta.backup.flight import CELLS, fly_attitude
from rta.backup.nominal_check import KEPT, RATES_ROUNDED, NominalBackup
from rta.backup.robust_check import RobustBackup
from rta.bounds.prediction import KINDS
from rta.constraints.names import PAPERS

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

GIVEN_BOUND = ("x", "control", "error_bound")

# of a function: its name in C, itself, examples, and what it is given and gives
Named = tuple[str, Callable[..., Sequence[Tensor]], tuple[Tensor, ...], Sequence[str], Sequence[str]]


def checks(safety_filter: "SafetyFilter") -> list[Printed]:
    """The functions that the driver's check calls; none where the filter knows no backup trajectory."""
    b, (x, u) = safety_filter.backup, safety_filter.probe("cpu")
    if b is None:
        return []
    states = all_printed(("state_room", lambda x: [state_room(x, safety_filter.c)], (x,), ("x",), ("room",)))
    if isinstance(b, RobustBackup):
        return states + robust_functions(b, x, u)
    assert isinstance(b, NominalBackup)
    planes = if_long(len(safety_filter.c.planes))  # of a hull
    holds = all_printed(
        ("flown", lambda x, u: list(b.hold(x, u)), (x, u), ("x", "control"), ("after", "least")),
        long=planes or CELLS[0],
    )
    return states + holds + laws(b, x, u) + all_printed(
        ("attitude_flown", lambda x, u: list(fly_attitude(x, u, b.flight)), (x, u), ("x", "control"),
         ("after", "least")),
        ("at_once", lambda x: [b.at_once(x)], (x,), ("x",), ("least",)),
        ("terminal_room", lambda x: [b.terminal.room(x)], (x,), ("x",), ("room",)),
        long=planes,
    )  # fmt: skip


def laws(check: Check, x: Tensor, u: Tensor) -> list[Printed]:
    """Both backup laws."""
    return all_printed(
        ("backup_torque", lambda x: [check.torque(x)], (x,), ("x",), ("torque",)),
        ("backup_thrust", lambda x, torque: [check.thrust(x, torque)], (x, u[TORQUE]), ("x", "torque"), ("thrust",)),
    )  # fmt: skip


def robust_functions(b: RobustBackup, x: Tensor, u: Tensor) -> list[Printed]:
    """The functions that robust_check.c calls."""
    bound, late = torch.zeros(KINDS, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    y, least, found = torch.cat((x, bound)), ("least",), []
    if w := b.attitude:
        run = lambda x, u, e: [robust_attitude_check.verified(x, u, e, w)[None]]  # noqa: E731
        found += all_printed(("attitude_verified", run, (x, u, bound), GIVEN_BOUND, least))
    if v := b.terminal_set:

        def hold_period(x: Tensor, u: Tensor, error_bound: Tensor) -> list[Tensor]:
            end, after, least = robust_motion_check.hold_period(x, u, error_bound, v, b.r)
            return [end, after, least[None]]

        def margin(x: Tensor, error_bound: Tensor, late: Tensor) -> list[Tensor]:
            return [robust_motion_check.trajectory_margin_at(x, error_bound, late[0], v)[None]]

        found += all_printed(
            ("motion_hold", hold_period, (x, u, bound), GIVEN_BOUND, ("after", "bound_after", "least")),
            ("motion_trajectory_margin", margin, (x, bound, late), ("x", "error_bound", "late"), least),
            long=v.free.cells,
        )
    return (
        found
        + laws(b, x, u)
        + all_printed(("may_be_kept", lambda y: [b.may_be_kept(y)], (y,), ("y",), least))
    )


def all_printed(*named: Named, long: int = 0) -> list[Printed]:
    """Functions, with examples and names of what they are given and of their results; an axis is `long`."""
    return [
        printed(run, *examples, name=name, names=(given, results), long=long)
        for name, run, examples, given, results in named
    ]


def constants(backup: Check | None) -> dict[str, tuple[int | float | str, str]]:
    """What a check in C depends on: by name the value and what it is."""
    if backup is None:
        return {"CHECKED": (0, ""), "FLIES": (0, ""), "ALL_CHECKED": (0, ""), "SEEN": (SIZE, "")}
    found = {
        "CHECKED": (1, "what is proposed is checked"),
        "LARGEST": (LARGEST, "of any number in a state, in its unit"),
        "ALL_CHECKED": (int(all(backup.knows)), "thrust and torque are"),
        "FLIES": (int(isinstance(backup, NominalBackup)), "by flights of the laws, see flight.c"),
        "LIMITS": (LIMITS, "of which the body rates are one, the last"),
        **trials(),
        **limits(),
    }
    assert isinstance(backup, NominalBackup | RobustBackup)
    return found | (of_flights(backup) if isinstance(backup, NominalBackup) else of_bounds(backup))


def of_bounds(backup: RobustBackup) -> dict[str, tuple[int | float | str, str]]:
    """Of robust_check.c, as `constants`."""
    return {
        "SEEN": (SIZE + KINDS, "numbers: a state, and by how much further than measured it may be off"),
        "ATTITUDE_CHECKED": (int(backup.attitude is not None), "1: torque is checked"),
        "HELD_CALLS": (
            robust_motion_check.calls(backup.terminal_set) if backup.terminal_set else 0,
            "of a hold; 0: thrust is not checked",
        ),
    }


def of_flights(backup: NominalBackup) -> dict[str, tuple[int | float | str, str]]:
    """Of flight.c, as `constants`."""
    names = {
        "SEPARATION": "collision",
        "ZONE": "keep_in_zone",
        "PASSIVE": "passive_safety",
        "TEMPERATURE": "temperature",
        "BATTERY": "battery",
    }
    own: dict[str, tuple[int | float | str, str]] = {
        "SEEN": (SIZE, "numbers of a state"),
        "KEPT": (KEPT, "in the unit of each limit: what rounding may take"),
        "FLIGHT_HOLDS": (backup.max_periods, "of a flight at most"),
        "GLANCES": (backup.glances, "holds, between two looks at all that is left of a flight"),
    }
    return own | {f"{name}_LIMIT": (PAPERS.index(limit), "") for name, limit in names.items()}


def trials() -> dict[str, tuple[int | float | str, str]]:
    """What is tried in the place of a control, as `constants`."""
    shares = ", ".join(f"{share:g}" for share in (*SHARES, 1.0))
    return {
        "SLACK_ROUNDED": (SLACK_ROUNDED, "in the unit of slack, up to which it is a solver's rounding"),
        "SHARE_COUNT": (len(SHARES) + 1, ""),
        "SHARES": ("{" + shares + "}", "tried between the proposed control and the backup law's"),
    }


def limits() -> dict[str, tuple[int | float | str, str]]:
    """Which limits a backup trajectory keeps, as `constants`."""
    return {
        "MOTION_LIMITS": (MOTION, "constraints, the first, that a backup trajectory keeps by thrust"),
        "ATTITUDE_LIMITS": (ATTITUDE, "the next, by torque"),
        "KEPT_LIMITS": (
            len(PAPERS),
            "the first, the rates being their last; after these the user's own, which it does not know",
        ),
        "RATES_ROUNDED": (RATES_ROUNDED, "rad^2/s^2, by which rates at their limit may be beyond"),
    }
