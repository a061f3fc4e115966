"""What flies behind the filter in a verification: random controls and the adversaries, and how they choose corners."""

import itertools

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.stats import kstest

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.world.corners import displaced
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.scales import scales
from study.verification.adversaries import LONGEST_ACTION, Greedy, adversarial, attacked, held_at_random
from tests.oracles import paper, push, slope, tensor
from tests.support.flights import LIMIT, flights

C = InspectionParameters()
R = RtaParameters()


def test_random_controls_are_held_for_up_to_a_minute() -> None:
    count, steps = 50, 400
    policy = held_at_random(C, torch.Generator().manual_seed(3), count)
    part = held_at_random(C, torch.Generator().manual_seed(3), count, 10)
    x = torch.zeros(16, count, dtype=torch.float64)
    u = torch.stack([policy(float(t), x) for t in range(steps)]).numpy()
    assert all((part(float(t), x[:, :5]).numpy() == u[t][:, 10:15]).all() for t in range(steps))
    assert (np.abs(u) <= LIMIT).all() and (np.abs(u).max((0, 2)) > 0.99 * LIMIT[:, 0]).all()
    changes = (np.diff(u, axis=0) != 0).any(1)
    assert (changes == (np.diff(u, axis=0) != 0).all(1)).all()  # all six at once
    holds = np.concatenate([np.diff(np.flatnonzero(changes[:, k])) for k in range(count)])
    assert holds.min() >= 1 and holds.max() <= LONGEST_ACTION
    assert (
        kstest((holds - np.random.default_rng(0).random(holds.size)) / LONGEST_ACTION, "uniform").pvalue
        > 1e-4
    )


def test_adversary_descends_the_row_that_zero_control_comes_closest_to_breaking() -> None:
    x = flights(2000, (16, 790), (0.05, 0.95))
    safety = SafetyFilter(C, R)
    u = adversarial(safety)(0.0, tensor(x)).numpy()
    np.testing.assert_allclose(np.abs(u[:3]).max(0), 1.0)
    np.testing.assert_allclose(np.abs(u[3:]).max(0), C.max_torque)
    a, b, *_ = safety.program.evaluated(tensor(x))
    worst = (b[:7] / a[:7, :3].norm(dim=1)).argmin(0).numpy()
    seen = 0
    for row in (0, 1, 2, 4, 5, 6):  # rows whose slopes can be found by differences

        def h(y: ndarray, row: int = row) -> ndarray:
            return paper(y)[row]

        y = x[:, worst == row]
        if y.size:
            gradient = np.stack([slope(h, y, push(y, i), 1e-3) for i in range(3)])
            np.testing.assert_allclose(u[:3, worst == row], -gradient / np.abs(gradient).max(0), atol=1e-6)
            assert (h(y + 1e-3 * sum(u[i, worst == row] * push(y, i) for i in range(3))) < h(y)).all()
            seen += y.shape[1]
    assert seen > 300


EACH = torch.arange(112)  # of these columns every pair of constraints, or all of a group, is attacked twice
SIZES = torch.tensor([0.1] * 3 + [1e-3] * 3 + [1e-3] * 3 + [1e-4] * 3, dtype=torch.float64)[:, None]


def lowered(x: torch.Tensor, u: torch.Tensor) -> np.ndarray:
    """Returns J, which `Greedy` lowers: thrust's and torque's smallest attacked h a second later, in calls."""
    h = SafetyFilter(C, R).values(step(x, u, 1.0, C)).numpy() / np.array(scales(C, 1.0))[:, None]
    h = np.where(attacked(EACH), h, np.inf)
    return h[:7].min(0) + h[7:].min(0)


@pytest.fixture(scope="module")
def pressed() -> tuple[torch.Tensor, torch.Tensor]:
    """Returns states and the held controls there."""
    x = tensor(flights(112, (100, 700), (0.05, 0.5)))
    return x, 0.5 * tensor(LIMIT) * (
        2.0 * torch.rand(6, 112, generator=torch.Generator().manual_seed(2)) - 1.0
    )


def test_greedy_errors_are_those_that_make_the_truth_look_safest(
    pressed: tuple[torch.Tensor, torch.Tensor],
) -> None:
    """Each sign against what a displacement along that axis does to h; where that is next to nothing, any will do."""
    x, u = pressed
    greedy = Greedy(SafetyFilter(C, R), attacked(EACH))
    greedy.last = u
    positive = greedy.errors(torch.zeros(112), x).numpy()
    checked = 0
    for axis in range(12):
        push = SIZES * (torch.arange(12) == axis)[:, None]
        gained = lowered(displaced(x, push), u) - lowered(displaced(x, -push), u)
        clear = np.abs(gained) > 1e-5
        assert (positive[axis, clear] == (gained[clear] > 0)).mean() > 0.97, axis  # a kink may lie between
        checked += clear.sum()
    assert checked > 700


def test_greedy_gains_lower_h_the_most_of_all_corners_and_a_call_is_missed_where_the_last_control_does(
    pressed: tuple[torch.Tensor, torch.Tensor],
) -> None:
    x, u = pressed
    greedy = Greedy(SafetyFilter(C, R), attacked(EACH))
    chosen = greedy.response(torch.zeros(112), x, u, u)
    assert not chosen[6].any()  # where the world cannot miss it, both are the same
    corners = torch.tensor(list(itertools.product((0.999, 1.001), repeat=6)), dtype=torch.float64)
    found = [lowered(x, corner[:, None] * u) for corner in corners]
    least, most = np.min(found, axis=0), np.max(found, axis=0)
    got = lowered(x, torch.where(chosen[:6], 1.001, 0.999) * u)
    assert np.mean(got - least <= 0.02 * (most - least)) > 0.95
    last = -u
    missed = greedy.response(torch.zeros(112), x, u, last)[6].numpy()
    assert (missed == (lowered(x, last) < lowered(x, u))).all() and 20 < missed.sum() < 92


def test_pressing_is_full_control_against_the_constraint_that_an_episode_attacks() -> None:
    x = tensor(flights(112, (300, 700), (0.05, 0.5)))
    u = Greedy(SafetyFilter(C, R), attacked(EACH))(0.0, x)
    units = (u.numpy() / LIMIT).reshape(2, 3, -1)
    np.testing.assert_allclose(np.abs(units[0]).max(0), 1.0)
    assert (lowered(x, 1e-3 * u) <= lowered(x, -1e-3 * u)).all()
