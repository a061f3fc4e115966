"""Which plant and filter have been verified, by a fingerprint of what the guarantee depends on."""

import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from inspection.chief.mesh import pinned
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.world.plant import PlantParameters
from ppo.distributed import is_first
from study import config as configuration
from study.commands import command
from study.config import Config, StudyConfig, override
from study.errors import MALFORMED, InputError
from study.files import ROOT

# Settings of [inspection] and [rta] on which no guarantee depends: the agent's task and reward, and the solver, whose
# answers are checked one by one. Campaigns start anywhere, so the radius of an episode's start is among them; its
# temperature and energy are not, since they bound the campaigns' starts as well. Of [chief] the hull and its attitude
# count, of [plant] and [uncertainty] everything.
IRRELEVANT = {
    "num_points",
    "points_per_cluster",
    "success_score",
    "action_period",
    "observed",
    "max_time",
    "initial_radius",
    "points_reward",
    "delta_v_reward",
    "torque_reward",
    "orientation_reward",
    "orientation_width",
    "time_reward",
    "time_reward_until",
    "terminal_reward",
    "rate_reward",
    "correction_reward",
    "limit_reward",
    "drift_reward",
    "free_flight_horizon",
    "qp_solver",
}
# Settings that came later: at their defaults they are what was flown before, and its fingerprint stays.
LATER = {
    "[inspection]": (
        InspectionParameters(),
        {"orbit", "eccentricity", "sun_from_perigee", "gravitational_parameter", "hill_rotation"},
    ),
    "[plant]": (PlantParameters(), {"simulator", "j2", "drag", "actuators"}),
}
POLICIES = ("random", "adversarial")  # each has to have flown
EPISODES = 1000  # so many at least
DURATION = 2000  # s, each at least so long
PAGE = "docs/guides/changed_constants.md"
REPORTS = "runs/verification"  # below the working directory: a person's own; the shipped ones are below runs/reference


def relevant(config: Config) -> dict[str, Any]:
    """What the guarantee depends on: values by their names in a configuration file, "[rta] period"."""
    tables = {
        "inspection": vars(config.inspection),
        "chief": of_hull(config.chief),
        "rta": vars(config.rta),
        "plant": vars(PlantParameters() if config.plant.is_nominal else config.plant),
        "uncertainty": vars(config.uncertainty),
    }
    return {
        f"[{table}] {key}": value
        for table, part in tables.items()
        for key, value in part.items()
        if key not in IRRELEVANT
    }


def of_hull(chief: ChiefParameters) -> dict[str, Any]:
    """What of a chief counts where its hull is what to stay clear of: of its file the digest, wherever it lies."""
    if chief.collision == "sphere":
        chief = ChiefParameters()
    mesh = chief.mesh
    with suppress(ValueError):  # of a report whose mesh is not here
        mesh = mesh and pinned(mesh).rpartition("#")[2]
    return {"mesh": mesh, "attitude": chief.attitude, "collision": chief.collision}


def fingerprint(config: Config) -> str:
    """The first 12 hexadecimal digits of `settings_digest`."""
    return settings_digest(config)[:12]


def settings_digest(config: Config) -> str:
    """SHA-256 of `relevant`, less a plant that is the model, bounds that are nil and LATER defaults.

    The chief counts where its hull is what to stay clear of.
    """
    nil = {
        "[plant]": config.plant.is_nominal,
        "[uncertainty]": config.uncertainty.is_nil,
        "[chief]": config.chief.collision == "sphere",
    }

    def counts(name: str, value: Any) -> bool:
        table, _, key = name.partition(" ")
        default, later = LATER.get(table, (None, set()))
        return not (nil.get(table, False) or (key in later and value == getattr(default, key)))

    settings = {name: value for name, value in relevant(config).items() if counts(name, value)}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Flown:
    """A report of `verify` in a file; its fingerprint is that of its settings, as they are read today."""

    path: Path
    report: dict[str, Any]
    config: Config

    @property
    def violating(self) -> int:
        """Episodes with a violation."""
        return int(self.report["violating_episodes"]["any"])

    @property
    def clean(self) -> bool:
        """No violation, and no program unsolved."""
        return not self.violating and not int(self.report["unsolved"])

    @property
    def large(self) -> bool:
        """Long and many enough to count."""
        return self.report["episodes"] >= EPISODES and self.report["campaign"]["duration"] >= DURATION


def reports(filters: Sequence[str] = ("python",)) -> Iterator[Flown]:
    """All reports at hand of filters in these forms, see `Campaign.filter`; a file that is none is passed over."""
    reference = ROOT / "runs" / "reference"
    for directory in (reference / "verification", reference / "frequency", Path(REPORTS)):
        for path in sorted(directory.glob("*.json")):
            try:
                report = json.loads(path.read_text(encoding="utf-8"))
                flown = Flown(path, report, override(Config(), report["config"], str(path)))
                _ = flown.clean, flown.large, report["campaign"]["policy"]
            except (OSError, *MALFORMED):
                continue
            if report["campaign"].get("filter", "python") in filters:
                yield flown


