"""A report's computations: what they give is what other commands give, and nothing is computed twice."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import main
from inspection.orbits import GUIDANCE
from settings import InputError, load
from study.config import Config, StudyConfig
from study.experiment import Experiment
from study.report import agents, compute, flights, inputs, tables

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
    "guidance.json",
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
    """Two periods, short demonstrations and few cases of the guidance."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "PERIODS", (1.0, 5.0))
        patch.setattr(flights, "DEMONSTRATION_DURATION", DURATION)
        patch.setattr(flights, "GUIDANCE_CASES", CASES)
        patch.setattr(flights, "GUIDANCE", {name: GUIDANCE[name] for name in ("following", "even", "quick")})
        patch.setattr(flights, "WORLDS", ("nominal", "harsh"))
        patch.setattr(flights, "WORLDS_CASES", 1)
        patch.setattr(flights, "PROGRESS_UNTIL", 2 * DURATION)
        yield


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a study of two updates and its report."""
    directory = tmp_path_factory.mktemp("study") / "tiny"
    settings = directory.with_suffix(".toml")
    settings.write_text(SETTINGS)
    assert main.main(["study", "--config", str(settings), "--study-dir", str(directory)]) == 0
    assert main.main(["report", "--study", str(directory)]) == 0
    return directory


@pytest.fixture
def copy(study: Path, tmp_path: Path) -> Path:
    """A copy to work on."""
    return Path(shutil.copytree(study, tmp_path / "copy"))


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.parametrize(
    ("file", "keys", "arm", "flags"),
    [
        ("cross", ("no_rta", "on"), "no_rta", ["--rta"]),
        ("cross", ("rta", "off"), "rta", ["--no-rta"]),
        ("frequency", ("1",), "rta", ["--rta-period", "1"]),
        ("frequency", ("5",), "rta", ["--rta-period", "5"]),
    ],
)
def test_other_filters_give_what_evaluate_says_of_each_policy(
    file: str, keys: tuple[str, ...], arm: str, flags: list[str], study: Path, tmp_path: Path
) -> None:
    results = read(study / "report" / f"{file}.json")
    for key in keys:
        results = results[key]
    alone = []
    for seed in SEEDS:
        path = tmp_path / f"{seed}.json"
        arguments = ["evaluate", "--checkpoint", str(study / arm / f"seed{seed}" / "policy.pt"), *flags]
        arguments += ["--qp-solver", "batched", "--episodes", str(CASES), "--json", str(path)]
        assert main.main(arguments) == 0
        alone.append(read(path))
    assert results["episodes"] == len(SEEDS) * CASES
    assert results["rta"]["period_s"] == alone[0]["rta"]["period_s"]
    assert results["config"] == alone[0]["config"]
    for name, metric in results["metrics"].items():
        assert metric["mean"] == pytest.approx(np.mean([own["metrics"][name]["mean"] for own in alone]))
    for name, percent in results["violations_percent"].items():
        assert percent == pytest.approx(np.mean([own["violations_percent"][name] for own in alone]))
    for name, value in results["worst_constraint_value"].items():
        assert value == pytest.approx(min(own["worst_constraint_value"][name] for own in alone))


def test_the_studys_own_filter_gives_the_studys_own_results(study: Path) -> None:
    arms = read(study / "results.json")["arms"]
    cross = read(study / "report" / "cross.json")
    assert cross["no_rta"]["off"] == arms["no_rta"]
    assert cross["rta"]["on"] == arms["rta"] == read(study / "report" / "frequency.json")["1"]


def test_worlds_are_those_of_evaluate(study: Path, tmp_path: Path) -> None:
    """The robust filter in the harsh plant, each seed alone."""
    found = read(study / "report" / "worlds.json")
    assert list(found) == ["nominal", "harsh"]
    assert all(list(arms) == ["no_rta", "rta"] for arms in found.values())
    settings = tmp_path / "harsh_and_told.toml"
    told = (flights.PLANTS / "u1.toml").read_text()
    plant = (flights.PLANTS / "harsh.toml").read_text()
    settings.write_text(plant + told[told.index("[uncertainty]") :])
    alone = []
    for seed in SEEDS:
        arguments = ["evaluate", "--checkpoint", str(study / "rta" / f"seed{seed}" / "policy.pt")]
        arguments += ["--config", str(settings), "--episodes", "1", "--json", str(tmp_path / "one.json")]
        assert main.main(arguments) == 0
        alone.append(read(tmp_path / "one.json"))
    flown = found["harsh"]["rta"]["robust"]
    for name in ("reward", "delta_v_m_s"):
        assert flown["metrics"][name]["mean"] == pytest.approx(
            np.mean([each["metrics"][name]["mean"] for each in alone])
        )
    # the model and no filter: the study's own flight, of its first case alone
    episodes = np.load(study / "no_rta" / "episodes.npz")
    first = episodes["metrics"][episodes["metric_names"].tolist().index("reward"), :, 0]
    mean = found["nominal"]["no_rta"]["off"]["metrics"]["reward"]["mean"]
    assert mean == pytest.approx(first.mean())
    assert found["nominal"]["no_rta"]["off"] != found["harsh"]["no_rta"]["off"]


def test_arms_fly_side_by_side_as_they_fly_alone(study: Path) -> None:
    """Bit for bit, in a plant whose errors are drawn by the columns' numbers."""
    arms = agents.load(study, None)
    told = load(flights.BOUNDS, Config()).uncertainty
    together = flights.in_world(list(arms.values()), "harsh", True, told)
    assert together == [flights.in_world([arm], "harsh", True, told)[0] for arm in arms.values()]
    assert together[0]["metrics"] != together[1]["metrics"]


