"""The Monte Carlo campaign: how often, and how badly, any constraint is violated behind the filter."""

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import beta, qmc
from torch import Tensor
from tqdm import tqdm

from inspection.environment import InspectionEnv
from inspection.guidance import Controller
from inspection.initial_state import MAX_ATTEMPTS, sample_initial_state, spherical
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from ppo.network import Policy
from rta.constraints import CONSTRAINTS
from rta.filter import SafetyFilter, make_solver
from rta.qp import Status
from rta.rows import Barriers
from study import build
from study.config import Config, from_toml
from study.errors import InputError, refusing
from study.offline import read_arrays

BATCH = 1024  # episodes at once
FARTHEST = 795.0  # m, of the safe set's initial states
LONGEST_HOLD = 60  # s that the random policy holds an action
CONFIDENCE = 0.95
OUTCOMES = tuple(status.name.lower() for status in Status)


def safe_set(count: int, seed: int, barriers: Barriers) -> tuple[Tensor, Tensor, int]:
    """Initial states from the whole safe set: every h and every Psi_1 is non-negative.

    A Latin hypercube over distance up to FARTHEST, speed up to the limit there, all directions and attitudes,
    body rates, temperature and energy down to their limits and the Sun's angle. States beyond the filter's own
    keep-in barrier, where not every attitude has the thrust to follow it (`Barriers.can_brake`), are left out
    and counted.

    Returns:
        States (16, count), priority vectors (3, count) and how many states were left out.

    Raises:
        RuntimeError: fewer were found in 1000 hypercubes.
    """
    c = barriers.c
    sampler = qmc.LatinHypercube(16, rng=np.random.default_rng(seed))
    kept, left_out = torch.zeros(SIZE + 3, 0, dtype=torch.float64), 0
    for _ in range(MAX_ATTEMPTS):
        if kept.shape[1] >= count:
            return kept[:SIZE, :count], kept[SIZE:, :count], left_out
        s = torch.from_numpy(sampler.random(4 * count).T.copy())
        turn, lean = 2 * math.pi * s, (2 * s - 1).arcsin()  # azimuth, and elevation uniform on the sphere
        distance = c.collision_radius + (FARTHEST - c.collision_radius) * s[0]
        x = torch.zeros(SIZE, 4 * count, dtype=torch.float64)
        x[P] = spherical(distance, turn[1], lean[2])
        x[V] = spherical((c.docking_speed + c.speed_slope * distance) * s[3], turn[4], lean[5])
        # uniform rotations from three uniform numbers (Shoemake 1992)
        low, high = (1 - s[6]).sqrt(), s[6].sqrt()
        x[Q] = torch.stack(
            (low * turn[7].sin(), low * turn[7].cos(), high * turn[8].sin(), high * turn[8].cos())
        )
        x[OMEGA] = c.max_rate * (2 * s[9:12] - 1)
        x[T] = c.initial_temperature[0] + (c.max_temperature - c.initial_temperature[0]) * s[12]
        x[E] = c.min_energy + (c.initial_energy[1] - c.min_energy) * s[13]
        x[THETA_S] = turn[14]
        priority = spherical(torch.ones_like(distance), turn[15], lean[0])
        safe = torch.cat((x, priority))[:, barriers.is_in_safe_set(x)]
        can_brake = barriers.can_brake(safe[:SIZE])
        kept = torch.cat((kept, safe[:, can_brake]), 1)
        left_out += int((~can_brake).sum())
    raise RuntimeError(f"only {kept.shape[1]} of {count} initial states found in the safe set")


