"""Rows of what a held control does: against scipy's flight of the paper's equations and against worlds flown.

Where worlds are drawn they are `inspection.world.plant`'s, whose tests are tests/inspection/world/test_plant.py.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.integrate import cumulative_trapezoid, solve_ivp
from torch import Tensor

from inspection.model.attitude import norm, rotation_matrix, turned_by
from inspection.model.dynamics import integrate, step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, THRUST, TORQUE, P, Q, V
from inspection.world.parameters import PlantParameters
from inspection.world.plant import Plant
from rta.bounds.uncertainty import Uncertainty
from rta.conditions.held_rows import KINDS, HeldGroup
from rta.conditions.prediction import predicted
from rta.conditions.rows import Rows
from rta.constraints.thrust import chord, thrust_constraints
from rta.constraints.torque import torque_constraints
from rta.parameters import RtaParameters
from tests.inspection.model.test_dynamics import paper_rate
from tests.inspection.world.test_plant import begun, moments
from tests.rta.constraints.test_constraints import clearance, keep_in_curve, length, root, speed_limit, tensor
from tests.rta.test_filter import LIMIT, commands, near_the_limits

C = InspectionParameters()
RATE = math.radians(2.0)


def group(by: str, period: float = 1.0, c: InspectionParameters = C, **told: Any) -> HeldGroup:
    r, known = RtaParameters(period=period), Uncertainty(**told)
    constraints = (*thrust_constraints(c, r, known), *torque_constraints(c, r, known))
    return HeldGroup(by, constraints, c, r, known)


def rows_at(held: HeldGroup, x: Tensor, u: Tensor) -> Rows:
    """The tangents before any is softened where a constraint is violated."""
    return held.conditions_at(x, u, torch.zeros_like(x[:KINDS]), held.constraints, coupled=False)


def left_hand_side(held: HeldGroup, rows: Rows, u: Tensor) -> Tensor:
    """a u + b, (R, B)."""
    return (rows.a * u[held.controls]).sum(1) + rows.b


def places(held: HeldGroup) -> list[tuple[str, int]]:
    """The constraint of each row, and which of its own it is, moments beside each other."""
    return [(each.name, i) for each in held.constraints for i in range(each.rows) for _ in held.moments]


# what a row says of the model


def flown(x: ndarray, u: ndarray, seconds: float) -> ndarray:
    """The paper's equations of motion of each column by DOP853, without saturation."""
    ends = [
        solve_ivp(
            lambda _, y, u=u[:, i]: paper_rate(y, u, C.inertia), (0, seconds), x[:, i], "DOP853", rtol=1e-11
        )
        for i in range(x.shape[1])
    ]
    assert all(end.success for end in ends)
    return np.stack([end.y[:, -1] for end in ends], 1)


def paper_psi(name: str, i: int, x: ndarray, period: float, after: float = 0.0) -> ndarray:
    """The barrier of a row by the paper's numbers, so many s into a hold, (B,)."""
    floor = chord(C, RtaParameters(period=period))
    if name == "collision":
        return root(length(x[:3]) - 15, floor) + (x[:3] * x[3:6]).sum(0) / length(x[:3])
    if name == "dynamic_speed":
        return speed_limit(x) - length(x[3:6])
    if name == "keep_in_zone":
        return keep_in_curve(x, floor)
    if name == "passive_safety":
        edges = (0.0, 60.0, 160.0, 300.0, 420.0, 500.0 + period)
        return clearance(x, tuple(max(edge - after, 0.0) for edge in edges))[i]
    axis = "xyz".index(name[-1])
    if name.startswith("angular"):
        return RATE + (-1, 1)[i] * x[10 + axis]
    return 25 - x[3 + axis] ** 2


GAINS = {"collision": 0.1, "dynamic_speed": 0.5, "keep_in_zone": 0.1, "passive_safety": 0.03} | {
    **{f"velocity_{i}": 0.2 for i in "xyz"},
    **{f"angular_velocity_{i}": 0.5 for i in "xyz"},
}
MARGINS = {"collision": 0.02, "keep_in_zone": 0.02, "passive_safety": 1.0}


