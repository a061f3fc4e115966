"""Which plant and filter have been verified, by a fingerprint of all that the guarantee depends on."""

import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from inspection.chief.mesh import with_digest
from inspection.model.parameters import ChiefParameters, Limits
from inspection.world.parameters import PlantParameters
from ppo.distributed import is_first
from rta.limits import PAPER
from rta.names import OWN, PAPERS
from settings import override, rules
from study.config import Config, of_today
from study.errors import MALFORMED
from study.experiment import checked_filter, ignores_keep_clear
from study.files import ROOT, read_json

LIMITS = "limits of your own"
GAINS = "rta/limits.py"  # holds the gains, which are not settings
# Settings that were added later. Their defaults are what was flown before, so that the fingerprint stays the same.
LATER = {
    "[inspection] hill_rotation",
    "[rta] unverified",
    "[rta] filter",
    LIMITS,
    *(f"[plant] {key}" for key in ("simulator", "j2", "drag", "actuators", "errors")),
}
POLICIES = ("random", "adversarial")  # a campaign of each is required
EPISODES = 1000  # at least
DURATION = 2000  # s, of each episode, at least
PAGE = "docs/guides/your_own_spacecraft.md"
CHECK = "docs/reference/filter.md"
REPORTS = "runs/verification"  # a person's own, below the working directory; shipped ones: runs/reference


def gains_of() -> str:
    """Returns a digest of the gains and weights of the paper's limits."""
    table = [(name, limit.gains, limit.weight) for name, limit in PAPER.items()]
    return hashlib.sha256(json.dumps(table).encode()).hexdigest()[:12]


def relevant(config: Config, own: Sequence[str] = OWN, gains: str | None = None) -> dict[str, Any]:
    """Returns what the guarantee depends on: values by name, such as "[rta] period", and the names of your own limits.

    Args:
        gains: digest as from `gains_of`; None: today's.

    The episode is not among the values, nor the solver, since each of its answers is checked. Of [chief] only the hull
    and its attitude are.
    """
    plant = PlantParameters() if config.plant.is_nominal else config.plant
    tables = {
        "inspection": {key: getattr(config.inspection, key) for key in rules(Limits)},
        "chief": of_hull(config.chief),
        "rta": {key: value for key, value in vars(config.rta).items() if key != "qp_solver"},
        "plant": vars(plant),
        "uncertainty": vars(config.uncertainty),
    }
    values = {f"[{table}] {key}": value for table, part in tables.items() for key, value in part.items()}
    return values | {LIMITS: own, GAINS: gains_of() if gains is None else gains}


def of_hull(chief: ChiefParameters) -> dict[str, Any]:
    """Returns the settings of a chief that matter for its hull; the file's digest stands for its mesh, not its path."""
    if chief.collision == "sphere":
        chief = ChiefParameters()
    mesh = chief.mesh
    with suppress(ValueError):  # the mesh of a report may not be here
        mesh = mesh and with_digest(mesh).rpartition("#")[2]
    return {"mesh": mesh, "attitude": chief.attitude, "collision": chief.collision}


def fingerprint(config: Config) -> str:
    """Returns the first 12 hexadecimal digits of `settings_digest`."""
    return settings_digest(config)[:12]


def code_digest(config: Config) -> str:
    """Returns the first 12 hexadecimal digits of the SHA-256 of a filter in C, its forms for one and for a batch."""
    from kernels.build import header
    from kernels.cache import remembered
    from rta.fast.files import implementation
    from rta.fast.filter import printed_answer

    safety_filter = checked_filter(config)
    batch = remembered(printed_answer, safety_filter, False)
    own = batch.waiting or batch.text
    texts = [implementation(safety_filter), *batch.parts, own, header("waiting.h")]
    return hashlib.sha256("".join(texts).encode()).hexdigest()[:12]


