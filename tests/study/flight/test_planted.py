"""`verify`, `simulate` and `evaluate` can fail: each reports a violation that was planted."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray

from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.result import FilterResult
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.flight.evaluation import report, run_episodes
from study.flight.fly import Starts
from study.flight.simulation import simulate
from study.verification import campaign
from study.verification.starts import safe_set
from tests.oracles import PSM_TOLERANCE, paper
from tests.support.flights import FILTER
from tests.test_main import STATE, call

pytestmark = pytest.mark.usefixtures("small_pools")

FILTERED = SafetyFilter.correct
COMPILED = {"train": {"compile": "on", "device": "cpu"}}


def let_pass(self: SafetyFilter, x: torch.Tensor, desired: torch.Tensor) -> FilterResult:
    """Returns the filter's answer with the desired control in place of its own."""
    return dataclasses.replace(FILTERED(self, x, desired), control=desired.clone())


def test_verify_reports_a_filter_that_corrects_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SafetyFilter, "correct", let_pass)
    monkeypatch.setattr(campaign, "BATCH", 8)  # draws only as many starts as it flies
    path = tmp_path / "report.json"
    words = "verify --policy adversarial --episodes 8 --duration 50 --compile on --rta-period 1 --json"
    code, out, err = call([*words.split(), str(path)], capsys)
    assert code == 0, err
    found = json.loads(path.read_text())
    for name in CONSTRAINTS:
        row = next(line for line in out.splitlines() if line.startswith(f"{name} ")).split()
        counts = [int(word.replace(",", "")) for word in row[1:3]]
        assert counts == [found["violating_steps"][name], found["violating_episodes"][name]]
    broken = [name for name in CONSTRAINTS if found["violating_steps"][name]]
    assert len(broken) > 3 and found["violating_episodes"]["any"] > 4
    assert found["upper_bound_95"] > 0.5
    for name in broken:
        assert found["worst_value"][name] < 0.0
        example = np.load(tmp_path / f"report.json.{name}.npz")
        assert (example["control_desired"] == example["control_applied"]).all()


def simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], state: dict[str, Any], *more: str
) -> tuple[dict[str, ndarray], list[str]]:
    """Returns `simulate`'s record of 30 s with full thrust and torque, and the constraints it reports as violated."""
    paths = [str(tmp_path / name) for name in ("state.json", "actions.npy", "run.npz")]
    Path(paths[0]).write_text(json.dumps(STATE | state))
    np.save(paths[1], np.tile([1.0, 1.0, 1.0, 0.001, 0.001, 0.001], (30, 1)))
    arguments = ["--controller", "recorded", "--initial-state", paths[0], "--actions", paths[1]]
    code, out, err = call(["simulate", *arguments, "--duration", "30", "--out", paths[2], *more], capsys)
    assert code == 0, err
    run = dict(np.load(paths[2]))
    violated = out.strip().split("violated constraints: ")[1].split(", ")
    return run, [name for name in violated if name != "none"]


def states_of(run: dict[str, ndarray]) -> ndarray:
    """Returns states (16, rows)."""
    parts = [run["position"], run["velocity"], run["quaternion"], run["angular_velocity"]]
    return np.column_stack([*parts, run["temperature"], run["energy"], run["sun_angle"]]).T


