"""The field: what an arm broke in training, of all its seeds together, and how it learned."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from experiments import field
from settings import InputError
from study.config import EVALUATION_CASES, TEST_CASES
from study.experiment import Experiment
from study.files import ROOT
from study.flight.evaluation import evaluate
from study.report.flights import with_rta
from study.report.inputs import Arm, load_arm

pytestmark = pytest.mark.usefixtures("small_pools")


def test_exposure_adds_the_steps_of_seeds_and_keeps_the_smallest_h() -> None:
    def seed(interactions: int, percent: float, h: float) -> dict[str, object]:
        return {
            "interactions": interactions,
            "violations_percent": {"battery": percent, "any": 2.0 * percent},
            "smallest_h": {"battery": h},
        }

    found = field.exposure({"training_per_seed": [seed(1000, 10.0, -3.0), seed(200, 5.0, 0.5)]})
    assert found == {
        "steps": 1200,
        "violated": {"battery": 110, "any": 220},
        "smallest_h": {"battery": -3.0},
    }


def test_curves_have_a_row_for_a_time_and_a_column_for_a_seed() -> None:
    path = ROOT / "runs/reference/study/rta/evaluations.jsonl"
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    found = field.curves(path)
    for number, time in enumerate(found["interactions"]):
        then = [line for line in lines if line["interactions"] == time]
        assert found["reward"][number] == [line["metrics"]["reward"]["mean"] for line in then]
        assert found["success"][number] == [100.0 * line["outcomes"]["success"] for line in then]
        assert found["violations"][number] == [line["violations_percent"]["any"] for line in then]
    assert len(found["interactions"]) == 4 and len(found["reward"][0]) == 10


def test_a_figure_draws_every_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    rising = [[0.0, 1.0, 5.0], [50.0, 60.0, 90.0]]
    curves = {"interactions": [0, 1_000_000]} | dict.fromkeys(field.SHOWN, rising)
    arms = {name: {"curves": curves, "filtered": name == "rta"} for name in ("plain", "rta")}
    guided = {"metrics": {"reward": {"mean": 7.0}, "delta_v_m_s": {"mean": 7.0}}}
    field.figure(arms, guided, tmp_path / "figure.png")
    for axis, name in zip(drawn[0].axes, field.SHOWN, strict=True):
        assert [line.get_linestyle() for line in axis.lines[:2]] == ["--", "-"]  # without and with the filter
        learned, beside = axis.lines[:2], axis.lines[2:]
        assert [line.get_label() for line in learned] == ["no filter", "rta"]
        assert all(line.get_ydata().tolist() == [1.0, 60.0] for line in learned)  # medians
        assert [set(line.get_ydata()) for line in beside] == [{7.0}] * (name in guided["metrics"])
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == [
        "no filter",
        "rta",
        "guidance (even)",
    ]


def test_curves_without_a_seed_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "evaluations.jsonl"
    lines = (ROOT / "runs/reference/study/rta/evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines[:-1]))
    with pytest.raises(InputError, match="not every seed"):
        field.curves(path)


def few(cases: int, seeds: int) -> Arm:
    """Agents from nothing, with the filter, that fly few cases, and not to their ends."""
    shipped = ROOT / "runs/reference/from_nothing"
    results = json.loads((shipped / "results.json").read_text())["arms"]["rta"]
    arm = load_arm(shipped / "rta", results | {"seeds": results["seeds"][:seeds]}, "cpu")
    train = replace(arm.config.train, final_episodes=cases, evaluation_episodes=1, compile="on")
    inspection = replace(arm.config.inspection, max_time=200.0)  # s
    return replace(arm, config=replace(arm.config, train=train, inspection=inspection))


def test_each_seed_is_summed_up_apart() -> None:
    both, lone = (
        {switch: field.flown(few(3, seeds), rta) for switch, rta in field.SWITCHES.items()}
        for seeds in (2, 1)
    )
    for switch, flown in both.items():
        reward = flown["per_seed"]["reward"]
        assert reward[0] == pytest.approx(lone[switch]["per_seed"]["reward"][0], abs=1e-3)
        assert reward[0] != reward[1] and lone[switch]["metrics"]["reward"]["iqm"] == pytest.approx(
            lone[switch]["per_seed"]["reward"][0]
        )
    assert not both["off"]["corrected_percent"] and both["on"]["corrected_percent"] > 0.0
    assert both["on"]["violating_episodes"] == 0


def test_a_controller_is_flown_without_the_filter_and_with_it() -> None:
    config = few(1, seeds=1).config
    found = {switch: field.guided(config, "random", 1, rta) for switch, rta in field.SWITCHES.items()}
    assert not found["off"]["corrected_percent"] and found["off"]["violating_episodes"] == 1
    assert found["on"]["corrected_percent"] > 50.0 and found["on"]["violating_episodes"] == 0


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Returns two studies of an arm of their own, each evaluated once."""
    arms = {"one": few(2, seeds=1), "two": few(2, seeds=2)}
    monkeypatch.setattr(field, "agents_of", lambda study, device: {study.name: arms[study.name]})
    monkeypatch.setattr(field, "CLASSICAL", ("even",))
    line = {
        "interactions": 0,
        "outcomes": {"success": 1.0},
        "violations_percent": {"any": 0.0},
        "metrics": {"reward": {"mean": 1.0}, "delta_v_m_s": {"mean": 1.0}},
    }
    for name, arm in arms.items():
        (directory := tmp_path / name / name).mkdir(parents=True)
        (directory / "evaluations.jsonl").write_text((json.dumps(line) + "\n") * len(arm.digests))
    return [tmp_path / name for name in arms]


