"""How fast everything is on this machine: simulator, filter, solvers and learner, by batch."""

import math
import os
import platform
import resource
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import torch

from kernels.build import VARIABLE
from rta.parameters import PERIODS
from settings import load, override
from study.benchmark import rates
from study.benchmark.breakdown import breakdown
from study.benchmark.flights import record, trained, untrained
from study.benchmark.timing import Spread, seconds, us
from study.config import Config
from study.experiment import Experiment
from study.files import ROOT
from study.machine.compiling import compile_or_explain, wants_compile
from study.verification import measure as demands
from study.verified import code_digest, fingerprint

BATCHES = (256, 1024, 4096, 16384, 65536)
TYPICAL = {"cpu": 4096, "cuda": 65536}  # the batch of the headline numbers
U1 = ROOT / "configs/plants/u1.toml"
PROGRAMS = (1, 16, 64, 256, 1024, 4096)  # solved at once
TYPICAL_PROGRAMS = 1024
FLOWN = 1024  # spacecraft under random demands


def experiment_at(config: Config, period: float, batch: int, solver: str = "batched") -> Experiment:
    """The experiment with the filter at a period, for about so many spacecraft at once."""
    train, rta = replace(config.train, rta=True), replace(config.rta, period=period, qp_solver=solver)
    return Experiment(replace(config, train=train, rta=rta), batch, seconds=math.inf)


@torch.no_grad()
def benchmark(
    config: Config, batches: tuple[int, ...], gymnasium: Callable[..., rates.GymnasiumEnv]
) -> dict[str, Any]:
    """Measures everything, compiled unless config.train.compile is "off".

    Args:
        gymnasium: makes a vector environment of (episodes, config, device, compiled).

    Returns:
        The content of `benchmark --json`. Headline numbers are medians, rates those at the batch of `batches`
        next to TYPICAL, the learner's at that next to its minibatch. `min_max` has the smallest and largest
        measurement of each under the same key; `scaling` has all three by batch: environments, spacecraft or
        samples at once, or programs for `qp_us`. `closed_loop_us` has `breakdown` by batch, and
        `compile_s` what `compile_times` says. `arithmetic` is of the filter, see `rates.arithmetic`. `random_call_us`
        has us a call under random demands from three kinds of starts, `filter` what filters were measured.
    """
    compiled, largest = wants_compile(config.train.compile, True), max(batches)
    say = partial(print, file=sys.stderr, flush=True)

    say("learner and matrix products")
    bare = experiment_at(replace(config, train=replace(config.train, compile="off")), 1.0, largest)
    matrix_product = rates.matrix_product(bare.device)
    bare_told = experiment_at(in_u1(bare.config), 1.0, largest)
    compile_s = compile_times(bare, bare_told, largest) if compiled else {}
    learner = {n: rates.learner(bare, n, compiled) for n in batches}

    say("filter")
    experiments = {f"{period:g}": experiment_at(config, period, largest) for period in PERIODS}
    experiment = experiments["1"]
    agent = untrained(experiment)
    sample = record(experiment, agent)
    filter_calls = {n: rates.filter_calls(experiment.filter, sample, n) for n in batches}
    onboard = experiment_at(config, 1.0, 1, "piqp").filter
    latencies = rates.single_latencies(experiment.filter, sample)
    arithmetic = rates.arithmetic(experiment.filter) if experiment.filter.compiled else {}
    typical = nearest(batches, TYPICAL[experiment.device.type])

    say("filter with [uncertainty]")
    told = in_u1(config)
    of_u1 = experiment_at(told, 1.0, typical)
    # what it meets itself: the other filter leads to states that it would have kept away from
    told_sample = record(of_u1, agent)._replace(programs=[])  # which are many
    # where controls are held, more at once take a minute each and are no faster
    told_calls = {n: rates.filter_calls(of_u1.filter, told_sample, n) for n in batches if n <= typical}
    told_latencies = rates.single_latencies(of_u1.filter, told_sample)

    say("filter under random demands")
    flown = {"paper": (config, "paper"), "edge": (config, "edge"), "u1": (told, "paper")}
    random_us = {name: us(random_calls(own, where)) for name, (own, where) in flown.items()}

    simulator: dict[str, dict[int, Spread]] = {name: {} for name in ("native", *rates.KINDS)}
    closed_loop: dict[str, dict[int, Spread]] = {name: {} for name in experiments}
    parts: dict[int, dict[str, float]] = {}
    for n in batches:
        say(f"{n:,} episodes at once")
        gym_env = gymnasium(n, config, config.train.device, compiled)
        for name, rate in rates.simulator(gym_env, sample).items():
            simulator[name][n] = rate
        env = gym_env.simulator
        for name, at_period in experiments.items():
            if at_period.filter.holds and n > typical:
                continue
            env.put_behind(at_period.safety)
            closed_loop[name][n] = rates.closed_loop(env, sample, agent)
        sample.start(env)
        parts[n] = breakdown(env, experiment.filter, agent)

    say("solvers")
    shipped = trained(experiment)
    met = sample.programs + (record(*shipped).programs if shipped else [])
    solvers = {
        "piqp": onboard.solver,
        "batched": rates.batched_solver(experiment, TYPICAL_PROGRAMS, compiled),
    }
    qp_us = {name: {n: us(rates.programs(own, met, n)) for n in PROGRAMS} for name, own in solvers.items()}

    minibatch = nearest(batches, config.ppo.minibatch_size)
    scaling: dict[str, Any] = {
        "simulator_steps_per_s": simulator.pop("native"),
        "gymnasium_steps_per_s": simulator,
        "closed_loop_steps_per_s": closed_loop,
        "filter_calls_per_s": filter_calls,
        "told_filter_calls_per_s": told_calls,
        "learner_samples_per_s": learner,
        "qp_us": qp_us,
    }
    counts = {"learner_samples_per_s": minibatch, "qp_us": TYPICAL_PROGRAMS}
    headline = {name: at(counts.get(name, typical), curves) for name, curves in scaling.items()}
    headline["random_call_us"] = random_us
    headline["matmul_gflops"] = {key: rate / 1e9 for key, rate in matrix_product.items()}
    flops = learner[minibatch]["median"] * rates.learner_flops(rates.fresh_learner(bare))
    single = {"single_filter_latency_ms": latencies, "told_filter_latency_ms": told_latencies}
    return pick_out(headline, lambda s: s["median"]) | {
        **{name: {"median": median(ms), "p99": ms[int(0.99 * len(ms))]} for name, ms in single.items()},
        "closed_loop_us": {name: {n: parts[n][name] for n in batches} for name in parts[typical]},
        "learner_matmul_share": flops / matrix_product["median"],
        "peak_memory_mb": peak_memory_mb(experiment.device),
        "compile_s": compile_s,
        "arithmetic": arithmetic,
        "scaling": scaling,
        "min_max": pick_out(headline, lambda s: [s["min"], s["max"]])
        | {name: [ms[0], ms[-1]] for name, ms in single.items()},
        "batch": typical,
        "threads": torch.get_num_threads(),
        "filter": {name: identity(each) for name, each in filters(config).items()},
        "torch": torch.__version__,
        "device": device_name(experiment.device),
        "compiled": compiled,
    }


