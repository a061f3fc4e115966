"""What the campaigns against the filter found."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from experiments.break_points import EFFECTS, said
from rta.constraints.names import UNITS
from study.paper import PAPER_VIOLATIONS
from study.results.numbers.evidence import (
    LABELS,
    POLICIES,
    Row,
    calls,
    campaign,
    corrected,
    interval,
    middle,
    read,
    report,
    share_of_backup,
    slack,
    success,
    violating,
    violation,
)

README, SAFETY, TESTS = "README.md", "docs/results/safety.md", "docs/results/safety_tests.md"
LIMITS, IN_C = "docs/results/safety_limits.md", "docs/guides/filter_in_c.md"
ADVERSARIES = (
    "lookahead",
    "learned_motion",
    "learned_passive",
    "learned_attitude",
)  # of which U1 has reports, too
WRITTEN = {limit: unit.replace("^2", "²").replace("deg ", "°") for limit, unit in UNITS.items()}  # units of h


def both(name: str = "{}") -> list[Any]:
    """The reports of random and of adversarial controls; `name` has {} for these."""
    return [campaign(name.format(policy)) for policy in POLICIES]


def flown() -> Iterator[Row]:
    """Every limit under random and adversarial controls."""
    for limit, unit in WRITTEN.items():
        cells = []
        for each in both():
            worst, when = each["worst_value"][limit], each["worst_case"][limit]["time_s"]
            cells += [f"{each['violating_episodes'][limit]:,}", f"{worst:.3g} at {when:g} s"]
        yield f"{PAPER_VIOLATIONS[limit].label} ({unit})", *cells
    random, adversarial = map(violating, both())
    yield "any", random, "", adversarial, ""


def yielded() -> Iterator[Row]:
    """Calls in which rows yielded, because they conflicted."""

    def calls_of(each: Any, of_rates: bool) -> int:
        """Calls in which a body rate yielded, or another limit."""
        return sum(
            group["calls"]
            for names, group in each["slack_together"].items()
            if any(name.startswith("angular_velocity") == of_rates for name in names.split(" + "))
        )

    yield "any", *slack(*both())
    for label, of_rates in (("body rates", True), ("the other ten limits", False)):
        yield label, *(f"{calls_of(each, of_rates):,}" for each in both())


def came_of(campaign: Any) -> Row:
    """Violations, the bound on their probability, and the smallest h of the zone and of passive safety."""
    worst = campaign["worst_value"]
    return (
        f"{campaign['violating_episodes']['any']:,}",
        f"{campaign['upper_bound_95']:.2g}",
        f"{worst['keep_in_zone']:.3f}, {worst['passive_safety']:.2f}",
    )


def adversaries() -> Iterator[Row]:
    """What adversaries that look ahead or learn reached."""
    learned = {
        "motion": "learned: motion",
        "passive": "learned: passive safety",
        "attitude": "learned: attitude, temperature, energy",
    }
    tried = {
        "adversarial_between": ("the model", "adversarial"),
        "lookahead": ("the model", "lookahead"),
        **{f"learned_{name}": ("the model", label) for name, label in learned.items()},
        "u1_lookahead": ("U1", "lookahead, 8 for two calls"),
        **{f"u1_learned_{name}": ("U1", label) for name, label in learned.items()},
    }
    for name, label in tried.items():
        each = campaign(name)
        yield *label, f"{each['episodes']:,}", f"{each['campaign']['check_every']:g}", *came_of(each)


def break_points() -> Iterator[Row]:
    """The sizes at which each effect breaks a limit."""
    found = campaign("break_points")
    for effect in dict.fromkeys(world["effect"] for world in found["worlds"]):
        yield effect, EFFECTS[effect].unit or "share", *(said(found, effect, told) for told in (False, True))


def periods_of_agents() -> Iterator[Row]:
    """The study's agents behind the filter at each period."""
    for period, results in report("frequency").items():
        metrics = (interval(results, each) for each in ("delta_v_m_s", "torque_n_m", "reward"))
        yield period, violation(results), corrected(results), *metrics


def periods_of_campaigns() -> Iterator[Row]:
    """Random and adversarial controls at each period."""
    for period in report("frequency"):
        found = both() if period == "1" else [read(f"frequency/{each}_{period}s.json") for each in POLICIES]
        yield period, *map(violating, found)


