"""An experiment, built once from its configuration: device, filter, environments and policies."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from columns import if_long
from inspection.chief.hull import with_hull
from inspection.chief.mesh import with_digest
from inspection.chief.surface import surface
from inspection.closed_loop import Safety
from inspection.environment import Compiler, InspectionEnv, clocks_of
from inspection.initial_state import InitialStates
from inspection.model.draws import uniform
from inspection.model.state import CONTROL_SIZE
from inspection.observation import components
from inspection.privileged import PRIVILEGED
from inspection.world.uncertainty import Uncertainty
from ppo import checkpoint
from ppo.errors import CheckpointError
from ppo.network import Policy, Value
from rta.filter import SafetyFilter
from rta.keep_clear import kept_clear
from rta.names import OWN
from rta.own import OWN as OWN_LIMITS
from rta.parameters import RtaParameters
from settings import InputError
from study.config import AnyConfig, Config, recorded
from study.errors import as_input_error
from study.flight.fly import Starts
from study.machine import WORTH_COMPILING_FILTER, announced, compile_or_explain, resolve_device, wants_compile

EPISODE = 3600  # s, about the length of an agent's episode

# settings on which "free_flight" in `observed` depends
OF_FREE_FLIGHT = ("passive_safety_horizon", "free_flight_horizon", "deputy_radius", "chief_radius")

LARGEST_WEIGHT = 1e3  # of a policy; weights after training are at most 2


def ignores_keep_clear(config: Config) -> str | None:
    """Returns why a configuration that asks for `[train] keep_clear` cannot have it; None: it can, or does not ask."""
    if config.train.keep_clear and not config.train.rta:
        return "it leads what the filter is asked for, and there is none (--no-rta)"
    if config.train.keep_clear and not config.uncertainty.is_zero:
        return "within [uncertainty] no free flight is known"
    return None


class Experiment:
    """Builds from a configuration the device, the filter, environments and networks.

    Args:
        config: the configuration.
        batch: about how many spacecraft are filtered at once.
        seconds: simulated time of the experiment, to judge whether compiling saves time; None: an episode.

    Attributes:
        config: with the digest of the chief's mesh; device; filter.
        task: `[inspection]`, with the chief's hull if this is the keep-out zone.
        safety: constraints, accepted initial states and, if the configuration wants it, the filter.
        filter_compiled, compiled: the filter is compiled; simulator and learner are to be compiled.

    Raises:
        InputError: parts of the configuration contradict each other, or the machine does not support them.
    """

    def __init__(self, config: Config, batch: int, seconds: float | None = None) -> None:
        check_clocks(config)
        check_plant(config)
        check_chief(config)
        check_cache()
        self.device = resolve_device(config.train.device)
        seconds = min(EPISODE, config.inspection.max_time) if seconds is None else seconds
        choice, calls = config.train.compile, seconds / config.rta.period
        steps = seconds / config.inspection.action_period
        self.filter_compiled = config.train.rta and wants_compile(choice, calls, WORTH_COMPILING_FILTER)
        self.config = settled(config)
        self.compiled = wants_compile(choice, steps)
        self.task = with_hull(config.inspection, config.chief)
        self.filter = filter_of(self.config)
        with as_input_error("[plant] and [inspection]", ValueError):
            config.plant.check_body(config.inspection)
        if self.filter_compiled:
            self.filter_compiled = compile_or_explain("filter", lambda: self.compile_filter(batch))
        self.safety = self.filter.safety(config.train.rta)
        if config.train.keep_clear and not ignores_keep_clear(config):
            self.safety = kept_clear(self.safety, self.task)

    def compile_filter(self, batch: int) -> None:
        """Replaces the filter by a compiled one; raises as `rta.fast.filter.fast`."""
        from rta.fast.filter import fast

        self.filter = fast(self.filter, self.device, batch)

    @property
    def compiler(self) -> Compiler:
        """Returns the compiler of functions of a batch."""
        from kernels.compiled import Compiled

        return Compiled

    def of_states(self, function: Callable[[Tensor], list[Tensor]]) -> Callable[[Tensor], list[Tensor]]:
        """Returns a function of states (16, B), compiled if the filter is."""
        if not self.filter_compiled:
            return function
        example, planes = self.filter.probe(self.device)[0], self.filter.c.planes
        return self.compiler(function, example, long=if_long(len(planes)))

    def generators(self, seeds: Sequence[int] = (0,)) -> list[torch.Generator]:
        """Returns one generator per seed, on the device."""
        return [torch.Generator(self.device).manual_seed(seed) for seed in seeds]

    def env(
        self,
        num_envs: int,
        generators: Sequence[torch.Generator] | None = None,
        decide_every: float | None = None,
        report_every: float | None = None,
        compiled: bool = False,
        safety: Safety | None = None,
        privileged: bool = False,
    ) -> InspectionEnv:
        """Makes a batch of num_envs episodes per generator, compiled if wanted and possible.

        Args:
            decide_every, report_every: as in `InspectionEnv`.
            safety: replaces the experiment's; privileged: as in `InspectionEnv`.
        """
        with as_input_error(
            f"[inspection] and [chief], {num_envs:,} episodes",
            ValueError,
            RuntimeError,
            OverflowError,
            MemoryError,
        ):
            env = InspectionEnv(
                num_envs,
                self.task,
                generators or self.generators(),
                safety or self.safety,
                decide_every,
                report_every,
                self.config.plant,
                self.config.chief,
                privileged,
            )
        if compiled:
            compile_or_explain("simulator", lambda: env.compile(self.compiler))
        return env

    def policy(self, generators: Sequence[torch.Generator]) -> Policy:
        """Returns a freshly initialised policy, one seed per generator."""
        return make_policy(self.config, generators)

    def value(self, generators: Sequence[torch.Generator]) -> Value:
        """Returns a freshly initialised value network, one seed per generator."""
        observed = len(components(self.config.inspection))
        size = observed + (PRIVILEGED if self.config.ppo.privileged else 0)
        return Value(size, generators, self.config.ppo.hidden)


def filter_of(config: Config) -> SafetyFilter:
    """Returns the filter that a configuration asks for; raises InputError if its parts contradict each other.

    A filter that does not correct controls needs no check.
    """
    rta = config.rta if config.train.rta else replace(config.rta, unverified=True)
    is_paper = config.rta.filter == "paper"
    if is_paper and config.chief.collision == "hull":
        raise InputError('[rta] filter = "paper": keeps clear of a sphere; must be "checked" beside a hull')
    if is_paper and config.train.rta and not config.uncertainty.is_zero:
        raise InputError(
            '[rta] filter = "paper": knows no [uncertainty]; must be "checked" with error bounds'
        )
    if is_paper and OWN:
        raise InputError(
            f'[rta] filter = "paper": has the paper\'s limits alone, not {", ".join(OWN)}; must be "checked"'
        )
    if tuple(OWN_LIMITS) != OWN:
        raise InputError(
            f"rta/names.py: OWN = {list(OWN)}: must be {list(OWN_LIMITS)}, the limits in rta/own.py"
        )
    with as_input_error("[rta], [inspection] and [uncertainty]", ValueError, OverflowError):
        task = with_hull(config.inspection, config.chief)
        if is_paper or config.uncertainty.is_zero:
            found = SafetyFilter(task, rta, OWN_LIMITS)
        elif find_spec("rta.robust"):
            from rta.robust.filter import RobustFilter

            found = RobustFilter(task, rta, OWN_LIMITS, uncertainty=config.uncertainty)
        else:
            raise InputError("[uncertainty]: rta/robust is not here, so that error bounds must be nil")
    if rta.solver == "batched" and find_spec("rta.fast"):
        from rta.fast.filter import batched

        return batched(found)
    return found


def check_is_checked(config: Config) -> None:
    """Raises InputError if a configuration asks for a filter without a check."""
    if config.rta.filter != "checked":
        raise InputError(
            f'[rta] filter (--rta-filter) = "{config.rta.filter}": must be "checked" for this command'
        )


def checked_filter(config: Config) -> SafetyFilter:
    """Returns the filter with a check; raises InputError if the configuration asks for another filter or is wrong."""
    check_is_checked(config)
    return filter_of(config)


def paper_task(
    batch: int, seed: int, rta: bool = False, decide_every: float | None = None, **task: Any
) -> tuple[Experiment, InspectionEnv]:
    """Builds the default task, compiled on the CPU, in which programs fly the guidance without or with the filter.

    Args:
        batch: episodes; seed: of their random numbers; decide_every: as in `InspectionEnv`.
        task: changed constants, as in `InspectionParameters`.
    """
    base = Config()
    config = replace(
        base,
        train=replace(base.train, rta=rta, device="cpu", compile="on"),
        inspection=replace(base.inspection, **task),
    )
    experiment = Experiment(config, batch)
    generators = experiment.generators([seed])
    return experiment, experiment.env(batch, generators, decide_every=decide_every, compiled=True)


def test_cases(config: Config, episodes: int, seed: int) -> Starts:
    """Returns the common test cases, the same for every agent and device; no case depends on the number of cases."""
    drawn_by = replace(config, rta=RtaParameters(unverified=True), uncertainty=Uncertainty())
    with (
        as_input_error(
            "[inspection]: no test cases, whose starts the checked filter accepts", RuntimeError, ValueError
        ),
        announced("drawing the test cases, seconds"),
    ):
        accepting = filter_of(drawn_by)
        starts = InitialStates(torch.Generator().manual_seed(seed), accepting.c, accepting.is_safe)
        x, priority = starts.take(episodes)
    return Starts(x, priority, plant_numbers(episodes, seed))


def plant_numbers(episodes: int, seed: int) -> Tensor:
    """Returns the numbers (episodes,) from which the plants and chiefs of the test cases of a seed follow."""
    return uniform(0.0, 1.0, episodes, torch.Generator().manual_seed(seed + 1))  # not the states' stream


def check_clocks(
    config: Config,
    decide_every: float | None = None,
    report_every: float | None = None,
    duration: float | None = None,
    where: str = "clocks that do not fit",
) -> None:
    """Raises InputError for clocks that do not divide, before anything is built; `where` begins the message."""
    c, period = config.inspection, config.rta.period if config.train.rta else None
    with as_input_error(where, ValueError):
        clocks_of(c, period, decide_every, report_every).count(duration or c.action_period)


def check_plant(config: Config) -> None:
    """Raises InputError for effects that the simulator does not have, and for Basilisk if it is not installed."""
    with as_input_error("[plant]", ValueError):
        config.plant.check_simulator()
    if config.plant.simulator == "basilisk" and not find_spec("Basilisk"):
        raise InputError(
            "--plant basilisk ([plant] simulator): Basilisk is not installed here; see docs/guides/basilisk.md"
        )


def check_chief(config: Config) -> None:
    """Raises InputError for a chief whose mesh cannot be used, before anything is built or written."""
    if config.chief.mesh:
        with as_input_error("[chief]", ValueError):
            surface(config.chief, config.inspection)
            with_hull(config.inspection, config.chief)


def check_cache() -> None:
    """Raises InputError if the compile cache cannot be made: PyTorch makes it even if nothing is compiled."""
    if path := os.environ.get("TORCHINDUCTOR_CACHE_DIR"):
        with as_input_error(
            f"TORCHINDUCTOR_CACHE_DIR {path!r}: cannot make this directory", OSError, ValueError
        ):
            Path(path).mkdir(parents=True, exist_ok=True)


def settled(config: AnyConfig) -> AnyConfig:
    """Returns the configuration with the digest of the chief's mesh, on which a run's numbers depend."""
    with as_input_error("[chief]", ValueError):
        mesh = config.chief.mesh and with_digest(config.chief.mesh)
    return replace(config, chief=replace(config.chief, mesh=mesh))


def make_policy(config: Config, generators: Sequence[torch.Generator]) -> Policy:
    """Returns a freshly initialised policy, one seed per generator."""
    ppo = config.ppo
    return Policy(
        len(components(config.inspection)),
        CONTROL_SIZE,
        generators,
        ppo.hidden,
        ppo.log_std_bounds,
        ppo.initial_std,
        ppo.action_power,
        ppo.tanh_outputs,
    )


def load_policy(path: str | Path) -> tuple[Policy, Config]:
    """Loads a trained policy to the CPU, and the configuration of its training.

    Raises:
        CheckpointError, InputError: the file is missing, damaged or not a checkpoint.
    """
    content = checkpoint.load(path, ("policy", "config"))
    with as_input_error(f"{path}: not a checkpoint of this program", AttributeError, TypeError, RuntimeError):
        config = recorded(content["config"], str(path), Config())
        policy = make_policy(config, [torch.Generator()])
        check_weights(content["policy"], path)
        policy.load_state_dict(content["policy"])
    return policy, config


def check_observed(config: Config, trained: Config) -> None:
    """Raises InputError if an agent would observe anything else than in training."""
    ours, theirs = (list(each.inspection.observed) for each in (config, trained))
    if set(ours) != set(theirs):
        raise InputError(f"[inspection] observed = {ours}: the agent was trained with {theirs}")
    scales, trained_with = (list(each.inspection.observation_scales) for each in (config, trained))
    if scales != trained_with:
        raise InputError(
            f"[inspection] observation_scales = {scales}: the agent was trained with {trained_with}"
        )
    for name in OF_FREE_FLIGHT if "free_flight" in ours else ():
        value, before = (getattr(each.inspection, name) for each in (config, trained))
        if value != before:
            raise InputError(
                f"[inspection] {name} = {value:g}: the agent observes free flight and was trained with {before:g}"
            )


def check_weights(weights: dict[str, Tensor], path: str | Path) -> None:
    """Raises CheckpointError for weights that cannot come from training."""
    for name, weight in weights.items():
        if weight.dtype != torch.float32:
            raise CheckpointError(f"{path}: {name} is {weight.dtype}: must be torch.float32")
        if not (weight.abs() <= LARGEST_WEIGHT).all():  # False for NaN
            raise CheckpointError(
                f"{path}: its policy holds weights that are not finite or beyond {LARGEST_WEIGHT:g}"
            )
