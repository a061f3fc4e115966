"""Where it breaks: one effect of the plant at a time, of rising size, behind a filter that is told of it or not.

Each world is flown like a campaign of `study.verification.campaign`, once with its errors held at a corner of their
bounds and once with the worst. The break point of a limit is the smallest size tried at which an episode violated it in
either; a size holds where none did and the filter checks motion and attitude. Where it does not check both, what was
flown says nothing of other flights: that size is unchecked.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

from inspection.world.parameters import PlantParameters
from rta.constraints.names import CONSTRAINTS
from settings import InputError, override
from study.config import Config
from study.drawing import Figure, Rectangle
from study.experiment import Experiment
from study.files import write_json
from study.flight.figures import GREY, SAFE, UNSAFE
from study.machine import bar
from study.verification.campaign import looking_ahead, run
from study.verification.findings import WIDTH, Campaign, report_in
from study.verified import fingerprint

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
MISSED = 0.8  # probability of a missed call, up to so many in a row as the size says: nine are met, too
ERRORS = ("steady", "worst")  # in which each world is flown


class Effect(NamedTuple):
    """One effect, by size in its unit: `[plant]` of the world, `[uncertainty]` that says so, and the sizes tried."""

    unit: str
    plant: Callable[[float], dict[str, Any]]
    told: Callable[[float, float], dict[str, Any]]  # of the size and the filter's period in s
    sizes: tuple[float, ...]


def share(name: str, told: str, sizes: tuple[float, ...]) -> Effect:
    """A factor of 1 -+ size."""
    return Effect("", lambda s: {name: [1.0 - s, 1.0 + s]}, lambda s, _: {told: s}, sizes)


def noise(kind: str, unit: str, sizes: tuple[float, ...]) -> Effect:
    """Errors of a sensor's axis up to the size."""
    return Effect(
        unit, lambda s: {f"{kind}_noise": s / PlantParameters.noise_bound}, lambda s, _: {kind: s}, sizes
    )


EFFECTS = {
    "mass": share("mass_factor", "mass", (0.03, 0.1, 0.3, 0.5)),
    # beyond a third no such body is possible
    "inertia": share("inertia_factor", "inertia", (0.03, 0.1, 0.2, 0.3)),
    "thrust gain": share("thrust_gain", "thrust_gain", (0.03, 0.1, 0.3, 0.5)),
    "torque gain": share("torque_gain", "torque_gain", (0.1, 0.3, 0.6, 0.9)),
    "misalignment": Effect(
        "deg",
        lambda s: {"thrust_misalignment": s},
        lambda s, _: {"thrust_misalignment": s},
        (1.0, 3.0, 10.0, 30.0),
    ),
    "acceleration": Effect(
        "m/s²", lambda s: {"acceleration": s}, lambda s, _: {"acceleration": s}, (1e-5, 1e-3, 1e-2, 3e-2)
    ),
    "position error": noise("position", "m", (0.1, 0.6, 3.0, 20.0)),
    "velocity error": noise("velocity", "m/s", (0.001, 0.006, 0.03, 0.1)),
    "attitude error": noise("attitude", "deg", (0.3, 1.0, 3.0, 10.0)),
    "rate error": noise("rate", "deg/s", (0.03, 0.1, 0.3, 1.0)),
    "latency": Effect(
        "calls", lambda s: {"latency": int(s)}, lambda s, _: {"latency": int(s)}, (1.0, 2.0, 5.0, 10.0)
    ),
    "missed in a row": Effect(
        "calls",
        lambda s: {"missed_calls": MISSED, "missed_in_a_row": int(s)},
        lambda s, period: {"longest_hold": (s + 1.0) * period},
        (1.0, 2.0, 4.0, 9.0),
    ),
    "least impulse": Effect(
        "N", lambda s: {"minimum_thrust": s}, lambda s, _: {"minimum_thrust": s}, (0.02, 0.1, 0.3, 0.6)
    ),
    "quantum": Effect(
        "N", lambda s: {"thrust_quantum": s}, lambda s, _: {"thrust_quantum": s}, (0.05, 0.2, 0.5, 1.0)
    ),
}


