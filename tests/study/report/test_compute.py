"""A report's computations: what they give is what other commands give, and nothing is computed twice."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import main
from inspection.orbits import GUIDANCE
from study.report import compute, figures, flights, page

SEEDS = (5, 6)
CASES = 4
DURATION = 5.0
SETTINGS = f"""
[study]
seeds = 2
[train]
seed = 5
num_envs = 3
rollout_steps = 4
interactions = 24
evaluation_interval = 12
evaluation_episodes = 2
final_episodes = {CASES}
compile = "on"
device = "cpu"
[rta]
qp_solver = "batched"
[inspection]
action_period = {DURATION}
max_time = {DURATION} # every episode lasts one step
[ppo]
epochs = 2
minibatch_size = 8
"""
FILES = {
    "cross.json",
    "frequency.json",
    "baselines.json",
    "front.json",
    "progress.json",
    "worlds.json",
    "sunlight.json",
    "training.csv",
    "episode_no_rta.npz",
    "episode_rta.npz",
    "demonstration_no_rta.npz",
    "demonstration_rta.npz",
}


@pytest.fixture(scope="module", autouse=True)
def brief(small_pools: None, loose_figures: None) -> Any:
    """Uses two periods, short demonstrations and few settings of the guidance."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "PERIODS", (1.0, 5.0))
        patch.setattr(flights, "DEMONSTRATION_DURATION", DURATION)
        patch.setattr(flights, "GUIDANCE", {name: GUIDANCE[name] for name in ("following", "even", "quick")})
        patch.setattr(flights, "WORLDS", ("nominal", "harsh"))
        patch.setattr(flights, "WORLDS_CASES", 1)
        patch.setattr(flights, "PROGRESS_UNTIL", 2 * DURATION)
        yield


def reported(settings: str, directory: Path) -> Path:
    """Returns the directory of a study of two updates and its report."""
    path = directory.with_suffix(".toml")
    path.write_text(settings)
    assert main.main(["study", "--config", str(path), "--study-dir", str(directory)]) == 0
    assert main.main(["report", "--study", str(directory)]) == 0
    return directory


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reported(SETTINGS, tmp_path_factory.mktemp("study") / "tiny")


