"""The report's page, self-contained: every table and figure of a study, and links to the files behind them.

The text of the page is in `page.html.j2`, the parts that all pages share are in `study/web`.
"""

import base64
import shlex
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from inspection.world.parameters import PlantParameters
from study.config import GUIDE
from study.errors import as_input_error
from study.files import write_text
from study.flight.figures import Episode, effort
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate, Results, measured
from study.report.figures import ARM_LABELS, label
from study.report.inputs import Inputs
from study.report.tables import of_seeds, over_seeds, throughput
from study.web import replay
from study.web.template import render

REPLAYED_ROWS = 400  # of an episode, about one per action; three.js is most of the page
MEDIA_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
PAPER = PAPER_METRICS | PAPER_VIOLATIONS


def write(inputs: Inputs) -> None:
    """Writes `report.html`, whose figures exist already, and the replay of the arms' episodes that it links to.

    Raises:
        InputError: the pages cannot be written.
    """
    if inputs.episodes:
        episodes = [str(inputs.directory / f"episode_{arm}.npz") for arm in inputs.episodes]
        replay.write(episodes, inputs.directory / "replay.html", REPLAYED_ROWS, report="../report.html")
    with as_input_error(f"--study {inputs.study}: cannot write its report", OSError):
        write_text(inputs.study / "report.html", document(inputs))


def document(inputs: Inputs) -> str:
    """Returns the whole page."""

    def image(name: str) -> str:
        """Returns a figure as a data URL, which makes it part of the page."""
        path = inputs.directory / name
        return f"data:{MEDIA_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"

    def files(patterns: Sequence[str]) -> list[str]:
        """Returns the study's files that match, as paths relative to the study."""
        found = [path for pattern in patterns for path in sorted(inputs.study.glob(pattern))]
        return [path.relative_to(inputs.study).as_posix() for path in found]

    return render(
        "report/page.html.j2",
        filters={"fixed": fixed, "percent": percent, "plain": plain},
        inputs=inputs,
        columns=inputs.columns,
        guidance=inputs.front[GUIDE],
        flyers={f"agents, {label(arm)}": flown for arm, flown in inputs.cross.items()} | inputs.baselines,
        period=f"{inputs.config.rta.period:g}",
        GUIDE=GUIDE,
        study=shlex.quote(inputs.study.as_posix()),
        label=label,
        labels=ARM_LABELS,
        metrics=PAPER_METRICS,
        violations=PAPER_VIOLATIONS,
        paper=PAPER,
        measured=measured,
        shown=shown,
        difference=difference,
        throughput=throughput(inputs.arms, inputs.provenance),
        interp=np.interp,
        model=asdict(PlantParameters()),
        of_seeds=of_seeds,
        over_seeds=over_seeds,
        effort=effort,
        violated=violated,
        image=image,
        files=files,
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


def shown(results: Results, name: str) -> str:
    """Returns an evaluation's number for a metric, a constraint or "success", with the digits of the paper's tables."""
    return plain(measured(results, name), 1 if name == "success" else PAPER[name].digits)


def difference(ours: Estimate, paper: Estimate, digits: int) -> tuple[str, bool]:
    """Returns our number minus the paper's, and whether both have intervals and these do not overlap."""
    apart = False
    if ours.interval and paper.interval:
        apart = ours.interval[0] > paper.interval[1] or ours.interval[1] < paper.interval[0]
    return f"{ours.value - paper.value:+z.{digits}f}", apart


def violated(episode: Episode) -> dict[str, str]:
    """Returns the constraints that an episode violates in some row, with the share of violating rows in percent."""
    shares = {
        name[2:]: 100.0 * float(np.mean(h < 0.0)) for name, h in episode.items() if name.startswith("h_")
    }
    return {PAPER_VIOLATIONS[name].label: percent(share) for name, share in shares.items() if share}