def conditions(held: HeldGroup, x: ndarray, u: ndarray, curvatures: bool = True) -> dict[int, ndarray]:
    """By row: (psi(phi_t(x, u)) - psi(x)) / t + alpha(psi(x)), less what psi sags between the moments."""
    period, found = held.r.period, {}
    times = sorted({0.0, *held.moments, *(t - held.moments[0] / 2 for t in held.moments)})
    there = {t: flown(x, u, t) if t else x for t in times}
    for row, (name, i) in enumerate(places(held)):
        if name not in GAINS:
            continue
        moment = row % len(held.moments)
        t, step = held.moments[moment], held.moments[0]
        psi = {time: paper_psi(name, i, there[time], period, time) for time in times}
        gain = GAINS[name] * (1 + (psi[0.0] / 30) ** 2 if name == "passive_safety" else 1)
        gain = np.minimum(gain, 0.5 / period)
        curvature = np.maximum((psi[t] + psi[t - step]) / 2 - psi[t - step / 2], 0)
        if name == "passive_safety":
            curvature = 0.0
        lost = curvatures * np.maximum(4 * curvature - psi[t - step] - (1 - gain * t) * psi[0.0], 0) / t
        margin = (
            2 * 5 / 12 * period if name.startswith("velocity") else MARGINS.get(name, 0)
        )  # 1 N on 12 kg at 5 m/s
        found[row] = (psi[t] - psi[0.0]) / t + gain * (psi[0.0] - margin) - lost
    return found


def some_states(count: int, seed: int = 0) -> ndarray:
    x = near_the_limits(count, seed)
    x[3:6] *= 0.8
    return x


def some_controls(count: int, seed: int = 0) -> ndarray:
    """With torque that keeps a body's turn over 10 s in sight of one step of the model."""
    u = commands(count, seed).numpy()
    u[3:] *= 0.1
    return u


@pytest.mark.parametrize("period", [1.0, 10.0])
@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_a_row_at_its_control_is_what_that_control_does(by: str, period: float) -> None:
    held = group(by, period, saturates_rates=False)
    x, u = some_states(4), some_controls(4)
    rows = rows_at(held, tensor(x), tensor(u))
    found = left_hand_side(held, rows, tensor(u)).numpy()
    still = u.copy()
    still[THRUST] = 0.0
    expected, coasting = conditions(held, x, u), conditions(held, x, still)
    assert len(expected) == {"thrust": 11, "torque": 6}[by] * len(held.moments)
    for row, value in expected.items():
        name = places(held)[row][0]
        if name == "passive_safety":  # of coasting
            np.testing.assert_allclose(rows.b[row].numpy(), coasting[row], rtol=0, atol=2e-4)
        else:
            np.testing.assert_allclose(found[row], value, rtol=0, atol=2e-5)
    # of another control they say something else
    other = conditions(held, x, 0.9 * u)
    assert all((np.abs(other[row] - expected[row]) > 1e-5).any() for row in expected)


@pytest.mark.parametrize("period", [1.0, 10.0])
@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_a_rows_slope_is_the_finite_difference(by: str, period: float) -> None:
    """But for what the turn of Hill's frame adds to a position, a share of n t."""
    held = group(by, period, saturates_rates=False)
    x, u = some_states(2, seed=1), some_controls(2, seed=1)
    rows = rows_at(held, tensor(x), tensor(u))
    for j in range(3):
        shift = np.zeros((6, 1))
        shift[held.controls.start + j] = 1e-3 * LIMIT[held.controls.start].item()
        more, less = (conditions(held, x, u + sign * shift, curvatures=False) for sign in (1, -1))
        for row in more:
            if places(held)[row][0] == "passive_safety":
                continue
            slope = (more[row] - less[row]) / (2 * shift.sum())
            scale = max(np.abs(slope).max(), 1e-3)
            within = (1e-4 + C.mean_motion * period) * scale
            np.testing.assert_allclose(rows.a[row, j].numpy(), slope, rtol=0, atol=within)


@pytest.mark.parametrize("eccentricity", [0.0, 0.3])
def test_a_slope_has_the_turn_of_hills_frame_where_the_chief_is(eccentricity: float) -> None:
    """That of v_max^2 - v_i^2 by the thrust of 10 s, at perigee and at apogee, to a share of (n t)^2."""
    c = replace(C, orbit="two-body", eccentricity=eccentricity, saturate_rates=False)
    held = group("thrust", 10.0, c, saturates_rates=False)
    x, u = tensor(some_states(2, seed=1)), tensor(some_controls(2, seed=1))
    x[15] = torch.tensor([0.0, math.pi]).double()
    a, shift = rows_at(held, x, u).a, 1e-3 * torch.eye(6).double()
    for j in range(3):
        more, less = (integrate(x, u + sign * shift[:, [j]], 1.0, c, 10) for sign in (1, -1))
        slope = (less[V] ** 2 - more[V] ** 2) / 2e-3 / 10.0
        rows = [
            row
            for row, (name, _) in enumerate(places(held))
            if name.startswith("velocity") and row % len(held.moments) == len(held.moments) - 1
        ]
        within = 5e-4 * slope.abs().amax(0)
        assert ((a[rows, j] - slope).abs() < within).all()


