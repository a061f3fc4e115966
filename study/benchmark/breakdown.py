"""Where the time of the closed loop goes: microseconds per environment step of each of its parts."""

from copy import copy
from dataclasses import replace

from inspection.environment import InspectionEnv
from rta.filter import SafetyFilter
from study.benchmark.flights import Agent
from study.benchmark.timing import Stopwatch

STEPS = 10
WHOLE = {"integrate": "integration", "look": "visibility and k-means"}  # methods of the simulator


def breakdown(env: InspectionEnv, safety_filter: SafetyFilter, agent: Agent) -> dict[str, float]:
    """Plays STEPS steps and returns microseconds per environment step.

    Args:
        env: started, of B episodes.

    Returns:
        "total", and its parts: "filter: rows" (all that is computed for every spacecraft), "filter: programs" (those
        that must be solved), "filter: rest", "integration", "visibility and k-means", "agent" and "rest".
    """
    watch = Stopwatch(env.x.device)
    env, timed, agent = copy(env), copy(safety_filter), watch.timed("agent", agent)
    # a copy is not compiled, so the parts are the given filter's own
    timed._prepare = watch.timed("filter: rows", safety_filter._prepare)
    timed._prepare_held = [watch.timed("filter: rows", run) for run in safety_filter._prepare_held]
    timed._predict = watch.timed("filter: rows", safety_filter._predict)
    timed.solver = copy(safety_filter.solver)
    timed.solver.solve = watch.timed("filter: programs", safety_filter.solver.solve)  # type: ignore[method-assign]
    env.put_behind(replace(timed.safety(), correct=watch.timed("filter", timed.correct)))
    for method, name in WHOLE.items():
        setattr(env, method, watch.timed(name, getattr(env, method)))

    def play() -> None:
        observation = env.observation()
        for _ in range(STEPS):
            observation = env.step(agent(observation)).observation

    play()  # warm
    watch.calls.clear()
    watch.timed("total", play)()
    us = {name: 1e6 * sum(calls) / STEPS / env.time.numel() for name, calls in watch.calls.items()}
    us["filter: rest"] = us.pop("filter") - us["filter: rows"] - us["filter: programs"]
    total = us.pop("total")
    us["rest"] = total - sum(us.values())
    order = ("filter: rows", "filter: programs", "filter: rest", *WHOLE.values(), "agent", "rest")
    return {"total": total} | {name: us[name] for name in order}
