"""The golden numbers that take seconds, and that a comparison says what has moved."""

import copy

import pytest

from inspection.model.parameters import InspectionParameters
from tests import golden

PART = "filter/quick"


@pytest.fixture(scope="module")
def answers() -> golden.Quantities:
    """Returns the filter's answers."""
    return golden.PARTS[PART]()


@pytest.fixture
def planted(answers, monkeypatch, tmp_path) -> golden.Quantities:
    """Returns a copy for planted changes, which the program computes, beside a copy of golden.json."""
    path = tmp_path / "golden.json"
    path.write_text(golden.FILE.read_text())
    changed = copy.deepcopy(answers)
    monkeypatch.setattr(golden, "FILE", path)
    monkeypatch.setitem(golden.PARTS, PART, lambda: changed)
    return changed


def test_quick_parts_are_as_recorded(planted, capsys):
    code = golden.main([PART, "network", "training/no_rta"])
    assert code == 0, capsys.readouterr().out


@pytest.mark.parametrize("column", (0, 7))  # 0 is a sample, and 7 none
def test_a_control_that_moved_is_reported(planted, column, capsys):
    planted["control"]["thrust_y"][column] += 1e-6 * InspectionParameters().max_thrust
    assert golden.main([PART]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if "BEYOND" in line]
    assert len(lines) == 1 and "control" in lines[0] and "1.0e-06 in thrust_y" in lines[0]


def test_a_label_that_moved_is_reported(planted, capsys):
    planted["verified"][0] = str(planted["verified"][0] != "True")
    assert golden.main([PART]) == 1
    assert "MOVED" in capsys.readouterr().out


def test_renewing_shows_and_replaces(planted, capsys):
    planted["control"]["thrust_x"][3] += 1e-3
    assert golden.main([PART, "--renew"]) == 0
    assert "BEYOND" in capsys.readouterr().out
    assert golden.main([PART]) == 0
    assert "BEYOND" not in capsys.readouterr().out
