"""What single calls next to the limits did: counted by limit and pair, the worst cases kept, and shown as text."""

import dataclasses
from textwrap import fill
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rta.constraints.names import CONSTRAINTS
from study.boundary.limits import NearLimits
from study.config import Config
from study.flight.fly import ROUNDING
from study.flight.summary import upper_bound
from study.verification.findings import WIDTH
from study.verified import fingerprint

SHOWN = 5  # worst cases that a report holds, per constraint


class Tried(NamedTuple):
    """What came of a batch of draws; last axis the draws.

    Attributes:
        smallest: (13, B) h within the period, under the worst of the controls for each.
        last: (13, B) h at its end, under the worst of the controls for that.
        desired, applied: (13, 6, B) those controls, and what the filter made of them.
        before, after: (13, B) largest slack of the rows at the state, and at the end of the period.
        unsolved: filter calls, of `calls`; backup: those in which the backup law decided.
    """

    smallest: Tensor
    last: Tensor
    desired: Tensor
    applied: Tensor
    before: Tensor
    after: Tensor
    unsolved: int
    backup: int
    calls: int


def empty_report(campaign: Any, config: Config) -> dict[str, Any]:
    """A report of no draws, the form of `boundary --json`.

    `violating_draws` are those with h < 0 within the period, `violating_at_end` those with h < 0 at its end; in
    `lost_draws` a row has slack after it and none had before, in `yielding_draws` one had before. `limits` and `pairs`
    have the counts by what the states were drawn next to, `within_margins` those next to margins and beyond none.
    `worst` and `lost` have the SHOWN cases per constraint of least h and of most slack.
    """

    def counts() -> dict[str, int]:
        return dict.fromkeys((*CONSTRAINTS, "any"), 0)

    return {
        "campaign": dataclasses.asdict(campaign),
        "batches": 0,
        "draws": 0,
        "upper_bound_95": 1.0,
        "violating_draws": counts(),
        "violating_at_end": counts(),
        "lost_draws": counts(),
        "yielding_draws": counts(),
        "worst_value": dict.fromkeys(CONSTRAINTS),
        "filter_calls": 0,
        "unsolved": 0,
        "backup_calls": 0,
        "limits": {},
        "pairs": {},
        "within_margins": {},
        "worst": {name: [] for name in CONSTRAINTS},
        "lost": {name: [] for name in CONSTRAINTS},
        "fingerprint": fingerprint(config),
        "config": dataclasses.asdict(config),
    }


def held_by_the_plant(config: Config) -> list[bool]:
    """Of each constraint, whether the plant holds it by itself: the rates', where it saturates them."""
    saturates = config.inspection.saturate_rates and config.plant.saturate_rates
    return [saturates and name.startswith("angular_velocity") for name in CONSTRAINTS]


def add(
    report: dict[str, Any], near: NearLimits, result: Tried, number: Tensor, by_plant: list[bool]
) -> None:
    """Adds a batch of draws to a report, in place."""
    needed = ~torch.tensor(by_plant, device=number.device)[:, None]
    violating = result.smallest < 0.0
    yielding = (result.before > ROUNDING) & needed
    lost = (result.after > ROUNDING) & needed & ~yielding.any(0)
    report["batches"] += 1
    report["draws"] += number.numel()
    report["filter_calls"] += result.calls
    report["unsolved"] += result.unsolved
    report["backup_calls"] += result.backup
    counted = {
        "violating_draws": violating,
        "violating_at_end": result.last < 0.0,
        "lost_draws": lost,
        "yielding_draws": yielding,
    }
    for kind, flags in counted.items():
        counts = report[kind]
        for name, own in zip((*CONSTRAINTS, "any"), torch.cat((flags, flags.any(0)[None])), strict=True):
            counts[name] += int(own.sum())
    report["upper_bound_95"] = upper_bound(report["violating_draws"]["any"], report["draws"])
    add_by_limit(report, near, violating.any(0), lost.any(0))
    for i, name in enumerate(CONSTRAINTS):
        least = [result.smallest[i].min().item(), report["worst_value"][name]]
        report["worst_value"][name] = min(value for value in least if value is not None)
        for kind, value in (
            ("worst", result.smallest[i]),
            ("lost", -result.after[i].where(lost[i], -torch.inf)),
        ):
            add_cases(report[kind][name], value, i, near, result, number, report["batches"] - 1)


