"""How fast each part is: simulator, closed loop, filter and solvers on what was met in flight, and the learner."""

from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from kernels.compiled import Kernel
from kernels.printer import printed
from ppo.learner import PPO
from rta.filter import SafetyFilter
from rta.qp.batched_solver import BatchedSolver
from rta.qp.programs import Problems, Solver
from study.benchmark.flights import Agent, Sample
from study.benchmark.timing import Spread, in_turn, per_second, seconds
from study.experiment import Experiment
from study.machine.compiling import compile_or_explain

KINDS = {"numpy": "NumPy", "torch": "PyTorch"}  # of arrays that Gymnasium's interface takes and gives
WARM_CALLS, SINGLE_CALLS = 50, 1000
SAMPLES = 16384  # of an update, at least
MATRIX = 1024
CHAIN, INDEPENDENT = 200, 12  # products and sums in a row, and how many such rows at once


class GymnasiumEnv(Protocol):
    """What is measured of a vector environment of Gymnasium's interface around the simulator."""

    num_envs: int

    @property
    def simulator(self) -> InspectionEnv: ...

    def reset(self, *, seed: int) -> Any: ...

    def step(self, actions: Any) -> Any: ...


def simulator(gym_env: GymnasiumEnv, sample: Sample) -> dict[str, Spread]:
    """Environment steps per s under small random actions, those of an untrained policy.

    Returns:
        "native", of the simulator itself, and "numpy" and "torch", of the same through Gymnasium's interface.
    """
    env, device = gym_env.simulator, gym_env.simulator.x.device
    gym_env.reset(seed=0)
    sample.start(env)
    generator = torch.Generator(device).manual_seed(0)
    action = 0.1 * torch.randn(gym_env.num_envs, CONTROL_SIZE, generator=generator, device=device)
    functions = {
        "native": partial(env.step, action),
        "numpy": partial(gym_env.step, action.cpu().numpy()),
        "torch": partial(gym_env.step, action),
    }
    return in_turn(functions, gym_env.num_envs, device)


def closed_loop(env: InspectionEnv, sample: Sample, agent: Agent) -> Spread:
    """Environment steps per s, each of them observation, policy, filter calls and simulation."""
    observation = sample.start(env)

    def step() -> None:
        nonlocal observation
        observation = env.step(agent(observation)).observation

    return per_second(step, env.time.numel(), env.x.device)


def filter_calls(safety_filter: SafetyFilter, sample: Sample, batch: int) -> Spread:
    """Filter calls per s, one call being one spacecraft's."""
    call = partial(safety_filter.correct, *sample.take(batch), nothing_sent(safety_filter, sample, batch))
    return per_second(call, batch, sample.x.device)


def nothing_sent(safety_filter: SafetyFilter, sample: Sample, batch: int) -> Tensor:
    """No control (calls, 6, batch) at each call that a state may be old: as much to compute as any."""
    return sample.desired.new_zeros(safety_filter.known.latency, CONTROL_SIZE, batch)


def single_latencies(safety_filter: SafetyFilter, sample: Sample) -> list[float]:
    """ms of SINGLE_CALLS filter calls, each of another single spacecraft, NumPy in and out, sorted."""
    x, desired = (part.numpy(force=True).T.copy() for part in sample.take(WARM_CALLS + SINGLE_CALLS))
    calls = [partial(safety_filter, *given) for given in zip(x, desired, strict=True)]
    return sorted([1e3 * seconds(call, torch.device("cpu")) for call in calls][WARM_CALLS:])


def programs(solver: Solver, met: list[Problems], batch: int) -> Spread:
    """Programs per s where each call of the solver is given `batch` of one actuator group."""
    parts = [part[torch.arange(batch, device=part.a.device) % part.desired.shape[1]] for part in met]

    def solve() -> None:
        for part in parts:
            solver.solve(part)

    return per_second(solve, batch * len(parts), parts[0].a.device)


def batched_solver(experiment: Experiment, batch: int, compiled: bool) -> BatchedSolver:
    """The batched solver as PyTorch runs it, its attempt compiled if wanted."""
    solver = BatchedSolver()
    rows = max(len(group.weights) for group in experiment.filter.groups)
    if compiled:
        compile_or_explain("solver", partial(solver.compile, [rows], batch, experiment.device))
    return solver


def arithmetic(safety_filter: SafetyFilter) -> dict[str, float]:
    """Of the filter's C on one core: statements and their rate, beside that of sums and products of nothing else.

    Returns:
        "statements" of a spacecraft's call; "us" that it takes; "statements_per_s", and the "peak" of these.
    """
    whole = safety_filter.compiled
    assert whole is not None

    def chains(x: Tensor) -> list[Tensor]:
        for _ in range(CHAIN):
            x = x * 0.5 + 1.0
        return [x]

    independent = Kernel(printed(chains, torch.ones(INDEPENDENT, 1, dtype=torch.float64)))
    return {
        "statements": whole.statements,
        "us": 1e6 * whole.seconds,
        "statements_per_s": whole.statements / whole.seconds,
        "peak": 2 * CHAIN * INDEPENDENT / independent.seconds,
    }


def fresh_learner(experiment: Experiment, **settings: Any) -> PPO:
    """A learner as training begins with it, with some of [ppo]'s settings replaced."""
    generators = experiment.generators()
    policy, value = experiment.policy(generators), experiment.value(generators)
    return PPO(policy, value, replace(experiment.config.ppo, **settings), generators)


@torch.enable_grad()
def learner(experiment: Experiment, minibatch: int, compiled: bool) -> Spread:
    """Samples per s of PPO updates: a sample counts once per epoch that trains on it."""
    fresh = fresh_learner(experiment, epochs=1, minibatch_size=minibatch)
    samples = max(SAMPLES, minibatch)
    if compiled and experiment.device.type == "cuda":
        compile_or_explain("learner", partial(fresh.compile, samples))
    noise = partial(torch.randn, generator=fresh.generators[0], device=experiment.device)
    batch = {"observation": noise(1, samples, fresh.policy.network.layers[0].weight.shape[1])}
    batch["action"], batch["log_prob"] = fresh.policy.sample(batch["observation"], fresh.generators)
    batch |= {name: noise(1, samples) for name in ("advantage", "return_", "value")}
    return per_second(partial(fresh.update, batch, 0.5), samples, experiment.device)


def learner_flops(learner: PPO) -> float:
    """Matrix-product flop per sample of an update.

    A layer of n x m weights takes 2 n m flop forward, as many for the weights' gradient and, but in the first
    layer, as many for its input's. With 26 inputs, two hidden layers of 256 and 12 + 2 outputs (the value is
    multiplied as two columns, see StackedLinear) that is 6 (2 (26 + 256) 256 + 256 (12 + 2)) - 4 (26) 256 = 861,184.
    """
    flops = 0
    for network in (learner.policy.network, learner.value.network):
        for i, layer in enumerate(network.layers):
            inputs, outputs = layer.weight.shape[1:]
            flops += (4 if i == 0 else 6) * inputs * max(outputs, 2)
    return float(flops)


def matrix_product(device: torch.device) -> Spread:
    """Flop per s of a square float32 matrix product."""
    a, b = torch.randn(2, MATRIX, MATRIX, device=device)
    return per_second(partial(torch.mm, a, b, out=torch.empty_like(a)), 2.0 * MATRIX**3, device)
