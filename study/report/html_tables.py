"""The tables of the report's page: performance beside the paper's, and evaluations row by row, as HTML."""

from collections.abc import Callable

from study.config import ARMS
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS
from study.report import page
from study.report.figures import measured
from study.report.inputs import Inputs, Results

NONE = "-"
PAPER = {
    metric: dict(zip(ARMS, published, strict=True)) for metric, (_, _, *published) in PAPER_METRICS.items()
}
PAPER_PERCENT = {
    name: dict(zip(ARMS, published, strict=True)) for name, (_, *published) in PAPER_VIOLATIONS.items()
}


def percent(value: float) -> str:
    """Three digits, as in the paper's Table 3; what they would hide is not called zero."""
    return "< 0.001" if 0.0 < value < 0.0005 else f"{value:.3f}"


def success(results: Results) -> str:
    """Share of episodes that end with success, in percent."""
    return f"{100.0 * results['outcomes']['success']:.1f}"


def metric(results: Results, name: str) -> str:
    """A metric's interquartile mean with the digits of the paper's table."""
    return f"{measured(results, name)[0]:.{PAPER_METRICS[name][1]}f}"


def with_interval(values: tuple[float, float, float], digits: int) -> str:
    """IQM with its 95 % interval below, as HTML."""
    iqm, low, high = (f"{value:.{digits}f}" for value in values)
    return f"{iqm}<small>[{low}, {high}]</small>"


def difference(ours: tuple[float, float, float], paper: tuple[float, float, float], digits: int) -> str:
    """Ours less the paper's, bold where the two intervals have nothing in common."""
    text = f"{ours[0] - paper[0]:+z.{digits}f}"
    return f"<strong>{text}</strong>" if ours[1] > paper[2] or ours[2] < paper[1] else text


def table_2(inputs: Inputs) -> list[list[str]]:
    """The rows of Table 2, and the success that the paper does not print."""
    rows = []
    for name, (label, digits, *_) in PAPER_METRICS.items():
        row = [label]
        for arm, results in inputs.arms.items():
            ours, paper = measured(results, name), PAPER[name][arm]
            row += [
                with_interval(ours, digits),
                with_interval(paper, digits),
                difference(ours, paper, digits),
            ]
        if inputs.guidance:
            row.append(with_interval(measured(inputs.guidance, name), digits))
        rows.append(row)
    row = ["Success (%)"]
    for results in inputs.arms.values():
        row += [success(results), NONE, NONE]
    return [*rows, row + ([success(inputs.guidance)] if inputs.guidance else [])]


def table_3(inputs: Inputs) -> list[list[str]]:
    """The rows of Table 3."""
    rows = []
    for name, (label, *_) in PAPER_VIOLATIONS.items():
        row = [label]
        for arm, results in inputs.arms.items():
            ours, paper = results["violations_percent"][name], PAPER_PERCENT[name][arm]
            row += [percent(ours), percent(paper), f"{ours - paper:+z.3f}"]
        if inputs.guidance:
            row.append(percent(inputs.guidance["violations_percent"][name]))
        rows.append(row)
    return rows


# columns of the evaluations that the paper's tables do not have: heading and cell
COLUMNS: dict[str, Callable[[Results], str]] = {
    "any violation (% of steps)": lambda results: percent(results["violations_percent"]["any"]),
    "calls corrected (%)": lambda results: (
        NONE if results["rta"]["period_s"] is None else f"{results['rta']['intervention_percent']:.1f}"
    ),
    "delta v (m/s)": lambda results: with_interval(measured(results, "delta_v_m_s"), 3),
    "torque (N m)": lambda results: with_interval(measured(results, "torque_n_m"), 4),
    "reward": lambda results: with_interval(measured(results, "reward"), 4),
    "success (%)": success,
}


def evaluations(caption: str, first: str, rows: dict[str, Results]) -> str:
    """A table with a row per evaluation."""
    return page.table(
        caption,
        [first, *COLUMNS],
        [[label, *(cell(results) for cell in COLUMNS.values())] for label, results in rows.items()],
    )
