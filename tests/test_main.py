"""The command line: every bad input ends in one line and exit code 2; good input writes what is promised."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import main
from inspection.transition import METRICS
from rta.fast.program import FastProgram
from rta.names import CONSTRAINTS
from rta.paper import PaperFilter
from settings import from_toml, load, override
from study import experiment
from study.config import Config, StudyConfig
from study.experiment import load_policy
from study.training import session as training

STATE: dict[str, Any] = {
    "position": [60.0, 10.0, -20.0],
    "velocity": [0.0, 0.0, 0.0],
    "quaternion": [0.0, 0.0, 0.0, 1.0],
    "angular_velocity": [0.0, 0.0, 0.0],
    "temperature": 5.0,
    "energy": 6.0,
    "sun_angle": 3.0,
}

POLICY = Path(main.__file__).parent / "runs/reference/from_nothing/rta/seed0/policy.pt"
EPISODE = Path(main.__file__).parent / "runs/reference/from_nothing/report/episode_rta.npz"


def write_inputs(directory: Path) -> dict[str, Path]:
    """Writes a valid input of every kind: agent, state, controls, states, configuration, run; returns paths by name."""
    paths = {name: directory / name for name in ("p.pt", "s.json", "u.npy", "x.npz", "c.toml", "r.npz")}
    paths["p.pt"].write_bytes(POLICY.read_bytes())
    paths["s.json"].write_text(json.dumps(STATE))
    np.save(paths["u.npy"], np.zeros((20, 6)))
    state = np.concatenate([np.ravel(value) for value in STATE.values()])
    np.savez(paths["x.npz"], state=state[None], control_desired=np.zeros((1, 6)))
    paths["c.toml"].write_text("[train]\nseed = 1\n")
    paths["r.npz"].write_bytes(EPISODE.read_bytes())
    return paths


def call(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Runs a command; returns exit code, stdout and stderr."""
    code = main.main(arguments)
    out, err = capsys.readouterr()
    return code, out, err


def assert_refused(arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    before = set(Path.cwd().iterdir())
    code, _, err = call(arguments, capsys)
    assert code == 2, err
    assert set(Path.cwd().iterdir()) == before
    assert err.count("\n") == 1, err
    assert err.startswith("error: ")
    for word in words:
        assert word in err


@pytest.mark.parametrize(
    ("command", "gone"),
    [
        (["export", "--filter", "c"], "study.export"),
        (["break-points"], "experiments"),
        (["train", "--cache-dir", "kept", "--interactions", "2"], "kernels.build"),
    ],
)
def test_a_command_whose_wing_was_taken_off_says_so(
    command: list[str], gone: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, gone, None)
    assert_refused(command, [f"{command[0]}: needs {gone.replace('.', '/')}", "not here"], capsys)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the directory of an untrained run with short episodes, because nothing here depends on their outcome."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    settings = {
        "train": {"rta": False, "num_envs": 4, "rollout_steps": 4, "interactions": 32, "device": "cpu"},
        "ppo": {"minibatch_size": 16},
        "inspection": {"max_time": 200.0},
    }
    training.start(override(Config(), settings, "test"), directory)
    return directory


