"""Evaluation of what is not trained, against the simulation of a single spacecraft."""

import math

import numpy as np
import pytest
import torch

from inspection.model.state import OMEGA, THETA_S, P, Q, V
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.experiment import test_cases as common_cases
from study.flight import evaluation
from study.flight.controllers import agent, classical
from study.flight.evaluation import METRICS, play_controller, run_episodes
from study.flight.fly import Starts
from study.flight.simulation import Recording, simulate

SETTINGS = {"inspection": {"max_time": 20.0}, "rta": {"qp_solver": "piqp"}}


def experiment_of(rta: bool, episodes: int) -> Experiment:
    config = override(Config(), SETTINGS | {"train": {"rta": rta, "device": "cpu"}}, "test")
    return Experiment(config, episodes, seconds=20.0 * episodes)


@pytest.mark.parametrize(
    ("name", "every", "rta"),
    [
        ("quick", 1.0, True),
        ("untrained", 10.0, False),
    ],
)
def test_a_baseline_is_evaluated_as_it_is_simulated(name: str, every: float, rta: bool) -> None:
    experiment = experiment_of(rta, 2)
    config = experiment.config
    c = config.inspection
    record = play_controller(name, experiment, 2, 0)
    cases = common_cases(config, 2, 0)
    env = experiment.env(1, decide_every=every, report_every=1.0)
    policy = experiment.policy(experiment.generators([0]))
    for i in range(2):
        controller = agent(policy, env) if name == "untrained" else classical(name, env, 0)
        flight = simulate(env, controller, cases.one(i), c.max_time)
        control = abs(flight["control_applied"][:-1])  # the last row repeats the one before it
        expected = {
            "inspected_score": flight["inspected_score"][-1],
            "episode_length_s": c.max_time,
            "delta_v_m_s": control[:, :3].sum() / c.mass,
            "torque_n_m": control[:, 3:].sum() / c.action_period,
        }
        metrics = dict(zip(METRICS, record.metrics[:, i].tolist(), strict=True))
        assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-6)
        assert metrics["delta_v_m_s"] > 0.0
    assert record.filter_calls.tolist() == [c.max_time * rta] * 2


def test_a_success_is_clean_that_stays_clear_and_breaks_no_limit_in_any_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four cases at rest: nothing wrong; above the chief, to swing through it; a little too hot; no success."""
    experiment = experiment_of(False, 4)
    x, priority, _ = common_cases(experiment.config, 4, 0)
    x[:13], x[13], x[14], x[15] = 0.0, 5.0, 6.0, math.pi  # the panels are lit
    x[1], x[9] = 60.0, 1.0
    x[:3, 1] = torch.tensor([0.0, 0.0, 60.0])  # swings through the orbital plane
    x[13, 2] = 10.001
    env = experiment.env(4, experiment.generators([1]))
    begun = env.start

    def start(*arguments: torch.Tensor) -> None:
        begun(*arguments)
        env.sight.inspected[:, :3] = True

    monkeypatch.setattr(env, "start", start)
    record = evaluation.run_episodes(env, classical("zero", env, 0), Starts(x, priority))
    results = evaluation.report(record, experiment.config, 0)
    assert record.outcome.tolist() == [3, 3, 3, 4]
    assert record.clear.tolist() == [True, False, True, False]
    broken = record.violation_seconds[-1].tolist()
    assert broken[0] == broken[1] == 0.0 and broken[2] > 0.0
    assert record.clean.tolist() == [True, False, False, False]
    assert (results["outcomes"]["success"], results["outcomes"]["clean_success"]) == (0.75, 0.25)


@pytest.mark.parametrize("end", ["timeout", "crash"])
def test_the_first_episode_of_an_evaluation_is_recorded_as_it_is_simulated(end: str) -> None:
    """Also where it crashes between two actions."""
    experiment = experiment_of(end == "timeout", 2)
    c = experiment.config.inspection
    x, priority, _ = common_cases(experiment.config, 2, 0)
    x[P, 0], x[THETA_S, 0] = torch.tensor([60.0, 0.0, 0.0]).double(), 0.0
    x[Q, 0], x[OMEGA, 0] = torch.tensor([0.0, 0.0, 1.0, 0.0]).double(), 0.0  # looks at the lit side
    if end == "crash":
        x[P, 0], x[V, 0] = torch.tensor([[0.0, 17.0, 0.0], [0.0, -0.6, 0.0]]).double()  # in four seconds
    policy = experiment.policy(experiment.generators([0]))
    env = experiment.env(2)
    recording, starts = Recording(), Starts(x, priority)
    run_episodes(env, agent(policy, env), starts, recording)
    alone = experiment.env(1)
    length = 4.0 if end == "crash" else c.max_time
    flight = simulate(alone, agent(policy, alone), starts.one(0), length)
    recorded = recording.arrays()
    assert list(recorded) == list(flight)
    assert recorded["time"][-1] == length
    for name, array in flight.items():
        if name == "parameters":
            assert recorded[name] == array
        else:
            np.testing.assert_allclose(recorded[name], array, rtol=1e-5, atol=1e-6, err_msg=name)
    assert flight["inspected"][-1].any() or end == "crash"
