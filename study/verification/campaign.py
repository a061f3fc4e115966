"""A campaign: flies batch after batch of starts under one policy, into a report that a longer campaign continues."""

import dataclasses
import hashlib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Controller, Safety
from inspection.environment import InspectionEnv
from inspection.model.attitude import unit
from inspection.model.draws import uniform
from inspection.model.state import P
from inspection.world.uncertainty import Uncertainty
from ppo.network import Policy
from rta.names import CONSTRAINTS
from settings import InputError
from study.config import Config
from study.errors import as_input_error
from study.experiment import Experiment, check_clocks, check_is_checked, load_policy
from study.files import write_json, write_npz
from study.flight.controllers import agent
from study.flight.fly import Observer, Progress, Starts, fly
from study.flight.summary import upper_bound
from study.machine import announced, bar
from study.verification.adversaries import Greedy, adversarial, attacked, held_at_random, learned
from study.verification.counter_examples import counter_example
from study.verification.findings import Campaign, report_in, table
from study.verification.limits import DRAWING, barriers, near_limits
from study.verification.lookahead import CANDIDATES, HORIZON, Lookahead
from study.verification.starts import initial_states, spawned
from study.verification.tally import add
from study.verification.tape import CHECK_EVERY, Tape

CHECKPOINT, LEARNED = FILES = ("checkpoint:", "learned:")  # prefixes of a policy that is an agent in a file
POLICIES = ("random", "adversarial", "pressing", "lookahead")
BATCH = 1024  # starts drawn at once
BAR = "{percentage:3.0f}%|{bar}| {n:,.0f}/{total:,} episodes [{elapsed}<{remaining}{postfix}]"  # n may be a fraction


def blamed(config: Config) -> str:
    """Returns the settings that are to blame if there is no start: the error bounds, if there are any."""
    nothing = vars(Uncertainty())
    bounds = {
        name: value for name, value in sorted(vars(config.uncertainty).items()) if value != nothing[name]
    }
    if not bounds:
        return "[inspection] and [rta]"
    return f"[uncertainty] {', '.join(f'{name} = {value!r}' for name, value in bounds.items())}"


def run(
    campaign: Campaign,
    episodes: int,
    experiment: Experiment,
    network: Policy | None,
    path: Path | None,
    keep_worst: bool = False,
    observers: Sequence[Observer] = (),
) -> Iterator[dict[str, Any]]:
    """Flies batch after batch and yields the report so far; `path` holds the same report, and a later call resumes it.

    Invalid input is refused before the first report. A batch is always drawn whole; if fewer episodes are wanted, the
    first ones are flown, and a longer campaign continues with the rest.

    Args:
        episodes: number of episodes.
        network: of a policy in a file, else None.
        path: a JSON file; beside it the worst episode of each violated constraint is saved, FILE.CONSTRAINT.npz.
        keep_worst: save the worst episode of every constraint, violated or not.
        observers: observe each batch; more may be appended after the first report.
    """
    config, env = experiment.config, None
    decide_every = decides_every(config, network)
    report = report_in(path, campaign, config, table)
    starts = supply_of_starts(campaign, experiment)
    kept_below = math.inf if keep_worst else 0.0
    while report["episodes"] < episodes:
        number, first = divmod(report["episodes"], campaign.batch_size)
        batch_seed = np.random.SeedSequence((campaign.seed, number)).generate_state(1)[0]
        seed_of_starts, seed_of_controls, seed_of_plants = spawned(int(batch_seed), 3)
        drawing = announced("drawing the starts, some seconds a batch")
        with as_input_error(blamed(config), RuntimeError), drawing:
            x, priority, rejected = starts(seed_of_starts)
        count = min(campaign.batch_size - first, episodes - report["episodes"])
        if env is None or env.time.numel() != count:
            env = experiment.env(count, None, decide_every, campaign.check_every, experiment.filter_compiled)
        controller = commanding(campaign, experiment, env, network, seed_of_controls, first)
        yield report

        x, priority = (part[:, first : first + count].to(env.x) for part in (x, priority))
        before = dict(report["worst_value"])

        tape = Tape(campaign.duration, first)
        plants = torch.Generator().manual_seed(seed_of_plants)
        number = uniform(0.0, 1.0, campaign.batch_size, plants)[first : first + count].to(env.x)
        flight = fly(env, controller, Starts(x, priority, number), campaign.duration, [tape, *observers])
        origin = {"batch_seed": seed_of_starts, "batch_size": campaign.batch_size}
        everywhere = torch.ones(count, dtype=torch.bool, device=env.x.device)
        add(report, flight, tape, everywhere, origin)
        report["upper_bound_95"] = upper_bound(report["violating_episodes"]["any"], report["episodes"])
        if first == 0:
            report["starts_rejected"] += rejected
        if path is not None:
            for name in CONSTRAINTS:
                now, then = (
                    math.inf if w[name] is None else w[name] for w in (report["worst_value"], before)
                )
                if now < min(then, kept_below):
                    example = counter_example(flight, tape, everywhere, name, config, campaign.check_every)
                    write_npz(f"{path}.{name}.npz", example)
            write_json(path, report)
    yield report


