"""Gains and margins follow from the vehicle; one that cannot hold a limit is refused; the shipped ones hold theirs."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from rta.constraints.vehicle import PAPER, check, scaled, time_to_stop, time_to_turn
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from settings import load
from study.config import Config
from study.verification.adversaries import adversarial, held_at_random
from study.verification.starts import initial_states

VEHICLES = sorted((Path(__file__).parents[3] / "configs/vehicles").glob("*.toml"))
R = RtaParameters()
GAINS = {"exclusion_gains", "temperature_gains", "battery_gains"}


def changed(**settings: Any) -> set[str]:
    """The filter's parameters that are others for a vehicle that differs from the paper's."""
    own = scaled(R, replace(PAPER, **settings))
    return {name for name, value in vars(own).items() if value != getattr(R, name)}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, set()),
        # thrust's barriers have the vehicle's own braking in them
        ({"mass": 20.0, "max_thrust": 3.0}, set()),
        ({"mean_motion": 0.0005, "max_distance": 300.0}, set()),
        ({"power_draw": 20.0}, {"battery_margin"}),
        ({"absorptivity": 0.3}, {"temperature_margin"}),
        # half the torque: twice the time and the angle of a stop
        (
            {"max_angular_acceleration": 0.017453 / 2},
            {*GAINS, "temperature_margin", "battery_margin", "incidence_rounding", "pole_angle"},
        ),
        # half the rate: half the time of a stop, an eighth... of its angle, but twice the time of a turn
        (
            {"max_rate": PAPER.max_rate / 2},
            {"temperature_gains", "battery_gains", "temperature_margin", "battery_margin"},
        ),
        # twice the torque: a period misses more
        ({"max_angular_acceleration": 0.034906, "max_wheel_acceleration": 400.0}, {"exclusion_margin"}),
    ],
)
def test_what_depends_on_what(settings: dict[str, Any], expected: set[str]) -> None:
    assert changed(**settings) == expected


def test_gains_fall_and_margins_grow_as_the_equations_say() -> None:
    slow = replace(PAPER, max_angular_acceleration=PAPER.max_angular_acceleration / 4)
    own = scaled(R, slow)
    assert time_to_stop(slow) == pytest.approx(4 * time_to_stop(PAPER))
    longer = time_to_turn(slow) / time_to_turn(PAPER)
    assert longer == pytest.approx((45.0 + 8.0) / (45.0 + 2.0), rel=1e-4)
    assert own.exclusion_gains == pytest.approx((0.05 / 4, 0.2 / 4))
    assert own.battery_gains == pytest.approx((0.004 / longer, 0.1 / 4))
    assert own.battery_margin == pytest.approx(0.02 * longer)
    assert own.incidence_rounding == pytest.approx(1.0)  # 4 times 0.3 would be most of the sphere
    assert math.tan(own.pole_angle) == pytest.approx(4 * math.tan(0.2))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_thrust": 0.1}, ["0.00833", "natural acceleration", "keep-in zone"]),
        ({"max_thrust": 0.6}, ["dynamic speed limit", "0.0475", "0.049"]),
        ({"max_thrust": 0.75}, ["across at the speed limit", "0.0506", "90%"]),
        ({"max_thrust": 1.5}, ["in 1 s by up to 0.217 m/s", "56% of the limit", "0.316 m/s"]),
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
    with pytest.raises(ValueError) as refused:
        SafetyFilter(c)
    for word in words:
        assert word in str(refused.value)
    check(PAPER)


@pytest.mark.campaign
@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: path.stem)
@torch.no_grad()
def test_shipped_vehicles_violate_nothing(path: Path) -> None:
    c: InspectionParameters = load(path, Config()).inspection
    safety = SafetyFilter(c, R)
    safety.compile("cpu", 64)
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
