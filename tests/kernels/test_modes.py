"""PyTorch's modes of the moment change no result: autocast, inference mode, another default type of numbers."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from inspection.environment import InspectionEnv
from inspection.initial_state import sample_initial_state
from inspection.model.parameters import InspectionParameters
from kernels.compiled import Compiled
from ppo.learner import PPO
from ppo.network import Policy, Value
from ppo.parameters import PPOParameters
from ppo.rollout import collect
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.lie_derivatives import load_forward_mode
from rta.parameters import RtaParameters
from rta.robust.filter import RobustFilter
from settings import load
from study.config import Config

C = InspectionParameters()
U1 = load(Path("configs/plants/u1.toml"), Config())


@contextmanager
def default(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


MODES: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "autocast": partial(torch.autocast, "cpu", dtype=torch.bfloat16),
    "inference": torch.inference_mode,
    "half": partial(default, torch.float16),
}


def episodes(rta: bool, period: float = 1.0, compiled: bool = False, robust: bool = False) -> list[Tensor]:
    """Observations, rewards and states of random actions; in an imperfect world where the filter is robust to it."""
    c = U1.inspection if robust else C
    parameters = RtaParameters(period=period)
    safety_filter = SafetyFilter(c, parameters)
    if robust:
        safety_filter = RobustFilter(c, parameters, uncertainty=U1.uncertainty)
    safety_filter = fast(safety_filter, "cpu", 8) if compiled else batched(safety_filter)
    plant = U1.plant if robust else None
    env = InspectionEnv(8, c, [torch.Generator().manual_seed(0)], safety_filter.safety(rta), plant=plant)
    if compiled:
        env.compile(Compiled)
    draw, observation = torch.Generator().manual_seed(1), env.reset()
    flown = env.step(2.0 * torch.rand(8, 6, generator=draw, dtype=torch.float32) - 1.0)
    return [observation, flown.observation, flown.reward, flown.state]


def learned() -> list[Tensor]:
    """Returns an agent's weights after an update, its decisions, and statistics."""
    generators = [torch.Generator().manual_seed(0)]
    env = InspectionEnv(8, C, [torch.Generator().manual_seed(3)], SafetyFilter(C).safety(False))
    learner = PPO(
        Policy(26, 6, generators), Value(26, generators), PPOParameters(minibatch_size=32), generators
    )
    observation = env.reset()
    statistics = learner.update(collect(env, learner, 4, generators), 0.0)
    decided = learner.policy.mean_action(observation[None])
    return [decided, *(each.detach() for each in learner.policy.parameters()), *statistics.values()]


def called() -> list[Tensor]:
    """Returns the results of the filter as a function: control, values, starts."""
    safety_filter = SafetyFilter(C)
    x = np.zeros(16)
    x[[0, 3, 9, 13, 14]] = 60.0, -1.5, 1.0, 5.0, 6.0
    result = safety_filter(x, [-1.0, 0.5, 0.0, 0.0, 1e-3, 0.0])
    column = torch.from_numpy(x)[:, None]
    return [torch.from_numpy(result.control), safety_filter.values(column), safety_filter.is_safe(column)]


BRIEF: list[Callable[[], list[Tensor]]] = [partial(episodes, rta=False), called, learned]
LONG = [
    partial(episodes, rta=True),
    partial(episodes, rta=True, period=5.0),
    partial(episodes, rta=True, robust=True),
    partial(episodes, rta=True, compiled=True),
]


@pytest.mark.parametrize(
    "compute", [*BRIEF, *(pytest.param(each, marks=pytest.mark.campaign) for each in LONG)]
)
def test_no_mode_changes_a_result(compute: Callable[[], list[Tensor]]) -> None:
    expected = compute()
    for mode, within in MODES.items():
        if compute is learned and mode == "inference":
            continue  # there are no gradients
        with within():
            found = compute()
        for one, other in zip(expected, found, strict=True):
            assert one.dtype == other.dtype and torch.equal(one, other), mode


class Watching(TorchDispatchMode):
    """Notes which operations answer in another precision than double."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        answer = function(*args, **(kwargs or {}))
        if isinstance(answer, Tensor) and answer.is_floating_point() and answer.dtype != torch.float64:
            self.seen.add(str(function))
        return answer


@pytest.mark.parametrize("robust", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_the_filter_computes_in_double(robust: bool) -> None:
    """A choice between two Python numbers is in PyTorch's default type, in single: bounds within U1 were, once."""
    safety_filter = RobustFilter(U1.inspection, uncertainty=U1.uncertainty) if robust else SafetyFilter(C)
    safety_filter = batched(safety_filter)
    x, _ = sample_initial_state(32, torch.Generator().manual_seed(0), safety_filter.c)
    load_forward_mode()
    with Watching() as watching:
        safety_filter.values(x)
        safety_filter.is_safe(x)
        safety_filter.correct(x, torch.ones(6, 32, dtype=torch.float64))
    assert not watching.seen
