"""The monitor's scalars against a count of every transition, one column at a time."""

from collections import defaultdict
from dataclasses import replace
from statistics import fmean

import pytest
import torch

from inspection.termination import OUTCOMES
from inspection.transition import Transition
from rta.result import FilterResult, Status
from study.training.monitor import EPISODE, Exposure, LatestEpisodes, Monitor

NAMES = ("near", "fast", "hot")
SEEDS, BATCH, CALLS = 2, 6, 3


def correction(generator: torch.Generator) -> FilterResult:
    """Returns a random correction."""
    status = torch.randint(len(Status), (BATCH,), generator=generator)
    slack = torch.randn(len(NAMES), BATCH, generator=generator, dtype=torch.float64).clamp(min=0.0)
    return FilterResult(
        control=torch.zeros(6, BATCH),
        intervened=status > Status.UNTOUCHED,
        verified=status == Status.UNTOUCHED,
        backup=status == Status.HARD,
        active=slack > 1.0,
        slack=slack.masked_fill(torch.rand(BATCH, generator=generator) < 0.7, 0.0),
        status=status,
        h=torch.randn(len(NAMES), BATCH, generator=generator, dtype=torch.float64),
    )


def transition(generator: torch.Generator, ending: bool = True, filtered: bool = True) -> Transition:
    """Returns a random transition."""
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


def count(transitions: list[Transition]) -> dict[str, float]:
    """Returns the scalars, counted by hand, without those of episodes."""
    shares = defaultdict(list)
    for each in transitions:
        for column in range(BATCH):
            for name, term in each.reward_terms.items():
                shares[f"step_reward/{name}"].append(float(term[column]))
            shares["violation_percent/any"].append(100.0 * bool(each.violated[:, column].any()))
            for i, name in enumerate(NAMES):
                shares[f"violation_percent/{name}"].append(100.0 * bool(each.violated[i, column]))
            for call in each.corrections:
                shares["rta/intervention_percent"].append(100.0 * (call.status[column] > Status.UNTOUCHED))
                shares["rta/slack_percent"].append(100.0 * any(call.slack[:, column] > 0.0))
                shares["rta/failures"].append(float(call.status[column] == Status.UNSOLVED))
                violated = bool((call.h[:, column] < 0.0).any())
                shares["rta/filter_step_violation_percent"].append(100.0 * violated)
    counted = {tag: fmean(values) for tag, values in shares.items()}
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


def test_behind_the_filter_only_limits_that_broke_are_named(generator: torch.Generator) -> None:
    kept = replace(
        transition(generator), violated=torch.tensor([[True] * BATCH, [False] * BATCH, [False] * BATCH])
    )
    tags = {tag for tag in watching([kept]).scalars() if tag.startswith("violation_percent/")}
    assert tags == {"violation_percent/any", "violation_percent/near"}


def ending(*columns: int, outcome: str, reward: float) -> Transition:
    """Returns an interaction after which these episodes ended."""
    done = torch.zeros(BATCH, dtype=torch.bool).index_fill(0, torch.tensor(columns, dtype=torch.int64), True)
    return replace(
        transition(torch.Generator().manual_seed(0), filtered=False),
        terminated=done,
        truncated=torch.zeros_like(done),
        outcome=torch.full((BATCH,), OUTCOMES.index(outcome)),
        metrics=torch.full((6, BATCH), reward, dtype=torch.float64),
    )


def test_episodes_are_shown_once_every_slot_has_ended_one_and_then_the_last_of_each() -> None:
    """Four slots succeed at once, again and again; two time out much later: a third of all episodes that began."""
    latest = LatestEpisodes(BATCH, torch.device("cpu"))

    def shown(seed: int | None = None) -> dict[str, float]:
        monitor = Monitor(NAMES, SEEDS, first_seed=5)
        monitor.episodes.append(latest.shown(SEEDS, 5))
        return monitor.episode_means(seed)

    for reward in (1.0, 2.0, 3.0):
        latest(ending(0, 1, 3, 4, outcome="success", reward=reward))
    assert shown() == shown(5) == shown(6) == {}
    latest(ending(2, outcome="timeout", reward=0.0))
    assert shown(5)["episode/success_percent"] == pytest.approx(200 / 3) and shown() == {}
    resumed = LatestEpisodes(BATCH, torch.device("cpu"))
    resumed.load_state_dict(latest.state_dict())
    latest = resumed
    latest(ending(5, outcome="timeout", reward=0.0))
    means = shown()
    assert means.keys() == {f"episode/{name}" for name in (*EPISODE, "count")}
    assert means["episode/success_percent"] == pytest.approx(200 / 3)
    assert means["episode/reward"] == pytest.approx(4 * 3.0 / 6) and means["episode/count"] == 1.0
    assert shown()["episode/count"] == 0.0


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
