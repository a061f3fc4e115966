"""Propose, check, commit: whatever is desired no limit breaks, and each call ends where a backup trajectory begins."""

import functools

import pytest
import torch

from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, E, P, T, V
from kernels.compiled import Compiled
from rta.check.commit import LIMITS, SHARES
from rta.check.motion_law import field
from rta.check.nominal import NominalCheck
from rta.check.terminal_set import CALM
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.verification.adversaries import adversarial
from tests.oracles import moved
from tests.rta.check.flights import (
    ROUNDED,
    C,
    anywhere,
    at_the_chief,
    backup,
    everywhere,
    least_of,
    limits,
    near_the_zone,
    opposite,
    random,
    safety,
    unit,
)

LOOK = 0.5  # s


@functools.cache
def compiled(hold: float) -> SafetyFilter:
    return fast(SafetyFilter(C, RtaParameters(period=hold)), "cpu", 64)


@pytest.mark.parametrize(
    ("hold", "seconds"), [(10.0, 60.0), pytest.param(1.0, 60.0, marks=pytest.mark.campaign)]
)
def test_no_limit_breaks_whatever_is_asked(hold: float, seconds: float) -> None:
    """Half of the demands are an adversary's, half are random and up to twice the actuators' limits."""
    filter_ = compiled(hold)
    x = anywhere(180, 1)
    x = x[:, filter_.is_safe(x)][:, :60]
    adversary, asked = adversarial(filter_), torch.zeros(CONTROL_SIZE, 60, dtype=torch.float64)
    for call in range(round(seconds / hold)):
        if call % round(10 / hold) == 0:
            asked = 2.0 * limits(C) * random(CONTROL_SIZE, 60, call)
        desired = asked.clone()
        desired[:, ::2] = adversary(call * hold, x)[:, ::2]
        result = filter_.correct(x, desired)
        # a control that is not verified now is on a backup trajectory that an earlier call verified
        assert (result.verified | result.backup).all(), (call, x[:, ~result.verified][:, 0].tolist())
        for i in range(round(hold / LOOK)):
            x = moved(x, result.control, LOOK, C)
            least = least_of(x, C, 10.0 if i == 0 and call % 8 == 0 else None)
            assert (least >= -ROUNDED).all(), (call, i, least.min(1))


@pytest.mark.campaign
def test_trajectories_that_fail_later_are_found_by_the_compiled_check_too() -> None:
    """A backup trajectory may keep the limits for some holds and break one then, under one of 1,000 of these."""
    one = compiled(1.0)
    x = torch.cat([kind(700, 3) for kind in (near_the_zone, anywhere, at_the_chief)], 1)
    desired = adversarial(one)(0.0, x)
    found, expected = (each.correct(x, desired) for each in (one, batched(SafetyFilter(C))))
    for name in ("verified", "backup", "intervened"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    torch.testing.assert_close(found.control, expected.control, rtol=0, atol=1e-9)


def test_flights_in_c_keep_the_limits_that_flights_in_pytorch_keep() -> None:
    """From states all over, half of them next to the chief and as slow as the laws leave them."""
    check = backup("paper", 10.0)
    x = everywhere(1500, 31, C)
    x[P, ::2] *= (C.collision_radius + 8.0 * torch.rand(750, dtype=torch.float64)) / x[P, ::2].norm(dim=0)
    x[V, ::2] = field(x[P, ::2], C) + 0.5 * CALM * unit(x[V, ::2])
    broken = torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    given = torch.ones(SIZE, 1, dtype=torch.float64), broken[:, :1], broken[:2, :1]
    found = Compiled(lambda *parts: [check.fly(*parts)], *given)(x, broken, ~broken[:2])[0]
    assert torch.equal(found, check.fly(x, broken, ~broken[:2]))
    assert (found.any(1) & ~found.all(1)).all()


def test_what_replaces_a_control_is_the_first_safe_share_of_the_way_to_the_law() -> None:
    check = NominalCheck(C, 10.0)
    x = anywhere(200, 9)
    x = x[:, safety("paper", 10.0).is_safe(x)][:, :50]
    u = opposite(check.law(x), C)
    none = torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    control, safe, changed = check.committed(x, u, none, ~none[:2])
    assert safe.all()
    assert torch.equal(changed[1], ~check.is_safe(x, u, none, ~none[:2])[1]) and changed.sum() > 5
    with_torque = torch.cat((u[THRUST], control[TORQUE]))
    laws = torch.cat((check.thrust(x, control[TORQUE]), check.torque(x)))
    follows, shares = (control == check.law(x)).all(0), set()  # both laws, where no other control is safe
    for group, own in ((0, THRUST), (1, TORQUE)):
        same = ~changed[group]
        assert torch.equal(control[own][:, same], u[own][:, same])
        moved_on = changed[group] & ~follows
        before, there = with_torque[:, moved_on], x[:, moved_on]
        before[own] = u[own][:, moved_on]
        way, gone = (part[own][:, moved_on] - before[own] for part in (laws, control))
        share = gone.norm(dim=0) / way.norm(dim=0)
        torch.testing.assert_close(gone, share * way, rtol=0, atol=1e-9)
        shares |= {round(each, 6) for each in share.tolist()}
        for less in SHARES:  # smaller shares are not safe
            tried, smaller = before.clone(), less < share - 1e-6
            tried[own] += less * way
            no = none[:, : int(smaller.sum())]
            found = check.is_safe(there[:, smaller], tried[:, smaller], no, ~no[:2])
            assert not found[group].any()
    assert shares <= {*SHARES, 1.0} and len(shares) > 1, shares


BROKEN = {  # a limit's row, and what breaks it
    "temperature": (8, lambda x, h: x[T].add_(h + 0.5)),
    "battery": (9, lambda x, h: x[E].sub_(h + 1e-9)),
    "dynamic_speed": (1, lambda x, h: x[V].mul_(1 + (h + 0.02) / x[V].norm(dim=0))),
}


@pytest.mark.parametrize("limit", BROKEN)
def test_a_limit_that_is_broken_leaves_the_others_checked(limit: str) -> None:
    row, breaks = BROKEN[limit]
    filter_, check = safety("paper", 10.0), backup("paper", 10.0)
    x = anywhere(400, 11)
    x = x[:, filter_.is_safe(x) & (x[P].norm(dim=0) < 500.0)][:, :100]
    breaks(x, filter_.values(x)[row])
    h, broken = filter_.values(x), torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    broken[row] = True
    assert (h[row] < 0.0).all()
    x = x[:, ((h >= 0.0).sum(0) == 12) & check.fly(x, broken, ~broken[:2] | broken[:2]).all(0)]
    assert x.shape[1] > 10  # from which the laws keep all others
    others = [k for k in range(LIMITS) if k != row]
    for _ in range(10):
        result = filter_.correct(x, opposite(check.law(x), C))
        assert not result.verified[filter_.values(x)[row] < 0.0].any()
        for _ in range(10):
            x = moved(x, result.control, 1.0, C)
        assert (least_of(x, C)[others] >= -ROUNDED).all(), least_of(x, C).min(1)
