"""The least of a barrier within errors, against the barrier itself at errors that were drawn at and within them."""

import dataclasses
from itertools import product

import pytest
import torch
from torch import Tensor

from inspection import THETA_S, InspectionParameters, P, Q, V, step
from inspection.chief.hull import beside
from inspection.model.attitude import dot, norm, unit
from inspection.model.draws import isotropic, random_quaternion
from inspection.model.orbit import coast
from inspection.model.state import THRUST
from rta import RtaParameters, Uncertainty
from rta.bounds.errors import Errors, Set, after
from rta.constraints.passes import strayed
from rta.constraints.thrust import thrust_constraints
from tests.inspection.chief.test_hull import MESHES, hull_of

C, R = InspectionParameters(), RtaParameters()
ELLIPSE = dataclasses.replace(C, orbit="two-body", eccentricity=0.3)
STATES, DRAWS = 64, 256
EXACT = 1e-9


def some_states(seed: int = 1, near: float = 16.0, far: float = 800.0) -> Tensor:
    """(16, STATES), as near to the chief as the task allows and as far, at up to 5 m/s."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.zeros(16, STATES, dtype=torch.float64)
    numbers = torch.rand(6, STATES, generator=generator, dtype=torch.float64)
    x[P] = near * (far / near) ** numbers[4] * isotropic(numbers[:2])
    x[V] = 5.0 * numbers[5] ** 3 * isotropic(numbers[2:4])
    x[Q], x[THETA_S] = random_quaternion(STATES, generator, x.dtype), 6.0 * numbers[0]
    return x


def errors(position: float, velocity: float, further: float, faster: float, impulse: float = 0.0) -> Errors:
    ball = torch.ones(STATES, dtype=torch.float64)
    return Errors(Set(position, further * ball), Set(velocity, faster * ball), impulse * ball)


def drawn(off: Set, seed: int) -> Tensor:
    """(3, DRAWS, STATES) of the set, half of them at the corners of the box, most on the ball's surface."""
    generator = torch.Generator().manual_seed(seed)
    box = 2.0 * torch.rand(3, DRAWS, STATES, generator=generator, dtype=torch.float64) - 1.0
    box[:, ::2] = box[:, ::2].sign()
    ball = isotropic(torch.rand(2, DRAWS, STATES, generator=generator, dtype=torch.float64))
    return off.box * box + off.ball * ball


def worlds(x: Tensor, off: Errors) -> Tensor:
    """(16, DRAWS, STATES) that states (16, STATES) may be."""
    true = x[:, None].repeat(1, DRAWS, 1)
    true[P] += drawn(off.position, 2)
    true[V] += drawn(off.velocity, 3)
    return true


