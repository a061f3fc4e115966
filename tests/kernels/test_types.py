"""Numbers of double and single precision, whole ones and truth values, as arguments, as results and on the way."""

import torch
from torch import Tensor

from kernels.compiled import Compiled
from kernels.printer import printed
from tests.kernels.test_operations import uniform


def test_single_precision_within_double() -> None:
    """Every operation on float32 rounds, as in PyTorch, and the last bits of float64 are gone."""
    functions = {
        "there and back": lambda x, y: x.float().double(),
        "sums": lambda x, y: ((x.float() + y.float()) * 3.0 - x.float()).double(),
        "choices": lambda x, y: torch.where(x > 0, x.float().minimum(y.float()), -y.float()).double().abs(),
        "mixed": lambda x, y: x.float().double() - x,
    }
    x, y = uniform(-1.0, 1.0, 2, 3, 50)
    compiled = Compiled(lambda *both: [f(*both) for f in functions.values()], x[:, :1], y[:, :1])(x, y)
    for (name, function), found in zip(functions.items(), compiled, strict=True):
        assert torch.equal(found, function(x, y)), name
    text = printed(lambda x, y: [functions["choices"](x, y)], x[:, :1], y[:, :1]).text
    assert text.count("SINGLE(") == 6  # for given numbers only


def test_double_precision_within_single() -> None:
    x = uniform(-1.0, 1.0, 3, 50).float()

    def precise(x: Tensor) -> list[Tensor]:
        return [x.double() / 3.0, (x.double() / 3.0).float(), x / 3.0]

    assert printed(precise, x[:, :1]).real == "double"
    assert printed(lambda x: [x / 3.0, x > 0.0], x[:, :1]).real == "float"
    for found, expected in zip(Compiled(precise, x[:, :1])(x), precise(x), strict=True):
        assert torch.equal(found, expected)


def test_arguments_and_results_of_all_types() -> None:
    g = torch.Generator().manual_seed(0)
    mask, count = torch.rand(2, 30, generator=g) > 0.5, torch.randint(-5, 2**53, (3, 30), generator=g)
    x, y = uniform(-1.0, 1.0, 3, 30), uniform(-1.0, 1.0, 1, 30).float()
    functions = {
        "mask": lambda m, n, x, y: m,
        "not": lambda m, n, x, y: ~m & (n[:2] > 3),
        "count": lambda m, n, x, y: n,
        "counted": lambda m, n, x, y: torch.where(m, n[:2], -n[1:]) // 3 + n[:2] % 7,
        "sum of counts": lambda m, n, x, y: (n // 4).sum(0),
        "double": lambda m, n, x, y: x * m[0] + n,
        "single": lambda m, n, x, y: y * 2.0,
        "whole": lambda m, n, x, y: (x * 10.0).long(),
        "small": lambda m, n, x, y: (x * 10.0).to(torch.int32).to(torch.float64),
        "constant": lambda m, n, x, y: torch.ones(2, x.shape[-1], dtype=torch.bool),
    }
    arguments = mask, count, x, y
    compiled = Compiled(
        lambda *given: [f(*given) for f in functions.values()], *(a[:, :1] for a in arguments)
    )
    for (name, function), found in zip(functions.items(), compiled(*arguments), strict=True):
        expected = function(*arguments)
        assert found.dtype == expected.dtype, name
        torch.testing.assert_close(found, expected, msg=name)
