"""The same numbers on a GPU; skipped where there is none."""

import pytest
import torch

from inspection.environment import InspectionEnv
from inspection.initial_state import sample_initial_state
from inspection.model.parameters import InspectionParameters
from ppo.learner import PPO
from ppo.network import Policy, Value
from ppo.parameters import PPOParameters
from ppo.rollout import collect
from rta.fast.filter import batched, fast
from rta.fast.vectors import states
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
C = InspectionParameters()
DEVICES = ("cpu", "cuda")


def environment(device: str, batch: int, rta: bool) -> InspectionEnv:
    safety_filter = batched(SafetyFilter(C, RtaParameters()))
    generator = torch.Generator(device).manual_seed(0)
    return InspectionEnv(batch, C, [generator], safety_filter.safety(rta))


@pytest.mark.parametrize("rta", [False, True])
def test_an_episode_is_the_same_on_both_devices(rta: bool) -> None:
    x, priority = sample_initial_state(8, torch.Generator().manual_seed(1), C)
    actions = 2.0 * torch.rand(5, 8, 6, generator=torch.Generator().manual_seed(2)) - 1.0
    states, observations = [], []
    for device in DEVICES:
        env = environment(device, 8, rta)
        env.start(x.to(device), priority.to(device))
        for action in actions.to(device):
            transition = env.step(action)
        states.append(transition.state.cpu())
        observations.append(transition.final_observation.cpu())
    torch.testing.assert_close(states[0], states[1], rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(observations[0], observations[1], rtol=1e-5, atol=1e-5)


def test_the_filter_gives_the_same_answers_on_both_devices() -> None:
    x, desired = states(300, 0, C)
    own = SafetyFilter(C, RtaParameters())
    answers = [fast(own, device, 300).correct(x.to(device), desired.to(device)) for device in DEVICES]
    assert answers[1].control.is_cuda
    assert (answers[0].status == answers[1].status.cpu()).all()
    limit = x.new_tensor(C.control_limit)[:, None]
    found = [each.control.cpu() / limit for each in answers]
    torch.testing.assert_close(*found, rtol=0, atol=1e-6)


def test_the_learner_trains_on_the_gpu() -> None:
    env = environment("cuda", 16, rta=False)
    env.reset()
    generators = [torch.Generator("cuda").manual_seed(0)]
    learner = PPO(
        Policy(26, 6, generators), Value(26, generators), PPOParameters(minibatch_size=64), generators
    )
    statistics = learner.update(collect(env, learner, 8, generators), 0.0)
    assert all(value.is_cuda and torch.isfinite(value).all() for value in statistics.values())
