"""How fast simulator, filter and learner are."""

from collections.abc import Iterator
from typing import Any

from study.results.numbers.evidence import Row, read

README, SPEED, GYMNASIUM = "README.md", "docs/results/speed.md", "docs/guides/gymnasium.md"
BATCHES = ("256", "1024", "4096", "65536")
FLOWN = {"paper": "from the paper's starts", "edge": "from the edge of the zone", "u1": "within U1"}
PARTS = {
    "total": "whole closed loop",
    "filter": "of this: the filter",
    "integration": "integration, ten substeps",
    "visibility and k-means": "point visibility and k-means",
    "agent": "agent",
    "rest": "observation, rewards, constraint values, restarts",
}  # of a step, as the benchmark and as the page call them


def benchmark() -> dict[str, Any]:
    """What `benchmark --json` measured."""
    return read("benchmark.json")


def measured() -> Iterator[Row]:
    """Our rates beside those of the authors' public packages, which were measured once."""
    b = benchmark()

    def latency(name: str) -> str:
        return f"{b[name]['median']:.3f} ms, 99 % below {b[name]['p99']:.3f} ms"

    loop, qp = b["closed_loop_steps_per_s"], b["qp_us"]
    yield "environment steps of 10 s, no RTA", f"{b['simulator_steps_per_s']:,.0f} per s", "53 per s"
    rates = " / ".join(f"{loop[period]:,.0f}" for period in ("1", "5", "10"))
    yield "with RTA at 1 / 5 / 10 s", f"{rates} per s", "8 per s at 1 s"
    yield "filter calls", f"{b['filter_calls_per_s']:,.0f} per s", "2,000 to 2,600 per s"
    yield "filter calls, with U1's bounds", f"{b['told_filter_calls_per_s']:,.0f} per s", ""
    for name, where in FLOWN.items():
        us, (low, high) = b["random_call_us"][name], b["min_max"]["random_call_us"][name]
        yield f"a filter call under random demands, {where}", f"{us:.1f} µs [{low:.1f}, {high:.1f}]", ""
    problem = "one optimisation problem of the filter, PIQP / batched solver, 1,024 at once"
    yield problem, f"{qp['piqp']:.1f} / {qp['batched']:.2f} µs", ""
    yield "one filter call alone, NumPy in and out", latency("single_filter_latency_ms"), "0.36 to 0.49 ms"
    yield "one filter call alone, with U1's bounds", latency("told_filter_latency_ms"), ""
    share = f"{100 * b['learner_matmul_share']:.0f} % of the float32 matrix-product rate"
    samples = f"{b['learner_samples_per_s']:,.0f} samples per s, {share} ({b['matmul_gflops']:.0f} Gflop/s)"
    yield "learner, 1,024 samples at once", samples, ""
    yield "peak memory, up to 65,536 episodes", f"{b['peak_memory_mb']:,.0f} MB", ""


def parts_of_a_step() -> Iterator[Row]:
    """Where the time of a step of the closed loop goes."""
    for part, by_batch in benchmark()["closed_loop_us"].items():
        yield PARTS[part], *(f"{by_batch[batch]:.1f}" for batch in BATCHES)


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    b = benchmark()
    free, filtered = b["simulator_steps_per_s"], b["closed_loop_steps_per_s"]["1"]
    yield README, f"{round(free, -3):,.0f} decisions of 10 s per second, and {round(filtered, -3):,.0f} with"
    calls, us = b["filter_calls_per_s"], b["random_call_us"]
    yield README, f"makes {round(calls, -4):,.0f} calls per second under an untrained agent"
    yield (
        README,
        f"takes {us['paper']:.0f} µs from the paper's starts, {us['edge']:.0f} µs at the edge of the zone and",
    )
    yield README, f"and {us['u1']:.0f} µs within large error bounds"
    share = 100 * b["told_filter_calls_per_s"] / calls
    yield SPEED, f"makes {share:.0f} % of the calls"
    yield SPEED, f"the edge of the zone takes {us['edge'] / us['paper']:.0f} times as long as"
    own, simulator, told = b["compile_s"].values()
    yield SPEED, f"takes {own:.0f} s to record, print and build, the simulator {simulator:.0f} s,"
    yield SPEED, f"a filter with U1's bounds {told:.0f} s"
    numpy, torch = (100 * rate / free for rate in b["gymnasium_steps_per_s"].values())
    yield GYMNASIUM, f"{numpy:.0f} % of the simulator's own rate with NumPy arrays and {torch:.0f} % with"
