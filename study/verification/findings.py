"""A campaign's report: its content, its JSON file and its text."""

import dataclasses
import shlex
from collections.abc import Callable
from pathlib import Path
from textwrap import fill
from typing import Any

from rta.names import CONSTRAINTS
from settings import InputError, override
from study.config import Config, of_today
from study.errors import MALFORMED, as_input_error
from study.files import check_like, read_json
from study.verification.tally import empty_tally
from study.verification.tape import CHECK_EVERY
from study.verified import fingerprint, gains_of, of_hull

WIDTH = 100  # of the text


@dataclasses.dataclass(frozen=True)
class Campaign:
    """Holds what determines a campaign's numbers besides the configuration. Fields missing in a report have defaults.

    Attributes:
        policy: random, adversarial, pressing, lookahead, learned:F or checkpoint:F; weights: digest of the weights in
            F, else empty.
        period: s between filter calls; duration: s per episode; batch_size: starts drawn at once.
        check_every: s between two checks of every constraint.
        starts: "anywhere" in the safe set, or "limits", next to them.
        candidates, horizon: of lookahead, see `study.verification.lookahead`; else 0.
        filter: "python", or "c" for the exported filter.
    """

    policy: str
    period: float
    duration: float
    seed: int
    batch_size: int
    weights: str = ""
    check_every: float = CHECK_EVERY
    candidates: int = 0
    horizon: int = 0
    filter: str = "python"
    starts: str = "anywhere"


def empty_report(campaign: Campaign, config: Config) -> dict[str, Any]:
    """Returns a report without episodes, in the form of `verify --json`.

    `starts_rejected` counts rejected states as in `safe_set`. `fingerprint` is that of the plant and the filter
    (`study.verified`).
    """
    return {
        "campaign": dataclasses.asdict(campaign),
        **empty_tally(),
        "upper_bound_95": 1.0,
        "starts_rejected": 0,
        "fingerprint": fingerprint(config),
        "gains": gains_of(),
        "config": dataclasses.asdict(config),
    }


def report_in(
    path: Path | None,
    campaign: Any,
    config: Config,
    shown: Callable[[dict[str, Any]], str],
    empty: Callable[[Any, Config], dict[str, Any]] = empty_report,
) -> dict[str, Any]:
    """Returns this campaign's report from a file, to continue it, or an empty one; raises InputError for other files.

    The campaign is a dataclass of numbers and strings. A file that `shown` cannot write as text is not a report.

    Older files may lack settings or have RETIRED ones; the returned report has today's settings. Files from before the
    backup law lack `backup_calls`, which are then 0.
    """
    fresh = empty(campaign, config)
    if path is None or not path.is_file() or not path.stat().st_size:
        return fresh
    with as_input_error(f"--json {path}: holds no report to go on with", *MALFORMED):
        report = read_json(path, "report")
        check_like(report, {"campaign": {}, "config": {}})
        if not report["campaign"].keys() <= vars(campaign).keys():
            raise ValueError("it is of another command")
        same = type(campaign)(**report["campaign"]) == campaign
        same = same and of_the_same(report["config"], config, path)
        same = same and report.get("gains", "") == gains_of()
        counted = (each.get("violating_episodes", {}).keys() for each in (report, fresh))
        same = same and len(set(map(frozenset, counted))) == 1  # the same limits
    if not same:
        raise InputError(f"--json {path}: holds another campaign or configuration; name another file")
    with as_input_error(f"--json {path}: holds no report to go on with", *MALFORMED):
        check_like(report, fresh | {"campaign": {}, "config": {}}, ("backup_calls", "fingerprint", "gains"))
        report.setdefault("backup_calls", 0)
        shown(report)
    kept = {name: report[name] for name in fresh if name in report}
    return kept | {name: fresh[name] for name in ("campaign", "fingerprint", "config")}


def of_the_same(before: dict[str, Any], config: Config, path: Path) -> bool:
    """Tells whether the tables of a file describe the same plant and filter; their other settings concern training."""
    held = override(Config(), of_today(before), str(path))
    # any solver has the same answers
    held = dataclasses.replace(held, rta=dataclasses.replace(held.rta, qp_solver=config.rta.qp_solver))
    parts = "inspection", "rta", "plant", "uncertainty"
    same = all(getattr(held, part) == getattr(config, part) for part in parts)
    return same and of_hull(held.chief) == of_hull(config.chief)


def table(report: dict[str, Any]) -> str:
    """Returns a report as text, at most WIDTH columns wide."""
    steps, episodes = report["violating_steps"], report["violating_episodes"]
    calls = report["filter_calls"]
    total = sum(calls.values())
    corrected = 100.0 * (total - calls["untouched"]) / max(total, 1)
    lines = [
        f"{'constraint':20s} {'violating checks':>16s} {'episodes':>9s} {'worst value':>13s}",
        *(
            f"{name:20s} {steps[name]:16,d} {episodes[name]:9,d} {report['worst_value'][name]:13.5g}"
            for name in CONSTRAINTS
        ),
        f"{'any of them':20s} {steps['any']:16,d} {episodes['any']:9,d}",
        f"{report['episodes']:,} episodes, {report['steps']:,} checks; violation probability per episode below "
        f"{report['upper_bound_95']:.2e} (95 %)",
        f"{total:,} filter calls, {corrected:.1f} % corrected, {calls['slack']:,} with slack, "
        f"{report['unsolved']:,} unsolved, {report['backup_calls']:,} by the backup; controls outside their bounds in "
        f"{report['controls_outside_bounds']:,} episodes",
        f"of all starts drawn for these batches the filter refused {report['starts_rejected']:,} that keep "
        "every limit",
    ]
    return "\n".join(fill(line, WIDTH, subsequent_indent=" " * 11) for line in lines)


def what_next(report: dict[str, Any], path: Path | None) -> str:
    """Returns where the report and its worst episodes are, and how to fly one of them again."""
    if path is None:
        return (
            "Nothing was saved: --json F saves the report, and the worst episode of every constraint violated"
        )
    lines = [f"Written to {path}; a larger --episodes goes on from there"]
    examples = [name for name in CONSTRAINTS if Path(f"{path}.{name}.npz").is_file()]
    examples.sort(key=lambda name: not report["violating_episodes"][name])
    if examples:
        lines.append(
            f"The worst episodes, first those with violations: {path}.CONSTRAINT.npz of {', '.join(examples)}"
        )
        lines.append(f"Fly one again: python main.py refly {shlex.quote(f'{path}.{examples[0]}.npz')}")
    return "\n".join(lines)
