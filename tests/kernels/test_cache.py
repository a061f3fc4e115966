"""What is recorded once is read in later runs, unless anything that it depends on is another."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import InspectionParameters, Limits
from inspection.model.state import OMEGA, P
from inspection.world.uncertainty import Uncertainty
from kernels import build
from kernels.cache import remembered
from kernels.digest import digest
from rta.check import flight
from rta.fast.filter import printed_answer
from rta.filter import SafetyFilter
from rta.limits import Limit
from rta.parameters import RtaParameters
from rta.robust.filter import RobustFilter
from tests.support.filters import without_check

ROOT = Path(__file__).parents[2]
OWN = {
    "own": "import helper\nGAIN = 2.0\ndef made(x):\n    print('computed')\n    return GAIN * helper.turned(x)\n",
    "helper": "from functools import cache\nclass Turn:\n    by = -1.0\n    def of(self, x):\n"
    "        return x * self.by\n"
    "@cache\ndef turned(x):\n    from this import more\n    return Turn().of(x) + more()\n",
    "this": "def more():\n    return 0.0\n",
}  # modules of somebody's own, one with the name of one of Python's
RUN = "from kernels.cache import remembered; import own; print(remembered(own.made, 1.0))"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a cache of its own."""
    monkeypatch.setenv(build.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a directory with OWN, from which modules are imported."""
    for name, text in OWN.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path


def answers(capsys: pytest.CaptureFixture[str], x: float = 1.0) -> list[str]:
    """Returns the output of RUN with the modules as they are now."""
    for name in OWN:
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    capsys.readouterr()
    print(remembered(importlib.import_module("own").made, x))
    return capsys.readouterr().out.split()


def test_what_another_process_computed_is_read(
    cache: Path, written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = os.pathsep.join([str(ROOT), str(written)])
    command = [sys.executable, "-B", "-c", RUN]
    said = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, check=True)
    assert said.stdout.split() == [b"computed", b"-2.0"] and len(list(cache.iterdir())) == 1
    assert answers(capsys) == ["-2.0"]
    assert answers(capsys, 3.0) == ["computed", "-6.0"]


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        ("own", "GAIN = 2.0", "GAIN = 3.0", "-3.0"),
        ("own", "GAIN * helper", "helper", "-1.0"),
        ("helper", "by = -1.0", "by = 4.0", "8.0"),
        ("helper", "x * self.by", "x + self.by", "0.0"),
        ("this", "0.0", "1.0", "0.0"),
    ],
)
def test_a_changed_line_of_anybodys_is_another_function(
    name: str,
    old: str,
    new: str,
    expected: str,
    cache: Path,
    written: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    answers(capsys)
    path = written / f"{name}.py"
    path.write_text(path.read_text().replace(old, new))
    assert answers(capsys) == ["computed", expected]


def test_what_cannot_be_told_is_not_kept(cache: Path) -> None:
    numbers = iter([1.0, 2.0, 3.0])
    handle = (value for value in numbers)

    def following() -> float:
        return next(handle)

    assert digest(following) is None
    assert [remembered(following), remembered(following)] == [1.0, 2.0]
    assert not cache.exists()


def half(x: Tensor) -> Tensor:
    return 0.5 * x


def test_closures_partials_methods_and_tensors_count() -> None:
    def by(factor: object) -> Callable[[Tensor], Tensor]:
        return lambda x: factor * x

    tensor = torch.arange(3.0)
    things = [by(1.0), by(1), by(-0.0), by(0.0), by(tensor), by(tensor.double()), by(tensor[:2]), partial(half),
              partial(half, tensor), half, InspectionParameters().__eq__, {1: 2}, {2: 1}, {1, 2}, [1, 2], (1, 2),
              Uncertainty(mass=0.1), flight, torch.sin, torch.cos, tensor.sin, len, [].append]  # fmt: skip
    assert len({digest(each) for each in things}) == len(things) and None not in map(digest, things)
    assert digest(by(tensor)) == digest(by(tensor.clone()))


def farther(x: Tensor, c: Limits) -> Tensor:
    """Returns m outside 50 m."""
    return norm(x[P]) - 50.0


def slower(x: Tensor, c: Limits) -> Tensor:
    """Returns 1e-3 rad^2/s^2 less the squared rate."""
    return 1e-3 - (x[OMEGA] * x[OMEGA]).sum(0)


def test_equal_filters_are_recorded_once_and_others_by_themselves() -> None:
    own = {"farther": Limit(farther, (0.01, 0.1), 1e6)}
    others = [
        without_check(SafetyFilter()),
        SafetyFilter(),
        SafetyFilter(parameters=RtaParameters(period=5.0)),
        SafetyFilter(InspectionParameters(mass=12.5)),
        SafetyFilter(extra=own),
        SafetyFilter(extra={"slower": Limit(slower, (0.3,), 1e6)}),
        SafetyFilter(extra={"farther": own["farther"]._replace(gains=(0.01, 0.125))}),
        SafetyFilter(extra={"farther": own["farther"]._replace(weight=1e5)}),
        RobustFilter(uncertainty=Uncertainty(mass=0.1)),
    ]
    again = [SafetyFilter(InspectionParameters(), RtaParameters()), SafetyFilter(extra=dict(own))]
    names, equal = ([digest(printed_answer, each, False) for each in filters] for filters in (others, again))
    assert len(set(names)) == len(names) and None not in names
    assert equal == [names[1], names[4]]