def initial_states(count: int, seed: int, barriers: Barriers) -> tuple[Tensor, Tensor, int]:
    """The paper's distribution first, then as many from the safe set; returns as `safe_set`."""
    generator = torch.Generator().manual_seed(seed)
    paper = sample_initial_state(count - count // 2, generator, barriers.c, barriers.is_safe)
    x, priority, left_out = safe_set(count // 2, seed, barriers)
    return torch.cat((paper[0], x), 1), torch.cat((paper[1], priority), 1), left_out


def held_at_random(c: InspectionParameters, generator: torch.Generator) -> Controller:
    """Uniformly random controls, each held for a uniformly random time of whole seconds."""
    held: dict[str, Tensor] = {}

    def control(t: float, x: Tensor) -> Tensor:
        draw = torch.rand(CONTROL_SIZE + 1, x.shape[1], generator=generator, dtype=torch.float64).to(x)
        fresh = (2.0 * draw[:CONTROL_SIZE] - 1.0) * x.new_tensor(c.control_limit)[:, None]
        until = t + (draw[CONTROL_SIZE] * LONGEST_HOLD).ceil()
        if held:
            keep = held["until"] > t
            fresh = torch.where(keep, held["u"], fresh)
            until = torch.where(keep, held["until"], until)
        held.update(u=fresh, until=until)
        return fresh

    return control


def adversarial(safety_filter: SafetyFilter) -> Controller:
    """Full control along the steepest descent of the worst thrust row and of the worst torque row.

    The worst row is the one that zero control comes closest to breaking, in units of the actuators' limits.
    """

    def control(t: float, x: Tensor) -> Tensor:
        halves = []
        for rows, limit in zip(safety_filter.rows(x), safety_filter.limits, strict=True):
            a = rows.a * limit
            worst = (rows.b / a.norm(dim=1).clamp(min=1e-9)).argmin(0)
            descent = -a.gather(0, worst.expand(1, 3, -1))[0]
            halves.append(limit * descent / descent.abs().amax(0).clamp(min=1e-12))
        return torch.cat(halves)

    return control


def agent(policy: Policy, env: InspectionEnv) -> Controller:
    """The agent's mean action once per action period; `env` keeps what has been inspected."""

    def control(t: float, x: Tensor) -> Tensor:
        env.x = x
        if t > 0.0:
            env.look()
        action = policy.mean_action(env.observation()[None])[0]
        return action.T.to(x.dtype).clamp(-1.0, 1.0) * env.limit

    return control


@dataclasses.dataclass
class Flight:
    """What a batch of episodes did; last axis the episodes, "any" last among 13 + 1 constraints.

    Attributes:
        violating: (14, B) steps at which the constraint was negative, out of `steps`.
        worst: (13, B) smallest value; when: (13, B) s.
        status: (4, B) filter calls by `Status`.
        yielded: (13, B) calls at which a row had slack; slack: (13, B) its largest.
        excess: (B,) largest control in units of its actuator's limit.
        start: (16 + 3, B) initial states and priority vectors; desired, applied: (steps, 6, B) controls.
    """

    violating: Tensor
    worst: Tensor
    when: Tensor
    status: Tensor
    yielded: Tensor
    slack: Tensor
    excess: Tensor
    start: Tensor
    desired: Tensor
    applied: Tensor


@torch.no_grad()
def fly(
    env: InspectionEnv, controller: Controller, x: Tensor, priority: Tensor, duration: float, decide: float
) -> Flight:
    """Flies one episode per column behind the environment's filter, checked at every second.

    Args:
        x, priority: initial states (16, B) and priority vectors (3, B).
        duration: s; decide: s between two desired controls. In between the filter is given its own last one.
    """
    env.start(x, priority)
    steps, period, batch = round(duration), round(env.safety.period), x.shape[1]
    tally = x.new_zeros(len(CONSTRAINTS), batch)
    flight = Flight(
        violating=x.new_zeros(len(CONSTRAINTS) + 1, batch),
        worst=torch.full_like(tally, torch.inf),
        when=tally.clone(),
        status=x.new_zeros(len(Status), batch),
        yielded=tally.clone(),
        slack=tally.clone(),
        excess=x.new_zeros(batch),
        start=torch.cat((x, priority)),
        desired=x.new_zeros(steps, CONTROL_SIZE, batch),
        applied=x.new_zeros(steps, CONTROL_SIZE, batch),
    )
    note_state(flight, env.constraint_values(x), 0.0)
    u = x.new_zeros(CONTROL_SIZE, batch)
    for i in range(steps):
        if i % decide == 0:
            u = controller(float(i), x)
        flight.desired[i] = u
        if i % period == 0:
            result = env.safety.correct(x, u)
            u = result.control
            flight.status += torch.nn.functional.one_hot(result.status, len(Status)).T
            flight.yielded += result.slack > 0.0
            flight.slack = torch.maximum(flight.slack, result.slack)
            flight.excess = torch.maximum(flight.excess, (u.abs() / env.limit).amax(0))
        flight.applied[i] = u
        x = env.integrate(x, u, round(1.0 / env.interval))
        note_state(flight, env.constraint_values(x), i + 1.0)
    return flight


def note_state(flight: Flight, h: Tensor, t: float) -> None:
    """Adds the constraint values (13, B) at t s, in place. NaN counts as violated without end."""
    h = torch.where(h.isnan(), -torch.inf, h)
    broken = h < 0.0
    flight.violating += torch.cat((broken, broken.any(0)[None]))
    flight.when = torch.where(h < flight.worst, t, flight.when)
    flight.worst = torch.minimum(flight.worst, h)


def upper_bound(events: int, trials: int) -> float:
    """Clopper and Pearson's one-sided bound: the probability at which so few events had a chance of 5 %."""
    return 1.0 if events >= trials else float(beta.ppf(CONFIDENCE, events + 1, trials - events))


@dataclasses.dataclass(frozen=True)
class Campaign:
    """What determines a campaign's numbers beside the configuration.

    Attributes:
        policy: random, adversarial or checkpoint:F; period: s between filter calls; duration: s per episode.
    """

    policy: str
    period: float
    duration: float
    seed: int

    def batch_seed(self, batch: int) -> int:
        """Of everything random in one batch of episodes."""
        return int(np.random.SeedSequence((self.seed, batch)).generate_state(1)[0])


def empty_report(campaign: Campaign, config: dict[str, Any]) -> dict[str, Any]:
    """A report of no episodes, the form of `verify --json`."""
    counts = dict.fromkeys((*CONSTRAINTS, "any"), 0)
    return {
        "campaign": dataclasses.asdict(campaign),
        "episodes": 0,
        "steps": 0,
        "violating_steps": counts,
        "violating_episodes": dict(counts),
        "worst_value": dict.fromkeys(CONSTRAINTS, float("inf")),
        "worst_case": dict.fromkeys(CONSTRAINTS),
        "upper_bound_95": 1.0,
        "filter_calls": {status.name.lower(): 0 for status in Status},
        "unsolved": 0,
        "controls_outside_bounds": 0,
        "yielded_calls": dict.fromkeys(CONSTRAINTS, 0),
        "largest_slack": dict.fromkeys(CONSTRAINTS, 0.0),
        "starts_left_out": 0,  # see safe_set
        "config": config,
    }


def add(report: dict[str, Any], flight: Flight) -> None:
    """Adds a batch of episodes to a report, in place."""
    before, batch = report["episodes"], flight.excess.numel()
    report["episodes"] += batch
    report["steps"] += batch * (len(flight.desired) + 1)
    for i, name in enumerate((*CONSTRAINTS, "any")):
        report["violating_steps"][name] += int(flight.violating[i].sum())
        report["violating_episodes"][name] += int((flight.violating[i] > 0).sum())
    for i, name in enumerate(CONSTRAINTS):
        value, column = flight.worst[i].min(0)
        report["yielded_calls"][name] += int(flight.yielded[i].sum())
        report["largest_slack"][name] = max(report["largest_slack"][name], flight.slack[i].max().item())
        if value.item() < report["worst_value"][name]:
            report["worst_value"][name] = value.item()
            report["worst_case"][name] = {
                "episode": before + int(column),
                "time_s": flight.when[i, column].item(),
                "initial_state": flight.start[:SIZE, column].tolist(),
            }
    for status in Status:
        report["filter_calls"][status.name.lower()] += int(flight.status[status].sum())
    report["unsolved"] = report["filter_calls"]["unsolved"]
    report["controls_outside_bounds"] += int((flight.excess > 1.0 + 1e-12).sum())
    report["upper_bound_95"] = upper_bound(report["violating_episodes"]["any"], report["episodes"])


def counter_example(
    flight: Flight, constraint: int, campaign: Campaign, config: Config
) -> dict[str, np.ndarray]:
    """The batch's worst episode for a constraint, up to its worst moment: all that `replay_file` needs."""
    column = int(flight.worst[constraint].argmin())
    steps = int(flight.when[constraint, column])
    return {
        "state": flight.start[:SIZE, column].cpu().numpy(),
        "priority": flight.start[SIZE:, column].cpu().numpy(),
        "control_desired": flight.desired[:steps, :, column].cpu().numpy(),
        "control_applied": flight.applied[:steps, :, column].cpu().numpy(),
        "constraint": np.array(CONSTRAINTS[constraint]),
        "value": flight.worst[constraint, column].cpu().numpy(),
        "period": np.array(campaign.period),
        "config": np.array(config.to_toml()),
    }


@torch.no_grad()
def replay(env: InspectionEnv, example: dict[str, np.ndarray]) -> tuple[float, int, float]:
    """Flies the example's applied controls from its state, and asks the filter for each of them again.

    Where rows change places from call to call, the closed loop multiplies the rounding of another batch size or of
    compiled code: by 20 per call at 10 s. The flight under the recorded controls does not.

    Returns:
        The smallest value of the example's constraint, when in s, and by how much the filter's controls now
        differ at most, in units of the actuators' limits.
    """
    constraint, period = CONSTRAINTS.index(str(example["constraint"])), round(env.safety.period)
    x, desired, applied = (
        torch.from_numpy(example[name]).to(env.x)[..., None]
        for name in ("state", "control_desired", "control_applied")
    )
    values, difference = [env.constraint_values(x)[constraint].item()], 0.0
    for i, (wanted, u) in enumerate(zip(desired, applied, strict=True)):
        if i % period == 0:
            again = env.safety.correct(x, wanted).control
            difference = max(difference, ((again - u).abs() / env.limit).max().item())
        x = env.integrate(x, u, round(1.0 / env.interval))
        values.append(env.constraint_values(x)[constraint].item())
    when = int(np.argmin(values))
    return values[when], when, difference


def controller_of(
    policy: str, safety_filter: SafetyFilter, env: InspectionEnv, network: Policy | None, seed: int
) -> tuple[Controller, float]:
    """A campaign's policy and how often it decides, in s."""
    if network is not None:
        return agent(network, env), env.c.action_period
    if policy == "random":
        return held_at_random(env.c, torch.Generator().manual_seed(seed)), safety_filter.period
    return adversarial(safety_filter), safety_filter.period


def run(
    campaign: Campaign,
    episodes: int,
    safety_filter: SafetyFilter,
    make_env: Callable[[int], InspectionEnv],
    network: Policy | None,
    path: Path | None,
    config: Config,
) -> Iterator[dict[str, Any]]:
    """Flies batch after batch and yields the report so far, which `path` holds too and is resumed from.

    Args:
        make_env: an environment of so many episodes behind the filter.
        network: of --policy checkpoint, else None.
        path: a JSON file; beside it a violated constraint leaves its worst episode, FILE.CONSTRAINT.npz.
        config: the configuration, for the report and for the counter-examples.
    """
    report = empty_report(campaign, dataclasses.asdict(config))
    if path is not None and path.is_file() and path.stat().st_size:
        report = continued(path, report)
    yield report
    env = None
    while report["episodes"] < episodes:
        batch = min(BATCH, episodes - report["episodes"])
        seed = campaign.batch_seed(report["episodes"])
        with refusing("[inspection] and [rta]", RuntimeError):
            x, priority, left_out = initial_states(batch, seed, safety_filter.barriers)
        if env is None or env.time.numel() != batch:
            env = make_env(batch)
        controller, decide = controller_of(campaign.policy, safety_filter, env, network, seed)
        flight = fly(env, controller, x.to(env.x), priority.to(env.x), campaign.duration, decide)
        before = dict(report["worst_value"])
        add(report, flight)
        report["starts_left_out"] += left_out
        if path is not None:
            for i, name in enumerate(CONSTRAINTS):
                if report["worst_value"][name] < min(0.0, before[name]):
                    np.savez_compressed(f"{path}.{name}.npz", **counter_example(flight, i, campaign, config))
            part = path.with_name(path.name + ".part")
            part.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
            os.replace(part, path)
        yield report


def continued(path: Path, fresh: dict[str, Any]) -> dict[str, Any]:
    """The report in a file, which must be of the same campaign as a fresh one."""
    with refusing(f"--json {path}: holds no report of verify", OSError, ValueError, TypeError, KeyError):
        report = json.loads(path.read_text(encoding="utf-8"))
        same = all(report[key] == json.loads(json.dumps(fresh[key])) for key in ("campaign", "config"))
    if not same:
        raise InputError(f"--json {path}: holds another campaign or configuration; name another file")
    return report


def table(report: dict[str, Any]) -> str:
    """A report as text."""
    lines = [
        f"{'constraint':20s} {'violating steps':>16s} {'episodes':>9s} {'worst value':>13s} {'slack used':>11s}"
    ]
    for name in CONSTRAINTS:
        lines.append(
            f"{name:20s} {report['violating_steps'][name]:16,d} {report['violating_episodes'][name]:9,d} "
            f"{report['worst_value'][name]:13.5g} {report['yielded_calls'][name]:11,d}"
        )
    steps, bad = report["violating_steps"]["any"], report["violating_episodes"]["any"]
    calls = report["filter_calls"]
    total = sum(calls.values())
    corrected = 100.0 * (total - calls["untouched"]) / max(total, 1)
    lines += [
        f"{'any':20s} {steps:16,d} {bad:9,d}",
        f"{report['episodes']:,} episodes, {report['steps']:,} steps; violation probability per episode below "
        f"{report['upper_bound_95']:.2e} (95 %)",
        f"{total:,} filter calls, {corrected:.1f} % corrected, {calls['slack']:,} with slack, "
        f"{report['unsolved']:,} unsolved; controls outside their bounds in "
        f"{report['controls_outside_bounds']:,} episodes; {report['starts_left_out']:,} starts left out: beyond "
        "the filter's keep-in barrier",
    ]
    return "\n".join(lines)


def verify(
    policy: str,
    episodes: int,
    duration: int,
    seed: int,
    resolve: Callable[[Config], Config],
    path: Path | None,
) -> dict[str, Any]:
    """The whole campaign with a progress bar; returns the report.

    Args:
        policy: random, adversarial or checkpoint:F.
        resolve: puts the command line over a base configuration, that of the checkpoint if there is one.
        path: see `run`.
    """
    network, base = None, Config()
    if policy.startswith("checkpoint:"):
        network, base = build.load_policy(policy.removeprefix("checkpoint:"))
    config = resolve(base)
    train, device = config.train, build.resolve_device(config.train.device)
    decide = config.inspection.action_period if network else train.rta_period
    if duration % decide:
        raise InputError(f"--duration {duration}: must be a multiple of {decide:g} s, the policy's period")
    calls = -(-episodes // BATCH) * duration / train.rta_period
    compiled = build.wants_compile(train.compile, calls >= build.WORTH_COMPILING_FILTER)
    with refusing("[rta] and [inspection]", ValueError, OverflowError):
        solver = make_solver(train.qp_solver)
        safety_filter = SafetyFilter(config.inspection, config.rta, train.rta_period, solver)
    if compiled:
        build.compile_or_explain("filter", safety_filter.compile)
    safety = safety_filter.safety()

    def make_env(count: int) -> InspectionEnv:
        return build.make_env(config, count, [torch.Generator(device).manual_seed(seed)], safety, compiled)

    campaign = Campaign(policy, train.rta_period, duration, seed)
    network = network.to(device) if network else None
    reports = run(campaign, episodes, safety_filter, make_env, network, path, config)
    report = next(reports)  # refuses a file before there is a bar
    with tqdm(total=episodes, initial=report["episodes"], unit=" episodes", dynamic_ncols=True) as bar:
        for report in reports:
            bar.update(report["episodes"] - bar.n)
            bar.set_postfix(violating=report["violating_episodes"]["any"])
    return report


def replay_file(path: str, resolve: Callable[[Config], Config]) -> str:
    """Flies the counter-example in a file and says what came of it.

    Args:
        resolve: puts the command line over the configuration in the file.
    """
    names = ("state", "control_desired", "control_applied", "constraint", "value", "period", "config")
    example = read_arrays(path, names)
    mistakes = ValueError, TypeError, RuntimeError, LookupError, ArithmeticError
    with refusing(f"{path}: not a counter-example of verify", *mistakes):
        config = resolve(from_toml(str(example["config"]), path))
        solver = make_solver("batched")  # that of `verify`
        safety_filter = SafetyFilter(config.inspection, config.rta, float(example["period"]), solver)
        env = build.make_env(config, 1, [torch.Generator().manual_seed(0)], safety_filter.safety())
        value, when, difference = replay(env, example)
    return (
        f"{path}: {example['constraint']} falls to {value:.12g} at {when} s; recorded {example['value']:.12g}; "
        f"the filter's controls differ by at most {difference:.1e} of their limits"
    )
