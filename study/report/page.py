"""The report's page, self-contained: every table and figure of a study, and links to the files behind them.

The text of the page is in `page.html.j2`, the parts that all pages share are in `study/web`.
"""

import base64
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from inspection.world.parameters import PlantParameters
from study.config import GUIDE
from study.errors import as_input_error
from study.files import write_text
from study.flight.figures import Episode, effort
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate, Results, measured
from study.report.figures import ARM_LABELS, TRAINING, label
from study.report.inputs import Inputs
from study.report.tables import of_seeds, over_seeds, throughput
from study.web import replay
from study.web.template import render

REPLAYED_ROWS = 400  # of an episode, about one per action; three.js is most of the page
MEDIA_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
PAPER = PAPER_METRICS | PAPER_VIOLATIONS
DIGITS = {name: paper.digits for name, paper in PAPER.items()} | {"success": 1}


def write(inputs: Inputs) -> None:
    """Writes `report.html`, whose figures exist already, and the replay of the arms' episodes that it links to.

    Raises:
        InputError: the pages cannot be written.
    """
    if inputs.arms:
        episodes = [str(inputs.directory / f"episode_{arm}.npz") for arm in inputs.arms]
        replay.write(episodes, inputs.directory / "replay.html", REPLAYED_ROWS, report="../report.html")
    with as_input_error(f"--study {inputs.study}: cannot write its report", OSError):
        write_text(inputs.study / "report.html", document(inputs))


def document(inputs: Inputs) -> str:
    """Returns the whole page."""
    return render(
        "report/page.html.j2",
        filters=FILTERS,
        inputs=inputs,
        columns=inputs.columns,
        flyers={f"agents, {label(arm)}": flown for arm, flown in inputs.cross.items()} | inputs.baselines,
        period=f"{inputs.config.rta.period:g}",
        GUIDE=GUIDE,
        study=shlex.quote(inputs.study.as_posix()),
        label=label,
        labels=ARM_LABELS,
        metrics=PAPER_METRICS,
        violations=PAPER_VIOLATIONS,
        curves=TRAINING,
        measured=measured,
        shown=shown,
        published=published,
        difference=difference,
        throughput=throughput(inputs.everyone, inputs.provenance),
        weight_at=weight_at,
        worst_seed=worst_seed,
        other_world=other_world,
        over_seeds=over_seeds,
        effort=effort,
        violated=violated,
        image=partial(embedded, inputs.directory),
        files=partial(matching, inputs.study),
    )


def fixed(value: float, digits: int) -> str:
    """Returns a number with `digits` digits after the decimal point."""
    return f"{value:.{digits}f}"


def percent(value: float, digits: int = 3) -> str:
    """Returns a percentage with three digits, as the paper's Table 3; "< 0.001" if a positive one would look like 0."""
    text = fixed(value, digits)
    return f"< {fixed(10**-digits, digits)}" if value > 0.0 and float(text) == 0.0 else text


def plain(number: Estimate, digits: int) -> str:
    """Returns a metric without its interval, or a percentage."""
    return (fixed if number.interval else percent)(number.value, digits)


# filters of the template
FILTERS: dict[str, Callable[..., str]] = {"fixed": fixed, "percent": percent, "plain": plain}


def shown(results: Results, name: str) -> str:
    """Returns an evaluation's number for a metric, a constraint or "success", with the digits of the paper's tables."""
    return plain(measured(results, name), DIGITS[name])


def published(arm: str, name: str) -> str:
    """Returns the paper's number for a metric or a constraint and an arm."""
    return plain(PAPER[name].by_arm[arm], DIGITS[name])


def difference(ours: Estimate, paper: Estimate, digits: int) -> tuple[str, bool]:
    """Returns our number minus the paper's, and whether both have intervals and these do not overlap."""
    apart = False
    if ours.interval and paper.interval:
        apart = ours.interval[0] > paper.interval[1] or ours.interval[1] < paper.interval[0]
    return f"{ours.value - paper.value:+z.{digits}f}", apart


def worst_seed(results: Results) -> float:
    """Returns the lowest reward (IQM) of an arm's seeds."""
    return min(of_seeds(results, "reward"))


def other_world(results: Results) -> bool:
    """Tells whether an arm flew in a plant that is not the model."""
    return results["config"]["plant"] != asdict(PlantParameters())


def weight_at(curve: dict[str, list[float]], time: float) -> float:
    """Returns the inspected weight after `time` s from a curve of `progress`."""
    return float(np.interp(time, curve["time_s"], curve["weight"]))


def violated(episode: Episode) -> dict[str, str]:
    """Returns the constraints that an episode violates in some row, with the share of violating rows in percent."""
    shares = {
        name[2:]: 100.0 * float(np.mean(h < 0.0)) for name, h in episode.items() if name.startswith("h_")
    }
    return {PAPER_VIOLATIONS[name].label: percent(share) for name, share in shares.items() if share}


def embedded(directory: Path, name: str) -> str:
    """Returns an image as a data URL, which makes it part of the page."""
    path = directory / name
    return f"data:{MEDIA_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def matching(study: Path, patterns: Sequence[str]) -> list[str]:
    """Returns files below a study that match the patterns, as paths relative to the study."""
    return [
        path.relative_to(study).as_posix() for pattern in patterns for path in sorted(study.glob(pattern))
    ]
