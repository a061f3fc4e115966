"""The command line: every bad input ends in one line and exit code 2; good input writes what is promised."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

import main
from inspection.environment import METRICS
from rta.constraints import CONSTRAINTS
from rta.filter import SOLVERS
from study import experiment
from study.arguments import build_parser, resolve
from study.config import Config, from_toml, override
from study.training import run as training

STATE: dict[str, Any] = {
    "position": [60.0, 10.0, -20.0],
    "velocity": [0.0, 0.0, 0.0],
    "quaternion": [0.0, 0.0, 0.0, 1.0],
    "angular_velocity": [0.0, 0.0, 0.0],
    "temperature": 5.0,
    "energy": 6.0,
    "sun_angle": 3.0,
}


def call(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    try:
        code = main.main(arguments)
    except SystemExit as stop:
        code = stop.code
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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a run that was never trained."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    train = {"rta": False, "num_envs": 4, "rollout_steps": 4, "interactions": 32, "device": "cpu"}
    training.start(override(Config(), {"train": train}, "test"), directory)
    return directory


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--rta-period", "2"], ["--rta-period", "'2'", "1, 5 or 10"]),
        (["train", "--num-envs", "0"], ["--num-envs", "'0'", "positive integer"]),
        (["train", "--interactions", "-5"], ["--interactions", "'-5'", "positive integer"]),
        (["train", "--interactions", "many"], ["--interactions", "'many'", "positive integer"]),
        (["train", "--learning-rate", "nan"], ["--learning-rate", "'nan'", "positive"]),
        (["train", "--seed", "-1"], ["--seed", "'-1'", "integer"]),
        (["train", "--device", "tpu"], ["--device", "'tpu'", "cuda"]),
        (["train", "--solar-panel-axis", "x"], ["--solar-panel-axis", "'x'", "+x"]),
        (["train", "--config", "nowhere.toml"], ["nowhere.toml", "No such file"]),
        (["train", "--resume", "nowhere"], ["nowhere", "no run there"]),
        (["train", "--resume", "nowhere", "--seed", "3"], ["--resume", "--seed"]),
        (["train", "--unknown"], ["--unknown"]),
        (["study", "--seeds", "0"], ["--seeds", "'0'", "positive integer"]),
        (["study", "--seeds", "9999"], ["seeds = 9999", "up to 1,000"]),
        (["study", "--arms", "rta,both"], ["--arms", "'rta,both'", "no_rta,rta"]),
        (["study", "--arms", "rta,rta"], ["--arms", "'rta,rta'", "no_rta,rta"]),
        (["study", "--config", "nowhere.toml"], ["nowhere.toml", "No such file"]),
        (["study", "--study-dir", "/proc/nowhere"], ["--study-dir", "cannot write there"]),
        (
            ["train", "--config", str(Path(main.__file__).parent / "configs" / "study.toml")],
            ["unknown table [study]"],
        ),
        (["benchmark", "--batches", "256,none"], ["--batches", "'none'", "positive integer"]),
        (["benchmark", "--json", "nowhere/x.json"], ["--json", "cannot write"]),
        (["train", "--qp-solver", "osqp"], ["--qp-solver", "'osqp'", "auto", "piqp", "batched"]),
        (["verify", "--qp-solver", "osqp"], ["--qp-solver", "'osqp'", "auto", "piqp", "batched"]),
        (["evaluate"], ["--checkpoint"]),
        (["evaluate", "--controller", "lqr-pd"], ["--controller", "'lqr-pd'", "natural-motion"]),
        (
            ["evaluate", "--controller", "natural-motion", "--checkpoint", "x.pt"],
            ["--checkpoint", "not allowed", "--controller"],
        ),
        (["evaluate", "--checkpoint", "nowhere.pt"], ["nowhere.pt", "no such checkpoint"]),
        (["evaluate", "--checkpoint", "x.pt", "--episodes", "0"], ["--episodes", "'0'", "positive"]),
        (["simulate", "--controller", "pid"], ["--controller", "'pid'", "lqr-pd"]),
        (["simulate", "--controller", "zero", "--duration", "0", "--out", "x"], ["--duration", "'0'"]),
        (
            ["simulate", "--controller", "policy", "--duration", "10", "--out", "x"],
            ["--checkpoint", "--controller policy"],
        ),
        (
            ["simulate", "--controller", "recorded", "--duration", "10", "--out", "x"],
            ["--actions", "--controller recorded"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "10", "--step", "3", "--out", "x"],
            ["--step 3", "10 s"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "15", "--step", "10", "--out", "x"],
            ["--duration 15", "--step"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "10", "--out", "nowhere/x.npz"],
            ["--out", "cannot write"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "10", "--out", "x", "--figure", "no/x.png"],
            ["--figure", "cannot write"],
        ),
        (["filter", "--out", "x"], ["--states"]),
        (["filter", "--states", "nowhere.npz", "--out", "x"], ["nowhere.npz", "no such file"]),
        (["filter", "--states", "x", "--out", "x", "--no-rta"], ["--no-rta"]),
        (["export", "--checkpoint", "x.pt"], ["--out"]),
        (["export", "--checkpoint", "nowhere.pt", "--out", "x"], ["nowhere.pt", "no such checkpoint"]),
        (["export", "--checkpoint", "x.pt", "--out", "nowhere/x.onnx"], ["--out", "cannot write"]),
        (
            [],
            ["train | study | report | evaluate | simulate | replay | filter | verify | benchmark | export"],
        ),
    ],
)
def test_bad_flags_are_refused(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(arguments, words, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_absent_cuda_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cuda", "no CUDA device"]
    assert_refused(["train", "--device", "cuda", "--run-dir", str(tmp_path / "r")], words, capsys)


def test_an_existing_run_is_not_overwritten(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(["train", "--run-dir", str(run)], ["--run-dir", "--resume"], capsys)


def test_corrupt_checkpoints_are_refused(
    tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (run / "policy.pt").read_bytes()
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, other)
    for name, content in (("empty", b""), ("garbage", b"\x80garbage"), ("half", whole[: len(whole) // 2])):
        path = tmp_path / f"{name}.pt"
        path.write_bytes(content)
        assert_refused(["evaluate", "--checkpoint", str(path)], [str(path), "not a readable"], capsys)
    assert_refused(["evaluate", "--checkpoint", str(other)], [str(other), "lacks policy"], capsys)
    assert_refused(["evaluate", "--checkpoint", str(tmp_path)], [str(tmp_path), "no such"], capsys)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": [1.0, 2.0]}, ["position", "3 numbers"]),
        ({"position": [0.0, 0.0, 0.0]}, ["position", "centre"]),
        ({"velocity": [0.0, float("nan"), 0.0]}, ["velocity", "finite"]),
        ({"energy": float("inf")}, ["energy", "finite"]),
        ({"temperature": "warm"}, ["temperature", "number"]),
        ({"quaternion": [0.0, 0.0, 0.0, 2.0]}, ["quaternion", "length 1"]),
        ({"quaternion": [1.0, 0.0, 0.0]}, ["quaternion", "4 numbers"]),
        ({"priority_vector": [0.0, 0.0, 0.0]}, ["priority_vector", "zero"]),
        ({"colour": 1}, ["'colour'", "position"]),
        ({"sun_angle": None}, ["sun_angle", "number"]),
    ],
)
def test_bad_state_files_are_refused(
    change: dict[str, Any], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps(STATE | change))
    arguments = ["simulate", "--controller", "zero", "--duration", "10", "--initial-state", str(path)]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path), *words], capsys)


@pytest.mark.parametrize("text", ["[1, 2]", "{", '{"position": [1, 2, 3]}'])
def test_malformed_state_files_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(text)
    arguments = ["simulate", "--controller", "zero", "--duration", "10", "--initial-state", str(path)]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path)], capsys)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((3, 5)), ["(3, 5)", "(N, 6)"]),
        (np.full((3, 6), np.nan), ["finite"]),
        (np.full((3, 6), 0.5), ["0.5", "0.001"]),
        (np.array(["a"]), ["(N, 6)"]),
    ],
)
def test_bad_actions_are_refused(
    actions: np.ndarray, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "actions.npy"
    np.save(path, actions)
    arguments = [
        "simulate",
        "--controller",
        "recorded",
        "--actions",
        str(path),
        "--duration",
        "10",
        "--no-rta",
    ]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path), *words], capsys)


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
    assert all(set(metric) == {"iqm", "mean", "ci95"} for metric in results["metrics"].values())
    assert set(results["violations_percent"]) == {"any", *CONSTRAINTS}
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
    assert results["rta"] == {"period_s": None, "intervention_percent": 0.0, "qp_failures": 0}


def test_evaluate_writes_json_to_standard_output(run: Path) -> None:
    arguments = [
        "evaluate",
        "--checkpoint",
        str(run / "policy.pt"),
        "--episodes",
        "2",
        "--json",
        "/dev/stdout",
    ]
    done = subprocess.run([sys.executable, main.__file__, *arguments], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    tables, _, results = done.stdout.partition("\n{")
    assert "Table 2" in tables
    assert json.loads("{" + results)["episodes"] == 2


def test_evaluate_is_the_same_for_policy_and_checkpoint_file(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    texts = []
    for name in ("policy.pt", "checkpoint.pt"):
        path = tmp_path / f"{name}.json"
        call(["evaluate", "--checkpoint", str(run / name), "--episodes", "3", "--json", str(path)], capsys)
        texts.append(path.read_text())
    assert texts[0] == texts[1]


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
    assert from_toml(str(result["parameters"]), "it").inspection == Config().inspection
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


@pytest.mark.parametrize("controller", ["lqr-pd", "zero"])
def test_simulate_draws_the_constraints(
    controller: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure = tmp_path / "constraints"  # a PNG whatever its name
    arguments = ["simulate", "--controller", controller, "--no-rta", "--duration", "20"]
    code, _, err = call([*arguments, "--out", str(tmp_path / "x.npz"), "--figure", str(figure)], capsys)
    assert code == 0, err
    height, width, _ = plt.imread(figure, format="png").shape
    assert (width, height) == (1200, 840)


def test_simulate_filters_a_policy_at_the_rta_period(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run.npz"
    arguments = ["simulate", "--controller", "policy", "--checkpoint", str(run / "policy.pt"), "--rta"]
    arguments += ["--rta-period", "5", "--duration", "20", "--step", "1", "--out", str(out)]
    code, _, err = call(arguments, capsys)
    assert code == 0, err
    applied = np.load(out)["control_applied"]
    changes = np.flatnonzero((np.diff(applied, axis=0) != 0).any(1)) + 1
    assert set(changes) <= {5, 10, 15}


def test_a_finished_run_without_its_checkpoint_is_not_overwritten(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = tmp_path / "shipped"
    shipped.mkdir()
    (shipped / "policy.pt").write_bytes((run / "policy.pt").read_bytes())
    assert_refused(["train", "--run-dir", str(shipped)], ["--run-dir", "holds a run"], capsys)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("value"),
        lambda content: content["env"].pop("x"),
        lambda content: content["env"].update(x=torch.zeros(16, 3)),
        lambda content: content.update(update="many"),
        lambda content: content.update(generators=[]),
        lambda content: content.update(config=3),
    ],
)
def test_a_damaged_run_is_not_resumed(
    damage: Any, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(run / "checkpoint.pt", weights_only=True)
    damage(content)
    torch.save(content, tmp_path / "checkpoint.pt")
    (tmp_path / "config.toml").write_text((run / "config.toml").read_text())
    assert_refused(["train", "--resume", str(tmp_path)], [str(tmp_path / "checkpoint.pt")], capsys)


def test_a_run_whose_configuration_was_edited_is_not_resumed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "checkpoint.pt").write_bytes((run / "checkpoint.pt").read_bytes())
    text = (run / "config.toml").read_text().replace("mass = 12.0", "mass = 20.0")
    (tmp_path / "config.toml").write_text(text)
    assert_refused(["train", "--resume", str(tmp_path)], ["config.toml", "trained with"], capsys)


def test_a_policy_with_nan_weights_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(run / "policy.pt", weights_only=True)
    next(iter(content["policy"].values()))[0, 0] = torch.nan
    torch.save(content, tmp_path / "policy.pt")
    words = [str(tmp_path / "policy.pt"), "not finite"]
    assert_refused(["evaluate", "--checkpoint", str(tmp_path / "policy.pt")], words, capsys)


@pytest.mark.parametrize(
    "text",
    [
        "[inspection]\nsubstep = 0.3",
        "[inspection]\nmax_distance = 10.0",
        "[inspection]\ninitial_temperature = [50.0, 60.0]",
        "[inspection]\nmax_thrust = 1e-4",
        "[ppo]\nlog_std_bounds = [-1e5, 1e5]",
        "[train]\nseed = 99999999999999999999",
        '[rta]\nqp_solver = "osqp"',
        "[rta]\npassive_safety_segments = [0.0, 400.0]",
    ],
)
def test_impossible_settings_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    arguments = ["train", "--config", str(path), "--run-dir", str(tmp_path / "run"), "--num-envs", "2"]
    assert_refused([*arguments, "--compile", "off", "--device", "cpu"], ["["], capsys)


def test_flags_override_the_file(tmp_path: Path) -> None:
    path = tmp_path / "some.toml"
    path.write_text("[train]\nseed = 5\nnum_envs = 8\n")
    words = ["train", "--config", str(path), "--seed", "6", "--no-rta"]
    train = resolve(build_parser(main.HANDLERS).parse_args(words), Config()).train
    assert (train.seed, train.num_envs, train.rta) == (6, 8, False)


@pytest.mark.parametrize(
    ("envs", "wanted", "used"), [(2, "auto", "piqp"), (512, "auto", "batched"), (2, "batched", "batched")]
)
def test_a_run_says_which_solver_it_uses_and_keeps_it(
    envs: int, wanted: str, used: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = {"num_envs": envs, "rollout_steps": 2, "interactions": 4, "device": "cpu", "compile": "off"}
    directory = tmp_path / "run"
    tables = {"train": train, "rta": {"qp_solver": wanted}}
    run = training.start(override(Config(), tables, "test"), directory)
    assert f"by {used}" in str(run)
    assert type(run.experiment.filter.solver) is SOLVERS[used]
    # another machine or version would choose the other one
    monkeypatch.setattr(experiment, "WORTH_BATCHING", {"piqp": 0, "batched": 10**9}[used])
    assert type(training.resume(directory).experiment.filter.solver) is SOLVERS[used]


@pytest.mark.parametrize(("flags", "used"), [([], "auto"), (["--qp-solver", "batched"], "batched")])
def test_evaluate_chooses_its_solver_however_the_agent_was_trained(flags: list[str], used: str) -> None:
    trained = override(Config(), {"rta": {"qp_solver": "batched", "period": 5.0}}, "test")
    arguments = build_parser(main.HANDLERS).parse_args(["evaluate", "--checkpoint", "x.pt", *flags])
    rta = resolve(arguments, trained.unsettled()).rta
    assert (rta.qp_solver, rta.period) == (used, 5.0)


@pytest.mark.parametrize("out", ["/proc/nothing.npz", "x" * 300])
def test_unwritable_output_is_refused_before_the_work(
    out: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(["simulate", "--controller", "zero", "--duration", "10", "--out", out], ["--out"], capsys)


def test_a_full_disk_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["simulate", "--controller", "zero", "--no-rta", "--duration", "10", "--out", "/dev/full"]
    assert_refused(arguments, ["/dev/full: No space left on device"], capsys)


@pytest.mark.parametrize(("duration", "step"), [("1e300", "1"), ("10", "1e-12"), ("1e8", "1")])
def test_endless_simulations_are_refused(
    duration: str, step: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["simulate", "--controller", "zero", "--duration", duration, "--step", step]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], ["--duration", "--step"], capsys)


def test_test_cases_do_not_depend_on_their_number_or_on_the_filter() -> None:
    few, _ = experiment.test_cases(Config(), 2, 0)
    gains = {"exclusion_margin": 0.1, "battery_gains": [0.001, 0.1]}
    many, _ = experiment.test_cases(override(Config(), {"rta": gains}, "test"), 300, 0)
    assert torch.equal(few, many[:, :2])
