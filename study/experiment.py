"""From a configuration to the objects of an experiment."""

import functools
import sys
from collections.abc import Callable

import torch
from torch._inductor.cpp_builder import get_cpp_compiler

from inspection.environment import InspectionEnv, Safety
from inspection.observation import SIZE as OBSERVATION_SIZE
from inspection.state import CONTROL_SIZE
from ppo import checkpoint
from ppo.checkpoint import CheckpointError
from ppo.distributed import local_rank
from ppo.network import Policy
from rta.filter import SafetyFilter, make_solver
from study import config as configuration
from study.config import Config, TrainParameters
from study.errors import InputError, refusing

# Compiling takes about a minute the first time, which as many filter calls or steps (of a batch each) repay.
WORTH_COMPILING_FILTER = 1000
WORTH_COMPILING_SIMULATOR = 3000
TYPICAL_EPISODE = 3000.0  # s

# Spacecraft from which the batched solver is the faster one on a CPU: about half of them have a program to solve, and
# `python main.py benchmark` shows both solvers by the number of programs at once, which cross below 16.
WORTH_BATCHING = 32


def resolve_device(name: str) -> torch.device:
    """The device for auto, cpu or cuda."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: no CUDA device is available here; allowed are auto and cpu (--device cpu)"
        )
    device = torch.device(
        "cuda" if name == "auto" and torch.cuda.is_available() else name.replace("auto", "cpu")
    )
    if device.type == "cuda" and local_rank() > 0:  # each rank of a machine has a device of its own
        devices = torch.cuda.device_count()
        if local_rank() >= devices:
            raise InputError(f"device cuda: {devices} here, too few for rank {local_rank()} of this machine")
        torch.cuda.set_device(local_rank())
    return device


def wants_compile(choice: str, repaid: bool) -> bool:
    """Whether to compile for --compile auto, on or off, given whether the run is long enough to repay it."""
    return (choice == "on" or (choice == "auto" and repaid)) and finds_compiler()


@functools.cache
def finds_compiler() -> bool:
    """Whether there is a C++ compiler; if not, says so, once."""
    try:
        get_cpp_compiler()
    except Exception as error:  # no compiler, or a broken one: PyTorch's exceptions differ by version
        print(
            f"no C++ compiler was found ({type(error).__name__}); uncompiled, this is slower", file=sys.stderr
        )
        return False
    return True


def faster_solver(train: TrainParameters) -> str:
    """The solver for --qp-solver auto in a training run: piqp or batched."""
    on_cpu = resolve_device(train.device).type == "cpu"
    return "piqp" if on_cpu and train.num_envs < WORTH_BATCHING else "batched"


def qp_solver(train: TrainParameters) -> str:
    """The name of the filter's solver, with auto resolved."""
    return faster_solver(train) if train.qp_solver == "auto" else train.qp_solver


def compile_or_explain(what: str, compile: Callable[[], None]) -> bool:
    """Compiles; where that fails, says so in a line. Returns whether it went well."""
    try:
        compile()
    except Exception as error:  # a missing or broken compiler shows itself in many ways
        print(
            f"the {what} could not be compiled ({type(error).__name__}); uncompiled, it is slower",
            file=sys.stderr,
        )
        return False
    return True


def make_filter(config: Config, period: float, compiled: bool = False, batch: int = 1) -> SafetyFilter:
    """The filter called every `period` s, with the configuration's solver; compiled for its device if possible.

    Args:
        batch: about how many spacecraft a call will have.
    """
    with refusing("[rta] and [inspection]", ValueError, OverflowError):
        solver = make_solver(qp_solver(config.train))
        safety_filter = SafetyFilter(config.inspection, config.rta, period, solver)
    if compiled:
        device = resolve_device(config.train.device)
        compile_or_explain("filter", lambda: safety_filter.compile(device, batch))
    return safety_filter


def make_safety(
    config: Config, enabled: bool, period: float, compiled: bool = False, batch: int = 1
) -> Safety:
    """Constraints, admissible starts and, if enabled, the filter, compiled for about so many episodes."""
    return make_filter(config, period, compiled and enabled, batch).safety(enabled)


def make_env(
    config: Config,
    num_envs: int,
    generators: list[torch.Generator],
    safety: Safety,
    compiled: bool = False,
) -> InspectionEnv:
    """A batch of num_envs episodes per generator, compiled if wanted and possible."""
    with refusing(
        f"[inspection], {num_envs:,} episodes", ValueError, RuntimeError, OverflowError, MemoryError
    ):
        env = InspectionEnv(num_envs, config.inspection, generators, safety)
    if compiled:
        compile_or_explain("simulator", env.compile)
    return env


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


def for_command(config: Config, simulated: float, batch: int) -> tuple[Safety, torch.device]:
    """What a command that simulates `batch` episodes for about so many s needs beside its configuration."""
    train = config.train
    device = resolve_device(train.device)
    repaid = simulated / train.rta_period >= WORTH_COMPILING_FILTER
    compiled = train.rta and wants_compile(train.compile, repaid)
    return make_safety(config, train.rta, train.rta_period, compiled, batch), device


def one_episode(config: Config, safety: Safety, device: torch.device) -> InspectionEnv:
    """An environment of a single episode, to be started from a given state."""
    return make_env(config, 1, [torch.Generator(device).manual_seed(0)], safety)