# what rows take off for worlds that are not the model

WORLDS = 600
U1 = {
    "mass": 0.1,
    "inertia": 0.15,
    "acceleration": 1e-5,
    "saturates_rates": False,
    "hill_rotation": True,
    "thrust_gain": 0.05,
    "torque_gain": 0.05,
    "thrust_misalignment": 1.0,
    "position": 0.6,
    "velocity": 0.006,
    "attitude": 0.3,
    "rate": 0.03,
}


def world(told: dict[str, Any]) -> PlantParameters:
    """Every world that is within these bounds."""
    given: dict[str, Any] = {"saturate_rates": False, "noise_bound": 1.0}
    for name, value in told.items():
        if name in ("mass", "inertia", "thrust_gain", "torque_gain"):
            given[name if name.endswith("gain") else f"{name}_factor"] = (1 - value, 1 + value)
        elif name in ("position", "velocity", "attitude", "rate"):
            given[f"{name}_noise"] = value  # most of it at one sigma, where it is clipped
        elif name in ("thrust_misalignment", "acceleration", "hill_rotation"):
            given[name] = value
    return PlantParameters(**given)


def relative(plant: Plant, x: Tensor) -> Tensor:
    """States with the rates relative to Hill's frame, as the filter wants them."""
    if not plant.parameters.hill_rotation:
        return x
    turning = rotation_matrix(x[Q])[2] * C.mean_motion
    return torch.cat((x[: OMEGA.start], x[OMEGA] - turning, x[OMEGA.stop :]))


def broken(held: HeldGroup, told: dict[str, Any]) -> set[str]:
    """The constraints whose condition truly is below what its rows say, in some of many worlds within the bounds.

    That of a least barrier is on what psi truly is at the end, from the least that it may be now, which must not be
    above what it truly is. By more than the second order, a share of what the rows take off. Where a barrier is
    positive, since beyond it has kinks; passive safety's closest pass moves, which its margin is for.
    """
    x, u = tensor(some_states(WORLDS, seed=4)), tensor(some_controls(WORLDS, seed=4))
    x[OMEGA] *= 0.5
    plant = begun(world(told), WORLDS, seed=5, c=C)
    now, seen = relative(plant, x), plant.sense(moments(WORLDS), x)
    rows = rows_at(held, seen, u)
    said = left_hand_side(held, rows, u)
    psi = held.psi_at(now, held.constraints)(now)
    of_row = [each for each in held.constraints for _ in range(each.rows)]
    least = rows.psi.unflatten(0, (-1, len(held.moments)))[:, 0]
    is_least = torch.tensor([held.is_least(each) for each in of_row])[:, None]
    nearest = torch.tensor([each.later is not None for each in of_row])[:, None]  # whose time is refined
    above = (
        (is_least & (least > psi + torch.where(nearest, 0.1, 1e-9)))
        .any(1)
        .repeat_interleave(len(held.moments))
    )
    psi = torch.where(is_least, least, psi)
    gain, margin, _ = held.alpha(psi, of_row)
    y, conditions = x, []
    for sooner, later in zip((0.0, *held.moments), held.moments, strict=False):
        acting = plant.actuate(moments(WORLDS), u)
        y = plant.integrate(y, acting, plant.body, 0.5, round(2 * (later - sooner)))
        end = relative(plant, y)
        at_end = held.psi_at(end, held.constraints, now, later)(end)
        conditions.append((at_end - psi) / later + gain * (psi - margin))
    within = [rows.h[i] > 0.0 for i, each in enumerate(held.constraints) for _ in range(held.count(each))]
    positive = (rows.psi > 0.0) & torch.stack(within)
    over = (torch.stack(conditions, 1).flatten(0, 1) - said).masked_fill(~positive, math.inf)
    assert (positive.sum(1) > WORLDS / 20).all()
    second_order = 2e-5 + 0.02 * rows.tightening.masked_fill(~positive, 0.0).amax(1)
    beyond = ((over.amin(1) < -second_order) | above).tolist()
    return {name for (name, _), is_beyond in zip(places(held), beyond, strict=True) if is_beyond} - {
        "passive_safety"
    }


