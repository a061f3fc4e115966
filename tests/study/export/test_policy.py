"""The agent in C: it compiles without a warning, answers as PyTorch does, and its own test tells when it does not."""

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from inspection.model.parameters import OBSERVED
from inspection.observation import components, scales
from ppo.network import Policy
from settings import override, to_toml
from study.config import Config
from study.experiment import load_policy, make_policy
from study.export import policy as export_policy
from study.files import ROOT

SHIPPED = ROOT / "runs/reference/study/rta/seed0/policy.pt"
STRICTER = ["-std=c99", "-Werror", "-Wshadow", "-Wdouble-promotion", "-Wstrict-prototypes", "-Wcast-qual"]
SANITIZED = ["-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
DEVIATIONS = ("2.4", "2.5", "8.9", "9.3")  # of MISRA C:2012; docs/guides/export.md says why each stands

AGENTS: dict[str, Path | dict[str, Any]] = {  # shipped, or the tables of one that is not trained
    "shipped": SHIPPED,
    "beside a chief that tumbles": ROOT / "runs/reference/chiefs/satellite/rta/seed0/policy.pt",
    "linear last layer": {
        "ppo": {"tanh_outputs": False, "hidden": [9]},
        "inspection": {"observation_scales": [175.0, 0.866, 0.05]},
    },
    "power": {
        "ppo": {"action_power": 1.5, "hidden": [7]},
        "inspection": {"max_thrust": 2.0, "observed": list(OBSERVED[:3])},
    },
}


class Exported(NamedTuple):
    """Holds the files that the command wrote for a checkpoint."""

    directory: Path
    policy: Policy
    config: Config


def untrained(tables: dict[str, Any], path: Path) -> Path:
    """Returns a checkpoint of an untrained agent whose actions are not small."""
    config = override(Config(), tables, "test")
    policy = make_policy(config, [torch.Generator().manual_seed(0)])
    with torch.no_grad():
        policy.network.layers[-1].weight *= 100
        policy.network.layers[0].bias += 0.1
    torch.save({"policy": policy.state_dict(), "config": to_toml(config)}, path)
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Exported]:
    """Returns each of AGENTS, exported once; only for reading."""
    found: dict[str, Exported] = {}

    def export(name: str) -> Exported:
        if name not in found:
            home, agent = tmp_path_factory.mktemp("export"), AGENTS[name]
            checkpoint = agent if isinstance(agent, Path) else untrained(agent, home / "policy.pt")
            policy, config = load_policy(checkpoint)
            export_policy.write(policy, config, str(checkpoint), home / "new" / "c")
            found[name] = Exported(home / "new" / "c", policy, config)
        return found[name]

    return export


def tool(name: str) -> str:
    if not shutil.which(name):
        pytest.skip(f"there is no {name} here")
    return name


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=300)


