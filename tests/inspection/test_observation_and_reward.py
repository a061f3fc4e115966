"""What the agent observes, earns and is ended by: against the paper's lists and numbers worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from inspection.model.parameters import OBSERVABLE
from inspection.model.state import E, P, Q, V
from inspection.observation import components, observe, scales
from inspection.reward import PHASES, distance_from_track, rewards
from inspection.termination import OUTCOMES, ends, failures
from tests.inspection.model.test_dynamics import A, N

ENDS = ("crash", "out_of_bounds", "out_of_power", "success", "timeout")

# The 26 observations, recomputed one spacecraft at a time


def recompute(x, priority, uninspected, score):
    """Returns the paper's o, in its order, for one spacecraft."""
    p, v, omega, (temperature, energy, theta_s) = x[:3], x[3:6], x[10:13], x[13:]
    to_body = Rotation.from_quat(x[6:10]).inv().apply
    p_hat, sun = p / np.linalg.norm(p), np.array([math.cos(theta_s), math.sin(theta_s), 0.0])
    return [
        np.linalg.norm(p),
        *to_body(p_hat),
        np.linalg.norm(v),
        *to_body(v / np.linalg.norm(v)),
        *omega,
        energy,
        temperature,
        *to_body(sun),
        sun @ p_hat,
        *to_body(priority),
        priority @ p_hat,
        *to_body(uninspected),
        uninspected @ p_hat,
        score,
    ]


def draw(random_states, generator, batch):
    directions = torch.randn(2, 3, batch, generator=generator, dtype=torch.float64)
    priority, uninspected = directions / directions.norm(dim=1, keepdim=True)
    score = torch.rand(batch, generator=generator, dtype=torch.float64)
    return random_states(batch), priority, uninspected, score


def test_observations_are_the_papers(c, random_states, generator):
    arguments = draw(random_states, generator, 8)
    o = observe(*arguments, c)
    expected = [recompute(*(a[..., i].numpy() for a in arguments)) for i in range(8)]
    np.testing.assert_allclose(o.T, expected, rtol=1e-12, atol=1e-12)


def test_units_and_scales_are_those_of_each_quantity(c):
    c = replace(c, observation_scales=(175.0, 1.5, 0.05))
    units = dict.fromkeys((name for name, _, _ in components(c)), ("1", 1.0))
    units |= {"position_norm": ("m", 175.0), "velocity_norm": ("m/s", 1.5)}
    units |= {"energy": ("kJ", 10.0), "temperature": ("deg C", 10.0)}
    units |= {f"angular_velocity_{i}": ("rad/s", 0.05) for i in "xyz"}
    assert {name: each for name, *each in components(c)} == {name: [*each] for name, each in units.items()}
    assert scales(torch.zeros(1).double(), c)[:, 0].tolist() == [scale for _, _, scale in components(c)]


# The terms of the reward


def as_column(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def at(p, v=(0.0, 0.0, 0.0), yaw=0.0):
    """Returns one state (16, 1) at p with n_x turned by `yaw` from +x towards +y."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[P, 0], x[V, 0] = as_column(p), as_column(v)
    x[Q, 0] = as_column([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    return x


def terms(c, x=None, new_score=0.0, delta_v=0.0, torque=0.0, time=10.0, ended=()):
    """Returns every term as a float, for one spacecraft."""
    numbers = [as_column([number]) for number in (new_score, delta_v, torque, time)]
    flags = {name: torch.tensor([name in ended]) for name in ENDS}
    x = at((60.0, 0.0, 0.0)) if x is None else x
    return {name: term.item() for name, term in rewards(x, *numbers, flags, c).items()}


def drifting(days):
    """Returns the state after (negative: before) passing the chief's centre at 2 mm/s, drifting 37 m an orbit."""
    state = expm(A * days * 86400.0) @ [0.0, 0.0, 0.0, 0.0, 0.002, 0.0]
    return at(state[:3], state[3:])


def test_points_and_time_are_paid_and_thrust_and_torque_cost(c):
    found = terms(c, new_score=0.0375, delta_v=2.5, torque=0.003)
    assert found["points"] == 0.0375
    assert found["delta_v"] == pytest.approx(-0.05)  # two hundredths per m/s
    assert found["torque"] == pytest.approx(-0.0003)  # a tenth per N m
    assert [terms(c, time=time)["time"] for time in (10.0, 3000.0, 3010.0)] == [0.001, 0.001, 0.0]


@pytest.mark.parametrize(
    ("yaw", "expected"),  # the cosine between boresight and chief is -cos(yaw) for a deputy on +x
    [
        (math.pi, 0.0005),
        (math.radians(135), 0.0005 * math.exp(-(1 - math.sqrt(0.5)) / 0.15)),
        (math.radians(90.1), 0.0005 * math.exp(-(1 - 0.00174533) / 0.15)),
        (math.radians(89.9), 0.0),
    ],
)
def test_orientation_decays_with_misalignment(c, yaw, expected):
    found = terms(c, at((60.0, 0.0, 0.0), yaw=yaw))["orientation"]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-12)


B = 40.0  # m


