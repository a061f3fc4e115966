"""The 26 observations against the paper's list, recomputed one spacecraft at a time in numpy."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from inspection.observation import OBSERVATIONS, SIZE, observe, scales
from inspection.state import V


def recompute(x, priority, uninspected, score):
    """The paper's o, in its order, for one spacecraft."""
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


def test_observations_are_the_papers(random_states, generator):
    arguments = draw(random_states, generator, 8)
    o = observe(*arguments)
    expected = [recompute(*(a[..., i].numpy() for a in arguments)) for i in range(8)]
    np.testing.assert_allclose(o.T, expected, rtol=1e-12, atol=1e-12)


def test_at_rest_the_velocity_is_zero_and_nothing_is_nan(random_states, generator):
    x, *rest = draw(random_states, generator, 3)
    x[V] = 0.0
    o = observe(x, *rest)
    assert (o[4:8] == 0.0).all() and o.isfinite().all()


def test_no_uninspected_points_are_seen_as_zeros(random_states, generator):
    x, priority, _, score = draw(random_states, generator, 3)
    assert (observe(x, priority, torch.zeros(3, 3).double(), score)[21:25] == 0.0).all()


def test_alignment_is_one_where_the_deputy_is_under_the_sun(random_states, generator):
    x, *rest = draw(random_states, generator, 1)
    x[:3, 0] = 70.0 * torch.tensor([math.cos(x[15]), math.sin(x[15]), 0.0])
    np.testing.assert_allclose(observe(x, *rest)[16], 1.0, rtol=1e-7)


def test_names_are_in_the_papers_order():
    assert SIZE == 26
    names = [name for name, _, _ in OBSERVATIONS]
    assert names[0] == "position_norm" and names[4] == "velocity_norm"
    assert names[8:13] == [*(f"angular_velocity_{i}" for i in "xyz"), "energy", "temperature"]
    alignments = ["sun_alignment", "priority_alignment", "uninspected_alignment"]
    assert [names[i] for i in (16, 20, 24)] == alignments and names[25] == "inspected_score"


def test_units_are_those_of_the_state():
    units = dict.fromkeys((name for name, _, _ in OBSERVATIONS), "1")
    units |= {"position_norm": "m", "velocity_norm": "m/s", "energy": "kJ", "temperature": "deg C"}
    units |= {f"angular_velocity_{i}": "rad/s" for i in "xyz"}
    assert {name: unit for name, unit, _ in OBSERVATIONS} == units


def test_scales_divide_by_the_size_of_each_quantity():
    divisors = scales(torch.zeros(1, dtype=torch.float64))[:, 0].tolist()
    assert divisors == [100, 1, 1, 1, 0.866, 1, 1, 1, 0.035, 0.035, 0.035, 10, 10] + [1] * 13


def test_normalised_observations_of_flight_are_within_a_few_units(random_states, generator):
    o = observe(*draw(random_states, generator, 200))
    assert (o / scales(o)).abs().max() <= 4.0  # at 400 m