@pytest.mark.parametrize(
    ("state", "flags"),
    [
        (
            {"velocity": [0.0, 0.7, 0.0], "temperature": 10.1, "energy": 0.9},
            [],
        ),  # 0.68 m/s is the limit there
        ({"position": [14.0, 0.0, 0.0], "angular_velocity": [0.0, 0.05, 0.0]}, ["--no-rta"]),
    ],
)
def test_simulate_reports_a_start_beyond_a_limit(
    state: dict[str, Any], flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, violated = simulated(tmp_path, capsys, state, *flags)
    h = paper(states_of(run))
    beyond = {name for name, first in zip(CONSTRAINTS, h[:, 0], strict=True) if first < -PSM_TOLERANCE}
    assert beyond and beyond <= set(violated)
    for name, expected in zip(CONSTRAINTS, h, strict=True):
        np.testing.assert_allclose(run[f"h_{name}"], expected, rtol=0, atol=PSM_TOLERANCE)
        assert (name in violated) == (run[f"h_{name}"] < 0.0).any()


def test_simulate_reports_what_a_filter_that_corrects_nothing_lets_pass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert simulated(tmp_path, capsys, {})[1] == []
    monkeypatch.setattr(SafetyFilter, "correct", let_pass)
    run, violated = simulated(tmp_path, capsys, {})
    h = paper(states_of(run))
    assert "dynamic_speed" in violated
    assert violated == [name for name, row in zip(CONSTRAINTS, h, strict=True) if row.min() < 0.0]


def experiment(period: float, seconds: float) -> Experiment:
    """Returns an experiment with episodes of so many s."""
    tables = {"inspection": {"max_time": seconds}, "rta": {"period": period}}
    return Experiment(override(Config(), COMPILED | tables, "test"), 1)


def coasting(t: float, x: torch.Tensor) -> torch.Tensor:
    """Returns zero control."""
    return torch.zeros_like(x[:CONTROL_SIZE])


def fast_inwards(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the starts of the safe set at 1 s that would soonest be too fast without braking."""
    x, priority, _ = safe_set(2000, 0, FILTER)
    inwards = -(x[:3] * x[3:6]).sum(0) / x[:3].norm(dim=0)
    speed = FILTER.values(x)[CONSTRAINTS.index("dynamic_speed")]
    chosen = (speed / inwards).where(inwards > 0.5, torch.inf).argsort()[:count]
    return x[:, chosen], priority[:, chosen]


@pytest.mark.parametrize("period", [1.0, pytest.param(10.0, marks=pytest.mark.campaign)])
def test_evaluate_reports_what_a_weaker_plant_violates(period: float) -> None:
    """Percent of the actions' ends, of all seconds and of the filter's calls, against a simulation of every second."""
    behind, count = experiment(period, 20.0), 3
    # the filter believes in ten times the acceleration that there is
    plant = dataclasses.replace(behind.config.inspection, mass=120.0)
    x, priority = fast_inwards(count)

    def env(columns: int, **clocks: float) -> InspectionEnv:
        return InspectionEnv(columns, plant, behind.generators(), behind.safety, period, **clocks)

    record = run_episodes(env(count), coasting, Starts(x, priority))
    results = report(record, behind.config, 0)
    ends, seconds, calls = [], [], []
    for i, length in enumerate(record.metrics[2].tolist()):
        run = simulate(env(1, report_every=1.0), coasting, Starts(x, priority).one(i), length)
        h = paper(states_of(run)) < 0.0
        every = np.vstack((h, h.any(0)))
        ends.append(every[:, 10::10].mean(1))
        seconds.append(every[:, 1:].mean(1))
        calls.append(h[:, : -1 : round(period)])
    expected = dict(zip((*CONSTRAINTS, "any"), 100.0 * np.mean(ends, 0), strict=True))
    assert results["violations_percent"] == pytest.approx(expected)
    of_seconds = dict(zip((*CONSTRAINTS, "any"), 100.0 * np.mean(seconds, 0), strict=True))
    assert results["violations_percent_of_seconds"] == pytest.approx(of_seconds)
    assert expected["dynamic_speed"] > 0.0 and results["worst_constraint_value"]["dynamic_speed"] < 0.0
    at_calls = dict(zip(CONSTRAINTS, 100.0 * np.hstack(calls).mean(1), strict=True))
    assert results["rta"]["filter_step_violations_percent"] == pytest.approx(at_calls)
    assert 0.0 < at_calls["dynamic_speed"] != expected["dynamic_speed"]
