"""Tests single calls of the filter next to its limits: is every h still >= 0?

A draw is a state (`study.verification.limits`) with TRIES desired controls, each of which goes through the filter and
the plant for one period. Every h is checked every CHECK_BETWEEN s. Draws are independent, so Clopper and Pearson's
bound holds per draw.
"""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from columns import if_long
from inspection.closed_loop import Smallest
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.result import Status
from study.config import Config
from study.errors import as_input_error
from study.experiment import Experiment, check_clocks, check_is_checked
from study.files import write_json
from study.flight.fly import with_any
from study.flight.summary import upper_bound
from study.machine import bar
from study.verification.adversaries import adversarial
from study.verification.campaign import blamed
from study.verification.findings import WIDTH, report_in
from study.verification.limits import BISECTIONS, CANDIDATES, NearLimits, barriers, near_limits
from study.verification.starts import spawned
from study.verified import fingerprint, gains_of

BATCH = 4096  # states drawn at once
TRIES = 4  # desired controls at each state
CHECK_BETWEEN = 0.1  # s
SHOWN = 5  # worst cases in a report, per constraint
CALLS = 2 + 3 * sum(BISECTIONS)  # about the number of evaluations of the filter's rows per batch


@dataclasses.dataclass(frozen=True)
class Boundary:
    """Holds what determines the numbers besides the configuration; `period` is the filter's in s."""

    period: float
    seed: int
    batch_size: int
    tries: int = TRIES
    candidates: int = CANDIDATES
    kind: str = "boundary"


def controls(x: Tensor, safety_filter: SafetyFilter, generator: torch.Generator) -> Tensor:
    """Returns desired controls (TRIES, 6, B) at states (16, B).

    They are the adversary's control, the vertex of the control box closest to it, a random vertex and a random control.
    """
    limit = x.new_tensor(safety_filter.c.control_limit)[:, None]
    down = adversarial(safety_filter)(0.0, x)
    number = torch.rand(2, CONTROL_SIZE, x.shape[1], generator=generator, dtype=torch.float64).to(x)
    vertex, anywhere = 2.0 * number[0].round() - 1.0, 2.0 * number[1] - 1.0
    nearest = torch.where(down == 0.0, vertex, down.sign())
    return torch.stack((down, limit * nearest, limit * vertex, limit * anywhere))


class Tried(NamedTuple):
    """Holds the results of a batch of draws; last axis the draws.

    Attributes:
        smallest: (constraints, B) smallest h within the period, under the worst desired control for each constraint.
        desired, applied: (constraints, 6, B) these worst controls, and the filter's controls in their place.
        unsolved, backup: number of filter calls, among `calls`, that were not solved and that the backup law decided.
    """

    smallest: Tensor
    desired: Tensor
    applied: Tensor
    unsolved: int
    backup: int
    calls: int


@torch.no_grad()
def tried(env: InspectionEnv, x: Tensor, desired: Tensor, number: Tensor) -> Tried:
    """Applies each of the desired controls (TRIES, 6, B) at states x (16, B) for one period.

    Args:
        env: with TRIES * B episodes; number: (B,) in [0, 1), which determine the plants.
    """
    tries, _, batch = desired.shape
    flat = desired.transpose(0, 1).flatten(1)
    start = x.repeat(1, tries)
    if env.plant:
        env.plant.begin(torch.arange(tries * batch, device=x.device), start, number.repeat(tries))
    h = Smallest(len(env.safety.names), start)
    holds = env.fly(lambda t, seen: flat, env.safety.period, start)
    for hold in chain((first := next(holds),), holds):
        h.note(env.constraint_values(hold.after))
    answer: Any = first.correction  # of the project's own filter
    smallest, worst = h.value.unflatten(-1, (tries, batch)).min(1)
    chosen = worst[:, None, None].expand(-1, CONTROL_SIZE, -1, -1)

    def of_worst(control: Tensor) -> Tensor:
        every = control.unflatten(-1, (tries, batch)).expand(len(worst), -1, -1, -1)
        return every.gather(2, chosen)[:, :, 0]

    unsolved, backup = int((answer.status == Status.UNSOLVED).sum()), int(answer.backup.sum())
    return Tried(smallest, of_worst(flat), of_worst(first.applied), unsolved, backup, tries * batch)


def empty_report(campaign: Any, config: Config) -> dict[str, Any]:
    """Returns a report without draws, in the form of `boundary --json`.

    `violating_draws` counts draws with h < 0 within the period; `limits` and `pairs` count draws by the limits that
    their states are next to, and `worst` has the SHOWN cases of smallest h per constraint.
    """
    return {
        "campaign": dataclasses.asdict(campaign),
        "batches": 0,
        "draws": 0,
        "upper_bound_95": 1.0,
        "violating_draws": dict.fromkeys((*CONSTRAINTS, "any"), 0),
        "worst_value": dict.fromkeys(CONSTRAINTS),
        "filter_calls": 0,
        "unsolved": 0,
        "backup_calls": 0,
        "limits": {},
        "pairs": {},
        "worst": {name: [] for name in CONSTRAINTS},
        "fingerprint": fingerprint(config),
        "gains": gains_of(),
        "config": dataclasses.asdict(config),
    }


