"""Measures how fast simulator, filter, solvers and learner are: `main.py benchmark` (docs/results/speed.md)."""

import math
import os
import platform
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, BinaryIO
from unittest.mock import patch

import torch
from matplotlib.figure import Figure
from torch import Tensor

from experiments import measure as demands
from inspection.closed_loop import Correction
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from interfaces.vector import VectorInspection6DoF
from kernels.build import VARIABLE
from kernels.compiled import Compiled
from ppo.learner import PPO
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters
from settings import load, override
from study.config import Config
from study.experiment import Experiment, check_is_checked
from study.files import ROOT
from study.machine import compile_or_explain, wants_compile
from study.verified import code_digest, fingerprint

BATCHES = (256, 1024, 4096, 16384, 65536)
TYPICAL = {"cpu": 4096, "cuda": 65536}  # the batch of the headline numbers
REPEATS = 5  # of a measurement
SHORTEST = 0.05  # least s of a repeat, since clocks and schedulers are coarse
EPISODES, STEPS = 256, 60  # flown to record states and controls, of which the later half is typical
FLOWN = 1024  # spacecraft under random demands
WARM_CALLS, SINGLE_CALLS = 50, 1000
SAMPLES = 16_384  # least number in an update
PARTS_STEPS = 10  # number of environment steps whose parts are timed
MATRIX = 1024  # rows and columns
PARTS = ("total", "filter", "integration", "visibility and k-means", "agent", "rest")
U1 = ROOT / "configs/plants/u1.toml"
# Okabe and Ito's palette
PALETTE = ("#0072B2", "#000000", "#D55E00", "#E69F00", "#CC79A7", "#009E73", "#56B4E9", "#666666", "#F0E442")

Spread = dict[str, float]  # "median", "min" and "max"
Agent = Callable[[Tensor], Tensor]  # observations (B, n) to actions (B, 6)


# the clock


def seconds(function: Callable[[], Any], device: torch.device, calls: int = 1) -> float:
    """Returns the s that `calls` calls take, until the device has finished them."""
    wait = partial(torch.cuda.synchronize, device) if device.type == "cuda" else lambda: None
    wait()
    started = time.perf_counter()
    for _ in range(calls):
        function()
    wait()
    return time.perf_counter() - started


def in_turn(
    functions: Mapping[str, Callable[[], Any]], work: float, device: torch.device
) -> dict[str, Spread]:
    """Measures `work` per s of several functions, with repeats in turns, so that all meet the same disturbances.

    Every function is warmed up, and called in a repeat as often as SHORTEST needs.
    """
    calls, rates = {}, defaultdict(list)
    for name, function in functions.items():
        function()
        calls[name] = max(1, round(SHORTEST / seconds(function, device)))
    for _ in range(REPEATS):
        for name, function in functions.items():
            rates[name].append(work * calls[name] / seconds(function, device, calls[name]))
    return {name: spread(values) for name, values in rates.items()}


def per_second(function: Callable[[], Any], work: float, device: torch.device) -> Spread:
    """Measures `work` per s of one function, see `in_turn`."""
    return in_turn({"": function}, work, device)[""]


def spread(values: list[float]) -> Spread:
    """Returns the median and the extremes of values."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def us(rate: Spread) -> Spread:
    """Converts a rate per s into microseconds per item."""
    return {"median": 1e6 / rate["median"], "min": 1e6 / rate["max"], "max": 1e6 / rate["min"]}


# the objects of the measurements


def filters(config: Config) -> dict[str, Config]:
    """Returns the configurations of the measured filters: by period in s, and "u1" with the bounds of plant U1.

    A configuration with bounds keeps its own.
    """
    at = {f"{period:g}": override(config, {"rta": {"period": period}}, "benchmark") for period in PERIODS}
    u1 = config if not config.uncertainty.is_zero else load(U1, Config())
    return at | {"u1": replace(config, uncertainty=u1.uncertainty, plant=u1.plant)}


def identity(config: Config) -> dict[str, str]:
    """Returns digests of a filter's settings and of its C code, which say to which filter the numbers belong."""
    return {"settings": fingerprint(config), "code": code_digest(config)}


