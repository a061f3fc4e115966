"""What the tables and sentences are made from, and how a page writes it."""

import functools
import json
from collections.abc import Sequence
from typing import Any

from study.errors import MALFORMED, refusing
from study.files import ROOT
from study.paper import PAPER_METRICS, Results, measured

REFERENCE = ROOT / "runs/reference"
Row = Sequence[str]  # a table's cells
POLICIES = ("random", "adversarial")  # of the campaigns, in the order of the tables' columns
LABELS = {
    "no_rta": "without RTA",
    "rta": "with RTA",
    "rta_5s": "with RTA at 5 s",
    "rta_10s": "with RTA at 10 s",
    "robust": "robust",
}  # what the pages call the study's arms


@functools.cache
def read(path: str) -> Any:
    """A .json or .jsonl file of runs/reference; of the latter a list of its lines."""
    with refusing(f"runs/reference/{path}: cannot read it", OSError, *MALFORMED):
        text = (REFERENCE / path).read_text(encoding="utf-8")
        return [json.loads(line) for line in text.splitlines()] if path.endswith("l") else json.loads(text)


def report(name: str) -> Any:
    """A file that `report` wrote about the study."""
    return read(f"study/report/{name}.json")


def campaign(name: str) -> Any:
    """A report of verification."""
    return read(f"verification/{name}.json")


def arms(study: str = "study") -> dict[str, Results]:
    """The results of a study's arms, by their names."""
    return read(f"{study}/results.json")["arms"]


def middle(results: Results, metric: str) -> float:
    """The interquartile mean of a metric."""
    return results["metrics"][metric]["iqm"]


def interval(results: Results, metric: str, digits: int | None = None) -> str:
    """IQM [95 % interval], with as many digits as the paper's unless others are given."""
    return measured(results, metric).text(PAPER_METRICS[metric].digits if digits is None else digits)


def success(results: Results, name: str = "success") -> str:
    """The share of "success" or "clean_success", in %."""
    return f"{100.0 * results['outcomes'][name]:.1f}"


def violation(results: Results, constraint: str = "any") -> str:
    """The mean share of steps that violate a limit, in %."""
    return f"{results['violations_percent'][constraint]:.3f}"


def corrected(results: Results, digits: int = 1) -> str:
    """The share of the filter's calls that it corrects, in %."""
    return f"{results['rta']['intervention_percent']:.{digits}f}" if results["rta"]["period_s"] else "-"


def violating(campaign: Any) -> str:
    """How many of a campaign's episodes violated a limit."""
    return f"{campaign['violating_episodes']['any']:,} of {campaign['episodes']:,}"


def calls(*campaigns: Any) -> int:
    """The filter calls of campaigns."""
    return sum(sum(each["filter_calls"].values()) for each in campaigns)


def slack(*campaigns: Any) -> list[str]:
    """Each campaign's calls in which a row yielded."""
    return [f"{each['filter_calls']['slack']:,}" for each in campaigns]


def share_of_backup(campaign: Any) -> float:
    """The share of a campaign's calls in which the backup decided, in %."""
    return 100.0 * campaign["backup_calls"] / calls(campaign)
