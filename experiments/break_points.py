"""Finds where the filter fails: one effect of the plant at a time, of rising size, with and without error bounds.

`main.py break-points`. Each effect and size is flown like a campaign of `study.verification.campaign`, once with errors
held at a corner of their bounds and once with the worst errors. The break point of a limit is the smallest tried size
at which an episode violated it in either flight; a size holds if no episode did. Bounds for which no check is known are
refused.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from inspection.world.parameters import PlantParameters
from rta.names import CONSTRAINTS
from settings import InputError, override
from study.config import Config
from study.experiment import Experiment, check_is_checked
from study.files import write_json
from study.flight.figures import GREY, SAFE, UNSAFE
from study.machine import bar
from study.verification.campaign import looking_ahead, run
from study.verification.findings import WIDTH, Campaign, report_in
from study.verified import fingerprint, gains_of

HATCHED: dict[str, Any] = {
    "fill": False,
    "hatch": "///",
    "ec": "0.75",
    "lw": 0,
}  # a cell with a size that was not flown
COLUMNS = {
    "separation": ("collision",),
    "speed": ("dynamic_speed",),
    "zone": ("keep_in_zone",),
    "passive\nsafety": ("passive_safety",),
    "velocity": ("velocity_x", "velocity_y", "velocity_z"),
    "Sun\nexclusion": ("attitude_exclusion",),
    "heat": ("temperature",),
    "battery": ("battery",),
    "body\nrates": ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z"),
}
MISSED = 0.8  # probability of a missed call, at most `size` in a row; so even nine in a row occur
ERRORS = ("steady", "worst")  # kinds of errors; each plant is flown with both


class Effect(NamedTuple):
    """Holds an effect: unit and tried sizes, and by size the `[plant]` with it and the `[uncertainty]` that covers it.

    `told` takes the size and the filter's period in s.
    """

    unit: str
    sizes: tuple[float, ...]
    plant: Callable[[float], dict[str, Any]]
    told: Callable[[float, float], dict[str, Any]]


def factor(key: str, told: str, *sizes: float) -> Effect:
    """Returns the effect of a factor between 1 - size and 1 + size."""
    return Effect("", sizes, lambda s: {key: [1.0 - s, 1.0 + s]}, lambda s, _: {told: s})


def noise(key: str, unit: str, *sizes: float) -> Effect:
    """Returns the effect of a sensor whose axes err by up to the size."""
    return Effect(
        unit, sizes, lambda s: {f"{key}_noise": s / PlantParameters.noise_bound}, lambda s, _: {key: s}
    )


def alike(key: str, unit: str, *sizes: float, kind: type = float) -> Effect:
    """Returns the effect of a key that [plant] and [uncertainty] share."""
    return Effect(unit, sizes, lambda s: {key: kind(s)}, lambda s, _: {key: kind(s)})


EFFECTS = {
    "mass": factor("mass_factor", "mass", 0.03, 0.1, 0.3, 0.5),
    # at more than a third some inertias are impossible for a body
    "inertia": factor("inertia_factor", "inertia", 0.03, 0.1, 0.2, 0.3),
    "thrust gain": factor("thrust_gain", "thrust_gain", 0.03, 0.1, 0.3, 0.5),
    "torque gain": factor("torque_gain", "torque_gain", 0.1, 0.3, 0.6, 0.9),
    "misalignment": alike("thrust_misalignment", "deg", 1.0, 3.0, 10.0, 30.0),
    "acceleration": alike("acceleration", "m/s²", 1e-5, 1e-3, 1e-2, 3e-2),
    "position error": noise("position", "m", 0.1, 0.6, 3.0, 20.0),
    "velocity error": noise("velocity", "m/s", 0.001, 0.006, 0.03, 0.1),
    "attitude error": noise("attitude", "deg", 0.3, 1.0, 3.0, 10.0),
    "rate error": noise("rate", "deg/s", 0.03, 0.1, 0.3, 1.0),
    "latency": alike("latency", "calls", 1.0, 2.0, 5.0, 10.0, kind=int),
    "missed in a row": Effect(
        "calls",
        (1.0, 2.0, 4.0, 9.0),
        lambda s: {"missed_calls": MISSED, "missed_in_a_row": int(s)},
        lambda s, period: {"longest_hold": (s + 1.0) * period},
    ),
    "least impulse": alike("minimum_thrust", "N", 0.02, 0.1, 0.3, 0.6),
    "quantum": alike("thrust_quantum", "N", 0.05, 0.2, 0.5, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Worlds:
    """Holds what determines the numbers besides the configuration, see `Campaign`."""

    policy: str
    period: float
    duration: float
    seed: int
    episodes: int
    missed: float = MISSED
    errors: str = "drawn"  # the errors of older reports, which do not say


def empty_report(worlds: Any, config: Config) -> dict[str, Any]:
    """Returns a report without worlds, in the form of `break-points --json`.

    Each of `worlds` has its effect, size and whether the filter was told. It also has `violating_episodes` by limit,
    over all ERRORS, and the number of unsolved filter calls, or else `refused`, the reason why it was not flown.
    """
    return {
        "campaign": dataclasses.asdict(worlds),
        "worlds": [],
        "fingerprint": fingerprint(config),
        "gains": gains_of(),
        "config": dataclasses.asdict(config),
    }


def measure(worlds: Worlds, config: Config, path: Path | None) -> dict[str, Any]:
    """Flies all worlds with a progress bar; returns the report, which `path` also holds, and a later call resumes.

    Args:
        config: with the filter on, a nominal plant and no error bounds.

    Raises:
        InputError: the configuration has another plant or error bounds, or cannot be flown.
    """
    if config.plant != PlantParameters() or not config.uncertainty.is_zero:
        raise InputError("break-points brings its own worlds; leave out [plant] and [uncertainty]")
    check_is_checked(config)
    # raises InputError, before the bar appears, for settings that no world could be flown with
    Experiment(replace(config, train=replace(config.train, compile="off")), worlds.episodes)
    report = report_in(path, worlds, config, table, empty_report)
    flown = {(world["effect"], world["size"], world["told"]): world for world in report["worlds"]}
    every = [(name, size, told) for name in EFFECTS for size in EFFECTS[name].sizes for told in (False, True)]
    todo = [world for world in every if world not in flown]
    with bar(len(every), "worlds", initial=len(every) - len(todo)) as shown:
        for name, size, told in todo:
            came = fly_world(worlds, config, EFFECTS[name], size, told)
            flown[name, size, told] = {"effect": name, "size": size, "told": told} | came
            report["worlds"] = [flown[world] for world in every if world in flown]
            if path is not None:
                write_json(path, report)
            shown.update()
    return report


def fly_world(worlds: Worlds, config: Config, effect: Effect, size: float, told: bool) -> dict[str, Any]:
    """Flies one world; returns its violations and unsolved calls, or why it was refused."""
    drawn = worlds.episodes * 9 // 8  # size of the batch, of which the first `episodes` starts are flown
    candidates, horizon = looking_ahead(worlds.policy, None, None)
    campaign = Campaign(
        *(worlds.policy, worlds.period, worlds.duration, worlds.seed, drawn),
        candidates=candidates,
        horizon=horizon,
    )
    violating, unsolved = Counter(dict.fromkeys((*CONSTRAINTS, "any"), 0)), 0
    for errors in ERRORS:
        tables = {"plant": effect.plant(size) | {"errors": errors}}
        if told:
            tables["uncertainty"] = effect.told(size, worlds.period)
        try:
            tried = worlds.episodes * (campaign.candidates or 1)
            experiment = Experiment(override(config, tables, "break-points"), tried, worlds.duration)
            *_, report = run(campaign, worlds.episodes, experiment, None, None)
        except InputError as refused:
            if not told:
                raise
            return {"refused": str(refused)}
        violating.update(report["violating_episodes"])
        unsolved += report["filter_calls"]["unsolved"]
    return {"violating_episodes": dict(violating), "unsolved": unsolved}


class Outcome(NamedTuple):
    """Holds the results of an effect, told or not; a size is None if there is none.

    Attributes:
        held: the largest size below all sizes that violated a limit or were refused.
        broken: by column of COLUMNS, the smallest size that violated one of its limits.
        refused: the smallest size that was refused.
    """

    held: float | None
    broken: dict[str, float]
    refused: float | None


def outcome(report: dict[str, Any], effect: str, told: bool) -> Outcome:
    """Returns the results of an effect from a report."""
    worlds = [world for world in report["worlds"] if world["effect"] == effect and world["told"] == told]
    held, broken, refused = None, dict[str, float](), list[float]()
    holds = True
    for world in sorted(worlds, key=lambda world: world["size"]):
        size, counts = world["size"], world.get("violating_episodes", {})
        if "refused" in world:
            refused.append(size)
        for column, limits in COLUMNS.items():
            if any(counts.get(name) for name in limits):
                broken.setdefault(column, size)
        holds = holds and not (refused or broken)
        held = size if holds else held
    return Outcome(held, broken, refused[0] if refused else None)


def said(report: dict[str, Any], effect: str, told: bool) -> str:
    """Returns as text an effect's largest size that held, the first violated limits, and the first refused size."""
    found = outcome(report, effect, told)
    text = "holds none" if found.held is None else f"holds {found.held:g}"
    if found.broken:
        least = min(found.broken.values())
        first = [column.replace("\n", " ") for column in COLUMNS if found.broken.get(column) == least]
        text += f", breaks at {least:g} ({', '.join(first)})"
    return text + (f", refuses {found.refused:g}" if found.refused else "")


