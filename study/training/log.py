"""The log of a training run: TensorBoard, a progress bar, evaluations.jsonl."""

import json
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from textwrap import indent
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from ppo.files import naming
from study.errors import MALFORMED, as_input_error
from study.files import as_object, write_text
from study.flight.evaluation import Episodes
from study.flight.summary import iqm
from study.machine import bar
from study.training.monitor import EPISODE, Monitor

MEANING = (
    "an interaction is one decision of the agent; once each of the parallel episodes has ended, the bar shows means "
    "over the latest ones (dv: delta v, violation: share of their steps that broke a limit); flying test cases: an "
    "evaluation of the agent so far"
)
LESSON = "losses/lesson_action"  # a tag of the imitation phase only
TAUGHT = "learning from the guidance"
# metric of an episode, and its format beside the bar
LATEST = {
    "success_percent": "success {:.0f} %",
    "reward": "reward {:.2f}",
    "delta_v_m_s": "dv {:.1f} m/s",
    "violation_percent": "violation {:.1f} %",
}


class Log:
    """Logs a run in its directory; several seeds side by side also have charts in their own directories.

    Args:
        seed_dirs: the seeds' directories; batch: interactions of each seed in an update.
    """

    def __init__(self, directory: Path, seed_dirs: Sequence[Path], batch: int) -> None:
        self.evaluations = directory / "evaluations.jsonl"
        self.folders = [directory, *seed_dirs] if len(seed_dirs) > 1 else [directory]
        self.seeds, self.batch = len(seed_dirs), batch

    @contextmanager
    def open(self, interactions: int, total: int, settings: str) -> Iterator[None]:
        """Shows training from `interactions` of each seed on; removes points that were drawn after this number.

        Args:
            total: interactions of each seed in the end; settings: of the run, as TOML.
        """
        with leaving_it_to_the_caller():
            self.charts = []
            for folder in self.folders:
                with naming(folder):  # without points that an earlier run drew from here on
                    self.charts.append(SummaryWriter(str(folder), purge_step=interactions + 1))
            with naming(file_of(self.charts[0])):
                self.charts[0].add_text("config", indent(settings, "    "), interactions)  # Markdown's code
            if interactions < total:
                print(MEANING, file=sys.stderr)
            try:
                with bar(total, "interactions", initial=interactions) as self.bar:
                    yield
            finally:
                for charts in self.charts:
                    with naming(file_of(charts)):
                        charts.close()

    def draw(self, charts: SummaryWriter, scalars: Mapping[str, float], interactions: int) -> None:
        """Adds a point to the chart of each scalar."""
        with naming(file_of(charts)):
            for tag, value in scalars.items():
                charts.add_scalar(tag, value, interactions)
            charts.flush()

    def update(self, reports: Sequence[tuple[dict[str, float], Monitor]], interactions: int) -> None:
        """Shows the statistics and the transitions of an update, or of an imitation batch, from each rank."""
        parts, (monitor, *others) = zip(*reports, strict=True)
        seeds = [each.seeds for _, each in reports]
        for other in others:
            monitor.add(other)
        for k, charts in enumerate(self.charts[1:]):
            self.draw(charts, monitor.episode_means(k), interactions)
        statistics = {tag: fmean((part[tag] for part in parts), seeds) for tag in parts[0]}
        slowest = max(part["time/rollout_s"] + part["time/learning_s"] for part in parts)
        statistics |= monitor.scalars() | {"charts/SPS": self.seeds * self.batch / slowest}
        self.draw(self.charts[0], statistics, interactions)
        latest = [
            text.format(statistics[f"episode/{name}"])
            for name, text in LATEST.items()
            if f"episode/{name}" in statistics
        ]
        if LESSON in statistics:
            latest.insert(0, TAUGHT)
        if latest or self.bar.postfix == TAUGHT:
            self.bar.set_postfix_str(", ".join(latest), refresh=False)
        self.bar.update(self.batch)

    def evaluation(
        self, record: Episodes, reports: Sequence[dict[str, Any]], interactions: int, seconds: float
    ) -> None:
        """Shows the episodes of a periodic evaluation; writes a line per seed with all metrics to evaluations.jsonl.

        Args:
            record: episodes of all seeds; reports: one per seed; seconds: wall-clock s of training so far.
        """
        episodes = record.split(self.seeds)
        for charts, shown in zip(self.charts, (record, *episodes), strict=False):
            self.draw(charts, evaluation_scalars(shown), interactions)
        lines = []
        for own, results in zip(episodes, reports, strict=True):
            cases = dict(zip(METRICS, own.metrics.tolist(), strict=True))
            line = {"interactions": interactions, "seconds": seconds} | results | {"cases": cases}
            lines.append(json.dumps(line) + "\n")
        with naming(self.evaluations), open(self.evaluations, "a", encoding="utf-8") as file:
            file.writelines(lines)

    def begun(self) -> bool:
        """Tells whether anything has been evaluated."""
        return self.evaluations.is_file() and self.evaluations.stat().st_size > 0

    def forget_evaluations_after(self, interactions: int) -> None:
        """Deletes the evaluations of a killed run after its last checkpoint."""
        if self.evaluations.is_file():
            lines = self.evaluations.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            with as_input_error(f"{self.evaluations}: not the evaluations of a run", *MALFORMED):
                kept = [line for line in whole if as_object(line)["interactions"] <= interactions]
            kept = kept[: len(kept) // self.seeds * self.seeds]  # lines of all seeds, or of none
            if kept != lines:
                write_text(self.evaluations, "".join(kept))


@contextmanager
def leaving_it_to_the_caller() -> Iterator[None]:
    """Keeps TensorBoard's threads from printing write errors, because the next flush raises them."""
    usual = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        if not type(failed.thread).__module__.startswith("tensorboard."):
            usual(failed)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = usual


def file_of(charts: SummaryWriter) -> str:
    """Returns the name of the file that charts are written to."""
    writer: Any = charts.file_writer  # None if it is closed
    return str(writer.event_writer._file_name)


def evaluation_scalars(record: Episodes) -> dict[str, float]:
    """Returns TensorBoard's scalars of evaluated episodes."""
    success = 100.0 * (record.outcome == OUTCOMES.index("success")).double().mean().item()
    values = *(float(iqm(metric)) for metric in record.metrics.cpu().numpy()), success
    return {f"evaluation/{name}": value for name, value in zip(EPISODE, values, strict=True)}


def times(started: float, collected: float, learned: float) -> dict[str, float]:
    """Returns the s that an update or a lesson took, by TensorBoard's tags."""
    return {"time/rollout_s": collected - started, "time/learning_s": learned - collected}
