"""The page of `play`: one file, which flies the deputy in a browser and asks no network for anything.

What it says stands in `page.html.j2`; what it does in `flight.js` (the flight), `picture.js` (how it looks, with what
`study.pages.scene` draws) and `panel.js` (keys, buttons, limits).
"""

import base64
import gzip
import json
import math
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tomli_w
from markupsafe import Markup

from inspection.chief.points import fibonacci_sphere
from inspection.model.parameters import InspectionParameters
from inspection.world.parameters import PlantParameters, bounds
from ppo.network import Policy
from rta.bounds.uncertainty import NOTHING
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from settings import InputError
from study.config import Config
from study.errors import refusing
from study.export import policy as agent
from study.files import write_text
from study.machine import step
from study.pages import scene
from study.pages.template import render
from study.play import printed, wasm, worst
from study.play.starts import starts

HORIZON = 500  # s, of the line ahead
# by table, what no saved flight depends on: what an agent is shown and rewarded for, and what the page chooses
IDLE: dict[str, Callable[[str], bool]] = {
    "inspection": lambda key: key == "observed" or key.endswith(("_reward", "_reward_until", "_width")),
    "rta": lambda key: key in ("period", "qp_solver"),
    "plant": lambda key: False,
    "uncertainty": lambda key: False,
}

WORDS = {  # by limit: its name for a newcomer, why it is there, what its violation is, and the unit that is shown
    "collision": ("Can stop before the chief", "braking in time", "Too fast to stop before the chief", "m/s"),
    "dynamic_speed": ("Speed near the chief", "the nearer, the slower", "Too fast so near the chief", "m/s"),
    "keep_in_zone": (
        "Can stop inside the zone",
        "beyond {c.max_distance:g} m it is lost",
        "Too fast to stop inside the zone",
        "m/s",
    ),
    "passive_safety": (
        "Free flight misses the chief",
        "if the thrusters die, {c.passive_safety_horizon:g} s of free flight must miss it",
        "Would hit the chief with dead thrusters",
        "m",
    ),
    "velocity_x": (
        "Speed, from the Earth",
        "at most {c.max_speed:g} m/s",
        "Too fast away from the Earth",
        "%",
    ),
    "velocity_y": ("Speed, along the orbit", "at most {c.max_speed:g} m/s", "Too fast along the orbit", "%"),
    "velocity_z": (
        "Speed, across the orbit",
        "at most {c.max_speed:g} m/s",
        "Too fast across the orbit",
        "%",
    ),
    "attitude_exclusion": (
        "Camera off the Sun",
        "sunlight blinds it",
        "Blind: the Sun shines into the camera",
        "\N{DEGREE SIGN}",
    ),
    "temperature": ("Temperature", "one side must stay cool", "Too hot", "\N{DEGREE SIGN}C"),
    "battery": ("Battery", "the panels must see the Sun in time", "The battery is below its limit", "kJ"),
    "angular_velocity_x": ("Roll rate", "at most {rate:g} deg/s", "Rolls too fast", "%"),
    "angular_velocity_y": ("Pitch rate", "at most {rate:g} deg/s", "Pitches too fast", "%"),
    "angular_velocity_z": ("Yaw rate", "at most {rate:g} deg/s", "Yaws too fast", "%"),
}


def check() -> None:
    """Raises InputError where the compiler is missing that the page is built with."""
    if find_spec("ziglang") is None:
        raise InputError("play needs the package ziglang (a compiler): pip install '.[play]'")


def check_config(config: Config) -> None:
    """Raises InputError where the page cannot fly a configuration."""
    c = config.inspection
    if not config.chief.is_the_papers or "chief" in c.observed:
        raise InputError("[chief]: play flies around the paper's chief only")
    steps = 1.0 / min(c.substep, 1.0)
    if abs(steps - round(steps)) > 1e-9 or c.action_period % 1.0:
        raise InputError(
            "play flies in seconds: substep must divide 1 s, action_period must be whole seconds"
        )
    if config.plant.simulator != "own":
        raise InputError(f'[plant] simulator = "{config.plant.simulator}": play flies its own simulator only')
    if config.plant.failing != "none":
        raise InputError(f'[plant] failing = "{config.plant.failing}": play flies no failures')
    if config.plant.is_nominal != config.uncertainty.is_nil:
        raise InputError(
            "play flies errors with a filter that is told of them: give [plant] and [uncertainty], or neither"
        )
    if bounds(config.plant.latency)[1] > config.uncertainty.latency:
        raise InputError(
            "play: [plant] latency is above [uncertainty] latency: the filter could never answer a state so old"
        )


