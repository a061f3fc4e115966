"""The filter's uncertainty: what is refused, and the worst of them against drawn worlds."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.world.parameters import PlantParameters
from inspection.world.uncertainty import Uncertainty
from rta.parameters import RtaParameters
from rta.robust.filter import RobustFilter
from tests.inspection.model.test_dynamics import UNEQUAL
from tests.inspection.world.test_plant import begun, moments
from tests.oracles import tensor

C = InspectionParameters()
MANY = 20_000  # worlds


# what is refused


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"minimum_thrust": 0.02, "thrust_quantum": 0.05}, ["minimum_thrust and thrust_quantum"]),
        ({"longest_hold": 4.0}, ["longest_hold = 4", "the period, 5 s"]),
        ({"minimum_thrust": 2.0}, ["minimum_thrust = 2", "max_thrust, 1 N"]),
        ({"mass": 0.9, "thrust_gain": 0.8}, ["no check is known of motion", "unverified"]),
        ({"thrust_quantum": 2.0}, ["no check is known of motion", "unverified"]),
        ({"rate": 1.95, "hill_rotation": True}, ["no check is known of attitude", "unverified"]),
    ],
)
def test_bounds_that_leave_no_control_are_refused_in_a_line(
    bounds: dict[str, float], words: list[str]
) -> None:
    with pytest.raises(ValueError) as refusal:
        RobustFilter(C, RtaParameters(period=5.0), uncertainty=Uncertainty(**bounds))
    assert all(word in str(refusal.value) for word in words) and "\n" not in str(refusal.value)


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