def settings_digest(config: Config) -> str:
    """Returns the SHA-256 of `relevant` without a nominal plant, zero bounds, a spherical chief and LATER defaults."""
    nil = {
        "[plant]": config.plant.is_nominal,
        "[uncertainty]": config.uncertainty.is_zero,
        "[chief]": config.chief.collision == "sphere",
    }
    default = relevant(Config(), ())
    counting = {
        name: value
        for name, value in relevant(config).items()
        if not nil.get(name.split()[0]) and not (name in LATER and value == default[name])
    }
    return hashlib.sha256(json.dumps(counting, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Flown:
    """Holds a report of `verify` from a file, with its settings as they are read today."""

    path: Path
    report: dict[str, Any]
    config: Config

    @cached_property
    def relevant(self) -> dict[str, Any]:
        """Returns `relevant` of the report's settings, with the limits that the report counted."""
        own = [name for name in self.report["violating_episodes"] if name not in (*PAPERS, "any")]
        return relevant(self.config, tuple(own), self.report.get("gains", ""))

    @property
    def violating(self) -> int:
        """Returns the number of episodes with a violation."""
        return int(self.report["violating_episodes"]["any"])

    @property
    def clean(self) -> bool:
        """Tells whether the report has no violation and no unsolved program."""
        return not self.violating and not int(self.report["unsolved"])

    @property
    def large(self) -> bool:
        """Tells whether the episodes count: long and many enough, and begun anywhere in the safe set."""
        campaign = self.report["campaign"]
        enough = self.report["episodes"] >= EPISODES and campaign["duration"] >= DURATION
        return enough and campaign.get("starts", "anywhere") == "anywhere"


def reports(filters: Sequence[str] = ("python",)) -> Iterator[Flown]:
    """Yields all available reports of filters in these forms, see `Campaign.filter`; skips files of other content."""
    reference = ROOT / "runs" / "reference"
    shipped = [reference / name for name in ("verification", "frequency", "paper_filter")]
    for directory in (*shipped, Path(REPORTS)):
        for path in sorted(directory.glob("*.json")):
            try:
                report = read_json(path, "report")
                flown = Flown(path, report, override(Config(), of_today(report["config"]), str(path)))
                _ = flown.clean, flown.large, report["campaign"]["policy"]
            except (OSError, *MALFORMED):
                continue
            if report["campaign"].get("filter", "python") in filters:
                yield flown


def alike(values: dict[str, Any], flown: Sequence[Flown]) -> list[Flown]:
    """Returns the reports of the plant and filter with these `relevant` values."""
    return [each for each in flown if each.relevant == values]


def warn_if_unverified(config: Config) -> None:
    """Warns on stderr of what the filter in use does not check, and that it has not been verified, in a line each."""
    warn_if_unchecked(config)
    if config.train.rta and is_first() and (reason := why_unverified(config)):
        print(reason, file=sys.stderr)


def warn_if_unchecked(config: Config) -> None:
    """Warns in a line each of what the filter does not check, and of what is ignored; of many ranks, the first one."""
    if is_first() and (why := ignores_keep_clear(config)):
        print(f"--keep-clear ([train] keep_clear) is ignored: {why}", file=sys.stderr)
    if config.train.rta and is_first() and (said := unchecked(config)):
        print(said, file=sys.stderr)


def unchecked(config: Config) -> str | None:
    """Returns in a line what the filter of a configuration does not check; None: it checks everything."""
    if config.rta.filter == "paper":
        return f"not checked: motion and attitude; the paper's filter has no check; see {CHECK}"
    known = checked_filter(config).checked
    names = [name for name, is_known in zip(("motion", "attitude"), known, strict=True) if not is_known]
    return f"not checked: {' and '.join(names)}; see {CHECK}" if names else None


def why_unverified(config: Config) -> str | None:
    """Returns in a line why a configuration does not count as verified; None if it does.

    It does if each of POLICIES has a large report on its plant and filter, and no report has a violation or an unsolved
    program.
    """
    flown = list(reports())
    same = alike(relevant(config), flown)
    if failed := [each for each in same if not each.clean]:
        worst = max(failed, key=lambda each: each.violating)
        said = (
            f"{worst.violating:,} of {worst.report['episodes']:,} episodes behind this filter violated a constraint"
            if worst.violating
            else f"{worst.report['unsolved']:,} calls of this filter were not solved"
        )
        return f"not safe: {difference(config, flown)}: {said} ({shown(worst.path)}); see {PAGE}"
    return None if verified(same) else f"not verified: {difference(config, flown)}; see {PAGE}"


def verified(same: list[Flown]) -> bool:
    """Tells whether reports of one plant and filter are enough: all clean, and a large one of each of POLICIES."""
    return all(each.clean for each in same) and {
        each.report["campaign"]["policy"] for each in same if each.large
    } >= set(POLICIES)


def difference(config: Config, flown: list[Flown]) -> str:
    """Returns the first difference from the closest verified configuration, with both values, and how many others."""
    ours = relevant(config)

    def names(other: Flown) -> list[str]:
        return [name for name, value in ours.items() if value != other.relevant[name]]

    trusted = [each for each in flown if verified(alike(each.relevant, flown))]
    if not trusted:
        return "no campaign is at hand"
    nearest = min(trusted, key=lambda each: len(names(each)))
    name, *others = names(nearest)
    values = [ours[name], nearest.relevant[name]]
    if name == "[chief] mesh":  # not the digest
        values = [config.chief.mesh, nearest.config.chief.mesh]
    texts = [in_toml(each, "{:g}") for each in values]
    if texts[0] == texts[1]:
        texts = [in_toml(each, "{!r}") for each in values]
    more = f", {len(others)} more differ" if others else ""
    return f"{name} = {texts[0]} (verified: {texts[1]}){more}"


def in_toml(value: Any, number: str) -> str:
    """Returns a value as in a configuration file, its floats in the given format."""
    if isinstance(value, tuple):
        return f"[{', '.join(in_toml(each, number) for each in value)}]"
    return number.format(value) if isinstance(value, float) else json.dumps(value)


def shown(path: str | Path) -> str:
    """Returns a path relative to the working directory if it is below this, else absolute."""
    path, here = Path(path).absolute(), Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
