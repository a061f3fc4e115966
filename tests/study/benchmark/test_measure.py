"""The benchmark: what it promises to report, and that its parts count what they claim to count."""

import json
import time
from pathlib import Path

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

import main
from inspection.observation import SIZE as OBSERVATION_SIZE
from inspection.state import CONTROL_SIZE
from ppo.learner import PPO
from ppo.network import Value
from study import experiment as build
from study.benchmark import breakdown
from study.benchmark import measure as benchmark
from study.config import Config

KEYS = {
    "simulator_steps_per_s",
    "gymnasium_steps_per_s",
    "closed_loop_steps_per_s",
    "filter_calls_per_s",
    "single_filter_latency_ms",
    "qp_us",
    "learner_samples_per_s",
    "matmul_gflops",
    "closed_loop_us",
    "learner_matmul_share",
    "peak_memory_mb",
    "scaling",
}
CPU = torch.device("cpu")


def test_benchmark_writes_the_promised_json_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {"SHORTEST": 0.0, "STEPS": 4, "EPISODES": 64, "SINGLE_CALLS": 5, "PROGRAMS": (1, 64)}
    for name, value in (few | {"TYPICAL_PROGRAMS": 64}).items():
        monkeypatch.setattr(benchmark, name, value)
    monkeypatch.setattr(breakdown, "STEPS", 2)
    results, drawing = tmp_path / "b.json", tmp_path / "b.png"
    arguments = ["benchmark", "--device", "cpu", "--compile", "off", "--batches", "16,64"]
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
    assert drawing.read_bytes().startswith(b"\x89PNG")


def test_a_rate_is_work_over_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def work() -> None:
        nonlocal now
        now += 0.01

    monkeypatch.setattr(time, "perf_counter", lambda: now)
    rates = benchmark.repeated(work, 5.0, CPU)
    assert len(rates) >= 5
    assert rates == pytest.approx([500.0] * len(rates))


def test_learner_flops_are_those_that_pytorch_counts() -> None:
    config, generators = Config(), [torch.Generator().manual_seed(0)]
    policy, value = build.make_policy(config, generators), Value(OBSERVATION_SIZE, generators)
    learner = PPO(policy, value, config.ppo, generators)
    batch = {name: torch.randn(1, 64) for name in ("log_prob", "advantage", "return_")}
    batch |= {"observation": torch.randn(1, 64, OBSERVATION_SIZE), "action": torch.randn(1, 64, CONTROL_SIZE)}
    with FlopCounterMode(display=False) as counter:
        learner._loss(batch)[0].sum().backward()
    assert counter.get_total_flops() == 64 * benchmark.learner_flops(config)


def test_a_missing_trained_agent_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(benchmark, "TRAINED", tmp_path / "none.pt")
    assert benchmark.trained_actor(CPU) is None
    assert "none.pt" in capsys.readouterr().out
