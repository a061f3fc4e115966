"""The filter's uncertainty: what is refused, and the worst of them against drawn worlds."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.world.parameters import PlantParameters
from rta.bounds.uncertainty import Uncertainty
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from tests.inspection.model.test_dynamics import UNEQUAL
from tests.inspection.world.test_plant import begun, moments
from tests.oracles import tensor

C = InspectionParameters()
R = RtaParameters()
MANY = 20_000  # worlds


# what is refused


def test_a_least_impulse_and_a_step_of_thrust_are_refused_together() -> None:
    with pytest.raises(ValueError, match="minimum_thrust and thrust_quantum"):
        Uncertainty(minimum_thrust=0.02, thrust_quantum=0.05)


@pytest.mark.parametrize(
    ("bounds", "period", "bound", "limit"),
    [
        ({"longest_hold": 4.0}, 5.0, "longest_hold = 4", "the period, 5 s"),
        ({"mass": 0.9, "thrust_gain": 0.8}, 1.0, "mass = 0.9, thrust_gain = 0.8", "max_distance = 800 m"),
        ({"acceleration": 0.08}, 1.0, "acceleration = 0.08", "max_distance = 800 m"),
        ({"thrust_gain": 0.9}, 1.0, "thrust_gain = 0.9", "max_distance = 800 m"),
        ({"thrust_misalignment": 30.0}, 1.0, "thrust_misalignment = 30", "max_distance = 800 m"),
        ({"thrust_quantum": 2.0}, 1.0, "thrust_quantum = 2", "max_distance = 800 m"),
        ({"minimum_thrust": 2.0}, 1.0, "minimum_thrust = 2", "max_thrust, 1 N"),
        ({"rate": 2.0}, 1.0, "rate = 2", "max_rate, 2 deg/s"),
        ({"rate": 1.95, "hill_rotation": True}, 1.0, "rate = 1.95", "max_rate, 2 deg/s"),
        ({"inertia": 0.3}, 10.0, "inertia = 0.3", "limits of the body rates"),
    ],
)
def test_a_bound_that_leaves_no_control_is_refused_with_the_limit_that_it_breaks(
    bounds: dict[str, float], period: float, bound: str, limit: str
) -> None:
    with pytest.raises(ValueError) as refusal:
        SafetyFilter(C, RtaParameters(period=period), uncertainty=Uncertainty(**bounds))
    assert bound in str(refusal.value) and limit in str(refusal.value)
    assert "\n" not in str(refusal.value)


# which rows


# the worst world, of many drawn by `inspection.world.plant`


BOUNDS = {"mass": 0.1, "inertia": 0.2, "thrust_gain": 0.05, "torque_gain": 0.07, "thrust_misalignment": 20.0}
UNCERTAINTY = Uncertainty(**BOUNDS, acceleration=0.004)
WORLD = PlantParameters(
    mass_factor=(0.9, 1.1),
    inertia_factor=(0.85, 1.15),  # more is no body
    thrust_gain=(0.95, 1.05),
    torque_gain=(0.93, 1.07),
    thrust_misalignment=(0.0, 20.0),
    acceleration=(0.0, 0.004),
)


def along_axes(u: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Accelerations for those of the model, of the thrust and of the torque along one axis, (MANY,) each."""
    plant = begun(WORLD, MANY, seed=axis, c=C)
    acting = plant.actuate(moments(MANY), u.expand(-1, MANY))
    mass, inertia = plant.body[0], plant.body[1:4]
    return acting[axis] / mass * C.mass, acting[3 + axis] / inertia[axis] * C.inertia[axis]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_no_world_gives_less_or_more_along_an_axis(axis: int) -> None:
    u = torch.zeros(6, 1, dtype=torch.float64)
    u[[axis, 3 + axis]] = 1.0
    for given, (least, most) in zip(
        along_axes(u, axis), (UNCERTAINTY.thrust, UNCERTAINTY.torque), strict=True
    ):
        assert (given >= least).all() and (given <= most).all()
        # nearly all of the interval is there
        assert given.min() < least + 0.1 and given.max() > most - 0.12
    # with less uncertainty a world would be beyond
    for name in ("mass", "thrust_gain", "thrust_misalignment"):
        least, most = dataclasses.replace(UNCERTAINTY, **{name: 0.0}).thrust
        given, _ = along_axes(u, axis)
        assert (given < least).any() or (given > most).any()
    for name in ("inertia", "torque_gain"):
        least, most = dataclasses.replace(UNCERTAINTY, **{name: 0.0}).torque
        _, given = along_axes(u, axis)
        assert (given < least).any() or (given > most).any()