@dataclasses.dataclass(frozen=True)
class Worlds:
    """What determines the numbers beside the configuration, see `Campaign`.

    In reports without `errors` these were drawn.
    """

    policy: str
    period: float
    duration: float
    seed: int
    episodes: int
    missed: float = MISSED
    errors: str = "drawn"


def empty_report(worlds: Any, config: Config) -> dict[str, Any]:
    """A report of no worlds, the form of `break-points --json`.

    `worlds` has of each its effect, size, whether the filter was told, and either `violating_episodes` by limit, of all
    ERRORS, how many filter calls were unsolved, and what the filter left `unchecked`, or `refused`, why there was
    nothing to fly.
    """
    return {
        "campaign": dataclasses.asdict(worlds),
        "worlds": [],
        "fingerprint": fingerprint(config),
        "config": dataclasses.asdict(config),
    }


def measure(worlds: Worlds, config: Config, path: Path | None) -> dict[str, Any]:
    """All worlds with a progress bar; returns the report, which `path` holds too and is resumed from.

    Args:
        config: with the filter on, nominal plant and nil bounds.
    """
    if config.plant != PlantParameters() or not config.uncertainty.is_nil:
        raise InputError("break-points brings its own worlds; leave out [plant] and [uncertainty]")
    # refuses before there is a bar what would refuse every world
    Experiment(replace(config, train=replace(config.train, compile="off")), worlds.episodes)
    report = report_in(path, worlds, config, empty_report)
    every = [
        (name, size, told) for name, own in EFFECTS.items() for size in own.sizes for told in (False, True)
    ]
    report["worlds"] = [world for world in report["worlds"] if of(world) in every]
    known = {of(world) for world in report["worlds"]}
    todo = [world for world in every if world not in known]
    with bar(len(every), "worlds", initial=len(every) - len(todo)) as shown:
        for name, size, told in todo:
            flown = fly_world(worlds, config, EFFECTS[name], size, told)
            report["worlds"].append({"effect": name, "size": size, "told": told} | flown)
            report["worlds"].sort(key=lambda world: every.index(of(world)))
            if path is not None:
                write_json(path, report)
            shown.update()
    return report


def of(world: dict[str, Any]) -> tuple[str, float, bool]:
    """What a world of a report is."""
    return world["effect"], world["size"], world["told"]


def fly_world(worlds: Worlds, config: Config, effect: Effect, size: float, told: bool) -> dict[str, Any]:
    """What came of one world."""
    drawn = worlds.episodes * 9 // 8  # a few starts are beyond braking and do not count
    candidates, horizon = looking_ahead(worlds.policy, None, None)
    campaign = Campaign(
        worlds.policy,
        worlds.period,
        worlds.duration,
        worlds.seed,
        drawn,
        candidates=candidates,
        horizon=horizon,
    )
    violating, unsolved, unchecked = Counter(dict.fromkeys((*CONSTRAINTS, "any"), 0)), 0, list[str]()
    for errors in ERRORS:
        own = {"plant": effect.plant(size) | {"errors": errors}}
        if told:
            own["uncertainty"] = effect.told(size, worlds.period)
        try:
            tried = worlds.episodes * (campaign.candidates or 1)
            experiment = Experiment(override(config, own, "break-points"), tried, worlds.duration)
            *_, report = run(campaign, worlds.episodes, experiment, None, None)
        except InputError as refused:
            if not told:
                raise
            return {"refused": str(refused)}
        violating.update(report["violating_episodes"])
        unsolved += report["filter_calls"]["unsolved"]
        unchecked = experiment.filter.unchecked
    return {"violating_episodes": dict(violating), "unsolved": unsolved, "unchecked": unchecked}


def break_points(report: dict[str, Any], told: bool) -> dict[str, dict[str, float | None]]:
    """By effect and column of COLUMNS: the smallest size at which a limit was violated, None where none ever was."""
    found: dict[str, dict[str, float | None]] = {}
    for world in sorted(report["worlds"], key=lambda world: -world["size"]):
        if world["told"] == told:
            columns = found.setdefault(world["effect"], dict.fromkeys(COLUMNS))
            counts = world.get("violating_episodes")
            for column, limits in COLUMNS.items():
                if counts and any(counts[name] for name in limits):
                    columns[column] = world["size"]
    return found


