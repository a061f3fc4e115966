"""Compares the project's own simulator with Basilisk: coasting, and agents (docs/guides/basilisk.md).

    python -m experiments.basilisk --study runs/reference/from_nothing --out runs/reference/basilisk

Coasts 100 spacecraft from all over the safe set, and flies all agents of two arms through the same cases in both
simulators. Needs Basilisk (docs/guides/basilisk.md); takes half an hour.
"""

import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, P, Q
from inspection.transition import METRICS
from inspection.world.basilisk import BasiliskPlant
from inspection.world.parameters import PlantParameters
from rta.filter import SafetyFilter
from settings import Parser, positive_integer
from study.config import TEST_CASES
from study.experiment import Experiment
from study.files import write_json, writing
from study.flight.evaluation import Episodes, play
from study.flight.figures import BLUE, ORANGE
from study.flight.fly import SUCCESS
from study.machine import set_threads
from study.report.inputs import Arm, agents_of
from study.verification.starts import safe_set

SPACECRAFT, SECONDS, EVERY = 100, 1000, 20  # number that coast, s of flight, s between comparisons
C = InspectionParameters(saturate_rates=False)
FREE = PlantParameters(simulator="basilisk", saturate_rates=False)
# settings of our model by the label in the figure
MODELS: dict[str, dict[str, Any]] = {
    "as the paper": {},
    "and Hill's frame turns": {"hill_rotation": True},
}
# effects whose influence within Basilisk is measured
PERTURBED = {"J2": replace(FREE, j2=True), "drag": replace(FREE, drag=True)}
ARMS = {"no_rta": "no RTA", "rta": "RTA"}
SHOWN = {"episode_length_s": "episode length (s)", "delta_v_m_s": "delta v (m/s)"}
WORLDS = {
    "basilisk": PlantParameters(simulator="basilisk"),
    "basilisk, J2 and drag": PlantParameters(simulator="basilisk", j2=True, drag=True),
    "basilisk, wheels and pulses": PlantParameters(simulator="basilisk", actuators="real"),
}


