"""Counting what flights did: violations, worst cases, filter calls, and rows that had slack together."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from inspection.state import SIZE
from rta.constraints import ATTITUDE, CONSTRAINTS, TRANSLATIONAL
from rta.qp import Status
from study.verification.flight import ROUNDING, Conflicts, Flight

SHOWN = 20  # calls with slack that a report holds, per constraint


class Origin(NamedTuple):
    """Where a flight's starts come from: the columns from `first` on of `initial_states(batch_size, batch_seed)`."""

    batch_seed: int
    batch_size: int
    first: int

    def of(self, column: Tensor) -> dict[str, int]:
        """A column of the flight in a report."""
        return {
            "batch_seed": self.batch_seed,
            "batch_size": self.batch_size,
            "column": self.first + int(column),
        }


def empty_tally() -> dict[str, Any]:
    """What is counted about episodes: none so far.

    `steps` are the states checked, one per second and that at 0 s. `worst_case` says which start of which batch
    gave the `worst_value` and when; `initial_states` of that size and seed has it in that column. `yielded_calls` and
    `largest_slack`, in h's unit per s (per s^2 at relative degree two), are about filter calls in which a row of the
    constraint had slack, and `slack_together` about the constraints of one program, of thrust or of torque.
    `conflicts` has the first SHOWN of these calls per constraint in full, in the order of the starts.
    """
    counts = dict.fromkeys((*CONSTRAINTS, "any"), 0)
    return {
        "episodes": 0,
        "steps": 0,
        "violating_steps": counts,
        "violating_episodes": dict(counts),
        "worst_value": dict.fromkeys(CONSTRAINTS),
        "worst_case": dict.fromkeys(CONSTRAINTS),
        "filter_calls": {status.name.lower(): 0 for status in Status},
        "unsolved": 0,
        "controls_outside_bounds": 0,
        "yielded_calls": dict.fromkeys(CONSTRAINTS, 0),
        "largest_slack": dict.fromkeys(CONSTRAINTS, 0.0),
        "slack_together": {},
        "conflicts": [],
    }


def add(tally: dict[str, Any], flight: Flight, origin: Origin) -> None:
    """Adds episodes to a tally, in place."""
    batch = flight.excess.numel()
    if batch == 0:
        return
    tally["episodes"] += batch
    tally["steps"] += batch * (len(flight.desired) + 1)
    for i, name in enumerate((*CONSTRAINTS, "any")):
        tally["violating_steps"][name] += int(flight.violating[i].sum())
        tally["violating_episodes"][name] += int((flight.violating[i] > 0).sum())
    for i, name in enumerate(CONSTRAINTS):
        tally["yielded_calls"][name] += int(flight.yielded[i].sum())
        tally["largest_slack"][name] = max(tally["largest_slack"][name], flight.slack[i].max().item())
        value, k = flight.worst[i].min(0)
        if tally["worst_value"][name] is None or value.item() < tally["worst_value"][name]:
            tally["worst_value"][name] = value.item()
            tally["worst_case"][name] = {
                **origin.of(flight.column[k]),
                "time_s": flight.when[i, k].item(),
                "initial_state": flight.start[:SIZE, k].tolist(),
                "priority": flight.start[SIZE:, k].tolist(),
            }
    for status in Status:
        tally["filter_calls"][status.name.lower()] += int(flight.status[status].sum())
    tally["unsolved"] = tally["filter_calls"]["unsolved"]
    tally["controls_outside_bounds"] += int((flight.excess > 1.0 + 1e-12).sum())
    add_conflicts(tally, flight.conflicts, origin)


def add_conflicts(tally: dict[str, Any], conflicts: Conflicts, origin: Origin) -> None:
    """Adds calls with slack to a tally, in place."""
    order = torch.argsort(conflicts.column, stable=True)  # so that a part of a batch comes first
    conflicts = Conflicts(*(part[..., order].cpu() for part in conflicts))
    together, recorded = tally["slack_together"], tally["conflicts"]
    shown = {name: sum(name in call["slack"] for call in recorded) for name in CONSTRAINTS}
    for k, slacks in enumerate(conflicts.slack.T.tolist()):
        slack = {name: value for name, value in zip(CONSTRAINTS, slacks, strict=True) if value > ROUNDING}
        for group in (TRANSLATIONAL, ATTITUDE):  # those of thrust and of torque do not conflict
            names = [name for name in slack if name in group]
            if not names:
                continue
            fresh = {"calls": 0, "largest_slack": dict.fromkeys(names, 0.0)}
            same = together.setdefault(" + ".join(names), fresh)
            same["calls"] += 1
            for name in names:
                same["largest_slack"][name] = max(same["largest_slack"][name], slack[name])
        if min(shown[name] for name in slack) < SHOWN:
            for name in slack:
                shown[name] += 1
            recorded.append(
                {
                    **origin.of(conflicts.column[k]),
                    "time_s": conflicts.time[k].item(),
                    "state": conflicts.state[:, k].tolist(),
                    "control_desired": conflicts.desired[:, k].tolist(),
                    "slack": slack,
                    "h": dict(zip(CONSTRAINTS, conflicts.h[:, k].tolist(), strict=True)),
                }
            )
