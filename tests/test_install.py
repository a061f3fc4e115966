"""Installed, the packages work from any directory, and what they need is declared."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement

import main

ROOT = Path(main.__file__).parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["setuptools"]["packages"]
MODULES = PROJECT["tool"]["setuptools"]["py-modules"]
SHIPPED = ROOT / "runs" / "reference" / "study" / "rta" / "seed0" / "policy.pt"

# What follows a page's program: the packages are those installed, and a shipped agent can be loaded.
AFTERWARDS = f"""
import sys
from pathlib import Path

import inspection, interfaces, ppo, rta, study
from study.experiment import load_policy

for package in (inspection, interfaces, ppo, rta, study):
    assert Path(sys.prefix) in Path(package.__file__).parents, package.__file__
    assert all(hasattr(package, name) for name in package.__all__)
policy, config = load_policy({str(SHIPPED)!r})
assert config.train.rta and sum(weight.numel() for weight in policy.parameters()) == 7_436
"""


def command(*arguments: str | Path, cwd: Path) -> str:
    """What a command prints; nothing of this checkout is in its way."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(arguments, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def page() -> tuple[str, str]:
    """The program of the page on a policy of one's own, and what it says it prints."""
    (path,) = (ROOT / "docs").rglob("your_own_policy.md")
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"(?s)```(\w+)\n(.*?)```", text)
    return tuple("".join(block for kind, block in blocks if kind == wanted) for wanted in ("python", "text"))


def test_a_wheel_works_from_an_empty_directory(tmp_path: Path) -> None:
    """Built, installed beside the same dependencies, and used: the page's program, and a shipped agent."""
    source, empty, home = tmp_path / "source", tmp_path / "empty", tmp_path / "environment"
    source.mkdir()
    empty.mkdir()
    listed = command(
        "git",
        "ls-files",
        "-co",
        "--exclude-standard",
        *PACKAGES,
        *(f"{name}.py" for name in MODULES),
        cwd=ROOT,
    ).splitlines()
    for name in ("pyproject.toml", "README.md", *listed):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip = (sys.executable, "-m", "pip", "-q", "--disable-pip-version-check")
    command(*pip, "wheel", "--no-build-isolation", "--no-deps", "-w", tmp_path, source, cwd=empty)
    (wheel,) = tmp_path.glob("*.whl")

    command(sys.executable, "-m", "venv", "--without-pip", home, cwd=empty)
    python = home / "bin" / "python"
    installed = Path(
        command(python, "-c", "import site; print(site.getsitepackages()[0])", cwd=empty).strip()
    )
    command(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=empty)
    others = next(path for path in sys.path if path.endswith("site-packages"))
    (installed / "dependencies.pth").write_text(f"{others}\n")

    program, promised = page()
    assert command(python, "-W", "ignore", "-c", program + AFTERWARDS, cwd=empty) == promised
    assert {
        path.name
        for path in (installed / "study").rglob("*.*")
        if path.suffix in (".j2", ".css", ".js", ".txt")
    } == {
        path.name for path in (ROOT / "study").rglob("*.*") if path.suffix in (".j2", ".css", ".js", ".txt")
    }
    settings = {path.relative_to(ROOT) for path in (ROOT / "configs").rglob("*.*") if path.suffix != ".py"}
    assert all(
        (installed / path).read_bytes() == (ROOT / path).read_bytes()
        for path in settings
        if path.suffix != ".pyc"
    )
    own = home / "bin" / "rta-inspection"
    flight = tmp_path / "flight.npz"
    named = ("--config", "chiefs/satellite", "--config", "3u", "--out", flight)  # a mesh, and a vehicle
    command(own, "simulate", "--controller", "zero", "--no-rta", "--duration", "2", *named, cwd=empty)
    assert "mass = 4.0" in str(np.load(flight)["parameters"]) and np.load(flight)["chief_triangles"].size
    version = PROJECT["project"]["version"]
    assert command(own, "--version", cwd=empty) == f"rta-inspection {version}\n"
    helped = command(own, cwd=empty)
    assert helped.startswith("usage: rta-inspection ") and "break-points" in helped
    assert not list(empty.iterdir())


def modules() -> list[Path]:
    alone = [ROOT / f"{name}.py" for name in MODULES]
    return alone + [
        path for package in PACKAGES for path in sorted((ROOT / package.replace(".", "/")).glob("*.py"))
    ]


def test_every_package_is_listed() -> None:
    top = {package.split(".")[0] for package in PACKAGES}
    found = {path.parent.relative_to(ROOT) for name in top for path in (ROOT / name).rglob("*.py")}
    found |= {path.parent.relative_to(ROOT) for path in (ROOT / "configs").rglob("*.toml")}
    assert {".".join(path.parts) for path in found} == set(PACKAGES)


IMPORTED = {"bsk": "Basilisk"}  # names that are not the package's
SHIPPED_WITH = {"mpl_toolkits": "matplotlib"}


def declared() -> dict[str, Requirement]:
    """By the name that is imported."""
    project = PROJECT["project"]
    every = chain(project["dependencies"], *project["optional-dependencies"].values())
    return {IMPORTED.get(each.name, each.name.replace("-", "_")): each for each in map(Requirement, every)}


def test_every_import_is_declared() -> None:
    imported = set()
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(str(node.module).split(".")[0])
    own = {package.split(".")[0] for package in (*PACKAGES, *MODULES)}
    needed = {SHIPPED_WITH.get(name, name) for name in imported}
    lacking = needed - own - sys.stdlib_module_names - set(declared())
    assert not lacking
    assert {"torch", "piqp", "gymnasium", "markupsafe"} <= imported


def test_the_pins_satisfy_the_bounds() -> None:
    pins = {}
    for name in ("requirements.txt", "requirements-optional.txt", "requirements-basilisk.txt"):
        for line in (ROOT / name).read_text(encoding="utf-8").split():
            package, version = line.split("==")
            pins[IMPORTED.get(package, package.replace("-", "_"))] = version
    for name, requirement in declared().items():
        assert requirement.specifier.contains(pins[name]), name
        assert requirement.specifier, f"{name} has no lower bound"


def test_without_gymnasium_interfaces_say_so() -> None:
    program = "import sys; sys.modules['gymnasium'] = None; import interfaces"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == "ImportError: interfaces needs Gymnasium: pip install gymnasium"
