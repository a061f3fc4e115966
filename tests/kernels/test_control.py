"""Loops, conditions and calls give the bits of the plain loop: in C for vectors and for one column, waiting or not."""

import ctypes
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from columns import ACTIVE, call, loop, when
from kernels import build, waiting
from kernels.compiled import WORTH_A_THREAD, Compiled, Kernel
from kernels.printer import printed

Function = Callable[..., list[Tensor]]
ONE = torch.ones(1, 1, dtype=torch.float64)


# Collatz: how often a number is halved or taken to 3 n + 1 until it is 1


def odd(n: Tensor) -> list[Tensor]:
    return [3.0 * n + 1.0]


def halved(n: Tensor) -> Tensor:
    """Returns half of it."""
    return n / 2.0


def collatz_step(n: Tensor, count: Tensor, most: Tensor) -> tuple[list[Tensor], Tensor]:
    (n,) = when(torch.fmod(n[0], 2.0) == 1.0, odd, [call(halved, n)], n)
    return [n, count + 1.0], (n[0] != 1.0) & (count[0] + 1.0 < most[0])


def collatz(n: Tensor, most: Tensor, waits: bool) -> Tensor:
    return loop(collatz_step, [n, torch.zeros_like(n)], most, alive=n[0] > 1.0, most=500, waits=waits)[1]


def in_lockstep(n: Tensor, most: Tensor) -> list[Tensor]:
    return [collatz(n, most, waits=False)]


def one_after_the_other(n: Tensor, most: Tensor) -> list[Tensor]:
    """Runs two loops, the second one on the result of the first; some columns need neither, one or both."""
    first = collatz(n, most, waits=True)
    second = collatz(first + n, most, waits=True)
    return [first, second * n, first > second, n * 2.0]


# nested loops that wait: sums of Collatz over the numbers from n on


def next_number(k: Tensor, total: Tensor, most: Tensor) -> tuple[list[Tensor], Tensor]:
    total = total + collatz(k, most, waits=True)
    (total,) = when(torch.fmod(total[0], 3.0) == 0.0, collatz_of_half, [total], total, most, waits=True)
    return [k + 1.0, total], k[0] + 1.0 < most[0]


def collatz_of_half(total: Tensor, most: Tensor) -> list[Tensor]:
    half = (total / 2.0).floor()
    return [half + collatz(half, most, waits=True)]


def nested(n: Tensor, most: Tensor) -> list[Tensor]:
    k, total = loop(next_number, [n, torch.zeros_like(n)], most, alive=n[0] < most[0], most=20, waits=True)
    (total,) = when(total[0] > 100.0, collatz_of_half, [total], total, most, waits=True)
    return [total, k]


# a bisection: a root of cos x - slope x, until the ends are as near as a column wants


def bisection_step(
    low: Tensor, high: Tensor, is_left: Tensor, slope: Tensor, near: Tensor
) -> tuple[list[Tensor], Tensor]:
    middle = (low + high) / 2.0
    left = middle.cos() < slope * middle
    return [torch.where(left, low, middle), torch.where(left, middle, high), left], (high - low)[0] > near[0]


def bisection(slope: Tensor, near: Tensor) -> list[Tensor]:
    start = [torch.zeros_like(slope), torch.full_like(slope, math.pi / 2), slope > slope]
    return loop(bisection_step, start, slope, near, alive=slope[0] > 0.0, most=60, waits=True)


FUNCTIONS: dict[str, Function] = {
    "lockstep": in_lockstep,
    "one after the other": one_after_the_other,
    "nested": nested,
    "bisection": bisection,
}


def given(name: str, batch: int) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(batch)
    if name == "bisection":
        slope = torch.rand(1, batch, generator=draw, dtype=torch.float64) * 3.0 - 0.3
        return slope, 10.0 ** (-12.0 * torch.rand(1, batch, generator=draw, dtype=torch.float64))
    numbers = [torch.randint(1, most, (1, batch), generator=draw).double() for most in (60, 90)]
    return numbers[0], numbers[1]