@pytest.mark.parametrize(
    ("x", "changed", "expected"),
    [
        (at((0.0, 60.0, 0.0)), {}, 1.0),  # an equilibrium of the Clohessy-Wiltshire equations
        (at((B, 0.0, 0.0), (0.0, -2 * N * B, 0.0)), {}, 1.0),  # a closed ellipse, never nearer than 40 m
        (at((0.0, 0.0, 60.0), (0.0, 0.0, 0.05)), {}, -1.0),  # z'' = -n^2 z brings it back to the origin
        (at((0.0, 14.5, 0.0)), {}, -1.0),
        (at((0.0, 14.5, 0.0)), {"deputy_radius": 4.0}, 1.0),
        (drifting(-1.0), {}, -1.0),
        (drifting(-1.99), {}, -1.0),
        (drifting(-2.2), {}, 1.0),
        (drifting(1.0), {}, 1.0),
    ],
)
def test_success_is_rewarded_where_coasting_stays_clear_of_the_chief_for_two_days(c, x, changed, expected):
    assert terms(replace(c, **changed), x, ended={"success"})["success"] == expected


@pytest.mark.parametrize(
    ("term", "end"), [("crash", "crash"), ("distance", "out_of_bounds"), ("energy", "out_of_power")]
)
def test_a_failure_costs_one(c, term, end):
    failed = terms(c, ended={end})
    assert failed[term] == -1.0
    assert sum(failed[name] for name in ("success", "crash", "distance", "energy")) == -1.0


# The five terminal conditions


@pytest.mark.parametrize(
    ("changed", "end"),
    [
        ({"chief_radius": 56.0}, "crash"),
        ({"max_distance": 50.0}, "out_of_bounds"),
        ({"success_score": 0.4}, "success"),
        ({"max_time": 90.0}, "timeout"),
    ],
)
def test_thresholds_are_the_tasks_constants(c, changed, end):
    x = at((0.0, 60.0, 0.0))
    x[E] = 5.0
    assert OUTCOMES == ENDS  # in the order of their priority

    def found_by(c):
        return failures(x, c) | ends(as_column([0.5]), as_column([100.0]), c)

    assert not any(found_by(c).values())
    found = found_by(replace(c, **changed))
    assert [name for name, holds in found.items() if holds] == [end]


def test_free_flight_is_seen_where_an_integrated_one_passes_the_chief(c, random_states, generator):
    """Within 500 s, and within 40,000 s, over which it drifts along the track."""
    x, *rest = draw(random_states, generator, 10)
    x[P] *= 0.4
    x[V] *= 0.03
    c = replace(c, observed=("free_flight",), free_flight_horizon=40_000.0)
    seen = observe(x, *rest, c)
    lengths = seen.reshape(2, 3, 10).norm(dim=1)
    assert (lengths > 0.9).any() and (lengths < 0.2).any()
    for i in range(10):
        start, to_body = torch.cat((x[P, i], x[V, i])).numpy(), Rotation.from_quat(x[Q, i].numpy()).inv()
        for horizon, row in ((500.0, seen[:3, i]), (40_000.0, seen[3:, i])):
            times = np.linspace(0.0, horizon, round(2 * horizon) + 1)
            path = solve_ivp(
                lambda _, s: A @ s, (0.0, horizon), start, t_eval=times, rtol=1e-10, atol=1e-10
            ).y[:3]
            distance = np.linalg.norm(path, axis=0)
            assert 15.0 / row.norm() == pytest.approx(max(distance.min(), 7.5), abs=1.0)
            towards = to_body.inv().apply(row.numpy() / row.norm().item())
            there = path[:, distance < distance.min() + 1.0]  # some passes are as near as others
            assert (towards @ there / np.linalg.norm(there, axis=0)).max() > 0.97


def test_the_distance_from_the_track_is_that_of_three_integrated_orbits(c, random_states):
    x = random_states(20)
    x[V] *= 0.1
    found = distance_from_track(x, c)
    for i in range(20):
        start, orbit = torch.cat((x[P, i], x[V, i])).numpy(), 2 * math.pi / N
        times = np.linspace(0.0, 3 * orbit, 9001)
        path = solve_ivp(lambda _, s: A @ s, (0.0, 3 * orbit), start, t_eval=times, rtol=1e-10, atol=1e-10).y
        assert np.ptp(path[1]) > 10.0  # it drifts along the line all the while
        across = np.hypot(path[0], path[2])
        fastest = np.hypot(path[3], path[5]).max()
        assert -1e-6 < found[i] - across.min() + 1e-3 < fastest * orbit / (2 * PHASES) + 2e-3


def test_groups_are_left_out_or_added_whatever_order_they_are_named_in(c, random_states, generator):
    arguments = draw(random_states, generator, 4)
    groups = tuple(group for group in OBSERVABLE if group != "chief")  # which is of a chief that turns
    names = [name for name, _, _ in components(replace(c, observed=groups))]
    everything = dict(zip(names, observe(*arguments, replace(c, observed=groups)), strict=True))
    chosen = ("hill", "score", "sun")
    few = [name for name, _, _ in components(replace(c, observed=chosen))]
    assert few == ["sun_x", "sun_y", "sun_z", "sun_alignment", "inspected_score", *names[-12:-6]]
    for row, name in zip(observe(*arguments, replace(c, observed=chosen)), few, strict=True):
        assert torch.equal(row, everything[name])
    assert torch.equal(observe(*arguments, c), torch.stack(list(everything.values())[:26]))
    assert scales(arguments[0], replace(c, observed=chosen)).shape == (11, 1)


def test_the_axes_of_hills_frame_are_seen_in_the_body_frame(c, random_states, generator):
    arguments = draw(random_states, generator, 4)
    axes = observe(*arguments, replace(c, observed=("hill",)))
    for i, row in enumerate(axes.T.numpy()):
        to_body = Rotation.from_quat(arguments[0][Q, i].numpy()).inv().apply
        np.testing.assert_allclose(row, [*to_body([1, 0, 0]), *to_body([0, 1, 0])], rtol=0, atol=1e-12)
