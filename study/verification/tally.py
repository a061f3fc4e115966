"""Counts of flights: violations, worst cases and filter calls."""

from typing import Any

from torch import Tensor

from rta.names import CONSTRAINTS
from rta.result import Status
from study.flight.fly import Record
from study.verification.tape import Tape


def empty_tally() -> dict[str, Any]:
    """Returns a tally without episodes.

    `steps` counts the checked states: the start, and one at each check. `worst_case` says which start of which batch
    gave the `worst_value`, and when: `initial_states` of this batch's size and seed returns the start in this column.
    `backup_calls` counts calls that the backup law decided, not the program (`FilterResult.backup`).
    """
    return {
        "episodes": 0,
        "steps": 0,
        "violating_steps": dict.fromkeys((*CONSTRAINTS, "any"), 0),
        "violating_episodes": dict.fromkeys((*CONSTRAINTS, "any"), 0),
        "worst_value": dict.fromkeys(CONSTRAINTS),
        "worst_case": dict.fromkeys(CONSTRAINTS),
        "filter_calls": {status.name.lower(): 0 for status in Status},
        "unsolved": 0,
        "controls_outside_bounds": 0,
        "backup_calls": 0,
    }


def add(tally: dict[str, Any], record: Record, tape: Tape, chosen: Tensor, origin: dict[str, int]) -> None:
    """Adds the episodes for which `chosen` (B,) bool is true to a tally, in place.

    Their columns are those of `initial_states` with the origin's size and seed.
    """
    batch = int(chosen.sum())
    if batch == 0:
        return
    limits, calls, starts = record.limits, record.calls, record.starts
    tally["episodes"] += batch
    tally["steps"] += int(limits.checked[chosen].sum())
    for name, steps in zip((*CONSTRAINTS, "any"), limits.violating[:, chosen], strict=True):
        tally["violating_steps"][name] += int(steps.sum())
        tally["violating_episodes"][name] += int((steps > 0).sum())
    columns = chosen.nonzero().flatten()
    for name, worst, when in zip(CONSTRAINTS, limits.worst[:, chosen], limits.when[:, chosen], strict=True):
        value, k = worst.min(0)
        if tally["worst_value"][name] is None or value.item() < tally["worst_value"][name]:
            tally["worst_value"][name] = value.item()
            tally["worst_case"][name] = {
                **origin,
                "column": int(tape.column[columns[k]]),
                "time_s": when[k].item(),
                "initial_state": starts.x[:, columns[k]].tolist(),
                "priority": starts.priority[:, columns[k]].tolist(),
            }
    for status, answered in zip(Status, calls.status[:, chosen], strict=True):
        tally["filter_calls"][status.name.lower()] += int(answered.sum())
    tally["unsolved"] = tally["filter_calls"]["unsolved"]
    tally["backup_calls"] += int(calls.backup[chosen].sum())
    tally["controls_outside_bounds"] += int((calls.excess[chosen] > 1.0 + 1e-12).sum())
