"""Takes off each wing of the house, and looks whether the rest stands: `rm -r` of it and of the tests that import it.

    python -m tests.wings                  # every wing
    python -m tests.wings rta/robust       # this one
    python -m tests.wings --all            # with every test that is left, an hour

Of what is left everything must import, the README's first command must run (with little to do), and a test of the
paper's limits, of the task and of the learner must pass. Prints a line for each; the exit code is 1 if something falls.
"""

import argparse
import ast
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
WINGS = {
    "rta/robust": ("rta/robust", "tests/rta/robust"),
    "rta/fast": ("rta/fast", "kernels", "tests/rta/fast", "tests/kernels"),
    "study/web": ("study/web", "tests/study/web"),
    "study/export": ("study/export", "tests/study/export"),
    "interfaces": ("interfaces", "tests/interfaces"),
    "experiments": ("experiments", "tests/experiments"),
}
AT_ONCE = 2
LITTLE = ("--interactions=2048", "--num-envs=32", "--train.jump_start=1024", "--evaluation-interval=2048",
          "--train.early_evaluations=1", "--evaluation-episodes=1", "--final-episodes=1",
          "--inspection.max_time=300")  # fmt: skip
FIRST = ("main.py", "train", "--config", "configs/quickstart.toml")
TESTS = ("tests/rta/test_limits.py", "tests/inspection/model/test_dynamics.py", "tests/ppo/test_gae.py")


def imported(path: Path) -> Iterator[str]:
    """Yields the modules that a file imports when it is imported itself, as folders."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{name.name}".replace(".", "/") for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name.replace(".", "/") for name in node.names)


def take_off(folder: Path, parts: tuple[str, ...]) -> None:
    """Removes parts, and every test of them: that imports one, another wing that needs it, or a test that is gone."""
    for part in parts:
        shutil.rmtree(folder / part, ignore_errors=True)
    gone = {part for part in parts if not part.startswith("tests")}
    while True:
        found = {
            path.relative_to(folder).with_suffix("").as_posix()
            for path in folder.rglob("*.py")
            if any(name.startswith(tuple(gone)) for name in imported(path))
        }
        if found <= gone:
            break
        gone |= found
    for name in gone:
        if name.startswith("tests/") and name != "tests/wings":
            (folder / f"{name}.py").unlink(missing_ok=True)


def stands(wing: str, every_test: bool) -> bool:
    """Takes a wing off a copy of the house, prints its line, with what falls below it; says whether all stands."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "house"
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
        )
        for name in listed.stdout.splitlines():
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, folder / name)
        take_off(folder, WINGS[wing])
        tests = ["-n", "2", "--dist", "loadfile", "tests"] if every_test else here(folder)
        commands = {
            "collects": (sys.executable, "-m", "pytest", "--collect-only", "-q", "tests"),
            "trains": (sys.executable, *FIRST, *LITTLE, "--run-dir", "runs/first"),
            "passes": (sys.executable, "-m", "pytest", "-q", *tests),
        }
        done = {
            name: subprocess.run(command, cwd=folder, capture_output=True, text=True)
            for name, command in commands.items()
        }
    said = (f"{name} {'yes' if run.returncode == 0 else 'NO'}" for name, run in done.items())
    lines = [f"without {wing:14} {', '.join(said)}"]
    for run in done.values():
        if run.returncode:
            lines += [f"    {line}" for line in (run.stdout + run.stderr).splitlines()[-5:]]
    print("\n".join(lines), flush=True)
    return all(run.returncode == 0 for run in done.values())


def here(folder: Path) -> list[str]:
    """Returns the TESTS that are there."""
    return [each for each in TESTS if (folder / each).exists()]


def main(words: list[str] | None = None) -> int:
    """Takes off the wings that are named, or all; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.wings", description=__doc__.partition("\n")[0])
    parser.add_argument("wings", nargs="*", metavar="WING", help=f"of {', '.join(WINGS)}")
    parser.add_argument("--all", action="store_true", help="run every test that is left")
    given = parser.parse_args(words)
    for wing in given.wings:
        if wing not in WINGS:
            parser.error(f"{wing}: must be one of {', '.join(WINGS)}")
    with ThreadPoolExecutor(1 if given.all else AT_ONCE) as workers:
        return int(not all(list(workers.map(lambda wing: stands(wing, given.all), given.wings or WINGS))))


if __name__ == "__main__":
    sys.exit(main())
