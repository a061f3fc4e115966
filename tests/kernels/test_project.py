"""The functions of this project, printed: the same text for any example, and PyTorch's numbers to rounding."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

import main
from kernels.printer import Printed, printed
from rta.fast import filter as fast_filter
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from settings import load
from study import experiment
from study.config import Config

CONFIGS = Path(main.__file__).parent / "configs"
FILES = {
    "1 s": ["rta.toml"],
    "5 s": ["rta_5s.toml"],
    "U1": ["plants/u1.toml"],
    "hull": ["chiefs/box.toml", "chiefs/hull.toml"],
    "tumbling": ["chiefs/satellite.toml"],
}


def campaign(name: str) -> Any:
    return pytest.param(name, marks=pytest.mark.campaign)


class Call(NamedTuple):
    """Holds a call of `printed` or of `Compiled`."""

    function: Callable[..., list[Tensor]]
    examples: tuple[Tensor, ...]
    options: dict[str, Any]
    text: str


class StopError(Exception):
    """Signals that nothing needs to be built."""


@functools.cache
def config_of(name: str) -> Config:
    config = Config()
    for file in FILES[name]:
        config = load(CONFIGS / file, config)
    return config


def filter_of(name: str) -> SafetyFilter:
    return batched(experiment.filter_of(config_of(name)))


def calls_of_filter(name: str, monkeypatch: pytest.MonkeyPatch) -> list[Call]:
    """Returns the calls of `printed` for a filter."""
    calls: list[Call] = []
    safety_filter = filter_of(name)

    def spy(function: Callable[..., list[Tensor]], *examples: Tensor, **options: Any) -> Any:
        found = printed(function, *examples, **options)
        calls.append(Call(function, examples, options, text_of(found)))
        return found

    def library(_: dict[str, str]) -> None:
        raise StopError

    monkeypatch.setattr(fast_filter, "printed", spy)
    monkeypatch.setattr(fast_filter, "library", library)
    # nothing is printed where an earlier run's recording is found
    monkeypatch.setattr(fast_filter, "remembered", lambda function, *given: function(*given))
    with pytest.raises(StopError):
        fast(safety_filter)
    return calls


def text_of(found: Printed) -> str:
    """Returns all of the printed text."""
    return "\n".join([*found.parts, found.text, found.waiting])


def other(example: Tensor) -> Tensor:
    """Returns another column of the same type."""
    generator = torch.Generator().manual_seed(0)
    return (30.0 * torch.randn(example.shape, generator=generator)).to(example.dtype)


@pytest.mark.parametrize("name", ["1 s", *(campaign(name) for name in ("5 s", "U1", "hull"))])
def test_a_filter_is_printed_alike_for_any_example(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    check_prints(calls_of_filter(name, monkeypatch))


def check_prints(calls: list[Call]) -> None:
    assert calls
    for function, examples, options, text in calls:
        assert text == text_of(printed(function, *map(other, examples), **options)), options
