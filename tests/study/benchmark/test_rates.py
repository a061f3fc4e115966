"""Rates count what they claim to count."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from inspection.model.state import CONTROL_SIZE
from rta.filter import SafetyFilter
from rta.qp.programs import Problems, Solutions
from study.benchmark import rates
from study.benchmark.flights import Sample
from study.config import Config
from study.experiment import Experiment


def test_learner_flops_are_those_that_pytorch_counts() -> None:
    train = replace(Config().train, device="cpu", compile="off")
    learner = rates.fresh_learner(Experiment(replace(Config(), train=train), 1))
    batch = {name: torch.randn(1, 64) for name in ("log_prob", "advantage", "return_")}
    batch |= {"observation": torch.randn(1, 64, 26), "action": torch.randn(1, 64, CONTROL_SIZE)}
    with FlopCounterMode(display=False) as counter:
        learner._loss(batch)[0].sum().backward()
    assert counter.get_total_flops() == 64 * rates.learner_flops(learner)


def test_single_calls_meet_one_spacecraft_after_another(monkeypatch) -> None:
    monkeypatch.setattr(rates, "WARM_CALLS", 2)
    monkeypatch.setattr(rates, "SINGLE_CALLS", 3)
    met: list[float] = []

    def safety_filter(x: np.ndarray, desired: np.ndarray) -> None:
        assert x.shape == (16,) and desired.shape == (6,) and x.flags.c_contiguous
        assert x[0] == desired[0]
        met.append(x[0])

    number = torch.arange(4.0)
    sample = Sample(number.expand(16, -1), number.expand(6, -1), [])
    latencies = rates.single_latencies(safety_filter, sample)
    assert met == [0.0, 1.0, 2.0, 3.0, 0.0]
    assert len(latencies) == 3 and latencies == sorted(latencies)


def test_a_filter_call_is_held_against_what_the_core_can_do() -> None:
    safety_filter = SafetyFilter()
    safety_filter.compile("cpu", 256)
    found = rates.arithmetic(safety_filter)
    assert found["statements"] > 4000
    assert found["statements_per_s"] == pytest.approx(1e6 * found["statements"] / found["us"])
    assert 0.0 < found["statements_per_s"] < found["peak"]


def test_a_solver_is_given_as_many_programs_of_each_group_as_are_counted(monkeypatch) -> None:
    asked: list[int] = []

    class Solver:
        def solve(self, problems: Problems) -> Solutions | None:
            asked.append(problems.desired.shape[1])

    def once(function, work, device):
        function()
        return work

    monkeypatch.setattr(rates, "per_second", once)
    ones = torch.ones(2, 3, 5)
    group = Problems(ones[0], ones, ones[:, 0], ones[:, 0], ones[:, 0, 0])
    assert rates.programs(Solver(), [group, group], 8) == sum(asked) == 16
    assert asked == [8, 8]
