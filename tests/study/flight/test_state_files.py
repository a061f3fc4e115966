"""Files of states: what editors put into them, and what looks like another unit or order."""

import json
from pathlib import Path
from typing import Any

import pytest

from inspection.model.parameters import InspectionParameters
from study.flight.state_files import read_state

STATE: dict[str, Any] = {
    "position": [60.0, 10.0, -20.0],
    "velocity": [0.0, 0.0, 0.0],
    "quaternion": [0.0, 0.0, 0.0, 1.0],
    "angular_velocity": [0.0, 0.0, 0.0],
    "temperature": 5.0,
    "energy": 6.0,
    "sun_angle": 3.0,
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"temperature": 60.0, "energy": 90.0}, ""),  # too hot, and charged by two orbits in the Sun
        ({"temperature": 278.15}, "temperature above 160 deg C: is it in K? It must be in deg C\n"),
        ({"energy": 6000.0}, "energy above 1400 kJ: is it in J? It must be in kJ\n"),
        (
            {"quaternion": [1.0, 0.0, 0.0, 0.0]},
            "quaternion [1, 0, 0, 0], half a turn about x: is its scalar first? It must be last\n",
        ),
        ({"quaternion": [0.6, 0.8, 0.0, 0.0]}, ""),
    ],
)
def test_what_looks_like_another_unit_is_said(
    change: dict[str, Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps(STATE | change))
    read_state(str(path), InspectionParameters())
    assert capsys.readouterr().err == (f"{path}: {said}" if said else "")
