"""What a filter makes of a demand: what is counted, against numbers made by hand, and who demands."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from experiments import measure
from experiments.measure import Counted, accepted, full, starts
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from settings import override
from study.config import Config

C = InspectionParameters()


class Halving:
    """Applies half of the thrust; its check moves every second call, and every third one is not verified."""

    c = C

    def correct(self, x: Tensor, desired: Tensor) -> SimpleNamespace:
        control = desired.clone()
        control[:3] *= 0.5
        column = torch.arange(x.shape[1])
        return SimpleNamespace(
            control=control,
            intervened=(control != desired).any(0),
            backup=column % 2 == 0,
            verified=column % 3 != 0,
        )


def test_calls_are_counted_and_changes_are_in_limits() -> None:
    counted = Counted(Halving())  # type: ignore[arg-type]
    desired = torch.zeros(6, 6, dtype=torch.float64)
    desired[:2, :4] = C.max_thrust
    for _ in range(2):
        counted.correct(torch.zeros(16, 6, dtype=torch.float64), desired)
    assert (counted.calls, counted.corrected, counted.moved, counted.unverified) == (12, 8, 6, 4)
    assert counted.change.tolist() == pytest.approx([8 * math.sqrt(0.5), 0.0])
    assert counted.chatter.tolist() == [0.0, 0.0]
    counted.correct(torch.zeros(16, 6, dtype=torch.float64), 0.0 * desired)
    assert counted.chatter.tolist() == pytest.approx([4 * math.sqrt(0.5), 0.0])
    assert counted.seconds > 0.0


def test_full_control_is_at_the_limits_and_is_held() -> None:
    controller, x = full(C, torch.Generator().manual_seed(0), 8), torch.zeros(16, 8, dtype=torch.float64)
    first, same, other = (controller(t, x).clone() for t in (0.0, 10.0, 60.0))
    limit = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
    assert (first.abs() == limit).all() and torch.equal(first, same) and not torch.equal(first, other)


@pytest.mark.parametrize("where", ["paper", "safe-set", "edge"])
def test_starts_are_accepted_and_where_they_should_be(where: str) -> None:
    safety_filter = fast(SafetyFilter(C))
    x, priority = starts(where, 20, 0, safety_filter)
    assert x.shape == (16, 20) and priority.shape == (3, 20) and safety_filter.is_safe(x).all()
    distance = x[P].norm(dim=0)
    assert (distance.amin() > 0.94 * C.max_distance) == (where == "edge")
    assert 0.9 < accepted(safety_filter, 0) < 1.0


@pytest.mark.parametrize("period", [1.0, pytest.param(10.0, marks=pytest.mark.campaign)])
def test_beside_states_that_are_barely_starts_there_are_others_that_are_none(period: float) -> None:
    safety_filter = fast(SafetyFilter(C, RtaParameters(period=period)))
    shares = []
    for where in ("barely", "safe-set"):
        x, _ = starts(where, 100, 0, safety_filter)
        assert safety_filter.is_safe(x).all() and (safety_filter.values(x) >= 0.0).all()
        beside = x.clone()
        beside[P] += 1e-6
        beside[13:15] += torch.tensor([[1e-8], [-1e-8]], dtype=torch.float64)  # warmer, and less energy
        shares.append(safety_filter.is_safe(beside).double().mean().item())
    assert shares[0] < 0.8 and shares[1] > 0.99, shares


@pytest.mark.campaign
def test_who_looks_ahead_from_there_breaks_nothing_and_is_corrected() -> None:
    config = override(Config(), {"train": {"rta": True}}, "test")
    found = measure.measure(config, "lookahead", "barely", 16, 10.0)
    assert found["broken_episodes"] == 0 and found["unverified_percent"] == 0.0
    assert found["moved_by_check_percent"] > 0.0


def test_a_filter_that_is_wrong_about_the_mass_is_seen_to_break_limits() -> None:
    """The planted fault: from the edge of the zone, in a world beyond the filter's bounds."""
    config = override(Config(), {"plant": {"mass_factor": 2.0}}, "test")
    assert measure.measure(config, "full", "edge", 16, 60.0)["broken_episodes"] > 0
