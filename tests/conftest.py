"""Fixtures shared by all tests: the paper's parameters, a seeded generator, random states, a made-up study."""

import itertools
import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from inspection import initial_state
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from inspection.transition import METRICS
from inspection.world.parameters import PlantParameters
from kernels import build
from rta.constraints.names import CONSTRAINTS
from settings import to_toml
from study import machine
from study.config import ARMS, BASELINES, Config, StudyConfig
from tests.optimised import QUICK

# Files that take more than half a minute of a core, the longest first: what begins last must not be long, or one of the
# workers of pytest-xdist ends minutes after the others. By itself it begins with the files of most tests.
LONGEST = (
    "rta/test_filter.py",
    "rta/printed/test_driver.py",
    "study/report/test_compute.py",
    "test_docs.py",
    "rta/printed/test_export.py",
    "rta/backup/test_homing.py",
    "rta/backup/test_turn.py",
    "study/verification/test_worlds.py",
    "study/training/test_study.py",
    "study/training/test_session.py",
    "kernels/test_numbers.py",
    "study/flight/test_planted.py",
    "rta/backup/test_check.py",
    "study/verification/test_counter_examples.py",
    "test_install.py",
    "rta/backup/test_haven.py",
    "study/web/test_flight.py",
    "study/web/test_play.py",
    "kernels/test_project.py",
    "test_command.py",
    "study/export/test_filter.py",
    "experiments/test_break_points.py",
    "inspection/test_leading_guidance.py",
    "rta/test_orbits.py",
    "study/verification/test_findings.py",
    "inspection/model/test_orbit.py",
    "inspection/test_guidance.py",
    "rta/constraints/test_vehicle.py",
    "ppo/test_distributed.py",
    "rta/backup/test_slew.py",
)

torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that tests start: nothing to measure, and to say
settings.register_profile("project", deadline=None, derandomize=True, max_examples=40, database=None)
settings.load_profile("project")


