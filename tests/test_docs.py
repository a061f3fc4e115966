"""The programs in the pages of docs: each page runs from top to bottom and prints what it says it prints."""

import contextlib
import importlib
import io
import operator
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import main
from docs.guides import control_loop
from rta.fast import files
from settings import load
from study.config import StudyConfig

ROOT = Path(main.__file__).parent
COMMANDS_PAGE = "reference/commands"  # whose commands train for hours
READERS = "README"  # whose commands print much
EXPORT = "guides/export"  # prints ONNX Runtime's distance from PyTorch, which depends on the processor
PAGES = sorted(
    str(page.relative_to(ROOT / "docs").with_suffix(""))
    for page in (ROOT / "docs").rglob("*.md")
    if "```python" in page.read_text(encoding="utf-8")
)
PAGES = [page for page in PAGES if page not in (COMMANDS_PAGE, READERS, EXPORT)]
NUMBER = re.compile(r"-?\d[\d,]*\.?\d*")
COMMAND = "python main.py "


def blocks(page: str) -> list[tuple[str, str, str]]:
    """Returns language, content and the text before it for each fenced block."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return [(match[2], match[3], match[1]) for match in re.finditer(r"(?s)(.*?)```(\w+)\n(.*?)```", text)]


def run(page: str) -> tuple[str, str]:
    """Runs a page in the working directory: what it printed, and what it says it prints."""
    names: dict[str, object] = {}
    printed, promised = io.StringIO(), ""
    with contextlib.redirect_stdout(printed):
        for language, content, before in blocks(page):
            if language == "python":
                exec(compile(content, f"docs/{page}.md", "exec"), names)
            elif language == "shell":
                for line in content.splitlines():
                    assert line.startswith(COMMAND)
                    assert main.main(shlex.split(line.removeprefix(COMMAND))) == 0, line
            elif language == "text":
                promised += content
            else:  # a file, which the text names last
                Path(re.findall(r"`([\w.]+)`", before)[-1]).write_text(content, encoding="utf-8")
    return printed.getvalue(), promised


def numbers(text: str) -> list[float]:
    return [float(word.replace(",", "")) for word in NUMBER.findall(text)]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a directory with a checkout's content to write in."""
    (tmp_path / "runs").mkdir()
    for name in ("runs/reference", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_prints_what_it_says(page: str) -> None:
    printed, promised = run(page)
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", promised).split()
    # another processor rounds otherwise; zero violations are zero everywhere
    np.testing.assert_allclose(numbers(printed), numbers(promised), rtol=0.03, atol=1e-9)


def test_every_way_in_leads_somewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The short commands run, each long one's settings are accepted."""
    real = main.main
    shorter = {"simulate": ["--duration", "20"]}
    monkeypatch.setattr(main, "main", lambda words: real([*words, *shorter.get(words[0], [])]))
    printed, promised = run(READERS)
    (said,) = (line for line in printed.splitlines() if line.startswith("thrust"))
    assert NUMBER.sub("#", said) == NUMBER.sub("#", promised.strip())
    np.testing.assert_allclose(numbers(said), numbers(promised), rtol=0.03)
    page = (ROOT / "docs" / f"{READERS}.md").read_text(encoding="utf-8")
    commands = re.findall(rf"(?m)^    {COMMAND}(.*)$", page)
    assert len(commands) > 10
    for command in commands:
        config = StudyConfig()
        for file in re.findall(r"--config (\S+)", command):
            config = load(file, config)


def test_the_program_of_the_commands_writes_what_they_read() -> None:
    (program,) = (content for language, content, _ in blocks(COMMANDS_PAGE) if language == "python")
    fly = "simulate --controller zero --no-rta --duration 20 --out runs/agent.npz"
    assert main.main(shlex.split(fly)) == 0
    exec(program, {})
    page = (ROOT / "docs" / f"{COMMANDS_PAGE}.md").read_text(encoding="utf-8")
    for reader in ("filter --states", "simulate --controller recorded"):
        (command,) = re.findall(rf"(?m)^{COMMAND}({reader} .*)$", page)
        assert main.main(shlex.split(command)) == 0


def test_the_exported_agent_flies_in_the_control_loop(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Python's answers, which take seconds, are compared in tests.rta.fast.test_export
    monkeypatch.setattr(files, "vectors_header", lambda safety_filter: "")
    printed, promised = run(EXPORT)
    assert printed.split(" bytes")[0] == promised.split(" bytes")[0]
    assert printed.splitlines()[-1] == promised.splitlines()[-1]  # the files of the filter in C
    control_loop.main(["policy.onnx", "--seconds", "10"])
    out = capsys.readouterr().out
    lines = re.findall(r"(\w+): median ([\d.]+) ms, 99th percentile ([\d.]+) ms of (\d+) calls", out)
    assert {name: int(count) for name, _, _, count in lines} == {"policy": 1, "filter": 10}
    assert all(0.0 < float(median) <= float(slow) for _, median, slow, _ in lines)
    assert "violated in 0 of 10 seconds" in out


@pytest.mark.parametrize("arguments", [["absent.onnx"], ["damaged.onnx"], ["damaged.onnx", "--seconds", "0"]])
def test_the_control_loop_refuses_in_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("damaged.onnx").write_bytes(b"not a model")
    with pytest.raises(SystemExit) as refusal:
        control_loop.main(arguments)
    assert refusal.value.code == 2
    assert re.fullmatch(r"error: python -m docs\.guides\.control_loop: .+\n", capsys.readouterr().err)


def test_every_name_of_the_equation_table_is_in_its_file() -> None:
    page = ROOT / "docs/reference/differences.md"
    table = page.read_text(encoding="utf-8").partition("## Where the paper's equations are")[2]
    links = re.findall(r"\[([^\]]+)\]\(([^)]+\.py)\)", table)
    assert len(links) > 25
    for names, target in links:
        path = (page.parent / target).resolve().relative_to(ROOT)
        module = importlib.import_module(".".join(path.with_suffix("").parts))
        for name in names.split(", "):
            if name != path.name:
                operator.attrgetter(name)(module)
