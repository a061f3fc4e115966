"""Sampled rows: against scipy's flight of the paper's equations, and against the paper's rows where a hold is short."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.integrate import solve_ivp
from torch import Tensor

from inspection.model.attitude import rotated_by
from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, THRUST, TORQUE
from rta.barrier import ActuatorGroup, Rows
from rta.bounds.uncertainty import Uncertainty
from rta.constraints.constraint import Constraint
from rta.constraints.thrust import sqrt_floor, thrust_constraints
from rta.constraints.torque import torque_constraints
from rta.parameters import RtaParameters
from tests.inspection.model.test_dynamics import paper_rate
from tests.oracles import clearance, keep_in_curve, length, root, speed_limit, tensor
from tests.rta.test_filter import LIMIT, commands, near_the_limits

C = InspectionParameters()
RATE = math.radians(2.0)


def group(by: str, period: float = 10.0, extra: tuple[Constraint, ...] = (), **bounds: Any) -> ActuatorGroup:
    r, uncertainty = RtaParameters(period=period, rows="sampled"), Uncertainty(**bounds)
    constraints = (*thrust_constraints(C, r, uncertainty), *torque_constraints(C, r, uncertainty), *extra)
    return ActuatorGroup(by, constraints, C, r, uncertainty)


def unsoftened(group: ActuatorGroup, x: Tensor, u: Tensor) -> Rows:
    """The tangents before any is softened where a constraint is violated."""
    return group.sampled_rows(x, u, group.constraints, coupled=False)


def places(group: ActuatorGroup) -> list[tuple[str, int]]:
    """The constraint of each row, and which of its own it is."""
    return [(each.name, i) for each in group.constraints for i in range(each.rows)]


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
    floor = sqrt_floor(C, RtaParameters(period=period))
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


def some_states(count: int, seed: int = 0) -> ndarray:
    x = near_the_limits(count, seed)
    x[3:6] *= 0.8
    return x


def some_controls(count: int, seed: int = 0) -> ndarray:
    """With torque that keeps a body's turn over 10 s in sight of one step of the model."""
    u = commands(count, seed).numpy()
    u[3:] *= 0.1
    return u


def conditions(group: ActuatorGroup, x: ndarray, u: ndarray) -> dict[int, ndarray]:
    """By row whose barrier is in closed form: (psi(phi_T(x, u)) - psi(x)) / T + alpha(psi(x))."""
    period, found = group.r.period, {}
    end = flown(x, u, period)
    for row, (name, i) in enumerate(places(group)):
        if name in GAINS:
            before, after = paper_psi(name, i, x, period), paper_psi(name, i, end, period, period)
            gain = GAINS[name] * (1 + (before / 30) ** 2 if name == "passive_safety" else 1)
            margin = (
                2 * 5 / 12 * period if name.startswith("velocity") else MARGINS.get(name, 0)
            )  # 1 N, 12 kg
            found[row] = (after - before) / period + np.minimum(gain, 0.5 / period) * (before - margin)
    return found


@pytest.mark.parametrize("period", [5.0, 10.0])
@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_a_row_at_its_control_is_what_that_control_does(by: str, period: float) -> None:
    own = group(by, period)
    x, u = some_states(6), some_controls(6)
    rows, expected = unsoftened(own, tensor(x), tensor(u)), conditions(own, x, u)
    assert len(expected) == {"thrust": 11, "torque": 6}[by]
    found = ((rows.a * tensor(u)[own.controls]).sum(1) + rows.b).numpy()
    for row, value in expected.items():
        within = (
            2e-3 if places(own)[row][0] == "passive_safety" else 2e-6
        )  # whose grid is refined by a parabola
        np.testing.assert_allclose(found[row], value, rtol=0, atol=within)


@pytest.mark.parametrize("by", ["thrust", "torque"])
def test_a_rows_slope_is_the_finite_difference(by: str) -> None:
    own = group(by)
    x, u = some_states(4, seed=1), some_controls(4, seed=1)
    rows = unsoftened(own, tensor(x), tensor(u))
    for j in range(3):
        shift = np.zeros((6, 1))
        shift[own.controls.start + j] = 1e-3 * LIMIT[own.controls.start].item()
        more, less = (conditions(own, x, u + sign * shift) for sign in (1, -1))
        for row in more:
            slope = (more[row] - less[row]) / (2 * shift.sum())
            within = (0.02 if places(own)[row][0] == "passive_safety" else 1e-4) * max(
                np.abs(slope).max(), 1e-3
            )
            np.testing.assert_allclose(rows.a[row, j].numpy(), slope, rtol=0, atol=within)