def told_worlds() -> Iterator[Row]:
    """Worlds with all errors at once, behind a filter that is given their bounds."""
    worlds = {
        "u1_random": ("U1", "random"),
        "u1_adversarial": ("U1", "adversarial"),
        "u1_worst_random": ("U1, the worst errors at every call", "random"),
        "u1_minimum_thrust": ("U1, minimum impulse", "adversarial"),
        "u1_thrust_quantum": ("U1, quanta", "adversarial"),
    }
    for name, label in worlds.items():
        each = campaign(name)
        yield *label, f"{each['episodes']:,}, {each['campaign']['duration']:,}", *came_of(each)


def agents_in_u1() -> Iterator[Row]:
    """The study's agents in U1 with U1's bounds, beside the model without any."""
    worlds = report("worlds")
    for arm in ("rta", "robust"):
        flown = worlds["u1"][arm]["robust"], worlds["nominal"][arm]["nominal"]
        apart = np.subtract(*(each["reward_of_seeds"] for each in flown))
        yield (
            LABELS[arm],
            success(flown[0]),
            violation(flown[0]),
            *(f"{middle(each, 'reward'):.4f}" for each in flown),
            f"{apart.min():+.3f} to {apart.max():+.3f}",
            *(f"{middle(each, 'delta_v_m_s'):.2f}" for each in flown),
        )


def barely() -> Iterator[Row]:
    """What the check makes of who asks for anything, from states that are barely starts."""
    flown = (("the paper's", "", 1), ("the paper's", "", 5), ("the paper's", "", 10), ("ESPA", "espa_", 10))
    for vehicle, prefix, period in flown:
        for demand in ("opposite", "full", "lookahead"):
            found = read(f"measure/{prefix}barely_{demand}_{period}s.json")
            yield (
                f"{vehicle}, {period} s",
                demand,
                f"{found['calls']:,}",
                f"{found['moved_by_check_percent']:.2f}",
                f"{found['unverified_percent']:.3g}",
                f"{found['broken_episodes']} of {found['measured']['episodes']:,}",
            )


def rows_of_a_filter() -> Iterator[Row]:
    """What rows add to the check, by who demands."""
    for demand in ("random", "waypoints", "agent"):
        for kind in ("paper", "sampled", "none"):
            found = read(f"measure/rows_{kind}_{demand}.json")
            yield (
                demand,
                kind,
                f"{found['corrected_percent']:.2f}",
                *(f"{found[f'change_of_{group}']:.4f}" for group in ("thrust", "torque")),
                *(f"{found[f'chatter_of_{group}']:.4f}" for group in ("thrust", "torque")),
                f"{found['moved_by_check_percent']:.2f}",
                f"{1e6 / found['calls_per_s']:.1f}",
            )


