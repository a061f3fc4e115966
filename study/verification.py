"""The Monte Carlo campaign: how often, and how badly, any constraint is violated behind the filter."""

import dataclasses
import hashlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import beta, qmc
from torch import Tensor
from tqdm import tqdm

from inspection.environment import InspectionEnv
from inspection.guidance import Controller
from inspection.initial_state import sample_initial_state, spherical
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from ppo.network import Policy
from rta.constraints import ATTITUDE, CONSTRAINTS, TRANSLATIONAL
from rta.filter import FilterResult, SafetyFilter
from rta.qp import Status
from rta.rows import Barriers
from study import build
from study.config import Config, from_toml
from study.errors import InputError, ReplayError, refusing
from study.offline import read_arrays

BATCH = 1024  # starts drawn at once
FARTHEST = 795.0  # m, of the safe set's initial states
HYPERCUBES = 100  # drawn before a safe set counts as empty
LONGEST_HOLD = 60  # s that the random policy holds an action
CONFIDENCE = 0.95
SHOWN = 20  # calls with slack that a report holds, per constraint
LISTED = 12  # sets of constraints with slack together that the text lists
ROUNDING = 1e-10  # slack that does not count, in units of h's rate; even rows that never yield reach 1e-12
# A replay flies the recorded controls, so only the plant's rounding differs: compiled or not, on a CPU or a GPU.
REPLAYED = 1e-8  # relative to the value or to 1 in the unit of h


def spawned(seed: int, count: int) -> list[int]:
    """Seeds of independent streams of random numbers."""
    streams = np.random.SeedSequence(seed).spawn(count)
    return [int(stream.generate_state(1, np.uint64)[0]) for stream in streams]


def without_margins(barriers: Barriers) -> Barriers:
    """The same barriers with the exact h and Psi_1 of attitude exclusion, temperature and battery."""
    margins = ("exclusion_margin", "temperature_margin", "battery_margin", "pole_angle", "incidence_rounding")
    return Barriers(
        barriers.c, dataclasses.replace(barriers.r, **dict.fromkeys(margins, 0.0)), barriers.period
    )


def safe_set(count: int, seed: int, barriers: Barriers) -> tuple[Tensor, Tensor, int]:
    """Initial states from the whole safe set: every h and every Psi_1 is non-negative.

    A Latin hypercube over distance up to FARTHEST, speed up to the limit there, all directions and attitudes,
    body rates, temperature and energy down to their limits and the Sun's angle. h is exact; Psi_1 is the filter's,
    with the margins of h inside it and the terminator rounded off (`RtaParameters.incidence_rounding`). States beyond
    the filter's own keep-in barrier (`Barriers.can_brake`) belong to the set.

    Returns:
        States (16, count), priority vectors (3, count) and how many other states of the hypercubes, up to the last
        one taken, are safe by the exact Psi_1 without margins alone.

    Raises:
        RuntimeError: fewer were found in HYPERCUBES hypercubes.
    """
    c, exact = barriers.c, without_margins(barriers)
    sampler = qmc.LatinHypercube(17, rng=np.random.default_rng(seed))
    kept, rejected = torch.zeros(SIZE + 3, 0, dtype=torch.float64), 0
    for _ in range(HYPERCUBES):
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
        priority = spherical(torch.ones_like(distance), turn[15], lean[16])
        safe = barriers.is_in_safe_set(x)
        missing = count - kept.shape[1]
        taken = torch.nonzero(safe).flatten()[:missing]
        seen = int(taken[-1]) + 1 if taken.numel() == missing else safe.numel()
        rejected += int((exact.is_in_safe_set(x) & ~safe)[:seen].sum())
        kept = torch.cat((kept, torch.cat((x, priority))[:, taken]), 1)
        if kept.shape[1] == count:
            return kept[:SIZE], kept[SIZE:], rejected
    raise RuntimeError(f"only {kept.shape[1]} of {count} initial states found in the safe set")


