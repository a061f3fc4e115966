"""Interquartile mean and its interval against hand-computed cases."""

import numpy as np
import pytest

from study.statistics import iqm, summary


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    assert iqm(np.array([100.0, 1.0, 2.0, 3.0, 4.0, -50.0, 5.0, 6.0])) == pytest.approx((2 + 3 + 4 + 5) / 4)


def test_summary_of_a_constant_has_an_interval_of_no_width() -> None:
    assert summary(np.full(7, 2.5)) == {"iqm": 2.5, "mean": 2.5, "ci95": [2.5, 2.5]}


def test_interval_agrees_with_a_plain_bootstrap_loop() -> None:
    values = np.random.default_rng(3).normal(10.0, 2.0, 100)
    rng = np.random.default_rng(4)
    means = [np.sort(rng.choice(values, 100))[25:75].mean() for _ in range(4000)]
    expected = np.percentile(means, [2.5, 97.5])
    assert summary(values)["ci95"] == pytest.approx(expected, abs=0.05)


def test_summary_is_deterministic() -> None:
    values = np.random.default_rng(5).exponential(size=50)
    assert summary(values) == summary(values)
