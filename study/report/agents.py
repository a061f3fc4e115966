"""The agents of a finished study, which its report flies."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ppo.network import Policy
from settings import InputError
from study.config import Config
from study.experiment import load_policy, make_policy
from study.paper import Results
from study.report.inputs import read_arms, read_settings


@dataclass(frozen=True)
class Arm:
    """Holds the agents of a finished arm.

    Attributes:
        config: of the first seed; policy: of all seeds.
        results: of the study; digests: SHA-256 of each seed's file.
    """

    config: Config
    policy: Policy
    results: Results
    digests: dict[str, str]

    def of_seed(self, place: int) -> Policy:
        """Returns the policy of one seed, counted from 0."""
        policy = make_policy(self.config, [torch.Generator()])
        own = {name: weights[place : place + 1] for name, weights in self.policy.state_dict().items()}
        policy.load_state_dict(own)
        return policy


def agents_of(study: Path, device: str | None) -> dict[str, Arm]:
    """Returns the arms of a finished study by name."""
    path = study / "results.json"
    if not path.is_file():
        raise InputError(f"--study {study}: no finished study there (it lacks results.json)")
    arms = read_arms(study) | read_arms(study, own=True)
    if not arms:
        raise InputError(f"{path}: holds no finished arm")
    if old := [name for name, arm in arms.items() if "clean_success" not in arm["outcomes"]]:
        raise InputError(
            f"{path}: {', '.join(old)} was evaluated by an older revision; that one can report it"
        )
    wanted = read_settings(study).study.arms
    if unfinished := [name for name in wanted if name not in arms]:
        print(f"--study {study}: {', '.join(unfinished)} is not finished and is left out", file=sys.stderr)
    return {name: load_arm(study / name, results, device) for name, results in arms.items()}


def load_arm(directory: Path, results: Results, device: str | None) -> Arm:
    """Loads an arm from its seeds' policies."""
    paths = [directory / f"seed{seed}" / "policy.pt" for seed in results["seeds"]]
    loaded = [load_policy(path) for path in paths]
    policies = [policy for policy, _ in loaded]
    config = loaded[0][1]
    return Arm(
        config=replace(config, train=replace(config.train, device=device or config.train.device)),
        policy=stacked(config, policies),
        results=results,
        digests={path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths},
    )


def stacked(config: Config, policies: Sequence[Policy]) -> Policy:
    """Returns one policy with the seeds of several, one after another; all must have the configuration's shape."""
    weights = [policy.state_dict() for policy in policies]
    together = make_policy(config, [torch.Generator() for policy in policies for _ in range(policy.seeds)])
    together.load_state_dict({name: torch.cat([own[name] for own in weights]) for name in weights[0]})
    return together
