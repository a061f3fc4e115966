"""A 14th limit, added in the two files that the guide names, is known to every command (your_own_constraint.md)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutants import copy_of_the_code

LIMIT = '''

def total_speed(c: Limits, r: RtaParameters) -> Constraint:
    """(1.2 v_max)^2 - |v|^2 in m^2/s^2."""
    return Entry(
        "total_speed",
        lambda x: (1.2 * c.max_speed) ** 2 - dot(x[V], x[V]),
        gains=(r.velocity_gain,),
        margin=0.02,
        weight=r.slack_weight_motion,
    )
'''


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the code with the limit."""
    copy = copy_of_the_code(tmp_path_factory.mktemp("fourteen"))
    for file, old, new in (
        ("names.py", '    "velocity_z",\n)', '    "velocity_z",\n    "total_speed",\n)'),
        ("names.py", '"m/s"),\n', '"m/s"),\n    "total_speed": "m^2/s^2",\n'),
        (
            "thrust.py",
            "for i in range(3)),\n    )\n",
            f"for i in range(3)),\n        total_speed(c, r),\n    )\n{LIMIT}",
        ),
    ):
        path = copy / "rta" / "constraints" / file
        text = path.read_text()
        assert text.count(old) == 1, (file, old)
        path.write_text(text.replace(old, new))
    return copy


def run(tree: Path, *words: str) -> str:
    """What a command prints."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(
        [sys.executable, "main.py", *words],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stderr
    return done.stdout


def test_it_is_evaluated_and_no_campaign_of_thirteen_speaks_for_it(tree: Path) -> None:
    said = run(
        tree, "evaluate", "--controller", "quick", "--episodes", "1", "--no-rta", "--compile", "off",
        "--inspection.max_time", "50", "--json", "out.json"
    )  # fmt: skip
    assert "total speed" in said and "nan" not in said
    assert json.loads((tree / "out.json").read_text())["violations_percent"]["total_speed"] == 0.0
    digest = "import study.verified as v; print(v.settings_digest(v.Config()))"
    ours, theirs = (
        subprocess.check_output([sys.executable, "-c", digest], cwd=where)
        for where in (tree, Path(__file__).parents[2])
    )
    assert ours != theirs


@pytest.mark.campaign
def test_campaigns_aim_at_it(tree: Path) -> None:
    small = "--compile", "off", "--episodes", "4", "--duration", "20"
    for policy in ("random", "lookahead"):
        assert "total_speed" in run(tree, "verify", "--policy", policy, *small)
    assert "14 limits" in run(tree, "boundary", "--draws", "64")
