"""The project's own simulator beside Basilisk: what coasting and agents do in both (docs/results/basilisk.md).

    python -m study.results.basilisk --study runs/reference/study --out runs/reference/basilisk

Coasts 100 spacecraft from all over the safe set, and flies all agents of two arms through the same cases in both, each
beside itself. Needs Basilisk (docs/guides/basilisk.md); takes half an hour.
"""

import math
import os
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, P, Q
from inspection.transition import METRICS
from inspection.world.basilisk import BasiliskPlant
from inspection.world.parameters import PlantParameters
from rta.filter import SafetyFilter
from settings import positive_integer
from study.config import TEST_CASES
from study.experiment import Experiment
from study.files import write_json, writing
from study.flight.evaluation import SUCCESS, Episodes, play
from study.flight.figures import BLUE, GREEN, ORANGE
from study.report.agents import Arm, agents_of
from study.results.arguments import of_a_study
from study.verification.starts import safe_set

SPACECRAFT, SECONDS, EVERY = 100, 1000, 20  # that coast, for so many s, compared every so many s
FREE = PlantParameters(simulator="basilisk", saturate_rates=False)
# what our model has, by what the figure calls it
MODELS: dict[str, dict[str, Any]] = {
    "as the paper": {},
    "and Hill's frame turns": {"hill_rotation": True},
    "and gravity is exact": {"hill_rotation": True, "orbit": "two-body"},
}
# by which Basilisk differs from itself
PERTURBED = {"J2": replace(FREE, j2=True), "drag": replace(FREE, drag=True)}
ARMS = ("no_rta", "rta")
SHOWN = {"episode_length_s": "episode length (s)", "delta_v_m_s": "delta v (m/s)"}
WORLDS = {
    "basilisk": PlantParameters(simulator="basilisk"),
    "basilisk, J2 and drag": PlantParameters(simulator="basilisk", j2=True, drag=True),
    "basilisk, wheels and pulses": PlantParameters(simulator="basilisk", actuators="real"),
}


def coasting() -> dict[str, Any]:
    """By model, the largest and the median difference from Basilisk over time, in m, deg and rad/s."""
    c = InspectionParameters(saturate_rates=False)
    x, _, _ = safe_set(SPACECRAFT, 0, SafetyFilter(c))
    u, times = torch.zeros(6, SPACECRAFT, dtype=torch.float64), range(EVERY, SECONDS + 1, EVERY)
    plant = BasiliskPlant(FREE, c, SPACECRAFT, "cpu")
    plant.begin(torch.arange(SPACECRAFT), x, torch.full((SPACECRAFT,), 0.5, dtype=torch.float64))
    true, paths = [x], {}
    begun = time.perf_counter()
    for _ in times:
        true.append(plant.integrate(true[-1], u, plant.body, 1.0, EVERY))
    speed = SPACECRAFT * SECONDS / (time.perf_counter() - begun)
    for name, settings in MODELS.items():
        own, errors = x, []
        for there in true[1:]:
            own = integrate(own, u, 1.0, replace(c, **settings), EVERY)
            errors.append(differences(own, there))
        paths[name] = {kind: [row[kind] for row in errors] for kind in errors[0]}
    moved = {}
    for name, perturbed in PERTURBED.items():
        other = BasiliskPlant(perturbed, c, SPACECRAFT, "cpu")
        other.begin(torch.arange(SPACECRAFT), x, torch.full((SPACECRAFT,), 0.5, dtype=torch.float64))
        moved[name] = differences(other.integrate(x, u, other.body, 1.0, SECONDS), true[-1])
    return {
        "time_s": list(times),
        "spacecraft": SPACECRAFT,
        "times_real_time": speed,
        "models": paths,
        "perturbed": moved,
    }


def differences(own: Tensor, there: Tensor) -> dict[str, float]:
    """Of positions, attitudes and body rates."""
    away = (own[P] - there[P]).norm(dim=0)
    turned = Rotation.from_quat(own[Q].T.numpy()).inv() * Rotation.from_quat(there[Q].T.numpy())
    angle = np.degrees(turned.magnitude())
    return {
        "position_m": float(f"{away.max():.4g}"),
        "position_median_m": float(f"{away.median():.4g}"),
        "attitude_deg": float(f"{angle.max():.4g}"),
        "attitude_median_deg": float(f"{np.median(angle):.4g}"),
        "rate_rad_s": float(f"{(own[OMEGA] - there[OMEGA]).abs().max():.4g}"),
    }


def one_alone() -> float:
    """How many times faster than real time one deputy flies."""
    c = InspectionParameters(saturate_rates=False)
    x, _, _ = safe_set(1, 0, SafetyFilter(c))
    plant = BasiliskPlant(FREE, c, 1, "cpu")
    plant.begin(torch.arange(1), x, torch.full((1,), 0.5, dtype=torch.float64))
    u = torch.zeros(6, 1, dtype=torch.float64)
    x = plant.integrate(x, u, plant.body, 1.0)  # builds the simulation
    begun = time.perf_counter()
    plant.integrate(x, u, plant.body, 1.0, SECONDS)
    return SECONDS / (time.perf_counter() - begun)


