"""Propose, check, commit: whatever is desired no limit breaks, and each call ends where a backup trajectory begins."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, P, V
from inspection.world.uncertainty import Uncertainty
from kernels.compiled import Compiled
from rta.check.commit import LIMITS, SHARES, NoCheckError
from rta.check.motion_law import field
from rta.check.nominal import NominalCheck
from rta.check.terminal_set import CALM
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters
from rta.robust.check import RobustCheck
from rta.robust.filter import RobustFilter
from study.verification.adversaries import adversarial
from tests.oracles import attitude, hypercube, motion, moved
from tests.rta.check.flights import at_the_chief, everywhere, least_of, near_the_zone, opposite, unit
from tests.support.filters import Unproposed, without_check

C = InspectionParameters()
LIMIT = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
HOLDS = pytest.mark.parametrize(
    "hold", [*(pytest.param(hold, marks=pytest.mark.campaign) for hold in (1.0, 5.0)), 10.0]
)
LOOK = 0.5  # s
ROUNDED = 1e-9


def compiled(hold: float) -> SafetyFilter:
    return fast(SafetyFilter(C, RtaParameters(period=hold)), "cpu", 64)


def plain(hold: float) -> SafetyFilter:
    """Returns the same, not compiled."""
    return batched(SafetyFilter(C, RtaParameters(period=hold)))


class Filters(dict[float, SafetyFilter]):
    """Holds filters by hold, each compiled when it is first used."""

    def __missing__(self, hold: float) -> SafetyFilter:
        self[hold] = compiled(hold)
        return self[hold]


@pytest.fixture(scope="module")
def filters() -> dict[float, SafetyFilter]:
    return Filters()


def demands(count: int, seed: int) -> Tensor:
    """Returns desired controls (6, count) from none to twice the actuators' limits."""
    generator = torch.Generator().manual_seed(seed)
    u = 4 * torch.rand(CONTROL_SIZE, count, generator=generator, dtype=torch.float64) - 2
    return LIMIT * u


def starts(safety: SafetyFilter, count: int, seed: int) -> Tensor:
    """Returns states (16, count) from which a backup trajectory is verified."""
    x = hypercube(3 * count, seed, C)
    return x[:, safety.is_safe(x)][:, :count]


@pytest.mark.parametrize(
    ("hold", "seconds"),
    [(10.0, 20.0), *(pytest.param(hold, 200.0, marks=pytest.mark.campaign) for hold in PERIODS)],
)
def test_no_limit_breaks_whatever_is_asked(
    filters: dict[float, SafetyFilter], hold: float, seconds: float
) -> None:
    safety = filters[hold]
    count = 60
    x = starts(safety, count, 1)
    assert x.shape[1] == count
    adversary, asked = adversarial(safety), torch.zeros(CONTROL_SIZE, count, dtype=torch.float64)
    for call in range(round(seconds / hold)):
        if call % round(10 / hold) == 0:
            asked = demands(count, call)
        desired = asked.clone()
        desired[:, ::2] = adversary(call * hold, x)[:, ::2]
        result = safety.correct(x, desired)
        # a control that is not verified now is on a backup trajectory that an earlier call verified
        assert (result.verified | result.backup).all(), (call, x[:, ~result.verified][:, 0].tolist())
        for i in range(round(hold / LOOK)):
            x = moved(x, result.control, LOOK, C)
            y, free = x.numpy(), 10.0 if i == 0 and call % 8 == 0 else None
            least = np.concatenate((motion(y[:3], y[3:6], C, free), attitude(y, C)))
            assert (least >= -ROUNDED).all(), (call, i, np.argwhere(least < -ROUNDED)[:3], least.min(1))


@pytest.mark.campaign
def test_without_the_check_a_limit_breaks(filters: dict[float, SafetyFilter]) -> None:
    alone, lowest = batched(SafetyFilter(C, RtaParameters(period=5.0))), {}
    without_check(alone)
    x = starts(filters[5.0], 300, 2)
    for name, safety in (("alone", alone), ("checked", filters[5.0])):
        y, lowest[name] = x, np.inf
        for call in range(12):
            y = moved(y, safety.correct(y, demands(300, call)).control, 5.0, C)
            least = np.concatenate((motion(y[:3].numpy(), y[3:6].numpy(), C, None), attitude(y.numpy(), C)))
            lowest[name] = min(lowest[name], least.min())
    assert lowest["checked"] >= -ROUNDED and lowest["alone"] < -0.001, lowest


