"""A directory is one process's at a time, where the file system knows locks."""

from pathlib import Path

import pytest

from settings import InputError
from study.machine import lock


def test_where_there_are_no_locks_nothing_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with lock.alone_in(tmp_path, "--run-dir"):
        with pytest.raises(InputError, match="another process"), lock.alone_in(tmp_path, "--run-dir"):
            pass
        monkeypatch.setattr(lock, "fcntl", None)
        with lock.alone_in(tmp_path, "--run-dir"):
            pass
        monkeypatch.undo()
    with lock.alone_in(tmp_path, "--run-dir"):
        assert not list(tmp_path.iterdir())