def supply_of_starts(
    campaign: Campaign, experiment: Experiment
) -> Callable[[int], tuple[Tensor, Tensor, int]]:
    """Returns a function of a seed: a batch of starts in the form of `safe_set`."""
    safety_filter, batch = experiment.filter, campaign.batch_size
    if campaign.starts == "anywhere":
        return lambda seed: initial_states(batch, seed, safety_filter)
    barriers_at = experiment.of_states(lambda x: [barriers(x, safety_filter)])

    def next_to_limits(seed: int) -> tuple[Tensor, Tensor, int]:
        found = near_limits(batch, seed, safety_filter, lambda x: barriers_at(x)[0], experiment.device)
        return found.state, unit(found.state[P]), 0

    return next_to_limits


def commanding(
    campaign: Campaign,
    experiment: Experiment,
    env: InspectionEnv,
    network: Policy | None,
    seed: int,
    first: int,
) -> Controller:
    """Returns the controller of `env`, which has the columns from `first` on of a batch whose controls have this seed.

    If the plant's errors are worst, their corners are random under random controls, chosen by `Lookahead` under
    lookahead, and else by `Greedy`.
    """
    generator, batch = torch.Generator().manual_seed(seed), campaign.batch_size
    column = torch.arange(first, first + env.time.numel(), device=env.x.device)
    aimed = campaign.policy in ("pressing", "lookahead")
    greedy = Greedy(experiment.filter, attacked(column) if aimed else None)
    is_worst = env.plant is not None and env.plant.is_worst
    if env.plant and campaign.policy != "random":
        env.plant.adversary = greedy
    if network and campaign.policy.startswith(LEARNED):
        return learned(network, env, generator, batch, first)
    if network:
        return agent(network, env)
    if campaign.policy == "random":
        return held_at_random(experiment.config.inspection, generator, batch, first)
    if campaign.policy == "adversarial":
        return adversarial(experiment.filter, experiment.of_states)
    if campaign.policy == "pressing":
        return greedy
    count = env.time.numel() * campaign.candidates
    tried = experiment.env(count, None, campaign.period, CHECK_EVERY, experiment.filter_compiled)
    ahead = Lookahead(env, tried, campaign.horizon, generator, batch, first, greedy if is_worst else None)
    if env.plant:
        env.plant.adversary = ahead
    return ahead


