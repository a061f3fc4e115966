"""A campaign: batch after batch of starts flown under one policy, into a report that a longer campaign goes on with."""

import dataclasses
import hashlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from inspection.environment import InspectionEnv
from inspection.guidance import Controller
from ppo.network import Policy
from rta.constraints import CONSTRAINTS
from rta.filter import SafetyFilter
from study import experiment as build
from study.config import Config
from study.errors import InputError, refusing
from study.files import write_json
from study.flight.summary import upper_bound
from study.verification.adversaries import adversarial, agent, held_at_random
from study.verification.counter_examples import counter_example
from study.verification.findings import continued, empty_report
from study.verification.flight import fly
from study.verification.starts import initial_states, spawned
from study.verification.tally import Origin, add

BATCH = 1024  # starts drawn at once


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
    report = empty_report(dataclasses.asdict(campaign), dataclasses.asdict(config))
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
                    np.savez_compressed(
                        f"{path}.{name}.npz", **counter_example(flight, i, campaign.period, config)
                    )
            write_json(path, report)
    yield report


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
