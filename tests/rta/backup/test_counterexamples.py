"""Ways that were verified and break a limit when they are flown (docs/reference/proof.md, the counterexample).

They are expected to fail. Who mends the check takes the mark away.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from inspection import InspectionParameters, Q, step
from rta import RtaParameters, SafetyFilter
from study import config as configuration

# position, velocity, attitude, rates, and temperature, charge and the Sun's angle
ALONG_THE_ZONE = {  # starts that are far out and fast, by period in s
    1.0: """396.459154 569.064568 328.658106  -3.916005 3.882933 1.568363  0.168598 0.614562 0.563901 0.525265
            -0.031032 -0.033549 0.015019  5.0 6.5 6.149597""",
    5.0: """301.22034 301.44564 -659.37797  -4.385562 -1.081647 -3.677801  -0.255119 0.050424 0.812369 0.521947
            -0.006739 0.034906 -0.000082  5.0 6.5 0.652854""",
    10.0: """-123.62049 494.86842 603.61029  -2.4820 -3.90993 3.48046  -0.595589 -0.034176 -0.769784 0.227019
             0.034906 -0.034638 0.012725  5.0 6.5 1.55096""",
}
UNEQUAL_MOMENTS = """100 0 0  0 0 0  0.326309 -0.121726 -0.936938 0.029202
                     -0.003149 -0.000305 0.002657  9.99 234 4.183952"""


def column(numbers: str) -> Tensor:
    x = torch.tensor([*map(float, numbers.split())], dtype=torch.float64)[:, None]
    x[Q] /= x[Q].norm()
    return x


def least_of_the_laws(safety: SafetyFilter, x: Tensor, seconds: float) -> Tensor:
    """The least h (constraints,) on the way that the laws fly from a state (16, 1), looked at every second."""
    if not safety.backup or not safety.is_safe(x).all():
        raise RuntimeError("no verified way begins here")
    lowest = safety.values(x)
    for _ in range(round(seconds / safety.period)):
        u = torch.zeros(6, 1, dtype=torch.float64)
        u[3:] = safety.backup.slews(x, u)
        u[:3] = safety.backup.brakes_with(x, u)
        for _ in range(round(safety.period)):
            x = step(x, u, 1.0, safety.c)
            lowest = lowest.minimum(safety.values(x))
    return lowest[:, 0]


@pytest.mark.xfail(
    strict=True, raises=AssertionError, reason="the plan that is verified is not the law that is flown"
)
@pytest.mark.parametrize("period", ALONG_THE_ZONE)
def test_a_verified_way_along_the_zone_keeps_the_limits(period: float) -> None:
    safety = SafetyFilter(InspectionParameters(), RtaParameters(period=period))
    assert (least_of_the_laws(safety, column(ALONG_THE_ZONE[period]), 70.0) >= 0.0).all()


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="the gyroscopic sag at the end of a hold is not the one in its middle",
)
def test_a_verified_turn_with_unequal_moments_keeps_the_rates() -> None:
    config = configuration.load(configuration.find("vehicles/espa"))
    c = replace(config.inspection, saturate_rates=False)
    safety = SafetyFilter(c, replace(config.rta, period=10.0))
    assert (least_of_the_laws(safety, column(UNEQUAL_MOMENTS), 200.0) >= 0.0).all()
