"""A vehicle that cannot hold a limit is refused, whatever its filter; the shipped ones hold theirs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.vehicle import check
from settings import load
from study.config import Config
from study.verification.adversaries import adversarial, held_at_random
from study.verification.starts import initial_states

PAPER = InspectionParameters()
VEHICLES = sorted((Path(__file__).parents[2] / "configs/vehicles").glob("*.toml"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mass": 1e-300}, ["1e+300", "1e+06"]),
        ({"max_thrust": 0.1}, ["0.00833", "natural acceleration", "keep-in zone"]),
        ({"max_thrust": 0.6}, ["dynamic speed limit", "0.0475", "0.049"]),
        ({"max_thrust": 0.75}, ["across at the speed limit", "0.0506", "90%"]),
        ({"inertia": (0.3, 0.3, 0.01), "wheel_inertia": 1e-6}, ["gyroscopic", "at most half"]),
        ({"max_rate": 0.001}, ["max_rate = 0.001", "0.00103", "Sun"]),
        ({"power_draw": 25.0}, ["25 W", "22.7 W"]),
        ({"emissivity": 0.0}, ["does not cool"]),
    ],
)
def test_a_vehicle_that_cannot_hold_a_limit_is_refused_with_the_number(
    settings: dict[str, Any], words: list[str]
) -> None:
    c = replace(PAPER, **settings)
    for parameters in (RtaParameters(), RtaParameters(filter="paper"), RtaParameters(unverified=True)):
        with pytest.raises(ValueError) as refused:
            SafetyFilter(c, parameters)
        assert all(word in str(refused.value) for word in words) and "\n" not in str(refused.value)
    check(PAPER)


@pytest.mark.campaign
@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: path.stem)
@torch.no_grad()
def test_shipped_vehicles_violate_nothing(path: Path) -> None:
    c: InspectionParameters = load(path, Config()).inspection
    safety = fast(SafetyFilter(c), "cpu", 64)
    x, _, _ = initial_states(64, 3, safety)
    random, adversary = held_at_random(c, torch.Generator().manual_seed(0), 64), adversarial(safety)
    smallest = torch.full((len(safety.names),), torch.inf, dtype=torch.float64)
    for t in range(60):
        desired = random(float(t), x)
        if t % 2 == 0:
            attack = adversary(float(t), x)
        desired[:, ::2] = attack[:, ::2]
        x = step(x, safety.correct(x, desired).control, 1.0, c)
        smallest = smallest.minimum(safety.values(x).amin(1))
    assert (smallest >= 0.0).all(), dict(zip(safety.names, smallest.tolist(), strict=True))
