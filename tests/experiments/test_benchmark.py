"""The benchmark: what it reports, that its rates count what they claim to, and whose numbers are shipped."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

import main
from experiments import benchmark
from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE
from ppo import checkpoint
from rta.qp.programs import Problems, Solutions, Status
from settings import load, override, to_toml
from study import verified
from study.config import Config
from study.experiment import Experiment, load_policy, make_policy
from study.files import ROOT

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def shipped() -> dict:
    return json.loads((ROOT / "runs/reference/benchmark.json").read_text())


@pytest.fixture
def experiment() -> Experiment:
    train = replace(Config().train, device="cpu", compile="off")
    return Experiment(replace(Config(), train=train), 8)


def test_the_benchmark_writes_what_the_shipped_file_has_and_a_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, shipped: dict
) -> None:
    few = {"SHORTEST": 0.0, "REPEATS": 1, "STEPS": 2, "EPISODES": 64, "WARM_CALLS": 1, "SINGLE_CALLS": 5}
    few |= {"SAMPLES": 256, "TYPICAL_PROGRAMS": 64, "FLOWN": 8, "PARTS_STEPS": 2, "PROGRAMS": (1, 64)}
    for name, value in few.items():
        monkeypatch.setattr(benchmark, name, value)
    results, drawing = tmp_path / "b.json", tmp_path / "b.png"
    arguments = ["benchmark", "--device", "cpu", "--compile", "on", "--batches", "16,64"]
    assert main.main([*arguments, "--json", str(results), "--figure", str(drawing)]) == 0
    out = capsys.readouterr().out
    found = json.loads(results.read_text())
    assert set(found) == set(shipped) and set(found["scaling"]) == set(shipped["scaling"])
    for key in ("gymnasium_steps_per_s", "closed_loop_steps_per_s", "qp_us"):
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


@pytest.mark.parametrize("name", ["1", "5", "10", "u1"])
def test_the_shipped_numbers_are_of_the_filter_that_ships(name: str, shipped: dict) -> None:
    """Who changes the filter runs the benchmark again on a quiet machine, or takes its numbers away."""
    ours = benchmark.identity(benchmark.filters(Config())[name])
    assert shipped["filter"][name]["settings"] == ours["settings"]
    if shipped["torch"].partition("+")[0] != torch.__version__.partition("+")[0]:
        pytest.skip("another PyTorch may record another C")
    assert shipped["filter"][name] == ours


def test_another_filter_has_another_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its settings, and by its code where these are the same."""
    config = Config()
    before = benchmark.identity(config)
    faster = override(config, {"rta": {"speed_gain": 0.21}}, "test")
    assert all(a != b for a, b in zip(before.values(), benchmark.identity(faster).values(), strict=True))
    implementation = verified.implementation
    monkeypatch.setattr(verified, "implementation", lambda f: implementation(f).replace("0.25", "0.26"))
    after = benchmark.identity(config)
    assert after["settings"] == before["settings"] and after["code"] != before["code"]


def test_the_told_filter_is_measured_in_the_world_that_it_is_told_of() -> None:
    u1, told = load(benchmark.U1, Config()), benchmark.filters(Config())["u1"]
    assert (told.plant, told.uncertainty) == (u1.plant, u1.uncertainty) and not told.uncertainty.is_nil
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
    unsafe = experiment.filter.correct(x, desired).program_status > Status.UNTOUCHED
    found = benchmark.programs(experiment.filter, x, desired)
    assert sorted(part.desired.shape[1] for part in found) == sorted(unsafe.sum(1).tolist())


def test_every_episode_starts_from_a_state_met() -> None:
    env = InspectionEnv(5, InspectionParameters(), [torch.Generator().manual_seed(0)])
    env.reset()
    met = env.x[:, :2]
    observation = benchmark.start(env, met)
    assert torch.equal(env.x, met[:, [0, 1, 0, 1, 0]]) and observation.shape == (5, 26)
    assert torch.equal(env.sight.priority, torch.eye(3, dtype=torch.float64)[:, [0, 1, 2, 0, 1]])


