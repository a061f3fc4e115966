"""Deterministic evaluation over common test cases, in the paper's metrics (Sec. Final Model Performance)."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from inspection import guidance
from inspection.attitude import norm
from inspection.dynamics import sun_and_earth_in_body
from inspection.environment import METRICS, OUTCOMES, InspectionEnv, Safety, Transition
from inspection.initial_state import InitialStates
from inspection.state import CONTROL_SIZE, OMEGA, E, P, T, V
from ppo.network import Policy
from rta.constraints import CONSTRAINTS
from rta.parameters import RtaParameters
from rta.qp import Status
from rta.rows import Barriers
from study import experiment as build
from study.config import Config
from study.errors import refusing
from study.flight.summary import summary_of_runs

Actor = Callable[[Tensor], Tensor]  # observations (B, 26) to actions (B, 6)


def policy_actor(policy: Policy) -> Actor:
    """Deterministic actions of a policy of S seeds, whose columns follow one another as the environment's do."""
    seeds = policy.network.layers[0].weight.shape[0]
    return lambda observation: policy.mean_action(observation.unflatten(0, (seeds, -1))).flatten(0, 1)


def test_cases(config: Config, episodes: int, seed: int) -> tuple[Tensor, Tensor]:
    """Initial states (16, episodes) and priority vectors (3, episodes), the same for every agent and device.

    Case i does not depend on how many cases there are.
    """
    # default gains, so that agents trained behind different filters meet the same cases
    gains = RtaParameters(passive_safety_segments=config.rta.passive_safety_segments)
    is_safe = Barriers(config.inspection, gains, period=1.0).is_safe
    with refusing("[inspection]", RuntimeError):
        return InitialStates(torch.Generator().manual_seed(seed), config.inspection, is_safe).take(episodes)


