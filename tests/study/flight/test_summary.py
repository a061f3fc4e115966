"""Interquartile mean and its interval against hand-computed cases, the bound against its definition."""

import itertools

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import binom

from study.flight.summary import (
    iqm,
    stratified_bootstrap,
    summary,
    summary_of_runs,
    upper_bound,
)


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    values = np.random.default_rng(0).permutation(np.arange(40.0) ** 2)
    assert iqm(values) == pytest.approx(np.mean(np.arange(10.0, 30.0) ** 2))


def test_summary_of_a_constant_has_an_interval_of_no_width() -> None:
    constant = {"iqm": 2.5, "mean": 2.5, "ci95": [2.5, 2.5], "p5": 2.5, "p95": 2.5, "max": 2.5}
    assert summary(np.full(7, 2.5)) == summary_of_runs(np.full((1, 7), 2.5)) == constant


def test_interval_agrees_with_a_plain_bootstrap_loop() -> None:
    values = np.random.default_rng(3).normal(10.0, 2.0, 100)
    rng = np.random.default_rng(4)
    means = [np.sort(rng.choice(values, 100))[25:75].mean() for _ in range(4000)]
    expected = np.percentile(means, [2.5, 97.5])
    assert summary(values)["ci95"] == pytest.approx(expected, abs=0.05)


def test_stratified_bootstrap_draws_every_resample_equally_often() -> None:
    scores = np.array(
        [[0.0, 3.0], [1.0, 8.0]]
    )  # 2 runs x 2 tasks: 16 resamples, whose IQM is that of 4 scores
    exact: dict[float, float] = {}
    for a, b, c, d in itertools.product((0.0, 1.0), (0.0, 1.0), (3.0, 8.0), (3.0, 8.0)):
        middle = sum(sorted((a, b, c, d))[1:3]) / 2
        exact[middle] = exact.get(middle, 0.0) + 1 / 16
    drawn = stratified_bootstrap(scores, np.random.default_rng(0))
    assert drawn.shape == (50_000,)
    values, counts = np.unique(drawn, return_counts=True)
    assert dict(zip(values, counts / len(drawn), strict=True)) == pytest.approx(exact, abs=0.01)


def test_stratified_interval_agrees_with_a_plain_loop() -> None:
    rng = np.random.default_rng(6)
    scores = rng.normal(2.0, 0.3, (4, 6)) + rng.normal(0.0, 2.0, 6)
    means = []
    for _ in range(20_000):
        tasks = [scores[rng.choice(4, 4), task] for task in range(6)]
        means.append(np.sort(np.concatenate(tasks))[6:18].mean())
    result = summary_of_runs(scores)
    assert result["ci95"] == pytest.approx(np.percentile(means, [2.5, 97.5]), abs=0.01)
    assert result["iqm"] == pytest.approx(np.sort(scores.ravel())[6:18].mean())
    assert result["mean"] == pytest.approx(scores.mean())
    assert [result["p5"], result["p95"]] == pytest.approx(np.percentile(scores, [5, 95]))
    assert result["max"] == scores.max()


@pytest.mark.parametrize(("events", "trials"), [(0, 30_000), (1, 10), (99, 100), (7, 30_000)])
def test_bound_solves_the_binomial_tail(events: int, trials: int) -> None:
    expected = brentq(lambda p: binom.cdf(events, trials, p) - 0.05, 0.0, 1.0, xtol=1e-16)
    assert upper_bound(events, trials) == pytest.approx(expected, rel=1e-9)
    assert upper_bound(0, trials) == pytest.approx(1 - 0.05 ** (1 / trials), rel=1e-9)
    assert upper_bound(trials, trials) == 1.0
