"""The filter in C for one spacecraft: its solver against the batched one, its search against `SafetyFilter.correct`."""

import ctypes
import dataclasses
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.initial_state import sample_initial_state
from inspection.model.attitude import conjugate, rotate
from inspection.model.state import OMEGA, E, Q, T, V
from rta.bounds.health import slewing
from rta.bounds.uncertainty import Uncertainty
from rta.filter import STEPS_SAMPLED, SafetyFilter
from rta.parameters import RtaParameters
from rta.printed.source import driver_text, source, tolerances
from rta.qp import batched_solver
from rta.qp.batched_solver import BatchedSolver
from rta.qp.programs import Problems, Status
from rta.result import FilterResult
from settings import load
from study.config import Config
from study.verification.adversaries import adversarial
from tests.oracles import projection, tensor
from tests.rta import test_actuator_groups as own
from tests.rta.backup.flights import at_the_chief, near_the_zone
from tests.rta.bounds.test_health import flying_out, without_one_axis
from tests.rta.qp.test_batched_solver import ADDED, FIELDS, arrays, synthetic
from tests.rta.test_filter import LIMIT, THRUST, TORQUE, C, R, commands, near_the_limits
from tests.support.filters import without_check
from tests.support.states import IMPOSSIBLE, at_rest, impossible

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")

SOLVER = """#include <math.h>
#define ROWS_MAX 256
#define ACTIVE_MAX 240
#define STEPS_MAX (4 * ACTIVE_MAX)
#define CLASSES_MAX 4
#define PROGRAMS 1
%s
%s
void solve_all(int count, int rows, const double *desired, const double *a, const double *b, const double *b_no_margin,
               const double *weight, double *control, int *status, double *residual);

void solve_all(int count, int rows, const double *desired, const double *a, const double *b, const double *b_no_margin,
               const double *weight, double *control, int *status, double *residual)
{
    for (int i = 0; i < count; ++i) {
        struct program program;
        struct answer answer;
        begin_program(&program, &desired[3 * i]);
        for (int j = rows * i; j < (rows * (i + 1)); ++j) {
            copy(program.a[program.rows], &a[3 * j], 3);
            program.b[program.rows] = b[j];
            program.b_no_margin[program.rows] = b_no_margin[j];
            program.weight[program.rows] = weight[j - (rows * i)];
            program.rows += 1;
        }
        solve(&program, &answer);
        copy(&control[3 * i], answer.control, 3);
        status[i] = answer.status;
        residual[i] = answer.residual;
        (void)larger(0.0, (double)THRUST);
    }
}
"""


