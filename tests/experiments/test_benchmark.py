"""The benchmark: what it reports, that its rates count what they claim to, and whose numbers are shipped."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import main
from experiments import benchmark
from settings import load, override
from study.config import Config
from study.experiment import Experiment
from study.files import ROOT


@pytest.fixture(scope="module")
def shipped() -> dict:
    return json.loads((ROOT / "runs/reference/benchmark.json").read_text())


@pytest.fixture
def experiment() -> Experiment:
    train = replace(Config().train, device="cpu", compile="off")
    return Experiment(replace(Config(), train=train), 8)


@pytest.mark.campaign
def test_the_benchmark_writes_what_the_shipped_file_has_and_a_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, shipped: dict
) -> None:
    few = {"SHORTEST": 0.0, "REPEATS": 1, "STEPS": 2, "EPISODES": 64, "WARM_CALLS": 1, "SINGLE_CALLS": 5}
    few |= {"SAMPLES": 256, "FLOWN": 8, "PARTS_STEPS": 2}
    for name, value in few.items():
        monkeypatch.setattr(benchmark, name, value)
    results, drawing = tmp_path / "b.json", tmp_path / "b.png"
    arguments = ["benchmark", "--device", "cpu", "--compile", "on", "--batches", "16,64"]
    assert main.main([*arguments, "--json", str(results), "--figure", str(drawing)]) == 0
    out = capsys.readouterr().out
    found = json.loads(results.read_text())
    assert set(found) == set(shipped) and set(found["scaling"]) == set(shipped["scaling"])
    for key in ("gymnasium_steps_per_s", "closed_loop_steps_per_s"):
        assert set(found[key]) == set(shipped[key]) == set(shipped["scaling"][key])
    assert set(found["scaling"]["gymnasium_steps_per_s"]["numpy"]) == {"16", "64"}
    parts = {name: us["64"] for name, us in found["closed_loop_us"].items()}
    assert parts.pop("total") == pytest.approx(sum(parts.values()))
    assert all(us > 0.0 for us in parts.values())
    for name in ("simulator_steps_per_s", "filter_calls_per_s", "learner_samples_per_s", "matmul_gflops"):
        low, high = found["min_max"][name]
        assert 0 < low <= found[name] <= high
    assert all(key.replace("_", " ") in out for key in set(found) - {"scaling", "min_max", "filter"})
    assert drawing.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "name", ["1", *(pytest.param(name, marks=pytest.mark.campaign) for name in ("5", "10", "u1"))]
)
def test_the_shipped_numbers_are_of_the_filter_that_ships(name: str, shipped: dict) -> None:
    """Who changes the filter runs the benchmark again on a quiet machine, or takes its numbers away."""
    ours = benchmark.identity(benchmark.filters(Config())[name])
    assert shipped["filter"][name]["settings"] == ours["settings"]
    if shipped["torch"].partition("+")[0] != torch.__version__.partition("+")[0]:
        pytest.skip("another PyTorch may record another C")
    assert shipped["filter"][name] == ours


def test_the_robust_filter_is_measured_in_the_world_of_its_bounds() -> None:
    u1, robust = load(benchmark.U1, Config()), benchmark.filters(Config())["u1"]
    assert (robust.plant, robust.uncertainty) == (u1.plant, u1.uncertainty) and not robust.uncertainty.is_zero
    own = override(Config(), {"uncertainty": {"mass": 0.1}}, "test")
    assert benchmark.filters(own)["u1"] == own


def test_a_flight_holds_what_the_filter_met_in_the_later_half(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "EPISODES", 8)
    monkeypatch.setattr(benchmark, "STEPS", 2)
    generator = torch.Generator().manual_seed(1)
    x, desired = benchmark.record(
        experiment, lambda observation: 2.0 * torch.rand(len(observation), 6, generator=generator) - 1.0
    )
    assert x.shape == (16, 80) and desired.shape == (6, 80)  # ten calls of one step
