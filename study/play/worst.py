"""A world whose errors are at their worst as C, for the page: its plant, its sensors, and who chooses its corners.

By hand, in `driver/worst.c`, are what is kept from call to call, by the rules of `hold`, `sense` and `tell` of `Plant`,
and the decisions of `Greedy`: it compares the slopes and margins that are printed.
"""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from inspection.model.draws import key_of
from inspection.model.parameters import InspectionParameters
from inspection.world.corners import CORNER, ERRORS, GAINS, Recorded
from inspection.world.parameters import PlantParameters, bounds
from inspection.world.plant import Plant, draw
from kernels.printer import printed
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from rta.printed.source import define, for_one
from settings import InputError
from study.config import Config
from study.experiment import plant_numbers
from study.play.printed import driver
from study.play.starts import CASES, starts
from study.verification.adversaries import NEXT_TO_NOTHING, Greedy

SEEDS = range(8)  # of `simulate`, whose plants are flown in turns


def told(config: Config) -> SafetyFilter:
    """The filter that is told of the world's bounds; ValueError where its parts do not fit."""
    return SafetyFilter(config.inspection, config.rta, known=config.uncertainty)


def described(config: Config, safety_filter: SafetyFilter) -> dict[str, Any]:
    """What the page is told of it: starts that the filter accepts, and plants by the seed of `simulate`.

    Raises:
        InputError: the filter accepts none of the test cases.
    """
    begun = starts(config, [safety_filter])
    x = torch.tensor([each["state"] for each in begun], dtype=torch.float64).T
    accepted = safety_filter.is_safe(x)
    if not accepted[:CASES].any():
        raise InputError(
            f"[uncertainty]: the filter that is told of it accepts none of the first {CASES} test cases as a start"
        )
    return {
        "period": safety_filter.period,
        "starts": [each for each, is_safe in zip(begun, accepted.tolist(), strict=True) if is_safe],
        "plants": plants(config.plant, config.inspection, SEEDS),
    }


def plants(parameters: PlantParameters, c: InspectionParameters, seeds: Iterable[int]) -> list[list[float]]:
    """By seed of `simulate` what its plant is: body [7], thrust [9] and torque [3] as of `Drawn`, latency in calls."""
    every = (draw(parameters, c, key_of(plant_numbers(1, seed))) for seed in seeds)
    return [
        torch.cat([part.flatten() for part in (each.body, each.thrust, each.torque, each.latency)]).tolist()
        for each in every
    ]


def texts(safety_filter: SafetyFilter, parameters: PlantParameters) -> dict[str, str]:
    """The C source of the world by its file.

    Args:
        safety_filter: that is told of its bounds; parameters: of its plant, whose errors are worst.
    """
    c = safety_filter.c
    at_once = Plant(replace(parameters, latency=0), c, 1, "cpu")  # what is old by then, the driver keeps
    drawn, (x, u) = at_once.drawn, safety_filter.probe("cpu")
    errors, gains = (x.new_ones(part.stop - part.start, 1) for part in (ERRORS, GAINS))
    wanted = ("x", "error", "u", "along_error", "along_control"), ("margin", "slope")
    duration = min(c.substep, min(PERIODS))
    parts = [
        printed(
            partial(outlook, Greedy(safety_filter)), x, errors, u, errors, u, name="outlook", names=wanted
        ),
        printed(partial(sensed, at_once), x, errors, name="sensed", names=(("x", "errors"), ("seen",))),
        printed(
            partial(actuated, at_once),
            *(drawn.thrust, drawn.torque, gains, u),
            name="actuated",
            names=(("thrust", "torque", "gains", "u"), ("acting",)),
        ),
        printed(
            partial(moved, at_once, duration),
            *(x, u, drawn.body),
            name="moved",
            names=(("x", "acting", "body"), ("y",)),
        ),
    ]
    source = [
        "#include <math.h>",
        define("PAST", int(bounds(parameters.latency)[1])),
        define("MISSED_MOST", parameters.missed_in_a_row if bounds(parameters.missed_calls)[1] else 0),
        define("NEXT_TO_NOTHING", NEXT_TO_NOTHING),
        for_one(parts),
        driver("worst.c"),
    ]
    return {"worst.c": "\n".join(source)}


# what is printed; the component axis comes first, one column after it


def outlook(
    greedy: Greedy, x: Tensor, error: Tensor, u: Tensor, along_error: Tensor, along_control: Tensor
) -> Sequence[Tensor]:
    """J of `Greedy`, and how it changes along a direction of errors and controls."""
    directions = along_error, along_control
    found: tuple[Any, ...] = torch.func.jvp(lambda e, v: greedy.ahead(x, e, v), (error, u), directions)
    return [each.nan_to_num()[None] for each in found]


def sensed(plant: Plant, x: Tensor, errors: Tensor) -> Sequence[Tensor]:
    """What a state is taken for where errors (12,) above 0 are at their upper ends, the others at their lower."""
    here, corner = copy(plant), torch.cat((errors, errors.new_zeros(CORNER - ERRORS.stop, 1)))
    here.adversary = Recorded(corner[None] > 0.0, here.every)
    return [here.sense(torch.zeros(1), x)]


def actuated(plant: Plant, thrust: Tensor, torque: Tensor, gains: Tensor, u: Tensor) -> Sequence[Tensor]:
    """What acts where u is held: of a `Drawn` and gains (6,), above 0 where they are at their upper ends."""
    here, zero = copy(plant), gains.new_zeros(CORNER, 1)
    here.drawn = plant.drawn._replace(thrust=thrust, torque=torque)
    here.corner = torch.cat((zero[ERRORS], gains, zero[GAINS.stop :])) > 0.0
    return [here.actuate(torch.zeros(1), u)]


def moved(plant: Plant, duration: float, x: Tensor, acting: Tensor, body: Tensor) -> Sequence[Tensor]:
    """The state `duration` s later."""
    return [plant.integrate(x, acting, body, duration)]