@pytest.fixture(autouse=True)
def steps_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes the steps for every program, as the driver does."""
    monkeypatch.setattr(batched_solver, "PIQP_FIRST", ())


def compiled(text: str, folder: Path) -> ctypes.CDLL:
    """The library of a C text, which no compiler has anything to say about; `test_export` has it optimised."""
    (folder / "filter.c").write_text(text)
    for compiler in COMPILERS:
        subprocess.run([compiler, "-std=c99", *WARNINGS, "-fsyntax-only", "filter.c"], check=True, cwd=folder)
    command = (COMPILERS[0], "-std=c99", "-O0", "-shared", "-fPIC", "filter.c", "-o", "filter.so", "-lm")
    subprocess.run(command, check=True, cwd=folder)
    return ctypes.CDLL(str(folder / "filter.so"))


def pointer(array: ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


@pytest.fixture(scope="module")
def solver(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    text = SOLVER % ("\n".join(tolerances()), driver_text("numbers.c") + driver_text("solver.c"))
    return compiled(text, tmp_path_factory.mktemp("solver"))


def solved(solver: ctypes.CDLL, problems: Problems) -> tuple[ndarray, ndarray, ndarray]:
    """Controls (N, 3), statuses and residuals (N,)."""
    parts = [np.ascontiguousarray(part) for part in vars(arrays(problems)).values()]
    count, rows = parts[2].shape
    control, status, residual = np.zeros((count, 3)), np.zeros(count, np.int32), np.zeros(count)
    solver.solve_all(count, rows, *map(pointer, (*parts, control, status, residual)))
    return control, status, residual


def largest_difference(solver: ctypes.CDLL, problems: Problems) -> float:
    """Between controls of the two solvers, whose statuses agree."""
    python = BatchedSolver()
    expected = python.solve(problems)
    control, status, residual = solved(solver, problems)
    assert (status == expected.status.numpy()).all()
    assert (residual[status < Status.UNSOLVED] <= batched_solver.ACCURATE).all()
    return np.abs(control - expected.control.T.numpy()).max(initial=0.0)


@pytest.mark.parametrize("rows", [6, 11, 22, 60])
def test_random_programs_are_solved_as_in_python(solver: ctypes.CDLL, rows: int) -> None:
    assert largest_difference(solver, synthetic(3000, rows, seed=rows)) <= 1e-9


@pytest.mark.parametrize("added", ADDED.values(), ids=ADDED)
def test_degenerate_rows_are_solved_as_in_python(solver: ctypes.CDLL, added: Any) -> None:
    problems = synthetic(450, 6, seed=5)[torch.arange(150, 450)]
    point = torch.from_numpy(projection(arrays(problems)).T)
    a, b = (torch.cat(pair) for pair in zip((problems.a, problems.b), added(problems, point), strict=True))
    twice = Problems(problems.desired, a, b, b, problems.weight.repeat(2))
    assert largest_difference(solver, twice) <= 1e-9


@pytest.mark.campaign
def test_a_straight_flight_at_the_chief_is_answered_as_in_python() -> None:
    """Its rows are parallel to 1e-8. A row that was active already entered again, beyond the solver's arrays."""
    x = tensor([-5.04327875138069e-07, -1.6510967882833787e-07, 14.002993728273115, -9.6943901119405863e-09,
                -1.2273732033834376e-08, 0.28059211380399007, 0.2390230257586286, 0.51063332709887399,
                0.18387372108208747, 0.80517827411608112, 0.029930312637664418, -0.020713487359794936,
                -0.028446781123232186, 17.23284216401921, 0.89092636559477401, 4.2952748032107])[:, None]  # fmt: skip
    desired = tensor([-0.20081038565644549, -0.17140507339794203, 0.62727390790073023, 0.0024571115776850908,
                      0.00053677400391030443, 0.0])[:, None]  # fmt: skip
    compiled_one, python = SafetyFilter(), SafetyFilter(solver=BatchedSolver())
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


@pytest.mark.parametrize("copies", [2, 8])
def test_equal_rows_that_yield_are_all_active(solver: ctypes.CDLL, copies: int) -> None:
    """As often as passes repeat them: together they weigh so many times as much."""
    p = synthetic(300, 22, seed=3)[torch.arange(30)]
    parts = (part.repeat(copies, *(1,) * (part.dim() - 1)) for part in (p.a, p.b, p.b_no_margin, p.weight))
    assert largest_difference(solver, Problems(p.desired, *parts)) <= 1e-9


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_what_is_not_finite_is_unsolved_and_zero(solver: ctypes.CDLL, field: str, value: float) -> None:
    problems = synthetic(3, 11, seed=4)
    getattr(problems, field)[-1, ..., 1] = value
    control, status, residual = solved(solver, problems)
    assert status.tolist() == [Status.SLACK, Status.UNSOLVED, Status.HARD]
    assert (control[1] == 0.0).all() and residual[1] == np.inf


def test_what_cannot_be_held_gets_the_least_violating_control(solver: ctypes.CDLL) -> None:
    problems = synthetic(200, 6, seed=1)
    problems.weight[:] = np.inf
    expected = BatchedSolver().solve(problems)
    control, status, _ = solved(solver, problems)
    unsolved = status == Status.UNSOLVED
    assert (status == expected.status.numpy()).all() and unsolved.sum() > 50
    np.testing.assert_allclose(control, expected.control.T, rtol=0, atol=1e-9)


