"""The configuration of an experiment: frozen dataclasses, one TOML table each."""

import dataclasses
import os
import re
import sys
import tomllib
import types
import typing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any, TypeVar, overload

import tomli_w

from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.orbits import GUIDANCE
from inspection.world.parameters import PlantParameters
from ppo.parameters import PPOParameters
from ppo.torchrun import is_first
from rta.bounds.uncertainty import Uncertainty
from rta.constraints.names import CONSTRAINTS
from rta.parameters import RtaParameters
from setting import KINDS, Settings, setting, settings
from study.errors import InputError, instead, nearest, refusing

CONFIGS = (
    Path(__file__).parents[1] / "configs"
)  # beside the packages, in a checkout and where they are installed
SUCH_AS = "quickstart, vehicles/12u or plants/u1"
MAX_COUNT = 10**12
LEARN_FROM = ("desired", "applied", "penalty")
MAX_SEEDS = 1000  # of a study; they share the memory
Tables = dict[str, dict[str, Any]]
# The paper's: by name, in what an arm of a study differs from the study's own tables. More are in a file's [arms].
ARMS: dict[str, Tables] = {"no_rta": {"train": {"rta": False}}, "rta": {"train": {"rta": True}}}
TEST_CASES = 0  # seed of the cases of every final evaluation
GUIDE = "quick"  # the guidance with which agents are compared, and which teaches them unless another is named
BASELINES = (
    "untrained",
    "random",
    "zero",
    "natural-motion",
    GUIDE,
)  # controllers that agents are compared with
EVALUATED = tuple(dict.fromkeys((*BASELINES, *GUIDANCE)))  # controllers that `evaluate` flies

# Settings of older files and checkpoints that have moved: the table and key of then, and those of now.
MOVED = {("train", "rta_period"): ("rta", "period"), ("train", "qp_solver"): ("rta", "qp_solver")}
NAME = re.compile(r"(?!(report|guidance)$)[a-z0-9][a-z0-9_-]*")  # of an arm, and of its directory
announced: set[str] = set()  # the moves that this process has told of

count = partial(setting, above=0, most=MAX_COUNT)


