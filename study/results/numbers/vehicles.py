"""Other spacecraft and other chiefs: their campaigns and agents."""

from collections.abc import Iterator

from study.paper import Results
from study.results.numbers.evidence import (
    POLICIES,
    Row,
    arms,
    calls,
    campaign,
    corrected,
    middle,
    read,
    success,
    violating,
    violation,
)

VEHICLES = {"3u": "3U, 4 kg", "12u": "12U, 20 kg", "espa": "ESPA-class, 180 kg"}
CHIEFS = {"box": "box between panels, fixed", "satellite": "satellite, tumbling"}


def campaigns() -> Iterator[Row]:
    """The filter on each vehicle."""
    for name, label in VEHICLES.items():
        both = [campaign(f"{name}_{policy}") for policy in POLICIES]
        unsolved = sum(each["unsolved"] for each in both)
        slack = sum(each["filter_calls"]["slack"] for each in both)
        share = f"{unsolved} of {calls(*both) / 1e6:.0f} million"
        yield label, *map(violating, both), share, f"{slack:,}"


def agent(label: str, results: Results) -> Row:
    """An agent behind the filter."""
    reward, time, fuel = (middle(results, name) for name in ("reward", "episode_length_s", "delta_v_m_s"))
    return (
        label,
        f"{success(results)} %",
        f"{success(results, 'clean_success')} %",
        f"{reward:.3f}",
        f"{time:,.0f}",
        f"{fuel:.2f}",
        f"{corrected(results, 2)} %",
        f"{violation(results)} %",
    )


def agents() -> Iterator[Row]:
    """The agents of each vehicle."""
    for name, label in VEHICLES.items():
        yield agent(label, arms(f"vehicles/{name}")["rta"])


def agents_of_chiefs() -> Iterator[Row]:
    """The agents that inspect each chief."""
    for name, label in CHIEFS.items():
        yield agent(label, arms(f"chiefs/{name}")["rta"])


def beside_the_hull() -> Iterator[Row]:
    """The filter that keeps clear of the box's hull."""
    for policy in POLICIES:
        each = campaign(f"hull_{policy}")
        unsolved = f"{each['unsolved']} of {calls(each) / 1e6:.0f} million"
        nearest = f"{each['worst_value']['passive_safety']:.2f} m"
        yield policy, violating(each), unsolved, f"{each['filter_calls']['slack']:,}", nearest


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    without = read("chiefs/satellite/report/sunlight.json")["without"]
    yield "docs/guides/your_own_chief.md", f"satellite's {without} cases of 100 without success"
