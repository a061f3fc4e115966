"""A 14th limit, added in the two files that the guide names, is known to every command (your_own_constraint.md)."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.mutants import copy_of_the_code

LIMIT = '''
def total_speed(x: Tensor, c: Limits) -> Tensor:
    """(1.2 v_max)^2 - |v|^2 in m^2/s^2."""
    return (1.2 * c.max_speed) ** 2 - (x[3:6] * x[3:6]).sum(0)


OWN: dict[str, Limit] = {"total_speed": Limit(total_speed, (0.2,), 1e12)}'''


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a copy of the code with the limit."""
    copy = copy_of_the_code(tmp_path_factory.mktemp("fourteen"))
    for file, old, new in (
        ("names.py", "OWN: tuple[str, ...] = ()", 'OWN: tuple[str, ...] = ("total_speed",)'),
        ("names.py", '"m/s"),\n', '"m/s"),\n    "total_speed": "m^2/s^2",\n'),
        ("own.py", "OWN: dict[str, Limit] = {}", LIMIT),
    ):
        path = copy / "rta" / file
        text = path.read_text()
        assert text.count(old) == 1, (file, old)
        path.write_text(text.replace(old, new))
    return copy


def run(tree: Path, *words: str) -> str:
    """Returns a command's output."""
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


SAME = """
import json
import torch
from inspection.model.parameters import InspectionParameters
from inspection.initial_state import sample_initial_state
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.own import OWN
from rta.parameters import RtaParameters

c, generator = InspectionParameters(), torch.Generator().manual_seed(1)
safety_filter = SafetyFilter(c, RtaParameters(), OWN)
x = sample_initial_state(64, generator, c)[0]
x[3:6] *= 5.0  # some faster than allowed, and many that the check has to slow down
u = torch.tensor(c.control_limit)[:, None] * (2 * torch.rand(6, 64, generator=generator, dtype=torch.float64) - 1)
safety_filter = fast(safety_filter) if COMPILED else batched(safety_filter)
result = safety_filter.correct(x, u)
print(json.dumps([part.tolist() for part in (result.control, result.h, result.verified)]))
"""


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_where_it_is_far_off_the_filter_and_its_check_do_as_they_did(tree: Path, compiled: bool) -> None:
    program, here = SAME.replace("COMPILED", str(compiled)), io.StringIO()
    there = subprocess.check_output([sys.executable, "-c", program], cwd=tree, text=True)
    with contextlib.redirect_stdout(here):
        exec(program, {})
    (control, h, verified), (expected, lower_h, known) = (
        map(torch.tensor, json.loads(said)) for said in (there, here.getvalue())
    )
    assert len(h) == 14 and len(lower_h) == 13
    torch.testing.assert_close(h[:13], lower_h)
    torch.testing.assert_close(control, expected, rtol=1e-9, atol=1e-9)
    assert torch.equal(verified, known) and known.any() and not known.all()


KNOWN = """
import main
import study.experiment as e
import study.verified as v
from study.config import Config

flown = "--episodes", "1", "--no-rta", "--compile", "off", "--inspection.max_time", "50", "--json", "out.json"
assert main.main(["evaluate", "--controller", "quick", *flown]) == 0
print(v.why_unverified(Config()))
e.OWN = ("other",)
try:
    e.filter_of(Config())
except e.InputError as error:
    print(error)
"""


def test_it_is_evaluated_named_in_order_and_no_campaign_of_thirteen_speaks_for_it(tree: Path) -> None:
    *said, doubted, refused = subprocess.check_output(
        [sys.executable, "-c", KNOWN], cwd=tree, text=True
    ).splitlines()
    assert "total speed" in "".join(said) and "nan" not in "".join(said)
    assert json.loads((tree / "out.json").read_text())["violations_percent"]["total_speed"] == 0.0
    assert doubted.startswith('not verified: limits of your own = ["total_speed"] (verified: [])')
    assert "OWN = ['other']: must be ['total_speed']" in refused


@pytest.mark.campaign
def test_campaigns_aim_at_it(tree: Path) -> None:
    small = "--compile", "on", "--episodes", "4", "--duration", "20"
    for how in (("--policy", "random"), ("--policy", "lookahead"), ("--starts", "limits")):
        assert "total_speed" in run(tree, "verify", *how, *small)
