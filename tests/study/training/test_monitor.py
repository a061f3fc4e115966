"""The monitor's scalars against a count of every transition, one column at a time."""

from collections import defaultdict
from dataclasses import replace
from statistics import fmean

import pytest
import torch

from inspection.termination import OUTCOMES
from inspection.transition import Transition
from rta.qp.programs import Status
from rta.result import FilterResult
from study.training.monitor import EPISODE, Exposure, Monitor

NAMES = ("near", "fast", "hot")
SEEDS, BATCH, CALLS = 2, 6, 3


def correction(generator: torch.Generator) -> FilterResult:
    """What a filter did at random."""
    status = torch.randint(len(Status), (2, BATCH), generator=generator)
    slack = torch.randn(len(NAMES), BATCH, generator=generator, dtype=torch.float64).clamp(min=0.0)
    return FilterResult(
        control=torch.zeros(6, BATCH),
        intervened=status.amax(0) > Status.UNTOUCHED,
        verified=status.amax(0) == Status.UNTOUCHED,
        backup=status.amax(0) == Status.HARD,
        active=slack > 1.0,
        slack=slack.masked_fill(torch.rand(BATCH, generator=generator) < 0.7, 0.0),
        status=status.amax(0),
        program_status=status,
        h=torch.randn(len(NAMES), BATCH, generator=generator, dtype=torch.float64),
    )


def transition(generator: torch.Generator, ending: bool = True, filtered: bool = True) -> Transition:
    """What the environment did at random."""
    ended, truncated = torch.rand(2, BATCH, generator=generator) < (0.3 if ending else 0.0)
    numbers = torch.randn(9, BATCH, generator=generator, dtype=torch.float64)
    return Transition(
        observation=torch.zeros(BATCH, 26),
        final_observation=torch.zeros(BATCH, 26),
        state=torch.zeros(16, BATCH),
        inspected=torch.zeros(100, BATCH, dtype=torch.bool),
        reward=numbers[0],
        reward_terms={"fuel": numbers[1], "time": numbers[2]},
        terminated=ended,
        truncated=truncated & ~ended,
        violated=numbers[3:6] < 0.0,
        h=numbers[3:6],
        corrections=[correction(generator) for _ in range(CALLS)] if filtered else [],
        applied_controls=[torch.zeros(6, BATCH)] * CALLS,
        limit=torch.ones(6, 1),
        outcome=torch.randint(len(OUTCOMES), (BATCH,), generator=generator),
        metrics=numbers[:6] + 3.0,
        violation_steps=torch.zeros(len(NAMES), BATCH, dtype=torch.int64),
        steps=torch.ones(BATCH, dtype=torch.int64),
    )


@pytest.fixture
def seen(generator: torch.Generator) -> list[Transition]:
    return [transition(generator) for _ in range(5)]


def count(transitions: list[Transition], seed: int | None = None) -> dict[str, float]:
    """The scalars, counted by hand; of one seed only the episodes' charts."""
    episodes, shares = defaultdict(list), defaultdict(list)
    for each in transitions:
        for column in range(BATCH):
            own = seed is None or column // (BATCH // SEEDS) == seed
            if own and (each.terminated[column] or each.truncated[column]):
                for i, name in enumerate(EPISODE[:-1]):
                    episodes[f"episode/{name}"].append(float(each.metrics[i, column]))
                successful = OUTCOMES[each.outcome[column]] == "success"
                episodes["episode/success_percent"].append(100.0 * successful)
            for name, term in each.reward_terms.items():
                shares[f"step_reward/{name}"].append(float(term[column]))
            shares["violation_percent/any"].append(100.0 * bool(each.violated[:, column].any()))
            for i, name in enumerate(NAMES if not each.corrections else ()):
                shares[f"violation_percent/{name}"].append(100.0 * bool(each.violated[i, column]))
            for call in each.corrections:
                shares["rta/intervention_percent"].append(100.0 * (call.status[column] > Status.UNTOUCHED))
                shares["rta/slack_percent"].append(100.0 * any(call.slack[:, column] > 0.0))
                shares["rta/failures"].append(float(call.status[column] == Status.UNSOLVED))
                violated = bool((call.h[:, column] < 0.0).any())
                shares["rta/filter_step_violation_percent"].append(100.0 * violated)
    counted = {tag: fmean(values) for tag, values in episodes.items()}
    if episodes:
        counted["episode/count"] = len(episodes["episode/reward"])
    if seed is None:
        counted |= {tag: fmean(values) for tag, values in shares.items()}
        if "rta/failures" in counted:
            counted["rta/failures"] = sum(shares["rta/failures"])
    return counted


