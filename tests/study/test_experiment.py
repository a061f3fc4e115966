"""What an experiment makes of its configuration: the price on corrections, and the hull to stay clear of."""

import math

import pytest
import torch

from inspection.environment import InspectionEnv
from inspection.model.state import SIZE, THRUST, E, P, Q, V
from settings import override
from study import machine
from study.config import Config
from study.experiment import Experiment, paper_task
from study.flight import evaluation

HULL = {"mesh": "configs/chiefs/box.npz", "collision": "hull"}


def made(**tables: dict[str, object]) -> Config:
    return override(Config(), {"train": {"compile": "off", "device": "cpu"}} | tables, "test")


def test_filter_and_environment_stay_clear_of_the_hull() -> None:
    experiment = Experiment(made(chief=HULL, inspection={"action_period": 1.0}), 2, seconds=1.0)
    env = experiment.env(2)
    for planes in (experiment.filter.c.planes, env.c.planes):
        assert len(planes) > 100
    env.reset()
    env.x[:3] = torch.tensor([[12.0], [0.0], [0.0]])  # within the sphere, beside a flat side of 3 m
    env.x[3:6] = 0.0
    assert (experiment.filter.values(env.x)[0] > 0.0).all()
    transition = env.step(torch.zeros(2, 6))
    assert not transition.terminated.any()


@pytest.mark.parametrize(
    ("leads", "tables"),
    [
        (True, {"train": {"keep_clear": True}}),
        (False, {}),
        (False, {"train": {"keep_clear": True, "rta": False}}),
        (False, {"train": {"keep_clear": True}, "uncertainty": {"position": 0.1}}),
    ],
)
def test_free_flight_is_kept_clear_only_behind_a_filter_of_the_model(
    leads: bool, tables: dict[str, dict[str, object]]
) -> None:
    experiment = Experiment(override(made(), tables, "test"), 2, seconds=1.0)
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    # 300 m ahead it drifts back by 100 m in an orbit, 6 pi v_y / n: the third leads through the chief
    x[P][1], x[V][1] = 300.0, 100.0 * experiment.task.mean_motion / (6.0 * math.pi)
    x[Q.stop - 1], x[E] = 1.0, 2.0
    nothing = torch.zeros(6, 1, dtype=torch.float64)
    correct = experiment.safety.correct
    assert bool(correct and (correct(x, nothing).control[THRUST] != 0.0).any()) == leads


@pytest.mark.parametrize(
    ("max_time", "choice", "compiled"),
    [(4000.0, "auto", True), (100.0, "auto", False), (4000.0, "off", False)],
)
def test_evaluated_episodes_are_compiled_where_that_is_repaid(
    max_time: float, choice: str, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of agents and of other controllers alike."""
    seen: list[bool] = []
    monkeypatch.setattr(machine, "finds_compiler", lambda: True)
    monkeypatch.setattr(InspectionEnv, "compile", lambda env, compiler: seen.append(True))
    monkeypatch.setattr(evaluation, "run_episodes", lambda *flown: None)
    config = override(
        made(), {"train": {"compile": choice, "rta": False}, "inspection": {"max_time": max_time}}, "test"
    )
    experiment = Experiment(config, 2)
    evaluation.play(experiment.policy(experiment.generators([0])), experiment, 2, 0)
    evaluation.play_controller("quick", experiment, 2, 0)
    assert seen == [True, True] * compiled


def test_the_guidance_is_flown_in_the_default_task_without_the_filter_and_with_what_is_asked_for() -> None:
    experiment, env = paper_task(3, 5, decide_every=1.0, max_time=70.0)
    default = override(Config(), {"inspection": {"max_time": 70.0}}, "test")
    assert env.c == experiment.config.inspection == default.inspection
    assert env.safety.correct is None and env.time.shape == (3,) and env.clocks.decision == 1.0
    assert (experiment.config.rta.period, experiment.device.type) == (1.0, "cpu")
    assert [each.generator.initial_seed() for each in env.starts] == [5]
