"""Evaluation of classical guidance against the simulation of a single spacecraft."""

import pytest
import torch

from inspection.guidance import natural_motion
from study import experiment as build
from study.config import Config, override
from study.flight.evaluation import METRICS, play_guidance
from study.flight.evaluation import test_cases as common_cases
from study.flight.simulation import simulate

CONFIG = override(Config(), {"inspection": {"max_time": 20.0}, "train": {"qp_solver": "piqp"}}, "test")
CPU = torch.device("cpu")


@pytest.mark.parametrize("rta", [False, True])
def test_guidance_is_evaluated_as_it_is_simulated(rta: bool) -> None:
    c, safety = CONFIG.inspection, build.make_safety(CONFIG, rta, 1.0)
    record = play_guidance(CONFIG, 2, 0, CPU, safety)
    x, priority = common_cases(CONFIG, 2, 0)
    env = build.one_episode(CONFIG, safety, CPU)
    for i in range(2):
        case = x[:, i : i + 1], priority[:, i : i + 1]
        flight = simulate(env, natural_motion(c), *case, c.max_time, step=1.0, decide_every=1.0)
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
