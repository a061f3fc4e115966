"""Calls of `export` that are refused: what cannot be written, what would be lost, flags that do not go together."""

from pathlib import Path

import pytest

from study.files import ROOT
from tests.test_main import assert_refused

SHIPPED = ["--checkpoint", str(ROOT / "runs" / "reference" / "study" / "rta" / "seed0" / "policy.pt")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--filter", "file"], ["--filter file", "cannot write there"]),
        (["--filter", "full"], ["--filter full", "holds no filter but main.c", "name a new directory"]),
        (["--filter", "c", "--checkpoint", "p.pt"], ["--filter", "no use for --checkpoint"]),
        (["--filter", "c", "--config", "odd.toml"], ["max_thrust"]),
        ([*SHIPPED, "--c", "file"], ["--c file", "cannot write there"]),
        ([*SHIPPED, "--c", "file/c"], ["--c file/c", "cannot write there"]),
        ([*SHIPPED, "--c", "full"], ["--c full", "holds no agent but main.c", "name a new directory"]),
        ([*SHIPPED, "--c", "a\0b"], ["--c", "cannot write there"]),
        ([*SHIPPED, "--c", "c", "--out", "o.onnx"], ["--c", "--out", "not allowed"]),
        (
            ["--checkpoint", "p.pt", "--c", "c", "--rta-period", "5"],
            ["--config and settings are of --filter"],
        ),
        (["--checkpoint", "nowhere.pt", "--c", "c"], ["nowhere.pt", "no such checkpoint"]),
        (["--c", "c"], ["--checkpoint F", "--c"]),
        (["--out", "o.onnx"], ["--checkpoint F", "--out"]),
    ],
)
def test_bad_calls_are_refused(
    arguments: list[str],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "main.c").write_text("int main(void) { return 0; }\n")
    (tmp_path / "odd.toml").write_text("[inspection]\nmax_thrust = -1.0\n")
    assert_refused(["export", *arguments], words, capsys)
