"""A study's files as its report reads them: all of them, or one line that says which is damaged."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from settings import InputError
from study.config import ARMS
from study.report import inputs


@pytest.fixture
def study(made_up_study: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(made_up_study, tmp_path / "study"))


def test_everything_is_read(made_up_study: Path) -> None:
    found = inputs.read(made_up_study)
    assert found.arms == json.loads((made_up_study / "results.json").read_text())["arms"]
    assert list(found.columns) == [*ARMS, "guidance"]
    assert list(found.frequency) == ["1", "5", "10"]
    assert found.training["reward"]["rta"].shape == (3, 4)
    assert found.training["reward"]["rta"][:, 0].tolist() == [5e5, 1e6, 1.5e6]
    for name, episodes in (("episode", found.episodes), ("demonstration", found.demonstrations)):
        for arm in ARMS:
            expected = np.load(made_up_study / f"report/{name}_{arm}.npz")
            np.testing.assert_array_equal(episodes[arm]["position"], expected["position"])


def test_what_need_not_be_there_is_empty(study: Path) -> None:
    for name in ("guidance", "sunlight", "frequency", "baselines"):
        (study / f"report/{name}.json").unlink(missing_ok=True)
    (study / "report/training.csv").write_text("interactions,arm,metric,iqm,low,high\n")
    found = inputs.read(study)
    empty = [found.guidance, found.sunlight, found.frequency, found.baselines, found.training]
    assert empty == [{}] * 5
    assert list(found.columns) == list(ARMS)


def test_of_a_study_of_one_arm_no_other_is_expected(study: Path) -> None:
    results = json.loads((study / "results.json").read_text())
    del results["arms"]["no_rta"]
    (study / "results.json").write_text(json.dumps(results))
    (study / "report/episode_no_rta.npz").unlink()
    found = inputs.read(study)
    assert list(found.arms) == list(found.episodes) == ["rta"]


@pytest.mark.parametrize("name", ["results.json", "provenance.json", "report/cross.json"])
def test_missing_and_damaged_files_are_refused(name: str, study: Path) -> None:
    (study / name).write_text("{")
    with pytest.raises(InputError, match=rf"{Path(name).name}: cannot read it"):
        inputs.read(study)
    (study / name).unlink()
    with pytest.raises(InputError, match=rf"{Path(name).name}: cannot read it"):
        inputs.read(study)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("results.json", b'{"arms": {"rta": 1}}', r"results\.json: not the results of a study"),
        ("report/training.csv", b"arm,metric\nrta,reward\n", r"training\.csv: not the training curves"),
        ("report/episode_rta.npz", b"PK\x03\x04", r"episode_rta\.npz: not an episode"),
        ("report/demonstration_rta.npz", b"", r"demonstration_rta\.npz: not an episode"),
        ("config.toml", b"[train]\nseed = -", r"config\.toml"),
    ],
)
def test_files_of_another_kind_are_refused(name: str, content: bytes, words: str, study: Path) -> None:
    (study / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        inputs.read(study)