def watching(transitions: list[Transition]) -> Monitor:
    monitor = Monitor(NAMES, SEEDS)
    for each in transitions:
        monitor(each)
    return monitor


def test_missed_calls_are_none_and_violations_are_of_the_true_states(generator: torch.Generator) -> None:
    """Two calls of a step, of which every other spacecraft missed the second one."""
    each = transition(generator)
    whole, half = torch.ones(BATCH, dtype=torch.bool), torch.arange(BATCH) % 2 == 0
    first, second = (correction(generator) for _ in range(2))
    true = torch.randn(2, len(NAMES), BATCH, generator=generator)
    watched = replace(each, corrections=[first, second], truths=[(whole, true[0]), (half, true[1])])
    scalars, calls = watching([watched]).scalars(), BATCH + half.sum().item()
    intervened = first.intervened.sum() + (second.intervened & half).sum()
    assert scalars["rta/intervention_percent"] == pytest.approx(100.0 * intervened.item() / calls)
    unsolved = (first.status == Status.UNSOLVED).sum() + (half & (second.status == Status.UNSOLVED)).sum()
    assert scalars["rta/failures"] == unsolved
    violated = (true[0] < 0.0).any(0).sum() + (half & (true[1] < 0.0).any(0)).sum()
    found = scalars["rta/filter_step_violation_percent"]
    assert found == pytest.approx(100.0 * violated.item() / calls)


def test_scalars_are_those_of_a_count_by_hand(seen: list[Transition]) -> None:
    monitor = watching(seen)
    assert monitor.scalars() == pytest.approx(count(seen), rel=1e-6)
    monitor(seen[0])  # they were forgotten
    assert monitor.scalars() == pytest.approx(count(seen[:1]), rel=1e-6)


def test_without_a_filter_or_an_ended_episode_there_is_less_to_show(generator: torch.Generator) -> None:
    quiet = [transition(generator, ending=False, filtered=False)]
    scalars = watching(quiet).scalars()
    assert scalars == pytest.approx(count(quiet), rel=1e-6)
    assert not any(tag.startswith(("episode/", "rta/")) for tag in scalars)
    assert watching(quiet).episode_means(0) == {}


def test_the_exposure_counts_every_limit_broken_in_training() -> None:
    generator = torch.Generator().manual_seed(7)
    seen = [transition(generator) for _ in range(5)]
    exposure = Exposure(NAMES, BATCH, torch.device("cpu"))
    for each in seen[:2]:
        exposure(each)
    resumed = Exposure(NAMES, BATCH, torch.device("cpu"))
    resumed.load_state_dict(exposure.state_dict())
    for each in seen[2:]:
        resumed(each)
    assert Exposure(NAMES, BATCH, torch.device("cpu")).report(SEEDS) == []
    reports = resumed.report(SEEDS)
    assert len(reports) == SEEDS
    for seed, report in enumerate(reports):
        assert report["interactions"] == len(seen) * BATCH // SEEDS
        columns = range(seed * BATCH // SEEDS, (seed + 1) * BATCH // SEEDS)
        for row, name in enumerate(NAMES):
            h = [step.h[row, column].item() for step in seen for column in columns]
            assert report["violations_percent"][name] == pytest.approx(100 * sum(v < 0 for v in h) / len(h))
            assert report["smallest_h"][name] == min(h)
        any_limit = [bool((step.h[:, column] < 0).any()) for step in seen for column in columns]
        assert report["violations_percent"]["any"] == pytest.approx(100 * fmean(any_limit))
