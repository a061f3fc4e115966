"""Deterministic evaluation over common test cases, in the paper's metrics (Sec. Final Model Performance)."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Controller, Hold, Smallest
from inspection.environment import InspectionEnv
from inspection.model.attitude import norm
from inspection.model.dynamics import sun_and_earth_in_body
from inspection.model.state import OMEGA, E, P, T, V
from inspection.orbits import GUIDANCE
from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from ppo.network import Policy
from rta.names import CONSTRAINTS
from rta.result import Status
from study.config import TEST_CASES, Config
from study.experiment import Experiment, test_cases
from study.flight.controllers import agent, classical
from study.flight.fly import Limits, Observer, Progress, Starts, fly
from study.flight.simulation import Recording
from study.flight.summary import summary_of_runs
from study.machine import bar

# The bar does not estimate the remaining time, because the last episode may take as long as all before it.
BAR = "{desc}: |{bar}| {n_fmt}/{total_fmt} ended [{elapsed}{postfix}]"


@dataclass
class Episodes:
    """Holds the record of each episode; first axes as named, last axis the episodes.

    Attributes:
        metrics: (6, episodes) in the order of METRICS.
        violations: (constraints + 1, episodes) percent of its steps, "any" last.
        violation_seconds: the same, percent of its integration steps.
        outcome: (episodes,) index into OUTCOMES.
        clear: (episodes,) bool, the episode succeeded and two days of free flight stay clear of the chief.
        filter_calls, interventions, failures, backup_calls: (episodes,) counts.
        filter_violations: (constraints, episodes) filter calls at which the constraint was violated.
        worst: (constraints, episodes) smallest constraint value, at the start or after an integration step.
        extremes: (8, episodes) smallest `raw_quantities` after an integration step.
    """

    metrics: Tensor
    violations: Tensor
    violation_seconds: Tensor
    outcome: Tensor
    clear: Tensor
    filter_calls: Tensor
    interventions: Tensor
    failures: Tensor
    backup_calls: Tensor
    filter_violations: Tensor
    worst: Tensor
    extremes: Tensor

    @property
    def clean(self) -> Tensor:
        """Returns (episodes,) bool: success, clear in free flight, and no limit violated after any integration step."""
        return self.clear & (self.violation_seconds[-1] == 0.0)

    def split(self, seeds: int) -> list["Episodes"]:
        """Returns the episodes of each seed from a record in which the seeds follow one another."""
        parts = zip(*(values.chunk(seeds, -1) for values in vars(self).values()), strict=True)
        return [Episodes(*part) for part in parts]

    @classmethod
    def join(cls, records: list["Episodes"]) -> "Episodes":
        """Returns the episodes of several records, one after another."""
        parts = zip(*(vars(record).values() for record in records), strict=True)
        return cls(*(torch.cat(part, -1) for part in parts))

    def named_extremes(self) -> dict[str, Tensor]:
        """Returns by name the worst value (episodes,) of each of RAW_QUANTITIES, with its natural sign."""
        rows = zip(RAW_QUANTITIES, self.extremes, strict=True)
        return {name: -row if name.startswith("max") else row for name, row in rows}


RAW_QUANTITIES = (
    "min_distance_m",
    "max_distance_m",
    "max_speed_m_s",
    "max_axis_speed_m_s",
    "min_sun_angle_deg",
    "max_temperature_deg_c",
    "min_energy_kj",
    "max_rate_deg_s",
)


def raw_quantities(x: Tensor) -> Tensor:
    """Returns RAW_QUANTITIES of states (16, B), signed so that the smallest is the worst: (8, B)."""
    sun_angle = sun_and_earth_in_body(x)[0][0].clamp(-1.0, 1.0).arccos().rad2deg()
    distance, component, rate = norm(x[P]), x[V].abs().amax(0), x[OMEGA].abs().amax(0).rad2deg()
    return torch.stack((distance, -distance, -norm(x[V]), -component, sun_angle, -x[T], x[E], -rate))


class Extremes(Observer):
    """Keeps the smallest `raw_quantities` after a hold, (8, B)."""

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.smallest = Smallest(len(RAW_QUANTITIES), env.x)

    def hold(self, hold: Hold, running: Tensor) -> None:
        self.smallest.note(torch.where(running, raw_quantities(hold.after), math.inf))


def run_episodes(
    env: InspectionEnv, controller: Controller, starts: Starts, recording: Recording | None = None
) -> Episodes:
    """Plays one episode per column of the environment to its end, and shows on a bar how many have ended.

    Args:
        recording: records the first episode.
    """
    count, extremes = starts.x.shape[1], Extremes()
    what = f"flying {count:,} test case{'s' * (count > 1)}"
    with bar(count, "have ended", desc=what, leave=False, bar_format=BAR) as shown:
        observers = [extremes, Progress(shown), *([recording] if recording else [])]
        record = fly(env, controller, starts, observers=observers)
    assert record.ends
    limits, calls, ends = record.limits, record.calls, record.ends
    seconds = (limits.violating - limits.at_start) * env.clocks.hold
    return Episodes(
        metrics=ends.metrics,
        violations=ends.violations,
        violation_seconds=100.0 * seconds / ends.metrics[METRICS.index("episode_length_s")],
        outcome=ends.outcome,
        clear=ends.clear,
        filter_calls=calls.count,
        interventions=calls.intervened,
        failures=calls.status[Status.UNSOLVED],
        backup_calls=calls.backup,
        filter_violations=calls.violated,
        worst=limits.worst,
        extremes=extremes.smallest.value,
    )


def report(record: Episodes, config: Config, seed: int, seeds: int = 1) -> dict[str, Any]:
    """Returns the content of `evaluate --json`.

    Args:
        seed: of the test cases; seeds: number of trained seeds, whose episodes of the same cases follow one another.
    """
    names = ("any", *CONSTRAINTS)
    of_steps, of_seconds = (
        dict(zip(names, rows.mean(1).roll(1).tolist(), strict=True))
        for rows in (record.violations, record.violation_seconds)
    )
    calls = record.filter_calls.sum().item()
    rta: dict[str, Any] = {
        "period_s": config.rta.period if config.train.rta else None,
        "intervention_percent": 100.0 * record.interventions.sum().item() / max(calls, 1.0),
        "qp_failures": int(record.failures.sum().item()),
        "backup_calls": int(record.backup_calls.sum().item()),
    }
    if calls:
        filter_steps = (100.0 * record.filter_violations.sum(1) / calls).tolist()
        rta["filter_step_violations_percent"] = dict(zip(CONSTRAINTS, filter_steps, strict=True))
    return {
        "metrics": {
            name: summary_of_runs(values.reshape(seeds, -1))
            for name, values in zip(METRICS, record.metrics.cpu().numpy(), strict=True)
        },
        "violations_percent": of_steps,
        "violations_percent_of_seconds": of_seconds,
        "outcomes": {
            name: (record.outcome == OUTCOMES.index(name)).double().mean().item()
            for name in ("success", "crash", "out_of_bounds", "out_of_power", "timeout")
        }
        | {"clean_success": record.clean.double().mean().item()},
        "rta": rta,
        "worst_constraint_value": dict(zip(CONSTRAINTS, record.worst.amin(1).tolist(), strict=True)),
        "extremes": {
            name: (values.amax() if name.startswith("max") else values.amin()).item()
            for name, values in record.named_extremes().items()
        },
        "episodes": record.outcome.numel(),
        "seed": seed,
        "config": asdict(config),
    }


def play(
    policy: Policy, experiment: Experiment, episodes: int, seed: int, recording: Recording | None = None
) -> Episodes:
    """Plays the same common test cases with every seed of a policy at once, deterministically, seed after seed.

    Args:
        recording: records the first episode.
    """
    env = experiment.env(episodes, experiment.generators([seed] * policy.seeds), compiled=experiment.compiled)
    starts = test_cases(experiment.config, episodes, seed).repeat(policy.seeds)
    return run_episodes(env, agent(policy, env), starts, recording)


def common_episode(policy: Policy, experiment: Experiment, case: int = 0) -> dict[str, np.ndarray]:
    """Returns the agent's episode from a common test case to its end in the form of `simulate`, a row per substep."""
    every = min(experiment.config.rta.period, experiment.config.inspection.substep)
    env, recording = experiment.env(1, report_every=every), Recording()
    start = test_cases(experiment.config, case + 1, TEST_CASES).one(case)
    run_episodes(env, agent(policy, env), start, recording)
    return recording.arrays()


