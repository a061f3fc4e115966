"""Where the time of the closed loop goes: microseconds per environment step of each of its parts."""

from copy import copy
from dataclasses import replace

from inspection.environment import InspectionEnv
from rta.filter import SafetyFilter
from study.benchmark.flights import Agent
from study.benchmark.timing import Stopwatch

STEPS = 10


def breakdown(env: InspectionEnv, safety_filter: SafetyFilter, agent: Agent) -> dict[str, float]:
    """Plays STEPS steps and returns microseconds per environment step.

    Args:
        env: started, of B episodes.

    Returns:
        "total", and its parts: "filter", "integration", "visibility and k-means", "agent" and "rest".
    """
    watch = Stopwatch(env.x.device)
    env, agent = copy(env), watch.timed("agent", agent)
    env.put_behind(replace(safety_filter.safety(), correct=watch.timed("filter", safety_filter.correct)))
    vars(env)["integrate"] = watch.timed("integration", env.integrate)
    env.sight = copy(env.sight)
    vars(env.sight)["mark"] = watch.timed("visibility and k-means", env.sight.mark)

    def play() -> None:
        observation = env.observation()
        for _ in range(STEPS):
            observation = env.step(agent(observation)).observation

    play()  # warm
    watch.calls.clear()
    watch.timed("total", play)()
    us = {name: 1e6 * sum(calls) / STEPS / env.time.numel() for name, calls in watch.calls.items()}
    total = us.pop("total")
    us["rest"] = total - sum(us.values())
    order = ("filter", "integration", "visibility and k-means", "agent", "rest")
    return {"total": total} | {name: us[name] for name in order}
