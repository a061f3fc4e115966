"""The filter in C, for a batch and as it is exported: it answers as `SafetyFilter.correct` does in PyTorch."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.initial_state import sample_initial_state
from inspection.world.uncertainty import Uncertainty
from rta import filter as called
from rta.check import commit, flight, nominal
from rta.check.nominal import NominalCheck
from rta.fast import active_set, program
from rta.fast.filter import batched, fast, latency, printed_answer
from rta.fast.loaded import InC
from rta.fast.program import FastProgram
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.result import FilterResult, Status
from rta.robust.filter import RobustFilter
from settings import load
from study.config import Config
from study.machine import finds_compiler
from study.verification.adversaries import adversarial
from tests.oracles import tensor
from tests.rta import test_own as own
from tests.rta.check.flights import at_the_chief, near_the_zone
from tests.rta.test_filter import LIMIT, THRUST, TORQUE, C, R, commands, near_the_limits
from tests.support.states import IMPOSSIBLE, at_rest, impossible

pytestmark = pytest.mark.skipif(not finds_compiler(), reason="no C compiler")


def uncertainty_of(name: str, **more: Any) -> Uncertainty:
    """Returns a filter's uncertainty in one of configs/plants."""
    return dataclasses.replace(load(Path(f"configs/plants/{name}.toml"), Config()).uncertainty, **more)


KINDS: dict[str, tuple[float, Uncertainty | None]] = {  # of filters: period in s, uncertainty
    "now": (1.0, None),
    "own limits": (1.0, None),
    "unchecked": (1.0, None),
    "5 s": (5.0, None),
    "10 s": (10.0, None),
    "U1": (1.0, uncertainty_of("u1")),
    "minimum thrust": (1.0, uncertainty_of("u1_minimum_thrust")),
    "quantum": (1.0, uncertainty_of("u1_thrust_quantum")),
    "thrust alone": (1.0, Uncertainty(torque_gain=0.5, rate=0.05)),
}


class Both:
    """Holds a filter in PyTorch, as exported C, and compiled for a batch."""

    def __init__(self, kind: str) -> None:
        period, uncertainty = KINDS[kind]
        extra = own.EXTRA if kind == "own limits" else {}
        c = dataclasses.replace(C, hill_rotation=True) if kind == "unchecked" else C
        given = c, RtaParameters(period=period, unverified=kind in ("unchecked", "thrust alone")), extra
        plain = RobustFilter(*given, uncertainty=uncertainty) if uncertainty else SafetyFilter(*given)
        self.safety, self.exported, self.batch = batched(plain), InC(plain), fast(plain, "cpu", 64)
        self.latency = latency(plain)

    def told(self, sent: Tensor | None) -> list[Tensor | None]:
        """Arguments of `correct` after the first two."""
        return [sent] if isinstance(self.safety, RobustFilter) else []

    def __call__(self, x: Tensor, desired: Tensor, sent: Tensor | None) -> list[FilterResult]:
        told = self.told(sent)
        newest = sent[-self.latency :] if sent is not None and self.latency else None
        return [self.exported.correct(x, desired, newest), self.batch.correct(x, desired, *told)]


@pytest.fixture(scope="module")
def made() -> Callable[[str], Both]:
    """Returns each kind's filters, built once."""
    return functools.cache(Both)


def assert_same(both: Both, x: Tensor, u: Tensor, sent: Tensor | None = None) -> FilterResult:
    """Calls the filter in both languages."""
    expected = both.safety.correct(x, u, *both.told(sent))
    quantised = isinstance(both.safety, RobustFilter) and both.safety.uncertainty.thrust_quantum
    for found in both(x, u, sent):
        same = ((expected.control - found.control).abs() / LIMIT <= 1e-9).all(0)
        # a solution that is a multiple of the quantum but for rounding has others next to it
        assert (~same).sum() <= (len(same) / 100 if quantised else 0)
        for name in ("status", "verified", "backup"):
            assert (getattr(expected, name) == getattr(found, name)).all(), name
        # the printed conditions of a state that is not finite may be: there 0 x is zero, whatever x is
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
    result, expected = (f.correct(x, desired) for f in (fast(SafetyFilter()), batched(SafetyFilter())))
    assert result.status == expected.status == Status.SLACK
    assert torch.allclose(result.control, expected.control, rtol=0.0, atol=1e-6)


def test_a_compiled_filter_reads_only_what_is_there(made: Callable[[str], Both]) -> None:
    f = made("now").batch
    x, desired = torch.ones(16, 8, dtype=torch.float64), torch.zeros(6, 8, dtype=torch.float64)
    assert f.correct(x[:, :0], desired[:, :0]).control.shape == (6, 0)
    for given in ((x[:15], desired), (x, desired[:, :1]), (x.float(), desired)):
        with pytest.raises(ValueError, match=r"must be torch\.float64"):
            f.correct(*given)


@pytest.mark.parametrize(
    "kind", ["now", *(pytest.param(kind, marks=pytest.mark.campaign) for kind in ("5 s", "U1"))]
)
def test_nothing_is_verified_of_a_state_that_cannot_be(made: Callable[[str], Both], kind: str) -> None:
    driver, x = made(kind), torch.cat([at_rest(), *map(impossible, IMPOSSIBLE)], 1)
    u = torch.zeros(6, x.shape[1], dtype=torch.float64)
    expected = [True] + [False] * len(IMPOSSIBLE)
    assert driver.safety.is_safe(x).tolist() == driver.batch.is_safe(x).tolist() == expected
    assert driver.safety.correct(x, u).verified.tolist() == expected
    for found in driver(x, u, None):
        assert found.verified.tolist() == expected


