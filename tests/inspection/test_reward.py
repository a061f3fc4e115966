"""Each of the paper's nine reward terms against numbers worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from inspection.reward import REWARDS, rewards
from inspection.state import P, Q, V

STEP_BY_STEP = ("points", "delta_v", "torque", "orientation", "time")
AT_THE_END = ("success", "crash", "distance", "energy")
ENDS = ("crash", "out_of_bounds", "out_of_power", "success", "timeout")


def as_column(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def at(p, v=(0.0, 0.0, 0.0), yaw=0.0):
    """One state (16, 1) at p with n_x turned by `yaw` from +x towards +y."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[P, 0], x[V, 0] = as_column(p), as_column(v)
    x[Q, 0] = as_column([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    return x


def terms(c, x=None, new_score=0.0, delta_v=0.0, torque=0.0, time=10.0, ended=()):
    """Every term as a float, for one spacecraft."""
    numbers = [as_column([number]) for number in (new_score, delta_v, torque, time)]
    flags = {name: torch.tensor([name in ended]) for name in ENDS}
    x = at((60.0, 0.0, 0.0)) if x is None else x
    return {name: term.item() for name, term in rewards(x, *numbers, flags, c).items()}


def drifting(days):
    """State after (or, negative, before) a pass through the chief's centre at 2 mm/s, drifting 37 m an orbit."""
    n = 0.001027
    A = np.zeros((6, 6))
    A[:3, 3:] = np.eye(3)
    A[3, 0], A[3, 4], A[4, 3], A[5, 2] = 3 * n**2, 2 * n, -2 * n, -(n**2)
    state = expm(A * days * 86400.0) @ [0.0, 0.0, 0.0, 0.0, 0.002, 0.0]
    return at(state[:3], state[3:])


def test_the_papers_nine_terms_are_there_in_its_order(c):
    papers = STEP_BY_STEP + AT_THE_END
    assert tuple(terms(c)) == REWARDS
    assert tuple(name for name in REWARDS if name in papers) == papers


def test_nothing_is_earned_for_nothing(c):
    earned = terms(c, time=3010.0)  # the boresight points away from the chief
    assert {earned[name] for name in STEP_BY_STEP + AT_THE_END} == {0.0}


def test_points_earn_their_weight(c):
    assert terms(c, new_score=0.0375)["points"] == 0.0375


def test_delta_v_costs_two_hundredths_per_metre_per_second(c):
    assert terms(c, delta_v=2.5)["delta_v"] == pytest.approx(-0.05)


def test_torque_costs_a_tenth_per_newton_metre(c):
    assert terms(c, torque=0.003)["torque"] == pytest.approx(-0.0003)


@pytest.mark.parametrize(
    ("yaw", "expected"),  # the cosine between boresight and chief is -cos(yaw) for a deputy on +x
    [
        (math.pi, 0.0005),
        (math.radians(120), 0.0005 * math.exp(-0.5 / 0.15)),
        (math.radians(135), 0.0005 * math.exp(-(1 - math.sqrt(0.5)) / 0.15)),
        (math.radians(90.1), 0.0005 * math.exp(-(1 - 0.00174533) / 0.15)),
        (math.radians(89.9), 0.0),
        (0.0, 0.0),
    ],
)
def test_orientation_decays_with_misalignment(c, yaw, expected):
    assert terms(c, at((60.0, 0.0, 0.0), yaw=yaw))["orientation"] == pytest.approx(
        expected, rel=1e-6, abs=1e-12
    )


@pytest.mark.parametrize(("time", "expected"), [(10.0, 0.001), (3000.0, 0.001), (3010.0, 0.0)])
def test_time_is_paid_until_3000_s(c, time, expected):
    assert terms(c, time=time)["time"] == expected


def test_success_is_rewarded_when_coasting_stays_clear_of_the_chief(c):
    in_track = at((0.0, 60.0, 0.0))  # an equilibrium of the Clohessy-Wiltshire equations
    n, b = c.mean_motion, 40.0
    ellipse = at((b, 0.0, 0.0), (0.0, -2 * n * b, 0.0))  # closed, never nearer than 40 m
    assert terms(c, in_track, ended={"success"})["success"] == 1.0
    assert terms(c, ellipse, ended={"success"})["success"] == 1.0


def test_success_is_punished_when_coasting_returns_to_the_chief(c):
    leaving = at((0.0, 0.0, 60.0), (0.0, 0.0, 0.05))  # z'' = -n^2 z brings it back to the origin
    assert terms(c, leaving, ended={"success"})["success"] == -1.0


@pytest.mark.parametrize(("days", "expected"), [(-1.0, -1.0), (-1.99, -1.0), (-2.2, 1.0), (1.0, 1.0)])
def test_success_looks_two_days_ahead(c, days, expected):
    assert terms(c, drifting(days), ended={"success"})["success"] == expected


def test_success_uses_both_radii(c):
    in_track = at((0.0, 14.5, 0.0))
    assert terms(c, in_track, ended={"success"})["success"] == -1.0
    assert terms(replace(c, deputy_radius=4.0), in_track, ended={"success"})["success"] == 1.0


def test_success_is_judged_per_column(c):
    x = torch.cat((at((0.0, 60.0, 0.0)), at((0.0, 0.0, 60.0)), at((0.0, 60.0, 0.0))), 1)
    zero, no = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.bool)
    ended = dict.fromkeys(ENDS, no) | {"success": torch.tensor([False, True, True])}
    assert rewards(x, zero, zero, zero, zero, ended, c)["success"].tolist() == [0.0, -1.0, 1.0]


@pytest.mark.parametrize(
    ("term", "end"), [("crash", "crash"), ("distance", "out_of_bounds"), ("energy", "out_of_power")]
)
def test_a_failure_costs_one(c, term, end):
    failed = terms(c, ended={end})
    assert failed[term] == -1.0
    assert sum(failed[name] for name in AT_THE_END) == -1.0


def test_a_timeout_costs_nothing(c):
    assert sum(terms(c, ended={"timeout"})[name] for name in AT_THE_END) == 0.0
