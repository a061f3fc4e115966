"""Where a flight of the page begins: test cases of the task, and states next to what must not happen."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from inspection.model.attitude import norm, unit
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THETA_S, E, P, Q, T, V
from rta.filter import SafetyFilter
from settings import InputError
from study.config import TEST_CASES, Config
from study.experiment import test_cases

CASES = 40  # of `evaluate` and `simulate`, the first
RAM_SPEED = 1.0  # m/s
RAM_SECONDS = range(540, 1600, 20)  # until it hits in free flight; the filter keeps 500 s clear
LEAVING = 780.0  # m
LEAVING_SPEEDS = [0.1 * k for k in range(12, 0, -1)]  # m/s
RESERVES = [0.01 * k for k in range(1, 100)]  # above the battery's limit, of what is above it when full
PRIORITY = (0.0, 0.0, 1.0)


def starts(config: Config, filters: Sequence[SafetyFilter]) -> list[dict[str, Any]]:
    """Starts with their name, state [16] and priority [3]; the cases are named by their number.

    Those made here are the hardest from which every filter can keep all limits.

    Raises:
        InputError: there is none, or no case can be drawn.
    """
    x, priority, _ = test_cases(config, CASES, TEST_CASES)
    cases = [
        {"name": f"case {i}", "state": x[:, i].tolist(), "priority": priority[:, i].tolist()}
        for i in range(CASES)
    ]
    c = config.inspection
    made: dict[str, Callable[[InspectionParameters], Iterator[Tensor]]] = {
        "ram": ramming,
        "leaving": leaving,
        "battery": nearly_empty,
    }
    for name, candidates in made.items():
        state = hardest(candidates(c), filters)
        if state is None:
            raise InputError(f"no start {name!r} from which the filter keeps all limits of this spacecraft")
        cases.append({"name": name, "state": state[:, 0].tolist(), "priority": list(PRIORITY)})
    return cases


def hardest(candidates: Iterator[Tensor], filters: Sequence[SafetyFilter]) -> Tensor | None:
    """The first of states (16, 1) from which every filter can keep all limits."""
    return next((x for x in candidates if all(bool(each.is_safe(x).all()) for each in filters)), None)


def at_rest(c: InspectionParameters, direction: Sequence[float], sunlit: float) -> Tensor:
    """A state (16, 1) at rest, 1 m from the chief in a direction, the camera on the chief.

    Args:
        sunlit: rad from the direction of the deputy to the Sun's, in the orbital plane.
    """
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    x[P, 0] = unit(x.new_tensor(direction)[:, None])[:, 0]
    x[Q, 0] = x.new_tensor(turn_to(-x[P, 0]))
    x[T, 0] = sum(c.initial_temperature) / 2
    x[E, 0] = c.initial_energy[1]
    x[THETA_S, 0] = torch.atan2(x[1, 0], x[0, 0]) + sunlit
    return x


def turn_to(camera: Tensor) -> list[float]:
    """The quaternion whose +x axis is a unit vector (3,) in Hill's frame: the shortest turn, scalar last."""
    a, b, c = camera.tolist()  # x cross camera = [0, -c, b]
    q = torch.tensor([0.0, -c, b, 1.0 + a], dtype=torch.float64)
    return list((q / q.norm()).tolist())


def ramming(c: InspectionParameters) -> Iterator[Tensor]:
    """Ways on which free flight hits the chief's centre, the shortest first."""
    each, none = torch.eye(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    for seconds in RAM_SECONDS:
        x, t = at_rest(c, (0.5, -0.75, 0.45), 0.6), each.new_tensor(seconds)
        by_speed = free_flight(none, each, t, c.mean_motion)  # m by m/s: the flow is linear
        x[V] = -torch.linalg.solve(by_speed, free_flight(x[P], none[:, :1], t, c.mean_motion))
        scale = RAM_SPEED / norm(x[V])
        x[P], x[V] = x[P] * scale, x[V] * scale
        yield x


def leaving(c: InspectionParameters) -> Iterator[Tensor]:
    """Next to the end of the zone and on the way out, the fastest first."""
    for speed in LEAVING_SPEEDS:
        x = at_rest(c, (0.6, 0.75, 0.3), 0.6)
        x[V] = speed * x[P]
        x[P] = x[P] * LEAVING * c.max_distance / 800.0
        yield x


def nearly_empty(c: InspectionParameters) -> Iterator[Tensor]:
    """The panels in the dark, the battery from empty on."""
    for reserve in RESERVES:
        x = at_rest(c, (-0.8, 0.5, 0.2), 1.9)
        x[P] = 6.0 * c.collision_radius * x[P]
        x[E] = c.min_energy + reserve * (c.initial_energy[1] - c.min_energy)
        yield x
