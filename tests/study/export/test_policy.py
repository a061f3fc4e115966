"""The agent in C: it compiles without a warning, answers as PyTorch does, and its own test tells when it does not."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import main
from inspection.model.parameters import OBSERVED
from inspection.observation import GROUPS, components, scales
from ppo.network import Policy
from settings import override, to_toml
from study.config import Config
from study.experiment import load_policy, make_policy
from study.export import policy as export_policy
from tests.test_main import assert_refused, call

REFERENCE = Path(main.__file__).parent / "runs" / "reference"
SHIPPED = REFERENCE / "study" / "rta" / "seed0" / "policy.pt"
STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
STRICTER = [
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wstrict-prototypes",
    "-Wmissing-prototypes",
    "-Wcast-qual",
    "-Wundef",
]
SANITIZED = ["-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

AGENTS: dict[str, Path | dict[str, Any]] = {  # shipped, or the tables of one that is not trained
    "shipped": SHIPPED,
    "beside a chief that tumbles": REFERENCE / "chiefs" / "satellite" / "rta" / "seed0" / "policy.pt",
    "linear": {"ppo": {"hidden": [7]}, "inspection": {"max_thrust": 2.0}},
    "power and dead zone": {"ppo": {"action_power": 2.0, "action_dead_zone": 0.1}},
    "free flight": {"inspection": {"observed": [*OBSERVED, "free_flight"]}, "ppo": {"action_power": 1.5}},
}
DRIVER = """
#include <stdio.h>
#include "policy.h"

int main(void)
{
    double observation[POLICY_OBSERVATIONS];
    double control[POLICY_CONTROLS];

    while (fread(observation, sizeof observation, 1, stdin) == 1) {
        if (!policy_control(observation, control) || fwrite(control, sizeof control, 1, stdout) != 1) {
            return 1;
        }
    }
    return 0;
}
"""


class Exported(NamedTuple):
    """What the command wrote of a checkpoint."""

    directory: Path
    policy: Policy
    config: Config


def untrained(tables: dict[str, Any], path: Path) -> Path:
    """A checkpoint of an untrained agent whose actions are not small."""
    config = override(Config(), tables, "test")
    policy = make_policy(config, [torch.Generator().manual_seed(0)])
    with torch.no_grad():
        policy.network.layers[-1].weight *= 100
        policy.network.layers[0].bias += 0.1
    torch.save({"policy": policy.state_dict(), "config": to_toml(config)}, path)
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Exported]:
    """Each of AGENTS, exported once; only for reading."""
    found: dict[str, Exported] = {}

    def export(name: str) -> Exported:
        if name not in found:
            home = tmp_path_factory.mktemp("export")
            agent = AGENTS[name]
            checkpoint = agent if isinstance(agent, Path) else untrained(agent, home / "policy.pt")
            arguments = ["export", "--checkpoint", str(checkpoint), "--c", str(home / "new" / "c")]
            assert main.main(arguments) == 0
            found[name] = Exported(home / "new" / "c", *load_policy(checkpoint))
        return found[name]

    return export


@pytest.fixture(params=["gcc", "clang"])
def compiler(request: pytest.FixtureRequest) -> str:
    if not shutil.which(request.param):
        pytest.skip(f"there is no {request.param} here")
    return request.param


def tool(name: str) -> str:
    if not shutil.which(name):
        pytest.skip(f"there is no {name} here")
    return name


def run(*words: str | Path, **options: Any) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(words, capture_output=True, timeout=300, **options)


def succeed(*words: str | Path, **options: Any) -> bytes:
    """What a program prints that must not fail."""
    done = run(*words, **options)
    assert done.returncode == 0, (done.stdout + done.stderr).decode()
    return done.stdout


def make_test(directory: Path, compiler: str) -> subprocess.CompletedProcess[bytes]:
    return run(tool("make"), "-C", directory, f"CC={compiler}", "test")


@pytest.mark.parametrize("agent", AGENTS)
def test_c_answers_as_pytorch(
    agent: str, compiler: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    directory, policy, config = exported(agent)
    (tmp_path / "driver.c").write_text(DRIVER)
    program = tmp_path / "driver"
    sources = tmp_path / "driver.c", directory / "policy.c"
    succeed(compiler, *STRICT, "-I", directory, "-o", program, *sources, "-lm")

    scale = scales(torch.zeros(1).double(), config.inspection.observed)[:, 0]
    observation = torch.randn(1000, len(scale), generator=torch.Generator().manual_seed(1)).double() * scale
    answer = np.frombuffer(succeed(program, input=observation.numpy().tobytes())).reshape(1000, 6)
    action = answer / config.inspection.control_limit
    assert 0.5 < np.abs(action).max() <= 1.0
    normalised = (observation / scale)[None]
    assert np.abs(action - policy.mean_action(normalised.float())[0].numpy()).max() <= 1e-6
    # its own rounding aside
    exact = deepcopy(policy).double().mean_action(normalised)[0].numpy()
    assert np.abs(action - exact).max() <= 1e-12
    if policy.dead_zone:
        assert 0.02 < (action == 0.0).mean() < 0.5


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_it_refuses_flags_that_take_nan_away(
    flag: str, compiler: str, exported: Callable[[str], Exported]
) -> None:
    done = run(compiler, "-std=c99", flag, "-fsyntax-only", exported("shipped").directory / "policy.c")
    assert done.returncode and b"compile it without -ffast-math" in done.stderr


def test_agents_of_two_prefixes_fit_into_one_program(
    exported: Callable[[str], Exported], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gcc = tool("gcc")
    (tmp_path / "both.c").write_text(
        """#include "here/here.h"
