"""How fast everything is on this machine: simulator, filter, solvers and learner, by batch."""

import platform
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor

from inspection.environment import Correction, InspectionEnv
from inspection.observation import SIZE as OBSERVATION_SIZE
from inspection.state import CONTROL_SIZE
from interfaces.vector import VectorInspection6DoF
from ppo.checkpoint import CheckpointError
from ppo.learner import PPO
from ppo.network import Value
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from rta.qp import Problems, Solutions, Solver
from study import experiment as build
from study.benchmark.breakdown import breakdown
from study.config import Config
from study.errors import InputError
from study.files import ROOT
from study.flight.evaluation import Actor, policy_actor

TRAINED = ROOT / "runs/reference/study/rta/seed0/policy.pt"
BATCHES = (256, 1024, 4096, 16384, 65536)
TYPICAL = {"cpu": 4096, "cuda": 65536}  # the batch of the headline numbers
REPEATS = 5
SHORTEST = 0.05  # s that a repeat lasts at least, for a clock's and a scheduler's sake
EPISODES, STEPS = 256, 60  # flown to record states, controls and programs, from a typical half of them on
PROGRAMS = (1, 16, 64, 256, 1024, 4096)  # solved at once
TYPICAL_PROGRAMS = 1024
SINGLE_CALLS = 1000
MATRIX = 1024
KINDS = {"numpy": "NumPy", "torch": "PyTorch"}  # of arrays that Gymnasium's interface takes and gives
Rates = list[float]  # per s, one per repeat
Spread = dict[str, float]


class Flight(NamedTuple):
    """What a closed loop met, shuffled: states (16, N), desired controls (6, N), programs by actuator group."""

    x: Tensor
    desired: Tensor
    programs: list[Problems]


class Recorder:
    """A solver that keeps what it is asked."""

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self.asked: dict[int, list[Problems]] = {}

    def solve(self, problems: Problems) -> Solutions:
        """See `Solver`."""
        self.asked.setdefault(len(problems.a), []).append(problems)
        return self.solver.solve(problems)

    def compile(self, rows: int, batch: int, device: torch.device | str) -> None:
        """See `Solver`."""
        self.solver.compile(rows, batch, device)


def repeated(function: Callable[[], Any], work: float, device: torch.device) -> Rates:
    """`work` per second of REPEATS repeats, warmed up; each calls the function as often as SHORTEST needs."""
    return in_turn({"": function}, work, device)[""]


def in_turn(functions: dict[str, Callable[[], Any]], work: float, device: torch.device) -> dict[str, Rates]:
    """`repeated` of several functions, a repeat of each after the other, so that all meet the same disturbances."""

    def seconds(function: Callable[[], Any], calls: int) -> float:
        wait(device)
        started = time.perf_counter()
        for _ in range(calls):
            function()
        wait(device)
        return time.perf_counter() - started

    calls = {}
    for name, function in functions.items():
        seconds(function, 1)
        calls[name] = max(1, round(SHORTEST / seconds(function, 1)))
    rates: dict[str, Rates] = {name: [] for name in functions}
    for _ in range(REPEATS):
        for name, function in functions.items():
            rates[name].append(work * calls[name] / seconds(function, calls[name]))
    return rates