@dataclass
class Episodes:
    """Each episode's record; first axes as named, last axis the episodes.

    Attributes:
        metrics: (6, episodes) in the order of METRICS.
        violations: (13 + 1, episodes) percent of its steps, "any" last.
        outcome: (episodes,) index into OUTCOMES.
        filter_calls, interventions, failures: (episodes,) counts.
        filter_violations: (13, episodes) filter calls at which the constraint was violated.
        worst: (13, episodes) smallest constraint value at the end of a step.
        extremes: name to (episodes,), raw quantities at the end of a step.
    """

    metrics: Tensor
    violations: Tensor
    outcome: Tensor
    filter_calls: Tensor
    interventions: Tensor
    failures: Tensor
    filter_violations: Tensor
    worst: Tensor
    extremes: dict[str, Tensor]

    def split(self, seeds: int) -> list["Episodes"]:
        """The episodes of each seed, where those of all follow one another."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "extremes"]
        arrays = {name: getattr(self, name).chunk(seeds, -1) for name in names}
        extremes = {name: values.chunk(seeds) for name, values in self.extremes.items()}
        return [
            Episodes(
                **{name: parts[k] for name, parts in arrays.items()},
                extremes={name: parts[k] for name, parts in extremes.items()},
            )
            for k in range(seeds)
        ]

    @classmethod
    def join(cls, records: list["Episodes"]) -> "Episodes":
        """The episodes of several records, one after another."""
        if len(records) == 1:
            return records[0]
        names = [field.name for field in dataclasses.fields(cls) if field.name != "extremes"]
        return cls(
            **{name: torch.cat([getattr(record, name) for record in records], -1) for name in names},
            extremes={
                name: torch.cat([record.extremes[name] for record in records]) for name in records[0].extremes
            },
        )


def raw_quantities(x: Tensor) -> dict[str, Tensor]:
    """What a person would check on states (16, B): each (B,), signed so that the smallest is the worst."""
    sun, _ = sun_and_earth_in_body(x)
    return {
        "min_distance_m": norm(x[P]),
        "max_distance_m": -norm(x[P]),
        "max_speed_m_s": -norm(x[V]),
        "max_axis_speed_m_s": -x[V].abs().amax(0),
        "min_sun_angle_deg": sun[0].clamp(-1.0, 1.0).arccos().rad2deg(),
        "max_temperature_deg_c": -x[T],
        "min_energy_kj": x[E],
        "max_rate_deg_s": -x[OMEGA].abs().amax(0).rad2deg(),
    }


@torch.no_grad()
def run_episodes(env: InspectionEnv, actor: Actor, x: Tensor, priority: Tensor) -> Episodes:
    """Plays one episode per column of the environment from the given states."""
    device = env.x.device
    observation = env.start(x.to(device), priority.to(device))
    running = torch.ones_like(env.time, dtype=torch.bool)
    zeros = torch.zeros_like(env.time)
    constraints = len(env.safety.names)
    record = Episodes(
        metrics=torch.full((len(METRICS), running.numel()), math.nan, dtype=zeros.dtype, device=device),
        violations=zeros.repeat(constraints + 1, 1),
        outcome=torch.full_like(env.steps, -1),
        filter_calls=zeros.clone(),
        interventions=zeros.clone(),
        failures=zeros.clone(),
        filter_violations=zeros.repeat(constraints, 1),
        worst=torch.full((constraints, running.numel()), math.inf, dtype=zeros.dtype, device=device),
        extremes={name: torch.full_like(zeros, math.inf) for name in raw_quantities(env.x)},
    )
    while running.any():
        transition = env.step(actor(observation))
        note(record, transition, running, env.safety)
        running = running & ~transition.done
        observation = transition.observation
    record.extremes = {n: -v if n.startswith("max") else v for n, v in record.extremes.items()}
    return record


def note(record: Episodes, transition: Transition, running: Tensor, safety: Safety) -> None:
    """Adds one step of the episodes still running, in place."""
    for correction in transition.corrections:
        record.filter_calls += running
        record.interventions += running & correction.intervened
        record.failures += running & (correction.status == Status.UNSOLVED)
        record.filter_violations += running & (correction.h < 0.0)
    h = torch.where(running, safety.values(transition.state), math.inf)
    record.worst = torch.minimum(record.worst, h)
    for name, value in raw_quantities(transition.state).items():
        record.extremes[name] = torch.minimum(record.extremes[name], torch.where(running, value, math.inf))
    ending = running & transition.done
    any_steps = transition.metrics[METRICS.index("violation_percent")]
    percent = torch.cat((100.0 * transition.violation_steps / transition.steps, any_steps[None]))
    record.metrics = torch.where(ending, transition.metrics, record.metrics)
    record.violations = torch.where(ending, percent, record.violations)
    record.outcome = torch.where(ending, transition.outcome, record.outcome)


def report(
    record: Episodes, config: Config, rta: bool, period: float, seed: int, seeds: int = 1
) -> dict[str, Any]:
    """The content of `evaluate --json`.

    Args:
        seed: of the test cases; seeds: trained seeds whose episodes of the same cases follow one another.
    """
    percent = dict(zip((*CONSTRAINTS, "any"), record.violations.mean(1).tolist(), strict=True))
    calls = record.filter_calls.sum().item()
    results = {
        "metrics": {
            name: summary_of_runs(values.reshape(seeds, -1))
            for name, values in zip(METRICS, record.metrics.cpu().numpy(), strict=True)
        },
        "violations_percent": {"any": percent.pop("any")} | percent,
        "outcomes": {
            name: (record.outcome == OUTCOMES.index(name)).double().mean().item()
            for name in ("success", "crash", "out_of_bounds", "out_of_power", "timeout")
        },
        "rta": {
            "period_s": period if rta else None,
            "intervention_percent": 100.0 * record.interventions.sum().item() / calls if calls else 0.0,
            "qp_failures": int(record.failures.sum().item()),
        },
        "worst_constraint_value": dict(zip(CONSTRAINTS, record.worst.amin(1).tolist(), strict=True)),
        "extremes": {
            name: (values.amax() if name.startswith("max") else values.amin()).item()
            for name, values in record.extremes.items()
        },
        "episodes": record.outcome.numel(),
        "seed": seed,
        "config": dataclasses.asdict(config),
    }
    if calls:
        filter_steps = (100.0 * record.filter_violations.sum(1) / calls).tolist()
        results["rta"]["filter_step_violations_percent"] = dict(zip(CONSTRAINTS, filter_steps, strict=True))
    return results


def common_start(
    config: Config,
    episodes: int,
    seed: int,
    device: torch.device,
    safety: Safety,
    compiled: bool = False,
    agents: int = 1,
) -> tuple[InspectionEnv, Tensor, Tensor]:
    """An environment for the common test cases of so many agents at once, and what to start its columns from.

    Returns:
        The environment, its states (16, agents * episodes) and its priority vectors (3, agents * episodes).
    """
    # for restarts of ended columns, which nobody sees
    generators = [torch.Generator(device).manual_seed(seed + 1) for _ in range(agents)]
    env = build.make_env(config, episodes, generators, safety, compiled)
    x, priority = test_cases(config, episodes, seed)
    return env, x.repeat(1, agents), priority.repeat(1, agents)


def play(
    policy: Policy,
    config: Config,
    episodes: int,
    seed: int,
    device: torch.device,
    safety: Safety,
    compiled: bool = False,
) -> Episodes:
    """Plays the same common test cases with every seed of a policy at once, deterministically, seed after seed."""
    seeds = policy.network.layers[0].weight.shape[0]
    env, x, priority = common_start(config, episodes, seed, device, safety, compiled, seeds)
    return run_episodes(env, policy_actor(policy), x, priority)


def play_guidance(config: Config, episodes: int, seed: int, device: torch.device, safety: Safety) -> Episodes:
    """Plays the common test cases with the natural-motion controller, asked as `InspectionEnv.command` is."""
    env, x, priority = common_start(config, episodes, seed, device, safety)
    controller = guidance.natural_motion(config.inspection)
    env.command = lambda x: controller(0.0, x)  # a function of the state alone
    idle = torch.zeros(episodes, CONTROL_SIZE, device=device)
    return run_episodes(env, lambda observation: idle, x, priority)


def evaluate(
    policy: Policy,
    config: Config,
    episodes: int,
    seed: int,
    device: torch.device,
    safety: Safety,
    compiled: bool = False,
) -> dict[str, Any]:
    """Plays the common test cases with a policy of one seed and reports them."""
    record = play(policy, config, episodes, seed, device, safety, compiled)
    return report(record, config, safety.correct is not None, safety.period, seed)