def last_held(report: dict[str, Any], effect: str, told: bool) -> tuple[float | None, float | None]:
    """The largest size below what broke, was refused or is unchecked, None if there is none; the smallest refused."""
    held = None
    worlds = [world for world in report["worlds"] if world["effect"] == effect and world["told"] == told]
    for world in sorted(worlds, key=lambda world: world["size"]):
        if "refused" in world or world["violating_episodes"]["any"] or (told and world.get("unchecked")):
            break
        held = world["size"]
    return held, min((world["size"] for world in worlds if "refused" in world), default=None)


def unchecked_from(report: dict[str, Any], effect: str) -> tuple[float, list[str]] | None:
    """The smallest size whose bound leaves motion or attitude unchecked, and which; None: there is none."""
    found = [
        (world["size"], world["unchecked"])
        for world in report["worlds"]
        if world["effect"] == effect and world["told"] and world.get("unchecked")
    ]
    return min(found, default=None)


def said(report: dict[str, Any], effect: str, told: bool) -> str:
    """Of an effect: the last size that held, from which on it is unchecked, what broke first, the smallest refused."""
    held, refused = last_held(report, effect, told)
    broken = {name: size for name, size in break_points(report, told)[effect].items() if size is not None}
    text = "holds none" if held is None else f"holds {held:g}"
    if told and (found := unchecked_from(report, effect)):
        text += f", unchecked from {found[0]:g} ({' and '.join(found[1])})"
    if broken:
        least = min(broken.values())
        first = [name.replace("\n", " ") for name, size in broken.items() if size == least]
        text += f", breaks at {least:g} ({', '.join(first)})"
    return text + (f", refuses {refused:g}" if refused else "")


def table(report: dict[str, Any]) -> str:
    """A report as text."""
    lines = []
    for effect in dict.fromkeys(world["effect"] for world in report["worlds"]):
        lines.append(f"{effect} ({EFFECTS[effect].unit or 'share'})")
        lines += [f"    told of nothing: {said(report, effect, False)}"]
        lines += [f"    told of it:      {said(report, effect, True)}"]
    return "\n".join(fill(line, WIDTH, subsequent_indent=" " * 8) for line in lines)


def figure(report: dict[str, Any]) -> Figure:
    """Two panels, without and with `[uncertainty]`: effects by limits, in each cell the size that broke it."""
    fig = Figure(figsize=(9.0, 9.5), layout="constrained")
    effects = list(dict.fromkeys(world["effect"] for world in report["worlds"]))
    for i, (ax, told) in enumerate(zip(fig.subplots(2, 1), (False, True), strict=True)):
        found = break_points(report, told)
        for row, effect in enumerate(effects):
            _, refused = last_held(report, effect, told)
            open_from = unchecked_from(report, effect) if told else None
            # from the smallest size on no flight says that it is safe
            nothing_from = min(refused or math.inf, open_from[0] if open_from else math.inf)
            flown = nothing_from > EFFECTS[effect].sizes[0]
            for column, name in enumerate(COLUMNS):
                size = found[effect][name]
                colour = UNSAFE if size is not None else SAFE if flown else "white"
                ax.add_patch(Rectangle((column, row), 1, 1, facecolor=colour, ec="white"))
                ax.text(
                    column + 0.5, row + 0.5, "" if size is None else f"{size:g}", ha="center", va="center"
                )
            largest = EFFECTS[effect].sizes[-1]
            tried = f"to {largest:g}" if refused is None else f"refused from {refused:g}"
            if open_from:
                tried += f", unchecked from {open_from[0]:g}"
            ax.text(len(COLUMNS) + 0.1, row + 0.5, tried, va="center", color=GREY)
        units = [f"{effect} ({EFFECTS[effect].unit or 'share'})" for effect in effects]
        ax.set_yticks([row + 0.5 for row in range(len(effects))], units)
        ax.set_xticks([column + 0.5 for column in range(len(COLUMNS))], COLUMNS)
        ax.set(xlim=(0, len(COLUMNS)), ylim=(len(effects), 0))
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        told_of = "told of the effect, as [uncertainty]" if told else "told of nothing"
        ax.set_title(f"{'ab'[i]}) the filter is {told_of}: smallest size that broke a limit", loc="left")
    return fig
