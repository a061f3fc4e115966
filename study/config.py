"""The configuration of an experiment: frozen dataclasses, each of which is a table of a TOML file."""

import dataclasses
import re
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.orbits import GUIDANCE
from inspection.world.parameters import PlantParameters
from inspection.world.uncertainty import Uncertainty
from ppo.parameters import PPOParameters
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from settings import Settings, from_toml, override, setting

# Keys that runs of earlier versions recorded. Those of a removed feature are passed over only where it was off.
RETIRED = re.compile(
    r"rows|(collision|speed|keep_in|passive_safety|velocity|rate)_gain|(exclusion|temperature|battery)_gains"
    r"|(collision|keep_in|passive_safety|exclusion|temperature|battery|rate)_margin"
    r"|passive_safety_(doubling|segments)|incidence_rounding|distance_floor|pole_angle"
    r"|slack_weight_(critical|resource|motion)|health|saturates_rates|sun_from_perigee|gravitational_parameter"
)
RETIRED_OFF = {"orbit": "clohessy-wiltshire", "eccentricity": 0.0, "action_dead_zone": 0.0}
MAX_COUNT = 10**12
LEARN_FROM = ("desired", "applied")
MAX_SEEDS = 1000  # in a study; all seeds share the memory
Tables = dict[str, dict[str, Any]]
# The paper's arms: by name, the settings in which an arm differs from the study's tables. A file's [arms] adds more.
ARMS: dict[str, Tables] = {"no_rta": {"train": {"rta": False}}, "rta": {"train": {"rta": True}}}
TEST_CASES = 0  # seed of the cases of every final evaluation
EVALUATION_CASES = 1_000_000  # seed of the cases of evaluations during training
GUIDE = "quick"  # the guidance that agents are compared with, and imitate unless another is named
BASELINES = (
    "untrained",
    "random",
    "zero",
    "natural-motion",
    GUIDE,
)  # controllers that agents are compared with
EVALUATED = tuple(dict.fromkeys((*BASELINES, *GUIDANCE)))  # controllers that `evaluate` flies
ARM = re.compile(r"(?!(report|guidance)$)[a-z0-9][a-z0-9_-]*")  # the name of an arm, and of its directory

count = partial(setting, above=0, most=MAX_COUNT)


