"""The benchmark's results for people: a table and a figure."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from study.benchmark.measure import KINDS, REPEATS, TYPICAL_PROGRAMS, Spread, us

PALETTE = (
    "#0072B2",
    "#000000",
    "#D55E00",
    "#E69F00",
    "#CC79A7",
    "#009E73",
    "#56B4E9",
    "#666666",
)  # Okabe and Ito


def table(results: dict[str, Any]) -> str:
    """The results for a person."""
    low_high = results["min_max"]
    lines = [
        f"{results['device']}, {results['threads']} threads, {'compiled' if results['compiled'] else 'eager'}; "
        f"medians of {REPEATS} repeats [min, max], {results['batch']:,} episodes or spacecraft at once",
        "",
    ]

    def line(label: str, value: float, extremes: list[float], unit: str) -> None:
        digits = 0 if value >= 1000 else 3
        low, high = extremes
        lines.append(
            f"{label:44}{value:>14,.{digits}f}  [{low:,.{digits}f}, {high:,.{digits}f}] {unit}".rstrip()
        )

    native = results["simulator_steps_per_s"]
    line("simulator", native, low_high["simulator_steps_per_s"], "steps/s")
    for kind, rate in results["gymnasium_steps_per_s"].items():
        unit = f"steps/s, {100 * rate / native:.0f} % of the simulator's"
        line(
            f"simulator through Gymnasium, {KINDS[kind]}", rate, low_high["gymnasium_steps_per_s"][kind], unit
        )
    for name, rate in results["closed_loop_steps_per_s"].items():
        line(f"closed loop, RTA at {name} s", rate, low_high["closed_loop_steps_per_s"][name], "steps/s")
    line("filter", results["filter_calls_per_s"], low_high["filter_calls_per_s"], "calls/s")
    for name, time_us in results["qp_us"].items():
        line(f"{name}, {TYPICAL_PROGRAMS:,} programs at once", time_us, low_high["qp_us"][name], "us per QP")
    latency = results["single_filter_latency_ms"]
    line(
        "single filter call",
        latency["median"],
        low_high["single_filter_latency_ms"],
        f"ms, p99 {latency['p99']:.3f}",
    )
    line("learner", results["learner_samples_per_s"], low_high["learner_samples_per_s"], "samples/s")
    line("float32 matrix product", results["matmul_gflops"], low_high["matmul_gflops"], "Gflop/s")
    lines.append(
        f"{'learner, share of the matrix product rate':44}{100 * results['learner_matmul_share']:>14.1f}  %"
    )
    lines.append(f"{'peak memory':44}{results['peak_memory_mb']:>14,.0f}  MB")
    curves = scaling_curves(results)
    for kind, rates in results["scaling"]["gymnasium_steps_per_s"].items():
        curves[f"through Gymnasium, {KINDS[kind]}"] = medians(rates)
    batches = sorted({n for rates in curves.values() for n in rates})
    lines += ["", f"{'median by batch, per s':28}" + "".join(f"{n:>12,}" for n in batches)]
    for label, rates in curves.items():
        lines.append(
            f"{label:28}" + "".join(f"{rates[n]:>12,.0f}" if n in rates else f"{'':12}" for n in batches)
        )
    for name, seconds in results["compile_s"].items():
        lines.append(f"{f'to compile the {name}':44}{seconds:>14,.1f}  s")
    parts = results["closed_loop_us"]
    lines += ["", f"{'us per step, RTA at 1 s':28}" + "".join(f"{n:>12,}" for n in parts["total"])]
    for name, by_batch in parts.items():
        lines.append(f"{name:28}" + "".join(f"{us:>12,.2f}" for us in by_batch.values()))
    return "\n".join(lines)


def scaling_curves(results: dict[str, Any]) -> dict[str, dict[int, float]]:
    """Medians per s by what is done at once, by label."""
    scaling = results["scaling"]
    curves = {
        "filter calls": scaling["filter_calls_per_s"],
        "simulator steps": scaling["simulator_steps_per_s"],
        **{f"closed-loop steps, {p} s": rates for p, rates in scaling["closed_loop_steps_per_s"].items()},
        "learner samples": scaling["learner_samples_per_s"],
        **{
            f"{name} programs": {n: us(t) for n, t in times.items()}
            for name, times in scaling["qp_us"].items()
        },
    }
    return {label: medians(rates) for label, rates in curves.items()}


def medians(rates: dict[int, Spread]) -> dict[int, float]:
    """The medians alone."""
    return {n: rate["median"] for n, rate in rates.items()}


def figure(results: dict[str, Any], path: Path) -> None:
    """Every rate over the batch as a log-log plot, a PNG."""
    drawing = Figure(figsize=(8, 5.2), layout="constrained")
    ax = drawing.subplots()
    for (label, rates), marker, colour in zip(
        scaling_curves(results).items(), "os^v<D*P", PALETTE, strict=True
    ):
        ax.plot(list(rates), list(rates.values()), marker=marker, color=colour, label=label)
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="at once (episodes, spacecraft, samples, programs)",
        ylabel="per second",
    )
    ax.grid(True, which="major", alpha=0.4)
    ax.set_title(f"{results['device']}, {results['threads']} threads", fontsize=10)
    drawing.legend(loc="outside right upper", frameon=False, fontsize=9)
    drawing.savefig(path, dpi=120, format="png")
