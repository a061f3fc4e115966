"""The page of `play`: one file, which flies the deputy in a browser and needs no network.

Its text is in `play.html.j2`, its code in `flight.js` (the flight), `scene.js` (the picture) and `play.js` (keys,
buttons, limits).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tomli_w
import torch
from markupsafe import Markup
from torch import Tensor

from inspection.chief.points import fibonacci_sphere
from inspection.closed_loop import is_multiple
from inspection.model.attitude import norm, unit
from inspection.model.draws import key_of
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THETA_S, E, P, Q, T, V
from inspection.world.parameters import PlantParameters, bounds
from inspection.world.plant import sample_plant
from inspection.world.uncertainty import NO_UNCERTAINTY
from ppo.network import Policy
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from settings import InputError
from study.config import TEST_CASES, Config
from study.errors import as_input_error
from study.experiment import filter_of, plant_numbers, test_cases
from study.export import policy as agent
from study.files import write_text
from study.machine import announced
from study.web import module
from study.web.template import drawn, embedded, packed, render

HORIZON = 500  # s, of the predicted path
CASES = 40  # number of the first cases of `evaluate` and `simulate`
SEEDS = range(8)  # seeds of `simulate`; their plants are flown in turns
SETTINGS = ("inspection", "rta", "plant", "uncertainty")  # tables that a saved flight depends on
MADE = {  # starts: direction of the deputy at rest, and the Sun's angle from it in the orbital plane, rad
    "ram": ((0.5, -0.75, 0.45), 0.6),
    "leaving": ((0.6, 0.75, 0.3), 0.6),
    "battery": ((-0.8, 0.5, 0.2), 1.9),
}


def check(config: Config) -> None:
    """Raises InputError if the page cannot fly a configuration, or the compiler is missing."""
    c, plant, uncertainty = config.inspection, config.plant, config.uncertainty
    own_chief = not config.chief.is_the_papers or "chief" in c.observed
    in_seconds = is_multiple(1.0, c.substep) and c.action_period % 1.0 == 0.0
    refused = {
        "[rta] filter: play flies the checked one only": config.rta.filter != "checked",
        "[chief]: play flies around the paper's chief only": own_chief,
        "play flies in seconds: substep must divide 1 s, action_period must be whole seconds": not in_seconds,
        "[plant]: play flies its own simulator only": plant.simulator != "own",
        "[plant]: play flies without failures": plant.failing != "none",
        "play flies errors with a filter that is told of them: give [plant] and [uncertainty], or neither": (
            plant.is_nominal != uncertainty.is_zero
        ),
        "[plant] latency is above [uncertainty] latency": bounds(plant.latency)[1] > uncertainty.latency,
        "play needs the package ziglang (a compiler): python -m pip install ziglang": find_spec("ziglang")
        is None,
    }
    for reason, holds in refused.items():
        if holds:
            raise InputError(reason)


def write(config: Config, out: Path, policy: Policy | None = None) -> int:
    """Writes the page of a configuration, with an agent if there is one; returns its size in bytes.

    Raises:
        InputError: see `check` and `world`; or the page cannot be written.
    """
    check(config)
    config = replace(config, train=replace(config.train, rta=True))
    c, errs = config.inspection, not config.plant.is_nominal
    nominal = replace(config, plant=PlantParameters(), uncertainty=NO_UNCERTAINTY)
    erring = replace(config, plant=replace(config.plant, errors="worst"))
    with announced("printing and compiling the filters, two minutes"):
        filters = [filter_of(replace(nominal, rta=replace(config.rta, period=period))) for period in PERIODS]
        robust = [filter_of(erring)] if errs else []
        worlds = [world(nominal, filters), *(world(erring, robust) for _ in robust)]
        own = agent.sources(policy, config, "") if policy else {}
        compiled = module.compiled([*filters, *robust], erring.plant if errs else None, own)
    text = document(packed(compiled), embedded(task(c) | {"worlds": worlds}), policy is not None, errs)
    with as_input_error(f"--out {out}: cannot write it", OSError):
        write_text(out, text)
    return len(text.encode())


def document(module: str, data: Markup, has_agent: bool, has_errors: bool) -> str:
    """Returns the whole page with a packed module and embedded data."""
    return render(
        "web/play.html.j2",
        periods=PERIODS,
        has_agent=has_agent,
        has_errors=has_errors,
        module=module,
        data=data,
    )


def world(config: Config, filters: Sequence[SafetyFilter]) -> dict[str, Any]:
    """Returns the page's data of a world: starts that all of its filters accept, its settings, and plants.

    Starts have a name, a state [16] and a priority [3]; the cases of `simulate` are named by their number. Plants are
    in the order of the seeds of `simulate`: body [7], thrust [9] and torque [3] as in `PlantSample`, latency in calls.

    Raises:
        InputError: the filters accept no case, or no start of a name in MADE.
    """
    c = config.inspection
    x, priority, _ = test_cases(config, CASES, TEST_CASES)
    safe = torch.stack([each.is_safe(x) for each in filters]).all(0)
    found = {f"case {i}": x[:, i] for i in range(CASES) if safe[i]}
    for name, (direction, sunlit) in MADE.items():
        for state in candidates(name, at_rest(c, direction, sunlit), c):  # the hardest first
            if all(bool(each.is_safe(state)) for each in filters):
                found[name] = state[:, 0]
                break
    if missing := {"case", *MADE} - {name.split()[0] for name in found}:
        raise InputError(f"[uncertainty], [rta]: the filter accepts no start of the kind {min(missing)!r}")
    drawn = [sample_plant(config.plant, c, key_of(plant_numbers(1, seed))) for seed in SEEDS]
    return {
        "period": config.rta.period,
        "settings": settings(config),
        "starts": [
            {"name": name, "state": state.tolist(), "priority": priority[:, i % CASES].tolist()}
            for i, (name, state) in enumerate(found.items())
        ],
        "plants": [
            torch.cat([part.flatten() for part in (d.body, d.thrust, d.torque, d.latency)]).tolist()
            for d in drawn
        ],
    }


def at_rest(c: InspectionParameters, direction: Sequence[float], sunlit: float) -> Tensor:
    """Returns a state (16, 1) at rest 1 m from the chief in a direction, with the camera on the chief."""
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    x[P] = unit(x.new_tensor(direction)[:, None])
    a, b, d = (-x[P, 0]).tolist()
    x[Q, 0] = unit(x.new_tensor([0.0, -d, b, 1.0 + a]))  # the shortest turn of +x to the chief, scalar last
    x[T], x[E] = sum(c.initial_temperature) / 2, c.initial_energy[1]
    x[THETA_S] = torch.atan2(x[1], x[0]) + sunlit
    return x


def candidates(name: str, rest: Tensor, c: InspectionParameters) -> Iterator[Tensor]:
    """Yields states (16, 1) of a start, the hardest first, from a state at rest.

    "ram": free flight at 1 m/s hits the chief's centre; sooner hits are harder. "leaving": next to the end of the zone,
    moving out. "battery": in the dark, with little energy.
    """
    one, none = torch.eye(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    for k in range(1, 100):
        x = rest.clone()
        if name == "ram":
            t = one.new_tensor(520.0 + 20.0 * k)  # s until the hit; the filter keeps 500 s clear
            by_speed = free_flight(none, one, t, c.mean_motion)  # m per m/s: free flight is linear
            x[V] = -torch.linalg.solve(by_speed, free_flight(x[P], none[:, :1], t, c.mean_motion))
            x[P], x[V] = x[P] / norm(x[V]), unit(x[V])
        elif name == "leaving":
            x[P], x[V] = 0.975 * c.max_distance * rest[P], (1.21 - 0.01 * k) * rest[P]
        else:
            x[P] = 6.0 * c.collision_radius * rest[P]
            x[E] = c.min_energy + 0.01 * k * (c.initial_energy[1] - c.min_energy)
        yield x


def settings(config: Config) -> str:
    """Returns as TOML the settings that a saved flight depends on and that differ from the defaults."""
    usual = Config()
    tables = {
        table: {
            key: value
            for key, value in vars(getattr(config, table)).items()
            if value != getattr(getattr(usual, table), key)
        }
        for table in SETTINGS
    }
    return tomli_w.dumps(tables)


def task(c: InspectionParameters) -> dict[str, Any]:
    """Returns the page's data of the task."""
    names = ("mass", "action_period", "success_score", "max_time")
    return {
        **{name: getattr(c, name) for name in names},
        "periods": list(PERIODS),
        "limit": list(c.control_limit),
        "steps": round(1.0 / c.substep),
        "arrays": module.arrays(c),
        "points": (c.chief_radius * fibonacci_sphere(c.num_points).T).tolist(),
        "places": module.PLACES,
        "ahead_steps": round(HORIZON / module.PLACES / c.substep),
        **drawn(c),
        "limits": limits(c),
    }