def wait(device: torch.device) -> None:
    """Until the device has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def untrained(config: Config, device: torch.device) -> Actor:
    """A policy as training begins with it, exploring."""
    generator = torch.Generator(device).manual_seed(0)
    policy = build.make_policy(config, [generator])
    return lambda observation: policy.sample(observation[None], [generator])[0][0]


def fly(config: Config, safety_filter: SafetyFilter, actor: Actor, device: torch.device) -> Flight:
    """Plays EPISODES from the initial distribution, and keeps what the filter meets in the later half of STEPS."""
    met: list[tuple[Tensor, Tensor]] = []
    recorder = Recorder(safety_filter.solver)

    def correct(x: Tensor, desired: Tensor) -> Correction:
        met.append((x, desired))
        return safety_filter(x, desired)

    safety = replace(safety_filter.safety(), correct=correct)
    env = build.make_env(config, EPISODES, [torch.Generator(device).manual_seed(0)], safety)
    observation = env.reset()
    for i in range(STEPS):
        if i == STEPS // 2:
            met.clear()
            safety_filter.solver = recorder
        observation = env.step(actor(observation)).observation
    safety_filter.solver = recorder.solver
    x, desired = (torch.cat(parts, 1) for parts in zip(*met, strict=True))
    order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(0)).to(device)
    return Flight(x[:, order], desired[:, order], [join(parts) for parts in recorder.asked.values()])


def join(parts: list[Problems]) -> Problems:
    """One batch of the programs of several, shuffled."""
    fields = ("desired", "a", "b", "b_bare")
    every = Problems(
        *(torch.cat([getattr(part, name) for part in parts], -1) for name in fields), parts[0].weight
    )
    count = every.desired.shape[1]
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    return every[order.to(every.a.device)]


def first(x: Tensor, count: int) -> Tensor:
    """The first `count` columns of x, repeated as often as needed."""
    return x[..., torch.arange(count, device=x.device) % x.shape[-1]].contiguous()


def simulator_rates(gym_env: VectorInspection6DoF, flight: Flight) -> dict[str, Rates]:
    """Environment steps per s under small random actions, those of an untrained policy.

    Returns:
        "native", of the simulator itself, and "numpy" and "torch", of the same through Gymnasium's interface.
    """
    env, device = gym_env.simulator, gym_env.device
    gym_env.reset(seed=0)
    begin(env, flight)
    generator = torch.Generator(device).manual_seed(0)
    action = 0.1 * torch.randn(gym_env.num_envs, CONTROL_SIZE, generator=generator, device=device)
    array = action.cpu().numpy()
    functions = {
        "native": lambda: env.step(action),
        "numpy": lambda: gym_env.step(array),
        "torch": lambda: gym_env.step(action),
    }
    return in_turn(functions, gym_env.num_envs, device)


def closed_loop_rate(env: InspectionEnv, flight: Flight, actor: Actor) -> Rates:
    """Environment steps per s, each of them observation, policy, filter calls and simulation."""
    begin(env, flight)
    observation = env.observation()

    def step() -> None:
        nonlocal observation
        observation = env.step(actor(observation)).observation

    return repeated(step, env.time.numel(), env.x.device)


def begin(env: InspectionEnv, flight: Flight) -> None:
    """Puts states met in flight into every episode."""
    x = first(flight.x, env.time.numel())
    env.start(x, first(torch.eye(3, dtype=x.dtype, device=x.device), env.time.numel()))


def filter_rate(safety_filter: SafetyFilter, flight: Flight, batch: int) -> Rates:
    """Filter calls per s, one call being one spacecraft's."""
    x, desired = first(flight.x, batch), first(flight.desired, batch)
    return repeated(lambda: safety_filter(x, desired), batch, x.device)


def solver_rate(solver: Solver, programs: list[Problems], batch: int) -> Rates:
    """Programs per s where each call of the solver is given `batch` of one actuator group."""
    parts = [part[torch.arange(batch, device=part.a.device) % part.desired.shape[1]] for part in programs]

    def solve() -> None:
        for part in parts:
            solver.solve(part)

    return repeated(solve, batch * len(parts), parts[0].a.device)


def single_latencies(safety_filter: SafetyFilter, flight: Flight) -> list[float]:
    """ms of SINGLE_CALLS filter calls, each of another single spacecraft, sorted."""
    milliseconds = []
    for i in range(50 + SINGLE_CALLS):
        k = i % flight.x.shape[1]
        x, desired = flight.x[:, k : k + 1].contiguous(), flight.desired[:, k : k + 1].contiguous()
        wait(x.device)
        started = time.perf_counter()
        safety_filter(x, desired)
        wait(x.device)
        milliseconds.append(1e3 * (time.perf_counter() - started))
    return sorted(milliseconds[50:])


def learner_rate(config: Config, minibatch: int, device: torch.device, compiled: bool) -> Rates:
    """Samples per s of PPO updates: a sample counts once per epoch that trains on it."""
    generators = [torch.Generator(device).manual_seed(0)]
    policy, value = build.make_policy(config, generators), Value(OBSERVATION_SIZE, generators)
    learner = PPO(policy, value, replace(config.ppo, epochs=1, minibatch_size=minibatch), generators)
    samples = max(16384, minibatch)
    if compiled:
        build.compile_or_explain("learner", lambda: learner.compile(samples))
    noise = partial(torch.randn, generator=generators[0], device=device)
    batch = {"observation": noise(1, samples, OBSERVATION_SIZE)}
    batch["action"], batch["log_prob"] = policy.sample(batch["observation"], generators)
    batch |= {name: noise(1, samples) for name in ("advantage", "return_", "value")}
    return repeated(lambda: learner.update(batch, 0.5), samples, device)