def table(report: dict[str, Any]) -> str:
    """Returns a report as text."""
    lines = []
    for effect in dict.fromkeys(world["effect"] for world in report["worlds"]):
        lines.append(f"{effect} ({EFFECTS[effect].unit or 'share'})")
        lines += [f"    told of nothing: {said(report, effect, False)}"]
        lines += [f"    told of it:      {said(report, effect, True)}"]
    return "\n".join(fill(line, WIDTH, subsequent_indent=" " * 8) for line in lines)


def figure(report: dict[str, Any]) -> Figure:
    """Draws two panels, without and with `[uncertainty]`: effects by limits, in each cell the size that violated it.

    Green cells were flown at every size without a violation; hatched ones were refused from some size on.
    """
    fig = Figure(figsize=(11.0, 9.5), layout="constrained")
    effects = list(dict.fromkeys(world["effect"] for world in report["worlds"]))
    for i, (ax, told) in enumerate(zip(fig.subplots(2, 1), (False, True), strict=True)):
        for row, effect in enumerate(effects):
            found, sizes = outcome(report, effect, told), EFFECTS[effect].sizes
            for column, name in enumerate(COLUMNS):
                broken = name in found.broken
                colour = UNSAFE if broken else "white" if found.refused else SAFE
                ax.add_patch(Rectangle((column, row), 1, 1, facecolor=colour, ec="white"))
                if colour == "white":
                    ax.add_patch(Rectangle((column, row), 1, 1, **HATCHED))
                text = f"{found.broken[name]:g}" if broken else ""
                ax.text(column + 0.5, row + 0.5, text, ha="center", va="center")
            tried = f"refused from {found.refused:g}" if found.refused else f"to {sizes[-1]:g}"
            ax.text(len(COLUMNS) + 0.1, row + 0.5, tried, va="center", color=GREY)
        units = [f"{effect} ({EFFECTS[effect].unit or 'share'})" for effect in effects]
        ax.set_yticks([row + 0.5 for row in range(len(effects))], units)
        ax.set_xticks([column + 0.5 for column in range(len(COLUMNS))], COLUMNS)
        ax.set(xlim=(0, len(COLUMNS)), ylim=(len(effects), 0))
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        bound = "with" if told else "without"
        key = {UNSAFE: "a limit broke, from this size on", SAFE: "kept at every size"}
        patches = [Rectangle((0, 0), 1, 1, facecolor=colour, label=text) for colour, text in key.items()]
        if told:
            text = "no limit broke, but refused from a size on"
            patches.append(Rectangle((0, 0), 1, 1, **HATCHED, label=text))
        ax.legend(handles=patches, loc="upper left", bbox_to_anchor=(0, -0.08), ncols=3, frameon=False)
        ax.set_title(
            f"{'ab'[i]}) {bound} its bound in [uncertainty]: smallest size that broke a limit", loc="left"
        )
    return fig