#include "there/there.h"

int main(void)
{
    const double observation[HERE_OBSERVATIONS] = {0.0};
    double control[THERE_CONTROLS];
    return !(here_control(observation, control) && there_control(observation, control));
}
"""
    )
    for prefix in ("here", "there"):
        words = ["export", "--checkpoint", str(SHIPPED), "--c", str(tmp_path / prefix), "--prefix", prefix]
        code, _, err = call(words, capsys)
        assert code == 0, err
        source = tmp_path / prefix / f"{prefix}.c"
        succeed(gcc, *STRICT, "-c", source, "-o", tmp_path / f"{prefix}.o")
        symbols = [line.split()[-2:] for line in succeed(tool("nm"), tmp_path / f"{prefix}.o").splitlines()]
        assert [name for kind, name in symbols if kind in (b"T", b"D", b"R", b"B")] == [
            f"{prefix}_control".encode()
        ]
    parts = tmp_path / "both.c", tmp_path / "here.o", tmp_path / "there.o"
    succeed(gcc, "-std=c99", "-o", tmp_path / "both", *parts, "-lm")
    succeed(tmp_path / "both")
    assert b"passed" in succeed(tool("make"), "-C", tmp_path / "there", "test")
    assert_refused([*words[:-1], "3u"], ["--prefix: '3u': must be a name in C"], capsys)
    out = ["export", "--checkpoint", str(SHIPPED), "--out", str(tmp_path / "a.onnx"), "--prefix", "a"]
    assert_refused(out, ["--prefix"], capsys)


@pytest.mark.parametrize("agent", AGENTS)
def test_its_own_test_passes_without_a_warning(
    agent: str, compiler: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    directory = shutil.copytree(exported(agent).directory, tmp_path / "c")
    done = make_test(directory, compiler)
    assert done.returncode == 0, done.stderr.decode()
    said = done.stdout.decode()
    assert all(flag in said for flag in STRICT)
    assert re.search(
        r"passed: at most [\d.]+e-1\d of the limits .* over 100 observations, (\d+) of \1 without ", said
    )
    for source in ("policy.c", "test_policy.c"):
        succeed(compiler, *STRICT, *STRICTER, "-c", directory / source, "-o", os.devnull)


SECOND_ROW = r"(?s)(%s.*?\},\n    \{\n        )(.+?),"  # its first number
FLAWS = {
    "a control of PyTorch's": ("policy_vectors.h", SECOND_ROW % "expected", r"\g<1>\2 + 1e-5,"),
    "no control of PyTorch's": ("policy_vectors.h", SECOND_ROW % "expected", r"\g<1>NAN,"),
    "an observation": ("policy_vectors.h", SECOND_ROW % "given", r"\g<1>1.01 * \2,"),
    "a weight": ("policy.c", SECOND_ROW % "weight_2", r"\g<1>1.01F * \2,"),
    "a scale": ("policy.c", r"(scale\[SIZE_0\] = \{\n    )100\.0,", r"\g<1>101.0,"),
    "the power": ("policy.c", r"power = 3\.0;", "power = 3.0001;"),
    "the limits": ("policy.c", r"(limit\[SIZE_3\] = \{\n    )1\.0,", r"\g<1>1.00001,"),
    "what is no number": ("policy.c", r"!\(fabs\((.*)\) <= LARGEST\)", r"fabs(\1) > LARGEST"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_its_own_test_fails_with_a_flaw(
    flaw: str, compiler: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    """Also one that is brought in after it has passed."""
    directory = shutil.copytree(exported("shipped").directory, tmp_path / "c")
    assert make_test(directory, compiler).returncode == 0
    name, pattern, replacement = FLAWS[flaw]
    text = (directory / name).read_text()
    flawed, count = re.subn(pattern, replacement, text, count=1)
    assert count == 1 and flawed != text
    (directory / name).write_text(flawed)
    done = make_test(directory, compiler)
    assert done.returncode == 2 and b"FAILED" in done.stdout, done.stderr.decode()


@pytest.mark.parametrize("agent", ["shipped", "linear"])
def test_sanitizers_find_nothing(
    agent: str, compiler: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    (tmp_path / "nothing.c").write_text("int main(void) { return 0; }\n")
    if run(compiler, *SANITIZED, tmp_path / "nothing.c", "-o", tmp_path / "nothing").returncode:
        pytest.skip(f"{compiler} has no sanitizers here")
    directory = exported(agent).directory
    program = tmp_path / "test_policy"
    succeed(compiler, *SANITIZED, directory / "test_policy.c", directory / "policy.c", "-o", program, "-lm")
    assert succeed(program).startswith(b"passed")


def test_it_keeps_nothing_and_calls_nothing_but_the_mathematics(
    compiler: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    for agent, needed in (("shipped", {"pow", "tanh"}), ("linear", {"tanh"})):
        succeed(compiler, *STRICT, "-c", exported(agent).directory / "policy.c", "-o", tmp_path / "policy.o")
        symbols = [
            line.split()[-2:] for line in succeed(tool("nm"), tmp_path / "policy.o").decode().splitlines()
        ]
        assert {name for kind, name in symbols if kind == "U"} == needed
        assert {name for kind, name in symbols if kind.isupper() and kind != "U"} == {"policy_control"}
        assert {kind for kind, _ in symbols} <= set("UTtr")  # nothing that can be written


def test_it_keeps_misras_rules(exported: Callable[[str], Exported]) -> None:
    """But for 8.9, by which the tables would stand within the one function that reads them."""
    source = exported("shipped").directory / "policy.c"
    if run(tool("cppcheck"), "--addon=misra", os.devnull).returncode:
        pytest.skip("cppcheck has no rules of MISRA here")
    rules = "--addon=misra", "--suppress=misra-c2012-8.9", "--suppress=missingIncludeSystem"
    succeed("cppcheck", "--std=c99", "--enable=style", "--error-exitcode=1", *rules, source)


def test_the_header_names_what_is_observed_and_commanded(exported: Callable[[str], Exported]) -> None:
    for agent in AGENTS:
        directory, _, config = exported(agent)
        c = config.inspection
        header = (directory / "policy.h").read_text()
        named = re.findall(r"(?m)^    POLICY_(\w+), /\* (.+?)(?:, from -(\S+) to (\S+))? \*/$", header)
        assert [(name.lower(), unit) for name, unit, *_ in named[:-6]] == [
            (each.name, each.unit) for each in components(c.observed)
        ]
        limits = [float(text) for text in re.findall(r", from -\S+ to (\S+)", header)]
        assert limits == list(c.control_limit)
        assert [name for name, *_ in named[-6:]] == [
            f"{kind}_{i}" for kind in ("THRUST", "TORQUE") for i in "XYZ"
        ]
        assert f"POLICY_OBSERVATIONS {len(named) - 6}U\n" in header and "POLICY_PERIOD 10.0 " in header
        assert ("for 500 s and 172800 s, 15 m / distance" in header) == ("free_flight" in c.observed)
        for name in directory.iterdir():
            assert max(map(len, name.read_text().splitlines())) <= 120
    assert set(export_policy.MEANINGS) == set(GROUPS)


def test_rates_are_relative_to_what_the_agent_was_trained_with() -> None:
    for turning, frame in ((True, "the stars"), (False, "Hill's frame")):
        config = override(Config(), {"inspection": {"hill_rotation": turning}}, "test")
        for group in ("angular_velocity", "chief"):
            assert export_policy.meaning(group, config.inspection).endswith(f"relative to {frame}")


def test_an_older_agent_is_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directory = tmp_path / "c"
    directory.mkdir()
    for name in ("policy.c", "policy.h.tmp", "test_policy"):  # not begun, left by a kill, built
        (directory / name).touch()
    for checkpoint in (AGENTS["beside a chief that tumbles"], SHIPPED, SHIPPED):
        before = {path.name: path.read_bytes() for path in directory.iterdir()}
        code, out, err = call(["export", "--checkpoint", str(checkpoint), "--c", str(directory)], capsys)
        assert code == 0, err
        weights = "7,046" if checkpoint == SHIPPED else "7,238"
        assert f"{weights} weights" in out and f"make -C {directory} test" in out
    assert before == {path.name: path.read_bytes() for path in directory.iterdir()}  # the same once more


@pytest.mark.parametrize("name", ["policy.c", "Makefile", "main.c", "policy.h/", "policy.pt"])
def test_what_is_not_an_agents_is_kept(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    directory = tmp_path / "c"
    directory.mkdir()
    if name.endswith("/"):
        (directory / name).mkdir()
    else:
        (directory / name).write_text("/* years of work */\n")
    before = sorted(directory.rglob("*"))
    words = ["--c c", "holds no agent", name.removesuffix("/"), "name a new directory"]
    assert_refused(["export", "--checkpoint", str(SHIPPED), "--c", "c"], words, capsys)
    assert sorted(directory.rglob("*")) == before
    assert name.endswith("/") or (directory / name).read_text() == "/* years of work */\n"


def test_a_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    monkeypatch.delitem(sys.modules, "study.export.policy")
    monkeypatch.delattr("study.export.policy")
    assert_refused(["export", "--checkpoint", str(SHIPPED), "--c", "c"], ["jinja2", "[report]"], capsys)
