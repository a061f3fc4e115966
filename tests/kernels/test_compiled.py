"""Compiled code gives what uncompiled code gives, in batches of any size, on any number of threads."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import rta.fast.filter
from inspection.model.parameters import InspectionParameters
from inspection.world.uncertainty import Uncertainty
from kernels import build
from kernels.build import NoCompilerError
from kernels.compiled import Compiled, in_shares
from rta.fast.filter import fast
from rta.fast.vectors import states
from rta.filter import SafetyFilter
from rta.result import Status
from study import experiment, machine
from study.config import Config, TrainParameters
from tests.optimised import OPTIMISED, QUICK

C = InspectionParameters()


def polynomial(x: Tensor, y: Tensor) -> list[Tensor]:
    """Parts of different shapes, one of them a derivative and one a matrix product."""
    value, slope = torch.func.jvp(lambda z: z**3, (x,), (torch.ones_like(x),))
    return [value, torch.stack((slope, 2 * slope)), y.new_tensor([[1.0, 2.0], [3.0, 4.0]]) @ y]


def arguments(batch: int) -> tuple[Tensor, Tensor]:
    x = torch.from_numpy(np.random.default_rng(batch).standard_normal((5, batch)))
    return x[:3], x[3:]


@pytest.mark.parametrize("threads", [1, 2])
def test_any_batch_on_any_number_of_threads(threads: int) -> None:
    torch.set_num_threads(threads)
    try:
        compiled = Compiled(polynomial, *arguments(1))
        for batch in (1, 16, 17, 256, 700):
            x, y = arguments(batch)
            value, slopes, product = compiled(x, y)
            np.testing.assert_allclose(value, x**3, rtol=1e-14)
            np.testing.assert_allclose(slopes, np.stack((3 * x**2, 6 * x**2)), rtol=1e-14)
            np.testing.assert_allclose(product, np.array([[1, 2], [3, 4]]) @ y.numpy(), rtol=1e-13)
    finally:
        torch.set_num_threads(1)


@pytest.mark.parametrize("threads", [2, 3])
def test_shares_cover_every_column_once(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    for columns in (1, 64, 65, 128, 129, 1000, 1025):
        seen: list[int] = []
        count = in_shares(
            lambda first, last, seen=seen: seen.extend(range(first, last)) or last - first, columns, 1.0
        )
        assert count == columns and sorted(seen) == list(range(columns))


def test_what_was_compiled_is_not_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(build.VARIABLE, str(tmp_path))
    x, y = arguments(20)
    Compiled(polynomial, *arguments(1))(x, y)
    monkeypatch.setattr(build, "built", None)  # cannot be called
    Compiled(polynomial, *arguments(1))(x, y)
    with pytest.raises(TypeError):  # another constant
        Compiled(lambda x, y: [x + 1.5, *polynomial(x, y)], *arguments(1))


@pytest.mark.campaign
def test_optimisation_changes_no_bit_of_a_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most tests fly filters that are not optimised, see `kernels_cache`; test_numbers.py has every operation."""
    found = []
    for flags in (OPTIMISED, QUICK):
        monkeypatch.setattr(build, "FLAGS", flags)
        found.append(fast(SafetyFilter(C), "cpu", 64).correct(*states(2000, 3, C)))
    assert found[0].status.unique().tolist() == list(Status)[: Status.UNSOLVED] and found[0].backup.any()
    for one, other in zip(*(vars(each).values() for each in found), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_without_a_compiler_nothing_is_compiled_and_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> str:
        raise NoCompilerError("no C compiler was found")

    monkeypatch.setattr(build, "compilers", missing)
    machine.finds_compiler.cache_clear()
    try:
        assert not machine.wants_compile("on", math.inf)
        assert not machine.wants_compile("auto", math.inf)
    finally:
        machine.finds_compiler.cache_clear()
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "compiler" in message


@pytest.mark.parametrize(
    ("choice", "mass", "calls", "works", "expected"),
    [
        ("auto", 0.0, 9, True, False),
        ("auto", 0.0, 10, True, True),
        ("auto", 0.0, 500, False, True),
        ("on", 0.0, 1, True, True),
        ("off", 0.0, 1000, True, False),
        ("auto", 0.1, 9, True, False),
        ("auto", 0.1, 10, True, True),
    ],
)
def test_a_filter_is_compiled_where_that_is_repaid(
    choice: str, mass: float, calls: int, works: bool, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []

    def compile_(safety_filter: SafetyFilter, device: torch.device, batch: int) -> SafetyFilter:
        done.append(batch)
        if not works:
            raise RuntimeError("no compiler")
        return safety_filter

    monkeypatch.setattr(rta.fast.filter, "fast", compile_)
    monkeypatch.setattr(machine, "finds_compiler", lambda: True)
    config = Config(TrainParameters(compile=choice, rta=True), uncertainty=Uncertainty(mass=mass))
    made = experiment.Experiment(config, 7, float(calls))
    assert bool(done) == expected and made.filter_compiled == (works and expected)