@dataclass(frozen=True)
class TrainParameters(Settings):
    """Settings of a training run."""

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
    evaluation_interval: int = count(500_000, "interactions between two evaluations")
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
        "behind the filter (the action that the agent desired, what the filter applied in its place, or the former "
        "with a price on corrections)",
        among=LEARN_FROM,
    )
    keep_clear: bool = setting(
        False,
        "whether, behind a filter that is told of no bounds, what is desired is led so that two days of free flight "
        "stay clear of the chief",
    )
    adversary: tuple[str, ...] = setting(
        (),
        "constraints whose smallest h it lowers, in place of the task; left out, it learns the task",
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
        """Number of PPO updates."""
        return -(-self.interactions // self.batch)

    @property
    def lessons(self) -> int:
        """Batches of the jump start, which take the place of updates."""
        return -(-self.jump_start // self.batch)

    @property
    def batch(self) -> int:
        """Interactions per update."""
        return self.num_envs * self.rollout_steps


@dataclass(frozen=True)
class StudyParameters(Settings):
    """What a study trains."""

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
    """Everything that determines a run; each field is a TOML table."""

    train: TrainParameters = field(default_factory=TrainParameters)
    inspection: InspectionParameters = field(default_factory=InspectionParameters)
    chief: ChiefParameters = field(default_factory=ChiefParameters)
    rta: RtaParameters = field(default_factory=RtaParameters)
    ppo: PPOParameters = field(default_factory=PPOParameters)
    plant: PlantParameters = field(default_factory=PlantParameters)
    uncertainty: Uncertainty = field(default_factory=Uncertainty)

    def to_toml(self) -> str:
        """The complete configuration as TOML text that `from_toml` reads back, each key with its source's comments."""
        parts = {part.name: getattr(self, part.name) for part in dataclasses.fields(self)}
        arms = parts.pop("arms", {})
        texts = [table_text(name, part) for name, part in parts.items()]
        return "\n".join((*texts, tomli_w.dumps({"arms": arms}))) if arms else "\n".join(texts)

    def unsettled(self) -> "Config":
        """The configuration with the solver, which a run settles for its own batch, to be chosen for another one."""
        return dataclasses.replace(self, rta=dataclasses.replace(self.rta, qp_solver="auto"))


class Arms(dict[str, Tables]):
    """By name, beside ARMS, in what an arm of a study differs from the study's own tables: `[arms.NAME.TABLE]`."""

    @classmethod
    def checked(cls, entries: dict[str, Any], source: str) -> "Arms":
        """From a TOML table; raises InputError unless each entry is one of tables."""
        for name, tables in entries.items():
            if name in ARMS or not NAME.fullmatch(name):
                raise InputError(f"{source}: [arms.{name}]: must be a name of its own, of a-z, 0-9, _ and -")
            if not isinstance(tables, dict) or not all(isinstance(own, dict) for own in tables.values()):
                raise InputError(f"{source}: [arms] {name}: must be tables, as [arms.{name}.ppo]")
            if "seed" in tables.get("train", {}):
                raise InputError(f"{source}: [arms.{name}.train] seed: must be the study's, in [train]")
        return cls(entries)


@dataclass(frozen=True)
class StudyConfig(Config):
    """Everything that determines a study."""

    study: StudyParameters = field(default_factory=StudyParameters)
    arms: Arms = field(default_factory=Arms)

    def __post_init__(self) -> None:
        if self.train.seed + self.study.seeds > 2**63:
            raise InputError(f"[train] seed = {self.train.seed}: too large for {self.study.seeds} seeds")
        known = {**ARMS, **self.arms}
        for name in known:
            self.of_arm(name)
        if unknown := [name for name in self.study.arms if name not in known]:
            raise InputError(f"[study] arms (--arms): {unknown[0]!r} must be one of {', '.join(known)}")

    @property
    def seeds(self) -> range:
        """The seeds of each arm."""
        return range(self.train.seed, self.train.seed + self.study.seeds)

    def of_arm(self, name: str) -> Config:
        """The configuration of a training run of the arm's first seed.

        Where only the arm has a filter that holds controls, or only the rest, its solver is to be chosen for itself.
        """
        rest = Config(*(getattr(self, part.name) for part in dataclasses.fields(Config)))
        tables = {**ARMS, **self.arms}[name]
        own = override(rest, tables, f"[arms.{name}]")
        alike = own.uncertainty.holds(own.rta) == rest.uncertainty.holds(rest.rta)
        return own if alike or "qp_solver" in tables.get("rta", {}) else own.unsettled()


AnyConfig = TypeVar("AnyConfig", bound=Config)


def table_text(name: str, part: Settings) -> str:
    """A table of settings as TOML, each key with its comments: notes above, what it is about beside it."""
    lines = [f"[{name}]"]
    for key, own in settings(type(part)).items():
        value = getattr(part, key)
        items = [
            tomli_w.dumps({key: item}).strip() for item in (value if isinstance(value, tuple) else [value])
        ]
        if isinstance(value, tuple):  # tomli_w gives each item a line
            items = [f"{key} = [{', '.join(item.partition(' = ')[2] for item in items)}]"]
        lines += ["", *wrap(own.note, 118, initial_indent="# ", subsequent_indent="# ")] if own.note else []
        lines.append(f"{items[0]} # {own.comment}")
    return "\n".join(lines) + "\n"


@overload
def from_toml(text: str, source: str) -> Config: ...
@overload
def from_toml(text: str, source: str, base: AnyConfig) -> AnyConfig: ...
def from_toml(text: str, source: str, base: Config | None = None) -> Config:
    """Parses and checks TOML text; of a study's what its arms share, where the base is not a study's, too.

    Args:
        source: what to call the text in an error, usually the file's path.
        base: what the text's keys replace; None means the defaults.

    Raises:
        InputError: not TOML, or an unknown table or key, a wrong type or an impossible value.
    """
    try:
        tables = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{source}: not valid TOML: {error}") from None
    base = base or Config()
    left_out = () if isinstance(base, StudyConfig) else ("study", "arms")
    return override(base, {name: each for name, each in tables.items() if name not in left_out}, source)


def shipped() -> dict[str, Path]:
    """The configurations that come with this code, by name: `quickstart`, `vehicles/12u`."""
    return {
        path.relative_to(CONFIGS).with_suffix("").as_posix(): path for path in sorted(CONFIGS.rglob("*.toml"))
    }


def find(given: str) -> str:
    """The path of a configuration: the file of that path or, where there is none, the shipped one of that name.

    `vehicles/12u`, `12u` and, so that what the pages say holds in any directory, `configs/vehicles/12u.toml` are names.

    Raises:
        InputError: there is neither, or several have the name.
    """
    if os.path.exists(given) and not os.path.isdir(given):
        return given
    name = given.removesuffix(".toml").removeprefix(f"{CONFIGS.name}/")
    known = shipped()
    found = [each for each in known if each == name or each.endswith(f"/{name}")]
    if len(found) > 1:
        raise InputError(f"{given}: could be any of {', '.join(found)}; give one of these")
    if not found and not os.path.isdir(given):
        words = dict.fromkeys((*known, *(each.rpartition("/")[2] for each in known)))
        near = name.lower()
        meant = nearest(near, words) or nearest(near.rpartition("/")[2], words) or f", such as {SUCH_AS}"
        raise InputError(
            f"{given or 'an empty name'}: cannot read the configuration: neither a file nor a shipped one{meant}"
        )
    return str(known[found[0]]) if found else given


@overload
def load(path: str | Path) -> Config: ...
@overload
def load(path: str | Path, base: AnyConfig) -> AnyConfig: ...
def load(path: str | Path, base: Config | None = None) -> Config:
    """Reads a TOML file over a base configuration, by default the defaults."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")  # without the mark that some editors put first
    except OSError as error:
        raise InputError(f"{path}: cannot read the configuration: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path!r}: cannot read the configuration: {error}") from None
    return from_toml(text, str(path), base or Config())


def override(config: AnyConfig, tables: dict[str, Any], source: str) -> AnyConfig:
    """A configuration with the given tables' keys replaced, every one checked; older keys are read as today's."""
    known = vars(config)
    for table, entries in tables.items():
        if table not in known and (owner := table_of(table, known)):
            raise InputError(f"{source}: {table} = {entries!r}: must stand below a table, [{owner}]")
        if table not in known:
            raise InputError(f"{source}: unknown table [{table}]{instead(table, known)}")
        if not isinstance(entries, dict):
            raise InputError(f"{source}: {table} = {entries!r}: must be a table, [{table}]")
    tables = with_keys_of_today(tables, source)
    arms: dict[str, Any] = {"arms": Arms.checked(tables.pop("arms"), source)} if "arms" in tables else {}
    for table, entries in tables.items():
        check_keys(table, entries, known, source)
    parts = {
        table: override_table(known[table], entries, f"{source}: [{table}]")
        for table, entries in tables.items()
    }
    return dataclasses.replace(config, **parts, **arms)


def check_keys(table: str, entries: dict[str, Any], known: dict[str, Any], source: str) -> None:
    """Refuses a key that the table does not have, and says where it is or which one may have been meant."""
    names = vars(known[table])
    for key in entries:
        if key in names:
            continue
        owner = table_of(key, known)
        meant = f"; it stands in [{owner}]" if owner else instead(key, names)
        listed = "" if meant else "; `config.toml` of a run lists all"
        raise InputError(f"{source}: [{table}] unknown key {key!r}{meant}{listed}")


def table_of(key: str, tables: dict[str, Any]) -> str | None:
    """The first table that has such a key."""
    return next((name for name, part in tables.items() if key in vars(part)), None)


def with_keys_of_today(tables: dict[str, dict[str, Any]], source: str) -> dict[str, dict[str, Any]]:
    """The tables with what has moved where it is now; says so on stderr, once for the same keys."""
    tables = {table: dict(entries) for table, entries in tables.items()}
    moves = []
    for (old_table, old), (table, key) in MOVED.items():
        if old in tables.get(old_table, {}):
            if key in tables.setdefault(table, {}):
                raise InputError(
                    f"{source}: [{old_table}] {old} is [{table}] {key} by now: give the latter alone"
                )
            tables[table][key] = tables[old_table].pop(old)
            moves.append(f"[{old_table}] {old} read as [{table}] {key}")
    line = ", ".join(moves)
    in_an_agent = source.endswith(".pt")  # which nobody edits
    if moves and not in_an_agent and line not in announced and is_first():
        announced.add(line)
        print(f"{source}: older keys: {line}", file=sys.stderr)
    return tables


def override_table(part: Any, entries: dict[str, Any], where: str) -> Any:
    """A table's dataclass with entries replaced."""
    types = typing.get_type_hints(type(part))
    values = {}
    for key, value in entries.items():
        values[key] = convert(value, types[key], f"{where} {key}")
    try:
        return dataclasses.replace(part, **values)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where} {error}") from None


def convert(value: Any, wanted: Any, where: str) -> Any:
    """A TOML value as the annotated type, or an InputError naming what is allowed.

    A type of two is one of a value, or a list of several.
    """
    if isinstance(wanted, types.UnionType):
        one, several = typing.get_args(wanted)
        wanted = several if isinstance(value, list) else one
    if typing.get_origin(wanted) is tuple:
        element, *rest = typing.get_args(wanted)
        length = None if rest == [...] else 1 + len(rest)
        if not isinstance(value, list) or (length is not None and len(value) != length):
            raise InputError(
                f"{where} = {value!r}: must be a list of {length or 'several'} {element.__name__}s"
            )
        return tuple(convert(item, element, where) for item in value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if wanted is float and is_number:
        with refusing(f"{where} is too large", OverflowError):
            return float(value)
    if type(value) is wanted:
        return value
    raise InputError(f"{where} = {value!r}: must be {KINDS[wanted]}")
