"""The filter in C for one spacecraft: its solver against the batched one, its search against `SafetyFilter.correct`."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray

from rta import batched_solver
from rta.batched_solver import BatchedSolver
from rta.qp import Problems, Status
from tests.rta.test_batched_solver import ADDED, FIELDS, arrays, fly, held, synthetic
from tests.rta.test_qp import projection

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")

SOLVER = """#include <math.h>
#define ROWS_MAX 256
#define ACTIVE_MAX 240
#define STEPS_MAX (4 * ACTIVE_MAX)
#define CLASSES_MAX 4
%s
void solve_all(int count, int rows, const double *desired, const double *a, const double *b, const double *b_bare,
               const double *weight, double *control, int *status, double *residual);

void solve_all(int count, int rows, const double *desired, const double *a, const double *b, const double *b_bare,
               const double *weight, double *control, int *status, double *residual)
{
    for (int i = 0; i < count; ++i) {
        struct program program;
        struct answer answer;
        begin_program(&program, &desired[3 * i]);
        for (int j = rows * i; j < (rows * (i + 1)); ++j) {
            copy(program.a[program.rows], &a[3 * j], 3);
            program.b[program.rows] = b[j];
            program.b_bare[program.rows] = b_bare[j];
            program.weight[program.rows] = weight[j - (rows * i)];
            program.rows += 1;
        }
        solve(&program, &answer);
        copy(&control[3 * i], answer.control, 3);
        status[i] = answer.status;
        residual[i] = answer.residual;
        (void)smaller(0.0, 0.0);
    }
}
"""


@pytest.fixture(autouse=True)
def steps_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes the steps for every program, as the driver does."""
    monkeypatch.setattr(batched_solver, "PIQP_FIRST", ())


def compiled(text: str, folder: Path) -> ctypes.CDLL:
    """The library of a C text, which no compiler has anything to say about."""
    source = folder / "filter.c"
    source.write_text(text)
    for compiler in COMPILERS:
        command = (compiler, "-std=c99", "-O2", *WARNINGS, "-shared", "-fPIC", source, "-lm", "-o")
        subprocess.run([*command, folder / f"{compiler}.so"], check=True)
    return ctypes.CDLL(str(folder / f"{COMPILERS[0]}.so"))


def pointer(array: ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


@pytest.fixture(scope="module")
def solver(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return compiled(SOLVER % Path("rta/driver/solver.c").read_text(), tmp_path_factory.mktemp("solver"))


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


def test_recorded_programs_are_solved_as_in_python(solver: ctypes.CDLL) -> None:
    for part in (*fly(1.0, 2, None), *held(400, seed=9)):
        assert largest_difference(solver, part) <= 1e-9


@pytest.mark.parametrize("added", ADDED.values(), ids=ADDED)
def test_degenerate_rows_are_solved_as_in_python(solver: ctypes.CDLL, added: Any) -> None:
    problems = synthetic(450, 6, seed=5)[torch.arange(150, 450)]
    point = torch.from_numpy(projection(arrays(problems)).T)
    a, b = (torch.cat(pair) for pair in zip((problems.a, problems.b), added(problems, point), strict=True))
    twice = Problems(problems.desired, a, b, b, problems.weight.repeat(2))
    assert largest_difference(solver, twice) <= 1e-9


@pytest.mark.parametrize("copies", [2, 8])
def test_equal_rows_that_yield_are_all_active(solver: ctypes.CDLL, copies: int) -> None:
    """As often as passes repeat them: together they weigh so many times as much."""
    p = synthetic(300, 22, seed=3)[torch.arange(100)]
    parts = (part.repeat(copies, *(1,) * (part.dim() - 1)) for part in (p.a, p.b, p.b_bare, p.weight))
    assert largest_difference(solver, Problems(p.desired, *parts)) <= 1e-9


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
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
