"""The paper's filter wherever a filter goes: experiment, flights, campaigns, the commands that need another one."""

from pathlib import Path

import numpy as np
import pytest
import torch

from interfaces.safety import VectorRunTimeAssurance
from interfaces.vector import VectorInspection6DoF
from main import main
from rta.filter import SafetyFilter
from rta.limits import PAPER
from rta.parameters import PERIODS, RtaParameters
from rta.result import Status
from settings import InputError, override
from study.config import Config, StudyConfig
from study.experiment import Experiment, checked_filter, filter_of
from study.flight.evaluation import play_controller, report
from study.flight.offline_filter import filter_states
from study.machine import finds_compiler
from study.verification.starts import initial_states
from study.verified import unchecked, why_unverified
from tests.support.flights import commands


def made(**tables: dict[str, object]) -> Config:
    own = {"train": {"device": "cpu", "compile": "off"}, "rta": {"filter": "paper"}}
    return override(override(Config(), own, "test"), tables, "test")


def papers(period: float) -> SafetyFilter:
    return SafetyFilter(parameters=RtaParameters(filter="paper", period=period))


def test_a_configuration_gets_the_filter_that_it_asks_for() -> None:
    paper = filter_of(made(rta={"period": 5.0}))
    assert paper.check is None and paper.period == 5.0 and paper.limits == PAPER
    assert all(filter_of(Config()).checked)
    assert made().rta.solver == "piqp"
    experiment = Experiment(made(), 2, seconds=1.0)
    assert experiment.safety.names == experiment.filter.names and experiment.safety.correct is not None
    assert Experiment(made(train={"rta": False}), 2, seconds=1.0).safety.correct is None


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"uncertainty": {"position": 0.1}}, r"knows no \[uncertainty\]"),
        ({"chief": {"mesh": "configs/chiefs/box.npz", "collision": "hull"}}, "beside a hull"),
    ],
)
def test_what_the_papers_filter_does_not_know_is_refused(tables: dict[str, dict], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Experiment(made(**tables), 2, seconds=1.0)


def test_a_solver_that_caps_weights_is_refused() -> None:
    with pytest.raises(ValueError, match="qp_solver"):
        RtaParameters(filter="paper", qp_solver="batched")


def test_an_arm_behind_another_filter_has_a_solver_of_its_own() -> None:
    study = override(
        StudyConfig(),
        {
            "train": {"compile": "on"},
            "study": {"arms": ["rta", "paper"]},
            "arms": {"paper": {"rta": {"filter": "paper"}}},
        },
        "test",
    )
    solvers = [study.of_arm(name).rta.solver for name in ("rta", "paper")]
    assert solvers == ["batched", "piqp"]


@pytest.mark.parametrize(
    "words",
    [
        ["export", "--filter", "runs/none"],
        ["play", "--out", "runs/none.html"],
        ["verify", "--policy", "random", "--filter", "c", "--episodes", "1", "--duration", "10"],
    ],
)
def test_commands_that_need_a_check_say_so(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--rta-filter", "paper"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ") and "filter" in said and "checked" in said


def test_a_person_is_told_that_nothing_is_checked() -> None:
    assert "the paper's filter has no check" in (unchecked(made()) or "")
    for period in PERIODS:  # as shipped campaigns found
        said = why_unverified(made(rta={"period": period})) or ""
        assert said.startswith("not safe") and "behind this filter violated a constraint" in said
    with pytest.raises(InputError, match='must be "checked"'):
        checked_filter(made())


def test_a_compiled_environment_reports_the_limits_that_the_filter_has() -> None:
    """What is compiled with a filter inside must not be what a compiled filter has computed."""
    if not finds_compiler():
        pytest.skip("no C compiler")
    experiment = Experiment(made(train={"compile": "on"}), 16)
    assert experiment.filter_compiled
    env = experiment.env(16, compiled=True)
    env.reset()
    torch.testing.assert_close(env.constraint_values(env.x), papers(1.0).values(env.x))


def test_episodes_are_flown_behind_it_and_counted() -> None:
    experiment = Experiment(made(inspection={"max_time": 100.0}), 4, seconds=100.0)
    record = play_controller("random", experiment, 4, 0)
    found = report(record, experiment.config, 0)
    assert found["rta"]["period_s"] == 1.0 and found["rta"]["intervention_percent"] > 50.0
    assert found["config"]["rta"]["filter"] == "paper"


def test_all_starts_of_a_campaign_count() -> None:
    paper = papers(10.0)
    x, _, left_out = initial_states(20, 0, paper)
    assert paper.is_safe(x).all() and left_out >= 0


def test_the_gymnasium_wrapper_reports_its_calls() -> None:
    config = made(rta={"period": 5.0})
    env = VectorRunTimeAssurance(VectorInspection6DoF(3, config))
    env.reset(seed=0)
    *_, info = env.step(np.ones((3, 6), dtype=np.float32))
    assert info["status"].shape == (3, 2) and not info["verified"].any()
    assert env.filter.check is None


def test_given_states_are_filtered_with_every_number_of_the_program(tmp_path: Path) -> None:
    """A control that satisfies its rows, with the slack that is said."""
    paper = papers(1.0)
    x = initial_states(40, 1, paper)[0]
    found = filter_states(paper, x, commands(40, largest=2.0))
    a, b, u, slack = (found[name] for name in ("A", "b", "control_safe", "slack"))
    assert a.shape == (40, 13, 6)
    left = (a * u[:, None]).sum(2) + b
    solved = found["status"] < Status.UNSOLVED
    assert solved.any() and (left[solved] >= slack[solved] - 1e-6).all()
    assert np.isinf(found["slack_weight"][0]) and (found["slack_weight"][1:] == 1e12).all()
    assert not found["verified"].any() and list(found["constraints"]) == list(paper.names)
