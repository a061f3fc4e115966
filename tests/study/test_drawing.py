"""Figures are drawn whatever backend MPLBACKEND names, and whoever imports them keeps their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = """
import os
import study.drawing
from matplotlib import rcParams
from study.flight.figures import Figure
figure = Figure()
figure.add_subplot().plot([0, 1])
figure.savefig("figure.png")
print(os.environ.get("MPLBACKEND"), rcParams._get("backend"))
"""


@pytest.mark.parametrize(
    ("named", "used"),
    [
        ("module://matplotlib_inline.backend_inline", None),  # a shell below Jupyter or Colab
        ("module://there.is.none", "module://there.is.none"),
        ("nonsense", None),
        ("TkAgg", "tkagg"),
        ("svg", "svg"),
        ("", ""),
    ],
)
def test_figures_are_drawn_whatever_backend_is_named(named: str, used: str | None, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": named, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    kept, backend = done.stdout.split(" ", 1)
    assert kept == named and (tmp_path / "figure.png").stat().st_size > 1000
    assert used is None or not used or backend.strip().lower() == used


def test_nothing_else_of_the_study_imports_matplotlib() -> None:
    names = [
        path for path in (ROOT / "study").rglob("*.py") if "matplotlib" in path.read_text(encoding="utf-8")
    ]
    assert [path.name for path in names] == ["drawing.py"]
