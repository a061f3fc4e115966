"""A report in its file: what it holds, how a longer campaign goes on with it, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rta.names import CONSTRAINTS
from study.files import ROOT
from study.verification import campaign
from tests.test_main import assert_refused, call


def verify(path: Path, *more: str) -> list[str]:
    flags = ["--compile", "on", "--device", "cpu", "--json", str(path)]
    return ["verify", "--episodes", "16", "--duration", "20", *flags, *more]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the report of a finished campaign."""
    import main

    path = tmp_path_factory.mktemp("verify") / "report.json"
    assert main.main(verify(path)) == 0
    return path


def test_verify_writes_the_promised_json(finished: Path) -> None:
    report = json.loads(finished.read_text())
    promised = {
        "episodes",
        "violating_steps",
        "violating_episodes",
        "worst_value",
        "upper_bound_95",
        "unsolved",
    }
    assert promised <= set(report)
    assert set(report["violating_steps"]) == set(report["violating_episodes"]) == {*CONSTRAINTS, "any"}
    assert set(report["worst_value"]) == set(CONSTRAINTS)
    assert (report["episodes"], report["steps"], report["unsolved"]) == (16, 16 * 21, 0)
    assert sum(report["filter_calls"].values()) == 16 * 20
    assert report["violating_steps"]["any"] == 0
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / 16))
    assert list(finished.parent.iterdir()) == [finished]


def test_the_worst_episode_of_every_constraint_is_kept_where_it_is_wanted(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It flies again to the same value, violated or not; a campaign is no other for it."""
    path = tmp_path / "report.json"
    assert call(verify(path, "--keep-worst"), capsys)[0] == 0
    report = json.loads(path.read_text())
    assert report == json.loads(finished.read_text())
    for name in CONSTRAINTS:
        example = Path(f"{path}.{name}.npz")
        assert np.load(example)["value"] == report["worst_value"][name] and example.stat().st_size < 30_000
    code, out, err = call(["refly", f"{path}.collision.npz"], capsys)
    assert code == 0, err
    assert f"recorded {report['worst_value']['collision']:.12g}" in out


def test_a_longer_campaign_goes_on_where_the_report_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the middle of a batch and over the next one's beginning."""
    monkeypatch.setattr(campaign, "BATCH", 16)
    texts = []
    for path, counts in ((tmp_path / "on.json", (5, 9, 18)), (tmp_path / "once.json", (18,))):
        for count in counts:
            assert call(verify(path, "--episodes", str(count)), capsys)[0] == 0
            assert json.loads(path.read_text())["episodes"] == count
        texts.append(json.loads(path.read_text()))
    # the rounding of other batch sizes
    for name in CONSTRAINTS:
        one, other = (text["worst_value"].pop(name) for text in texts)
        assert one == pytest.approx(other, rel=1e-9, abs=1e-9)
    assert texts[0] == texts[1]


@pytest.mark.parametrize("policy", ["random", "adversarial"])
def test_the_reference_reports_can_be_continued(
    policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(shutil.copy(ROOT / "runs" / "reference" / "verification" / f"{policy}.json", tmp_path))
    monkeypatch.setattr("study.machine.finds_compiler", lambda: False)
    monkeypatch.setattr(campaign, "fly", lambda *_: pytest.fail("flew"))
    arguments = ["--policy", policy, "--episodes", "100", "--json", str(path)]
    code, out, err = call(["verify", *arguments], capsys)
    assert code == 0, err
    assert "10,000 episodes, " in out and "holds 10,000 episodes already" in err


@pytest.mark.parametrize(
    "other",
    [
        ["--seed", "1"],
        ["--duration", "30"],
        ["--config", "chiefs/box", "--config", "chiefs/hull"],
    ],
)
def test_another_campaigns_report_is_refused(
    other: list[str], finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    assert_refused(verify(finished, *other, "--compile", "off"), [str(finished), "another campaign"], capsys)
    assert finished.read_bytes() == before


def test_a_report_of_other_limits_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = json.loads(finished.read_text())
    report["violating_episodes"]["total_speed"] = 0
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report))
    assert_refused(verify(path), [str(path), "another campaign"], capsys)