@HOLDS
def test_the_compiled_check_equals_pytorch(filters: dict[float, SafetyFilter], hold: float) -> None:
    safety = filters[hold]
    x, desired = hypercube(500, 5, C), demands(500, 6)
    x[:, ::2] = starts(safety, 250, 7)
    one, other = safety.correct(x, desired), plain(hold).correct(x, desired)
    torch.testing.assert_close(one.control, other.control, rtol=0, atol=1e-9)
    assert torch.equal(one.verified, other.verified) and torch.equal(one.backup, other.backup)
    assert torch.equal(one.intervened, other.intervened)
    assert torch.equal(one.status, other.status)
    assert one.verified.any() and not one.verified.all()


@pytest.mark.campaign
def test_trajectories_that_fail_later_are_found_by_the_compiled_check_too(
    filters: dict[float, SafetyFilter],
) -> None:
    """A backup trajectory may keep the limits for some holds and break one then, under one of 1,000 of these."""
    safety = filters[1.0]
    x = torch.cat((near_the_zone(2000, 3), hypercube(2000, 3, C), at_the_chief(2000, 3)), 1)
    desired = adversarial(safety)(0.0, x)
    one, other = safety.correct(x, desired), plain(1.0).correct(x, desired)
    assert torch.equal(one.verified, other.verified) and torch.equal(one.backup, other.backup)
    assert torch.equal(one.intervened, other.intervened)
    torch.testing.assert_close(one.control, other.control, rtol=0, atol=1e-9)


@HOLDS
def test_flights_in_c_keep_the_limits_that_flights_in_pytorch_keep(
    filters: dict[float, SafetyFilter], hold: float
) -> None:
    """From states all over, half of them next to the chief and as slow as the laws leave them."""
    backup = NominalCheck(C, hold)
    x = everywhere(1500, 31, C)
    x[P, ::2] *= (C.collision_radius + 8.0 * torch.rand(750, dtype=torch.float64)) / x[P, ::2].norm(dim=0)
    x[V, ::2] = field(x[P, ::2], C) + 0.5 * CALM * unit(x[V, ::2])
    broken = torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    given = torch.ones(SIZE, 1, dtype=torch.float64), broken[:, :1], broken[:2, :1]
    found = Compiled(lambda *parts: [backup.fly(*parts)], *given)(x, broken, ~broken[:2])[0]
    assert torch.equal(found, backup.fly(x, broken, ~broken[:2]))
    assert (found.any(1) & ~found.all(1)).all()


@HOLDS
def test_what_replaces_a_control_is_the_first_safe_share_of_the_way_to_the_law(hold: float) -> None:
    backup = NominalCheck(C, hold)
    x = hypercube(600, 9, C)
    x = x[:, backup.has_backup_trajectory(x)][:, :100]
    u = opposite(backup.law(x), C)
    none = torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    control, safe, changed = backup.committed(x, u, none, ~none[:2])
    assert safe.all()
    assert torch.equal(changed[1], ~backup.is_safe(x, u, none, ~none[:2])[1]) and changed.sum() > 5
    with_torque = torch.cat((u[THRUST], control[TORQUE]))
    torque, shares = backup.torque(x), set()
    laws = torch.cat((backup.thrust(x, control[TORQUE]), torque))
    follows = (control == backup.law(x)).all(0)  # both laws, where no other control is safe
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
            found = backup.is_safe(there[:, smaller], tried[:, smaller], no, ~no[:2])
            assert not found[group].any()
    assert shares <= {*SHARES, 1.0} and len(shares) > 1, shares


