"""What a training run shows and keeps of its course: TensorBoard, a progress bar, evaluations.jsonl."""

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from inspection.environment import METRICS
from inspection.termination import OUTCOMES
from study.files import write_text
from study.flight.evaluation import Episodes
from study.flight.summary import iqm
from study.training.monitor import Monitor

BAR = {
    "bar_format": "{percentage:3.0f}%|{bar}| {n:,}/{total:,} [{elapsed}<{remaining}, {rate_fmt}{postfix}]",
    "unit": " interactions",
    "dynamic_ncols": True,
    "mininterval": 1.0,  # s
}
# Beside the bar: label, tag and digits
LATEST = (
    ("success", "charts/success", 2),
    ("reward", "charts/reward", 2),
    ("dv", "charts/delta_v_m_s", 1),
    ("violation", "charts/violation_percent", 2),
)


class Log:
    """The log of a run in its directory; of several seeds side by side, each also has charts in its own.

    Args:
        homes: the seeds' directories; batch: interactions of each seed in an update.
    """

    def __init__(self, directory: Path, homes: Sequence[Path], batch: int) -> None:
        self.evaluations = directory / "evaluations.jsonl"
        self.folders = [directory, *homes] if len(homes) > 1 else [directory]
        self.seeds, self.batch = len(homes), batch

    @contextmanager
    def open(self, interactions: int, total: int) -> Iterator[None]:
        """Shows training from so many interactions of each seed on."""
        with ExitStack() as stack:
            self.writers = [
                stack.enter_context(SummaryWriter(str(folder), purge_step=interactions + 1))
                for folder in self.folders
            ]
            self.bar = stack.enter_context(tqdm(total=total, initial=interactions, **BAR))
            yield

    def update(self, reports: Sequence[tuple[dict[str, float], Monitor]], interactions: int) -> None:
        """Shows the statistics and the transitions of an update, from each rank."""
        parts, (monitor, *others) = zip(*reports, strict=True)
        seeds = [each.seeds for _, each in reports]
        for other in others:
            monitor.add(other)
        for k, writer in enumerate(self.writers[1:]):
            show(writer, monitor.charts(k), interactions)
        statistics = {tag: fmean((part[tag] for part in parts), seeds) for tag in parts[0]}
        slowest = max(part["time/rollout_s"] + part["time/learning_s"] for part in parts)
        statistics |= monitor.scalars() | {"charts/SPS": self.seeds * self.batch / slowest}
        show(self.writers[0], statistics, interactions)
        latest = {
            label: f"{statistics[tag]:.{digits}f}" for label, tag, digits in LATEST if tag in statistics
        }
        self.bar.set_postfix(latest, refresh=False)
        self.bar.update(self.batch)

    def evaluation(
        self, record: Episodes, reports: Sequence[dict[str, Any]], interactions: int, seconds: float
    ) -> None:
        """Shows the episodes of a periodic evaluation; a line per seed in evaluations.jsonl, with every case's metrics.

        Args:
            record: episodes of all seeds; reports: of each seed's; seconds: wall-clock of training so far.
        """
        episodes = record.split(self.seeds)
        for writer, shown in zip(self.writers, (record, *episodes), strict=False):
            show(writer, evaluation_scalars(shown), interactions)
        lines = []
        for own, results in zip(episodes, reports, strict=True):
            cases = dict(zip(METRICS, own.metrics.tolist(), strict=True))
            line = {"interactions": interactions, "seconds": seconds} | results | {"cases": cases}
            lines.append(json.dumps(line) + "\n")
        with open(self.evaluations, "a", encoding="utf-8") as file:
            file.writelines(lines)

    def forget_evaluations_after(self, interactions: int) -> None:
        """Drops what a run that was killed had evaluated after its last checkpoint."""
        if self.evaluations.is_file():
            lines = self.evaluations.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            kept = [line for line in whole if json.loads(line)["interactions"] <= interactions]
            write_text(self.evaluations, "".join(kept))


def show(writer: SummaryWriter, scalars: dict[str, float], interactions: int) -> None:
    """Adds a point to each chart."""
    for tag, value in scalars.items():
        writer.add_scalar(tag, value, interactions)


def evaluation_scalars(record: Episodes) -> dict[str, float]:
    """What TensorBoard shows of evaluated episodes."""
    metrics = zip(METRICS, record.metrics.cpu().numpy(), strict=True)
    success = (record.outcome == OUTCOMES.index("success")).double().mean().item()
    return {f"evaluation/{name}": float(iqm(values)) for name, values in metrics} | {
        "evaluation/success": success
    }
