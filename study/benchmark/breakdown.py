"""Where the time of the closed loop goes: microseconds per environment step of each of its parts."""

import time
from collections import defaultdict
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any

import torch

from inspection.environment import InspectionEnv
from rta.filter import SafetyFilter
from study.flight.evaluation import Actor

STEPS = 10


class Stopwatch:
    """Adds up the seconds that functions take, by name."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds: dict[str, float] = defaultdict(float)

    def now(self) -> float:
        """s, when the device has done what it was asked."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def run(*args: Any, **kwargs: Any) -> Any:
            started = self.now()
            result = function(*args, **kwargs)
            self.seconds[name] += self.now() - started
            return result

        return run


def breakdown(env: InspectionEnv, safety_filter: SafetyFilter, actor: Actor) -> dict[str, float]:
    """Plays STEPS steps and returns microseconds per environment step.

    Args:
        env: started, of B episodes; its safety is set to the filter's.
        actor: what chooses the actions.

    Returns:
        "total", and its parts: "filter: rows" (all that is computed for every spacecraft), "filter: programs" (those
        that must be solved), "filter: rest", "integration", "visibility and k-means", "agent" and "rest".
    """
    watch = Stopwatch(env.x.device)
    safety_filter = copy(safety_filter)
    safety_filter._prepare = watch.timed("filter: rows", safety_filter._prepare)
    safety_filter.solver = copy(safety_filter.solver)
    safety_filter.solver.solve = watch.timed("filter: programs", safety_filter.solver.solve)  # type: ignore[method-assign]
    env.safety = replace(safety_filter.safety(), correct=watch.timed("filter", safety_filter))
    whole = {"integrate": "integration", "look": "visibility and k-means"}
    for method, name in whole.items():
        setattr(env, method, watch.timed(name, getattr(env, method)))
    act = watch.timed("agent", actor)

    def play() -> None:
        observation = env.observation()
        for _ in range(STEPS):
            observation = env.step(act(observation)).observation

    play()  # warm
    watch.seconds.clear()
    watch.timed("total", play)()
    for method in whole:
        delattr(env, method)
    us = {name: 1e6 * seconds / STEPS / env.time.numel() for name, seconds in watch.seconds.items()}
    of_filter = us.pop("filter")
    us["filter: rest"] = of_filter - us["filter: rows"] - us["filter: programs"]
    total = us.pop("total")
    us["rest"] = total - sum(us.values())
    order = ("filter: rows", "filter: programs", "filter: rest", *whole.values(), "agent", "rest")
    return {"total": total} | {name: us[name] for name in order}
