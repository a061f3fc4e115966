"""Deterministic evaluation over common test cases, in the paper's metrics (Sec. Final Model Performance)."""

import dataclasses
import math
from dataclasses import dataclass
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
from inspection.reward import stays_clear
from inspection.termination import OUTCOMES, failures
from inspection.transition import METRICS, Transition
from ppo.network import Policy
from rta.constraints.names import CONSTRAINTS
from rta.qp.programs import Status
from study.config import TEST_CASES, Config
from study.experiment import Experiment, case_numbers, test_cases
from study.flight.answers import in_full
from study.flight.controllers import agent, classical, untrained
from study.flight.simulation import Recording
from study.flight.summary import summary_of_runs
from study.machine.progress import bar

# Without the time that is left: the last episode may take as long as all before it, and nobody knows.
BAR = "{desc}: |{bar}| {n_fmt}/{total_fmt} ended [{elapsed}{postfix}]"
SUCCESS = OUTCOMES.index("success")


@dataclass
class Episodes:
    """Each episode's record; first axes as named, last axis the episodes.

    Attributes:
        metrics: (6, episodes) in the order of METRICS.
        violations: (13 + 1, episodes) percent of its steps, "any" last.
        violation_seconds: the same, percent of its integration steps.
        outcome: (episodes,) index into OUTCOMES.
        clear: (episodes,) bool, it succeeded and two days of free flight stay clear of the chief.
        filter_calls, interventions, failures, backup_calls: (episodes,) counts.
        filter_violations: (13, episodes) filter calls at which the constraint was violated.
        worst: (13, episodes) smallest constraint value after an integration step.
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
        """(episodes,) bool: succeeded, clear in free flight, and no limit violated after any integration step."""
        return self.clear & (self.violation_seconds[-1] == 0.0)

    def split(self, seeds: int) -> list["Episodes"]:
        """The episodes of each seed, where those of all follow one another."""
        parts = zip(*(values.chunk(seeds, -1) for values in vars(self).values()), strict=True)
        return [Episodes(*part) for part in parts]

    @classmethod
    def join(cls, records: list["Episodes"]) -> "Episodes":
        """The episodes of several records, one after another."""
        return cls(
            *(torch.cat([getattr(record, f.name) for record in records], -1) for f in dataclasses.fields(cls))
        )

    def named_extremes(self) -> dict[str, Tensor]:
        """What a person would check, as it was at its worst, by name: (episodes,)."""
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
    """What a person would check on states (16, B), signed so that the smallest is the worst: (8, B)."""
    sun, _ = sun_and_earth_in_body(x)
    distance = norm(x[P])
    return torch.stack(
        (
            distance,
            -distance,
            -norm(x[V]),
            -x[V].abs().amax(0),
            sun[0].clamp(-1.0, 1.0).arccos().rad2deg(),
            -x[T],
            x[E],
            -x[OMEGA].abs().amax(0).rad2deg(),
        )
    )


@torch.no_grad()
def run_episodes(
    env: InspectionEnv,
    controller: Controller,
    x: Tensor,
    priority: Tensor,
    recording: Recording | None = None,
    number: Tensor | None = None,
) -> Episodes:
    """Plays one episode per column of the environment from the given states, behind a bar of those that ended.

    Args:
        recording: of the environment, takes down the first episode.
        number: (B,) as of `InspectionEnv.start`.
    """
    env.start(x.to(env.x.device), priority.to(env.x.device), number)
    running = torch.ones_like(env.time, dtype=torch.bool)
    zeros = torch.zeros_like(env.time)
    constraints = len(env.safety.names)
    worst, extremes = Smallest(constraints, env.x), Smallest(len(RAW_QUANTITIES), env.x)
    record = Episodes(
        metrics=torch.full_like(zeros, math.nan).repeat(len(METRICS), 1),
        violations=zeros.repeat(constraints + 1, 1),
        violation_seconds=zeros.repeat(constraints + 1, 1),
        outcome=torch.full_like(env.steps, -1),
        clear=torch.zeros_like(running),
        filter_calls=zeros.clone(),
        interventions=zeros.clone(),
        failures=zeros.clone(),
        backup_calls=zeros.clone(),
        filter_violations=zeros.repeat(constraints, 1),
        worst=worst.value,
        extremes=extremes.value,
    )
    count = x.shape[1]
    what = f"flying {count:,} test case{'s' * (count > 1)}"

    def watch(hold: Hold) -> None:
        h = env.constraint_values(hold.after)
        worst.note(torch.where(running, h, math.inf))
        extremes.note(torch.where(running, raw_quantities(hold.after), math.inf))
        violated = (h < 0.0) & running
        record.violation_seconds += hold.seconds * torch.cat((violated, violated.any(0)[None]))
        if recording and not recording.ended:
            recording.note(hold)
            # at the end of an action the chief is looked at first
            failed = any(bool(each[0]) for each in failures(hold.after, env.c).values())
            if failed and hold.end < env.c.action_period:
                recording.end()

    with bar(count, "have ended", desc=what, leave=False, bar_format=BAR) as shown:
        while running.any():
            transition = env.advance(controller, watch)
            note_step(record, transition, running)
            ending = running & transition.done
            record.clear |= stays_clear(transition.state, ending & (transition.outcome == SUCCESS), env.c)
            if recording and not recording.ended and ending[0]:
                score = transition.metrics[METRICS.index("inspected_score"), :1]
                recording.end(inspected_score=score, inspected=transition.inspected[:, 0])
            running = running & ~ending
            flown = int(transition.steps.max()) * env.c.action_period
            shown.set_postfix_str(f"{flown:,.0f} s flown of at most {env.c.max_time:,.0f}", refresh=False)
            shown.update(count - int(running.sum()) - shown.n)
    record.worst, record.extremes = worst.value, extremes.value
    record.violation_seconds *= 100.0 / record.metrics[METRICS.index("episode_length_s")]
    return record


def note_step(record: Episodes, transition: Transition, running: Tensor) -> None:
    """Adds one step of the episodes still running, in place."""
    for correction, answered, true in transition.calls():
        asked = running & answered
        record.filter_calls += asked
        record.interventions += asked & correction.intervened
        answer = in_full(correction)
        record.failures += asked & (answer.status == Status.UNSOLVED)
        record.backup_calls += asked & answer.backup
        record.filter_violations += asked & (true < 0.0)
    ending = running & transition.done
    any_steps = transition.metrics[METRICS.index("violation_percent")]
    percent = torch.cat((100.0 * transition.violation_steps / transition.steps, any_steps[None]))
    record.metrics = torch.where(ending, transition.metrics, record.metrics)
    record.violations = torch.where(ending, percent, record.violations)
    record.outcome = torch.where(ending, transition.outcome, record.outcome)


def report(record: Episodes, config: Config, seed: int, seeds: int = 1) -> dict[str, Any]:
    """The content of `evaluate --json`.

    Args:
        seed: of the test cases; seeds: trained seeds whose episodes of the same cases follow one another.
    """
    names = ("any", *CONSTRAINTS)
    of_steps, of_seconds = (
        dict(zip(names, rows.mean(1).roll(1).tolist(), strict=True))
        for rows in (record.violations, record.violation_seconds)
    )
    calls = record.filter_calls.sum().item()
    rta: dict[str, Any] = {
        "period_s": config.rta.period if config.train.rta else None,
        "intervention_percent": 100.0 * record.interventions.sum().item() / calls if calls else 0.0,
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
        "config": dataclasses.asdict(config),
    }


def play(policy: Policy, experiment: Experiment, episodes: int, seed: int) -> Episodes:
    """Plays the same common test cases with every seed of a policy at once, deterministically, seed after seed."""
    return run_episodes(*played_by(policy, experiment, episodes, seed))


def play_and_record(
    policy: Policy, experiment: Experiment, episodes: int, seed: int
) -> tuple[Episodes, Recording]:
    """`play`, and the first episode over time."""
    env, controller, x, priority = played_by(policy, experiment, episodes, seed)
    recording = Recording(env)
    return run_episodes(env, controller, x, priority, recording), recording


def common_episode(policy: Policy, experiment: Experiment, case: int = 0) -> dict[str, np.ndarray]:
    """The agent's episode from a common test case until it ends, as `simulate` has it, a row per integration step."""
    c, generators = experiment.config.inspection, experiment.generators([TEST_CASES + 1])
    env = experiment.env(1, generators, report_every=min(experiment.config.rta.period, c.substep))
    cases = *test_cases(experiment.config, case + 1, TEST_CASES), case_numbers(case + 1, TEST_CASES)
    x, priority, number = (each[..., case:].to(experiment.device) for each in cases)
    recording = Recording(env)
    run_episodes(env, agent(policy, env), x, priority, recording, number)
    return recording.arrays()