def braking(bounds: Uncertainty) -> np.ndarray:
    """m/s^2 against the worst flight next to the zone that 1 N along an axis brings, of drawn worlds, (MANY,)."""
    rng = np.random.default_rng(0)

    def within(share: float) -> np.ndarray:
        return rng.uniform(1 - share, 1 + share, MANY)

    tilt = np.cos(np.radians(bounds.thrust_misalignment * rng.uniform(size=MANY)))
    thrust = C.max_thrust * within(bounds.thrust_gain) * tilt / (C.mass * within(bounds.mass))
    n, r = C.mean_motion, C.max_distance
    speed = min(C.max_speed, C.docking_speed + C.speed_slope * r)
    angle = rng.uniform(0, 2 * np.pi, MANY)  # of a flight across, which Coriolis turns outwards or inwards
    nature = 3 * n**2 * r + 2 * n * speed * np.cos(angle)
    return thrust - nature - bounds.acceleration * rng.uniform(size=MANY)


def test_a_max_is_there_in_every_world() -> None:
    bounds = dataclasses.replace(UNCERTAINTY, thrust_misalignment=3.0)
    found = braking(bounds).min()
    assert bounds.max_acceleration(C, R) <= found < bounds.max_acceleration(C, R) + 0.006
    for name in ("mass", "thrust_gain", "acceleration"):
        assert dataclasses.replace(bounds, **{name: 0.0}).max_acceleration(C, R) > found
    assert Uncertainty().max_acceleration(C, R) == C.max_acceleration


@pytest.mark.parametrize("hill_rotation", [False, True])
@pytest.mark.parametrize("inertia", [C.inertia, UNEQUAL])
def test_no_body_within_the_bound_turns_otherwise_by_more(
    inertia: tuple[float, float, float], hill_rotation: bool
) -> None:
    c = dataclasses.replace(C, inertia=inertia)
    bounds = Uncertainty(inertia=0.2, hill_rotation=hill_rotation)
    rng = np.random.default_rng(1)
    omega = rng.uniform(-1, 1, (3, MANY)).round() * c.max_rate  # many at the corners
    nominal = np.array(c.inertia)[:, None]
    true = nominal * (1 + 0.2 * rng.choice((-1.0, 1.0, 0.3), (3, MANY)))
    z = rng.standard_normal((3, MANY))
    z /= np.linalg.norm(z, axis=0)  # Hill's, in the body
    turning = c.mean_motion * z if hill_rotation else 0.0 * z
    relative = omega  # to Hill's frame, as the model takes it
    stars = relative + turning

    def gyroscopic(w: np.ndarray, j: np.ndarray) -> np.ndarray:
        return -np.cross(w, j * w, axis=0) / j

    # d/dt (w - n z) of a z that stands still in Hill's frame: dz/dt = -(w - n z) x z
    true_rate = gyroscopic(stars, true) + np.cross(relative, turning, axis=0)
    off = np.linalg.norm(true_rate - gyroscopic(relative, nominal), axis=0)
    bound = bounds.angular_acceleration(c)
    assert off.max() <= bound
    assert off.max() > 0.5 * bound
    assert off.max() > dataclasses.replace(bounds, inertia=0.1).angular_acceleration(c)


# what thrusters give


def test_what_is_given_is_what_the_thrusters_of_the_plant_give() -> None:
    thrust = tensor(np.random.default_rng(2).uniform(-1, 1, (3, 500)))
    thrust[:, :5] = tensor([[-1.0, 1.0, 0.05, 0.0, 0.025]])
    u = torch.cat((thrust, torch.zeros_like(thrust)))
    for name, value in (("minimum_thrust", 0.3), ("thrust_quantum", 0.25), ("thrust_quantum", 0.6)):
        plant = begun(PlantParameters(**{name: value}), 500, c=C)
        assert torch.equal(
            Uncertainty(**{name: value}).quantised(thrust, C.max_thrust), plant.actuate(moments(500), u)[:3]
        )
    assert torch.equal(Uncertainty().quantised(thrust, C.max_thrust), thrust)