def test_studies_are_written_with_the_guidance_beside_them(
    studies: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Any] = []
    monkeypatch.setattr(field, "figure", lambda *given: figures.append(given))
    field.write(studies, tmp_path / "out")
    found = json.loads((tmp_path / "out/results.json").read_text())
    assert {name: arm["seeds"] for name, arm in found["arms"].items()} == {"one": 1, "two": 2}
    for name, arm in found["arms"].items():
        assert arm["training"]["violated"]["any"] == 0 and arm["curves"]["success"] == [
            [100.0] * arm["seeds"]
        ], name
        assert [flown["episodes"] for flown in arm["flown"].values()] == [2 * arm["seeds"]] * 2

    def flown(rta: bool, cases: int, seed: int) -> float:
        config = with_rta(few(2, seeds=1).config, rta, 1.0)
        return evaluate("even", Experiment(config, cases), cases, seed)["metrics"]["reward"]["mean"]

    for switch, guided in found["guidance"]["even"].items():
        assert guided["metrics"]["reward"]["mean"] == flown(field.SWITCHES[switch], 2, TEST_CASES)
    ((_, beside, path),) = figures
    assert path == tmp_path / "out/figure.png"
    assert beside["metrics"]["reward"]["mean"] == flown(True, 1, EVALUATION_CASES)  # the cases of the curves


def test_an_arm_of_two_studies_is_refused(
    studies: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        field.main(["--study", str(studies[0]), str(studies[0]), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert "its arm one is in a study before it, too" in capsys.readouterr().err


def test_a_study_of_other_cases_is_refused(
    studies: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for cases in ({"final_episodes": 3}, {"evaluation_episodes": 2}):
        arm = few(2, seeds=1)
        other = replace(arm, config=replace(arm.config, train=replace(arm.config.train, **cases)))
        arms = {"one": arm, "two": other}
        monkeypatch.setattr(
            field, "agents_of", lambda study, device, arms=arms: {study.name: arms[study.name]}
        )
        with pytest.raises(InputError, match="two: its evaluation_episodes or final_episodes differ"):
            field.write(studies, tmp_path / "out")


def test_a_study_that_did_not_count_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = few(1, seeds=1)
    uncounted = {key: value for key, value in arm.results.items() if key != "training_per_seed"}
    monkeypatch.setattr(field, "agents_of", lambda study, device: {"rta": replace(arm, results=uncounted)})
    with pytest.raises(SystemExit) as stopped:
        field.main(["--study", str(tmp_path), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert "did not count" in capsys.readouterr().err


def test_what_is_no_study_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(SystemExit) as stopped:
        field.main(["--study", str(tmp_path), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert "not the results of a study" in capsys.readouterr().err
