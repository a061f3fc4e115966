"""Filter and simulator compiled give PyTorch's numbers to rounding, at states of every kind, in vectors of any width.

What amplifies rounding most is the time of the closest pass (`inspection.model.orbit.closest_times`), a difference of
nearly equal |p|^2 by one that nearly cancels: of 600,000 flights both codes were off by up to 3e-10 of a row's size,
measured against 80-bit numbers, but as they compute the same in the same order, by the same. They part where a root or
an arccos begins, h at the zone's edge or towards the Sun: the root of a rounding error of 1e-16 is 1e-8.
"""

import functools
import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from columns import if_long
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from kernels import build
from kernels.compiled import Compiled
from rta.fast.filter import batched, printed_answer, printed_is_safe
from rta.filter import SafetyFilter
from settings import load
from study import experiment
from study.config import Config
from tests.kernels.test_long_axis import LONG, OVER_POINTS
from tests.kernels.test_operations import OF_ONE, OF_TWO, special_pairs, uniform
from tests.optimised import QUICK

FILES = {
    "1 s": ["rta.toml"],
    "5 s": ["rta_5s.toml"],
    "U1": ["plants/u1.toml"],
    "hull": ["chiefs/box.toml", "chiefs/hull.toml"],
}


def filter_of(name: str) -> SafetyFilter:
    config = Config()
    for file in FILES[name]:
        config = load(Path("configs") / file, config)
    return batched(experiment.filter_of(config))


