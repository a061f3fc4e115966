"""From a configuration to the objects of an experiment."""

import sys

import torch

from inspection.environment import InspectionEnv, Safety
from inspection.observation import SIZE as OBSERVATION_SIZE
from inspection.state import CONTROL_SIZE
from ppo import checkpoint
from ppo.checkpoint import CheckpointError
from ppo.network import Policy
from rta.filter import SafetyFilter
from study import config as configuration
from study.config import Config
from study.errors import InputError, refusing

# Compiling the barrier rows takes about half a minute; it repays itself after about this many filter calls.
WORTH_COMPILING = 1000
TYPICAL_EPISODE = 3000.0  # s


def resolve_device(name: str) -> torch.device:
    """The device for auto, cpu or cuda."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: no CUDA device is available here; allowed are auto and cpu (--device cpu)"
        )
    return torch.device(
        "cuda" if name == "auto" and torch.cuda.is_available() else name.replace("auto", "cpu")
    )


def wants_compile(choice: str, filter_calls: int) -> bool:
    """Whether to compile for a run of about so many filter calls (of a batch each)."""
    return choice == "on" or (choice == "auto" and filter_calls >= WORTH_COMPILING)


def make_safety(config: Config, enabled: bool, period: float, compiled: bool = False) -> Safety:
    """Constraints, admissible starts and, if enabled, the filter."""
    with refusing("[rta] and [inspection]", ValueError, OverflowError):
        safety_filter = SafetyFilter(config.inspection, config.rta, period)
    if compiled and enabled:
        try:
            safety_filter.compile()
        except Exception as error:  # a missing or broken compiler shows itself in many ways
            reason = type(error).__name__
            print(f"the filter could not be compiled ({reason}); it runs uncompiled, slower", file=sys.stderr)
    return safety_filter.safety(enabled)


def make_env(
    config: Config, num_envs: int, generators: list[torch.Generator], safety: Safety
) -> InspectionEnv:
    """A batch of num_envs episodes per generator."""
    with refusing(
        f"[inspection], {num_envs:,} episodes", ValueError, RuntimeError, OverflowError, MemoryError
    ):
        return InspectionEnv(num_envs, config.inspection, generators, safety)


def make_policy(config: Config, generators: list[torch.Generator]) -> Policy:
    """A freshly initialised policy, one seed per generator."""
    return Policy(
        OBSERVATION_SIZE,
        CONTROL_SIZE,
        generators,
        log_std_bounds=config.ppo.log_std_bounds,
        initial_std=config.ppo.initial_std,
    )


def load_policy(path: str) -> tuple[Policy, Config]:
    """A trained policy on the CPU and the configuration it was trained in.

    Raises:
        CheckpointError, InputError: the file is missing, damaged or not a checkpoint.
    """
    content = checkpoint.load(path, ("policy", "config"))
    with refusing(f"{path}: not a checkpoint of this program", AttributeError, TypeError, RuntimeError):
        config = configuration.from_toml(content["config"], path)
        policy = make_policy(config, [torch.Generator()])
        policy.load_state_dict(content["policy"])
    if not all(torch.isfinite(weight).all() for weight in policy.parameters()):
        raise CheckpointError(f"{path}: its policy holds weights that are not finite")
    return policy, config


def for_command(config: Config, simulated: float) -> tuple[Safety, torch.device]:
    """What a command that simulates about so many s needs beside its configuration."""
    train = config.train
    device = resolve_device(train.device)
    compiled = train.rta and wants_compile(train.compile, round(simulated / train.rta_period))
    return make_safety(config, train.rta, train.rta_period, compiled), device


def one_episode(config: Config, safety: Safety, device: torch.device) -> InspectionEnv:
    """An environment of a single episode, to be started from a given state."""
    return make_env(config, 1, [torch.Generator(device).manual_seed(0)], safety)