def verify(
    campaign: Campaign,
    episodes: int,
    config: Config,
    network: Policy | None,
    path: Path | None,
    keep_worst: bool = False,
) -> dict[str, Any]:
    """Flies the whole campaign with a progress bar; returns the report.

    Args:
        config: with the filter on; the others: see `run`.
    """
    check_times(campaign, config, network)
    duration, tried = campaign.duration, campaign.candidates or 1
    calls = DRAWING if campaign.starts == "limits" else 0
    seconds = -(-episodes // BATCH) * (duration + calls * campaign.period)
    experiment = Experiment(config, BATCH * tried, seconds)
    if campaign.filter != "python":
        experiment.safety = exported(experiment, campaign.filter)
    network = network.to(experiment.device) if network else None

    observers: list[Observer] = []
    reports = run(campaign, episodes, experiment, network, path, keep_worst, observers)
    report = next(reports)  # raises InputError before the bar appears
    if report["episodes"] > episodes:
        print(f"{path}: holds {report['episodes']:,} episodes already, more than asked for", file=sys.stderr)
    with bar(episodes, "episodes", initial=report["episodes"], bar_format=BAR) as shown:
        observers.append(Progress(shown, duration, report["violating_episodes"]["any"]))
        for report in reports:
            shown.update(report["episodes"] - shown.n)
    return report


def load_commander(policy: str) -> tuple[Policy | None, Config]:
    """Returns the network of a policy in a file and the configuration of its training; else None and the defaults."""
    if policy in POLICIES:
        return None, Config()
    prefix, _, file = policy.partition(":")
    if f"{prefix}:" not in FILES or not file:
        raise InputError(f"--policy {policy!r}: must be {', '.join(POLICIES)}, learned:F or checkpoint:F")
    network, trained = load_policy(file)
    if policy.startswith(LEARNED) and not trained.train.adversary:
        raise InputError(f"--policy {policy}: was not trained as an adversary; fly it as {CHECKPOINT}F")
    return network, trained


def looking_ahead(policy: str, candidates: int | None, horizon: int | None) -> tuple[int, int]:
    """Returns a campaign's candidates and horizon, with lookahead's defaults; raises InputError for other policies."""
    if policy == "lookahead":
        return candidates or CANDIDATES, horizon or HORIZON
    if candidates or horizon:
        raise InputError(f"--policy {policy}: --candidates and --horizon are those of lookahead; drop them")
    return 0, 0


def check_times(campaign: Campaign, config: Config, network: Policy | None) -> None:
    """Raises InputError if the duration or the checks do not fit the clocks, before anything is built."""
    duration, check_every = campaign.duration, campaign.check_every
    every = decides_every(config, network)
    if duration % every:
        raise InputError(f"--duration {duration}: must be a multiple of {every:g} s, the policy's period")
    if check_every > config.rta.period:
        raise InputError(
            f"--check-every {check_every:g}: must be at most {config.rta.period:g} s, the filter's period"
        )
    where = f"--duration {duration}, checked every {check_every:g} s"
    check_clocks(config, None, check_every, duration, where)


def exported(experiment: Experiment, filter_in: str) -> Safety:
    """Returns the experiment's `Safety` with the exported filter, compiled."""
    from kernels.build import NoCompilerError
    from rta.fast.loaded import InC

    check_is_checked(experiment.config)
    if experiment.device.type != "cpu":
        raise InputError(f"--filter {filter_in}: runs on a CPU only; add --device cpu")
    with (
        as_input_error(f"--filter {filter_in}: cannot be compiled", NoCompilerError),
        announced("compiling it, seconds"),
    ):
        in_c = InC(experiment.filter)
    return dataclasses.replace(experiment.safety, correct=in_c.correct)


def decides_every(config: Config, network: Policy | None) -> float:
    """Returns the s between two decisions: an agent's action period, or the filter's period for other policies."""
    return config.inspection.action_period if network else config.rta.period


def digest(network: Policy | None) -> str:
    """Returns a digest of a policy's weights, 16 hexadecimal digits; an empty text without a policy."""
    if network is None:
        return ""
    state = sorted(network.state_dict().items())
    content = b"".join(name.encode() + weight.cpu().numpy().tobytes() for name, weight in state)
    return hashlib.sha256(content).hexdigest()[:16]