def say_unless_verified(
    config: Config, files: Sequence[str | Path], checkpoint: str | Path | None = None
) -> None:
    """Says in a line on stderr that the filter in use has not been verified; of many ranks, the first one.

    Args:
        files: of --config; checkpoint: the agent's file. Either may hold the settings.
    """
    if config.train.rta and is_first() and (reason := doubt(config, files, checkpoint)):
        print(reason, file=sys.stderr)


def doubt(config: Config, files: Sequence[str | Path], checkpoint: str | Path | None) -> str | None:
    """Why a configuration does not count as verified, and what to do about it, in a line; None where it does.

    It does where there is a report of each of POLICIES with its fingerprint, large and without a violation.
    """
    flown = list(reports())
    own = fingerprint(config)
    same = [each for each in flown if fingerprint(each.config) == own]
    if failed := [each for each in same if not each.clean]:
        worst = max(failed, key=lambda each: each.violating)
        said = (
            f"{worst.violating:,} of {worst.report['episodes']:,} episodes behind this filter violated a constraint"
            if worst.violating
            else f"{worst.report['unsolved']:,} calls of this filter were not solved"
        )
        return f"not safe: {difference(config, flown)}: {said} ({shown(worst.path)}); see {PAGE}"
    if verified(same):
        return None
    begin = f"not verified: {difference(config, flown)}; see {PAGE}"
    source = source_of(config, files, checkpoint)
    if source is None:
        return begin
    commands = [f"mkdir -p {REPORTS}"] + [
        command("verify", *source, "--policy", policy, "--json", f"{REPORTS}/{own}_{policy}.json")
        for policy in POLICIES
    ]
    return f"{begin}, or verify it: {' && '.join(commands)}"


def verified(same: list[Flown]) -> bool:
    """Whether reports of one fingerprint, all clean, are enough."""
    return {each.report["campaign"]["policy"] for each in same if each.large} >= set(POLICIES)


def difference(config: Config, flown: list[Flown]) -> str:
    """The first setting that differs from the nearest verified configuration, with both values, and how many more."""
    by_fingerprint: dict[str, list[Flown]] = {}
    for each in flown:
        by_fingerprint.setdefault(fingerprint(each.config), []).append(each)
    trusted = [
        same[0].config
        for same in by_fingerprint.values()
        if all(each.clean for each in same) and verified(same)
    ]
    ours, differing = relevant(config), []
    for other in trusted:
        theirs = relevant(other)
        names = [name for name, value in ours.items() if value != theirs[name]]
        if not differing or len(names) < len(differing):
            mesh, other_mesh = (
                {"[chief] mesh": each.chief.mesh} for each in (config, other)
            )  # not the digest
            differing = [(name, (ours | mesh)[name], (theirs | other_mesh)[name]) for name in names]
    if not differing:
        return "no configuration has been verified here"
    name, value, other = differing[0]
    texts = [in_toml(each, "{:g}") for each in (value, other)]
    if texts[0] == texts[1]:
        texts = [in_toml(each, "{!r}") for each in (value, other)]
    more = f", {len(differing) - 1} more differ" if len(differing) > 1 else ""
    return f"{name} = {texts[0]} (verified: {texts[1]}){more}"


def in_toml(value: Any, number: str) -> str:
    """A value as a configuration file has it, its numbers in the given format."""
    if isinstance(value, tuple):
        return f"[{', '.join(in_toml(each, number) for each in value)}]"
    return number.format(value) if isinstance(value, float) else json.dumps(value)


def source_of(config: Config, files: Sequence[str | Path], checkpoint: str | Path | None) -> list[str] | None:
    """The flags with which `verify` has this plant and filter; None where none are found.

    The settings may come from --config, from the config.toml nearest above a checkpoint, and from two flags.
    """
    above = Path(checkpoint).absolute().parents if checkpoint else ()
    nearest = next((folder / "config.toml" for folder in above if (folder / "config.toml").is_file()), None)
    for paths in (files, [nearest] if nearest else [], []):
        with suppress(InputError):  # somebody else's config.toml
            base = reduce(lambda under, path: configuration.load(path, under), paths, StudyConfig())
            flags, tables = [word for path in paths for word in ("--config", shown(path))], {}
            for flag, table, key in (
                ("--rta-period", "rta", "period"),
                ("--solar-panel-axis", "inspection", "solar_panel_axis"),
            ):
                value = getattr(getattr(config, table), key)
                if value != getattr(getattr(base, table), key):
                    flags += [flag, value if isinstance(value, str) else f"{value:g}"]
                    tables[table] = {key: value}
            if fingerprint(override(base, tables, "command line")) == fingerprint(config):
                return flags
    return None


def shown(path: str | Path) -> str:
    """A path as it is written from the working directory, if it is below that."""
    path, here = Path(path).absolute(), Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
