"""The task's constants: what follows from them, and what is refused."""

import math
from dataclasses import fields, replace

import pytest

from inspection.model.parameters import InspectionParameters


def test_actuator_limits_are_the_papers(c):
    assert c.max_torque == pytest.approx(0.0573 * 0.017453) == pytest.approx(0.001, rel=1e-3)
    assert replace(c, max_wheel_acceleration=10.0).max_torque == pytest.approx(4.1e-4)
    assert replace(c, inertia=(0.05, 0.02, 0.03)).max_torque == pytest.approx(0.02 * 0.017453)
    assert c.control_limit == (1.0,) * 3 + (c.max_torque,) * 3


def test_max_acceleration_is_thrust_less_the_worst_drift(c):
    # v_max = 0.2 + 7.5 n 800 = 6.362, cut to 5 m/s: 1/12 - 3 n^2 800 - 2 n 5
    assert c.max_acceleration == pytest.approx(0.0833333 - 0.0025313 - 0.0102700, abs=1e-6)
    assert c.max_acceleration == pytest.approx(0.0705, abs=5e-5)


def test_parameters_name_what_is_wrong():
    for wrong in ({"mass": -1.0}, {"solar_panel_axis": "x"}, {"inertia": (1.0, 0.0, 1.0)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            InspectionParameters(**wrong)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"thermal_axis": "w"}, r"thermal_axis = 'w': must be \+x, -x, \+y, -y, \+z or -z \(body axis of"),
        ({"max_time": 0.0}, "max_time = 0.0: must be finite and positive"),
        ({"mean_motion": math.inf}, "mean_motion = inf: must be finite"),
        ({"mean_motion": 1e-300}, r"mean_motion = 1e-300: must be finite and at least 1e-12 \(rad/s"),
        ({"albedo": math.nan}, "albedo = nan: must be finite"),
        ({"initial_energy": (5.0, math.inf)}, "initial_energy"),
        ({"initial_radius": (100.0, 50.0)}, r"initial_radius = \[100.0, 50.0\]: must be \[low, high\]"),
        ({"substep": 3.0}, "substep = 3: must divide action_period, 10 s"),
        ({"substep": 20.0}, "substep = 20.0: must be finite, positive and at most 5"),
        ({"substep": 5.5, "action_period": 5.5}, r"substep = 5.5: must be .* at most 5 \(s, longest"),
        ({"field_of_view": 3.2}, r"field_of_view = 3.2: must be .* at most 3.14159 \(rad"),
        ({"num_points": 100_001}, "num_points = 100001: must be an integer, positive and at most 100,000"),
        (
            {"inertia": (1.0, 1.0, -1.0)},
            r"inertia = \[1.0, 1.0, -1.0\]: must be 3 numbers, each finite and positive",
        ),
        ({"inertia": (0.1, 0.2, 0.31)}, "no body has a moment above the sum of the other two"),
        ({"inertia": (0.1, 0.2)}, "inertia = .*: must be 3 numbers"),
        ({"initial_energy": (5.0, 6.0, 7.0)}, r"initial_energy = \[5.0, 6.0, 7.0\]: must be \[low, high\]"),
        ({"initial_energy": (-1.0, 6.0)}, "initial_energy = .*: must be .*, finite and not negative"),
        ({"initial_radius": (0.0, 50.0)}, "initial_radius = .*: must be .*, finite and positive"),
        ({"initial_temperature": (-300.0, 5.0)}, "initial_temperature = .*: must be above absolute zero"),
        ({"max_distance": 15.0}, "max_distance = 15: must exceed deputy_radius"),
        ({"exclusion_buffer": 2.7}, "field_of_view / 2 .* must be below pi"),
        ({"docking_speed": -0.1}, "docking_speed = -0.1: must be finite and not negative"),
        ({"speed_slope": -1e-3}, "speed_slope = -0.001: must be finite and not negative"),
        ({"temperature_sun_slope": -0.05}, "temperature_sun_slope = -0.05: must be finite and not negative"),
        (
            {"temperature_earth_slope": -0.01},
            "temperature_earth_slope = -0.01: must be finite and not negative",
        ),
        ({"energy_sun_slope": -0.05}, "energy_sun_slope = -0.05: must be finite and not negative"),
        ({"exclusion_buffer": -0.1}, "exclusion_buffer = -0.1: must be finite and not negative"),
        ({"power_draw": -15.0}, "power_draw = -15.0: must be finite and not negative"),
        ({"success_score": 5}, "success_score = 5: must be finite, positive and at most 1"),
        ({"success_score": 0.0}, "success_score = 0.0: must be finite, positive"),
        ({"num_points": 2.5}, "num_points = 2.5: must be an integer"),
        ({"albedo": 1.1}, "albedo = 1.1: must be finite, not negative and at most 1"),
    ],
)
def test_what_no_flight_could_use_is_refused(c, changed, words):
    with pytest.raises(ValueError, match=words):
        replace(c, **changed)


@pytest.mark.parametrize(
    "possible",
    [
        {"inertia": (0.1, 0.2, 0.1 + 0.2)},  # a flat plate
        {"success_score": 1.0},
        {"docking_speed": 0.0},
        {"temperature_sun_slope": 0.0, "temperature_earth_slope": 0.0, "energy_sun_slope": 0.0},
        {"speed_slope": 0.0, "exclusion_buffer": 0.0, "power_draw": 0.0, "min_energy": 0.0},
        {"delta_v_reward": 0.02, "torque_reward": 0.1, "max_temperature": -5.0},
    ],
)
def test_what_can_be_is_not_refused(c, possible):
    replace(c, **possible)


NUMBERS = [each.name for each in fields(InspectionParameters) if not isinstance(each.default, (bool, str))]


@pytest.mark.parametrize("name", NUMBERS)
def test_no_constant_may_be_nan(c, name):
    value = getattr(c, name)
    with pytest.raises(ValueError, match=name):
        replace(c, **{name: (math.nan, *value[1:]) if isinstance(value, tuple) else math.nan})


def test_docking_radius_and_thermal_constants_are_the_papers(c):
    assert c.collision_radius == 15.0
    assert c.speed_slope == pytest.approx(7.5 * c.mean_motion)
    assert (math.degrees(c.field_of_view), math.degrees(c.exclusion_buffer)) == pytest.approx((60.0, 10.0))
