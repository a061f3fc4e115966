"""A report in its file: what it holds, how a longer campaign goes on with it, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from study.files import ROOT
from study.verification import campaign, findings
from study.verification.starts import initial_states
from tests.rta.test_barrier import FILTER
from tests.test_main import assert_refused, call

NEWER = {"check_every", "candidates", "horizon"}  # of a campaign


def verify(path: Path, *more: str) -> list[str]:
    flags = ["--compile", "on", "--device", "cpu", "--json", str(path)]
    return ["verify", "--episodes", "16", "--duration", "20", *flags, *more]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a finished campaign."""
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
    assert report["starts_beyond_braking"]["episodes"] == 0
    assert list(finished.parent.iterdir()) == [finished]


def test_a_worst_case_is_found_again_from_its_seed(finished: Path) -> None:
    report = json.loads(finished.read_text())
    for case in report["worst_case"].values():
        x, priority, _ = initial_states(case["batch_size"], case["batch_seed"], FILTER)
        np.testing.assert_array_equal(x[:, case["column"]], case["initial_state"])
        np.testing.assert_array_equal(priority[:, case["column"]], case["priority"])
    assert len({case["column"] for case in report["worst_case"].values()}) > 3


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


def test_a_finished_report_flies_nothing_more(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    monkeypatch.setattr(campaign, "fly", lambda *_: pytest.fail("flew"))
    code, out, err = call(verify(finished), capsys)
    assert code == 0, err
    assert "16 episodes, 336 steps" in out
    assert finished.read_bytes() == before


def test_a_report_that_holds_more_than_asked_for_says_so(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    code, out, err = call(verify(finished, "--episodes", "8"), capsys)
    assert code == 0 and "16 episodes" in out
    assert f"{finished}: holds 16 episodes already, more than asked for" in err
    assert finished.read_bytes() == before


def test_a_longer_campaign_goes_on_where_the_report_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the middle of a batch, over the next one's beginning and past starts beyond braking."""
    monkeypatch.setattr(campaign, "BATCH", 16)
    monkeypatch.setattr(SafetyFilter, "can_brake", lambda _, x: x[6].abs() < 0.6)
    texts = []
    for path, counts in ((tmp_path / "on.json", (5, 9, 18)), (tmp_path / "once.json", (18,))):
        for count in counts:
            assert call(verify(path, "--episodes", str(count)), capsys)[0] == 0
            assert json.loads(path.read_text())["episodes"] == count
        texts.append(json.loads(path.read_text()))
    beyond = texts[0]["starts_beyond_braking"]
    assert beyond["episodes"] > 0 and beyond["steps"] == 21 * beyond["episodes"]
    # the rounding of other batch sizes
    for name in CONSTRAINTS:
        for tally in ("worst_value", "largest_slack"):
            assert texts[0][tally].pop(name) == pytest.approx(texts[1][tally].pop(name), rel=1e-9, abs=1e-9)
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
        ["--policy", "adversarial"],
        ["--rta-period", "10"],
        ["--duration", "30"],
        ["--check-every", "0.5"],
    ],
)
def test_another_campaigns_report_is_refused(
    other: list[str], finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    assert_refused(verify(finished, *other), [str(finished), "another campaign"], capsys)
    assert finished.read_bytes() == before


@pytest.mark.parametrize("text", ["{", "[]", "{}", "3"])
def test_what_is_no_report_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "report.json"
    path.write_text(text)
    assert_refused(verify(path), [str(path), "no report"], capsys)


def test_the_text_fits_into_100_columns(finished: Path, tmp_path: Path) -> None:
    """With numbers as they are after many episodes, and all that can stand beside them."""
    report = json.loads(finished.read_text())
    large = {name: 123_456_789 for name in (*CONSTRAINTS, "any")}
    report |= {
        "violating_steps": large,
        "violating_episodes": large,
        "worst_value": dict.fromkeys(CONSTRAINTS, -1.2345e-123),
        "yielded_calls": large,
        "steps": 10**12,
        "episodes": 10**9,
        "unsolved": 10**9,
        "backup_calls": 10**9,
        "filter_calls": dict.fromkeys(report["filter_calls"], 10**12),
        "slack_together": {"all": {"calls": 10**8, "largest_slack": dict.fromkeys(CONSTRAINTS, 1.2e-123)}},
    }
    report["starts_beyond_braking"] |= {
        name: report[name] for name in ("violating_steps", "violating_episodes", "worst_value")
    }
    lines = findings.table(report).splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("angular_velocity_z" in line for line in lines) == 3  # nothing is cut off


def test_what_next_names_the_report_and_a_counter_example(finished: Path, tmp_path: Path) -> None:
    report, path = json.loads(finished.read_text()), tmp_path / "my report.json"
    assert findings.what_next(report, path).splitlines() == [
        f"Written to {path}; a larger --episodes goes on from there"
    ]
    assert "--json F keeps" in findings.what_next(report, None)
    report["violating_episodes"]["battery"] = 1
    Path(f"{path}.battery.npz").touch()
    assert findings.what_next(report, path).splitlines()[1:] == [
        f"The worst episodes, first those with violations: {path}.CONSTRAINT.npz of battery",
        f"Fly one again: python main.py refly '{path}.battery.npz'",
    ]
