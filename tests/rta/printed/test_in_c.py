"""The filter in C, for a batch and as it is exported: it answers as `SafetyFilter.correct` does in PyTorch."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.initial_state import sample_initial_state
from inspection.model.attitude import conjugate, rotate
from inspection.model.state import OMEGA, E, Q, T, V
from rta import propose
from rta.backup import commit, flight, nominal_check
from rta.backup.nominal_check import NominalBackup
from rta.bounds.health import slewing
from rta.bounds.uncertainty import Uncertainty
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.printed.loaded import InC
from rta.qp import active_set
from rta.qp.programs import Status
from rta.result import FilterResult
from settings import load
from study.config import Config
from study.machine import finds_compiler
from study.verification.adversaries import adversarial
from tests.oracles import tensor
from tests.rta import test_actuator_groups as own
from tests.rta.backup.flights import at_the_chief, near_the_zone
from tests.rta.bounds.test_health import flying_out, without_one_axis
from tests.rta.test_filter import LIMIT, THRUST, TORQUE, C, R, commands, near_the_limits
from tests.support.filters import without_check
from tests.support.states import IMPOSSIBLE, at_rest, impossible

pytestmark = pytest.mark.skipif(not finds_compiler(), reason="no C compiler")


def uncertainty_of(name: str, **more: Any) -> Uncertainty:
    """A filter's uncertainty in one of configs/plants."""
    return dataclasses.replace(load(Path(f"configs/plants/{name}.toml"), Config()).uncertainty, **more)


KINDS: dict[str, tuple[float, Uncertainty | None, str]] = {  # of filters: period in s, uncertainty, rows
    "now": (1.0, None, "auto"),
    "own constraints": (1.0, None, "auto"),
    "sampled at 1 s": (1.0, None, "sampled"),
    "none": (1.0, None, "none"),
    "5 s": (5.0, None, "auto"),
    "paper at 5 s": (5.0, None, "paper"),
    "none at 5 s": (5.0, None, "none"),
    "U1": (1.0, uncertainty_of("u1"), "auto"),
    "paper in U1": (1.0, uncertainty_of("u1"), "paper"),
    "none in U1": (1.0, uncertainty_of("u1"), "none"),
    "minimum thrust": (1.0, uncertainty_of("u1_minimum_thrust"), "auto"),
    "quantum": (1.0, uncertainty_of("u1_thrust_quantum"), "auto"),
    "health": (1.0, uncertainty_of("u1", health=True), "auto"),
    "health alone": (1.0, Uncertainty(health=True), "auto"),
}


IN_THE_SUITE = ("now", "5 s", "U1")


class Both:
    """A filter in PyTorch, as it is exported in C, and compiled for a batch."""

    def __init__(self, kind: str) -> None:
        period, uncertainty, rows = KINDS[kind]
        extra = [own.OWN[name][0] for name in ("cone", "sphere")] if kind == "own constraints" else []
        given = C, dataclasses.replace(R, period=period, rows=rows), None, extra, uncertainty
        self.safety, self.batch = SafetyFilter(*given), SafetyFilter(*given)
        self.exported = InC(self.safety)
        self.batch.compile("cpu", 64)

    def __call__(
        self, x: Tensor, desired: Tensor, sent: Tensor | None, left: Tensor | None
    ) -> list[FilterResult]:
        newest = None if sent is None else sent[: self.safety.uncertainty.latency]
        return [self.exported.correct(x, desired, newest, left), self.batch.correct(x, desired, sent, left)]


@pytest.fixture(scope="module")
def made() -> Callable[[str], Both]:
    """Each kind's filters, built once."""
    filters: dict[str, Both] = {}

    def both(kind: str) -> Both:
        if kind not in filters:
            filters[kind] = Both(kind)
        return filters[kind]

    return both


def assert_same(
    both: Both, x: Tensor, u: Tensor, sent: Tensor | None = None, left: Tensor | None = None
) -> FilterResult:
    """Calls the filter in both languages."""
    expected = both.safety.correct(x, u, sent, left)
    # a dead thruster may get any command: to rounding all of it is as good
    alive = 1.0 if left is None else (left > 0.0).double()
    for found in both(x, u, sent, left):
        same = (((expected.control - found.control) * alive / LIMIT).abs() <= 1e-9).all(0)
        # a solution that is a multiple of the quantum but for rounding has others next to it
        assert (~same).sum() <= (len(same) / 100 if both.safety.uncertainty.thrust_quantum else 0)
        for name in ("status", "program_status", "verified", "backup"):
            assert (getattr(expected, name) == getattr(found, name)).all(), name
        # the printed rows of a state that is not finite may be: there 0 x is zero, whatever x is
        same &= x.isfinite().all(0) & u.isfinite().all(0)
        assert (expected.intervened == found.intervened)[same].all()
        assert (expected.active == found.active)[:, same].all()
        for name in ("h", "slack"):
            parts = (getattr(each, name)[:, same] for each in (expected, found))
            torch.testing.assert_close(*parts, rtol=0, atol=1e-9)
    return expected