def play_controller(name: str, experiment: Experiment, episodes: int, seed: int) -> Episodes:
    """Plays the common test cases with one of EVALUATED.

    Controllers of GUIDANCE decide at every call of the filter, or without filter at every integration step. The others
    decide once per action period, as an agent does: `untrained` takes the mean actions of the policy with which `train
    --seed` begins, `random` draws uniform controls each time, both from `seed`, and `zero` coasts.
    """
    if name == "untrained":
        begun = experiment.policy(experiment.generators([seed]))
        return play(begun, experiment, episodes, seed)
    config, every = experiment.config, None
    if name in GUIDANCE:
        every = config.rta.period if config.train.rta else config.inspection.substep
    env = experiment.env(episodes, decide_every=every, compiled=experiment.compiled)
    controller = classical(name, env, seed, every or config.inspection.action_period)
    return run_episodes(env, controller, test_cases(config, episodes, seed))


def evaluate(commander: Policy | str, experiment: Experiment, episodes: int, seed: int) -> dict[str, Any]:
    """Plays the common test cases with a policy of one seed, or with one of EVALUATED, and reports them."""
    if isinstance(commander, str):
        record = play_controller(commander, experiment, episodes, seed)
    else:
        record = play(commander.to(experiment.device), experiment, episodes, seed)
    return report(record, experiment.config, seed)