def test_evaluate_writes_the_promised_json(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.json"
    arguments = ["evaluate", "--checkpoint", str(run / "policy.pt"), "--episodes", "6", "--json", str(path)]
    code, out, err = call(arguments, capsys)
    assert code == 0, err
    assert "Table 2" in out
    assert "Table 3" in out
    results = json.loads(path.read_text())
    assert set(results["metrics"]) == set(METRICS)
    assert all(
        set(metric) == {"iqm", "mean", "ci95", "p5", "p95", "max"} for metric in results["metrics"].values()
    )
    for violations in ("violations_percent", "violations_percent_of_seconds"):
        assert set(results[violations]) == {"any", *CONSTRAINTS}
    assert 0.0 <= results["outcomes"].pop("clean_success") <= results["outcomes"]["success"]
    assert sum(results["outcomes"].values()) == pytest.approx(1.0)
    assert set(results["outcomes"]) == {"success", "crash", "out_of_bounds", "out_of_power", "timeout"}
    assert {"period_s", "intervention_percent", "qp_failures"} <= set(results["rta"])
    assert (results["episodes"], results["seed"]) == (6, 0)
    assert results["config"]["train"]["num_envs"] == 4


def test_evaluate_flies_a_classical_controller(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "short.toml").write_text("[inspection]\nmax_time = 20.0")
    path = tmp_path / "results.json"
    arguments = ["evaluate", "--controller", "natural-motion", "--no-rta", "--episodes", "4"]
    code, out, err = call([*arguments, "--config", str(tmp_path / "short.toml"), "--json", str(path)], capsys)
    assert code == 0, err
    assert "Table 2" in out
    results = json.loads(path.read_text())
    assert results["metrics"]["episode_length_s"]["mean"] == 20.0
    assert results["metrics"]["delta_v_m_s"]["mean"] > 0.0
    assert results["rta"] == {
        "period_s": None,
        "intervention_percent": 0.0,
        "backup_calls": 0,
        "qp_failures": 0,
    }


def test_simulate_replays_recorded_controls_from_a_state(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (8, 6)) * [1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3]
    np.save(tmp_path / "actions.npy", actions)
    (tmp_path / "state.json").write_text(json.dumps(STATE))
    out = tmp_path / "run.npz"
    arguments = [
        "simulate",
        "--controller",
        "recorded",
        "--actions",
        str(tmp_path / "actions.npy"),
        "--no-rta",
    ]
    arguments += ["--initial-state", str(tmp_path / "state.json"), "--duration", "40", "--step", "5"]
    code, _, err = call([*arguments, "--out", str(out)], capsys)
    assert code == 0, err
    result = np.load(out)
    names = "time position velocity quaternion angular_velocity temperature energy sun_angle"
    names += " control_desired control_applied inspected_score inspected intervened parameters"
    assert set(result.files) == {*names.split(), *(f"h_{name}" for name in CONSTRAINTS)}
    np.testing.assert_allclose(result["time"], np.arange(0, 41, 5))
    np.testing.assert_array_equal(result["position"][0], STATE["position"])
    np.testing.assert_allclose(result["control_applied"][:-1], actions, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(result["quaternion"], axis=1), 1.0, atol=1e-12)
    assert result["temperature"].shape == result["h_battery"].shape == (9,)
    assert from_toml(str(result["parameters"]), "it", Config()).inspection == Config().inspection
    assert result["inspected"].shape == (9, Config().inspection.num_points)
    assert result["intervened"].shape == (9, 2) and not result["intervened"].any()  # there is no filter


@pytest.mark.parametrize("controller", ["lqr-pd", "natural-motion", "zero", "random"])
def test_simulate_runs_every_classical_controller_within_the_actuators_limits(
    controller: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run.npz"
    arguments = ["simulate", "--controller", controller, "--no-rta", "--duration", "30", "--out", str(out)]
    code, _, err = call(arguments, capsys)
    assert code == 0, err
    limit = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
    assert (np.abs(np.load(out)["control_desired"]) <= limit * (1 + 1e-9)).all()


def test_all_settings_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(["config", "--config", "12u", "--rta-period", "5"], capsys)
    assert (code, err) == (0, "")
    assert from_toml(out, "test", StudyConfig()) == override(
        load("12u", StudyConfig()), {"rta": {"period": 5.0}}, "test"
    )


def test_the_settings_of_an_agent_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(["config", "--checkpoint", str(POLICY), "--rta-period", "5"], capsys)
    found = from_toml(out, "test", Config())
    assert code == 0 and found.rta.period == 5.0
    assert found.ppo == load_policy(POLICY)[1].ppo != Config().ppo


PROGRAMS = {"piqp": PaperFilter, "batched": FastProgram}


@pytest.mark.parametrize(("wanted", "used"), [("auto", "batched"), ("piqp", "piqp")])
def test_a_run_says_which_solver_it_uses_and_keeps_it(wanted: str, used: str, tmp_path: Path) -> None:
    train = {"num_envs": 2, "rollout_steps": 2, "interactions": 4, "device": "cpu", "compile": "off"}
    directory = tmp_path / "run"
    tables = {"train": train, "rta": {"qp_solver": wanted}, "ppo": {"minibatch_size": 4}}
    run = training.start(override(Config(), tables, "test"), directory)
    assert f"by {used}" in str(run)
    assert type(run.experiment.filter.program) is PROGRAMS[used]
    assert type(training.resume(directory).experiment.filter.program) is PROGRAMS[used]


def test_test_cases_do_not_depend_on_their_number_or_on_the_filter() -> None:
    few = experiment.test_cases(Config(), 2, 0).x
    slow = {"period": 10.0}
    many = experiment.test_cases(override(Config(), {"rta": slow}, "test"), 300, 0).x
    assert torch.equal(few, many[:, :2])


@pytest.mark.parametrize(
    "command",
    [
        ["evaluate", "--episodes", "2"],
        ["simulate", "--controller", "policy", "--duration", "10", "--out", "x.npz"],
    ],
)
def test_an_agent_is_shown_what_it_was_trained_with(
    command: list[str], run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "blind.toml").write_text('[inspection]\nobserved = ["score", "hill"]\n')
    flags = ["--checkpoint", str(run / "policy.pt"), "--config", str(tmp_path / "blind.toml")]
    assert_refused([*command, *flags], ["observed = ['score', 'hill']: the agent was trained with"], capsys)