@pytest.mark.campaign
def test_a_straight_flight_at_the_chief_is_answered_as_in_python() -> None:
    """Its rows are parallel to 1e-8. A row that was active already entered again, beyond the solver's arrays."""
    x = tensor([-5.04327875138069e-07, -1.6510967882833787e-07, 14.002993728273115, -9.6943901119405863e-09,
                -1.2273732033834376e-08, 0.28059211380399007, 0.2390230257586286, 0.51063332709887399,
                0.18387372108208747, 0.80517827411608112, 0.029930312637664418, -0.020713487359794936,
                -0.028446781123232186, 17.23284216401921, 0.89092636559477401, 4.2952748032107])[:, None]  # fmt: skip
    desired = tensor([-0.20081038565644549, -0.17140507339794203, 0.62727390790073023, 0.0024571115776850908,
                      0.00053677400391030443, 0.0])[:, None]  # fmt: skip
    compiled_one, python = SafetyFilter(), SafetyFilter()
    compiled_one.compile("cpu", 1)
    result, expected = compiled_one.correct(x, desired), python.correct(x, desired)
    assert result.status == expected.status == Status.SLACK
    assert torch.allclose(result.control, expected.control, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("wrong", ["state", "control", "precision"])
def test_a_compiled_filter_reads_only_what_is_there(wrong: str) -> None:
    f = SafetyFilter()
    f.compile("cpu", 1)
    x, desired = torch.ones(16, 8, dtype=torch.float64), torch.zeros(6, 8, dtype=torch.float64)
    given = {"state": (x[:15], desired), "control": (x, desired[:, :1]), "precision": (x.float(), desired)}
    assert f.correct(x[:, :0], desired[:, :0]).control.shape == (6, 0)
    with pytest.raises(ValueError, match=r"must be torch\.float64"):
        f.correct(*given[wrong])


@pytest.mark.parametrize(
    "kind", ["now", *(pytest.param(kind, marks=pytest.mark.campaign) for kind in ("5 s", "U1", "none in U1"))]
)
def test_nothing_is_verified_of_a_state_that_cannot_be(made: Callable[[str], Both], kind: str) -> None:
    driver, x = made(kind), torch.cat([at_rest(), *map(impossible, IMPOSSIBLE)], 1)
    u = torch.zeros(6, x.shape[1], dtype=torch.float64)
    expected = [True] + [False] * len(IMPOSSIBLE)
    assert driver.safety.is_safe(x).tolist() == expected
    assert driver.safety.correct(x, u).verified.tolist() == expected
    for found in driver(x, u, None, None):
        assert found.verified.tolist() == expected


@pytest.mark.parametrize(
    "kind",
    [kind if kind in IN_THE_SUITE else pytest.param(kind, marks=pytest.mark.campaign) for kind in KINDS],
)
def test_a_filter_in_c_is_that_in_python(made: Callable[[str], Both], kind: str) -> None:
    """Also where a number of a state or of a control is none."""
    driver, count = made(kind), 400
    uncertainty = driver.safety.uncertainty
    bad_x, bad_u = tensor(near_the_limits(44, seed=7)), commands(44, seed=7)
    for i, value in enumerate((np.nan, np.inf)):
        for row in range(16):
            bad_x[row, 22 * i + row] = value
        for row in range(6):
            bad_u[row, 22 * i + 16 + row] = value
    x = torch.cat((tensor(near_the_limits(count, seed=5)), bad_x), 1)
    u = torch.cat((1.1 * commands(count, seed=5), bad_u), 1)
    sent = commands(count + 44, seed=6)[None] if uncertainty.latency else None
    left = None
    if uncertainty.health:
        rng = np.random.default_rng(0)
        left = torch.ones_like(u)
        left[rng.integers(0, 3, count), range(count)] = tensor(rng.choice([0.0, 0.5, 1.0], count))
        left[TORQUE, :count] = tensor(rng.uniform(0.5, 1.0, (3, count)))
    result = assert_same(driver, x, u, sent, left)
    some = (Status.HARD,) if driver.safety.propose.kind == "none" else (Status.HARD, Status.SLACK)
    assert all((result.status[:count] == status).sum() > 30 for status in some)
    assert (result.status[count:] == Status.UNSOLVED).sum() > 20 and result.control.isfinite().all()


@pytest.mark.campaign
def test_what_rows_waive_is_said_of_a_batch_as_in_python() -> None:
    """What brakes with all that there is is applied as it is, though a limit that is broken asks for more than that."""
    batch, python = (
        SafetyFilter(C, R, uncertainty=Uncertainty(health=True)) for _ in range(2)
    )  # without a check
    batch.compile("cpu", 64)
    x = tensor(near_the_limits(400, seed=5))
    x[V], x[OMEGA] = 1.5 * x[V], 0.0
    u = torch.zeros(6, 400, dtype=torch.float64)
    u[THRUST] = -C.max_thrust * rotate(conjugate(x[Q]), x[V]).sign()
    found, expected = batch.correct(x, u), python.correct(x, u)
    waives = (expected.slack > 0.0).any(0) & ~expected.intervened
    assert waives.sum() > 20 and (expected.status[waives] == Status.SLACK).all()
    assert torch.equal(found.program_status, expected.program_status)
    torch.testing.assert_close(found.slack, expected.slack, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "kind", ["now", *(pytest.param(kind, marks=pytest.mark.campaign) for kind in ("5 s", "quantum"))]
)
def test_a_state_that_is_too_old_is_unsolved_and_never_verified(
    made: Callable[[str], Both], kind: str
) -> None:
    """In Python, compiled or not, and in C; what is next to the limits, and starts, of which all are verified."""
    driver = made(kind)
    safety, latency = driver.safety, driver.safety.uncertainty.latency
    starts = sample_initial_state(10, torch.Generator().manual_seed(0), C, SafetyFilter(C).is_safe)[0]
    x, u = torch.cat((tensor(near_the_limits(10, seed=8)), starts), 1), commands(20, seed=8)
    sent = u[None].repeat(latency + 1, 1, 1)
    for result in (safety.correct(x, u, sent), driver.batch.correct(x, u, sent)):
        assert (result.program_status == Status.UNSOLVED).all() and (result.status == Status.UNSOLVED).all()
        assert not result.verified.any() and result.control.isfinite().all()
    younger = sent.clone()
    younger[0, :, ::2] = torch.nan
    result = safety.correct(x, u, younger)
    assert ((result.status == Status.UNSOLVED) == ~younger[0, 0].isnan()).all()
    for correct in (safety.correct, driver.batch.correct):  # what was sent to others makes no difference
        whole, alone = correct(x, u, younger), correct(x, u, younger[1:])
        assert torch.equal(whole.control[:, ::2], alone.control[:, ::2])
        assert torch.equal(whole.verified[::2], alone.verified[::2])
    assert safety.unchecked or not safety.uncertainty.is_zero or result.verified[10::2].all()
    if latency:
        assert_same(driver, x, u)  # of no age
        assert_same(driver, x, u, torch.full_like(u[None], torch.nan))


@pytest.mark.campaign
def test_a_dead_axis_is_turned_off_the_radius_as_in_python(made: Callable[[str], Both]) -> None:
    driver = made("health alone")
    x, left = flying_out(200, 700.0, 2.0, seed=1), without_one_axis(200)
    u = torch.zeros(6, 200, dtype=torch.float64)
    torque = slewing(x, u[TORQUE], left, C, R, driver.safety.uncertainty)
    assert (torque != 0.0).any(0).sum() > 100
    assert_same(driver, x, u, left=left)
    generator = torch.Generator().manual_seed(2)  # of bodies that turn already
    x[OMEGA] = 0.01 * (2.0 * torch.rand(3, 200, generator=generator, dtype=torch.float64) - 1.0)
    assert_same(driver, x, u, left=left)


@pytest.mark.campaign
def test_thrust_that_is_replaced_is_for_the_torque_that_is_applied(made: Callable[[str], Both]) -> None:
    driver = made("5 s")
    x = torch.cat((near_the_zone(800, 3), at_the_chief(800, 3)), 1)
    u = adversarial(driver.safety)(0.0, x)
    unchecked = SafetyFilter(C, driver.safety.parameters)
    without_check(unchecked)
    checked, proposed = driver.safety.correct(x, u), unchecked.correct(x, u)
    both = torch.stack([(checked.control != proposed.control)[own].any(0) for own in (THRUST, TORQUE)]).all(0)
    assert both.sum() > 10
    assert_same(driver, x[:, both], u[:, both])


@pytest.mark.parametrize(
    "uncertainty",
    [Uncertainty(), pytest.param(Uncertainty(position=0.3), marks=pytest.mark.campaign)],
    ids=["nominal", "robust"],
)
def test_states_that_are_not_finite_are_never_verified(uncertainty: Uncertainty) -> None:
    """Also where there are no rows, of which a number that is none would show it."""
    safety = SafetyFilter(C, RtaParameters(rows="none"), uncertainty=uncertainty)
    x = sample_initial_state(16, torch.Generator().manual_seed(0), C, safety.is_safe)[0]
    u, far = torch.zeros(6, 16, dtype=torch.float64), torch.arange(0, 16, 2)
    x[E, far], x[T, far[::2]] = math.inf, -math.inf
    expected = safety.correct(x, u)
    safety.compile("cpu", 16)
    found = safety.correct(x, u)
    assert not found.verified[far].any() and found.verified[1::2].all()
    assert torch.equal(found.verified, expected.verified) and torch.equal(found.status, expected.status)


# What is written once in Python is in the C, too: of each function in the order of a call another one is put in its
# place.


def turned(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose numbers have the other sign, and whose truth values are the others."""

    def run(*given: Any) -> Any:
        return other(function(*given))

    run.__name__ = function.__name__
    return run


def other(found: Any) -> Any:
    if isinstance(found, Tensor):
        return ~found if found.dtype == torch.bool else -found if found.is_floating_point() else found
    parts = [other(each) for each in found]
    return type(found)._make(parts) if hasattr(found, "_make") else type(found)(parts)


ORDER: dict[str, tuple[Any, str]] = {  # where each function is looked up
    "demand": (propose.Propose, "demand"), "scale_rows": (propose, "scale_rows"), "to_qp": (propose, "to_qp"),
    "attempt": (active_set, "attempt"), "by_stages": (active_set, "by_stages"), "stage": (active_set, "stage"),
    "step": (active_set, "step"), "cholesky": (active_set, "forwards"),
    "from_qp": (propose, "from_qp"), "concluded": (propose, "concluded"), "fit": (NominalBackup, "fit"),
    "hold": (nominal_check, "hold"), "motion_along": (flight, "motion_along"),
    "attitude_along": (flight, "attitude_along"), "at_once": (nominal_check, "at_once"),
    "arrived": (NominalBackup, "arrived"), "slew": (nominal_check, "slew"), "brake": (nominal_check, "brake"),
    "hold_of_laws": (NominalBackup, "hold_of_laws"), "kept": (NominalBackup, "kept"),
    "replaced": (NominalBackup, "replaced"), "nearest": (NominalBackup, "nearest"), "share": (NominalBackup, "share"),
    "followed": (NominalBackup, "followed"), "after the check": (commit, "concluded"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [name if name in ("step", "share") else pytest.param(name, marks=pytest.mark.campaign) for name in ORDER],
)
def test_a_fault_in_python_is_a_fault_in_c(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.cat((tensor(near_the_limits(1500, seed=5)), near_the_zone(300, 3), at_the_chief(300, 3)), 1)
    u = 1.1 * commands(2100, seed=5)
    expected = SafetyFilter(C, R).correct(x, u)
    place, attribute = ORDER[name]
    faulty = turned(getattr(place, attribute))
    is_static = isinstance(vars(place).get(attribute), staticmethod)
    monkeypatch.setattr(place, attribute, staticmethod(faulty) if is_static else faulty)
    batch = SafetyFilter(C, R)
    batch.compile("cpu", 64)
    found = batch.correct(x, u)
    off = ((found.control - expected.control).abs() / LIMIT).nan_to_num(1.0).amax(0) > 1e-6
    off |= ((found.slack - expected.slack).abs().nan_to_num(1.0) > 1e-6).any(0)
    off |= (found.active != expected.active).any(0)
    others = (getattr(found, name) != getattr(expected, name) for name in ("verified", "backup", "status"))
    assert torch.stack([off, *others]).any()