def pytest_configure(config: pytest.Config) -> None:
    """Has pytest-xdist take the files in the order of `pytest_collection_modifyitems`."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the files of LONGEST first, where there are several."""
    tests = Path(__file__).parent
    place = {tests / name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


@pytest.fixture(scope="session", autouse=True)
def kernels_cache(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache of what is recorded and built, in pytest's own, and libraries that are not optimised.

    Nothing is recorded or built twice, in no run: what is kept goes by the code, compiler and processor. `pytest
    --cache-clear` empties it. tests/kernels builds as users do; `test_optimisation_changes_no_bit_of_a_filter` there
    says that the compiler's optimisation does not matter.
    """
    kept = getattr(pytestconfig, "cache", None)  # None under -p no:cacheprovider
    directory = kept.mkdir("kernels") if kept else tmp_path_factory.mktemp("kernels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(build.VARIABLE, str(directory))
        patch.setattr(build, "FLAGS", QUICK)
        yield directory


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Keeps bars and what is said of long steps out of stderr, however busy the machine is."""
    monkeypatch.setattr(machine, "PATIENCE", 1e9)


@pytest.fixture(scope="module")
def small_pools() -> Iterator[None]:
    """Few initial states drawn at once: whether one is safe is a search for a control where rows are of a hold."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial_state, "POOL", 64)
        yield


@pytest.fixture(scope="module")
def loose_figures() -> Iterator[None]:
    """Figures whose parts are not fitted to each other, which takes half of their time; `test_page` fits them."""
    save = Figure.savefig

    def loose(self: Figure, *arguments: Any, **options: Any) -> None:
        self.set_layout_engine("none")
        save(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", loose)
        yield


@pytest.fixture(scope="session")
def c():
    """The paper's constants."""
    return InspectionParameters()


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def random_states(generator):
    """A function of the batch size B: states (16, B) such as occur in flight, float64."""

    def draw(batch):
        def uniform(low, high, *shape):
            return low + (high - low) * torch.rand(*shape, batch, generator=generator, dtype=torch.float64)

        def direction(size):
            vector = torch.randn(size, batch, generator=generator, dtype=torch.float64)
            return vector / vector.norm(dim=0)

        x = torch.empty(SIZE, batch, dtype=torch.float64)
        x[P] = uniform(16.0, 400.0) * direction(3)
        x[V] = uniform(0.05, 1.0) * direction(3)
        x[Q] = direction(4)
        x[OMEGA] = uniform(-0.03, 0.03, 3)
        x[T] = uniform(-20.0, 12.0)
        x[E] = uniform(0.5, 8.0)
        x[THETA_S] = uniform(0.0, 2 * math.pi)
        return x

    return draw


def made_up_evaluation(rng: np.random.Generator, period: float | None, episodes: int = 300) -> dict[str, Any]:
    """Random numbers in the form of `evaluate --json`, less what no report shows."""

    def metric() -> dict[str, Any]:
        low, middle, high = np.sort(rng.uniform(0.5, 30.0, 3)).tolist()
        return {"iqm": middle, "mean": middle, "ci95": [low, high], "p5": low, "p95": high, "max": high}

    return {
        "metrics": {name: metric() for name in METRICS},
        **{
            kind: {name: rng.uniform(0.001, 9.0) for name in ("any", *CONSTRAINTS)}
            for kind in ("violations_percent", "violations_percent_of_seconds")
        },
        "outcomes": {"success": rng.uniform(0.5, 1.0), "clean_success": rng.uniform(0.1, 0.5)},
        "config": {"plant": asdict(PlantParameters())},
        "rta": {"period_s": period, "intervention_percent": rng.uniform(1.0, 99.0), "qp_failures": 0},
        "episodes": episodes,
        "digest": "of no interest",
    }


def made_up_episode(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A tour around the chief in the form of `simulate`, every value within its limit."""
    t = np.arange(0.0, 300.0, 10.0)
    ones, turn = np.ones_like(t), 2.0 * np.pi * t / t[-1]
    control = rng.uniform(-5e-4, 5e-4, (len(t), 6))
    return {
        "time": t,
        "position": rng.uniform(50.0, 90.0) * np.stack((np.cos(turn), np.sin(turn), 0.1 * ones), 1),
        "velocity": 0.3 * np.stack((-np.sin(turn), np.cos(turn), 0.0 * ones), 1),
        "quaternion": np.stack((0.0 * t, 0.0 * t, np.sin(turn / 2), np.cos(turn / 2)), 1),
        "angular_velocity": rng.uniform(-0.02, 0.02, (len(t), 3)),
        "temperature": 5.0 * ones,
        "energy": 6.0 * ones,
        "sun_angle": 0.001 * t,
        "control_desired": control,
        "control_applied": control,
        "inspected_score": t / t[-1],
        "inspected": t[:, None] >= rng.uniform(0.0, 1.3 * t[-1], 100),
        "parameters": np.array(to_toml(Config())),
        "intervened": np.zeros((len(t), 2), dtype=bool),
        **{f"h_{name}": ones for name in CONSTRAINTS},
    }


@pytest.fixture(scope="session")
def made_up_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with every file that a report shows, full of random numbers."""
    study = tmp_path_factory.mktemp("made_up") / "study"
    report = study / "report"
    report.mkdir(parents=True)
    rng = np.random.default_rng(0)
    arms = {
        arm: made_up_evaluation(rng, 1.0 if rta else None)
        | {"seeds": [0, 1, 2], "interactions": 5_013_504, "wall_clock_s": 4321.0}
        | {"per_seed": [made_up_evaluation(rng, None) for _ in range(3)]}
        for arm, rta in ARMS.items()
    }
    contents = {
        "results.json": {"arms": arms},
        "provenance.json": {"device": "cpu", "ranks": 1, "threads": 2},
        "report/guidance.json": made_up_evaluation(rng, 1.0, episodes=1000),
        "report/cross.json": {
            arm: {"off": made_up_evaluation(rng, None), "on": made_up_evaluation(rng, 1.0)} for arm in ARMS
        },
        "report/baselines.json": {
            name: {"off": made_up_evaluation(rng, None, 100), "on": made_up_evaluation(rng, 1.0, 100)}
            for name in BASELINES
        },
        "report/front.json": {name: made_up_evaluation(rng, 1.0, 100) for name in ("thrifty", "quick")},
        "report/progress.json": {
            name: {"time_s": [0.0, 500.0, 1000.0], "weight": np.sort(rng.uniform(size=3)).tolist()}
            for name in (*ARMS, "guidance")
        },
        "report/worlds.json": {
            plant: {
                arm: {switch: made_up_evaluation(rng, None, 200) for switch in ("off", "nominal", "robust")}
                for arm in ARMS
            }
            for plant in ("nominal", "harsh")
        },
        "report/frequency.json": {f"{period}": made_up_evaluation(rng, period) for period in (1, 5, 10)},
    }
    for name, content in contents.items():
        (study / name).write_text(json.dumps(content))
    (study / "config.toml").write_text(to_toml(StudyConfig()))
    lines = ["interactions,arm,metric,iqm,low,high"]
    for interactions, arm, metric in itertools.product((500_000, 1_000_000, 1_500_000), ARMS, METRICS):
        low, middle, high = np.sort(rng.uniform(0.0, 5.0, 3))
        lines.append(f"{interactions},{arm},{metric},{middle},{low},{high}")
    (report / "training.csv").write_text("\n".join(lines) + "\n")
    np.savez(report / "violation.npz", **made_up_episode(rng), seed=np.array(2), case=np.array(7))
    for name, arm in itertools.product(("episode", "demonstration"), ARMS):
        np.savez(report / f"{name}_{arm}.npz", **made_up_episode(rng))
    return study


@pytest.fixture(scope="session")
def flown() -> dict[str, np.ndarray]:
    """A run of 290 s in rows of 10 s, tumbling, whose controls are corrected now and then.

    Its torque keeps a correction for a row in which the filter has nothing more to correct.
    """
    rng = np.random.default_rng(1)
    made_up = made_up_episode(rng)
    rows = len(made_up["time"])
    corrected = made_up["control_desired"].copy()
    corrected[[2, 3, 7], 1] += 1e-4  # thrust
    corrected[[7, 20, 21], 5] -= 1e-6  # torque
    intervened = np.zeros((rows, 2), dtype=bool)
    intervened[[2, 3, 7], 0] = intervened[[7, 20], 1] = True
    return made_up | {
        "quaternion": Rotation.random(rows, rng).as_quat(),
        "sun_angle": np.linspace(1.0, -2.0, rows),
        "control_applied": corrected,
        "intervened": intervened,
        **{f"h_{name}": rng.uniform(-1.0, 9.0, rows) for name in CONSTRAINTS},
    }


@pytest.fixture(scope="session")
def flown_files(flown: dict[str, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The run, and another that ends sooner."""
    directory = tmp_path_factory.mktemp("runs")
    paths = directory / "one.npz", directory / "two.npz"
    np.savez(paths[0], **flown)
    np.savez(paths[1], **{name: array[:20] if array.ndim else array for name, array in flown.items()})
    return paths