def in_u1(config: Config) -> Config:
    """The configuration in the set U1, of which the filter is told; unchanged where it has bounds of its own."""
    if not config.uncertainty.is_nil:
        return config
    u1 = load(U1, Config())
    return replace(config, uncertainty=u1.uncertainty, plant=u1.plant)


def random_calls(config: Config, where: str) -> Spread:
    """Filter calls per s of spacecraft that are flown for a minute under random demands, see `measure.starts`."""
    own = override(config, {"train": {"rta": True}}, "benchmark")
    rates = sorted(demands.measure(own, "random", where, FLOWN, 60.0)["calls_per_s"] for _ in range(3))
    return {"median": rates[1], "min": rates[0], "max": rates[2]}


def filters(config: Config) -> dict[str, Config]:
    """The configurations of the filters that are measured, by name."""
    at = {f"{period:g}": override(config, {"rta": {"period": period}}, "benchmark") for period in PERIODS}
    return at | {"u1": in_u1(config)}


def identity(config: Config) -> dict[str, str]:
    """What says that numbers are of a configuration's filter as it is now: of its settings, and of its code as C."""
    return {"settings": fingerprint(config), "code": code_digest(config)}


def compile_times(bare: Experiment, told: Experiment, batch: int) -> dict[str, float]:
    """s until filter and simulator are compiled for a training run, and a filter with bounds: with an empty cache."""
    parts: dict[str, Callable[[], None]] = {
        "filter": partial(bare.filter.compile, bare.device, batch),
        "simulator": bare.env(batch).compile,
        "filter with [uncertainty]": partial(told.filter.compile, told.device, batch),
    }
    kept = os.environ.get(VARIABLE)
    try:
        with tempfile.TemporaryDirectory() as empty:
            os.environ[VARIABLE] = empty
            return {
                name: seconds(partial(compile_or_explain, name, part), bare.device)
                for name, part in parts.items()
            }
    finally:
        os.environ.pop(VARIABLE)
        if kept is not None:
            os.environ[VARIABLE] = kept


def nearest(batches: tuple[int, ...], wanted: int) -> int:
    """The batch next to the one wanted."""
    return min(batches, key=lambda n: abs(n - wanted))


def at(count: int, curves: dict[Any, Any]) -> Any:
    """What a curve has at a count, or every curve of a nested dictionary."""
    return curves[count] if count in curves else {name: at(count, curve) for name, curve in curves.items()}


def pick_out(headline: dict[str, Any], choose: Callable[[Spread], Any]) -> dict[str, Any]:
    """The same nested dictionary with `choose` of every Spread in it."""
    return {
        name: choose(value) if "median" in value else pick_out(value, choose)
        for name, value in headline.items()
    }


def peak_memory_mb(device: torch.device) -> float:
    """Most memory of the process so far; on a GPU, of PyTorch's tensors there."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # bytes, elsewhere KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def device_name(device: torch.device) -> str:
    """The GPU's name, else the processor's."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"cpu ({platform.processor() or platform.machine()})"
