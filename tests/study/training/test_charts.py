"""The charts: what a series is, and that the page explains every tag that a run can draw and no other."""

import itertools
import re
from collections.abc import Iterable
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import main
from rta.constraints.names import CONSTRAINTS
from settings import from_toml, override
from study.config import Config
from study.training import charts as charts_of_training
from study.training import session as training
from study.training.charts import Charts

PAGE = Path(main.__file__).parent / "docs" / "reference" / "tensorboard.md"
SHORT = """
[train]
interactions = 12
jump_start = 4
num_envs = 2
rollout_steps = 2
evaluation_interval = 4
checkpoint_interval = 4
evaluation_episodes = 1
compile = "off"
device = "cpu"
[rta]
period = 1.0
[inspection]
action_period = 1.0
max_time = 2.0 # s; every episode ends within the update
rate_reward = -0.001
correction_reward = -0.001
limit_reward = -0.001
drift_reward = -0.001
[ppo]
minibatch_size = 4
hidden = [8]
"""


def shown(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows."""
    events = EventAccumulator(str(directory))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }


@pytest.mark.parametrize("files", [0, 9])
def test_a_series_begins_where_it_differs_from_zero_also_in_a_resumed_run(
    files: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(charts_of_training, "COUNT", itertools.count(files))  # "10" comes before "9"
    values = {"always": [1.0, 2.0, 3.0, 4.0], "never": [0.0] * 4, "once": [0.0, -5.0, 0.0, 0.0]}
    begun: Iterable[str] = ()
    for session in ((0, 1), (2, 3)):
        charts = Charts(tmp_path, begun)
        charts.open(10 * session[0])
        for k in session:
            charts.add({tag: series[k] for tag, series in values.items()}, 10 * (k + 1))
        begun = charts.begun
    assert shown(tmp_path) == {
        "always": [(10, 1.0), (20, 2.0), (30, 3.0), (40, 4.0)],
        "once": [(20, -5.0), (30, 0.0), (40, 0.0)],
    }


def test_a_kill_in_the_midst_of_a_point_spoils_no_other(tmp_path: Path) -> None:
    first = Charts(tmp_path)
    first.open(0)
    first.add({"x": 1.0}, 10)
    first.add({"x": 2.0}, 20)
    first.path.write_bytes(first.path.read_bytes()[:-3])
    second = Charts(tmp_path)
    second.open(10)
    second.add({"x": 3.0}, 20)
    assert shown(tmp_path) == {"x": [(10, 1.0), (20, 3.0)]}


def test_an_unwritable_file_is_named(tmp_path: Path) -> None:
    charts = Charts(tmp_path / "gone")
    with pytest.raises(OSError, match="No such file") as caught:
        charts.open(0)
    assert caught.value.filename == str(charts.path)


def documented() -> list[str]:
    """The tags of the page's tables."""
    tags = re.findall(r"(?m)^\| `([^`]+)` \|", PAGE.read_text(encoding="utf-8"))
    each = [
        [tag.replace("<constraint>", name) for name in CONSTRAINTS] if "<" in tag else [tag] for tag in tags
    ]
    return [tag for expanded in each for tag in expanded]


def test_the_page_explains_every_tag_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[bool, set[str]] = {False: set(), True: set()}
    add = Charts.add
    for rta, tags in drawn.items():
        monkeypatch.setattr(
            Charts, "add", lambda self, scalars, at, tags=tags: (tags.update(scalars), add(self, scalars, at))
        )
        config = override(from_toml(SHORT, "test", Config()), {"train": {"rta": rta}}, "test")
        run = training.start(config, tmp_path / str(rta))
        run.train()
    assert len(documented()) == len(set(documented()))
    assert drawn[True] | {"step_reward/adversary"} == set(documented())  # of `train --adversary` alone
    ours = {tag for tag in documented() if not tag.startswith("rta/")} - {"step_reward/adversary"}
    assert drawn[False] == ours
    assert not [tag for tag in shown(tmp_path / "False") if tag.startswith("rta/") or tag == "time/filter_s"]
    assert {"episode/reward", "evaluation/reward", "losses/value_loss"} <= set(shown(tmp_path / "True"))