def flown(arm: Arm, plant: PlantParameters, cases: int) -> Episodes:
    """All agents of an arm through the first common test cases."""
    config = replace(arm.config.with_solver("auto"), plant=plant)
    return play(arm.policy, Experiment(config, cases * arm.policy.seeds), cases, TEST_CASES)


def summary(own: Episodes, other: Episodes) -> dict[str, Any]:
    """What an arm did in a world, and how each episode differs from itself in our simulator."""
    metrics = dict(zip(METRICS, other.metrics.tolist(), strict=True))
    apart = dict(zip(METRICS, (other.metrics - own.metrics).tolist(), strict=True))
    return {
        "episodes": other.outcome.numel(),
        "success_percent": 100.0 * (other.outcome == SUCCESS).double().mean().item(),
        "other_outcomes": int((other.outcome != own.outcome).sum()),
        "clean_percent": 100.0 * other.clean.double().mean().item(),
        "violating_episodes": int((other.violation_seconds[-1] > 0).sum()),
        "unsolved": int(other.failures.sum()),
        "mean": {name: float(np.mean(values)) for name, values in metrics.items()},
        "difference": {
            name: {
                "mean": float(np.mean(values)),
                "median": float(np.median(values)),
                "p5": float(np.percentile(values, 5)),
                "p95": float(np.percentile(values, 95)),
                "standard_error": float(np.std(values, ddof=1) / math.sqrt(len(values))),
            }
            for name, values in apart.items()
        },
        "of_each": {name: [round(value, 4) for value in metrics[name]] for name in SHOWN},
    }


def closed_loop(study: Path, cases: int) -> dict[str, Any]:
    """By arm and world, `summary`."""
    found: dict[str, Any] = {}
    for name, arm in agents_of(study, "cpu").items():
        if name in ARMS:
            own = flown(arm, PlantParameters(), cases)
            found[name] = {"own": summary(own, own)}
            for world, plant in WORLDS.items():
                few = max(1, cases // 5) if plant.actuators == "real" else cases  # a twentieth as fast
                beside = own if few == cases else flown(arm, PlantParameters(), few)
                found[name][world] = summary(beside, flown(arm, plant, few))
    return found


def figure(results: dict[str, Any], path: Path) -> None:
    """Coasting: differences over time; agents: each episode in both simulators."""
    from study.drawing import Figure

    drawn = Figure(figsize=(11, 7), layout="constrained")
    axes = drawn.subplots(2, 2)
    coasted = results["coasting"]
    for axis, kind, unit in zip(axes[0], ("position", "attitude"), ("m", "deg"), strict=True):
        lines = zip(coasted["models"].items(), (ORANGE, BLUE, GREEN), (5.0, 3.0, 1.2), strict=True)
        for (name, errors), colour, width in lines:  # where one is another's, both are seen
            axis.semilogy(coasted["time_s"], errors[f"{kind}_{unit}"], color=colour, lw=width, label=name)
            axis.semilogy(coasted["time_s"], errors[f"{kind}_median_{unit}"], color=colour, lw=width, ls=":")
        axis.set(xlabel="time (s)", ylabel=f"difference of {kind} ({unit})", title=f"Coasting: {kind}")
        axis.grid(alpha=0.3)
    axes[0, 0].legend(title="our model, largest (median dotted)", fontsize=8)
    for axis, (metric, text) in zip(axes[1], SHOWN.items(), strict=True):
        for (arm, worlds), colour in zip(results["agents"].items(), (BLUE, ORANGE), strict=True):
            pair = [worlds[world]["of_each"][metric] for world in ("own", "basilisk")]
            axis.plot(*pair, ".", color=colour, ms=4, label={"no_rta": "no RTA", "rta": "RTA"}[arm])
        ends = axis.get_xlim()
        axis.plot(ends, ends, color="0.5", lw=0.8, zorder=0)
        axis.set(xlabel=f"{text}, own simulator", ylabel=f"{text}, Basilisk", title=f"Agents: {text}")
        axis.grid(alpha=0.3)
    axes[1, 0].legend()
    with writing(path) as file:
        drawn.savefig(file, dpi=85, format="png")


def main(argv: list[str] | None = None) -> None:
    parser = of_a_study("basilisk", "basilisk.json and basilisk.png")
    parser.add_argument("--cases", type=positive_integer, default=20, help="of each agent (default: 20)")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    results: dict[str, Any] = {
        "coasting": coasting() | {"one_alone_times_real_time": one_alone()},
        "plants": {world: asdict(plant) for world, plant in WORLDS.items()},
        "agents": closed_loop(arguments.study, arguments.cases),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "basilisk.json", results)
    figure(results, arguments.out / "basilisk.png")


if __name__ == "__main__":
    main()
