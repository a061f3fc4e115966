"""What is printed gives what PyTorch gives: every operation, on ordinary numbers and on those that are none."""

import itertools
import math
from collections.abc import Callable, Mapping
from types import ModuleType

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from kernels.compiled import Compiled
from kernels.printer import printed

Function = Callable[..., Tensor]

SPECIAL = (0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.7, 1e-140, 1e140, math.inf, -math.inf, math.nan)


def uniform(low: float, high: float, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def assert_same(
    functions: Mapping[str, Function], *tensors: Tensor, long: int = 0, atol: float = 0.0
) -> None:
    """Compares functions, compiled together, with what PyTorch makes of them."""

    def all_of(*given: Tensor) -> list[Tensor]:
        return [function(*given) for function in functions.values()]

    compiled = Compiled(all_of, *(x[..., :1] for x in tensors), long=long)(*tensors)
    single = torch.float32 in (x.dtype for x in tensors)
    for name, found, expected in zip(functions, compiled, all_of(*tensors), strict=True):
        is_single = single or expected.dtype == torch.float32
        torch.testing.assert_close(
            found,
            expected,
            rtol=2e-6 if is_single else 1e-13,
            atol=max(atol, 1e-6 if is_single else 1e-300),
            equal_nan=True,
            msg=lambda text, name=name: f"{name}: {text}",
        )


# on each element


def named(module: ModuleType, names: str) -> dict[str, Function]:
    return {name: getattr(module, name) for name in names.split()}


OF_ONE: dict[str, Function] = {
    **named(
        torch,
        "neg abs reciprocal rsqrt sqrt square relu sign sgn round floor ceil trunc frac sin cos tan asin acos atan "
        "sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log2 log10 log1p erf erfc sigmoid sinc deg2rad rad2deg "
        "positive isnan isinf isposinf isneginf isfinite nan_to_num logical_not clone zeros_like ones_like",
    ),
    **named(functional, "silu softplus"),
    **{
        f"power {k}": lambda x, k=k: x**k for k in (0, 1, 2, 3, 5, 8, 9, -1, -2, -3, 0.5, -0.5, 1.5, math.inf)
    },
    "power of a number": lambda x: 1.5**x,
    "softplus of 2": lambda x: functional.softplus(x, beta=2.0, threshold=3.0),
    "clamp": lambda x: x.clamp(-0.5, 2.0),
    "clamp from below": lambda x: x.clamp(min=0.0),
    "clamp from above": lambda x: x.clamp(max=-0.25),
    "clamp between bounds that cross": lambda x: x.clamp(1.0, -1.0),
    "nan_to_num of other numbers": lambda x: x.nan_to_num(nan=3.0, posinf=5.0, neginf=-7.0),
    "numbers": lambda x: 2.0 - 3 * x / 4.0 + 1,
    "a number divided": lambda x: 2.0 / x,
    "where of a number": lambda x: torch.where(x > 0.5, x, -1.0),
    "masked_fill": lambda x: x.masked_fill(x.isnan() | (x < 0.0), 4.0),
    "remainder of a number": lambda x: x % 0.7,
    "floor_divide by a number": lambda x: x // 0.1,
    "bool": lambda x: x.bool(),
    "long": lambda x: x.nan_to_num(posinf=3.0, neginf=4.0).clamp(-9.9, 9.9).long(),
    "min with NaN": lambda x: x.clamp(min=math.nan),
}
OF_TWO: dict[str, Function] = {
    **named(
        torch,
        "add sub rsub mul div pow minimum maximum atan2 hypot fmod remainder floor_divide copysign "
        "heaviside logaddexp xlogy lt le gt ge eq ne logical_and logical_or logical_xor",
    ),
    "add alpha": lambda x, y: torch.add(x, y, alpha=3),
    "sub alpha": lambda x, y: torch.sub(x, y, alpha=0.25),
    "div trunc": lambda x, y: torch.div(x, y, rounding_mode="trunc"),
    "div floor": lambda x, y: torch.div(x, y, rounding_mode="floor"),
    "lerp": lambda x, y: torch.lerp(x, y, 0.3),
    "addcmul": lambda x, y: torch.addcmul(x, x, y, value=2.0),
    "addcdiv": lambda x, y: torch.addcdiv(x, x, y, value=2.0),
    "clamp between": lambda x, y: x.clamp(y, y + 1.0),
    "clamp from below": lambda x, y: x.clamp(min=y),
    "where": lambda x, y: torch.where(x < y, x, y),
    "isclose": torch.isclose,
    "masks": lambda x, y: ((x > 0.0) & (y > 0.0)) | ~(x < y) ^ (x == y),
    "masks as numbers": lambda x, y: (x > 0.0) * y + (y > 0.0) - 2 * (x > y),
}


def special_pairs(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Returns all pairs of special numbers, and some ordinary ones: (1, B) each."""
    pairs = torch.tensor(list(itertools.product(SPECIAL, SPECIAL)), dtype=torch.float64).T
    x, y = torch.cat((pairs, uniform(-3.0, 3.0, 2, 500)), 1).to(dtype)
    return x[None], y[None]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_functions_of_one_number(dtype: torch.dtype) -> None:
    assert_same(OF_ONE, special_pairs(dtype)[0])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_functions_of_two_numbers(dtype: torch.dtype) -> None:
    assert_same(OF_TWO, *special_pairs(dtype))


def test_the_sign_of_zero_is_kept_where_nothing_folds() -> None:
    names = ("add", "sub", "mul", "div", "copysign", "neg", "abs", "sqrt", "round")
    functions = {name: lambda *given, f={**OF_ONE, **OF_TWO}[name]: 1.0 / f(*given) for name in names}
    x, y = special_pairs(torch.float64)
    assert_same({name: f for name, f in functions.items() if name in OF_TWO}, x, y)
    assert_same({name: f for name, f in functions.items() if name in OF_ONE}, x)


def test_a_literal_zero_or_one_folds_as_is_said() -> None:
    """0 x = 0 / x = 0, x + 0 = x, 0 - x = -x: what is zero by its structure costs nothing."""
    x = torch.tensor([[math.nan, math.inf, -math.inf, 0.0, -0.0, 2.0]], dtype=torch.float64)

    def folds(x: Tensor) -> list[Tensor]:
        zero = torch.zeros_like(x)
        products = [zero * x, zero / x, x * 1.0, x / 1.0, x * -1.0]
        return [*products, x + zero, zero - x, torch.where(zero > 0, x, 3.0)]

    function = printed(folds, x[:, :1])
    assert function.text.count(" * ") == function.text.count(" / ") == function.text.count(" + ") == 0
    for found, expected in zip(Compiled(folds, x[:, :1])(x), folds(x), strict=True):
        known = x.isfinite() & ((x != 0.0) | (expected == expected))
        assert torch.equal(found[known], expected[known])
    assert (Compiled(folds, x[:, :1])(x)[0] == 0.0).all()


# derivatives

NOT_DIFFERENTIATED = ("heaviside", "floor_divide", "long", "bool", "numbers", "isclose", "remainder")
ONCE = ("silu", "softplus of 2")  # at most, by PyTorch's forward mode


def along(function: Function, direction: Callable[[Tensor], Tensor], times: int) -> Function:
    """Returns a derivative of a function of two tensors, by nested forward mode."""
    for _ in range(times):
        function = (
            lambda f: lambda x, y: torch.func.jvp(f, (x, y), (direction(x), torch.full_like(y, 0.5)))[1]
        )(function)
    return function


@pytest.mark.parametrize("times", [1, 2])
def test_derivatives_on_each_element(times: int) -> None:
    of_one = {f"{name} of one": lambda x, y, f=f: f(x) for name, f in OF_ONE.items()}
    assert_same_derivatives(of_one | OF_TWO, *uniform(0.1, 0.9, 2, 1, 20), times=times)


@pytest.mark.parametrize("times", [1, 2])
def test_derivatives_along_axes(times: int) -> None:
    assert_same_derivatives(AXES, *uniform(0.1, 0.9, 2, 3, 3, 20), times=times)


def test_derivatives_of_shapes() -> None:
    assert_same_derivatives(SHAPES | IN_PLACE, *uniform(0.1, 0.9, 2, 3, 4, 20), times=1)


def assert_same_derivatives(table: dict[str, Function], x: Tensor, y: Tensor, times: int) -> None:
    functions = {
        name: along(f, torch.ones_like, times)
        for name, f in table.items()
        if not name.startswith(NOT_DIFFERENTIATED) and not (times == 2 and name.startswith(ONCE))
    }
    differentiable = {name: f for name, f in functions.items() if f(x, y).is_floating_point()}
    assert len(differentiable) > 25
    assert_same(differentiable, x, y, atol=1e-13)


# along axes

AXES: dict[str, Function] = {
    **{f"norm {p}": lambda x, y, p=p: x.norm(p=p, dim=0) for p in (0, 1, 2, 3, math.inf, -math.inf)},
    "norm over two axes": lambda x, y: torch.linalg.vector_norm(x, dim=(0, 1)),
    "sum": lambda x, y: x.sum(0),
    "sum over two axes": lambda x, y: x.sum((0, 1), keepdim=True),
    "sum of masks": lambda x, y: (x > y).sum(1),
    "mean": lambda x, y: x.mean(1),
    "mean over two axes": lambda x, y: x.mean((0, 1), keepdim=True),
    "logsumexp": lambda x, y: x.logsumexp((0, 1)),
    "amin": lambda x, y: x.amin(0),
    "amax": lambda x, y: x.amax((0, 1)),
    "aminmax": lambda x, y: torch.cat(x.aminmax(dim=0)),
    "min": lambda x, y: x.min(1).values,
    "max": lambda x, y: x.max(0, keepdim=True).values,
    "argmin": lambda x, y: x.argmin(0),
    "argmax": lambda x, y: x.argmax(1, keepdim=True),
    "any": lambda x, y: (x > y).any(0),
    "all": lambda x, y: (x > y).all(1),
    "any over two axes": lambda x, y: (x > 0.9 * y).any((0, 1)),
    "count_nonzero": lambda x, y: (x > y).count_nonzero(1),
    "cross": lambda x, y: torch.linalg.cross(x, y, dim=0),
    "mm of a constant": lambda x, y: x.new_tensor([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]]) @ x[:, 0],
    "addmm": lambda x, y: torch.addmm(y[:2, 1], x.new_ones(2, 3), x[:, 0], beta=0.5, alpha=2),
    "mv": lambda x, y: x[:, 0].T.mv(x.new_tensor([1.0, 2.0, 3.0])),
    "bmm": lambda x, y: (x.permute(2, 0, 1) @ y.permute(2, 1, 0)).permute(1, 2, 0),
    "einsum of matrices": lambda x, y: torch.einsum("ijb,kjb->ikb", x, y),
    "einsum of vectors": lambda x, y: torch.einsum("ijb,ijb->b", x, y),
    "normalize": lambda x, y: functional.normalize(x, dim=0),
    "cosine_similarity": lambda x, y: functional.cosine_similarity(x, y, dim=0),
    "vecdot": lambda x, y: torch.linalg.vecdot(x, y, dim=0),
    "diff": lambda x, y: x.diff(dim=1),
    "huber_loss": lambda x, y: functional.smooth_l1_loss(x, y, reduction="none"),
}


def test_along_axes() -> None:
    assert_same(AXES, *uniform(-1.0, 1.0, 2, 3, 4, 50), atol=1e-15)


def test_reductions_of_what_is_no_number() -> None:
    x = torch.tensor(
        list(itertools.product((1.0, -0.5, math.inf, -math.inf, math.nan), repeat=3)), dtype=torch.float64
    )
    names = "sum mean amin amax argmin argmax any all logsumexp norm"
    functions = {name: lambda x, f=f: f(x, dim=0) for name, f in named(torch, names).items()}
    functions |= {"min": lambda x: x.min(0).values, "max": lambda x: x.max(0).values}
    functions |= {"norm inf": lambda x: x.norm(p=math.inf, dim=0), "which is min": lambda x: x.min(0).indices}
    assert_same(functions, x.T.contiguous())


# shapes

SHAPES: dict[str, Function] = {
    "view": lambda x, y: x.reshape(12, -1)[5:7],
    "flatten": lambda x, y: x.flatten(0, 1),
    "unflatten": lambda x, y: x.unflatten(1, (2, 2)),
    "transpose": lambda x, y: x.transpose(0, 1).reshape(12, -1),
    "movedim": lambda x, y: x.movedim(1, 0),
    "squeeze": lambda x, y: x[:1, None].squeeze(0).squeeze((0,)),
    "expand": lambda x, y: x[:, None].expand(-1, 2, 4, -1),
    "repeat": lambda x, y: x.repeat(2, 1, 1, 1),
    "tile": lambda x, y: x.tile(2, 1, 1),
    "repeat_interleave": lambda x, y: x.repeat_interleave(2, 0),
    "unbind": lambda x, y: torch.stack(x.unbind(1)[::-1]),
    "split": lambda x, y: torch.cat(x.split([1, 3], 1)[::-1], 1),
    "chunk": lambda x, y: torch.cat(x.chunk(2, 0)[::-1]),
    "narrow": lambda x, y: x.narrow(1, 1, 2),
    "steps": lambda x, y: x[::2, 1::2],
    "from the end": lambda x, y: x[-1, -3:],
    "flip": lambda x, y: x.flip(0, 1),
    "stack": lambda x, y: torch.stack((x, y), 1),
    "cat": lambda x, y: torch.cat((x, y), 0),
    "index of a list": lambda x, y: x[[2, 0]],
    "index of two lists": lambda x, y: x[[2, 0], [1, 3]],
    "index between": lambda x, y: x[:, [3, 0, 0]],
    "index of a known mask": lambda x, y: x[torch.tensor([True, False, True])],
    "index_select": lambda x, y: x.index_select(1, torch.tensor([0, 2])),
    "index_fill": lambda x, y: x.index_fill(0, torch.tensor([0, 2]), -1.0),
    "index_copy": lambda x, y: x.index_copy(0, torch.tensor([2, 0]), y[:2]),
    "gather": lambda x, y: x.gather(0, torch.tensor([[[1]], [[2]]]).expand(2, 4, x.shape[-1])),
    "gather at a computed index": lambda x, y: x.gather(1, y.argmin(1, keepdim=True).clamp(1, 2) - 1),
    "take_along_dim": lambda x, y: torch.take_along_dim(x, y.argmax(1, keepdim=True), 1),
    "tril": lambda x, y: x.permute(2, 0, 1).tril().permute(1, 2, 0),
    "new tensors": lambda x, y: x.new_full((2, 1), 3.0) * x[:2, 0] + x.new_zeros(2, 1) + torch.full_like(x[:2, 0], 2.0),
    "constants": lambda x, y: torch.eye(3, dtype=x.dtype) @ x[:, 0] + torch.linspace(0, 1, 3, dtype=x.dtype)[:, None],
}  # fmt: skip


def test_shapes() -> None:
    assert_same(SHAPES, *uniform(-1.0, 1.0, 2, 3, 4, 50))


# what is written in place


def written(write: Callable[[Tensor, Tensor], None]) -> Function:
    def run(x: Tensor, y: Tensor) -> Tensor:
        z = x.clone()
        write(z, y)
        return z

    return run


def by_views(x: Tensor, y: Tensor) -> None:
    flat = x.view(12, -1)
    flat[3:5] = y[0, :2]
    x.transpose(0, 1)[1, 2] += 1.0
    x[0].unsqueeze(0).mul_(2.0)
    x.permute(1, 0, 2)[-1].copy_(flat[:3])


IN_PLACE: dict[str, Function] = {
    "an entry": written(lambda x, y: x.__setitem__(0, y[1])),
    "a slice": written(lambda x, y: x.__setitem__(slice(1, 3), y[:2])),
    "a number": written(lambda x, y: x[1, ::2].fill_(3.0)),
    "zero": written(lambda x, y: x[2].zero_()),
    "a list": written(lambda x, y: x.__setitem__([2, 0], y[:2])),
    "two lists": written(lambda x, y: x.__setitem__(([2, 0], [1, 3]), y[0, :2])),
    "a sum": written(lambda x, y: x[1:].add_(y[1:], alpha=2)),
    "a product of itself": written(lambda x, y: x.mul_(x.flip(0))),
    "clamp": written(lambda x, y: x.clamp_(-0.1, 0.1)),
    "views": written(by_views),
    "masks": written(lambda x, y: x.masked_fill_(x > y, 1.0).__setitem__(x < 0.0, -1.0)),
    "signs": written(lambda x, y: x[1:].sgn_()),
    "entries filled": written(lambda x, y: x[1:].index_fill_(0, torch.tensor([1]), 2.0)),
    "entries copied": written(lambda x, y: x[1:].index_copy_(0, torch.tensor([0]), y[:1])),
}


def test_what_is_written_through_views_is_seen() -> None:
    assert_same(IN_PLACE, *uniform(-1.0, 1.0, 2, 3, 4, 50))


def test_new_tensors_are_filled_in_place() -> None:
    def control_matrix(x: Tensor, y: Tensor) -> Tensor:
        g = x.new_zeros(6, 2, x.shape[-1])
        g[:3, 0], g[3:, 1] = x[:, 0] * 2.0, y[:, 1]
        g[0, 1] = 0.5
        table = torch.tensor([[1.0], [2.0]], dtype=x.dtype)
        table[0] = 3.0
        return g * table

    def from_nothing(x: Tensor, y: Tensor) -> Tensor:
        out = torch.empty_like(x)
        for i in range(3):
            out[i] = x[i] * float(i)
        return out

    functions = {"control_matrix": control_matrix, "from_nothing": from_nothing}
    assert_same(functions, *uniform(-1.0, 1.0, 2, 3, 4, 9))


# types


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
    assert_same(functions, mask, count, x, y)
