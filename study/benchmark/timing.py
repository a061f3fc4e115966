"""How long a call takes, and how often a second something can be done."""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import torch

REPEATS = 5
SHORTEST = 0.05  # s that a repeat lasts at least, for a clock's and a scheduler's sake
Spread = dict[str, float]  # "median", "min" and "max"


def now(device: torch.device) -> float:
    """s, when the device has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def seconds(function: Callable[[], Any], device: torch.device, calls: int = 1) -> float:
    """s that so many calls take."""
    started = now(device)
    for _ in range(calls):
        function()
    return now(device) - started


def typical_seconds(function: Callable[[], Any], device: torch.device, repeats: int) -> float:
    """Median time of a call in s, after one that is not timed."""
    function()
    return median(seconds(function, device) for _ in range(repeats))


def per_second(function: Callable[[], Any], work: float, device: torch.device) -> Spread:
    """`work` per s of REPEATS repeats, warmed up; each calls the function as often as SHORTEST needs."""
    return in_turn({"": function}, work, device)[""]


def in_turn(
    functions: Mapping[str, Callable[[], Any]], work: float, device: torch.device
) -> dict[str, Spread]:
    """`per_second` of several functions, a repeat of each after the other, so that all meet the same disturbances."""
    calls: dict[str, int] = {}
    rates: dict[str, list[float]] = {name: [] for name in functions}
    for name, function in functions.items():
        function()
        calls[name] = max(1, round(SHORTEST / seconds(function, device)))
    for _ in range(REPEATS):
        for name, function in functions.items():
            rates[name].append(work * calls[name] / seconds(function, device, calls[name]))
    return {name: {"median": median(own), "min": min(own), "max": max(own)} for name, own in rates.items()}


def us(rate: Spread) -> Spread:
    """Microseconds each from how many a second, and the other way round."""
    return {"median": 1e6 / rate["median"], "min": 1e6 / rate["max"], "max": 1e6 / rate["min"]}


class Stopwatch:
    """The s that each call of functions took, by name."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.calls: dict[str, list[float]] = defaultdict(list)

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def run(*args: Any, **kwargs: Any) -> Any:
            started = now(self.device)
            result = function(*args, **kwargs)
            self.calls[name].append(now(self.device) - started)
            return result

        return run
