"""The check of a filter's controls as C: what the driver's commit.c is made of."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE, SIZE, TORQUE
from kernels import Printed, printed
from rta.backup import brake, homing, slew, turn
from rta.backup.check import ATTITUDE, MOTION, RATES_ROUNDED, SHARES, SLACK_ROUNDED, Backup
from rta.backup.haven import thrust
from rta.backup.homing import Homing
from rta.backup.turn import TurnBackup
from rta.backup.turning import Turning
from rta.bounds.prediction import KINDS
from rta.constraints.names import CONSTRAINTS

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

AT = 10  # components of where a way begins, see `rta.backup.brake.beginning`
AT_A_GLANCE = (
    "thrust_glance",
    "torque_sight",
    "torque_glance",
    "thrust_look",
    "beginning",
    "braked",
    "turn_verified",
    "homing_look",
    "homing_way",
)  # which are computed for vectors of spacecraft

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
    at = torch.zeros(AT, 1, dtype=torch.float64)
    at[:AT] = x[:AT]
    backup = safety_filter.backup
    rough, close = backup.braking.rough.cells, backup.braking.free.cells  # looped over
    named: list[tuple[str, Run, tuple[Tensor, ...], tuple[str, ...], tuple[str, ...], int]] = [
        ("thrust_glance", partial(thrust_glance, backup), (x, u), ("x", "control"), ("least",), rough),
        ("torque_sight", partial(torque_sight, backup), (x, u), ("x", "control"), ("least",), 0),
        ("torque_glance", partial(torque_glance, backup), (x, u), ("x", "control"), ("least",), 0),
        ("thrust_look", partial(thrust_look, backup), (x, u), ("x", "control"), ("after", "least"), close),
        ("beginning", partial(beginning, backup), (x,), ("x",), ("at",), 0),
        ("torque_verified", partial(torque_verified, backup), (x, u), ("x", "control"), ("least",), 0),
        ("braked", partial(braked, backup), (at,), ("at",), ("after", "least"), close),
        ("brake_law", partial(brake_law, backup), (x, u), ("x", "control"), ("thrust",), 0),
        ("slew_law", partial(slew_law, backup), (x,), ("x",), ("torque",), 0),
    ]
    return [
        printed(run, *examples, name=name, names=(given, results), long=long)
        for name, run, examples, given, results, long in named
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


def thrust_glance(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`brake.at_a_glance`."""
    return [brake.at_a_glance(x, u, backup.braking)[None]]


def torque_glance(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`slew.at_a_glance`."""
    return [slew.at_a_glance(x, u, backup.slewing)[None]]


def torque_sight(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`slew.at_first_sight`."""
    return [slew.at_first_sight(x, u, backup.slewing)[None]]


def thrust_look(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`brake.look`, closely."""
    end, least = brake.look(x, u, backup.braking, backup.braking.free)
    return [end, least[None]]


def beginning(backup: Backup, x: Tensor) -> list[Tensor]:
    """`brake.beginning`."""
    return [brake.beginning(x, backup.braking)]


def torque_verified(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`slew.verified`."""
    return [slew.verified(x, u, backup.slewing)[None]]


def braked(backup: Backup, at: Tensor) -> list[Tensor]:
    """`brake.braked`."""
    after, least = brake.braked(at, backup.braking)
    return [after, least[None]]


def brake_law(backup: Backup, x: Tensor, u: Tensor) -> list[Tensor]:
    """`brake.brake`, with the torque of controls (6, B)."""
    return [brake.brake(x, u[TORQUE], backup.braking)]


def slew_law(backup: Backup, x: Tensor) -> list[Tensor]:
    """`slew.slew`."""
    return [slew.slew(x, backup.slewing)]


GIVEN = f"const double x[{SIZE}], const double control[{CONTROL_SIZE}]"
DECLARED = {
    "thrust_glance": f"{GIVEN}, double least[1]",
    "torque_sight": f"{GIVEN}, double least[1]",
    "thrust_look": f"{GIVEN}, double after[{SIZE}], double least[1]",
    "beginning": f"const double x[{SIZE}], double at[{AT}]",
    "torque_verified": f"{GIVEN}, double least[1]",
    "braked": f"const double at[{AT}], double after[{AT}], double least[1]",
    "brake_law": f"{GIVEN}, double thrust[3]",
    "slew_law": f"const double x[{SIZE}], double torque[3]",
}
OF_HOMING = {
    "homing_look": f"{GIVEN}, const double error_bound[{KINDS}],\n    double after[{SIZE}], "
    f"double bound_after[{KINDS}], double least[1]",
    "homing_way": f"const double x[{SIZE}], const double error_bound[{KINDS}], const double late[1], double least[1]",
    "homing_kept": f"const double x[{SIZE}], const double error_bound[{KINDS}], double least[1]",
    "homing_law": f"{GIVEN}, double thrust[3]",
}
OF_TURN = {
    "turn_verified": f"{GIVEN}, const double error_bound[{KINDS}], double least[1]",
    "turn_kept": f"const double x[{SIZE}], const double error_bound[{KINDS}], double least[1]",
    "turn_law": f"const double x[{SIZE}], double torque[3]",
}


def of_one(parts: Sequence[Printed]) -> list[Printed]:
    """Those of `checks` that are called for one spacecraft; the others are a batch's."""
    return [part for part in parts if part.name in DECLARED or part.name in OF_TURN or part.name in OF_HOMING]


def constants(backup: Backup) -> dict[str, tuple[int | float | str, str]]:
    """What commit.c depends on: by name the value and what it is."""
    own: dict[str, tuple[int | float | str, str]] = {
        "LOOKS": (backup.braking.steps, "at a hold"),
        "BRAKING_HOLDS": (backup.braking.holds, "after which a spacecraft that brakes must be at rest"),
        "AT_REST": (brake.AT_REST, "m/s"),
    }
    return own | trials() | limits()


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
