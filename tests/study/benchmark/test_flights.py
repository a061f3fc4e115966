"""What is recorded in flight: the filter's own questions, and all of them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from ppo import checkpoint
from rta.qp.programs import Status
from settings import to_toml
from study.benchmark import flights
from study.config import Config
from study.experiment import Experiment, load_policy, make_policy


@pytest.fixture
def experiment() -> Experiment:
    train = replace(Config().train, device="cpu", compile="off")
    return Experiment(replace(Config(), train=train), 8)


def test_a_flight_holds_what_the_filter_met_in_the_later_half(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "EPISODES", 8)
    monkeypatch.setattr(flights, "STEPS", 2)
    generator = torch.Generator().manual_seed(1)
    sample = flights.record(
        experiment, lambda observation: 2.0 * torch.rand(len(observation), 6, generator=generator) - 1.0
    )
    assert sample.x.shape == (16, 80) and sample.desired.shape == (6, 80)  # ten calls of one step
    result = experiment.filter.correct(sample.x, sample.desired)  # every call, asked again
    unsafe = result.program_status > Status.UNTOUCHED
    assert sorted(part.desired.shape[1] for part in sample.programs) == sorted(unsafe.sum(1).tolist())


def test_columns_are_repeated_as_often_as_needed() -> None:
    x = torch.arange(6.0).reshape(2, 3)
    assert flights.cycled(x, 5).tolist() == [[0, 1, 2, 0, 1], [3, 4, 5, 3, 4]]
    assert flights.cycled(x, 2).tolist() == [[0, 1], [3, 4]]


def test_every_episode_starts_from_a_state_met() -> None:
    env = InspectionEnv(5, InspectionParameters(), [torch.Generator().manual_seed(0)])
    env.reset()
    sample = flights.Sample(env.x[:, :2], torch.zeros(6, 2, dtype=torch.float64), [])
    observation = sample.start(env)
    assert torch.equal(env.x, sample.x[:, [0, 1, 0, 1, 0]]) and observation.shape == (5, 26)
    assert torch.equal(env.sight.priority, torch.eye(3, dtype=torch.float64)[:, [0, 1, 2, 0, 1]])


def test_a_missing_trained_agent_is_named(
    experiment: Experiment,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(flights, "TRAINED", tmp_path / "none.pt")
    assert flights.trained(experiment) is None
    assert "none.pt" in capsys.readouterr().out


def test_the_shipped_agent_acts_on_what_it_observes(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shipped, config = load_policy(flights.TRAINED)
    seen = Config(inspection=replace(config.inspection, observed=("sun", "hill")), ppo=config.ppo)
    other = make_policy(seen, [torch.Generator()])
    checkpoint.save(tmp_path / "other.pt", {"policy": other.state_dict(), "config": to_toml(seen)})
    for path, policy in ((flights.TRAINED, shipped), (tmp_path / "other.pt", other)):
        monkeypatch.setattr(flights, "TRAINED", path)
        found = flights.trained(experiment)
        assert found is not None
        seeing, agent = found
        observation = seeing.env(3).reset()
        assert torch.equal(agent(observation), policy.mean_action(observation[None])[0])
        assert seeing.filter is experiment.filter
