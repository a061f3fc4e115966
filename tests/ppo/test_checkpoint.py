"""Checkpoints: whole or not at all, and what is no checkpoint is refused."""

import resource
from pathlib import Path

import pytest
import torch

from ppo import checkpoint
from ppo.errors import CheckpointError


def test_a_write_that_dies_leaves_the_previous_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, {"update": 1})

    def dying_save(content: object, file: object) -> None:
        file.write(b"half a checkpo")
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint.torch, "save", dying_save)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(path, {"update": 2})
    monkeypatch.undo()
    assert checkpoint.load(path, ("update",)) == {"update": 1}


def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path) -> None:
    damaged, notes, other = tmp_path / "damaged.pt", tmp_path / "notes.pt", tmp_path / "other.pt"
    damaged.write_bytes(b"half a checkpo")  # which pickle reads as a key of its memo
    notes.write_bytes(b"# what was flown")  # in which it finds no code of its own
    checkpoint.save(other, {"update": torch.tensor(1)})
    for path, words in (
        (tmp_path / "none.pt", "no such checkpoint file"),
        (damaged, "not a readable checkpoint: damaged, or no policy.pt"),
        (notes, "not a readable checkpoint: damaged, or no policy.pt"),
        (other, "it lacks policy, value"),
    ):
        with pytest.raises(CheckpointError, match=words) as refusal:
            checkpoint.load(path, ("update", "policy", "value"))
        assert str(refusal.value).startswith(str(path)) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("size", [100, 10_000, 1_000_000])
def test_a_full_disk_leaves_the_previous_checkpoint_and_is_named(tmp_path: Path, size: int) -> None:
    path, soft_and_hard = tmp_path / "checkpoint.pt", resource.getrlimit(resource.RLIMIT_FSIZE)
    checkpoint.save(path, {"update": 1})
    larger = {"update": 2, "weights": [torch.zeros(size) for _ in range(5)], "config": 8000 * "x"}
    resource.setrlimit(resource.RLIMIT_FSIZE, (9000, soft_and_hard[1]))
    try:
        with pytest.raises(OSError, match="File too large") as full:
            checkpoint.save(path, larger)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, soft_and_hard)
    assert full.value.filename == str(path)
    assert [each.name for each in tmp_path.iterdir()] == ["checkpoint.pt"]
    assert checkpoint.load(path, ("update",)) == {"update": 1}
