"""Recorded states on whose ways a law broke a limit that its plan kept: they are refused, or nothing breaks."""

import pytest
import torch
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.state import OMEGA, TORQUE, Q
from tests.rta.check.flights import C, in_c, least_between, least_of, safety

# position, velocity, attitude, rates, and temperature, charge and the Sun's angle
REFUSED = {
    "far out and fast, along the zone": """-123.62049 494.86842 603.61029  -2.4820 -3.90993 3.48046
        -0.595589 -0.034176 -0.769784 0.227019  0.034906 -0.034638 0.012725  5.0 6.5 1.55096""",
    "hot, with rates that are not the law's": """100 0 0  0 0 0
        -0.857427 -0.202538 0.160551 0.444994  0.029927 0.019323 -0.031676  9.991878 6.0 3.956315""",
}
# Turning at all limits of the rates, with a control at 10 s under which a plant that holds the rates keeps all limits
# in its own steps. In shorter ones they are clamped sooner, and passive safety breaks by 6.7 m. The check holds the
# rates itself: what is verified never meets the clamp.
CLAMPED = """108.83062793259712 0.15979367526855467 -102.73916508785312
    -0.8563259525965546 0.4816658868905582 0.7439023280788077
    -0.15142152428167893 -0.25818335406579923 -0.9418566454678843 0.1527044965589766
    -0.03490658503988659 0.03490658503988659 -0.03490658503988659
    9.880520352243419 2.1276257418265305 0.5976667226013289"""
DESIRED = (-1.0, 1.0, -1.0, -0.0010000569, -0.0010000569, 0.0010000569)


def column(numbers: str) -> Tensor:
    x = torch.tensor([*map(float, numbers.split())], dtype=torch.float64)[:, None]
    x[Q] /= x[Q].norm()
    return x


@pytest.mark.parametrize("kind", REFUSED)
def test_a_state_whose_way_breaks_a_limit_is_refused(kind: str) -> None:
    x, flight = column(REFUSED[kind]), in_c("paper", 10.0)
    accepted, least = safety("paper", 10.0).is_safe(x), torch.from_numpy(least_of(x, C))
    assert (least >= 0.0).all()
    for _ in range(20):
        after, _, u, *_ = flight(x)
        least = torch.minimum(least, torch.from_numpy(least_between(x, u, 10.0, C, look=1.0)))
        x = after
    assert not accepted or (least >= 0.0).all()


def test_a_flight_in_shorter_steps_is_the_one_that_was_checked() -> None:
    x, desired = column(CLAMPED), torch.tensor(DESIRED, dtype=torch.float64)[:, None]
    f = safety("paper", 10.0)
    assert not f.is_safe(x) and not f.correct(x, desired).verified  # at its limit a rate has no room
    x[OMEGA] *= 1.0 - 1e-6
    answer = f.correct(x, desired)
    assert f.is_safe(x) and answer.verified and (answer.control != desired)[TORQUE].all()
    lowest = []
    for control in (desired, answer.control):
        states = [x]
        for _ in range(1000):
            states.append(step(states[-1], control, 0.01, C))
        lowest.append(f.values(torch.cat(states, 1)).amin(1))
    assert lowest[0][f.names.index("passive_safety")] < 0.0 and (lowest[1] >= -1e-9).all()