def learner_flops(config: Config) -> float:
    """Matrix-product flop per sample of an update.

    A layer of n x m weights takes 2 n m flop forward, as many for the weights' gradient and, but in the first
    layer, as many for its input's. With 26 inputs, two hidden layers of 256 and 12 + 2 outputs (the value is
    multiplied as two columns, see StackedLinear) that is 6 (2 (26 + 256) 256 + 256 (12 + 2)) - 4 (26) 256 = 861,184.
    """
    flops, generators = 0, [torch.Generator()]
    for network in (
        build.make_policy(config, generators).network,
        Value(OBSERVATION_SIZE, generators).network,
    ):
        for i, layer in enumerate(network.layers):
            inputs, outputs = layer.weight.shape[1:]
            flops += (4 if i == 0 else 6) * inputs * max(outputs, 2)
    return float(flops)


def matmul_rate(device: torch.device) -> Rates:
    """Flop per s of a square float32 matrix product."""
    a, b = torch.randn(2, MATRIX, MATRIX, device=device)
    out = torch.empty_like(a)
    return repeated(lambda: torch.mm(a, b, out=out), 2.0 * MATRIX**3, device)


def peak_memory_mb(device: torch.device) -> float:
    """Most memory of the process so far; on a GPU, of PyTorch's tensors there."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # bytes, elsewhere KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def trained_actor(device: torch.device) -> Actor | None:
    """The shipped agent; None, and a line that says so, where it cannot be loaded."""
    try:
        policy, _ = build.load_policy(str(TRAINED))
    except (CheckpointError, InputError) as error:
        print(f"no trained agent, so only programs of the untrained one are solved: {error}", flush=True)
        return None
    return policy_actor(policy.to(device))


def spread(rates: Rates) -> Spread:
    """Median, smallest and largest."""
    return {"median": median(rates), "min": min(rates), "max": max(rates)}


def us(rate: Spread) -> Spread:
    """Microseconds per program from programs per s."""
    return {"median": 1e6 / rate["median"], "min": 1e6 / rate["max"], "max": 1e6 / rate["min"]}


@torch.no_grad()
def benchmark(config: Config, batches: tuple[int, ...]) -> dict[str, Any]:
    """Measures everything, compiled unless config.train.compile is "off".

    Returns:
        The content of `benchmark --json`. Headline numbers are medians, rates those at the batch of `batches`
        next to TYPICAL, the learner's at that next to its minibatch. `min_max` has the smallest and largest
        measurement of each under the same key; `scaling` has all three by batch: environments, spacecraft or
        samples at once, or programs for `qp_us`. `closed_loop_us` has `breakdown` by batch, and
        `compile_s` what `compile_times` says, before anything else is compiled.
    """
    device = build.resolve_device(config.train.device)
    compiled = build.wants_compile(config.train.compile, True)
    say = partial(print, file=sys.stderr, flush=True)

    say("learner and matrix products")
    matmul = spread(matmul_rate(device))
    compile_s = compile_times(config, max(batches)) if compiled else {}
    with torch.enable_grad():
        learner = {n: spread(learner_rate(config, n, device, compiled)) for n in batches}

    say("filter")
    filters = {f"{period:g}": make_filter(config, period, compiled, max(batches)) for period in PERIODS}
    safety_filter, actor = filters["1"], untrained(config, device)
    flight = fly(config, safety_filter, actor, device)
    filtering = {n: spread(filter_rate(safety_filter, flight, n)) for n in batches}
    onboard = make_filter(config, 1.0, compiled, 1, "piqp")
    latencies = single_latencies(onboard, flight)

    simulator: dict[str, dict[int, Spread]] = {name: {} for name in ("native", *KINDS)}
    parts: dict[int, dict[str, float]] = {}
    closed: dict[str, dict[int, Spread]] = {name: {} for name in filters}
    for n in batches:
        say(f"{n:,} episodes at once")
        gym_env = VectorInspection6DoF(n, config, config.train.device, compiled)
        for name, rates in simulator_rates(gym_env, flight).items():
            simulator[name][n] = spread(rates)
        env = gym_env.simulator
        for name, filter_at_period in filters.items():
            env.safety = filter_at_period.safety()
            closed[name][n] = spread(closed_loop_rate(env, flight, actor))
        begin(env, flight)
        parts[n] = breakdown(env, safety_filter, actor)

    say("solvers")
    flights = [flight]
    if shipped := trained_actor(device):
        flights.append(fly(config, safety_filter, shipped, device))
    programs = [program for flown in flights for program in flown.programs]
    solvers = {"piqp": onboard.solver, "batched": safety_filter.solver}
    qp = {
        name: {n: us(spread(solver_rate(solver, programs, n))) for n in PROGRAMS}
        for name, solver in solvers.items()
    }

    typical = min(batches, key=lambda n: abs(n - TYPICAL[device.type]))
    minibatch = min(batches, key=lambda n: abs(n - config.ppo.minibatch_size))
    headline: dict[str, Any] = {
        "simulator_steps_per_s": simulator["native"][typical],
        "gymnasium_steps_per_s": {kind: simulator[kind][typical] for kind in KINDS},
        "closed_loop_steps_per_s": {name: rates[typical] for name, rates in closed.items()},
        "filter_calls_per_s": filtering[typical],
        "qp_us": {name: times[TYPICAL_PROGRAMS] for name, times in qp.items()},
        "learner_samples_per_s": learner[minibatch],
        "matmul_gflops": {key: rate / 1e9 for key, rate in matmul.items()},
    }
    flops = learner[minibatch]["median"] * learner_flops(config)
    return pick_out(headline, lambda s: s["median"]) | {
        "single_filter_latency_ms": {
            "median": median(latencies),
            "p99": latencies[int(0.99 * len(latencies))],
        },
        "closed_loop_us": {
            name: {n: by_name[name] for n, by_name in parts.items()} for name in parts[typical]
        },
        "learner_matmul_share": flops / matmul["median"],
        "peak_memory_mb": peak_memory_mb(device),
        "compile_s": compile_s,
        "scaling": {
            "simulator_steps_per_s": simulator["native"],
            "gymnasium_steps_per_s": {kind: simulator[kind] for kind in KINDS},
            "closed_loop_steps_per_s": closed,
            "filter_calls_per_s": filtering,
            "learner_samples_per_s": learner,
            "qp_us": qp,
        },
        "min_max": pick_out(headline, lambda s: [s["min"], s["max"]])
        | {"single_filter_latency_ms": [latencies[0], latencies[-1]]},
        "batch": typical,
        "threads": torch.get_num_threads(),
        "device": device_name(device),
        "compiled": compiled,
    }


def compile_times(config: Config, batch: int) -> dict[str, float]:
    """s until filter, simulator and learner are compiled for a training run, less where the cache holds them."""
    device = build.resolve_device(config.train.device)
    generators = [torch.Generator(device).manual_seed(0)]
    safety_filter = make_filter(config, 1.0, False, batch)
    env = build.make_env(config, batch, generators, safety_filter.safety(False))
    learner = PPO(
        build.make_policy(config, generators), Value(OBSERVATION_SIZE, generators), config.ppo, generators
    )
    seconds = {}
    for name, compile in (
        ("filter", lambda: safety_filter.compile(device, batch)),
        ("simulator", env.compile),
        ("learner", lambda: learner.compile(config.train.batch)),
    ):
        started = time.perf_counter()
        with torch.enable_grad():
            build.compile_or_explain(name, compile)
        seconds[name] = time.perf_counter() - started
    return seconds


def pick_out(headline: dict[str, Any], choose: Callable[[Spread], Any]) -> dict[str, Any]:
    """The same nested dictionary with `choose` of every Spread in it."""
    return {
        name: choose(value) if "median" in value else pick_out(value, choose)
        for name, value in headline.items()
    }


def make_filter(
    config: Config, period: float, compiled: bool, batch: int, solver: str = "batched"
) -> SafetyFilter:
    """The filter at a period, for about so many spacecraft at once."""
    train = replace(config.train, qp_solver=solver)
    return build.make_filter(replace(config, train=train), period, compiled, batch)


def device_name(device: torch.device) -> str:
    """The GPU's name, else the processor's."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"cpu ({platform.processor() or platform.machine()})"
