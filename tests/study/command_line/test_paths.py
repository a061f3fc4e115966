"""No command writes over what it reads, nor over a file of another suffix."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import main
from study.command_line.commands import COMMANDS
from study.command_line.paths import check_inputs, check_outputs, check_replaced
from study.errors import InputError
from tests.test_main import call, write_inputs

ROOT = Path(main.__file__).parent


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """An input of every kind."""
    return write_inputs(tmp_path)


ZERO = "simulate --controller zero --duration 10"
OVERWRITING = [  # commands with the output left out, the flag that names it, and the input that it names
    ("export --checkpoint p.pt", "--out", "p.pt"),
    ("evaluate --checkpoint p.pt --episodes 1", "--json", "p.pt"),
    ("evaluate --controller natural-motion --episodes 1 --config c.toml", "--json", "c.toml"),
    ("simulate --controller policy --checkpoint p.pt --duration 10", "--out", "p.pt"),
    ("simulate --controller policy --checkpoint p.pt --duration 10 --out o.npz", "--figure", "p.pt"),
    (f"{ZERO} --initial-state s.json", "--out", "s.json"),
    (f"{ZERO} --config c.toml --out o.npz", "--figure", "c.toml"),
    ("simulate --controller recorded --actions u.npy --duration 10", "--out", "u.npy"),
    ("filter --states x.npz", "--out", "x.npz"),
    ("replay r.npz", "--out", "r.npz"),
    ("verify --policy checkpoint:p.pt --episodes 1 --duration 10", "--json", "p.pt"),
    ("verify --config c.toml --episodes 1 --duration 10", "--json", "c.toml"),
    ("benchmark --batches 2 --json o.json", "--figure", "o.json"),
    (f"{ZERO} --out o.npz", "--figure", "o.npz"),
]


@pytest.mark.parametrize("through", ["itself", "symbolic", "hard", "relative"])
@pytest.mark.parametrize(("command", "flag", "name"), OVERWRITING)
def test_an_output_that_is_an_input_is_refused(
    command: str,
    flag: str,
    name: str,
    through: str,
    files: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    out = name
    if through == "relative":
        out = f"../{tmp_path.name}/{name}"
    elif through != "itself" and name in files:
        out = "link"
        (os.symlink if through == "symbolic" else os.link)(name, out)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    code, _, err = call([*command.split(), flag, out], capsys)
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith(f"error: {flag} {out}: is the file of ")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_input_that_an_output_is_written_by_way_of_is_not_lost(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    states = files["x.npz"].rename(tmp_path / "o.npz.tmp")
    before = states.read_bytes()
    code, _, err = call(["filter", "--states", str(states), "--out", str(tmp_path / "o.npz")], capsys)
    assert (code, err.count("\n")) == (2, 1) and "by way of the file of --states" in err
    assert states.read_bytes() == before


def test_every_file_of_every_command_is_declared() -> None:
    for name, command in COMMANDS.items():
        for flag in command.flags:
            if flag.options.get("metavar", "").startswith(("F", "G.", "RUN")):
                assert flag.reads or flag.writes.startswith("."), (name, flag.name)


SUFFIXES = {flag.writes for command in COMMANDS.values() for flag in command.flags if flag.writes}


@pytest.mark.parametrize("suffix", sorted(SUFFIXES))
def test_a_file_of_another_suffix_is_not_replaced(
    suffix: str, files: dict[str, Path], tmp_path: Path
) -> None:
    nameless = tmp_path / "Makefile"
    nameless.write_text("all:")
    for path in (*files.values(), nameless):
        if path.suffix != suffix:
            with pytest.raises(InputError, match=rf"--out .* must end in \{suffix}; name it \w+\{suffix}"):
                check_outputs({"--out": (str(path), suffix)}, {})


def test_a_file_of_the_same_suffix_is_replaced(
    files: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    zero = f"{ZERO} --no-rta --out o.npz --figure o.png"
    for command in (
        zero,
        "replay o.npz --out o.html",
        "export --checkpoint p.pt --out o.onnx",
        "filter --states x.npz --out f.npz",
    ):
        for _ in range(2):
            code, _, err = call(command.split(), capsys)
            assert code == 0, err


@pytest.mark.parametrize("path", ["out", "empty", "out.txt", "folder.json/out"])
def test_a_name_without_the_suffix_is_refused_at_the_first_call(path: str, tmp_path: Path) -> None:
    """And not at the second, whose own report would be there."""
    (tmp_path / "empty").touch()
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(InputError, match=r"must end in \.json; name it (out|empty)\.json"):
        check_outputs({"--json": (str(tmp_path / path), ".json")}, {})
    assert sorted(each.name for each in tmp_path.iterdir()) == ["empty", "folder.json"]


def test_a_link_to_a_file_of_another_suffix_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(files["c.toml"])
    with pytest.raises(InputError, match=r"exists and is no \.json file"):
        check_outputs({"--json": (str(tmp_path / "link"), ".json")}, {})


@pytest.mark.parametrize(
    ("command", "key"),
    [("evaluate --controller zero --episodes 1", "metrics"), ("benchmark", "closed_loop_us")],
)
@pytest.mark.parametrize("content", ['{"campaign": {}, "episodes": 100000}', "[]", "no JSON"])
def test_results_do_not_replace_a_report_of_another_command(
    command: str, key: str, content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "report.json"
    path.write_text(content)
    code, _, err = call([*command.split(), "--json", str(path)], capsys)
    assert (code, err.count("\n")) == (2, 1)
    assert f"--json {path}: holds no results of {command.split()[0]}; name another file" in err
    assert path.read_text() == content
    path.write_text(json.dumps({key: 0.0}))
    check_replaced(str(path), "own", key)


def test_a_figure_has_the_name_of_its_format(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = call([*ZERO.split(), "--out", "o.npz", "--figure", "x.bogus"], capsys)
    assert (code, err.count("\n")) == (2, 1)
    assert "--figure x.bogus" in err and "x.png" in err


def test_a_named_pipe_is_no_input_but_a_shells_own_is(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a named pipe"):
        check_inputs({"--states": str(tmp_path / "pipe")})
    ours, theirs = os.pipe()
    check_inputs({"--config": f"/dev/fd/{ours}"})
    os.close(ours), os.close(theirs)


def test_what_standard_output_is_redirected_to_is_no_file_to_be_kept(tmp_path: Path) -> None:
    code = (
        "from study.command_line.paths import check_outputs\n"
        "print('a table', flush=True)\n"
        "check_outputs({'--json': ('/dev/stdout', '.json')}, {})\n"
    )
    with open(tmp_path / "out.txt", "w") as out:
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, stdout=out, stderr=subprocess.PIPE)
    assert done.returncode == 0, done.stderr
