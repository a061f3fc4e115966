"""The log: charts in TensorBoard, evaluations.jsonl, and what a killed run leaves of it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from study.flight.evaluation import RAW_QUANTITIES, Episodes
from study.flight.summary import iqm
from study.training.log import LESSON, Log
from study.training.monitor import EPISODE, Monitor

BATCH = 24


def charts(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """Returns TensorBoard's scalars."""
    events = EventAccumulator(str(directory))
    events.Reload()
    tags = events.Tags()["scalars"]
    return {tag: [(event.step, pytest.approx(event.value)) for event in events.Scalars(tag)] for tag in tags}


def record(seeds: int, cases: int, generator: torch.Generator) -> Episodes:
    """Episodes with random metrics and outcomes, nothing else."""
    count = seeds * cases
    metrics = torch.rand(len(METRICS), count, generator=generator, dtype=torch.float64)
    outcome = torch.randint(len(OUTCOMES), (count,), generator=generator)
    nothing, percent, zeros = torch.zeros(13, count), torch.zeros(14, count), torch.zeros(count)
    extremes = torch.zeros(len(RAW_QUANTITIES), count)
    clear = torch.zeros(count, dtype=torch.bool)
    counts = zeros, zeros, zeros, zeros, nothing
    return Episodes(metrics, percent, percent, outcome, clear, *counts, nothing, extremes)


def ended(seed: int, reward: float) -> Monitor:
    """Returns a monitor of one seed that saw an episode end."""
    monitor = Monitor(("near",), 1, seed)
    monitor.steps += BATCH
    monitor.count(violated=torch.tensor([6 * (1 + seed)]), any_violated=torch.tensor(6 * (1 + seed)))
    metrics = torch.full((len(METRICS) + 3, 1), reward)
    metrics[-3], metrics[-2], metrics[-1] = 100.0, 1.0, seed
    monitor.episodes.append(metrics)
    return monitor


def quiet() -> Monitor:
    """Returns a monitor that saw no episode end."""
    monitor = Monitor(("near",))
    monitor.steps += BATCH
    monitor.count(violated=torch.tensor([0]), any_violated=torch.tensor(0))
    return monitor


def test_an_update_is_shown_for_all_and_for_each_seed(tmp_path: Path) -> None:
    seed_dirs = [tmp_path / "seed5", tmp_path / "seed6", tmp_path / "seed7"]
    for home in seed_dirs:
        home.mkdir()
    log = Log(tmp_path, seed_dirs, BATCH)
    two = ended(1, 2.0)
    two.seeds, two.episodes = 2, two.episodes + ended(2, 6.0).episodes
    reports = [
        ({"losses/x": 1.0, "time/rollout_s": 0.5, "time/learning_s": 1.0}, ended(0, 1.0)),
        (
            {"losses/x": 4.0, "time/rollout_s": 1.0, "time/learning_s": 2.0},
            two,
        ),  # a rank that trains two seeds
    ]
    with log.open(0, 2 * BATCH, "[train]\nseed = 5\n"):
        log.update(reports, BATCH)
        assert (log.bar.n, log.bar.total) == (BATCH, 2 * BATCH)
        expected = "success 100 %, reward 3.00, dv 3.0 m/s, violation 3.0 %"
        assert log.bar.postfix == expected
        seconds = {"time/rollout_s": 1.0, "time/learning_s": 1.0}
        log.update([(dict(seconds), quiet())], 2 * BATCH)  # no episode ended: the bar keeps its text
        assert log.bar.postfix == expected
        log.update([(seconds | {LESSON: 1.0}, quiet())], 2 * BATCH)
        assert log.bar.postfix == "learning from the guidance"
        log.update([(dict(seconds), quiet())], 2 * BATCH)
        assert not log.bar.postfix
    shown = charts(tmp_path)
    assert shown["losses/x"] == [(BATCH, 3.0)]
    assert shown["charts/SPS"][0] == (BATCH, 3 * BATCH / 3.0)  # by the rank that took longest
    assert shown["episode/reward"] == [(BATCH, 3.0)]
    assert shown["episode/count"] == [(BATCH, 3.0)]
    assert shown["violation_percent/near"][0] == (BATCH, 100.0 * 18 / (2 * BATCH))
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    (settings,) = events.Tensors("config/text_summary")
    assert settings.tensor_proto.string_val == [b"    [train]\n    seed = 5\n"]
    for home, reward in zip(seed_dirs, (1.0, 2.0, 6.0), strict=True):
        shown = charts(home)
        assert shown["episode/reward"] == [(BATCH, reward)]
        assert set(shown) == {f"episode/{name}" for name in (*EPISODE, "count")}


def test_an_evaluation_is_a_line_and_a_chart_for_each_seed(
    tmp_path: Path, generator: torch.Generator
) -> None:
    seed_dirs = [tmp_path / "seed5", tmp_path / "seed6"]
    for home in seed_dirs:
        home.mkdir()
    log, episodes = Log(tmp_path, seed_dirs, BATCH), record(2, 4, generator)
    with log.open(0, BATCH, ""):
        log.evaluation(episodes, [{"seed": 5}, {"seed": 6}], BATCH, 1.5)
    lines = [json.loads(line) for line in log.evaluations.read_text().splitlines()]
    for k, (home, line) in enumerate(zip(seed_dirs, lines, strict=True)):
        own = slice(4 * k, 4 * k + 4)
        assert (line["interactions"], line["seconds"], line["seed"]) == (BATCH, 1.5, 5 + k)
        assert np.array(list(line["cases"].values())) == pytest.approx(episodes.metrics[:, own].numpy())
        success = 100.0 * (episodes.outcome[own] == OUTCOMES.index("success")).double().mean().item()
        assert charts(home)["evaluation/success_percent"] == [(BATCH, success)]
    for name, values in zip(EPISODE, episodes.metrics.numpy(), strict=False):
        assert charts(tmp_path)[f"evaluation/{name}"] == [(BATCH, float(iqm(values)))]


@pytest.fixture
def killed(tmp_path: Path) -> Log:
    """Returns the log of a run that was killed during its fourth evaluation."""
    log = Log(tmp_path, [tmp_path], BATCH)
    lines = [json.dumps({"interactions": k * BATCH, "seed": seed}) for k in (1, 2, 3) for seed in (0, 1)]
    log.evaluations.write_text("\n".join(lines) + '\n{"interactions": 24, "se')
    return log


@pytest.mark.parametrize(("done", "kept"), [(0, 0), (1, 2), (2, 4), (3, 6), (9, 6)])
def test_evaluations_after_the_last_checkpoint_are_forgotten(killed: Log, done: int, kept: int) -> None:
    before = killed.evaluations.read_text().splitlines()
    killed.forget_evaluations_after(done * BATCH)
    assert killed.evaluations.read_text() == "".join(f"{line}\n" for line in before[:kept])
