"""What cannot be printed is refused in a line that a person can read; what is printed is C of few statements."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kernels.compiled import Compiled
from kernels.operations import expressions
from kernels.printer import printed
from kernels.recorder import BRANCH
from tests.kernels.test_operations import Function

X = torch.tensor([[0.5], [-2.0], [1.5]], dtype=torch.float64)
OUTSIDE = torch.full((3, 1), -2.0, dtype=torch.float64)


def refused(function: Function, *examples: Tensor) -> str:
    with pytest.raises(NotImplementedError) as error:
        printed(lambda *given: [function(*given)], *(examples or [X]))
    return str(error.value)


def jumps(x: Tensor) -> Tensor:
    if x[0] > 0.0:
        return x
    return -x


BRANCHES: dict[str, Function] = {
    "if": jumps,
    "while any": lambda x: 2 * x if (x > 1.0).any(0) else x,
    "float": lambda x: x * float(x[0]),
    "item": lambda x: x * x[0].item(),
    "tolist": lambda x: x * x.tolist()[0][0],
    "numpy": lambda x: x * float(x.numpy()[0, 0]),
    "asarray": lambda x: x * float(np.asarray(x)[0, 0]),
    "nonzero": lambda x: x[torch.nonzero(x[:, 0] > 0.0)[:, 0]],
    "equal": lambda x: x if torch.equal(x, -x) else 2 * x,
    "zero by its structure": lambda x: x if bool((0.0 * x).sum(0) == 0.0) else 2 * x,
}


@pytest.mark.parametrize("name", BRANCHES)
def test_values_that_decide_are_refused(name: str) -> None:
    message = refused(BRANCHES[name])
    assert message.startswith(BRANCH) and "torch.where" in message


def test_a_refusal_shows_the_line_that_wants_it() -> None:
    assert "test_printer.py, line" in refused(jumps) and "if x[0] > 0.0:" in refused(jumps)
    message = refused(lambda x: x.sort(0).values)
    assert "aten::sort cannot be printed as C (test_printer.py, line" in message and "\n" not in message


REFUSED: dict[str, tuple[Function, str]] = {
    "a mask that selects": (lambda x: x[x > 0.0][None], "aten::index.Tensor with a mask that is computed"),
    "entries scattered": (lambda x: x.scatter(0, x.argmax(0, keepdim=True), 7.0), "aten::scatter.value"),
    "random numbers": (lambda x: x + torch.rand(3, 1), "aten::rand of random numbers"),
    "over all axes": (lambda x: x / x.sum(), "aten::sum over all axes, so also over the columns; name an axis (dim)"),
    "an argument written to": (lambda x: x.mul_(2.0), "aten::mul_.Tensor to a tensor that the function was given"),
    "a part of it": (lambda x: x[0].zero_()[None], "aten::zero_ to a tensor that the function was given"),
    "another's tensor": (lambda x: OUTSIDE[1].copy_(x[0])[None], "aten::copy_ to a tensor that the function was given"),
    "complex numbers": (lambda x: torch.fft.fft(x, dim=0).abs(), "aten::_fft_r2c"),
    "half precision": (lambda x: x.half().double(), "of torch.float16"),
    "bits of integers": (lambda x: x.long() & 1, "bitwise_and of integers"),
    "an unknown option": (lambda x: x.round(decimals=2), "aten::round.decimals with these arguments"),
    "no columns": (lambda x: x[:, 0], "result_0 of shape (3,) has no columns"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_there_is_refused_by_its_name(name: str) -> None:
    function, words = REFUSED[name]
    message = refused(function)
    assert words in message.partition(" (test_printer.py")[0]  # the line that wants it has the words, too
    assert "cannot be printed as C" in message and "\n" not in message


def test_an_argument_of_a_type_that_c_does_not_load_is_refused() -> None:
    assert "x0 of torch.float16 cannot be printed as C" in refused(lambda x: x, X.half())
    assert "x0 of shape (3, 2) has no columns" in refused(lambda x: x, X.expand(3, 2))


def test_what_a_compiler_would_take_minutes_for_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expressions, "MOST", 50)
    assert "after 50 others, too many for a C compiler" in refused(
        lambda x: torch.cat([x * i for i in range(30)])
    )


def test_names_are_those_that_are_wanted() -> None:
    found = printed(
        lambda x, y: [x[:2] + 1.0, y > 0.0], X, X, name="area", names=(("state", "other"), ("sum", "up"))
    )
    assert "static void area(const V state[3], const V other[3], V sum[2], M up[3])" in found.text
    assert "(void)" not in found.text
    unused = printed(lambda x, y: [x[:1]], X, X > 0.0)
    assert "    (void)x1;" in unused.text and [part.kind for part in unused.inputs] == ["double", "bool"]


def test_numbers_are_printed_exactly() -> None:
    numbers = (0.1, 1 / 3, -1e-310, 5e-324, -0.0, 3e38, math.inf, -math.inf, math.nan, 1.7976931348623157e308)

    def constants(x: Tensor) -> list[Tensor]:
        some = numbers if x.dtype == torch.float64 else numbers[:-1]
        return [torch.stack([torch.full_like(x[0], number) for number in some]), x[:1] / 3.3]

    for example in (X, X.float()):
        for found, expected in zip(Compiled(constants, example)(example), constants(example), strict=True):
            assert torch.equal(found.nan_to_num(7.0), expected.nan_to_num(7.0))
            assert torch.equal(found.signbit(), expected.signbit())