def write(config: Config, out: Path, policy: Policy | None = None) -> int:
    """Writes the page of a configuration, with an agent if there is one; returns its size in bytes.

    Raises:
        InputError: a package is missing, the configuration does not fit, or the page cannot be written.
    """
    check_config(config)
    check()
    told: SafetyFilter | None = None
    of_worst: dict[str, Any] | None = None
    with step("printing the filters, a minute"):
        with refusing("[rta], [inspection], [plant] and [uncertainty]", ValueError, OverflowError):
            filters = printed.filters(config)
            if not config.plant.is_nominal:
                config = replace(config, plant=replace(config.plant, errors="worst"))
                told = worst.told(config)
        begun = starts(config, filters)
        sources = printed.texts(filters, told, policy is not None)
        if told:
            of_worst = worst.described(config, told)
            sources |= worst.texts(told, config.plant)
        if policy:
            sources |= agent.sources(policy, config, "")
    with step("compiling them to WebAssembly, a minute"):
        module = wasm.compiled(sources)
    text = document(config, module, begun, policy is not None, of_worst)
    with refusing(f"--out {out}: cannot write it", OSError):
        write_text(out, text)
    return len(text.encode())


def document(
    config: Config,
    module: bytes,
    begun: list[dict[str, Any]],
    has_agent: bool = False,
    of_worst: dict[str, Any] | None = None,
) -> str:
    """The whole page, with a world whose errors are worst where that is described."""
    nominal = replace(config, plant=PlantParameters(), uncertainty=NOTHING)
    own = {
        "starts": begun,
        "settings": settings(nominal),
        "worst": of_worst and of_worst | {"settings": settings(config)},
    }
    data = json.dumps(task(config.inspection) | own, separators=(",", ":"))
    return render(
        "play/page.html.j2",
        periods=PERIODS,
        has_agent=has_agent,
        has_errors=of_worst is not None,
        module=packed(module),
        data=Markup(data.replace("<", "\\u003c")),
        licence=Markup(scene.LICENCE.read_text(encoding="utf-8")),
        three=packed(scene.three().encode()),
    )


def packed(content: bytes) -> str:
    """What `unpacked` of `flight.js` unpacks."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def settings(config: Config) -> str:
    """What of a configuration a saved flight depends on, where it differs from the defaults: TOML, or nothing."""
    usual, tables = Config(), {}
    for table, is_idle in IDLE.items():
        own, defaults = vars(getattr(config, table)), vars(getattr(usual, table))
        tables[table] = {
            key: value for key, value in own.items() if value != defaults[key] and not is_idle(key)
        }
    return tomli_w.dumps({table: entries for table, entries in tables.items() if entries})


def task(c: InspectionParameters) -> dict[str, Any]:
    """What the page is told of the task."""
    return {
        "periods": list(PERIODS),
        "limit": list(c.control_limit),
        "mass": c.mass,
        "steps": round(1.0 / min(c.substep, 1.0)),
        "action_period": c.action_period,
        "success_score": c.success_score,
        "max_time": c.max_time,
        "normals": fibonacci_sphere(c.num_points).T.tolist(),
        "places": printed.AHEAD,
        "ahead_steps": round(HORIZON / printed.AHEAD / min(c.substep, 1.0)),
        **scene.task(c),
        "limits": [limit(name, scale, c) for name, scale in zip(CONSTRAINTS, scales(c), strict=True)],
    }


def limit(name: str, scale: float, c: InspectionParameters) -> dict[str, Any]:
    """What the page says of a limit."""
    title, why, broken, unit = WORDS[name]
    return {
        "name": name,
        "title": title,
        "why": why.format(c=c, rate=math.degrees(c.max_rate)),
        "broken": broken,
        "unit": unit,
        "scale": scale,
    }


def scales(c: InspectionParameters) -> tuple[float, ...]:
    """By limit the h from which its bar is empty: far from it."""
    return (
        *(3.0, 1.0, 8.0, 100.0),
        *(c.max_speed**2,) * 3,
        *(1.5, 8.0, c.initial_energy[1] - c.min_energy),
        *(c.max_rate**2,) * 3,
    )