def test_a_report_of_one_seed_of_one_arm_has_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "PERIODS", (1.0,))
    monkeypatch.setattr(flights, "WORLDS", ("nominal",))
    monkeypatch.setattr(flights, "GUIDANCE", {"quick": GUIDANCE["quick"]})
    monkeypatch.setattr(flights, "BASELINES", ("even",))
    monkeypatch.setattr(figures, "draw", lambda found: None)
    monkeypatch.setattr(page, "write", lambda found: None)  # which embeds the figures
    settings = SETTINGS.replace("seeds = 2", 'seeds = 1\narms = ["rta"]').replace('"on"', '"off"')
    settings = settings.replace(f"final_episodes = {CASES}", "final_episodes = 1")
    settings = settings.replace("interactions = 24", "interactions = 12")
    report = reported(settings, tmp_path / "tiny") / "report"
    assert {path.name for path in report.iterdir()} >= FILES - {"episode_no_rta.npz"}
    mean = read(report / "cross.json")["rta"]["on"]["metrics"]["reward"]["mean"]
    assert mean == read(report.parent / "results.json")["arms"]["rta"]["metrics"]["reward"]["mean"]


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("keys", "arm", "flags"),
    [
        (("cross", "no_rta", "on"), "no_rta", f"--rta --episodes {CASES}"),
        (("frequency", "5"), "rta", f"--rta-period 5 --episodes {CASES}"),
        (("worlds", "harsh", "rta", "robust"), "rta", "--config told.toml --episodes 1"),
        (("worlds", "nominal", "no_rta", "off"), "no_rta", "--episodes 1"),
    ],
)
def test_other_filters_and_worlds_give_what_evaluate_says_of_each_policy(
    keys: tuple[str, ...],
    arm: str,
    flags: str,
    study: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name, *inside = keys
    results = read(study / "report" / f"{name}.json")
    for key in inside:
        results = results[key]
    monkeypatch.chdir(tmp_path)
    bounds = (flights.PLANTS / "u1.toml").read_text()
    plant = (flights.PLANTS / "harsh.toml").read_text()
    Path("told.toml").write_text(plant + bounds[bounds.index("[uncertainty]") :])
    alone = []
    for seed in SEEDS:
        checkpoint = str(study / arm / f"seed{seed}" / "policy.pt")
        assert main.main(["evaluate", "--checkpoint", checkpoint, *flags.split(), "--json", "one.json"]) == 0
        alone.append(read(Path("one.json")))
    assert results["episodes"] == sum(own["episodes"] for own in alone)
    assert results["rta"]["period_s"] == alone[0]["rta"]["period_s"]
    assert results.get("config", alone[0]["config"]) == alone[0]["config"]
    for metric, found in results["metrics"].items():
        assert found["mean"] == pytest.approx(np.mean([own["metrics"][metric]["mean"] for own in alone]))
    for limit, percent in results["violations_percent"].items():
        assert percent == pytest.approx(np.mean([own["violations_percent"][limit] for own in alone]))
    for limit, value in results["worst_constraint_value"].items():
        assert value == pytest.approx(min(own["worst_constraint_value"][limit] for own in alone))


@pytest.mark.campaign
def test_progress_ends_at_the_weight_that_the_study_found(study: Path) -> None:
    arms = read(study / "results.json")["arms"]
    found = read(study / "report" / "progress.json")
    assert list(found) == ["no_rta", "rta", "guidance"]
    for name, results in arms.items():
        assert found[name]["time_s"] == [0.0, DURATION, 2 * DURATION]
        # every episode lasts one step, and keeps its weight from then on
        last = results["metrics"]["inspected_score"]["iqm"]
        assert found[name]["weight"][1:] == pytest.approx([last, last])


@pytest.mark.campaign
@pytest.mark.parametrize("rta", [False, True])
def test_episodes_are_those_of_simulate(rta: bool, study: Path, tmp_path: Path) -> None:
    arm = "rta" if rta else "no_rta"
    agent = ["--controller", "policy", "--checkpoint", str(study / arm / "seed5" / "policy.pt")]
    classical = ["--controller", "lqr-pd", "--initial-state", str(flights.DEMONSTRATION)]
    settings = tmp_path / "settings.toml"  # as the study has them
    settings.write_text(f"[inspection]\naction_period = {DURATION}\nmax_time = {DURATION}")
    classical += ["--config", str(settings)]
    filtered = ["--rta" if rta else "--no-rta", "--rta-period", "1"]
    for name, flags in (("episode", agent), ("demonstration", classical)):
        arguments = ["simulate", *flags, *filtered, "--duration", str(DURATION), "--out"]
        assert main.main([*arguments, str(tmp_path / "one.npz")]) == 0
        expected, ours = np.load(tmp_path / "one.npz"), np.load(study / "report" / f"{name}_{arm}.npz")
        assert ours.files == expected.files
        assert (ours["time"] == np.arange(DURATION + 1)).all()
        for array in ours.files:
            kept = expected[array].astype(ours[array].dtype)  # single precision, where it is a float
            np.testing.assert_array_equal(ours[array], kept, array)


@pytest.mark.campaign
def test_an_interrupted_report_keeps_what_it_has_computed(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(study, tmp_path / "copy"))
    report = copy / "report"
    whole = {path.name for path in report.iterdir()}
    absent = {name for name in FILES if name.startswith("demonstration")}
    for name in absent:
        (report / name).unlink()

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(flights, "demonstration", interrupted)
        with pytest.raises(KeyboardInterrupt):
            compute.compute(copy)
    assert {path.name for path in report.iterdir()} == whole - absent
    monkeypatch.setattr(flights, "play", None)
    monkeypatch.setattr(flights, "common_episode", None)
    compute.compute(copy)
    assert {path.name for path in report.iterdir()} == whole
