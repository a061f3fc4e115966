"""The benchmark's results for people: a table and a figure."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from study.benchmark.measure import TYPICAL_PROGRAMS
from study.benchmark.rates import KINDS
from study.benchmark.timing import REPEATS, Spread, us
from study.drawing import Figure

# Okabe and Ito's
PALETTE = ("#0072B2", "#000000", "#D55E00", "#E69F00", "#CC79A7", "#009E73", "#56B4E9", "#666666", "#F0E442")

RANDOM = {"paper": "the paper's starts", "edge": "the edge of the zone", "u1": "U1"}


def table(results: dict[str, Any]) -> str:
    """The results for a person."""
    lines = [
        f"{results['device']}, {results['threads']} threads, {'compiled' if results['compiled'] else 'eager'}; "
        f"medians of {REPEATS} repeats [min, max], {results['batch']:,} episodes or spacecraft at once",
        "",
    ]

    def measured(label: str, unit: str, key: str, name: str = "") -> None:
        """Adds a line with what is under this key, or under a name there, and with its extremes."""
        value, extremes = results[key], results["min_max"][key]
        value = value[name] if isinstance(value, dict) else value
        low, high = extremes[name] if isinstance(extremes, dict) else extremes
        digits = 0 if value >= 1000 else 3
        numbers = f"{value:>14,.{digits}f}  [{low:,.{digits}f}, {high:,.{digits}f}]"
        lines.append(f"{label:44}{numbers} {unit}")

    measured("simulator", "steps/s", "simulator_steps_per_s")
    for kind, rate in results["gymnasium_steps_per_s"].items():
        unit = f"steps/s, {100 * rate / results['simulator_steps_per_s']:.0f} % of the simulator's"
        measured(f"simulator through Gymnasium, {KINDS[kind]}", unit, "gymnasium_steps_per_s", kind)
    for name in results["closed_loop_steps_per_s"]:
        measured(f"closed loop, RTA at {name} s", "steps/s", "closed_loop_steps_per_s", name)
    measured("filter", "calls/s", "filter_calls_per_s")
    of_filter = 100 * results["told_filter_calls_per_s"] / results["filter_calls_per_s"]
    unit = f"calls/s, {of_filter:.0f} % of the filter's"
    measured("filter with [uncertainty]", unit, "told_filter_calls_per_s")
    for name, label in RANDOM.items():
        measured(f"random demands, {label}", "us a call", "random_call_us", name)
    for name in results["qp_us"]:
        measured(f"{name}, {TYPICAL_PROGRAMS:,} programs at once", "us per QP", "qp_us", name)
    singles = {"": "single_filter_latency_ms", ", with [uncertainty]": "told_filter_latency_ms"}
    for label, key in singles.items():
        measured(f"single filter call{label}", f"ms, p99 {results[key]['p99']:.3f}", key, "median")
    measured("learner", "samples/s", "learner_samples_per_s")
    measured("float32 matrix product", "Gflop/s", "matmul_gflops")
    share = 100 * results["learner_matmul_share"]
    lines.append(f"{'learner, share of the matrix product rate':44}{share:>14.1f}  %")
    lines.append(f"{'peak memory':44}{results['peak_memory_mb']:>14,.0f}  MB")

    if found := results["arithmetic"]:
        share = (
            f"{100 * found['statements_per_s'] / found['peak']:.0f} % of the rate of sums and products alone"
        )
        line = f"{found['statements']:>14,}  in {found['us']:.2f} us, {share}"
        lines.append(f"{'statements of a filter call, one core':44}{line}")

    curves = scaling_curves(results)
    for kind, rates in results["scaling"]["gymnasium_steps_per_s"].items():
        curves[f"through Gymnasium, {KINDS[kind]}"] = medians(rates)
    batches = sorted({n for rates in curves.values() for n in rates})
    lines += grid("median by batch, per s", batches, curves, 0)
    for name, seconds in results["compile_s"].items():
        lines.append(f"{f'to compile the {name}':44}{seconds:>14,.1f}  s")
    parts = results["closed_loop_us"]
    return "\n".join(lines + grid("us per step, RTA at 1 s", parts["total"], parts, 2))


def grid(title: str, counts: Iterable[int], rows: dict[str, dict[int, float]], digits: int) -> list[str]:
    """A line with the counts, and one for each row with what it has at each."""
    lines = ["", f"{title:28}" + "".join(f"{n:>12,}" for n in counts)]
    for label, row in rows.items():
        cells = (f"{row[n]:>12,.{digits}f}" if n in row else f"{'':12}" for n in counts)
        lines.append(f"{label:28}" + "".join(cells))
    return lines


def scaling_curves(results: dict[str, Any]) -> dict[str, dict[int, float]]:
    """Medians per s by what is done at once, by label."""
    scaling = results["scaling"]
    curves = {
        "filter calls": scaling["filter_calls_per_s"],
        "filter calls, told": scaling["told_filter_calls_per_s"],
        "simulator steps": scaling["simulator_steps_per_s"],
        **{f"closed-loop steps, {p} s": rates for p, rates in scaling["closed_loop_steps_per_s"].items()},
        "learner samples": scaling["learner_samples_per_s"],
        **{
            f"{name} programs": {n: us(each) for n, each in times.items()}
            for name, times in scaling["qp_us"].items()
        },
    }
    return {label: medians(rates) for label, rates in curves.items()}


def medians(rates: dict[int, Spread]) -> dict[int, float]:
    """The medians alone."""
    return {n: rate["median"] for n, rate in rates.items()}


def figure(results: dict[str, Any], file: Path | BinaryIO) -> None:
    """Every rate over the batch as a log-log plot, a PNG."""
    drawing = Figure(figsize=(8, 5.2), layout="constrained")
    ax = drawing.subplots()
    curves = scaling_curves(results).items()
    for (label, rates), marker, colour in zip(curves, "os^v<D*PX", PALETTE, strict=True):
        ax.plot(list(rates), list(rates.values()), marker=marker, color=colour, label=label)
    ax.set(xscale="log", yscale="log", ylabel="per second")
    ax.set_xlabel("at once (episodes, spacecraft, samples, programs)")
    ax.grid(True, which="major", alpha=0.4)
    ax.set_title(f"{results['device']}, {results['threads']} threads", fontsize=10)
    drawing.legend(loc="outside right upper", frameon=False, fontsize=9)
    drawing.savefig(file, dpi=120, format="png")