THRUST_ROWS = {"collision", "dynamic_speed", "keep_in_zone", "velocity_x", "velocity_y", "velocity_z"}
RATE_ROWS = {f"angular_velocity_{i}" for i in "xyz"}
CASES = [  # what is told, who holds, what the plant of a filter without it would break
    ({"mass": 0.1, "thrust_gain": 0.05}, "thrust", {"less": 0.0}, THRUST_ROWS),
    ({"mass": 0.1}, "thrust", {"more": 0.0}, THRUST_ROWS),
    ({"thrust_misalignment": 5.0}, "thrust", {"angle_at_rest": 0.0}, THRUST_ROWS),
    ({"acceleration": 1e-3}, "thrust", {"push": 0.0}, THRUST_ROWS),
    (
        {"position": 0.6},
        "thrust",
        {"known": Uncertainty(position=1e-9)},
        {"collision", "dynamic_speed", "keep_in_zone"},
    ),
    ({"velocity": 0.006}, "thrust", {"known": Uncertainty(velocity=1e-9)}, THRUST_ROWS),
    ({"attitude": 0.3, "rate": 0.03}, "thrust", {"angle_at_rest": 0.0}, {"collision"}),
    ({"torque_gain": 0.05}, "torque", {"less": 0.0, "more": 0.0}, RATE_ROWS),
    ({"attitude": 0.3}, "torque", {"measured": (0.0,) * KINDS}, {"attitude_exclusion"}),
    ({"rate": 0.03}, "torque", {"measured": (0.0,) * KINDS}, RATE_ROWS),
    ({"hill_rotation": True}, "torque", {"push": 0.0}, RATE_ROWS),
]


@pytest.mark.parametrize(("told", "by", "planted", "breaks"), CASES, ids=[str([*case[0]]) for case in CASES])
def test_rows_hold_in_every_world_within_the_bounds_and_no_term_can_go(
    told: dict[str, Any], by: str, planted: dict[str, Any], breaks: set[str]
) -> None:
    held = group(by, **told)
    assert broken(held, told) == set()
    for name, value in planted.items():
        setattr(held, name, value)
    assert broken(held, told) >= breaks


def test_thrust_along_a_row_is_counted_on_for_no_more_than_its_cosine() -> None:
    held = group("thrust", attitude=10.0)
    x, u = torch.zeros(16, 1, dtype=torch.float64), torch.zeros(6, 1, dtype=torch.float64)
    x[P.start], x[V.start], x[Q.stop - 1], u[0] = 300.0, 4.9, 1.0, -1.0
    i = places(held).index(("velocity_x", 0))
    said = left_hand_side(held, rows_at(held, x, u), u)[i]
    turned = x.clone()
    turned[Q] = turned_by(x[Q], torch.tensor([[0.0], [10.0], [10.0]], dtype=torch.float64).deg2rad())
    psi = held.psi_at(turned, held.constraints)
    gain, margin, _ = held.alpha(psi(turned), held.of_row)
    given = psi(step(turned, u, 1.0, C)) - psi(turned) + gain * (psi(turned) - margin)
    assert said <= given[i] < said + 0.05 * abs(said)


@pytest.mark.parametrize("more", [{}, {"longest_hold": 3.0}, {"period": 10.0}], ids=str)
@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_rows_hold_with_everything_at_once(by: str, more: dict[str, Any]) -> None:
    assert broken(group(by, **U1, **more), U1) == set()


# a hold that ends sooner than the longest


