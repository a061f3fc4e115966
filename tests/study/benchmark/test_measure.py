"""The benchmark as a whole: what it promises to report."""

import json
from pathlib import Path

import pytest
import torch

import main
from settings import load, override
from study import verified
from study.benchmark import breakdown, flights, measure, presentation, rates, timing
from study.config import Config
from study.files import ROOT

KEYS = {
    "simulator_steps_per_s",
    "gymnasium_steps_per_s",
    "closed_loop_steps_per_s",
    "filter_calls_per_s",
    "told_filter_calls_per_s",
    "single_filter_latency_ms",
    "told_filter_latency_ms",
    "qp_us",
    "learner_samples_per_s",
    "matmul_gflops",
    "closed_loop_us",
    "random_call_us",
    "filter",
    "learner_matmul_share",
    "peak_memory_mb",
    "scaling",
}


def test_benchmark_writes_the_promised_json_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {
        timing: {"SHORTEST": 0.0, "REPEATS": 1},
        flights: {"STEPS": 2, "EPISODES": 64},
        rates: {"WARM_CALLS": 1, "SINGLE_CALLS": 5, "SAMPLES": 256},
        measure: {"PROGRAMS": (1, 64), "TYPICAL_PROGRAMS": 64, "FLOWN": 8},
        presentation: {"TYPICAL_PROGRAMS": 64},
        breakdown: {"STEPS": 2},
    }
    for module, settings in few.items():
        for name, value in settings.items():
            monkeypatch.setattr(module, name, value)
    results, drawing = tmp_path / "b.json", tmp_path / "b.png"
    arguments = ["benchmark", "--device", "cpu", "--compile", "on", "--batches", "16,64"]
    assert main.main([*arguments, "--json", str(results), "--figure", str(drawing)]) == 0
    out = capsys.readouterr().out
    found = json.loads(results.read_text())
    assert set(found) >= KEYS
    assert set(found["closed_loop_steps_per_s"]) == {"1", "5", "10"}
    assert set(found["gymnasium_steps_per_s"]) == {"numpy", "torch"}
    assert set(found["scaling"]["gymnasium_steps_per_s"]["numpy"]) == {"16", "64"}
    assert set(found["single_filter_latency_ms"]) == {"median", "p99"}
    assert set(found["qp_us"]) == {"piqp", "batched"}
    assert set(found["scaling"]["filter_calls_per_s"]) == {"16", "64"}
    parts = {name: us["64"] for name, us in found["closed_loop_us"].items()}
    assert parts.pop("total") == pytest.approx(sum(parts.values()))
    assert all(us > 0.0 for us in parts.values())
    for name in ("simulator_steps_per_s", "filter_calls_per_s", "learner_samples_per_s", "matmul_gflops"):
        low, high = found["min_max"][name]
        assert 0 < low <= found[name] <= high
    assert "closed loop, RTA at 10 s" in out and "through Gymnasium, NumPy" in out and "peak memory" in out
    assert "64 programs at once" in out
    assert drawing.read_bytes().startswith(b"\x89PNG")


def test_headline_numbers_are_those_at_a_count() -> None:
    few, many = ({"median": middle, "min": middle - 1, "max": middle + 1} for middle in (10.0, 20.0))
    curve = {16: few, 64: many}
    assert measure.at(64, curve) == many
    nested = measure.at(16, {"1": curve, "5": {16: many}})
    assert nested == {"1": few, "5": many}
    assert measure.pick_out({"loop": nested, "filter": few}, lambda spread: spread["max"]) == {
        "loop": {"1": 11.0, "5": 21.0},
        "filter": 11.0,
    }
    assert measure.nearest((256, 1024, 4096), 1000) == 1024


def test_the_told_filter_is_measured_in_the_world_that_it_is_told_of() -> None:
    u1 = load(measure.U1, Config())
    told = measure.in_u1(Config())
    assert (told.plant, told.uncertainty) == (u1.plant, u1.uncertainty) and not told.uncertainty.is_nil
    own = override(Config(), {"uncertainty": {"mass": 0.1}}, "test")
    assert measure.in_u1(own) is own


@pytest.mark.parametrize("name", ["1", "5", "10", "u1"])
def test_the_shipped_numbers_are_of_the_filter_that_ships(name: str) -> None:
    """Who changes the filter runs the benchmark again on a quiet machine, or takes its numbers away."""
    shipped = json.loads((ROOT / "runs/reference/benchmark.json").read_text())
    ours = measure.identity(measure.filters(Config())[name])
    assert shipped["filter"][name]["settings"] == ours["settings"]
    if shipped["torch"].partition("+")[0] != torch.__version__.partition("+")[0]:
        pytest.skip("another PyTorch may record another C")
    assert shipped["filter"][name] == ours


def test_another_filter_has_another_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its settings, and by its code where these are the same."""
    config = Config()
    before = measure.identity(config)
    faster = override(config, {"rta": {"speed_gain": 0.21}}, "test")
    assert all(a != b for a, b in zip(before.values(), measure.identity(faster).values(), strict=True))
    implementation = verified.implementation
    monkeypatch.setattr(verified, "implementation", lambda f: implementation(f).replace("0.25", "0.26"))
    after = measure.identity(config)
    assert after["settings"] == before["settings"] and after["code"] != before["code"]