@pytest.mark.parametrize(
    "name", ["1 s", *(pytest.param(name, marks=pytest.mark.campaign) for name in ("5 s", "U1", "hull"))]
)
def test_a_filter_is_printed_alike_for_any_example(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No number of an example decides what is computed."""
    safety = filter_of(name)
    expected = printed_answer(safety, False), printed_is_safe(safety)
    draw = torch.Generator().manual_seed(0)
    others = [30.0 * torch.randn(x.shape, generator=draw, dtype=x.dtype) for x in safety.probe()]
    monkeypatch.setattr(type(safety), "probe", lambda *_: others)
    assert (printed_answer(safety, False), printed_is_safe(safety)) == expected


def flights(c: InspectionParameters, count: int) -> Tensor:
    """Returns states (16, count) in flight."""
    x = torch.randn(SIZE, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x[P] *= uniform(16.0, 400.0, count) / x[P].norm(dim=0)
    x[V] *= uniform(0.05, 1.0, count) / x[V].norm(dim=0)
    x[Q] /= x[Q].norm(dim=0)
    x[OMEGA] = uniform(-0.03, 0.03, 3, count)
    x[T], x[E] = uniform(-20.0, 12.0, count), uniform(0.5, 8.0, count)
    x[THETA_S] = uniform(0.0, 2 * math.pi, count)
    return x


def at_limits(c: InspectionParameters, share: float) -> Tensor:
    """Returns states (16, B) at this share of each limit."""
    x = flights(c, 60)
    parts = x.split(10, 1)
    parts[0][P] *= share * c.max_distance / parts[0][P].norm(dim=0)
    parts[1][P] *= c.collision_radius / share / parts[1][P].norm(dim=0)
    parts[2][V] = share * c.max_speed * parts[2][V].sign()
    parts[3][OMEGA] = share * c.max_rate * parts[3][OMEGA].sign()
    parts[4][T], parts[4][E] = share * c.max_temperature, c.min_energy / share
    # towards the Sun or away from it
    parts[5][Q] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=x.dtype)[:, None]
    parts[5][THETA_S] = torch.arange(10) * math.pi + share - 1.0
    return x


def not_finite(c: InspectionParameters) -> Tensor:
    """Returns states (16, 48) with NaN or infinity in each component."""
    x = flights(c, 3 * SIZE)
    for i, number in enumerate((math.nan, math.inf, -math.inf)):
        x[torch.arange(SIZE), torch.arange(SIZE) + i * SIZE] = number
    return x


KINDS_OF_STATES: dict[str, Callable[[InspectionParameters], Tensor]] = {
    "in flight": partial(flights, count=500),
    "at limits": partial(at_limits, share=1.0),
    "beyond limits": partial(at_limits, share=1.01),
    "within limits": partial(at_limits, share=0.999),
    "not finite": not_finite,
}


def assert_near(found: Tensor, expected: Tensor, name: str, tolerance: float) -> None:
    """Asserts agreement relative to a component's size. A NaN may be a number, because structural zeros stay zero."""
    size = expected.nan_to_num(0.0, 0.0, 0.0).abs().amax(-1, keepdim=True).clamp(min=1e-3)
    off = torch.where(found == expected, 0.0, (found - expected).abs() / size)
    off = torch.where(expected.isnan(), 0.0, off)
    assert (off <= tolerance).all(), f"{name}: {off.max():.1e}"


def conditions(safety: SafetyFilter, x: Tensor) -> list[Tensor]:
    """Returns a and b of the program, Psi, and h."""
    return list(safety.program.evaluated(x))


@pytest.mark.parametrize(
    "name", ["1 s", *(pytest.param(name, marks=pytest.mark.campaign) for name in ("5 s", "hull"))]
)
def test_conditions_of_the_filter(name: str) -> None:
    safety = filter_of(name)
    run = partial(conditions, safety)
    compiled = Compiled(run, safety.probe()[0], long=if_long(len(safety.c.planes)))
    for kind, states in KINDS_OF_STATES.items():
        x = states(safety.c)
        for field, found, expected in zip(("a", "b", "psi", "h"), compiled(x), run(x), strict=True):
            # beside a hull the plane in between is a quotient of differences
            assert_near(found, expected, f"{kind}: {field}", 1e-11 if name == "hull" else 1e-12)


# the same bits


def mixture(x: Tensor, y: Tensor) -> list[Tensor]:
    """Returns every operation, of two numbers each."""
    return [*(function(x) for function in OF_ONE.values()), *(function(x, y) for function in OF_TWO.values())]


def over_points(x: Tensor, w: Tensor) -> list[Tensor]:
    return [function(x, w) for function in OVER_POINTS.values()]


def bits(parts: list[Tensor]) -> list[Tensor]:
    """Returns bits that differ between numbers, also between NaN and a number, but not between NaNs."""

    def of(part: Tensor) -> Tensor:
        negative = part.signbit() & ~part.isnan()
        return torch.stack((part.nan_to_num(7.0, 8.0, 9.0), negative, part.isnan()))

    return [of(part) for part in parts]


@functools.cache
def compared() -> dict[str, tuple[Callable[..., list[Tensor]], tuple[Tensor, ...], int]]:
    """Functions, their arguments, and the length of the axis that is looped over."""
    safety = filter_of("1 s")
    x = torch.cat([states(safety.c) for states in KINDS_OF_STATES.values()], 1)
    return {
        "every operation": (mixture, special_pairs(torch.float64), 0),
        "every operation in single precision": (mixture, special_pairs(torch.float32), 0),
        "conditions": (partial(conditions, safety), (x,), 0),
        "points": (over_points, (uniform(-1.0, 1.0, 3, 50), uniform(-1.0, 1.0, LONG, 50)), LONG),
    }


@functools.cache
def expected_bits(name: str) -> list[Tensor]:
    function, given, long = compared()[name]
    return bits(Compiled(function, *(part[..., :1] for part in given), long=long)(*given))


@pytest.mark.parametrize(
    ("compiler", "width", "name"),
    [
        ("gcc", 16, "every operation"),
        ("gcc", 64, "points"),
        *(("clang", 64, name) for name in ("every operation", "points")),
        *(
            pytest.param(*case, "conditions", marks=pytest.mark.campaign)
            for case in (("gcc", 16), ("clang", 64))
        ),
        ("gcc", 32, "every operation in single precision"),
    ],
)
def test_bits_depend_on_neither_width_nor_compiler(
    compiler: str, width: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not shutil.which(compiler):
        pytest.skip(f"{compiler} is not installed")
    function, given, long = compared()[name]
    expected = expected_bits(name)
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setattr(build, "vector_bytes", lambda: width)
    examples = [part[..., :1] for part in given]
    for one, other in zip(bits(Compiled(function, *examples, long=long)(*given)), expected, strict=True):
        assert torch.equal(one, other)


def test_bits_do_not_depend_on_the_compilers_optimisation(monkeypatch: pytest.MonkeyPatch) -> None:
    function, given, _ = compared()["every operation"]
    expected = expected_bits("every operation")
    monkeypatch.setattr(build, "FLAGS", QUICK)
    for one, other in zip(
        bits(Compiled(function, *(x[..., :1] for x in given))(*given)), expected, strict=True
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("batch", "threads"), [(1, 1), (9, 3), (700, 3)])
def test_bits_depend_on_neither_batch_nor_threads(batch: int, threads: int) -> None:
    function, given, _ = compared()["conditions"]
    torch.set_num_threads(threads)
    try:
        found = Compiled(function, *(part[..., :1] for part in given))(*(part[..., :batch] for part in given))
    finally:
        torch.set_num_threads(1)
    for one, other in zip(bits(found), expected_bits("conditions"), strict=True):
        assert torch.equal(one, other[..., :batch])