def test_the_tangent_is_near_what_the_rates_permit() -> None:
    """Full torque for 10 s would turn a body by 50 deg."""
    own, x, u = group("torque"), tensor(some_states(20)), commands(20).sign()
    u[TORQUE] *= LIMIT[TORQUE]
    near = own.near(x, u)
    rate = x[OMEGA] + own.hold * near[TORQUE] / tensor(np.array(C.inertia))[:, None]
    assert (rate.abs() <= x[OMEGA].abs().clamp(min=RATE) + 1e-12).all()
    assert torch.equal(near[THRUST], u[THRUST]) and (near[TORQUE].abs() < u[TORQUE].abs()).all()
    assert torch.equal(own(x, u).a, own(x, near).a)


def test_of_a_constraint_that_the_other_group_changes_its_worst_comes_off() -> None:
    nose = Constraint("nose", lambda x: x[6] * x[3] + 9.0 * x[10] * x[4] + x[5], "thrust", (0.02,))
    own, x, u = group("thrust", extra=(nose,)), tensor(some_states(10)), tensor(some_controls(10))
    row = own.sampled_rows(x, u, [nose], coupled=True)
    free, limit, hold = replace(C, saturate_rates=False), tensor(LIMIT), own.hold

    def after(u: Tensor) -> Tensor:
        return nose.h(integrate(x, u, hold / 4, free, 4)) / hold

    shifts = [1e-4 * limit * torch.eye(6).double()[:, [j]] for j in range(6)]
    a = torch.stack([(after(u + each) - after(u - each)) / (2 * each.sum()) for each in shifts])
    assert (a[TORQUE].abs() * limit[TORQUE]).amax() > 1e-4
    b = after(u) + (0.02 - 1 / hold) * nose.h(x) - (a * u).sum(0) - (a[TORQUE].abs() * limit[TORQUE]).sum(0)
    torch.testing.assert_close(row.a[0], a[THRUST], rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(row.b[0], b, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("by", "draws"),
    [("thrust", 20), *(pytest.param(by, 300, marks=pytest.mark.campaign) for by in ("thrust", "torque"))],
)
def test_where_no_check_is_known_rows_take_off_what_is_not_known(by: str, draws: int) -> None:
    """The condition in any state and under any thrust or torque within the bounds, where a row of the model sees it."""
    bounds = {
        "position": 0.3,
        "velocity": 0.02,
        "attitude": 0.2,
        "rate": 0.02,
        "thrust_gain": 0.02,
        "torque_gain": 0.02,
    }
    uncertainty, generator = Uncertainty(**bounds), np.random.default_rng(0)
    own = group(by, 5.0)
    tight = ActuatorGroup(by, own.constraints, C, own.r, uncertainty, checked=False)
    model = ActuatorGroup(by, own.constraints, C, own.r, uncertainty)
    x = tensor(some_states(60))
    u = 0.5 * tensor(commands(60, 3) * LIMIT)

    def least(group: ActuatorGroup, x: Tensor, asked: Tensor, given: Tensor) -> Tensor:
        """The left-hand sides, before any is softened, of controls `given`, by tangents at `asked`."""
        rows = [
            part for coupled in (False, True)
            if (part := [each for each in group.constraints if each.coupled == coupled])
        ]  # fmt: skip
        sides = []
        for coupled, constraints in zip((False, True), rows, strict=False):
            found = group.sampled_rows(x, group.near(x, asked), constraints, coupled)
            sides.append((found.a * given[group.controls]).sum(1) + found.b)
        return torch.cat(sides)

    robust_least, lowest = least(tight, x, u, u), torch.full_like(least(model, x, u, u), math.inf)
    for _ in range(draws):
        away = [generator.standard_normal((3, 60)) for _ in range(6)]
        p, v, turn, rate, thrust, torque = (tensor(part / length(part)) for part in away)
        y = x.clone()
        y[:3] += uncertainty.radii[0] * p
        y[3:6] += uncertainty.radii[1] * v
        y[6:10] = rotated_by(x[6:10], uncertainty.radii[2] * turn)
        y[OMEGA] += uncertainty.radii[3] * rate
        given = u.clone()
        given[THRUST] += 0.02 * u[THRUST].norm(dim=0) * thrust
        given[TORQUE] += 0.02 * u[TORQUE].norm(dim=0) * torque
        lowest = lowest.minimum(least(model, y, u, given))
    free = torch.tensor([each.axis is None for each in own.of_row])
    lost = (least(model, x, u, u) - robust_least)[free]
    missed = (robust_least - lowest)[free]
    assert (lost > 0.0).any(1).all()
    # but where a row has a kink: at a limit that is broken, or where a light begins to shine
    seen = (missed <= 0.1 * lost + 1e-9).double().mean(1)
    assert (seen > 0.9).all(), seen
    assert (missed > -0.9 * lost).any(1).all()  # it takes off no more than can be lost
