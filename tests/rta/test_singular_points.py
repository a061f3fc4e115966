"""Attitudes where the angle that a broken limit counts has no slope: the filter turns away from them."""

import math

import pytest
import torch
from torch import Tensor

from inspection.model.dynamics import step, sun_and_earth_in_body
from inspection.model.parameters import InspectionParameters
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters

C = InspectionParameters()
LIMIT = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
# By limit, the angle theta_s of the Sun for a body whose axes are Hill's (camera +x, surface -y, panels -x) and what
# breaks the limit: deg C, kJ.
POINTS = {
    "attitude_exclusion": (0.0, 5.0, 6.0),
    "temperature": (-math.pi / 2, C.max_temperature + 0.2, 6.0),
    "battery": (0.0, 5.0, C.min_energy - 0.2),
}
AXES = {"attitude_exclusion": (0, 1.0), "temperature": (1, -1.0), "battery": (0, 1.0)}  # that the Sun is at


def at(limit: str) -> Tensor:
    """Returns a state (16, 1) exactly at the point, at rest 60 m above the chief."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[0], x[9] = 60.0, 1.0
    x[15], x[13], x[14] = POINTS[limit]
    return x


@pytest.mark.parametrize("period", [1.0, 10.0])
def test_the_filter_turns_away_from_a_pole(period: float) -> None:
    """By more than 40 deg, which is the exclusion zone, in a minute; nothing is desired, or full torque in turns."""
    limits = list(POINTS)
    safety = fast(SafetyFilter(C, RtaParameters(period=period)), "cpu", 2 * len(limits))
    x = torch.cat([at(limit) for limit in limits] * 2, 1)
    torque = torch.tensor([0.0] * len(limits) + [1.0] * len(limits)) * LIMIT[3:]
    columns = torch.arange(x.shape[1])
    index, sign = (torch.tensor(part) for part in zip(*(AXES[limit] for limit in limits * 2), strict=True))

    def away(x: Tensor) -> Tensor:
        return (sun_and_earth_in_body(x)[0][index, columns] * sign).clamp(-1.0, 1.0).arccos()

    assert away(x).max() < 1e-6
    broken = torch.tensor([safety.names.index(limit) for limit in limits * 2])
    assert (safety.values(x)[broken, columns] < 0.0).all()
    farthest = torch.zeros_like(x[0])
    for call in range(int(60 / period)):
        desired = torch.cat((torch.zeros_like(torque), torque * (-1.0) ** call))
        answer = safety.correct(x, desired)
        if call == 0:
            assert answer.violated.all() and (answer.control[3:] != 0.0).any(0).all()
        for _ in range(int(period)):
            x = step(x, answer.control, 1.0, C)
        farthest = farthest.maximum(away(x))
    assert (farthest > math.radians(40.0)).all(), dict(zip(limits * 2, farthest.tolist(), strict=True))