def test_a_speed_along_the_radius_is_less_where_the_chief_is_seen_askew() -> None:
    """By hand: of 5 m/s at 100 m, from a place 20 m off at a right angle to where it is then, sin phi = 0.2."""
    x, one = torch.zeros(16, 1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    x[P.start], x[V.start] = 100.0, 5.0
    off = Errors(Set(0.0, 20.0 * one), Set(0.0, 0.0 * one))
    less = 5.0 * (1.0 - 0.96**0.5)
    assert less <= off.radial_speed(x).item() <= 2.0 * less


SMALL = (0.6, 0.006, 0.05, 0.002)
LARGE = (5.0, 0.1, 1.0, 0.05)


def test_the_longest_vector_of_a_box_and_a_ball_is_at_a_corner_of_it() -> None:
    off, a = Set(0.6, torch.full((STATES,), 0.2, dtype=torch.float64)), some_states()[P]
    corners = torch.tensor(list(product((-1.0, 1.0), repeat=3)), dtype=torch.float64).T
    at = a[:, None] + off.box * corners[..., None]
    longest = norm(at + off.ball * unit(at)).amax(0)
    torch.testing.assert_close(off.longest(a), longest, rtol=EXACT, atol=EXACT)
    n = unit(torch.randn(3, STATES, dtype=torch.float64, generator=torch.Generator().manual_seed(5)))
    least = (n[:, None] * (off.box * corners[..., None] - off.ball * n[:, None])).sum(0).amin(0)
    torch.testing.assert_close(off.support(n), -least, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("sizes", [SMALL, LARGE])
def test_distance_and_radial_speed_are_within_their_bounds_and_come_near_them(
    sizes: tuple[float, ...],
) -> None:
    x, off = some_states(), errors(*sizes)
    true = worlds(x, off)
    nearest, least = norm(true[P]).amin(0), off.least_distance(x)
    assert (least <= nearest + EXACT).all()
    radial = dot(true[V], true[P]) / norm(true[P])
    error = (radial - dot(x[V], x[P]) / norm(x[P])).abs().amax(0)
    assert (error <= off.radial_speed(x)).all()
    assert (error > 0.4 * off.radial_speed(x)).double().mean() > 0.9  # else it were worth little
    across = (norm(true[V]) ** 2 - radial**2).clamp(min=0.0).sqrt().amax(0)
    assert (across <= off.most_across(x) + EXACT).all()


@pytest.mark.parametrize("c", [C, ELLIPSE], ids=["circle", "ellipse"])
@pytest.mark.parametrize("seconds", [0.0, 60.0, 250.0, 500.0])
def test_a_free_flight_strays_by_no_more_than_its_bound(c: InspectionParameters, seconds: float) -> None:
    x, off, t = some_states(), errors(*SMALL), torch.tensor(seconds, dtype=torch.float64)
    expected, true = coast(x, t, c), coast(worlds(x, off), t, c)
    n = expected / norm(expected)
    bound = strayed(x, n, t, c, off)
    lost = (dot(n, expected) - dot(n[:, None], true)).amax(0)
    second_order = 1e-3 * bound  # of the exact tide
    assert (lost <= bound + (second_order if c is ELLIPSE else EXACT)).all()
    assert (lost > (0.2 if c is ELLIPSE else 0.6) * bound).double().mean() > 0.9


@pytest.mark.parametrize("c", [C, ELLIPSE], ids=["circle", "ellipse"])
@pytest.mark.parametrize("seconds", [1.0, 10.0])
@pytest.mark.parametrize("size", [0.0, 0.05])
def test_errors_after_a_hold_cover_where_worlds_get_to(
    c: InspectionParameters, seconds: float, size: float
) -> None:
    """The simulator flies each world, with a constant force that adds up to the impulse besides."""
    x, off = some_states(), errors(*(SMALL if size else (*SMALL[:2], 0.0, 0.0)))
    x[Q], x[Q.stop - 1] = 0.0, 1.0
    impulse = torch.full((STATES,), size, dtype=torch.float64)
    generator = torch.Generator().manual_seed(4)
    push = isotropic(torch.rand(2, DRAWS, STATES, generator=generator, dtype=torch.float64))
    force = torch.zeros(6, DRAWS * STATES, dtype=torch.float64)
    force[THRUST] = (c.mass * impulse / seconds * push).flatten(1)
    there = step(x, torch.zeros(6, STATES, dtype=torch.float64), seconds, c)[:, None]
    pushed = step(x[:, None].repeat(1, DRAWS, 1).flatten(1), force, seconds, c).reshape(16, DRAWS, STATES)
    true = step(worlds(x, off).flatten(1), force, seconds, c).reshape(16, DRAWS, STATES)
    later = after(off, seconds, c, impulse)
    # what the impulse adds to the velocity is in the rows' slopes
    for part, within, model in ((P, later.position, there), (V, later.velocity, pushed)):
        astray = true[part] - model[part]
        excess = (astray.abs() - within.box).clamp(min=0.0)
        assert (norm(excess) <= within.ball + EXACT).all()
        assert norm(excess).amax() > 0.3 * within.ball.amin()


@pytest.mark.parametrize("sizes", [SMALL, LARGE])
@pytest.mark.parametrize("i", range(7))
def test_a_least_barrier_is_below_the_barrier_in_every_world(i: int, sizes: tuple[float, ...]) -> None:
    known = Uncertainty(position=sizes[0], velocity=sizes[1])
    each = thrust_constraints(C, R, known)[i]
    x, off = some_states(), errors(*sizes)
    least = each.barrier_at(x, off=off)(x, off)
    true = worlds(x, off).flatten(1)
    barrier = each.barrier_at(true)(true).reshape(len(least), DRAWS, STATES).amin(1)
    refined = 0.3 if each.name == "passive_safety" else EXACT  # m, of a time between two points of a grid
    assert (least <= barrier + refined).all(), each.name
    assert (least - each.barrier_at(x)(x)).abs().median() < 4.0 * (
        barrier - each.barrier_at(x)(x)
    ).abs().median()


def test_an_impulse_across_the_velocity_breaks_no_limit_that_the_least_barrier_keeps() -> None:
    """At a speed that leaves the least barrier zero, any impulse that slopes do not see, which is across v."""
    x, impulse = some_states(), 0.05
    off = errors(0.0, 0.0, 0.0, 0.0, impulse)
    speed = thrust_constraints(C, R, Uncertainty(thrust_gain=0.5))[1]
    limit = C.docking_speed + C.speed_slope * norm(x[P])
    x[V] = (limit - impulse**2 / limit) * unit(x[V])
    torch.testing.assert_close(speed.barrier_at(x, off=off)(x, off)[0], 0.0 * limit, rtol=0.0, atol=1e-12)
    aside = unit(torch.stack(torch.linalg.cross(x[V], x[P], dim=0).unbind()))
    hit = x.clone()
    hit[V] += impulse * aside
    left = speed.h(hit)
    assert (left >= 0.0).all() and (left < impulse**2 / limit).all()
    assert (speed.h(hit) - speed.h(x) < -0.4 * impulse**2 / limit).all(), "else there were nothing to see"


def test_beside_a_hull_the_least_height_and_speed_are_those_of_its_planes() -> None:
    c = beside(C, hull_of(MESHES[0]))
    x, off = some_states(near=30.0, far=60.0), errors(*SMALL)
    for i in (0, 3):
        each = thrust_constraints(c, R, Uncertainty(position=SMALL[0], velocity=SMALL[1]))[i]
        least = each.barrier_at(x, off=off)(x, off).amin(0)
        true = worlds(x, off).flatten(1)
        barrier = each.barrier_at(true)(true).amin(0).reshape(DRAWS, STATES).amin(0)
        assert (least <= barrier + 1.0).all(), each.name  # m, its margin: a pass may be another
        assert least.median() > barrier.median() - 8.0 * SMALL[0]
