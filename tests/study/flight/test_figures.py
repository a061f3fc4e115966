"""What figures of episodes compute: pointing by hand, effort against the environment's own count."""

import math

import numpy as np
import pytest
import torch

from inspection.guidance import recorded
from inspection.transition import METRICS
from study.config import Config, TrainParameters
from study.experiment import Experiment
from study.flight.figures import effort, pointing
from study.flight.simulation import simulate, starting_point

QUARTER = math.sqrt(0.5)


def test_pointing_is_the_cosine_between_the_camera_and_the_chief() -> None:
    still, turned = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, QUARTER, QUARTER]  # by 90 deg about z: boresight along y
    positions = [[-20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, -40.0, 0.0], [-40.0, -40.0, 0.0]]
    episode = {"quaternion": np.array(3 * [still] + 2 * [turned]), "position": np.array(positions)}
    assert pointing(episode) == pytest.approx([1.0, -1.0, 0.0, 1.0, QUARTER], abs=1e-12)


def test_effort_is_what_the_environment_counts() -> None:
    config = Config(train=TrainParameters(rta=False, device="cpu", compile="off"))
    experiment = Experiment(config, 1, 60.0)
    start = starting_point(None, experiment, seed=3)
    actions = torch.rand(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1

    env = experiment.env(1)
    env.start(*start)
    metrics = [env.step(action[None]).metrics[:, 0] for action in actions]

    env = experiment.env(1, report_every=1.0)
    controls = (actions * env.limit[:, 0]).numpy()
    episode = simulate(env, recorded(controls, 10.0), start, 60.0)
    delta_v, torque = effort(episode, config.inspection)

    at_steps = slice(10, None, 10)
    counted = dict(zip(METRICS, torch.stack(metrics, 1), strict=True))
    assert delta_v[at_steps] == pytest.approx(counted["delta_v_m_s"].numpy(), rel=1e-12)
    assert torque[at_steps] == pytest.approx(counted["torque_n_m"].numpy(), rel=1e-12)
    assert delta_v[0] == torque[0] == 0.0