def played_by(
    policy: Policy, experiment: Experiment, episodes: int, seed: int
) -> tuple[InspectionEnv, Controller, Tensor, Tensor]:
    """Who plays what: the environment, the agents of all seeds, and each one's states and priority vectors."""
    # for restarts of ended columns, which nobody sees
    generators = experiment.generators([seed + 1] * policy.seeds)
    env = experiment.env(episodes, generators, compiled=experiment.compiled)
    x, priority = test_cases(experiment.config, episodes, seed)
    return env, agent(policy, env), x.repeat(1, policy.seeds), priority.repeat(1, policy.seeds)


def play_controller(name: str, experiment: Experiment, episodes: int, seed: int) -> Episodes:
    """Plays the common test cases with one of EVALUATED.

    Those of GUIDANCE decide at every call of the filter, without it at every integration step. The others decide as an
    agent does, once an action period: `untrained` takes the mean actions of the policy with which `train --seed`
    begins, `random` draws uniform controls anew each time, both from `seed`, and `zero` coasts.
    """
    if name == "untrained":
        return play(untrained(experiment, seed), experiment, episodes, seed)
    config, every = experiment.config, None
    if name in GUIDANCE:
        every = config.rta.period if config.train.rta else config.inspection.substep
    generators = experiment.generators([seed + 1])
    env = experiment.env(episodes, generators, decide_every=every, compiled=experiment.compiled)
    return run_episodes(
        env,
        classical(name, env, seed, every or config.inspection.action_period),
        *test_cases(config, episodes, seed),
    )


def evaluate(commander: Policy | str, experiment: Experiment, episodes: int, seed: int) -> dict[str, Any]:
    """Plays the common test cases with a policy of one seed, or with one of EVALUATED, and reports them."""
    if isinstance(commander, str):
        record = play_controller(commander, experiment, episodes, seed)
    else:
        record = play(commander.to(experiment.device), experiment, episodes, seed)
    return report(record, experiment.config, seed)
