"""Rates count what they claim to count."""

from dataclasses import replace
from types import SimpleNamespace

import torch
from torch.utils.flop_counter import FlopCounterMode

from inspection.state import CONTROL_SIZE
from rta.qp import Problems, Solutions
from rta.uncertainty import Uncertainty
from study.benchmark import rates
from study.benchmark.flights import Flight
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

    def correct(x: torch.Tensor, desired: torch.Tensor, sent: torch.Tensor) -> None:
        assert x.shape == (16, 1) and desired.shape == (6, 1) and sent.shape == (2, 6, 1)
        assert x.is_contiguous() and desired.is_contiguous() and x[0, 0] == desired[0, 0]
        met.append(x[0, 0].item())

    number = torch.arange(4.0)
    flight = Flight(number.expand(16, -1), number.expand(6, -1), [])
    latencies = rates.single_latencies(SimpleNamespace(correct=correct, known=Uncertainty(latency=2)), flight)
    assert met == [0.0, 1.0, 2.0, 3.0, 0.0]
    assert len(latencies) == 3 and latencies == sorted(latencies)


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