def uncertainty_of(name: str, **more: Any) -> Uncertainty:
    """A filter's uncertainty in one of configs/plants."""
    return dataclasses.replace(load(Path(f"configs/plants/{name}.toml"), Config()).uncertainty, **more)


class Driver:
    """A filter in C, called as `SafetyFilter.correct`."""

    def __init__(self, safety: SafetyFilter, folder: Path) -> None:
        self.safety, self.library = safety, compiled(source(safety), folder)
        count, room, real = len(safety.names), max(1, safety.uncertainty.latency), ctypes.c_double
        given = {"state": 16 * real, "desired": 6 * real, "sent": 6 * room * real}
        given |= {"sent_count": ctypes.c_int, "left": 6 * real}
        truth = ctypes.c_int
        found = {"control": 6 * real, "status": ctypes.c_int, "program_status": 2 * ctypes.c_int}
        found |= {"verified": truth, "backup": truth, "violated": truth}
        found |= {
            "residual": 2 * real,
            "h": count * real,
            "slack": count * real,
            "active": count * ctypes.c_int,
        }
        self.given = type("Input", (ctypes.Structure,), {"_fields_": list(given.items())})
        self.found = type("Output", (ctypes.Structure,), {"_fields_": list(found.items())})

    def __call__(self, x: Tensor, desired: Tensor, sent: Tensor | None, left: Tensor | None) -> FilterResult:
        answers = []
        for i in range(x.shape[1]):
            given, found = self.given(), self.found()
            given.state[:], given.desired[:] = x[:, i].tolist(), desired[:, i].tolist()
            given.left[:] = [1.0] * 6 if left is None else left[:, i].tolist()
            given.sent_count = 0 if sent is None else len(sent)
            if sent is not None and self.safety.uncertainty.latency:
                given.sent[:] = sent[: self.safety.uncertainty.latency, :, i].flatten().tolist()
            self.library.safety_filter(ctypes.byref(given), ctypes.byref(found))
            answers.append(found)

        def column(name: str) -> Tensor:
            return torch.from_numpy(np.array([getattr(each, name) for each in answers]).T.copy())

        truths = {"active", "verified", "backup"}
        names = {field.name for field in dataclasses.fields(FilterResult)} - {"intervened"}
        parts = {name: column(name) == 1 if name in truths else column(name) for name in names}
        return FilterResult(**parts, intervened=parts["status"] > Status.UNTOUCHED)


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


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Driver]:
    """Each kind's driver, built once."""
    drivers: dict[str, Driver] = {}

    def driver(kind: str) -> Driver:
        if kind not in drivers:
            period, uncertainty, rows = KINDS[kind]
            extra = [own.OWN[name][0] for name in ("cone", "sphere")] if kind == "own constraints" else []
            is_sampled = uncertainty is not None or period > 1.0
            solver = BatchedSolver(STEPS_SAMPLED) if is_sampled else BatchedSolver()
            safety = SafetyFilter(
                C, dataclasses.replace(R, period=period, rows=rows), solver, extra, uncertainty
            )
            drivers[kind] = Driver(safety, tmp_path_factory.mktemp("driver"))
        return drivers[kind]

    return driver


def assert_same(
    driver: Driver, x: Tensor, u: Tensor, sent: Tensor | None = None, left: Tensor | None = None
) -> FilterResult:
    """Calls the filter in both languages."""
    expected, found = driver.safety.correct(x, u, sent, left), driver(x, u, sent, left)
    # a dead thruster may get any command: to rounding all of it is as good
    alive = 1.0 if left is None else (left > 0.0).double()
    same = (((expected.control - found.control) * alive / LIMIT).abs() <= 1e-9).all(0)
    # a solution that is a multiple of the quantum but for rounding has others next to it
    assert (~same).sum() <= (len(same) / 100 if driver.safety.uncertainty.thrust_quantum else 0)
    for name in ("status", "program_status", "intervened", "verified", "backup"):
        assert (getattr(expected, name) == getattr(found, name)).all(), name
    # the printed rows of a state that is not finite may be: there 0 x is zero, whatever x is
    same &= x.isfinite().all(0) & u.isfinite().all(0)
    assert (expected.active == found.active)[:, same].all()
    for name in ("h", "slack"):
        parts = (getattr(each, name)[:, same] for each in (expected, found))
        torch.testing.assert_close(*parts, rtol=0, atol=1e-9)
    return expected