def succeed(*words: str | Path) -> str:
    """Runs a program that must not fail; returns its output."""
    done = run(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("agent", AGENTS)
def test_c_answers_as_pytorch(agent: str, exported: Callable[[str], Exported], tmp_path: Path) -> None:
    directory, policy, config = exported(agent)
    succeed(tool("gcc"), "-shared", "-fPIC", directory / "policy.c", "-o", tmp_path / "policy.so", "-lm")
    library = ctypes.CDLL(str(tmp_path / "policy.so"))
    library.policy_control.restype = ctypes.c_bool
    scale = scales(torch.zeros(1).double(), config.inspection)[:, 0]
    given = torch.randn(1000, len(scale), generator=torch.Generator().manual_seed(1)).double()
    answer = np.zeros((1000, 6))
    for observation, control in zip((given * scale).numpy(), answer, strict=True):
        assert library.policy_control(*(x.ctypes.data_as(ctypes.c_void_p) for x in (observation, control)))
    action = answer / config.inspection.control_limit
    assert 0.5 < np.abs(action).max() <= 1.0
    assert np.abs(action - policy.mean_action(given[None].float())[0].numpy()).max() <= 1e-6


@pytest.mark.parametrize("agent", AGENTS)
def test_its_own_test_passes_without_a_warning(
    agent: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    for compiler in filter(shutil.which, ("gcc", "clang")):
        directory = shutil.copytree(exported(agent).directory, tmp_path / compiler)
        said = succeed(tool("make"), "-C", directory, f"CC={compiler}", "test")
        assert "-Wall -Wextra -Wpedantic -Wconversion" in said and "-Werror" in said
        assert re.search(
            r"passed: at most [\d.]+e-1\d of the limits .* over 100 states, (\d+) of \1 without ", said
        )
        if agent == "shipped":
            for source in ("policy.c", "test_policy.c"):
                succeed(compiler, *STRICTER, "-c", directory / source, "-o", os.devnull)


SECOND_ROW = r"(?s)(%s.*?\},\n    \{)(.+?),"  # its first number
FLAWS = {
    "a control of PyTorch's": ("test_policy.c", SECOND_ROW % r"EXPECTED\[", r"\g<1>\2 + 1e-5,"),
    "no control of PyTorch's": ("test_policy.c", SECOND_ROW % r"EXPECTED\[", r"\g<1>NAN,"),
    "a weight": ("policy.c", r"(WEIGHT\[\] = \{\n    )(\S+),", r"\g<1>1.01F * \2,"),
    "the power": ("policy.c", r"POWER 3\.0", "POWER 3.0001"),
    "the clusters": ("policy.c", r"ITERATIONS 5U", "ITERATIONS 1U"),
    "what is no number": ("policy.c", r"!\(fabs\((.*)\) <= LARGEST\)", r"fabs(\1) > LARGEST"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_its_own_test_fails_with_a_flaw(
    flaw: str, exported: Callable[[str], Exported], tmp_path: Path
) -> None:
    directory = shutil.copytree(exported("shipped").directory, tmp_path / "c")
    name, pattern, replacement = FLAWS[flaw]
    text = (directory / name).read_text()
    flawed, count = re.subn(pattern, replacement, text, count=1)
    assert count == 1 and flawed != text
    (directory / name).write_text(flawed)
    done = run(tool("make"), "-C", directory, f"CC={tool('gcc')}", "CFLAGS=-std=c99", "test")
    assert done.returncode == 2 and "FAILED" in done.stdout, done.stderr


def test_sanitizers_find_nothing(exported: Callable[[str], Exported], tmp_path: Path) -> None:
    gcc, directory = tool("gcc"), exported("shipped").directory
    (tmp_path / "nothing.c").write_text("int main(void) { return 0; }\n")
    if run(gcc, *SANITIZED, tmp_path / "nothing.c", "-o", tmp_path / "nothing").returncode:
        pytest.skip("gcc has no sanitizers here")
    program = tmp_path / "test_policy"
    succeed(gcc, *SANITIZED, directory / "test_policy.c", directory / "policy.c", "-o", program, "-lm")
    assert succeed(program).startswith("passed")


def test_it_keeps_misras_rules(exported: Callable[[str], Exported], tmp_path: Path) -> None:
    """But for DEVIATIONS. The printed observation is left out, which takes cppcheck hours."""
    if run(tool("cppcheck"), "--addon=misra", os.devnull).returncode:
        pytest.skip("cppcheck has no rules of MISRA here")
    directory = shutil.copytree(exported("shipped").directory, tmp_path / "c")
    text = (directory / "policy.c").read_text()
    rest = re.sub(r"(?s)typedef double real;.*(?=/\* Where points are left)", "", text)
    assert len(rest) < len(text)
    (directory / "policy.c").write_text(rest)
    rules = [f"--suppress=misra-c2012-{rule}" for rule in DEVIATIONS]
    rules += ["--addon=misra", "--suppress=missingIncludeSystem", "--suppress=unusedStructMember"]
    succeed("cppcheck", "--std=c99", "--enable=style", "--error-exitcode=1", *rules, directory / "policy.c")


@pytest.mark.parametrize("agent", ["shipped", "power"])
def test_the_header_names_what_is_observed_and_commanded(
    agent: str, exported: Callable[[str], Exported]
) -> None:
    directory, _, config = exported(agent)
    header = (directory / "policy.h").read_text()

    def members(kind: str) -> list[tuple[str, str]]:
        return re.findall(rf"(?m)^    POLICY_{kind}_(\w+) /\* (.+) \*/,?$", header)

    observed = components(config.inspection)
    assert [(name.lower(), unit) for name, unit in members("OBSERVATION")] == [
        (each.name, each.unit) for each in observed
    ]
    assert len(members("STATE")) == 16 and f"POLICY_OBSERVATIONS {len(observed)}U\n" in header
    limits = [float(text.rpartition(" ")[2]) for _, text in members("COMMAND")]
    assert limits == list(config.inspection.control_limit)
    assert "POLICY_PERIOD 10.0 " in header