def test_only_arms_of_one_task_fly_side_by_side(study: Path) -> None:
    arms = agents.load(study, None)
    rta = arms["rta"]
    others = {
        "period": {"rta": replace(rta.config.rta, period=5.0)},  # in all worlds it is one second
        "gain": {"rta": replace(rta.config.rta, speed_gain=0.11)},
        "task": {"inspection": replace(rta.config.inspection, max_time=10.0)},
        "price": {"train": replace(rta.config.train, learn_from="penalty")},
        "network": {"ppo": replace(rta.config.ppo, hidden=(32, 32))},
    }
    arms |= {name: replace(rta, config=replace(rta.config, **parts)) for name, parts in others.items()}
    groups = flights.side_by_side(arms | {"seeds": replace(rta, digests={"seed5": ""})})
    assert groups == [["no_rta", "rta", "period"], ["gain"], ["task"], ["price"], ["network"], ["seeds"]]


def test_the_episode_that_violates_most_is_a_success_that_does(tmp_path: Path) -> None:
    path = tmp_path / "episodes.npz"
    outcome = np.array([[0, 1, 1], [1, 1, 0]])  # of two seeds and three cases

    def found(shares: list[list[float]]) -> tuple[int, int] | None:
        names = {"outcome_names": np.array(["crash", "success"])}
        np.savez(path, outcome=outcome, violation_seconds=np.array([[[9.0] * 3] * 2, shares]), **names)
        return flights.worst_success(path)

    assert found([[90.0, 1.0, 2.0], [5.0, 3.0, 80.0]]) == (1, 0)
    assert found([[90.0, 0.0, 0.0], [0.0, 0.0, 80.0]]) is None


def test_the_episode_of_a_seed_and_a_case_is_the_studys(study: Path) -> None:
    flown = flights.violation(agents.load(study, None)["no_rta"], 1, CASES - 1)
    assert (int(flown["seed"]), int(flown["case"])) == (SEEDS[1], CASES - 1)
    with np.load(study / "no_rta" / "episodes.npz") as episodes:
        metrics = dict(zip(episodes["metric_names"].tolist(), episodes["metrics"], strict=True))
    assert flown["inspected_score"][-1] == pytest.approx(metrics["inspected_score"][1, CASES - 1])


