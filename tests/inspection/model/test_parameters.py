"""The task's constants: what follows from them, and what is refused."""

from dataclasses import replace

import pytest


def test_actuator_limits_are_the_papers(c):
    assert c.max_torque == pytest.approx(0.0573 * 0.017453) == pytest.approx(0.001, rel=1e-3)
    assert replace(c, max_wheel_acceleration=10.0).max_torque == pytest.approx(4.1e-4)
    assert replace(c, inertia=(0.05, 0.02, 0.03)).max_torque == pytest.approx(0.02 * 0.017453)
    assert c.control_limit == (1.0,) * 3 + (c.max_torque,) * 3


def test_max_acceleration_is_thrust_less_the_worst_drift(c):
    # v_max = 0.2 + 7.5 n 800 = 6.362, cut to 5 m/s: 1/12 - 3 n^2 800 - 2 n 5
    assert c.max_acceleration == pytest.approx(0.0833333 - 0.0025313 - 0.0102700, abs=1e-6)
    assert c.max_acceleration == pytest.approx(0.0705, abs=5e-5)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"substep": 3.0}, "substep = 3: must divide action_period, 10 s"),
        ({"inertia": (0.1, 0.2, 0.31)}, "no body has a moment above the sum of the other two"),
        ({"initial_temperature": (-300.0, 5.0)}, "initial_temperature = .*: must be above absolute zero"),
        ({"max_distance": 15.0}, "max_distance = 15: must exceed deputy_radius"),
        ({"exclusion_buffer": 2.7}, "field_of_view / 2 .* must be below pi"),
    ],
)
def test_constants_that_do_not_fit_together_are_refused(c, changed, words):
    """What is declared of a single one is enforced in tests/test_settings.py."""
    with pytest.raises(ValueError, match=words):
        replace(c, **changed)