def test_the_shipped_agent_acts_on_what_it_observes(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    agent, config = load_policy(benchmark.TRAINED)
    seen = Config(inspection=replace(config.inspection, observed=("sun", "hill")), ppo=config.ppo)
    other = make_policy(seen, [torch.Generator()])
    checkpoint.save(tmp_path / "other.pt", {"policy": other.state_dict(), "config": to_toml(seen)})
    for path, policy in ((benchmark.TRAINED, agent), (tmp_path / "other.pt", other)):
        monkeypatch.setattr(benchmark, "TRAINED", path)
        seeing, acts = benchmark.trained(experiment)
        observation = seeing.env(3).reset()
        assert torch.equal(acts(observation), policy.mean_action(observation[None])[0])
        assert seeing.filter is experiment.filter


def test_rates_are_work_over_time_by_a_clock_of_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, order = [0.0], []
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def work(name: str, seconds: float) -> None:
        order.append(name)
        clock[0] += seconds

    rate = benchmark.per_second(lambda: work("short", 0.01), 5.0, CPU)
    assert rate == pytest.approx({"median": 500.0, "min": 500.0, "max": 500.0})
    assert len(order) == 2 + 5 * benchmark.REPEATS >= 27  # 0.05 s a repeat
    clock[0] = 0.0
    durations = iter([1.0, 1.0, 0.5, 0.25, 1.0, 2.0, 4.0])  # the first two are no repeats
    rate = benchmark.per_second(lambda: work("", next(durations)), 1.0, CPU)
    assert rate == {"median": 1.0, "min": 0.25, "max": 4.0}
    assert benchmark.us(rate) == {"median": 1e6, "min": 0.25e6, "max": 4e6}
    order.clear()
    found = benchmark.in_turn({"a": lambda: work("a", 1.0), "b": lambda: work("b", 2.0)}, 6.0, CPU)
    assert {name: rate["median"] for name, rate in found.items()} == {"a": 6.0, "b": 3.0}
    assert order == ["a", "a", "b", "b"] + ["a", "b"] * benchmark.REPEATS


def test_learner_flops_are_those_that_pytorch_counts(experiment: Experiment) -> None:
    learner = benchmark.fresh_learner(experiment)
    batch = {name: torch.randn(1, 64) for name in ("log_prob", "advantage", "return_")}
    batch |= {"observation": torch.randn(1, 64, 26), "action": torch.randn(1, 64, CONTROL_SIZE)}
    with FlopCounterMode(display=False) as counter:
        learner._loss(batch)[0].sum().backward()
    assert counter.get_total_flops() == 64 * benchmark.learner_flops(learner)


def test_single_calls_meet_one_spacecraft_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "WARM_CALLS", 2)
    monkeypatch.setattr(benchmark, "SINGLE_CALLS", 3)
    met: list[float] = []

    def safety_filter(x: np.ndarray, desired: np.ndarray) -> None:
        assert x.shape == (16,) and desired.shape == (6,) and x.flags.c_contiguous and x[0] == desired[0]
        met.append(x[0])

    number = torch.arange(4.0)
    latencies = benchmark.single_latencies(safety_filter, number.expand(16, -1), number.expand(6, -1))
    assert met == [0.0, 1.0, 2.0, 3.0, 0.0]
    assert len(latencies) == 3 and latencies == sorted(latencies)


def test_a_solver_is_given_as_many_programs_of_each_group_as_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    class Solver:
        def solve(self, problems: Problems) -> Solutions | None:
            asked.append(problems.desired.shape[1])

    monkeypatch.setattr(benchmark, "per_second", lambda function, work, device: (function(), work)[1])
    ones = torch.ones(2, 3, 5)
    group = Problems(ones[0], ones, ones[:, 0], ones[:, 0], ones[:, 0, 0])
    assert benchmark.solver_rate(Solver(), [group, group], 8) == sum(asked) == 16
    assert asked == [8, 8]