def add_by_limit(report: dict[str, Any], near: NearLimits, violating: Tensor, lost: Tensor) -> None:
    """Counts draws by the limits that they are next to, in place."""

    def add_to(table: dict[str, Any], name: str, own: Tensor) -> None:
        counts = table.setdefault(name, {"draws": 0, "violating": 0, "lost": 0})
        for kind, flags in (("draws", own), ("violating", violating & own), ("lost", lost & own)):
            counts[kind] += int(flags.sum())
        counts["upper_bound_95"] = (
            upper_bound(counts["violating"], counts["draws"]) if counts["draws"] else 1.0
        )

    code = near.limits[0] * len(CONSTRAINTS) + near.limits[1]
    for each in code.unique().tolist():
        first, second = CONSTRAINTS[each // len(CONSTRAINTS)], CONSTRAINTS[each % len(CONSTRAINTS)]
        if first == second:
            add_to(report["limits"], first, code == each)
        else:
            add_to(report["pairs"], f"{first} + {second}", code == each)
        for name in dict.fromkeys((first, second)):
            add_to(report["within_margins"], name, near.within & (code == each))
    add_to(report["within_margins"], "any", near.within)


def add_cases(
    cases: list[dict[str, Any]],
    value: Tensor,
    constraint: int,
    near: NearLimits,
    result: Tried,
    number: Tensor,
    batch: int,
) -> None:
    """Keeps the SHOWN cases of least value (B,), in place; infinity is none."""
    least, columns = value.topk(min(SHOWN, value.numel()), largest=False)
    for one, k in zip(least.tolist(), columns.tolist(), strict=True):
        if one < torch.inf:
            cases.append(
                {
                    "value": one,
                    "limits": [CONSTRAINTS[i] for i in near.limits[:, k].unique().tolist()],
                    "within_margins": bool(near.within[k]),
                    "batch": batch,
                    "column": k,
                    "plant": number[k].item(),
                    "state": near.state[:, k].tolist(),
                    "control_desired": result.desired[constraint, :, k].tolist(),
                    "control_applied": result.applied[constraint, :, k].tolist(),
                }
            )
    cases.sort(key=lambda case: case["value"])
    del cases[SHOWN:]


def table(report: dict[str, Any]) -> str:
    """A report as text, at most WIDTH columns wide."""
    pairs = {
        kind: sum(own[kind] for own in report["pairs"].values()) for kind in ("draws", "violating", "lost")
    }
    pairs["upper_bound_95"] = upper_bound(pairs["violating"], pairs["draws"]) if pairs["draws"] else 1.0
    parts = report["limits"] | {"two of them": pairs, "margins, none beyond": report["within_margins"]["any"]}
    none = {"draws": 0, "violating": 0, "lost": 0, "upper_bound_95": 1.0}
    lines = [
        f"{'next to':20s} {'draws':>13s} {'violating':>11s} {'lost':>9s} {'below (95 %)':>13s}  {'smallest h':>12s}"
    ]
    for name in (*CONSTRAINTS, "two of them", "margins, none beyond"):
        own, value = parts.get(name, none), report["worst_value"].get(name)
        lines.append(
            f"{name:20s} {own['draws']:13,d} {own['violating']:11,d} {own['lost']:9,d} {own['upper_bound_95']:13.2e}"
            + ("" if value is None else f"  {value:12.5g}")
        )
    lines += [
        f"{report['draws']:,} draws next to {len(report['limits'])} limits and {len(report['pairs'])} pairs; violation "
        f"probability per draw below {report['upper_bound_95']:.2e} (95 %)",
        "violated: " + described(report["violating_draws"]),
        "violated at the end of the period: " + described(report["violating_at_end"]),
        "lost, all rows held before the call and not after it: " + described(report["lost_draws"]),
        f"{report['yielding_draws']['any']:,} draws in which a row had slack before; {report['filter_calls']:,} "
        f"filter calls, {report['unsolved']:,} unsolved, {report['backup_calls']:,} by the backup",
    ]
    return "\n".join(fill(line, WIDTH, subsequent_indent=" " * 11) for line in lines)


def described(counts: dict[str, int]) -> str:
    """What is not zero of counts by constraint."""
    return (
        ", ".join(f"{name} {count:,}" for name, count in counts.items() if count and name != "any") or "none"
    )
