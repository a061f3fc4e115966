"""A flight with everything that a campaign keeps of it, by name."""

from types import SimpleNamespace

import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from study.flight.fly import Starts, fly
from study.verification.tape import Tape


def flown(
    env: InspectionEnv,
    controller: Controller,
    x: Tensor,
    priority: Tensor,
    duration: float,
    number: Tensor | None = None,
    first: int = 0,
) -> SimpleNamespace:
    """Returns the record and the tape of a flight, and their tensors: `violating`, `status`, `applied`, ..."""
    tape = Tape(duration, first)
    number = torch.zeros_like(x[0]) if number is None else number
    record = fly(env, controller, Starts(x, priority, number), duration, [tape])
    limits, calls = record.limits, record.calls
    return SimpleNamespace(
        record=record,
        tape=tape,
        violating=limits.violating,
        worst=limits.worst,
        when=limits.when,
        status=calls.status,
        backup=calls.backup,
        excess=calls.excess,
        desired=tape.desired,
        applied=tape.applied,
        corners=tape.corners,
        starts=record.starts,
    )
