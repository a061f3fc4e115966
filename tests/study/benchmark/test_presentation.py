"""The table and the figure of made-up results."""

from pathlib import Path
from typing import Any

import pytest

from study.benchmark import presentation


def spread(middle: float) -> dict[str, float]:
    return {"median": middle, "min": middle / 2, "max": middle * 2}


@pytest.fixture
def results() -> dict[str, Any]:
    """Results at batches of 16 and 64, the solvers' at one program and 64."""
    by_batch = {16: spread(500.0), 64: spread(2000.0)}
    scaling = {
        "simulator_steps_per_s": by_batch,
        "gymnasium_steps_per_s": {"numpy": by_batch, "torch": by_batch},
        "closed_loop_steps_per_s": {"1": by_batch, "5": by_batch, "10": by_batch},
        "filter_calls_per_s": by_batch,
        "told_filter_calls_per_s": {16: spread(250.0)},
        "learner_samples_per_s": by_batch,
        "qp_us": {name: {1: spread(100.0), 64: spread(2.5)} for name in ("piqp", "batched")},
    }
    headline = {"simulator_steps_per_s": 4000.0, "filter_calls_per_s": 2000.0, "matmul_gflops": 12.5}
    headline["told_filter_calls_per_s"] = 500.0
    headline["random_call_us"] = {"paper": 1.5, "edge": 20.0, "u1": 60.0}
    headline |= {"learner_samples_per_s": 3000.0, "gymnasium_steps_per_s": {"numpy": 3000.0, "torch": 4000.0}}
    headline |= {"closed_loop_steps_per_s": {"1": 100.0, "5": 200.0, "10": 300.0}}
    headline |= {"qp_us": {"piqp": 20.0, "batched": 2.0}}
    low_high = {
        key: {name: [each / 2, 2 * each] for name, each in value.items()}
        if isinstance(value, dict)
        else [value / 2, 2 * value]
        for key, value in headline.items()
    }
    return headline | {
        "single_filter_latency_ms": {"median": 0.35, "p99": 1.25},
        "told_filter_latency_ms": {"median": 4.5, "p99": 20.0},
        "closed_loop_us": {"total": {16: 100.0, 64: 60.0}, "rest": {16: 7.125, 64: 3.0}},
        "learner_matmul_share": 0.5,
        "peak_memory_mb": 1234.5,
        "compile_s": {"filter": 60.04},
        "arithmetic": {"statements": 6543, "us": 0.5, "statements_per_s": 2e10, "peak": 5e10},
        "scaling": scaling,
        "min_max": low_high
        | {"single_filter_latency_ms": [0.25, 2.5], "told_filter_latency_ms": [4.0, 30.0]},
        "batch": 64,
        "threads": 2,
        "device": "cpu (made up)",
        "compiled": True,
    }


@pytest.mark.parametrize(
    "line",
    [
        "cpu (made up), 2 threads, compiled; medians of 5 repeats [min, max], 64 episodes or spacecraft at once",
        "simulator                                            4,000  [2,000, 8,000] steps/s",
        "simulator through Gymnasium, NumPy                   3,000  [1,500, 6,000] steps/s, 75 % of the simulator's",
        "closed loop, RTA at 5 s                            200.000  [100.000, 400.000] steps/s",
        "batched, 1,024 programs at once                      2.000  [1.000, 4.000] us per QP",
        "statements of a filter call, one core                6,543  in 0.50 us, 40 % of the rate of sums and "
        "products alone",
        "single filter call                                   0.350  [0.250, 2.500] ms, p99 1.250",
        "filter with [uncertainty]                          500.000  "
        "[250.000, 1,000.000] calls/s, 25 % of the filter's",
        "single filter call, with [uncertainty]               4.500  [4.000, 30.000] ms, p99 20.000",
        "learner, share of the matrix product rate             50.0  %",
        "median by batch, per s                 1          16          64",
        "learner samples                                  500       2,000",
        "piqp programs                     10,000                 400,000",
        "to compile the filter                                 60.0  s",
        "rest                                7.12        3.00",
    ],
)
def test_the_table_has_a_line_for_each_measurement(results: dict[str, Any], line: str) -> None:
    assert line in presentation.table(results).splitlines()


def test_the_figure_shows_every_curve(results: dict[str, Any], tmp_path: Path) -> None:
    assert list(presentation.scaling_curves(results)) == [
        "filter calls",
        "filter calls, told",
        "simulator steps",
        "closed-loop steps, 1 s",
        "closed-loop steps, 5 s",
        "closed-loop steps, 10 s",
        "learner samples",
        "piqp programs",
        "batched programs",
    ]
    presentation.figure(results, tmp_path / "rates.png")
    assert (tmp_path / "rates.png").read_bytes().startswith(b"\x89PNG")
