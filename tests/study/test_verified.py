"""What has been verified is silent; whatever else is said in one line."""

import json
from pathlib import Path
from typing import Any

import pytest

from rta.parameters import PERIODS
from settings import override
from study import verified
from study.config import Config, of_today
from study.export import filter as filter_in_c
from study.files import ROOT
from study.verification.findings import Campaign, empty_report
from study.verified import fingerprint, why_unverified

FAST = {"inspection": {"max_rate": 0.3}}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a working directory without reports of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def configured(tables: dict[str, Any]) -> Config:
    return override(Config(), tables, "test")


def put(config: Config, policy: str, **more: Any) -> None:
    """Writes a report of a person's own."""
    campaign = Campaign(policy, 1.0, 2000, 0, 1024)
    Path("runs/verification").mkdir(parents=True, exist_ok=True)
    report = empty_report(campaign, config) | {"episodes": 1000} | more
    Path(f"runs/verification/{policy}.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    "path",
    sorted((ROOT / "runs/reference").glob("verification/*.json"))
    + sorted((ROOT / "runs/reference").glob("frequency/*.json"))
    + sorted((ROOT / "runs/reference").glob("paper_filter/*.json")),
    ids=lambda p: p.stem,
)
def test_the_shipped_reports_hold_the_fingerprint_of_their_rules(path: Path) -> None:
    report = json.loads(path.read_text())
    assert report["fingerprint"] == fingerprint(override(Config(), of_today(report["config"]), "test"))


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
        {"plant": {"noise_bound": 2.0, "missed_in_a_row": 1}},  # of effects that are not there
    ],
)
def test_what_changes_neither_plant_nor_filter_is_silent(tables: dict[str, Any]) -> None:
    assert fingerprint(configured(tables)) == fingerprint(Config())
    assert why_unverified(configured(tables)) is None


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (FAST, ["not verified: [inspection] max_rate = 0.3 (verified: 0.0349066);"]),
        ({"inspection": {"initial_energy": [4.0, 6.0]}}, ["initial_energy = [4, 6] (verified: [5, 7])"]),
        (
            FAST | {"rta": {"period": 5.0}, "plant": {"mass_factor": 1.1}},
            ["max_rate = 0.3", ", 1 more differ;"],
        ),
        ({"plant": {"mass_factor": 1.1}}, ["not verified: [plant] mass_factor = 1.1 (verified: 1);"]),
    ],
)
def test_what_differs_is_said_with_both_values(tables: dict[str, Any], words: list[str]) -> None:
    line = why_unverified(configured(tables))
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
        ({"campaign": {"policy": "adversarial", "duration": 2000, "starts": "limits"}}, False),
        ({"violating_episodes": {"any": 1}}, False),
        ({"gains": "0123456789ab"}, False),
    ],
)
def test_two_large_and_clean_campaigns_are_needed(more: dict[str, Any], trusted: bool) -> None:
    config = configured(FAST)
    put(config, "random")
    assert why_unverified(config)
    put(config, "adversarial", **more)
    assert (why_unverified(config) is None) == trusted


@pytest.mark.parametrize("period", PERIODS)
def test_the_shipped_campaigns_verify_every_period(period: float) -> None:
    assert why_unverified(configured({"rta": {"period": period}})) is None


@pytest.mark.parametrize(
    ("what", "tables"),
    [
        (None, {}),
        (None, {"uncertainty": {"torque_gain": 0.1}}),
        ("motion", {"uncertainty": {"thrust_quantum": 1.0}, "rta": {"unverified": True}}),
        ("motion and attitude", {"inspection": {"hill_rotation": True}, "rta": {"unverified": True}}),
        (None, {"chief": {"mesh": "configs/chiefs/box.npz", "collision": "hull"}}),
    ],
)
def test_what_a_filter_does_not_check_is_said_in_a_line(
    what: str | None, tables: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    config = configured(tables)
    verified.warn_if_unchecked(config)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(";")[0] for line in lines] == [f"not checked: {what}"] * (what is not None)
    assert (filter_in_c.said_of(config).count(lines[0]) if lines else 0) == len(lines)
    verified.warn_if_unchecked(configured(tables | {"train": {"rta": False}}))
    assert capsys.readouterr().err == ""


def test_without_the_filter_nothing_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    verified.warn_if_unverified(configured(FAST | {"train": {"rta": False}}))
    assert capsys.readouterr().err == ""
    verified.warn_if_unverified(configured(FAST))
    assert capsys.readouterr().err.startswith("not verified: ")
