"""What has been verified is silent; whatever else is said in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import main
from inspection.model.parameters import Episode, InspectionParameters, Limits
from rta.parameters import PERIODS
from settings import override, rules, to_toml
from study import verified
from study.config import Config, StudyConfig
from study.export import filter as filter_in_c
from study.files import ROOT
from study.verification.findings import Campaign, empty_report
from study.verified import doubt, fingerprint
from tests.test_main import assert_refused

FAST = {"inspection": {"max_rate": 0.3}}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory without reports of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def configured(tables: dict[str, Any]) -> Config:
    return override(Config(), tables, "test")


def put(config: Config, policy: str, **more: Any) -> None:
    """A report of a person's own."""
    campaign = Campaign(policy, 1.0, 2000, 0, 1024)
    Path("runs/verification").mkdir(parents=True, exist_ok=True)
    report = empty_report(campaign, config) | {"episodes": 1000} | more
    Path(f"runs/verification/{policy}.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    "path", sorted((ROOT / "runs" / "reference").glob("[vf]*/*.json")), ids=lambda p: p.stem
)
def test_the_shipped_reports_hold_the_fingerprint_of_their_rules(path: Path) -> None:
    report = json.loads(path.read_text())
    assert report["fingerprint"] == fingerprint(override(Config(), report["config"], "test"))


@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"rta": {"qp_solver": "piqp"}},
        {
            "inspection": {
                "points_reward": 2.0,
                "num_points": 50,
                "max_time": 500.0,
                "initial_radius": [60.0, 200.0],
            }
        },
        {"ppo": {"gamma": 0.9}, "train": {"seed": 3}},
        {"plant": {"noise_bound": 2.0, "missed_in_a_row": 1}},  # of what there is not
    ],
)
def test_what_changes_neither_plant_nor_filter_is_silent(tables: dict[str, Any]) -> None:
    assert fingerprint(configured(tables)) == fingerprint(Config())
    assert doubt(configured(tables)) is None


def test_of_the_task_all_but_the_episode_counts() -> None:
    names = {name.split()[1] for name in verified.relevant(Config()) if name.startswith("[inspection]")}
    assert names == {*rules(Limits)} == {*rules(InspectionParameters)} - {*rules(Episode)}
    assert {"substep", "initial_energy", "initial_temperature"} < names  # which campaigns begin and step with


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (FAST, ["not verified: [inspection] max_rate = 0.3 (verified: 0.0349066);"]),
        ({"inspection": {"saturate_rates": False}}, ["saturate_rates = false (verified: true);"]),
        ({"inspection": {"mass": 12.0000001}}, ["mass = 12.0000001 (verified: 12.0);"]),
        ({"rta": {"battery_gains": [0.004, 0.2]}}, ["battery_gains = [0.004, 0.2] (verified: [0.004, 0.1])"]),
        (FAST | {"rta": {"period": 5.0, "speed_gain": 0.4}}, ["max_rate = 0.3", ", 1 more differ;"]),
        ({"plant": {"mass_factor": 1.1}}, ["not verified: [plant] mass_factor = 1.1 (verified: 1);"]),
        ({"plant": {"latency": [0, 2]}}, ["[plant] latency = [0, 2] (verified: 0);"]),
        ({"plant": {"rate_noise": 0.1, "noise_bound": 2.0}}, ["[plant] rate_noise = 0.1", ", 1 more differ"]),
        ({"rta": {"period": 5.0, "speed_gain": 0.4}}, ["not verified: [rta] speed_gain = 0.4 "]),
    ],
)
def test_what_differs_is_said_with_both_values(tables: dict[str, Any], words: list[str]) -> None:
    line = doubt(configured(tables))
    assert line and "\n" not in line and verified.PAGE in line
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("more", "trusted"),
    [
        ({}, True),
        ({"episodes": 999}, False),
        ({"campaign": {"policy": "adversarial", "duration": 1999}}, False),
        ({"campaign": {"policy": "checkpoint:x.pt", "duration": 2000}}, False),
        ({"unsolved": 1}, False),
        ({"violating_episodes": {"any": 1}}, False),
    ],
)
def test_two_large_and_clean_campaigns_are_needed(more: dict[str, Any], trusted: bool) -> None:
    config = configured(FAST)
    put(config, "random")
    assert doubt(config)
    put(config, "adversarial", **more)
    assert (doubt(config) is None) == trusted


@pytest.mark.parametrize("period", PERIODS)
def test_the_shipped_campaigns_verify_every_period(period: float) -> None:
    assert doubt(configured({"rta": {"period": period}})) is None


def test_a_hull_counts_by_what_its_file_holds_wherever_it_lies(elsewhere: Path) -> None:
    def of(mesh: str, **chief: Any) -> str:
        return fingerprint(configured({"chief": {"mesh": mesh, "collision": "hull"} | chief}))

    name = "configs/chiefs/box.npz"
    shipped = of(name)
    assert of(str(ROOT / name)) == shipped == of(name, moments=[1.0, 0.9, 0.8])
    assert of(name, attitude=[0.0, 0.0, 1.0, 0.0]) != shipped
    (elsewhere / "configs/chiefs").mkdir(parents=True)
    np.savez(elsewhere / name, triangles=np.load(ROOT / name)["triangles"] * 1.1)
    assert of(name) != shipped
    line = doubt(configured({"chief": {"mesh": name, "collision": "hull"}}))
    assert line and f'[chief] mesh = "{name}" (verified: "' in line


def test_reports_of_another_plant_verify_none() -> None:
    heavy, noisy = (configured({"plant": plant}) for plant in ({"mass_factor": 1.1}, {"position_noise": 0.2}))
    for policy in verified.POLICIES:
        put(heavy, policy)
    assert doubt(heavy) is None
    assert "mass_factor = 1 (verified: 1.1)" in doubt(noisy) or "position_noise" in doubt(noisy)
    assert doubt(configured({"plant": {"mass_factor": [1.0, 1.1]}}))
    assert doubt(Config()) is None
    put(heavy, "random", violating_episodes={"any": 7})
    assert "not safe" in doubt(heavy)
    assert doubt(Config()) is None


def test_violations_and_damaged_files_are_told_apart() -> None:
    config = configured(FAST)
    put(config, "random", violating_episodes={"any": 7})
    for i, text in enumerate(("{", "[]", '{"config": 3}', '{"config": {"rta": {"colour": 1}}}')):
        Path(f"runs/verification/{i}.json").write_text(text)
    put(config, "adversarial", violating_episodes={"any": "many"})
    line = doubt(config)
    assert line and "7 of 1,000 episodes behind this filter violated" in line
    assert str(Path("runs/verification/random.json")) in line


def test_verify_passes_over_the_table_of_a_study(capsys: pytest.CaptureFixture[str]) -> None:
    Path("study.toml").write_text(to_toml(StudyConfig()))
    words = ["--config", "study.toml", "--rta-period", "10", "--duration", "25"]
    assert_refused(["verify", *words], ["--duration 25", "10 s"], capsys)


@pytest.mark.parametrize(
    ("what", "tables"),
    [
        (None, {}),
        (None, {"uncertainty": {"torque_gain": 0.1}}),
        ("motion", {"uncertainty": {"thrust_quantum": 1.0}}),
        ("attitude", {"uncertainty": {"torque_gain": 0.6, "rate": 0.2}}),
        ("motion and attitude", {"uncertainty": {"health": True}}),
        ("motion and attitude", {"inspection": {"orbit": "two-body"}}),
        (None, {"chief": {"mesh": "configs/chiefs/box.npz", "collision": "hull"}}),
    ],
)
def test_what_a_filter_does_not_check_is_said_in_a_line(
    what: str | None, tables: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    config = configured(tables)
    verified.say_unchecked(config)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(";")[0] for line in lines] == [f"not checked: {what}"] * (what is not None)
    assert (filter_in_c.said_of(config).count(lines[0]) if lines else 0) == len(lines)
    verified.say_unchecked(configured(tables | {"train": {"rta": False}}))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("why", "tables"),
    [
        (None, {}),
        (None, {"train": {"keep_clear": True}}),
        ("there is none", {"train": {"keep_clear": True, "rta": False}}),
        ("no free flight is known", {"train": {"keep_clear": True}, "uncertainty": {"position": 0.1}}),
    ],
)
def test_it_is_said_where_free_flights_are_not_kept_clear_though_asked_for(
    why: str | None, tables: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    verified.say_unchecked(configured(tables))
    said = [line for line in capsys.readouterr().err.splitlines() if "keep_clear" in line]
    assert len(said) == (why is not None) and all("ignored" in line and str(why) in line for line in said)


def test_without_the_filter_nothing_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    verified.say_doubts(configured(FAST | {"train": {"rta": False}}))
    assert capsys.readouterr().err == ""
    verified.say_doubts(configured(FAST))
    assert capsys.readouterr().err.startswith("not verified: ")


def test_verify_flies_as_much_as_counts() -> None:
    given = main.build_parser().parse_args(["verify"])
    assert (given.episodes, given.duration) == (verified.EPISODES, verified.DURATION)