def assert_equal(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("width", [16, 64])
def test_bits_are_the_plain_loops_for_any_lanes_batch_and_order(
    name: str, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "vector_bytes", lambda: width)
    monkeypatch.setattr(waiting, "CHUNK", 64)
    fast = Compiled(FUNCTIONS[name], ONE, ONE)
    for batch in (0, 1, 7, 64, 700):
        numbers = given(name, batch)
        expected = FUNCTIONS[name](*numbers)
        assert_equal(fast(*numbers), expected)
        order = torch.randperm(batch, generator=torch.Generator().manual_seed(1))
        assert_equal(fast(*(x[:, order] for x in numbers)), [y[:, order] for y in expected])


def test_bits_are_the_plain_loops_on_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    numbers = given("nested", 5000)
    fast = Compiled(nested, 5 * ONE, 70 * ONE)
    assert isinstance(fast.run, Kernel) and fast.run.seconds * 5000 > 3 * WORTH_A_THREAD
    assert_equal(fast(*numbers), nested(*numbers))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_one_column_has_the_bits_of_a_batch(name: str) -> None:
    one = printed(FUNCTIONS[name], ONE, ONE, name="alone", single=True)
    assert "M on" not in one.text + "".join(one.parts) and not one.waiting
    outputs = [f"double {y.name}[{y.size}]; int m_{y.name}[{y.size}];" for y in one.outputs]
    passed = ", ".join(f"{'m_' if y.kind == 'bool' else ''}{y.name}" for y in one.outputs)
    taken = " ".join(f"*out++ = {'m_' if y.kind == 'bool' else ''}{y.name}[0];" for y in one.outputs)
    text = "\n".join([
        "#include <math.h>\ntypedef double real;", build.header("scalar.h"),
        *[f"#define {each.upper()} {each}" for each in ("floor", "fmod", "rint", "fabs", "sqrt")],
        *[f"#define LIBRARY_{each.upper()} {each}" for each in build.OWN], build.header("functions.h"),
        *one.parts, one.text,
        f"void of(const double *x0, const double *x1, double *out) {{ {' '.join(outputs)}",
        f"    alone(x0, x1, {passed}); {taken} }}",
    ])  # fmt: skip
    library = build.library({"alone": text})
    numbers = given(name, 200)
    expected = [y.double() for y in FUNCTIONS[name](*numbers)]
    found = (ctypes.c_double * len(expected))()
    for column in range(200):
        library.of(*(ctypes.byref(ctypes.c_double(x[0, column].item())) for x in numbers), found)
        assert list(found) == [y.flatten(0, -2)[0, column].item() for y in expected]


def test_a_loop_goes_round_as_often_as_it_may_and_no_more() -> None:
    def at_most(n: Tensor) -> list[Tensor]:
        most = torch.full_like(n, 1e6)
        found = [
            loop(collatz_step, [n, torch.zeros_like(n)], most, alive=n[0] > 0.0, most=times, waits=waits)[1]
            for times in (0, 1, 5)
            for waits in (False, True)
        ]
        return [torch.cat(found)]

    n = torch.tensor([[27.0, 31.0, 54.0, 8.0]], dtype=torch.float64)
    (found,) = Compiled(at_most, ONE)(n)
    assert found[:, 0].tolist() == [0, 0, 1, 1, 5, 5] and found[:, 3].tolist() == [0, 0, 1, 1, 3, 3]
    assert_equal([found], at_most(n))


def down(left: Tensor) -> tuple[list[Tensor], Tensor]:
    return [left - 1.0], left[0] > 1.0


def count_down(left: Tensor) -> list[Tensor]:
    return loop(down, [left], alive=left[0] > 0.0, most=10_000, waits=True)


def test_lanes_are_kept_full() -> None:
    """A column that ends makes room: few lanes idle, though one column of eight takes fifty times as long as others."""
    function = printed(count_down, ONE)
    text = function.waiting.replace("static void loop_0", "long rounds = 0;\nstatic void loop_0", 1)
    text = text.replace("down(on,", "++rounds; down(on,", 1)
    text = text.replace(waiting.INCLUDE, build.header("waiting.h"))
    library = build.library({"run": "\n".join([build.for_vectors("double"), *function.parts, text])})
    rounds = ctypes.c_long.in_dll(library, "rounds")
    fast = Kernel(function, [ONE], library)
    left = torch.ones(1, 800, dtype=torch.float64)
    left[0, ::8] = 50.0
    rounds.value = 0
    fast(left)
    least = left.sum().item() * 8 / build.vector_bytes()
    assert least <= rounds.value < least + 60.0


def test_functions_are_printed_once_by_their_python_names() -> None:
    text = printed(one_after_the_other, ONE, ONE)
    names = [part.split("static void ")[1].split("(")[0] for part in text.parts]
    assert names == ["halved", "odd", "collatz_step"]
    assert "/* Returns half of it. */\nstatic void halved(M on, const V n[1], V result_0[1])" in text.parts[0]


def test_functions_of_one_name_are_told_apart() -> None:
    def scaled(x: Tensor, factor: float) -> Tensor:
        return factor * x

    def both(x: Tensor) -> list[Tensor]:
        return [call(scaled, x, 2.0) + call(scaled, x, 3.0) + call(scaled, x, 2.0), call(scaled, x[:1], 2.0)]

    x = torch.arange(6, dtype=torch.float64).reshape(3, 2)
    text = printed(both, x[:, :1])
    assert [part.split("(")[0].split()[-1] for part in text.parts] == ["scaled", "scaled_2", "scaled_3"]
    assert_equal(Compiled(both, x[:, :1])(x), [7.0 * x, 2.0 * x[:1]])


def append(goes_on: Tensor, X: Tensor, exp: Tensor) -> tuple[list[Tensor], Tensor]:
    return [goes_on + call(lookup, X), X], goes_on[0] < exp[0]


class Double(NamedTuple):
    """Holds a result whose field names are keywords of C."""

    double: Tensor
    on: Tensor


def lookup(x: Tensor) -> Tensor:
    found = call(memcpy, x)
    return found.double - found.on


def memcpy(x: Tensor) -> Double:
    return Double(3.0 * x, x)


def test_names_that_c_or_its_headers_have_are_changed() -> None:
    def whole(x: Tensor, y: Tensor) -> list[Tensor]:
        found = loop(append, [x, y], 50.0 * y, alive=x[0] > 0.0, most=90, waits=True)
        return [*found, call(lambda x: 2.0 * x, x), call(partial(Tensor.add, other=1.0), x)]

    x, y = torch.rand(2, 1, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_equal(Compiled(whole, ONE, ONE)(x, y), whole(x, y))


def test_results_are_never_what_was_given() -> None:
    def changes(x: Tensor) -> list[Tensor]:
        y, no = x + 1.0, torch.zeros_like(x[0], dtype=torch.bool)
        (one,) = when(no, lambda y: [y * 2.0], [y], y)
        (two,) = loop(lambda y: ([y * 2.0], y[0] > 0.0), [y], alive=~no, most=0)
        one += 1.0
        two += 2.0
        return [one, two, y]

    x = torch.rand(1, 9, dtype=torch.float64)
    assert_equal(Compiled(changes, ONE)(x), [x + 2.0, x + 3.0, x + 1.0])


def test_several_calls_in_a_row_are_refused_where_loops_wait() -> None:
    with pytest.raises(ValueError, match="must be 1 where loops wait"):
        Compiled(count_down, ONE)(ONE, times=3)


def test_a_function_of_single_precision_stays_one() -> None:
    x = 9.0 * torch.rand(1, 50)
    assert printed(count_down, x[:, :1]).real == "float"
    assert_equal(Compiled(count_down, x[:, :1])(x), count_down(x))
    assert printed(lambda x: [call(lambda y: y.double(), x)], x[:, :1]).real == "double"


def test_an_axis_may_be_looped_over_in_what_is_called() -> None:
    points = torch.linspace(0.0, 1.0, 97, dtype=torch.float64)[:, None]

    def nearest(x: Tensor) -> Tensor:
        return (x - points).abs().amin(0)

    def run(x: Tensor) -> list[Tensor]:
        return [call(nearest, x, long=97) + 1.0]

    x = torch.rand(1, 30, dtype=torch.float64)
    assert "for (int i = 0; i < 97; i++)" in printed(run, ONE).parts[0]
    assert_equal(Compiled(run, ONE)(x), run(x))


@pytest.mark.parametrize("rows", [[0, 1, 2], [0, 2, 1], [2, 0, 2], [1]])
def test_one_column_picks_its_own_entry(rows: list[int]) -> None:
    """By its address where entries lie evenly apart, else by comparisons."""

    def entry(x: Tensor, at: Tensor) -> Tensor:
        return x[rows].gather(0, at.long())

    x = torch.tensor([[3.0], [5.0], [7.0]], dtype=torch.float64)
    one = printed(lambda x, at: [entry(x, at)], x, 0.0 * ONE, name="alone", single=True)
    assert ("PLACE" in one.text) == (rows == [0, 1, 2])
    head = "#include <math.h>\n#define TRUNC trunc\ntypedef double real;", build.header("scalar.h")
    own = "void of(const double *x, const double *at, double *out) { alone(x, at, out); }"
    text = "\n".join([*head, one.text, own])
    library = build.library({"alone": text})
    given, found = (ctypes.c_double * 3)(3.0, 5.0, 7.0), ctypes.c_double()
    for k, row in enumerate(rows):
        library.of(given, ctypes.byref(ctypes.c_double(k)), ctypes.byref(found))
        assert found.value == x[row].item()


REFUSED: dict[str, tuple[Function, type[Exception], str]] = {
    "a column's tensor from around": (
        lambda x: loop(lambda y: ([y * x], y[0] > 9.0), [x + 1.0], alive=x[0] > 0.0, most=3),
        NotImplementedError, "of a tensor (1, 1) that the body was not given",
    ),
    "another shape": (
        lambda x: when(x[0] > 0.0, lambda y: [torch.cat((y, y))], [x], x), ValueError, "in the place of",
    ),
    "another type": (lambda x: when(x[0] > 0.0, lambda y: [y > 0.0], [x], x), ValueError, "in the place of"),
    "an axis looped over beside loops that wait": (
        lambda x: [*count_down(x), (x - torch.arange(97.0, dtype=torch.float64)[:, None]).abs().amin(0)[None]],
        NotImplementedError, "in a function with loops that wait",
    ),
    "values that decide": (
        lambda x: [call(lambda y: y if y[0] > 0.0 else -y, x)], NotImplementedError, "use torch.where",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_a_body_is_refused(name: str) -> None:
    function, kind, words = REFUSED[name]
    with pytest.raises(kind, match=re.escape(words)):
        printed(function, ONE, long=97)
    assert not ACTIVE.all  # and nothing is recorded any more