@pytest.mark.parametrize(
    "kind",
    [kind if kind in ("now", "U1") else pytest.param(kind, marks=pytest.mark.campaign) for kind in KINDS],
)
def test_a_filter_in_c_is_that_in_python(made: Callable[[str], Both], kind: str) -> None:
    """Also where a number of a state or of a control is none."""
    driver, count = made(kind), 400
    bad_x, bad_u = tensor(near_the_limits(44, seed=7)), commands(44, seed=7)
    for i, value in enumerate((np.nan, np.inf)):
        for row in range(16):
            bad_x[row, 22 * i + row] = value
        for row in range(6):
            bad_u[row, 22 * i + 16 + row] = value
    x = torch.cat((tensor(near_the_limits(count, seed=5)), bad_x), 1)
    u = torch.cat((1.1 * commands(count, seed=5), bad_u), 1)
    sent = commands(count + 44, seed=6)[None] if driver.latency else None
    result = assert_same(driver, x, u, sent)
    assert torch.equal(driver.batch.is_safe(x), driver.safety.is_safe(x))
    assert all((result.status[:count] == status).sum() > 30 for status in (Status.HARD, Status.SLACK))
    assert (result.status[count:] == Status.UNSOLVED).sum() > 20 and result.control.isfinite().all()
    if all(driver.safety.checked):
        assert result.verified.sum() > 10 and (~result.verified[:count]).sum() > 30


@pytest.mark.parametrize("kind", ["U1", pytest.param("quantum", marks=pytest.mark.campaign)])
def test_a_state_that_is_too_old_is_unsolved_and_never_verified(
    made: Callable[[str], Both], kind: str
) -> None:
    """In Python, compiled or not, and in C; what is next to the limits, and starts, of which all are verified."""
    driver = made(kind)
    safety, latency = driver.safety, driver.latency
    starts = sample_initial_state(10, torch.Generator().manual_seed(0), C, SafetyFilter(C).is_safe)[0]
    x, u = torch.cat((tensor(near_the_limits(10, seed=8)), starts), 1), commands(20, seed=8)
    sent = u[None].repeat(latency + 1, 1, 1)
    for result in (safety.correct(x, u, sent), driver.batch.correct(x, u, sent)):
        assert (result.status == Status.UNSOLVED).all()
        assert not result.verified.any() and result.control.isfinite().all()
    younger = sent.clone()
    younger[0, :, ::2] = torch.nan
    result = safety.correct(x, u, younger)
    assert ((result.status == Status.UNSOLVED) == ~younger[0, 0].isnan()).all()
    assert result.verified[10::2].any()
    for correct in (safety.correct, driver.batch.correct):  # controls sent to other columns must not matter
        whole, alone = correct(x, u, younger), correct(x, u, younger[1:])
        assert torch.equal(whole.control[:, ::2], alone.control[:, ::2])
        assert torch.equal(whole.verified[::2], alone.verified[::2])
    assert_same(driver, x, u)  # states without age
    assert_same(driver, x, u, torch.full_like(u[None], torch.nan))


@pytest.mark.campaign
def test_thrust_that_is_replaced_is_for_the_torque_that_is_applied(made: Callable[[str], Both]) -> None:
    driver = made("5 s")
    x = torch.cat((near_the_zone(800, 3), at_the_chief(800, 3)), 1)
    u = adversarial(driver.safety)(0.0, x)
    checked, proposed = driver.safety.correct(x, u), driver.safety.proposed(x, u)
    both = torch.stack([(checked.control != proposed.control)[own].any(0) for own in (THRUST, TORQUE)]).all(0)
    assert both.sum() > 10
    assert_same(driver, x[:, both], u[:, both])


# What is written once in Python is in the C, too: of each function in the order of a call another one is put in its
# place.


def turned(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function with negated numbers and inverted truth values."""

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
    "demanded": (called, "demanded"), "within_rates": (called, "within_rates"), "in_mid_hold": (called, "in_mid_hold"),
    "conditions": (FastProgram, "conditions"), "scaled": (program, "scaled"),
    "attempt": (active_set, "attempt"), "by_stages": (active_set, "by_stages"), "stage": (active_set, "stage"),
    "step": (active_set, "step"), "cholesky": (active_set, "forwards"),
    "concluded": (program, "concluded"), "fit": (NominalCheck, "fit"),
    "led_back": (NominalCheck, "led_back"),
    "hold": (nominal, "hold"), "motion_along": (flight, "motion_along"),
    "attitude_along": (flight, "attitude_along"), "at_once": (nominal, "at_once"),
    "arrived": (NominalCheck, "arrived"), "slew": (nominal, "slew"), "brake": (nominal, "brake"),
    "hold_of_laws": (NominalCheck, "hold_of_laws"), "kept": (NominalCheck, "kept"),
    "replaced": (NominalCheck, "replaced"), "nearest": (NominalCheck, "nearest"), "share": (NominalCheck, "share"),
    "followed": (NominalCheck, "followed"), "after the check": (commit, "concluded"),
}  # fmt: skip


def text() -> list[str]:
    """Returns the C of a filter for a batch."""
    found = printed_answer(SafetyFilter(C, R), False)
    return [*found.parts, found.waiting]


@pytest.fixture(scope="module")
def sound() -> list[str]:
    return text()


@pytest.mark.parametrize(
    "name",
    [name if name in ("step", "share") else pytest.param(name, marks=pytest.mark.campaign) for name in ORDER],
)
def test_a_fault_in_python_is_a_fault_in_c(
    name: str, sound: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place, attribute = ORDER[name]
    faulty = turned(getattr(place, attribute))
    is_static = isinstance(vars(place).get(attribute), staticmethod)
    monkeypatch.setattr(place, attribute, staticmethod(faulty) if is_static else faulty)
    assert text() != sound
