"""Fixtures shared by all tests: the paper's constants, random states, a flight, the shipped study."""

import math
import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
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
from rta.names import CONSTRAINTS
from settings import to_toml
from study import machine
from study.config import Config
from study.files import ROOT
from tests.processors import THREADS

os.environ["OMP_NUM_THREADS"] = os.environ.get(THREADS, "1")  # of the processes that tests start, too
torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
settings.register_profile("project", deadline=None, derandomize=True, max_examples=40, database=None)
settings.load_profile("project")


@pytest.fixture(scope="session", autouse=True)
def kernels_cache(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Sets a cache for recorded and built code below pytest's own, and builds libraries without optimisation.

    Nothing is recorded or built twice, in no run: what is kept goes by the code, compiler and processor. `pytest
    --cache-clear` empties it. tests/kernels builds as users do; `test_optimisation_changes_no_bit_of_a_filter` there
    says that the compiler's optimisation does not matter.
    """
    kept = getattr(pytestconfig, "cache", None)  # None under -p no:cacheprovider
    directory = kept.mkdir("kernels") if kept else tmp_path_factory.mktemp("kernels")
    with pytest.MonkeyPatch.context() as patch:
        if find_spec("kernels"):  # a wing
            from kernels import build
            from tests.optimised import QUICK

            patch.setenv(build.VARIABLE, str(directory))
            patch.setattr(build, "FLAGS", QUICK)
        yield directory


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Keeps bars and what is said of long steps out of stderr, however busy the machine is."""
    monkeypatch.setattr(machine, "PATIENCE", 1e9)


@pytest.fixture(scope="module")
def small_pools() -> Iterator[None]:
    """Draws few initial states at once, because testing whether one is safe can be a search for a control."""
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
    """Returns the paper's constants."""
    return InspectionParameters()


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def random_states(generator):
    """Returns a function of the batch size B: states (16, B) such as occur in flight, float64."""

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


def made_up_episode(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Returns a tour around the chief in the form of `simulate`, every value within its limit."""
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
def shipped_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a copy of the shipped study and its report, without its runs."""
    source, study = ROOT / "runs/reference/from_nothing", tmp_path_factory.mktemp("shipped") / "study"
    shutil.copytree(source / "report", study / "report")
    for path in (*source.glob("*.json"), source / "config.toml"):
        shutil.copy(path, study)
    return study


@pytest.fixture(scope="session")
def flown() -> dict[str, np.ndarray]:
    """Returns a run of 290 s in rows of 10 s, tumbling, whose controls are corrected now and then.

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
    """Returns the run, and another that ends sooner."""
    directory = tmp_path_factory.mktemp("runs")
    paths = directory / "one.npz", directory / "two.npz"
    np.savez(paths[0], **flown)
    np.savez(paths[1], **{name: array[:20] if array.ndim else array for name, array in flown.items()})
    return paths
