"""Compiled code gives what uncompiled code gives, in batches of any size, in any process."""

import math
from collections.abc import Callable
from dataclasses import fields
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
from rta.fast.filter import batched, fast
from rta.fast.vectors import states
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.result import FilterResult, Status
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


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "cache" in request.fixturenames:
        monkeypatch.setenv(build.VARIABLE, str(request.getfixturevalue("cache")))


@pytest.mark.parametrize("batch", [1, 16, 17, 256, 700])
@pytest.mark.parametrize("threads", [1, 2])
def test_any_batch_on_any_number_of_threads(batch: int, threads: int, cache: Path) -> None:
    torch.set_num_threads(threads)
    try:
        x, y = arguments(batch)
        value, slopes, product = Compiled(polynomial, *arguments(1))(x, y)
    finally:
        torch.set_num_threads(1)
    np.testing.assert_allclose(value, x**3, rtol=1e-14)
    np.testing.assert_allclose(slopes, np.stack((3 * x**2, 6 * x**2)), rtol=1e-14)
    np.testing.assert_allclose(product, np.array([[1, 2], [3, 4]]) @ y.numpy(), rtol=1e-13)


@pytest.mark.parametrize("threads", [2, 3])
def test_shares_cover_every_column_once(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    for columns in (1, 64, 65, 128, 129, 1000, 1025):
        seen: list[int] = []
        count = in_shares(
            lambda first, last, seen=seen: seen.extend(range(first, last)) or last - first, columns, 1.0
        )
        assert count == columns and sorted(seen) == list(range(columns))


def test_what_was_compiled_is_not_compiled_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = arguments(20)
    Compiled(polynomial, *arguments(1))(x, y)
    monkeypatch.setattr(build, "built", None)  # cannot be called
    Compiled(polynomial, *arguments(1))(x, y)
    with pytest.raises(TypeError):  # another constant
        Compiled(lambda x, y: [x + 1.5, *polynomial(x, y)], *arguments(1))


def test_compiled_filter_equals_the_eager_one(
    random_states: Callable[[int], Tensor], generator: torch.Generator
) -> None:
    eager = batched(SafetyFilter(C, RtaParameters()))
    compiled = fast(eager, "cpu", 16)
    x = random_states(300)
    x[5, 7] = x[13, 8] = math.nan
    x[0, 9] = math.inf
    limit = x.new_tensor(C.control_limit)[:, None]
    desired = (2 * torch.rand(6, 300, generator=generator, dtype=torch.float64) - 1) * limit
    desired[:, 100:200] *= 50
    desired[2, 10], desired[3, 11] = math.inf, math.nan
    for batch in (1, 300):
        one, other = (
            eager.correct(x[:, :batch], desired[:, :batch]),
            compiled.correct(x[:, :batch], desired[:, :batch]),
        )
        for field in fields(FilterResult):
            expected, found = getattr(one, field.name), getattr(other, field.name)
            torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9, equal_nan=True)
        assert (other.control.abs() <= limit).all()
    assert one.status.unique().tolist() == list(Status)
    assert torch.equal(compiled.is_safe(x), eager.is_safe(x))


def test_optimisation_changes_no_bit_of_a_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most tests fly filters that are not optimised, see `kernels_cache`."""
    found = []
    for flags in (OPTIMISED, QUICK):
        monkeypatch.setattr(build, "FLAGS", flags)
        safety = fast(SafetyFilter(C, RtaParameters()), "cpu", 64)
        found.append(safety.correct(*states(2000, 3, C)))
    assert found[0].status.unique().tolist() == list(Status)[: Status.UNSOLVED] and found[0].backup.any()
    for field in fields(FilterResult):
        parts = (getattr(each, field.name) for each in found)
        torch.testing.assert_close(*parts, rtol=0, atol=0, equal_nan=True)


def test_without_a_compiler_nothing_is_compiled_and_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> str:
        raise NoCompilerError("no C compiler was found")

    monkeypatch.setattr(build, "compiler", missing)
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
        ("auto", 0.0, 9, True, []),
        ("auto", 0.0, 10, True, ["compile"]),
        ("auto", 0.0, 500, False, ["compile"]),
        ("on", 0.0, 1, True, ["compile"]),
        ("off", 0.0, 1000, True, []),
        ("auto", 0.1, 9, True, []),
        ("auto", 0.1, 10, True, ["compile"]),
    ],
)
def test_a_filter_is_compiled_where_that_is_repaid(
    choice: str, mass: float, calls: int, works: bool, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []

    def compile_(safety_filter: SafetyFilter, device: torch.device, batch: int) -> SafetyFilter:
        done.append("compile")
        if not works:
            raise RuntimeError("no compiler")
        return safety_filter

    monkeypatch.setattr(rta.fast.filter, "fast", compile_)
    monkeypatch.setattr(machine, "finds_compiler", lambda: True)
    config = Config(TrainParameters(compile=choice, rta=True), uncertainty=Uncertainty(mass=mass))
    made = experiment.Experiment(config, 7, float(calls))
    assert done == expected and made.filter_compiled == (works and bool(expected))