def rows_of_agents() -> Iterator[Row]:
    """Agents that were trained behind each kind of rows."""
    for kind, results in read("rows/results.json")["arms"].items():
        means = (results["metrics"][name]["mean"] for name in ("episode_length_s", "delta_v_m_s"))
        yield (
            kind,
            success(results),
            success(results, "clean_success"),
            violation(results),
            corrected(results, 3),
            f"{results['rta']['backup_calls']:,}",
            *(
                f"{middle(results, name):,.{k}f}"
                for name, k in (("reward", 3), ("episode_length_s", 0), ("delta_v_m_s", 2))
            ),
            "{:,.0f}, {:.2f}".format(*means),
        )


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    episodes = sum(each["episodes"] for each in both())
    yield README, f"{episodes:,} episodes, half of them"
    at_random, at_worst, ahead = (  # at 5 and at 10 s
        [read(f"frequency/{policy}_{period}s.json") for period in (5, 10)]
        for policy in (*POLICIES, "lookahead")
    )
    flown = [sum(each["episodes"] for each in found) for found in ([*at_random, *at_worst], ahead)]
    broken = sum(each["violating_episodes"]["any"] for each in (*at_random, *at_worst, *ahead))
    yield (
        README,
        f"In {flown[0]:,} random and adversarial episodes and {flown[1]:,} against an adversary that",
    )
    yield README, f"looks ahead, {broken} violated a limit"
    broken_ahead = sum(each["violating_episodes"]["any"] for each in ahead)
    yield SAFETY, f"behind it, {broken_ahead} of {flown[1]:,} such episodes"
    yield README, f"{calls(*both()) / 1e6:.0f} million calls: no violation"
    bound = max(each["upper_bound_95"] for each in both())
    yield README, f"is below {math.ceil(1e4 * bound)} in 10,000 (95 % confidence)"
    of_1 = list(map(share_of_backup, both()))
    yield TESTS, f"The backup decided {of_1[0]:.2f} % of the random and {of_1[1]:.2f} % of the adversarial"
    yield SAFETY, f"The backup decided {max(of_1):.1f} % of the calls at 1 s"
    yield README, f"kept every limit in {sum(each['episodes'] for each in both('u1_{}')):,} episodes"

    yield TESTS, f"violates anything is below {bound:.3g} under either kind"
    yield TESTS, f"None of {calls(*both()):,} filter calls was unsolved"
    yield TESTS, f"{both()[0]['starts_rejected_by_margin']} of the safe set's starts were left out"
    yield TESTS, f"{both()[0]['starts_beyond_braking']['episodes']} starts were flown but"
    yield TESTS, f"In these {episodes:,} episodes a row yielded"
    yield TESTS, f"in each of the {len(campaign('break_points')['worlds'])} worlds"

    looks, *learns = (share_of_backup(campaign(f"u1_{name}")) for name in ADVERSARIES)
    yield TESTS, f"in U1 {looks:.0f} % of what `lookahead` asked"
    yield TESTS, f"and {learns[0]:.1f}, {learns[1]:.1f} and {learns[2]:.1f} %"
    between, ahead_at_1, *learned = (campaign(name) for name in ("adversarial_between", *ADVERSARIES))
    yield TESTS, f"the backup decided {between['backup_calls']:,} of the {calls(between):,} calls"
    yield TESTS, f"{share_of_backup(ahead_at_1):.2f} % of those of `lookahead`"
    counts = [f"{each['backup_calls']:,}" for each in learned]
    yield TESTS, f"and {counts[0]}, {counts[1]} and {counts[2]} of the {calls(learned[0]):,} of each"
    nearest = ahead_at_1["worst_value"]["passive_safety"]
    yield TESTS, f"{nearest:.3f} m, to the limit of passive safety: nearer in {calls(ahead_at_1):,} calls"

    single = campaign("boundary")
    yield TESTS, f"{single['violating_draws']['any']:,} of {single['draws']:,} draws went below zero"
    yield TESTS, f"(below {single['upper_bound_95']:.1e} with 95 % confidence)"
    share = 100.0 * single["backup_calls"] / single["filter_calls"]
    yield TESTS, f"The backup decided {share:.1f} % of the filter's calls"
    slower = [read(f"frequency/boundary_{period}s.json") for period in (5, 10)]
    draws = f"{slower[0]['draws']:,} at 5 s and {slower[1]['draws']:,} at 10 s"
    yield TESTS, f"of {draws} {sum(each['violating_draws']['any'] for each in slower)} did"

    told = both("u1_{}")
    random, adversarial = (f"{each['filter_calls']['slack']} of the {calls(each):,}" for each in told)
    yield SAFETY, f"yielded in {random} calls under random and in {adversarial} under"
    random, adversarial = (f"{share_of_backup(each):.0f} %" for each in told)
    yield SAFETY, f"The backup decided {random} of the calls in the first row, {adversarial} in the second"
    at_5, at_10 = (list(map(share_of_backup, found)) for found in zip(at_random, at_worst, strict=True))
    both_at_5 = f"{at_5[0]:.1f} % of the random and {at_5[1]:.1f} % of the adversarial calls at 5 s"
    yield SAFETY, f"{both_at_5}, {at_10[0]:.1f} % and {at_10[1]:.1f} % at 10 s"
    looking = f"{ahead[0]['episodes']:,} at 5 s and {ahead[1]['episodes']:,} at 10 s"
    yield LIMITS, f"of {looking} {sum(each['violating_episodes']['any'] for each in ahead)} violated a limit"
    of_5, of_10 = map(share_of_backup, ahead)
    yield LIMITS, f"the backup decided {of_5:.0f} % and {of_10:.0f} % of the calls"

    in_c = campaign("in_c_random")
    yield IN_C, f"campaign of {in_c['episodes']:,} random episodes at 1 s"
    yield IN_C, f"{in_c['violating_episodes']['any']} violations in {calls(in_c):,} calls"
