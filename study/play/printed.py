"""The flight of a page as C: the filters of a configuration and what surrounds them, printed from Python.

By hand is only what stands in `driver`: it calls them in their order.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from inspection.chief.points import fibonacci_sphere, in_view, point_weights
from inspection.guidance import limited, look, natural_motion, pointing_frequency
from inspection.model.attitude import unit
from inspection.model.dynamics import step, sun_direction
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, TORQUE, P
from inspection.orbits import GUIDANCE
from inspection.termination import failures
from kernels.printer import printed
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from rta.printed.files import sources
from rta.printed.source import define, for_one
from study.config import Config
from study.verification.adversaries import adversarial

PILOT = "even"  # the guidance that flies the page by itself
AHEAD = 250  # places of a line ahead, at most
WORST = (  # the functions of `study.play.worst`
    "void worst_begin(void);",
    "void worst_sense(const double *, const double *, double *, double *);",
    "const double *worst_sent(const double *, int *);",
    "void worst_hold(const double *, const double *, double *, double *, double *);",
    "void worst_move(const double *, double *, const double *);",
)
DRIVER = Path(__file__).parent / "driver"


def filters(config: Config) -> list[SafetyFilter]:
    """The filter for each period that is told of no errors; ValueError where one of its parts does not fit."""
    return [SafetyFilter(config.inspection, replace(config.rta, period=period)) for period in PERIODS]


def texts(
    nominal: Sequence[SafetyFilter], told: SafetyFilter | None = None, has_agent: bool = False
) -> dict[str, str]:
    """The C sources by file: one per filter and `play.c`.

    Args:
        told: the last filter, of a world whose errors are worst, of which `study.play.worst` has the other sources.
        has_agent: there is an agent, of which `study.export.policy` has them.
    """
    found = [*nominal, told] if told else nominal
    return {f"filter{i}.c": of_filter(each, i) for i, each in enumerate(found)} | {
        "play.c": of_flight(found, has_agent, told is not None)
    }


def of_filter(safety_filter: SafetyFilter, index: int) -> str:
    """A filter, and who commands in its rhythm, in one source."""
    c, every = safety_filter.c, safety_filter.period
    x, u = safety_filter.probe("cpu")
    parts = [
        printed(partial(assistant, c, every), x, name="assistant", names=(("x",), ("torque",))),
        printed(partial(guidance, c, every), x, u[0], name="guidance", names=(("x", "score"), ("u",))),
    ]
    given = sources(safety_filter, only=("safety_filter.h", "safety_filter.c"))
    filtering = given["safety_filter.c"].replace('#include "safety_filter.h"\n', given["safety_filter.h"])
    return "\n".join(
        [
            f"#define safety_filter safety_filter_{index}",
            f"#define safety_filter_names safety_filter_names_{index}",
            f"#define PLAY(name) name##_{index}",
            filtering,
            for_one(parts),
            driver("period.c"),
        ]
    )


def of_flight(found: Sequence[SafetyFilter], has_agent: bool, has_worst: bool) -> str:
    """The model and what it comes to, with the page's functions around them, in one source."""
    safety_filter = found[0]
    c = safety_filter.c
    x, u = safety_filter.probe("cpu")
    normals = fibonacci_sphere(c.num_points)
    duration = min(c.substep, min(PERIODS))
    points = {"long": c.num_points}
    parts = [
        printed(partial(model_step, c, duration), x, u, name="model_step", names=(("x", "u"), ("y",))),
        printed(partial(values, safety_filter), x, name="constraint_values", names=(("x",), ("h",))),
        printed(partial(ended, c), x, name="failures", names=(("x",), ("failed",))),
        printed(partial(seen, normals, c), x, name="in_view", names=(("x",), ("lit", "seen")), **points),
        printed(partial(weights, normals), x[:3], name="point_weights", names=(("p",), ("w",)), **points),
        printed(partial(adversary, safety_filter), x, name="adversary", names=(("x",), ("u",))),
    ]
    return "\n".join(
        [
            "#include <math.h>",
            define("POINTS", c.num_points),
            define("AHEAD_MOST", AHEAD),
            define("LIMITS", len(safety_filter.names)),
            define("AGENT", int(has_agent)),
            *(['#include "policy.h"'] if has_agent else []),
            define("WORST", int(has_worst)),
            *(WORST if has_worst else ()),
            *declarations(len(found)),
            for_one(parts),
            driver("play.c"),
        ]
    )


def declarations(count: int) -> list[str]:
    """The functions of the filters' sources, and tables of them by index."""
    kinds = {
        "correct": (
            "void",
            "const double *, const double *, const double *, int, double *, double *, double *",
        ),
        "assist": ("void", "const double *, double *"),
        "guide": ("void", "const double *, const double *, double *"),
        "way": ("int", "const double *, const double *, double *, int"),
    }
    lines = []
    for name, (result, given) in kinds.items():
        own = [f"{name}_{i}" for i in range(count)]
        lines += [f"{result} {each}({given});" for each in own]
        lines.append(f"static {result} (*const {name}s[{count}])({given}) = {{{', '.join(own)}}};")
    return lines


def driver(name: str) -> str:
    """A file that is written by hand."""
    return (DRIVER / name).read_text(encoding="utf-8")


# what is printed; the component axis comes first, one column after it


def model_step(c: InspectionParameters, duration: float, x: Tensor, u: Tensor) -> list[Tensor]:
    """The state `duration` s later."""
    return [step(x, u, duration, c)]


def values(safety_filter: SafetyFilter, x: Tensor) -> list[Tensor]:
    """Every constraint's h."""
    return [safety_filter.values(x)]


def ended(c: InspectionParameters, x: Tensor) -> list[Tensor]:
    """1 for each failure of `inspection.termination` that holds, in its order."""
    return [torch.stack([each.to(x.dtype) for each in failures(x, c).values()])]


def seen(normals: Tensor, c: InspectionParameters, x: Tensor) -> list[Tensor]:
    """1 for each point that is lit, and for each that is in view, too."""
    lit, both = in_view(normals, x, c).to(x.dtype)
    return [lit, both]


def weights(normals: Tensor, priority: Tensor) -> list[Tensor]:
    """The points' weights."""
    return [point_weights(normals, priority)]


def assistant(c: InspectionParameters, every: float, x: Tensor) -> list[Tensor]:
    """Torque that points the camera at the chief, held for `every` s, and the cold side away from the Sun."""
    sun = sun_direction(x[THETA_S])
    torque = look(x, -unit(x[P]), sun, c, pointing_frequency(every))
    return [limited(torch.zeros_like(torque), torque, x, c)[TORQUE]]


def guidance(c: InspectionParameters, every: float, x: Tensor, score: Tensor) -> list[Tensor]:
    """The control of PILOT, held for `every` s, once a weight (1,) has been inspected."""
    return [natural_motion(c, every, GUIDANCE[PILOT], lambda: score)(0.0, x)]


def adversary(safety_filter: SafetyFilter, x: Tensor) -> list[Tensor]:
    """The control of the campaigns' adversary."""
    return [adversarial(safety_filter)(0.0, x)]