def initial_states(count: int, seed: int, barriers: Barriers) -> tuple[Tensor, Tensor, int]:
    """The paper's distribution and the safe set in turns; returns as `safe_set`."""
    first, second = spawned(seed, 2)
    generator = torch.Generator().manual_seed(first)
    both = torch.zeros(SIZE + 3, count, dtype=torch.float64)
    paper = sample_initial_state(count - count // 2, generator, barriers.c, barriers.is_safe)
    x, priority, rejected = safe_set(count // 2, second, barriers)
    both[:, ::2], both[:, 1::2] = torch.cat(paper), torch.cat((x, priority))
    return both[:SIZE], both[SIZE:], rejected


def held_at_random(
    c: InspectionParameters, generator: torch.Generator, batch: int, first: int = 0
) -> Controller:
    """Uniformly random controls, each held for a uniformly random time of whole seconds.

    Numbers are drawn for a whole batch, of which the states are the columns from `first` on.
    """
    held: dict[str, Tensor] = {}

    def control(t: float, x: Tensor) -> Tensor:
        draw = torch.rand(CONTROL_SIZE + 1, batch, generator=generator, dtype=torch.float64)
        draw = draw[:, first : first + x.shape[1]].to(x)
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


class Conflicts(NamedTuple):
    """Filter calls with slack, in the order of time; last axis the calls.

    Attributes:
        column: (N,) of the episode; time: (N,) s; state: (16, N); desired: (6, N); slack, h: (13, N).
    """

    column: Tensor
    time: Tensor
    state: Tensor
    desired: Tensor
    slack: Tensor
    h: Tensor

    @classmethod
    def of(cls, t: float, x: Tensor, desired: Tensor, result: FilterResult, h: Tensor) -> "Conflicts":
        """Those of one call of the filter at t s."""
        column = torch.nonzero((result.slack > ROUNDING).any(0)).flatten()
        parts = (part[:, column] for part in (x, desired, result.slack, h))
        return cls(column, torch.full_like(column, t, dtype=x.dtype), *parts)


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
        column: (B,) of the episode in the batch that was flown; conflicts: calls with slack, by that column.
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
    column: Tensor
    conflicts: Conflicts

    def __getitem__(self, chosen: Tensor) -> "Flight":
        """The episodes where `chosen` (B,) bool is set."""
        parts = {name: part[..., chosen] for name, part in vars(self).items() if name != "conflicts"}
        theirs = torch.isin(self.conflicts.column, parts["column"])
        return Flight(**parts, conflicts=Conflicts(*(part[..., theirs] for part in self.conflicts)))


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
        column=torch.arange(batch, device=x.device),
        conflicts=Conflicts(*[x.new_zeros(0)] * len(Conflicts._fields)),
    )
    h = env.constraint_values(x)
    note_state(flight, h, 0.0)
    u = x.new_zeros(CONTROL_SIZE, batch)
    conflicts = []
    for i in range(steps):
        if i % decide == 0:
            u = controller(float(i), x)
        flight.desired[i] = u
        if i % period == 0:
            result = env.safety.correct(x, u)
            conflicts.append(Conflicts.of(i, x, u, result, h))
            u = result.control
            flight.status += torch.nn.functional.one_hot(result.status, len(Status)).T
            flight.yielded += result.slack > ROUNDING
            flight.slack = torch.maximum(flight.slack, result.slack)
            flight.excess = torch.maximum(flight.excess, (u.abs() / env.limit).amax(0))
        flight.applied[i] = u
        x = env.integrate(x, u, round(1.0 / env.interval))
        h = env.constraint_values(x)
        note_state(flight, h, i + 1.0)
    flight.conflicts = Conflicts(*(torch.cat(parts, -1) for parts in zip(*conflicts, strict=True)))
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
        policy: random, adversarial or checkpoint:F; weights: digest of the latter's weights, else empty.
        period: s between filter calls; duration: s per episode; batch_size: starts drawn at once.
    """

    policy: str
    period: float
    duration: float
    seed: int
    batch_size: int
    weights: str = ""

    def batch_seed(self, batch: int) -> int:
        """Of everything random in one batch of episodes."""
        return int(np.random.SeedSequence((self.seed, batch)).generate_state(1)[0])


class Origin(NamedTuple):
    """Where a flight's starts come from: the columns from `first` on of `initial_states(batch_size, batch_seed)`."""

    batch_seed: int
    batch_size: int
    first: int

    def of(self, column: Tensor) -> dict[str, int]:
        """A column of the flight in a report."""
        return {
            "batch_seed": self.batch_seed,
            "batch_size": self.batch_size,
            "column": self.first + int(column),
        }


def empty_tally() -> dict[str, Any]:
    """What is counted about episodes: none so far.

    `steps` are the states checked, one per second and that at 0 s. `worst_case` says which start of which batch
    gave the `worst_value` and when; `initial_states` of that size and seed has it in that column. `yielded_calls` and
    `largest_slack`, in h's unit per s (per s^2 at relative degree two), are about filter calls in which a row of the
    constraint had slack, and `slack_together` about the constraints of one program, of thrust or of torque.
    `conflicts` has the first SHOWN of these calls per constraint in full, in the order of the starts.
    """
    counts = dict.fromkeys((*CONSTRAINTS, "any"), 0)
    return {
        "episodes": 0,
        "steps": 0,
        "violating_steps": counts,
        "violating_episodes": dict(counts),
        "worst_value": dict.fromkeys(CONSTRAINTS),
        "worst_case": dict.fromkeys(CONSTRAINTS),
        "filter_calls": {status.name.lower(): 0 for status in Status},
        "unsolved": 0,
        "controls_outside_bounds": 0,
        "yielded_calls": dict.fromkeys(CONSTRAINTS, 0),
        "largest_slack": dict.fromkeys(CONSTRAINTS, 0.0),
        "slack_together": {},
        "conflicts": [],
    }


def empty_report(campaign: Campaign, config: dict[str, Any]) -> dict[str, Any]:
    """A report of no episodes, the form of `verify --json`.

    Its own tally and bound are over the starts that the filter can hold in any attitude. `starts_beyond_braking` has
    the tally of the others (`Barriers.can_brake`), where keep-in zone and actuators can conflict from the start on.
    `starts_rejected_by_margin` counts states left out as in `safe_set`.
    """
    return {
        "campaign": dataclasses.asdict(campaign),
        **empty_tally(),
        "upper_bound_95": 1.0,
        "starts_beyond_braking": empty_tally(),
        "starts_rejected_by_margin": 0,
        "config": config,
    }


def add(tally: dict[str, Any], flight: Flight, origin: Origin) -> None:
    """Adds episodes to a tally, in place."""
    batch = flight.excess.numel()
    if batch == 0:
        return
    tally["episodes"] += batch
    tally["steps"] += batch * (len(flight.desired) + 1)
    for i, name in enumerate((*CONSTRAINTS, "any")):
        tally["violating_steps"][name] += int(flight.violating[i].sum())
        tally["violating_episodes"][name] += int((flight.violating[i] > 0).sum())
    for i, name in enumerate(CONSTRAINTS):
        tally["yielded_calls"][name] += int(flight.yielded[i].sum())
        tally["largest_slack"][name] = max(tally["largest_slack"][name], flight.slack[i].max().item())
        value, k = flight.worst[i].min(0)
        if tally["worst_value"][name] is None or value.item() < tally["worst_value"][name]:
            tally["worst_value"][name] = value.item()
            tally["worst_case"][name] = {
                **origin.of(flight.column[k]),
                "time_s": flight.when[i, k].item(),
                "initial_state": flight.start[:SIZE, k].tolist(),
                "priority": flight.start[SIZE:, k].tolist(),
            }
    for status in Status:
        tally["filter_calls"][status.name.lower()] += int(flight.status[status].sum())
    tally["unsolved"] = tally["filter_calls"]["unsolved"]
    tally["controls_outside_bounds"] += int((flight.excess > 1.0 + 1e-12).sum())
    add_conflicts(tally, flight.conflicts, origin)


def add_conflicts(tally: dict[str, Any], conflicts: Conflicts, origin: Origin) -> None:
    """Adds calls with slack to a tally, in place."""
    order = torch.argsort(conflicts.column, stable=True)  # so that a part of a batch comes first
    conflicts = Conflicts(*(part[..., order].cpu() for part in conflicts))
    together, recorded = tally["slack_together"], tally["conflicts"]
    shown = {name: sum(name in call["slack"] for call in recorded) for name in CONSTRAINTS}
    for k, slacks in enumerate(conflicts.slack.T.tolist()):
        slack = {name: value for name, value in zip(CONSTRAINTS, slacks, strict=True) if value > ROUNDING}
        for group in (TRANSLATIONAL, ATTITUDE):  # those of thrust and of torque do not conflict
            names = [name for name in slack if name in group]
            if not names:
                continue
            fresh = {"calls": 0, "largest_slack": dict.fromkeys(names, 0.0)}
            same = together.setdefault(" + ".join(names), fresh)
            same["calls"] += 1
            for name in names:
                same["largest_slack"][name] = max(same["largest_slack"][name], slack[name])
        if min(shown[name] for name in slack) < SHOWN:
            for name in slack:
                shown[name] += 1
            recorded.append(
                {
                    **origin.of(conflicts.column[k]),
                    "time_s": conflicts.time[k].item(),
                    "state": conflicts.state[:, k].tolist(),
                    "control_desired": conflicts.desired[:, k].tolist(),
                    "slack": slack,
                    "h": dict(zip(CONSTRAINTS, conflicts.h[:, k].tolist(), strict=True)),
                }
            )


def counter_example(
    flight: Flight, constraint: int, campaign: Campaign, config: Config
) -> dict[str, np.ndarray]:
    """The flight's worst episode for a constraint, up to its worst moment: all that `replay_file` needs."""
    k = int(flight.worst[constraint].argmin())
    steps = int(flight.when[constraint, k])
    return {
        "state": flight.start[:SIZE, k].cpu().numpy(),
        "control_desired": flight.desired[:steps, :, k].cpu().numpy(),
        "control_applied": flight.applied[:steps, :, k].cpu().numpy(),
        "constraint": np.array(CONSTRAINTS[constraint]),
        "value": flight.worst[constraint, k].cpu().numpy(),
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
    campaign: Campaign,
    safety_filter: SafetyFilter,
    env: InspectionEnv,
    network: Policy | None,
    seed: int,
    first: int,
) -> tuple[Controller, float]:
    """A campaign's policy for the columns from `first` on of a batch, and how often it decides, in s."""
    if network is not None:
        return agent(network, env), env.c.action_period
    if campaign.policy == "random":
        generator = torch.Generator().manual_seed(seed)
        return held_at_random(env.c, generator, campaign.batch_size, first), safety_filter.period
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

    Whatever can be refused is before the first report. A batch is always drawn whole; where fewer episodes are wanted,
    its first ones are flown, and a longer campaign goes on with the rest.

    Args:
        episodes: from starts that the filter can hold.
        make_env: an environment of so many episodes behind the filter.
        network: of --policy checkpoint, else None.
        path: a JSON file; beside it a violated constraint leaves its worst episode, FILE.CONSTRAINT.npz.
        config: the configuration, for the report and for the counter-examples.
    """
    report = empty_report(campaign, dataclasses.asdict(config))
    if path is not None and path.is_file() and path.stat().st_size:
        report = continued(path, report)
    beyond, env = report["starts_beyond_braking"], None
    while report["episodes"] < episodes:
        number, first = divmod(report["episodes"] + beyond["episodes"], campaign.batch_size)
        seed = campaign.batch_seed(number)
        seed_of_starts, seed_of_controls = spawned(seed, 2)
        with refusing("[inspection] and [rta]", RuntimeError):
            x, priority, rejected = initial_states(
                campaign.batch_size, seed_of_starts, safety_filter.barriers
            )
        held = safety_filter.barriers.can_brake(x)[first:]
        held = held[held.cumsum(0) - held.long() < episodes - report["episodes"]]
        count = held.numel()
        if env is None or env.time.numel() != count:
            env = make_env(count)
        controller, decide = controller_of(campaign, safety_filter, env, network, seed_of_controls, first)
        yield report

        x, priority = (part[:, first : first + count].to(env.x) for part in (x, priority))
        flight = fly(env, controller, x, priority, campaign.duration, decide)
        held, origin = held.to(env.x.device), Origin(seed_of_starts, campaign.batch_size, first)
        add(beyond, flight[~held], origin)
        flight, before = flight[held], dict(report["worst_value"])
        add(report, flight, origin)
        report["upper_bound_95"] = upper_bound(report["violating_episodes"]["any"], report["episodes"])
        if first == 0:
            report["starts_rejected_by_margin"] += rejected
        if path is not None:
            for i, name in enumerate(CONSTRAINTS):
                if report["worst_value"][name] < min(0.0, before[name] or 0.0):
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
        f"{'constraint':20s} {'violating steps':>16s} {'episodes':>9s} {'worst value':>13s} "
        f"{'calls with slack':>17s}"
    ]
    for name in CONSTRAINTS:
        lines.append(
            f"{name:20s} {report['violating_steps'][name]:16,d} {report['violating_episodes'][name]:9,d} "
            f"{report['worst_value'][name]:13.5g} {report['yielded_calls'][name]:17,d}"
        )
    steps, bad = report["violating_steps"]["any"], report["violating_episodes"]["any"]
    calls, beyond = report["filter_calls"], report["starts_beyond_braking"]
    total = sum(calls.values())
    corrected = 100.0 * (total - calls["untouched"]) / max(total, 1)
    lines += [
        f"{'any':20s} {steps:16,d} {bad:9,d}",
        f"{report['episodes']:,} episodes, {report['steps']:,} steps; violation probability per episode below "
        f"{report['upper_bound_95']:.2e} (95 %)",
        f"{total:,} filter calls, {corrected:.1f} % corrected, {calls['slack']:,} with slack, "
        f"{report['unsolved']:,} unsolved; controls outside their bounds in "
        f"{report['controls_outside_bounds']:,} episodes",
        f"beside these {beyond['episodes']:,} starts beyond the filter's keep-in barrier: "
        f"{beyond['violating_episodes']['any']:,} with violations"
        + "".join(
            f"; {name} {beyond['violating_steps'][name]:,} steps, down to {beyond['worst_value'][name]:.3g}"
            for name in CONSTRAINTS
            if beyond["violating_steps"][name]
        ),
        f"{report['starts_rejected_by_margin']:,} states left out that are safe but for the margins of Psi_1",
    ]
    together = sorted(report["slack_together"].items(), key=lambda item: -item[1]["calls"])
    if together:
        lines += [
            "",
            f"{'calls':>9s}  slack together, largest in h's unit per s (per s^2 at relative degree two)",
        ]
    for _, same in together[:LISTED]:
        slack = ", ".join(f"{name} {value:.2g}" for name, value in same["largest_slack"].items())
        lines.append(f"{same['calls']:9,d}  {slack}")
    if more := together[LISTED:]:
        lines.append(f"{sum(same['calls'] for _, same in more):9,d}  in {len(more):,} other combinations")
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
    network, base, weights = None, Config(), ""
    if policy.startswith("checkpoint:"):
        network, base = build.load_policy(policy.removeprefix("checkpoint:"))
        weights = digest(network)
    config = resolve(base)
    solver = build.qp_solver(config.train)  # by name, so that a counter-example says which one it was
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, qp_solver=solver))
    train, device = config.train, build.resolve_device(config.train.device)
    decide = config.inspection.action_period if network else train.rta_period
    if duration % decide:
        raise InputError(f"--duration {duration}: must be a multiple of {decide:g} s, the policy's period")
    calls = -(-episodes // BATCH) * duration / train.rta_period
    compiled = build.wants_compile(train.compile, calls >= build.WORTH_COMPILING_FILTER)
    safety_filter = build.make_filter(config, train.rta_period, compiled, BATCH)
    safety = safety_filter.safety()

    def make_env(count: int) -> InspectionEnv:
        return build.make_env(config, count, [torch.Generator(device)], safety, compiled)

    campaign = Campaign(policy, train.rta_period, duration, seed, BATCH, weights)
    network = network.to(device) if network else None
    reports = run(campaign, episodes, safety_filter, make_env, network, path, config)
    report = next(reports)  # refuses before there is a bar
    if report["episodes"] > episodes:
        print(f"{path}: holds {report['episodes']:,} episodes already, more than asked for", file=sys.stderr)
    with tqdm(total=episodes, initial=report["episodes"], unit=" episodes", dynamic_ncols=True) as bar:
        for report in reports:
            bar.update(report["episodes"] - bar.n)
            bar.set_postfix(violating=report["violating_episodes"]["any"])
    return report


def digest(network: Policy) -> str:
    """Of a policy's weights: 16 hexadecimal digits."""
    state = sorted(network.state_dict().items())
    content = b"".join(name.encode() + weight.cpu().numpy().tobytes() for name, weight in state)
    return hashlib.sha256(content).hexdigest()[:16]


def replay_file(path: str) -> str:
    """Flies the counter-example in a file, with the filter that the file describes, and says what came of it.

    Raises:
        InputError: not such a file.
        ReplayError: the constraint falls to another value than the recorded one, by more than REPLAYED.
    """
    names = ("state", "control_desired", "control_applied", "constraint", "value", "period", "config")
    example = read_arrays(path, names)
    mistakes = ValueError, TypeError, RuntimeError, LookupError, ArithmeticError
    with refusing(f"{path}: not a counter-example of verify", *mistakes):
        config = from_toml(str(example["config"]), path)
        safety_filter = build.make_filter(config, float(example["period"]))
        env = build.make_env(config, 1, [torch.Generator().manual_seed(0)], safety_filter.safety())
        value, when, difference = replay(env, example)
        recorded = float(example["value"])
    outcome = (
        f"{path}: {example['constraint']} falls to {value:.12g} at {when} s; recorded {recorded:.12g}; "
        f"the filter's controls differ by at most {difference:.1e} of their limits"
    )
    if not math.isclose(value, recorded, rel_tol=REPLAYED, abs_tol=REPLAYED):
        raise ReplayError(f"{outcome}: not what was recorded")
    return outcome