def add(report: dict[str, Any], near: NearLimits, result: Tried, number: Tensor) -> None:
    """Adds a batch of draws to a report, in place."""
    violating = with_any(result.smallest < 0.0)
    report["draws"] += number.numel()
    report["filter_calls"] += result.calls
    report["unsolved"] += result.unsolved
    report["backup_calls"] += result.backup
    for name, drawn in zip((*CONSTRAINTS, "any"), violating, strict=True):
        report["violating_draws"][name] += int(drawn.sum())
    report["upper_bound_95"] = upper_bound(report["violating_draws"]["any"], report["draws"])
    code = near.limits[0] * len(CONSTRAINTS) + near.limits[1]
    for value in code.unique().tolist():
        first, second = (CONSTRAINTS[i] for i in divmod(value, len(CONSTRAINTS)))
        table, name = ("limits", first) if first == second else ("pairs", f"{first} + {second}")
        counts = report[table].setdefault(name, {"draws": 0, "violating": 0})
        counts["draws"] += int((code == value).sum())
        counts["violating"] += int((violating[-1] & (code == value)).sum())
    for i, name in enumerate(CONSTRAINTS):
        report["worst"][name] += [
            {
                "value": least,
                "limits": [CONSTRAINTS[k] for k in near.limits[:, column].unique().tolist()],
                "batch": report["batches"],
                "column": column,
                "plant": number[column].item(),
                "state": near.state[:, column].tolist(),
                "control_desired": result.desired[i, :, column].tolist(),
                "control_applied": result.applied[i, :, column].tolist(),
            }
            for least, column in zip(
                *(
                    part.tolist()
                    for part in result.smallest[i].topk(min(SHOWN, number.numel()), largest=False)
                ),
                strict=True,
            )
        ]
        report["worst"][name].sort(key=lambda case: case["value"])
        del report["worst"][name][SHOWN:]
        report["worst_value"][name] = report["worst"][name][0]["value"]
    report["batches"] += 1


def table(report: dict[str, Any]) -> str:
    """Returns a report as text, at most WIDTH columns wide."""
    pairs = {kind: sum(own[kind] for own in report["pairs"].values()) for kind in ("draws", "violating")}
    lines = [f"{'next to':20s} {'draws':>13s} {'violating':>11s} {'below (95 %)':>13s}  {'smallest h':>12s}"]
    for name, counts in (*report["limits"].items(), ("two of them", pairs)):
        bound = upper_bound(counts["violating"], counts["draws"]) if counts["draws"] else 1.0
        line = f"{name:20s} {counts['draws']:13,d} {counts['violating']:11,d} {bound:13.2e}"
        value = report["worst_value"].get(name)
        lines.append(line if value is None else f"{line}  {value:12.5g}")
    violated = {name: count for name, count in report["violating_draws"].items() if count and name != "any"}
    lines += [
        f"{report['draws']:,} draws next to {len(report['limits'])} limits and {len(report['pairs'])} pairs; violation "
        f"probability per draw below {report['upper_bound_95']:.2e} (95 %)",
        "violated: " + (", ".join(f"{name} {count:,}" for name, count in violated.items()) or "none"),
        f"{report['filter_calls']:,} filter calls, {report['unsolved']:,} unsolved, "
        f"{report['backup_calls']:,} by the backup",
    ]
    return "\n".join(fill(line, WIDTH, subsequent_indent=" " * 11) for line in lines)


def barriers_of(experiment: Experiment) -> Callable[[Tensor], Tensor]:
    """Returns `barriers` of the experiment's filter, compiled if the filter is."""
    safety_filter = experiment.checked_filter
    if not experiment.filter_compiled:
        return partial(barriers, safety_filter=safety_filter)
    example = safety_filter.probe(experiment.device)[0]
    long = if_long(len(safety_filter.c.planes))
    compiled = experiment.compiler(lambda x: [barriers(x, safety_filter)], example, long=long)
    return lambda x: compiled(x)[0]


def run(
    campaign: Boundary, draws: int, experiment: Experiment, path: Path | None
) -> Iterator[dict[str, Any]]:
    """Draws batch after batch and yields the report so far; `path` holds the same report, and a later call resumes it.

    Only whole batches are drawn, so there may be more draws than asked for.
    """
    config, safety_filter = experiment.config, experiment.checked_filter
    report = report_in(path, campaign, config, table, empty_report)
    barriers_at = barriers_of(experiment)
    columns = campaign.batch_size * campaign.tries
    env = experiment.env(columns, None, campaign.period, CHECK_BETWEEN, experiment.filter_compiled)
    yield report
    while report["draws"] < draws:
        batch_seed = np.random.SeedSequence((campaign.seed, report["batches"])).generate_state(1)[0]
        of_states, of_controls, of_plants = spawned(int(batch_seed), 3)
        with as_input_error(blamed(config), RuntimeError):
            near = near_limits(campaign.batch_size, of_states, safety_filter, barriers_at, experiment.device)
        desired = controls(near.state, safety_filter, torch.Generator().manual_seed(of_controls))
        plants = torch.Generator().manual_seed(of_plants)
        number = torch.rand(campaign.batch_size, generator=plants, dtype=torch.float64).to(near.state)
        add(report, near, tried(env, near.state, desired, number), number)
        if path is not None:
            write_json(path, report)
        yield report


def search(campaign: Boundary, draws: int, config: Config, path: Path | None) -> dict[str, Any]:
    """Makes all draws, with a progress bar; returns the report.

    Args:
        config: with the filter on; path: see `run`.
    """
    period = campaign.period
    check_clocks(config, period, CHECK_BETWEEN, period, f"boundary, checked every {CHECK_BETWEEN:g} s")
    check_is_checked(config)
    experiment = Experiment(config, BATCH * TRIES, seconds=-(-draws // BATCH) * CALLS * period)
    reports = run(campaign, draws, experiment, path)
    report = next(reports)  # raises InputError before the bar appears
    if report["draws"] >= draws:
        print(f"{path}: holds {report['draws']:,} draws already", file=sys.stderr)
    with bar(draws, "draws", initial=report["draws"]) as shown:
        for report in reports:
            shown.set_postfix_str(f"{report['violating_draws']['any']:,} violating", refresh=False)
            shown.update(min(report["draws"], draws) - shown.n)
    return report