def broken_on_the_way(held: HeldGroup, told: dict[str, Any]) -> set[str]:
    """The constraints whose barrier truly is negative at some second of a hold of which the rows say that they hold.

    Passive safety's holds with those of the others only.
    """
    count = 5 * WORLDS
    x, u = tensor(some_states(count, seed=8)), commands(count, 8).sign()
    x[V] *= torch.linspace(0.9, 1.0, count) * tensor(speed_limit(x.numpy())) / norm(x[V])
    x[OMEGA], u[TORQUE] = RATE * x[OMEGA].sign(), 0.0  # thrust turns most, and with it the path
    plant = begun(world(told), count, seed=9, c=C)
    now, seen = relative(plant, x), plant.sense(moments(count), x)
    rows = rows_at(held, seen, u)
    says = (left_hand_side(held, rows, u) >= 0.0) & (rows.psi > 0.0)
    fine = says.unflatten(0, (-1, len(held.moments))).all(1)
    assert (fine.sum(1) > WORLDS / 20).all()
    acting, y, least = plant.actuate(moments(count), u), x, torch.full(fine.shape, math.inf).to(x)
    for second in range(1, round(held.moments[-1]) + 1):
        y = plant.integrate(y, acting, plant.body, 0.5, 2)
        end = relative(plant, y)
        least = least.minimum(held.psi_at(end, held.constraints, now, second)(end))
    below = (least.masked_fill(~fine, math.inf) < -1e-4).any(1).tolist()
    names = [each.name for each in held.constraints for _ in range(each.rows)]
    return {name for name, is_below in zip(names, below, strict=True) if is_below} - {"passive_safety"}