@pytest.mark.parametrize("safe", [0.0, 0.5, 1.0])
def test_what_actuators_give_is_tried_and_applied(safe: float) -> None:
    """Of controls of which all, those near the law's, or none are refused."""

    def halved(u: Tensor) -> Tensor:
        return torch.cat((u[THRUST].mul(2).round() / 2, u[TORQUE]))

    class Halves(NominalCheck):
        def with_own(self, u: Tensor, group: int, own: Tensor) -> Tensor:
            return halved(super().with_own(u, group, own))

        def thrust(self, x: Tensor, torque: Tensor) -> Tensor:
            return torch.full_like(torque, -0.32)

        def is_safe(self, x: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
            assert torch.equal(u, halved(u))
            return (u[0] < 2.0 * safe - 1.0).repeat(2, 1)

    u, x = torch.full((6, 4), 0.91, dtype=torch.float64), torch.zeros(16, 4, dtype=torch.float64)
    control, found = Halves(C, 1.0).nearest(x, u, torch.zeros(LIMITS, 4, dtype=torch.bool), 0)
    assert found.all() == (safe > 0.0)
    assert (control[THRUST] == {0.0: -0.5, 0.5: -0.5, 1.0: 0.5}[safe]).all() and (
        control[TORQUE] == 0.91
    ).all()


BROKEN = {  # a limit, and what breaks it by little and by much
    "temperature": (8, lambda x, h, by: x[13].add_(h + by), (1e-9, 0.5)),
    "battery": (9, lambda x, h, by: x[14].sub_(h + by), (1e-9, 0.3)),
    "dynamic_speed": (1, lambda x, h, by: x[3:6].mul_(1 + (h + by) / x[3:6].norm(dim=0)), (1e-9, 0.02)),
}


@pytest.mark.parametrize("hold", [pytest.param(1.0, marks=pytest.mark.campaign), 10.0])
@pytest.mark.parametrize(
    ("limit", "much"),
    [
        ("battery", True),
        *(
            pytest.param(limit, much, marks=pytest.mark.campaign)
            for limit in BROKEN
            for much in (False, True)
        ),
    ],
)
def test_a_limit_that_is_broken_leaves_the_others_checked(hold: float, much: bool, limit: str) -> None:
    row, breaks, sizes = BROKEN[limit]
    safety, backup = fast(Unproposed(C, RtaParameters(period=hold)), "cpu", 64), NominalCheck(C, hold)
    x = starts(safety, 100, 11)
    x = x[:, x[:3].norm(dim=0) < 500.0] if row == 1 else x
    breaks(x, safety.values(x)[row], sizes[int(much)])
    h, broken = safety.values(x), torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    assert (h[row] < 0.0).all()
    broken[row] = True
    x = x[
        :, ((h >= 0.0).sum(0) == 12) & backup.fly(x, broken, ~broken[:2] | broken[:2]).all(0)
    ]  # the laws keep all others
    assert x.shape[1] > 10
    others = [k for k in range(11) if k != row]
    for _ in range(round(100 / hold)):
        result = safety.correct(x, opposite(backup.law(x), C))
        assert not result.verified[safety.values(x)[row] < 0.0].any()
        x = moved_by(x, result.control, hold)
        assert (least_of(x, C)[others] >= -ROUNDED).all(), least_of(x, C).min(1)


def moved_by(x: Tensor, u: Tensor, hold: float) -> Tensor:
    for _ in range(round(hold)):
        x = moved(x, u, 1.0, C)
    return x


def test_where_no_backup_trajectory_is_known_there_is_no_check() -> None:
    for c, reason in (
        (replace(C, solar_panel_axis="+x"), "no attitude of rest"),
        (replace(C, hill_rotation=True), "turning of Hill's frame must be left out"),
    ):
        with pytest.raises(NoCheckError, match=reason):
            NominalCheck(c, 1.0)
        with pytest.raises(ValueError, match=f"^no check is known: .*{reason}.*unverified = true"):
            SafetyFilter(c)
        alone = SafetyFilter(c, RtaParameters(unverified=True))
        assert alone.check is None and alone.checked == (False, False)
    robust = RobustFilter(C, uncertainty=Uncertainty(position=0.1))
    assert isinstance(robust.check, RobustCheck) and isinstance(SafetyFilter(C).check, NominalCheck)