@pytest.mark.parametrize(
    "kind", ["now", *(pytest.param(kind, marks=pytest.mark.campaign) for kind in ("5 s", "U1", "none in U1"))]
)
def test_nothing_is_verified_of_a_state_that_cannot_be(made: Callable[[str], Driver], kind: str) -> None:
    driver, x = made(kind), torch.cat([at_rest(), *map(impossible, IMPOSSIBLE)], 1)
    batch = SafetyFilter(C, driver.safety.parameters, uncertainty=driver.safety.uncertainty)
    batch.compile("cpu", 32)
    u = torch.zeros(6, x.shape[1], dtype=torch.float64)
    expected = [True] + [False] * len(IMPOSSIBLE)
    assert driver.safety.is_safe(x).tolist() == expected
    assert driver.safety.correct(x, u).verified.tolist() == expected
    assert driver(x, u, None, None).verified.tolist() == expected
    assert batch.correct(x, u).verified.tolist() == expected


@pytest.mark.parametrize(
    "kind",
    [kind if kind in IN_THE_SUITE else pytest.param(kind, marks=pytest.mark.campaign) for kind in KINDS],
)
def test_a_filter_in_c_is_that_in_python(made: Callable[[str], Driver], kind: str) -> None:
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
    options = {"solver": BatchedSolver(STEPS_SAMPLED), "uncertainty": Uncertainty(health=True)}
    batch, python = (SafetyFilter(C, R, **options) for _ in range(2))  # no check overrules these rows
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
    made: Callable[[str], Driver], kind: str
) -> None:
    """In Python, compiled or not, and in C; what is next to the limits, and starts, of which all are verified."""
    driver = made(kind)
    safety, latency = driver.safety, driver.safety.uncertainty.latency
    starts = sample_initial_state(10, torch.Generator().manual_seed(0), C, SafetyFilter(C).is_safe)[0]
    x, u = torch.cat((tensor(near_the_limits(10, seed=8)), starts), 1), commands(20, seed=8)
    sent = u[None].repeat(latency + 1, 1, 1)
    compiled_filter = SafetyFilter(C, safety.parameters, uncertainty=safety.uncertainty)
    compiled_filter.compile("cpu", 20)
    for correct in (driver, safety.correct, compiled_filter.correct):
        result = correct(x, u, sent, None)
        assert (result.program_status == Status.UNSOLVED).all() and (result.status == Status.UNSOLVED).all()
        assert not result.verified.any() and result.control.isfinite().all()
    younger = sent.clone()
    younger[0, :, ::2] = torch.nan
    result = safety.correct(x, u, younger)
    assert ((result.status == Status.UNSOLVED) == ~younger[0, 0].isnan()).all()
    for correct in (safety.correct, compiled_filter.correct):  # what was sent to others makes no difference
        whole, alone = correct(x, u, younger), correct(x, u, younger[1:])
        assert torch.equal(whole.control[:, ::2], alone.control[:, ::2])
        assert torch.equal(whole.verified[::2], alone.verified[::2])
    assert safety.unchecked or not safety.uncertainty.is_zero or result.verified[10::2].all()
    if latency:
        assert_same(driver, x, u)  # of no age
        assert_same(driver, x, u, torch.full_like(u[None], torch.nan))


@pytest.mark.campaign
def test_a_dead_axis_is_turned_off_the_radius_as_in_python(made: Callable[[str], Driver]) -> None:
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
def test_thrust_that_is_replaced_is_for_the_torque_that_is_applied(made: Callable[[str], Driver]) -> None:
    driver = made("5 s")
    x = torch.cat((near_the_zone(800, 3), at_the_chief(800, 3)), 1)
    u = adversarial(driver.safety)(0.0, x)
    unchecked = SafetyFilter(C, driver.safety.parameters, driver.safety.solver)
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