def test_an_older_revisions_study_is_refused(study: Path, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text((study / "config.toml").read_text())
    results = read(study / "results.json")
    del results["arms"]["rta"]["outcomes"]["clean_success"]
    (tmp_path / "results.json").write_text(json.dumps(results))
    with pytest.raises(InputError, match="rta was evaluated by an older revision"):
        agents.load(tmp_path, None)


def test_every_arm_of_the_shipped_study_can_fly_in_every_world() -> None:
    config = load(flights.ROOT / "configs" / "study.toml", StudyConfig())
    told = load(flights.BOUNDS, Config()).uncertainty
    for name in config.study.arms:
        own = replace(flights.with_rta(config.of_arm(name), True, flights.FILTER_PERIOD), uncertainty=told)
        own = replace(own, train=replace(own.train, compile="off"))  # which takes minutes and refuses nothing
        Experiment(own, 1).env(1, [torch.Generator()])


@pytest.mark.parametrize(
    ("agents", "guided", "kept"), [("a", "g", True), ("b", "g", False), ("a", "h", False)]
)
def test_what_was_flown_by_other_agents_or_another_guidance_is_dropped(
    agents: str, guided: str, kept: bool, tmp_path: Path
) -> None:
    todo = {"guidance.json": ("", dict)}
    compute.begin(tmp_path, {"rta": {"seed0": "a"}, "guidance": {"quick": "g"}}, todo)
    (tmp_path / "guidance.json").touch()
    compute.begin(tmp_path, {"rta": {"seed0": agents}, "guidance": {"quick": guided}}, todo)
    assert (tmp_path / "guidance.json").exists() == kept


def test_the_front_is_of_the_guidance_that_leads_the_sun(study: Path) -> None:
    found = read(study / "report" / "front.json")
    assert list(found) == ["even", "quick"]
    assert {each["episodes"] for each in found.values()} == {CASES}


def test_progress_ends_at_the_weight_that_the_study_found(study: Path) -> None:
    arms = read(study / "results.json")["arms"]
    found = read(study / "report" / "progress.json")
    assert list(found) == ["no_rta", "rta", "guidance"]
    for name, results in arms.items():
        assert found[name]["time_s"] == [0.0, DURATION, 2 * DURATION]
        # every episode lasts one step, and keeps its weight from then on
        last = results["metrics"]["inspected_score"]["iqm"]
        assert found[name]["weight"][1:] == pytest.approx([last, last])


def test_guidance_meets_the_common_cases_behind_the_filter(study: Path) -> None:
    guidance = read(study / "report" / "guidance.json")
    assert (guidance["episodes"], guidance["seed"], guidance["rta"]["period_s"]) == (CASES, 0, 1.0)


@pytest.mark.parametrize("rta", [False, True])
def test_episodes_are_those_of_simulate(rta: bool, study: Path, tmp_path: Path) -> None:
    arm = "rta" if rta else "no_rta"
    agent = ["--controller", "policy", "--checkpoint", str(study / arm / "seed5" / "policy.pt")]
    classical = ["--controller", "lqr-pd", "--initial-state", str(flights.DEMONSTRATION)]
    settings = tmp_path / "settings.toml"  # as the study has them
    settings.write_text(f"[inspection]\naction_period = {DURATION}\nmax_time = {DURATION}")
    classical += ["--config", str(settings)]
    filtered = ["--rta" if rta else "--no-rta", "--rta-period", "1", "--qp-solver", "batched"]
    for name, flags in (("episode", agent), ("demonstration", classical)):
        arguments = ["simulate", *flags, *filtered, "--duration", str(DURATION), "--out"]
        assert main.main([*arguments, str(tmp_path / "one.npz")]) == 0
        expected, ours = np.load(tmp_path / "one.npz"), np.load(study / "report" / f"{name}_{arm}.npz")
        assert ours.files == expected.files
        assert (ours["time"] == np.arange(DURATION + 1)).all()
        for array in ours.files:
            kept = expected[array].astype(ours[array].dtype)  # single precision, where it is a float
            np.testing.assert_array_equal(ours[array], kept, array)


def test_an_interrupted_report_keeps_what_it_has_computed(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = copy / "report"
    whole = contents(report)
    absent = [name for name in FILES if name.startswith("demonstration")]
    for name in (*absent, "episode_rta.npz"):
        (report / name).unlink()

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(flights, "demonstration", interrupted)
        with pytest.raises(KeyboardInterrupt):
            compute.compute(copy)
    assert contents(report).keys() == whole.keys() - set(absent)
    monkeypatch.setattr(flights, "play", None)
    monkeypatch.setattr(flights, "common_episode", None)
    compute.compute(copy)
    assert contents(report).keys() == whole.keys()


def test_other_policies_are_computed_anew(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "PERIODS", (5.0,))
    monkeypatch.setattr(flights, "WORLDS", ())
    before = contents(copy / "report")
    shutil.copy(copy / "rta" / "seed6" / "policy.pt", copy / "rta" / "seed5" / "policy.pt")
    compute.compute(copy)
    after = contents(copy / "report")
    for name in ("policies.json", "cross.json", "frequency.json", "episode_rta.npz"):
        assert before[name] != after[name]
    old, new = (json.loads(files["cross.json"]) for files in (before, after))
    assert new["no_rta"] == old["no_rta"]
    old_rate, new_rate = (json.loads(files["frequency.json"])["5"] for files in (before, after))
    assert new_rate["metrics"] != old_rate["metrics"]
    assert new["rta"]["off"]["metrics"] != old["rta"]["off"]["metrics"]


@pytest.mark.parametrize("arm", ["no_rta", "rta"])
def test_a_study_of_one_arm_has_a_report_of_one_arm(
    arm: str, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "evaluate", lambda arm, rta, period: arm.results)
    monkeypatch.setattr(flights, "WORLDS", ("nominal",))
    other = {"no_rta": "rta", "rta": "no_rta"}[arm]
    for directory in ("report", other):
        shutil.rmtree(copy / directory)
    results = {"arms": {arm: read(copy / "results.json")["arms"][arm]}}
    (copy / "results.json").write_text(json.dumps(results))
    compute.compute(copy)
    tables.write(inputs.read(copy))
    absent = {f"episode_{other}.npz"} | ({"frequency.json"} if arm == "no_rta" else set())
    assert contents(copy / "report").keys() & FILES == FILES - absent
    assert set(read(copy / "report" / "cross.json")) == {arm}


def damage(directory: Path, name: str) -> None:
    """Makes one of the ways in which a directory holds no finished study."""
    if name == "unfinished":
        (directory / "results.json").unlink()
    elif name == "not results":
        (directory / "results.json").write_text('{"arms": {"rta": 1}}')
    elif name == "no arm":
        (directory / "results.json").write_text('{"arms": {}}')
    elif name == "no policy":
        (directory / "rta" / "seed6" / "policy.pt").unlink()
    elif name == "occupied":
        shutil.rmtree(directory / "report")
        (directory / "report").touch()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("unfinished", "no finished study there"),
        ("not results", "not the results of a study"),
        ("no arm", "holds no finished arm"),
        ("no policy", "no such checkpoint"),
        ("occupied", "cannot write there"),
    ],
)
def test_what_is_no_finished_study_is_refused(
    name: str, words: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copy, name)
    capsys.readouterr()
    assert main.main(["report", "--study", str(copy)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert words in err
    assert str(copy) in err


def test_an_arm_that_is_not_finished_is_named(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = read(copy / "results.json")
    del results["arms"]["rta"]
    (copy / "results.json").write_text(json.dumps(results))
    assert list(compute.load(copy, None)) == ["no_rta"]
    assert "rta is not finished and is left out" in capsys.readouterr().err


def test_a_demonstration_is_flown_as_its_name_says(study: Path) -> None:
    todo = compute.work(study, compute.load(study, None))
    flown = {name: make.args[-1] for name, (_, make) in todo.items() if name.startswith("demonstration")}
    assert flown == {"demonstration_no_rta.npz": False, "demonstration_rta.npz": True}