@dataclass(frozen=True)
class TrainParameters(Settings):
    """Holds the settings of a training run."""

    rta: bool = setting(True, "whether the filter corrects the agent's actions")
    seed: int = setting(0, "of everything random; of a study, the first one", below=2**63)
    interactions: int = count(5_000_000, "agent steps of 10 s in all; rounded up to whole updates")
    num_envs: int = count(256, "episodes simulated at once, of each seed")
    rollout_steps: int = count(64, "interactions of each episode between two updates")
    device: str = setting("auto", "where tensors live", among=("auto", "cpu", "cuda"))
    compile: str = setting(
        "auto",
        "compile filter and simulator with the C compiler, on a GPU the learner, too; auto: where that is repaid",
        among=("auto", "on", "off"),
    )
    evaluation_interval: int = count(250_000, "interactions between two evaluations")
    early_evaluations: int = count(
        1, "as many within the first interval; of several, one more before training"
    )
    evaluation_episodes: int = count(20, "common test cases of each of these evaluations")
    final_episodes: int = count(100, "common test cases of the evaluation after training")
    checkpoint_interval: int = count(160_000, "interactions between two checkpoints")
    jump_start: int = setting(
        0, "of these interactions, how many the guidance teaches before PPO begins; 0: none", most=MAX_COUNT
    )
    teacher: str = setting(GUIDE, "the guidance of the jump start", among=tuple(GUIDANCE))
    learn_from: str = setting(
        "desired",
        "behind the filter (the action that the agent desired, or what the filter applied in its place)",
        among=LEARN_FROM,
    )
    keep_clear: bool = setting(
        False,
        "change the desired control so that two days of free flight stay clear of the chief (only with the filter, "
        "without error bounds)",
    )
    adversary: tuple[str, ...] = setting(
        (),
        "limits whose smallest h the agent is trained to lower, instead of the task; none: the task",
        among=CONSTRAINTS,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.early_evaluations > self.evaluation_interval:
            raise ValueError(
                f"early_evaluations = {self.early_evaluations}: must be at most evaluation_interval, "
                f"{self.evaluation_interval:,}"
            )
        if self.batch < 2:
            raise ValueError("num_envs * rollout_steps = 1: must be at least 2")
        if self.jump_start and self.lessons >= self.updates:
            raise ValueError(
                f"jump_start = {self.jump_start:,}: must leave an update, of {self.batch:,} interactions, for PPO"
            )
        if self.jump_start and self.adversary:
            raise ValueError("jump_start: an adversary has no guidance to learn from; it must be 0")
        if self.keep_clear and self.adversary:
            raise ValueError("keep_clear: what an adversary desires is not led; it must be false")

    @property
    def updates(self) -> int:
        """Returns the number of updates, those of the imitation phase included."""
        return -(-self.interactions // self.batch)

    @property
    def lessons(self) -> int:
        """Returns the number of batches of the imitation phase, each of which replaces a PPO update."""
        return -(-self.jump_start // self.batch)

    @property
    def batch(self) -> int:
        """Returns the number of interactions per update and seed."""
        return self.num_envs * self.rollout_steps


@dataclass(frozen=True)
class StudyParameters(Settings):
    """Holds the arms that a study trains, and how many seeds of each."""

    seeds: int = setting(10, "of each arm, counted up from [train] seed", above=0, most=MAX_SEEDS)
    arms: tuple[str, ...] = setting(
        tuple(ARMS), "those of [arms], and no_rta and rta, which replace [train] rta"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.arms or len(set(self.arms)) < len(self.arms):
            raise ValueError(f"arms = {list(self.arms)}: must be one or more, each once")


@dataclass(frozen=True)
class Config:
    """Holds everything that determines a run; each field is a TOML table."""

    train: TrainParameters = field(default_factory=TrainParameters)
    inspection: InspectionParameters = field(default_factory=InspectionParameters)
    chief: ChiefParameters = field(default_factory=ChiefParameters)
    rta: RtaParameters = field(default_factory=RtaParameters)
    ppo: PPOParameters = field(default_factory=PPOParameters)
    plant: PlantParameters = field(default_factory=PlantParameters)
    uncertainty: Uncertainty = field(default_factory=Uncertainty)


@dataclass(frozen=True)
class StudyConfig(Config):
    """Holds everything that determines a study.

    `arms` holds arms besides ARMS by name, each with the settings in which it differs from the study's own tables:
    `[arms.NAME.TABLE]`.
    """

    study: StudyParameters = field(default_factory=StudyParameters)
    arms: dict[str, Tables] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, tables in self.arms.items():
            if name in ARMS or not ARM.fullmatch(name):
                raise ValueError(f"[arms.{name}]: must be a name of its own, of a-z, 0-9, _ and -")
            if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
                raise ValueError(f"[arms] {name}: must be tables, as [arms.{name}.ppo]")
            if "seed" in tables.get("train", {}):
                raise ValueError(f"[arms.{name}.train] seed: must be the study's, in [train]")
        if self.train.seed + self.study.seeds > 2**63:
            raise ValueError(f"[train] seed = {self.train.seed}: too large for {self.study.seeds} seeds")
        for name in self.all_arms:
            self.of_arm(name)
        if unknown := [name for name in self.study.arms if name not in self.all_arms]:
            raise ValueError(
                f"[study] arms (--arms): {unknown[0]!r} must be one of {', '.join(self.all_arms)}"
            )

    @property
    def all_arms(self) -> dict[str, Tables]:
        """Returns the paper's arms and the arms of the file."""
        return {**ARMS, **self.arms}

    @property
    def seeds(self) -> range:
        """Returns the seeds of each arm."""
        return range(self.train.seed, self.train.seed + self.study.seeds)

    def of_arm(self, name: str) -> Config:
        """Returns the configuration of a training run of the arm's first seed.

        If the arm's filter is of another kind than the study's, the study's solver does not apply to the arm.
        """
        shared = Config(*(getattr(self, part.name) for part in dataclasses.fields(Config)))
        tables = self.all_arms[name]
        rta = tables.get("rta", {})
        if rta.get("filter", shared.rta.filter) != shared.rta.filter:
            tables = {**tables, "rta": {"qp_solver": "auto", **rta}}
        return override(shared, tables, f"[arms.{name}]")


AnyConfig = TypeVar("AnyConfig", bound=Config)


def recorded(text: str, source: str, base: AnyConfig) -> AnyConfig:
    """Reads the configuration of a finished run, as `from_toml`, without its solver and retired keys."""

    def kept(tables: dict[str, Any]) -> dict[str, Any]:
        tables = of_today(tables)
        if isinstance(rta := tables.get("rta"), dict):
            rta.pop("qp_solver", None)
        return tables

    return from_toml(text, source, base, kept)


def of_today(tables: dict[str, Any]) -> dict[str, Any]:
    """Returns the tables of a recorded configuration without retired keys, at any depth."""

    def kept(key: str, value: Any) -> bool:
        return not RETIRED.fullmatch(key) and (key not in RETIRED_OFF or value != RETIRED_OFF[key])

    return {
        key: of_today(value) if isinstance(value, dict) else value
        for key, value in tables.items()
        if isinstance(value, dict) or kept(key, value)
    }
