"""Rates and times, by a clock of our own."""

import time

import pytest
import torch

from study.benchmark import timing

CPU = torch.device("cpu")


class Clock:
    """Work that takes as many s as it is told, and nothing else takes any; counts how often it is done."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.calls = 0.0, 0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def work(self, seconds: float = 0.01) -> str:
        self.now += seconds
        self.calls += 1
        return "done"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_a_rate_is_work_over_time(clock: Clock) -> None:
    rate = timing.per_second(clock.work, 5.0, CPU)
    assert rate == pytest.approx({"median": 500.0, "min": 500.0, "max": 500.0})
    assert timing.REPEATS >= 5
    assert clock.calls == 2 + 5 * timing.REPEATS  # 0.05 s a repeat


def test_a_spread_has_the_extremes(clock: Clock) -> None:
    durations = iter([1.0, 1.0, 0.5, 0.25, 1.0, 2.0, 4.0])  # the first two are no repeats
    rate = timing.per_second(lambda: clock.work(next(durations)), 1.0, CPU)
    assert rate == {"median": 1.0, "min": 0.25, "max": 4.0}
    assert timing.us(rate) == {"median": 1e6, "min": 0.25e6, "max": 4e6}


def test_several_functions_take_turns(clock: Clock) -> None:
    order: list[str] = []

    def of(name: str, seconds: float) -> None:
        order.append(name)
        clock.work(seconds)

    found = timing.in_turn({"a": lambda: of("a", 1.0), "b": lambda: of("b", 2.0)}, 6.0, CPU)
    assert {name: rate["median"] for name, rate in found.items()} == {"a": 6.0, "b": 3.0}
    assert order == ["a", "a", "b", "b"] + ["a", "b"] * timing.REPEATS


def test_a_typical_time_leaves_out_the_first_call(clock: Clock) -> None:
    durations = iter([100.0, 1.0, 3.0, 2.0])
    assert timing.typical_seconds(lambda: clock.work(next(durations)), CPU, 3) == 2.0


def test_a_stopwatch_keeps_each_call_and_the_answer(clock: Clock) -> None:
    watch = timing.Stopwatch(CPU)
    work = watch.timed("work", clock.work)
    assert [work(0.5), work(seconds=0.25)] == ["done", "done"]
    assert watch.calls == {"work": [0.5, 0.25]}
