"""Evaluation of classical guidance against the simulation of a single spacecraft."""

import pytest

from inspection.guidance import natural_motion
from study.config import Config, override
from study.experiment import Experiment
from study.experiment import test_cases as common_cases
from study.flight.evaluation import METRICS, play_controller
from study.flight.simulation import simulate

SETTINGS = {"inspection": {"max_time": 20.0}, "rta": {"qp_solver": "piqp"}}


@pytest.mark.parametrize("rta", [False, True])
def test_guidance_is_evaluated_as_it_is_simulated(rta: bool) -> None:
    config = override(Config(), SETTINGS | {"train": {"rta": rta, "device": "cpu"}}, "test")
    experiment, c = Experiment(config, 2, seconds=40.0), config.inspection
    record = play_controller("natural-motion", experiment, 2, 0)
    x, priority = common_cases(config, 2, 0)
    env = experiment.env(1, decide_every=1.0, report_every=1.0)
    for i in range(2):
        case = x[:, i : i + 1], priority[:, i : i + 1]
        flight = simulate(env, natural_motion(c), *case, c.max_time)
        control = abs(flight["control_applied"][:-1])  # the last row repeats the one before it
        expected = {
            "inspected_score": flight["inspected_score"][-1],
            "episode_length_s": c.max_time,
            "delta_v_m_s": control[:, :3].sum() / c.mass,
            "torque_n_m": control[:, 3:].sum() / c.action_period,
        }
        metrics = dict(zip(METRICS, record.metrics[:, i].tolist(), strict=True))
        assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    assert record.filter_calls.tolist() == [c.max_time * rta] * 2