def limits(c: InspectionParameters) -> list[dict[str, Any]]:
    """Returns the limits: name, a simple title, a phrase for a violation, h from which the bar is empty, and unit."""
    directions = ("away from the Earth", "along the orbit", "across the orbit")
    turns = (("Roll", "Rolls"), ("Pitch", "Pitches"), ("Yaw", "Yaws"))
    rows: list[tuple[str, str, str, float, str]] = [
        ("collision", "Can stop before the chief", "Too fast to stop before the chief", 3.0, "m/s"),
        ("dynamic_speed", "Speed near the chief", "Too fast so near the chief", 1.0, "m/s"),
        ("keep_in_zone", "Can stop inside the zone", "Too fast to stop inside the zone", 8.0, "m/s"),
        ("passive_safety", "Free flight misses the chief", "Would hit it with dead thrusters", 100.0, "m"),
        *(
            (f"velocity_{axis}", f"Speed {where}", f"Too fast {where}", c.max_speed**2, "%")
            for axis, where in zip("xyz", directions, strict=True)
        ),
        ("attitude_exclusion", "Camera off the Sun", "Blind: the Sun shines into the camera", 1.5, "°"),
        ("temperature", "Temperature", "Too hot", 8.0, "°C"),
        ("battery", "Battery", "Below its limit", c.initial_energy[1] - c.min_energy, "kJ"),
        *(
            (f"angular_velocity_{axis}", f"{rate} rate", f"{turns} too fast", c.max_rate**2, "%")
            for axis, (rate, turns) in zip("xyz", turns, strict=True)
        ),
    ]
    return [dict(zip(("name", "title", "broken", "scale", "unit"), row, strict=True)) for row in rows]
