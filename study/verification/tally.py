"""Counting what flights did: violations, worst cases, filter calls, and rows that had slack together."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor

from rta.names import ATTITUDE, CONSTRAINTS, TRANSLATIONAL
from rta.result import Status
from study.flight.fly import ROUNDING, Record
from study.verification.tape import Conflicts, Tape

SHOWN = 10  # calls with slack that a report holds, per constraint


def empty_tally() -> dict[str, Any]:
    """What is counted about episodes: none so far.

    `steps` are the states checked: that at 0 s and one per check. `worst_case` says which start of which batch
    gave the `worst_value` and when; `initial_states` of that size and seed has it in that column. `yielded_calls` and
    `largest_slack`, in h's unit per s (per s^2 at relative degree two), are about filter calls in which a row of the
    constraint had slack, and `slack_together` about the constraints of one program, of thrust or of torque.
    `backup_calls` are those in which the backup law decided, not the programs' solution (`FilterResult.backup`).
    `conflicts` has the first SHOWN of these calls per constraint in full, in the order of the starts.
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
        "yielded_calls": dict.fromkeys(CONSTRAINTS, 0),
        "largest_slack": dict.fromkeys(CONSTRAINTS, 0.0),
        "slack_together": {},
        "conflicts": [],
    }


def add(tally: dict[str, Any], record: Record, tape: Tape, chosen: Tensor, origin: dict[str, int]) -> None:
    """Adds the episodes where `chosen` (B,) bool is set to a tally, in place.

    Their columns are those of `initial_states` of the origin's size and seed.
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
    parts = (limits.worst, limits.when, calls.yielded, calls.slack)
    rows = zip(CONSTRAINTS, *(part[:, chosen] for part in parts), strict=True)
    for name, worst, when, yielded, slack in rows:
        tally["yielded_calls"][name] += int(yielded.sum())
        tally["largest_slack"][name] = max(tally["largest_slack"][name], slack.max().item())
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
    add_conflicts(tally, tape.conflicts.of(tape.column[chosen]), origin)


def add_conflicts(tally: dict[str, Any], conflicts: Conflicts, origin: dict[str, int]) -> None:
    """Adds calls with slack to a tally, in place."""
    order = torch.argsort(conflicts.column, stable=True)  # so that a part of a batch comes first
    calls = (part[..., order].movedim(-1, 0).tolist() for part in conflicts)
    recorded = tally["conflicts"]
    shown = Counter(name for call in recorded for name in call["slack"])
    for column, time, state, desired, slacks, h in zip(*calls, strict=True):
        slack = {name: value for name, value in zip(CONSTRAINTS, slacks, strict=True) if value > ROUNDING}
        for group in (TRANSLATIONAL, ATTITUDE):  # those of thrust and of torque do not conflict
            if theirs := {name: value for name, value in slack.items() if name in group}:
                add_together(tally["slack_together"], theirs)
        if min(shown[name] for name in slack) < SHOWN:
            shown.update(slack.keys())
            recorded.append(
                {
                    **origin,
                    "column": column,
                    "time_s": time,
                    "state": state,
                    "control_desired": desired,
                    "slack": slack,
                    "h": dict(zip(CONSTRAINTS, h, strict=True)),
                }
            )


def add_together(together: dict[str, Any], slack: dict[str, float]) -> None:
    """Adds one program's slack by constraint, in place."""
    same = together.setdefault(" + ".join(slack), {"calls": 0, "largest_slack": dict.fromkeys(slack, 0.0)})
    same["calls"] += 1
    for name, value in slack.items():
        same["largest_slack"][name] = max(same["largest_slack"][name], value)