def coasted(parameters: PlantParameters, x: Tensor, every: int = SECONDS) -> tuple[list[Tensor], float]:
    """Returns states (16, N) of free flight in Basilisk every `every` s, and its speed in multiples of real time."""
    count = x.shape[1]
    plant, u = BasiliskPlant(parameters, C, count, "cpu"), torch.zeros(6, count, dtype=torch.float64)
    plant.begin(torch.arange(count), x, torch.full((count,), 0.5, dtype=torch.float64))
    path, begun = [x], time.perf_counter()
    for _ in range(SECONDS // every):
        path.append(plant.integrate(path[-1], u, plant.body, 1.0, every))
    return path, count * SECONDS / (time.perf_counter() - begun)


def coasting() -> dict[str, Any]:
    """Returns the content of "coasting": by model the differences from Basilisk over time, effects, and speeds."""
    x, _, _ = safe_set(SPACECRAFT, 0, SafetyFilter(C))
    path, speed = coasted(FREE, x, EVERY)
    models = {}
    for name, settings in MODELS.items():
        ours, errors = x, []
        for there in path[1:]:
            ours = integrate(ours, torch.zeros_like(x[:6]), 1.0, replace(C, **settings), EVERY)
            errors.append(differences(ours, there))
        models[name] = {kind: [row[kind] for row in errors] for kind in errors[0]}
    return {
        "time_s": list(range(EVERY, SECONDS + 1, EVERY)),
        "spacecraft": SPACECRAFT,
        "times_real_time": speed,
        "models": models,
        "perturbed": {
            name: differences(coasted(perturbed, x)[0][-1], path[-1]) for name, perturbed in PERTURBED.items()
        },
        "one_alone_times_real_time": coasted(FREE, x[:, :1])[1],
    }


def differences(one: Tensor, other: Tensor) -> dict[str, float]:
    """Returns the largest, and some median, differences of positions, attitudes and body rates of states (16, N)."""
    away = (one[P] - other[P]).norm(dim=0)
    turned = Rotation.from_quat(one[Q].T.numpy()).inv() * Rotation.from_quat(other[Q].T.numpy())
    angle = np.degrees(turned.magnitude())
    return {
        "position_m": float(f"{away.max():.4g}"),
        "position_median_m": float(f"{away.median():.4g}"),
        "attitude_deg": float(f"{angle.max():.4g}"),
        "attitude_median_deg": float(f"{np.median(angle):.4g}"),
        "rate_rad_s": float(f"{(one[OMEGA] - other[OMEGA]).abs().max():.4g}"),
    }


def flown(arm: Arm, plant: PlantParameters, cases: int) -> Episodes:
    """Flies all agents of an arm through the first common test cases."""
    config = replace(arm.config, plant=plant)
    return play(arm.policy, Experiment(config, cases * arm.policy.seeds), cases, TEST_CASES)


def summary(ours: Episodes, other: Episodes) -> dict[str, Any]:
    """Returns the results of an arm in a plant, and how its episodes differ from the same ones in our simulator."""
    apart = other.metrics - ours.metrics
    error = apart.std(dim=1) / math.sqrt(apart.shape[1])
    return {
        "episodes": other.outcome.numel(),
        "success_percent": 100.0 * (other.outcome == SUCCESS).double().mean().item(),
        "other_outcomes": int((other.outcome != ours.outcome).sum()),
        "clean_percent": 100.0 * other.clean.double().mean().item(),
        "violating_episodes": int((other.violation_seconds[-1] > 0).sum()),
        "unsolved": int(other.failures.sum()),
        "mean": dict(zip(METRICS, other.metrics.mean(1).tolist(), strict=True)),
        "difference": {
            name: {"mean": apart[i].mean().item(), "standard_error": error[i].item()}
            for i, name in enumerate(METRICS)
        },
        "of_each": {
            name: [round(value, 4) for value in other.metrics[METRICS.index(name)].tolist()] for name in SHOWN
        },
    }


def closed_loop(study: Path, cases: int) -> dict[str, Any]:
    """Returns `summary` by arm and plant."""
    found: dict[str, Any] = {}
    arms = agents_of(study, "cpu")
    for name in ARMS:
        ours = flown(arms[name], PlantParameters(), cases)
        found[name] = {"own": summary(ours, ours)}
        for world, plant in WORLDS.items():
            few = max(1, cases // 5) if plant.actuators == "real" else cases  # 20 times slower
            beside = ours if few == cases else flown(arms[name], PlantParameters(), few)
            found[name][world] = summary(beside, flown(arms[name], plant, few))
    return found


def figure(results: dict[str, Any], path: Path) -> None:
    """Draws the differences over time of coasting, and each episode of agents in both simulators."""
    drawn = Figure(figsize=(11, 7), layout="constrained")
    axes = drawn.subplots(2, 2)
    coasting = results["coasting"]
    for axis, kind, unit in zip(axes[0], ("position", "attitude"), ("m", "deg"), strict=True):
        lines = zip(coasting["models"].items(), (ORANGE, BLUE), (5.0, 3.0), strict=True)
        for (name, errors), colour, width in lines:  # widths differ: lines may coincide
            axis.semilogy(coasting["time_s"], errors[f"{kind}_{unit}"], color=colour, lw=width, label=name)
            axis.semilogy(coasting["time_s"], errors[f"{kind}_median_{unit}"], color=colour, lw=width, ls=":")
        axis.set(xlabel="time (s)", ylabel=f"difference of {kind} ({unit})", title=f"Coasting: {kind}")
    axes[0, 0].legend(title="our model, largest (median dotted)", fontsize=8)
    for axis, (metric, text) in zip(axes[1], SHOWN.items(), strict=True):
        for (arm, worlds), colour in zip(results["agents"].items(), (BLUE, ORANGE), strict=True):
            pair = [worlds[world]["of_each"][metric] for world in ("own", "basilisk")]
            axis.plot(*pair, ".", color=colour, ms=4, label=ARMS[arm])
        ends = axis.get_xlim()
        axis.plot(ends, ends, color="0.5", lw=0.8, zorder=0)
        axis.set(xlabel=f"{text}, own simulator", ylabel=f"{text}, Basilisk", title=f"Agents: {text}")
    axes[1, 0].legend()
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    with writing(path) as file:
        drawn.savefig(file, dpi=85, format="png")


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m experiments.basilisk", description=__doc__.splitlines()[0])
    parser.add_argument("--study", type=Path, required=True, help="directory of a finished study")
    parser.add_argument(
        "--out", type=Path, required=True, help="directory for basilisk.json and basilisk.png"
    )
    parser.add_argument("--cases", type=positive_integer, default=20, help="of each agent (default: 20)")
    given = parser.parse_args(argv)
    set_threads(None)
    results = {
        "coasting": coasting(),
        "plants": {world: asdict(plant) for world, plant in WORLDS.items()},
        "agents": closed_loop(given.study, given.cases),
    }
    given.out.mkdir(parents=True, exist_ok=True)
    write_json(given.out / "basilisk.json", results)
    figure(results, given.out / "basilisk.png")


if __name__ == "__main__":
    main()