def untrained(experiment: Experiment) -> Agent:
    """Returns the policy with which training begins, with exploration."""
    generators = experiment.generators()
    policy = experiment.policy(generators)
    return lambda observation: policy.shaped(policy.sample(observation[None], generators)[0])[0]


def record(experiment: Experiment, agent: Agent) -> tuple[Tensor, Tensor]:
    """Plays EPISODES from the initial distribution.

    Returns:
        States (16, N) and desired controls (6, N) of the later half of the filter's calls, shuffled.
    """
    met: list[tuple[Tensor, Tensor]] = []

    def correct(x: Tensor, desired: Tensor, **told: Tensor) -> Correction:
        met.append((x, desired))
        return experiment.filter.correct(x, desired, **told)

    safety = replace(experiment.safety, correct=correct)
    env = experiment.env(EPISODES, compiled=experiment.compiled, safety=safety)
    observation = env.reset()
    for _ in range(STEPS):
        observation = env.step(agent(observation)).observation
    x, desired = (torch.cat(parts[len(met) // 2 :], 1) for parts in zip(*met, strict=True))
    # the same order on every device
    order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(0)).to(x.device)
    return x[:, order], desired[:, order]


def repeated(columns: Tensor, count: int) -> Tensor:
    """Returns the first `count` columns, (..., count); if there are fewer, it begins again with the first."""
    return columns[..., torch.arange(count, device=columns.device) % columns.shape[-1]].contiguous()


def start(env: InspectionEnv, x: Tensor) -> Tensor:
    """Starts all episodes in states (16, N) from flights; returns the observations."""
    count = env.time.numel()
    return env.start(repeated(x, count), repeated(torch.eye(3).to(x), count))


# rates


def simulator_rates(gym_env: VectorInspection6DoF, x: Tensor) -> dict[str, Spread]:
    """Measures environment steps per s from states (16, N) under small random actions, like an untrained policy's.

    Returns:
        "native" for the simulator itself, "numpy" and "torch" for the simulator through Gymnasium's interface.
    """
    count = gym_env.num_envs
    gym_env.reset(seed=0)
    start(gym_env.simulator, x)
    generator = torch.Generator(x.device).manual_seed(0)
    action = 0.1 * torch.randn(count, CONTROL_SIZE, generator=generator, device=x.device)
    functions: dict[str, Callable[[], Any]] = {
        "native": partial(gym_env.simulator.step, action),
        "numpy": partial(gym_env.step, action.cpu().numpy()),
        "torch": partial(gym_env.step, action),
    }
    return in_turn(functions, count, x.device)


def closed_loop_rate(env: InspectionEnv, x: Tensor, agent: Agent) -> Spread:
    """Measures environment steps per s, with observation, policy, filter calls and simulation."""
    observation = start(env, x)

    def step() -> None:
        nonlocal observation
        observation = env.step(agent(observation)).observation

    return per_second(step, env.time.numel(), env.x.device)


def parts_of_a_step(experiment: Experiment, count: int, x: Tensor, agent: Agent) -> dict[str, float]:
    """Plays PARTS_STEPS steps of `count` episodes that start from states (16, N).

    Returns:
        Microseconds per environment step by PARTS: "total", and its parts.
    """
    spent: dict[str, float] = defaultdict(float)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            answers: list[Any] = []
            spent[name] += seconds(lambda: answers.append(function(*args, **kwargs)), experiment.device)
            return answers[0]

        return run

    safety = replace(experiment.safety, correct=timed("filter", experiment.filter.correct))
    env = experiment.env(count, compiled=experiment.compiled, safety=safety)
    start(env, x)
    vars(env)["integrate"] = timed("integration", env.integrate)
    vars(env.sight)["update_inspected"] = timed("visibility and k-means", env.sight.update_inspected)
    decide = timed("agent", agent)

    def play() -> None:
        observation = env.observation()
        for _ in range(PARTS_STEPS):
            observation = env.step(decide(observation)).observation

    play()  # warm
    spent.clear()
    timed("total", play)()
    spent["rest"] = 2.0 * spent["total"] - sum(spent.values())
    return {name: 1e6 * spent[name] / PARTS_STEPS / count for name in PARTS}


def filter_rate(safety_filter: SafetyFilter, x: Tensor, desired: Tensor, batch: int) -> Spread:
    """Measures filter calls per s; a call is for one spacecraft.

    If states may be old, the filter gets the controls sent since; they are all zero, which costs as much as others.
    """
    sent = [repeated(torch.zeros_like(part), batch) for part in safety_filter.probe(x.device)[2:]]
    call = partial(safety_filter.correct, repeated(x, batch), repeated(desired, batch), *sent)
    return per_second(call, batch, x.device)


def paper_filter_rates(paper: SafetyFilter, x: Tensor, desired: Tensor, batch: int) -> dict[str, Spread]:
    """Measures calls per s of the paper's filter if every call has a program to solve, and if every third call has one.

    Args:
        x, desired: states (16, N) and controls (6, N), some of which have a program to solve.
    """
    limit = x.new_tensor(paper.c.control_limit)[:, None]
    a, b, *_ = paper.program.evaluated(x)
    has_program = ((a * desired.clamp(-limit, limit)).sum(1) + b < 0.0).any(0)
    asked, passed = (torch.nonzero(each).flatten() for each in (has_program, ~has_program))
    third = torch.arange(batch, device=x.device) % 3 == 0
    every = repeated(asked, batch)
    mixed = torch.where(third, every, repeated(passed, batch))
    return {
        name: per_second(partial(paper.correct, x[:, own], desired[:, own]), batch, x.device)
        for name, own in {"every": every, "third": mixed}.items()
    }


def single_latencies(safety_filter: SafetyFilter, *met: Tensor) -> list[float]:
    """Returns the sorted ms of SINGLE_CALLS filter calls for different spacecraft, with NumPy in and out."""
    given = (repeated(part, WARM_CALLS + SINGLE_CALLS).numpy(force=True).T.copy() for part in met)
    calls = [partial(safety_filter, *pair) for pair in zip(*given, strict=True)]
    return sorted([1e3 * seconds(call, torch.device("cpu")) for call in calls][WARM_CALLS:])


def random_demands(config: Config, where: str) -> Spread:
    """Measures microseconds per filter call, in flights of a minute under random controls; starts as in `demands`."""
    flights = [demands.measure(config, "random", where, FLOWN, 60.0) for _ in range(3)]
    return us(spread([flight["calls_per_s"] for flight in flights]))


def fresh_learner(experiment: Experiment, **settings: Any) -> PPO:
    """Returns the learner with which training begins, with some of [ppo]'s settings replaced."""
    generators = experiment.generators()
    policy, value = experiment.policy(generators), experiment.value(generators)
    return PPO(policy, value, replace(experiment.config.ppo, **settings), generators)


@torch.enable_grad()
def learner_rate(experiment: Experiment, minibatch: int, compiled: bool) -> Spread:
    """Measures samples per s of PPO updates: a sample counts once per epoch that trains on it."""
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
    """Returns the flop of matrix products per sample of an update.

    A layer of n x m weights takes 2 n m flop forward, as many for the weights' gradient and, except in the first layer,
    as many for its input's gradient. The value is multiplied as two columns, see StackedLinear.
    """
    flops = 0
    for network in (learner.policy.network, learner.value.network):
        for i, layer in enumerate(network.layers):
            inputs, outputs = layer.weight.shape[1:]
            flops += (4 if i == 0 else 6) * inputs * max(outputs, 2)
    return float(flops)


def compile_times(bare: Experiment, robust: Experiment, batch: int) -> dict[str, float]:
    """Returns the s to compile filter, simulator and a filter with bounds, with an empty cache."""
    parts: dict[str, Callable[[], Any]] = {
        "filter": partial(fast, bare.filter, bare.device, batch),
        "simulator": partial(bare.env(batch).compile, Compiled),
        "filter with [uncertainty]": partial(fast, robust.filter, robust.device, batch),
    }
    with tempfile.TemporaryDirectory() as empty, patch.dict(os.environ, {VARIABLE: empty}):
        return {
            name: seconds(partial(compile_or_explain, name, part), bare.device)
            for name, part in parts.items()
        }


def peak_memory_mb(device: torch.device) -> float:
    """Returns the peak memory of the process so far in MiB, or on a GPU that of PyTorch's tensors there."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # bytes, elsewhere KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


# everything


@torch.no_grad()
def benchmark(config: Config, batches: tuple[int, ...] = BATCHES) -> dict[str, Any]:
    """Measures everything, compiled unless config.train.compile is "off".

    Returns:
        The content of `benchmark --json`. Headline numbers are medians. Rates are those at the batch of `batches`
        closest to TYPICAL, the learner's rate at the batch closest to its minibatch. `min_max` has the smallest and
        largest measurement of each under the same key; `scaling` has all three by batch: environments, spacecraft or
        samples at once. `closed_loop_us` has `parts_of_a_step` by batch, `compile_s` has `compile_times`,
        `random_call_us` has us per call under random controls, and `filter` says which filters were measured.
    """
    check_is_checked(config)
    config = override(config, {"train": {"rta": True}, "rta": {"qp_solver": "batched"}}, "benchmark")
    compiled, largest = wants_compile(config.train.compile, math.inf), max(batches)
    named = filters(config)
    built = partial(Experiment, seconds=math.inf)  # compiled, although the flights are short
    uncompiled = partial(replace, train=replace(config.train, compile="off"))
    say = partial(print, file=sys.stderr, flush=True)
    curves: dict[tuple[str, ...], dict[int, Spread]] = defaultdict(dict)  # keys as in `scaling`
    parts: dict[str, dict[int, float]] = {name: {} for name in PARTS}

    say("learner and matrix products")
    bare = built(uncompiled(named["1"]), largest)
    device = bare.device
    a, b = torch.randn(2, MATRIX, MATRIX, device=device)
    matrix_product = per_second(partial(torch.mm, a, b, out=torch.empty_like(a)), 2e-9 * MATRIX**3, device)
    compile_s = compile_times(bare, built(uncompiled(named["u1"]), largest), largest) if compiled else {}
    for n in batches:
        curves["learner_samples_per_s",][n] = learner_rate(bare, n, compiled)

    say("filter")
    typical = nearest(batches, TYPICAL[device.type])
    experiments = {name: built(each, typical if name == "u1" else largest) for name, each in named.items()}
    experiment, robust = experiments["1"], experiments.pop("u1")
    agent = untrained(experiment)
    met = record(experiment, agent)
    robust_met = record(robust, agent)  # this filter leads to other states
    paper = SafetyFilter(config.inspection, RtaParameters(filter="paper"))
    if compiled:
        paper = fast(paper, device, typical)
    papers = paper_filter_rates(paper, *met, typical)
    single = {
        "paper_filter_latency_ms": single_latencies(paper, *met),
        "single_filter_latency_ms": single_latencies(experiment.filter, *met),
        "told_filter_latency_ms": single_latencies(robust.filter, *robust_met),
    }
    flown = {"paper": ("1", "paper"), "edge": ("1", "edge"), "u1": ("u1", "paper")}
    random_us = {name: random_demands(named[own], where) for name, (own, where) in flown.items()}

    for n in batches:
        say(f"{n:,} at once")
        gym_env = VectorInspection6DoF(n, config, config.train.device, compiled)
        rates = simulator_rates(gym_env, met[0])
        curves["simulator_steps_per_s",][n] = rates.pop("native")
        for name, rate in rates.items():
            curves["gymnasium_steps_per_s", name][n] = rate
        for name, at_period in experiments.items():
            env = at_period.env(n, compiled=at_period.compiled)
            curves["closed_loop_steps_per_s", name][n] = closed_loop_rate(env, met[0], agent)
        curves["filter_calls_per_s",][n] = filter_rate(experiment.filter, *met, n)
        if n <= typical:
            curves["told_filter_calls_per_s",][n] = filter_rate(robust.filter, *robust_met, n)
        for name, spent in parts_of_a_step(experiment, n, met[0], agent).items():
            parts[name][n] = spent

    minibatch = nearest(batches, config.ppo.minibatch_size)
    counts = {"learner_samples_per_s": minibatch}
    headline = {path: by_count[counts.get(path[0], typical)] for path, by_count in curves.items()}
    headline |= {("random_call_us", name): spent for name, spent in random_us.items()}
    headline |= {("paper_filter_calls_per_s", name): rate for name, rate in papers.items()}
    headline["matmul_gflops",] = matrix_product
    flops = curves["learner_samples_per_s",][minibatch]["median"] * learner_flops(fresh_learner(bare))
    cpu = f"cpu ({platform.processor() or platform.machine()})"
    return nested({path: rate["median"] for path, rate in headline.items()}) | {
        **{name: {"median": median(ms), "p99": ms[int(0.99 * len(ms))]} for name, ms in single.items()},
        "closed_loop_us": parts,
        "learner_matmul_share": 1e-9 * flops / matrix_product["median"],
        "peak_memory_mb": peak_memory_mb(device),
        "compile_s": compile_s,
        "scaling": nested(curves),
        "min_max": nested({path: [rate["min"], rate["max"]] for path, rate in headline.items()})
        | {name: [ms[0], ms[-1]] for name, ms in single.items()},
        "batch": typical,
        "threads": torch.get_num_threads(),
        "filter": {name: identity(each) for name, each in named.items()},
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu,
        "compiled": compiled,
    }


def nearest(batches: tuple[int, ...], wanted: int) -> int:
    """Returns the batch that is closest to the wanted one."""
    return min(batches, key=lambda n: abs(n - wanted))


def nested(flat: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Returns values that have one key or two as a nested dictionary."""
    found: dict[str, Any] = {}
    for (key, *name), value in flat.items():
        found |= {key: found.get(key, {}) | {name[0]: value}} if name else {key: value}
    return found


# text and figure


def table(results: dict[str, Any]) -> str:
    """Returns the headline numbers as text, a line for each key of the JSON."""

    def text(value: Any, extremes: Any = None) -> str:
        if isinstance(value, dict):
            parts = {name: extremes.get(name) if isinstance(extremes, dict) else extremes for name in value}
            return ", ".join(f"{name}: {text(value[name], parts[name])}" for name in value)
        if isinstance(value, float):
            return f"{value:,.{0 if value >= 1000 else 3}f}" + (f" [{text(extremes)}]" if extremes else "")
        return " to ".join(map(text, value)) if isinstance(value, list) else f"{value}"

    parts = {name: by_batch[results["batch"]] for name, by_batch in results["closed_loop_us"].items()}
    lines = [f"medians of {REPEATS} repeats [smallest to largest]", ""]
    for key, value in (results | {"closed_loop_us": parts}).items():
        if key not in ("scaling", "min_max", "filter"):
            lines.append(f"{key.replace('_', ' '):26}{text(value, results['min_max'].get(key))}")
    return "\n".join(lines)


LABELS = {
    "filter_calls_per_s": "filter calls",
    "told_filter_calls_per_s": "filter calls, U1's bounds",
    "simulator_steps_per_s": "simulator steps",
    "closed_loop_steps_per_s": "closed-loop steps, {} s",
    "learner_samples_per_s": "learner samples",
}


def figure(results: dict[str, Any], file: Path | BinaryIO) -> None:
    """Draws every rate over the batch as a log-log plot, a PNG."""
    drawing = Figure(figsize=(8, 5.2), layout="constrained")
    ax = drawing.subplots()
    style = zip("os^v<D*PX", PALETTE, strict=True)
    for key, label in LABELS.items():
        found = results["scaling"][key]
        for name, by_count in found.items() if "{}" in label else [("", found)]:
            rates = list(by_count.values())
            marker, colour = next(style)
            medians = [rate["median"] for rate in rates]
            ax.plot(list(by_count), medians, marker=marker, color=colour, label=label.format(name))
    ax.set(xscale="log", yscale="log", ylabel="per second")
    ax.set_xlabel("at once (episodes, spacecraft, samples)")
    ax.grid(True, which="major", alpha=0.4)
    threads = "1 thread" if results["threads"] == 1 else f"{results['threads']} threads"
    ax.set_title(f"{results['device']}, {threads}", fontsize=10)
    drawing.legend(loc="outside right upper", frameon=False, fontsize=9)
    drawing.savefig(file, dpi=120, format="png")