@pytest.mark.parametrize(("told", "breaks"), [({}, {"collision"}), (U1, set())], ids=["model", "U1"])
def test_a_hold_may_end_at_any_second(
    told: dict[str, Any], breaks: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    held = group("thrust", **told, longest_hold=10.0)
    assert broken_on_the_way(held, told) == set()
    after = held.after

    def straight(*given: Any) -> tuple[Tensor, ...]:
        psi, curvature, *slopes = after(*given)
        return psi, torch.zeros_like(curvature), *slopes

    monkeypatch.setattr(held, "after", straight)
    assert broken_on_the_way(held, told) >= breaks  # where bounds come off that is enough


def test_an_error_exceeds_its_chord_between_two_moments_by_no_more_than_is_said() -> None:
    """Of thrust along an axis of a body that turns as fast as it may, and of thrust across that axis."""
    held = group("thrust", longest_hold=10.0)
    rng, fine = np.random.default_rng(0), 100  # samples of each gap
    slope, axis = (part / length(part) for part in rng.normal(size=(2, 3, 2000)))
    s = np.linspace(0.0, held.moments[-1], fine * len(held.moments) + 1)
    angle = math.sqrt(3.0) * RATE * s[:, None, None]
    along = axis * (axis * slope).sum(0)  # Rodrigues' formula
    seen = along + np.cos(angle) * (slope - along) - np.sin(angle) * np.cross(axis, slope, axis=0)
    moved = cumulative_trapezoid(seen, s, axis=0, initial=0.0)
    for error in (np.abs(moved[:, 0]), np.hypot(moved[:, 1], moved[:, 2])):
        for gap, (end, bulge) in enumerate(zip(held.moments, held.bulge, strict=True)):
            part = error[gap * fine : (gap + 1) * fine + 1]
            share = np.linspace(0.0, 1.0, fine + 1)[:, None]
            excess = (part - (1 - share) * part[0] - share * part[-1]).max()
            assert 0.5 * bulge * end < excess <= bulge * end


# the state of now, from one that is some calls old


def now_of(x: Tensor, sent: Tensor, r: RtaParameters, known: Uncertainty) -> tuple[Tensor, Tensor]:
    """The states of now and their error_bound from those that are as many calls old as controls were sent since."""
    error_bound = torch.zeros_like(x[:KINDS])
    for u in sent:
        x, error_bound = predicted(x, error_bound, u, C, r, known)
    return x, error_bound


def escaped(told: dict[str, Any], period: float, calls: int) -> list[float]:
    """By how much position, velocity, attitude and rates are off beyond what `predicted` says, at the worst."""
    plant = begun(world(told), WORLDS, seed=6, c=C)
    x = tensor(some_states(WORLDS, seed=6))
    x[OMEGA] *= 0.3
    sent = torch.stack([tensor(some_controls(WORLDS, seed=7 + i)) for i in range(calls)])
    seen = plant.sense(moments(WORLDS), x)
    for u in sent:
        x = plant.integrate(x, plant.actuate(moments(WORLDS), u), plant.body, 0.5, round(2 * period))
    now = relative(plant, x)
    r, known = RtaParameters(period=period), Uncertainty(latency=calls, **told)
    there, error_bound = now_of(seen, sent, r, known)

    def beyond(off: Tensor, measured: float) -> Tensor:
        return norm((off.abs() - measured).clamp(min=0.0))

    turned = 2 * torch.linalg.vecdot(now[Q].T, there[Q].T).abs().clamp(max=1.0).arccos()
    off = (
        beyond(now[P] - there[P], known.position),
        beyond(now[V] - there[V], known.velocity),
        turned - math.sqrt(3) * math.radians(known.attitude),
        beyond(now[OMEGA] - there[OMEGA], math.radians(known.rate)),
    )
    return [(each - bound).max().item() for each, bound in zip(off, error_bound, strict=True)]


ROUNDING = (5e-3, 5e-4, 2e-4, 1e-9)  # m, m/s, rad, rad/s: of one step of 10 s


@pytest.mark.parametrize(
    ("told", "kinds"),
    [
        ({"mass": 0.1, "thrust_gain": 0.05}, (0, 1)),
        ({"acceleration": 1e-3}, (0, 1)),
        ({"velocity": 0.006}, (0,)),
        ({"inertia": 0.15, "torque_gain": 0.05}, (2, 3)),
        ({"rate": 0.03}, (2,)),
        (U1, (0, 1)),
    ],
    ids=lambda value: str([*value]),
)
@pytest.mark.parametrize(("period", "calls"), [(1.0, 1), (1.0, 3), (10.0, 1)])
def test_the_truth_is_within_what_is_said_of_a_predicted_state(
    told: dict[str, Any], kinds: tuple[int, ...], period: float, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = escaped(told, period, calls)
    assert all(found[kind] <= ROUNDING[kind] for kind in kinds)
    # without what is said beyond the measurement's error it is not
    monkeypatch.setattr("tests.rta.conditions.test_held_rows.predicted", lambda *given: without_bound(*given))
    found = escaped(told, period, calls)
    assert all(found[kind] > 0.0 for kind in kinds)


def without_bound(*given: Any) -> tuple[Tensor, Tensor]:
    there, error_bound = predict(*given)
    return there, torch.zeros_like(error_bound)


predict = predicted


def test_a_predicted_velocity_is_off_by_what_thrust_does_in_another_attitude() -> None:
    """By hand: a body at rest, turned by the largest error across its thrust, F / m 2 sin(angle / 2) T."""
    x, u = torch.zeros(16, 1, dtype=torch.float64), torch.zeros(6, 1, dtype=torch.float64)
    x[P.start], x[Q.stop - 1], u[0] = 100.0, 1.0, C.max_thrust
    angle = math.sqrt(3.0) * math.radians(3.0)
    _, bound = predicted(x, torch.zeros(KINDS, 1).double(), u, C, RtaParameters(), Uncertainty(attitude=3.0))
    off = C.max_thrust / C.mass * 2.0 * math.sin(angle / 2.0)
    assert off <= bound[1].item() <= 1.01 * off


def test_a_younger_state_is_not_predicted_on() -> None:
    x, u = tensor(some_states(3)), tensor(some_controls(3))
    sent = torch.stack((u, u))
    sent[0, :, 1:] = math.nan
    sent[1, :, 2] = math.nan
    r, known = RtaParameters(), Uncertainty(latency=2, mass=0.1)
    there, error_bound = now_of(x, sent, r, known)
    for column, calls in ((0, 2), (1, 1), (2, 0)):
        own = [part[:, column : column + 1] for part in (x, u)]
        alone = now_of(own[0], own[1].expand(calls, -1, -1), r, known)
        assert torch.equal(there[:, column : column + 1], alone[0])
        assert torch.equal(error_bound[:, column : column + 1], alone[1])
    expected = flown(x.numpy()[:, :1], u.numpy()[:, :1], 2.0)
    np.testing.assert_allclose(there[:, :1].numpy(), expected, rtol=0, atol=1e-5)
    assert (error_bound[:, 2] == 0.0).all() and (error_bound[:2, 0] > error_bound[:2, 1]).all()


@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_the_tightened_level_is_where_alpha_is_the_doubt(by: str) -> None:
    held = group(by, position=0.6, velocity=0.006)
    tightening = torch.logspace(-6, 1, 40, dtype=torch.float64).expand(len(held.constraints), -1)
    for each, own, asked in zip(held.constraints, held.tightened(tightening), tightening, strict=True):
        psi = own * held.gain(each.gains[0]) if each.degree == 2 else own
        gain = held.gain(each.gains[-1]) * (1 + (psi / each.doubling) ** 2)
        torch.testing.assert_close(gain.clamp(max=held.gain(math.inf)) * psi, asked)
