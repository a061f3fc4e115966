"""The flight of a page as WebAssembly: Python functions printed as C, which hand-written C calls, built by ziglang."""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from columns import if_long
from inspection.chief.points import fibonacci_sphere, in_view, point_weights
from inspection.guidance import limited, natural_motion, pointing_frequency, pointing_torque
from inspection.model.attitude import unit
from inspection.model.dynamics import step, sun_direction
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, TORQUE, P
from inspection.orbits import GUIDANCE
from inspection.termination import failures
from inspection.world.corners import CORNER, ERRORS, GAINS, Recorded
from inspection.world.parameters import PlantParameters, bounds
from inspection.world.plant import Plant
from kernels.printer import Printed, printed
from rta.check.attitude_law import slew
from rta.check.flight import path
from rta.check.motion_law import brake
from rta.check.nominal import ENDS, NominalCheck
from rta.fast.files import sources as sources_of_filter
from rta.fast.source import define, for_one
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from settings import InputError
from study.verification.adversaries import NEXT_TO_NOTHING, Greedy, adversarial

PILOT = "even"  # the guidance that can fly on the page
PLACES = 250  # largest number of points on a predicted path
BY_HAND = {path.stem: path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("*.c")}
# without fused products, as in `kernels.build`, so that each operation rounds as in Python
FLAGS = "-target wasm32-wasi -mexec-model=reactor -std=gnu11 -O2 -ffp-contract=off -fno-math-errno "
FLAGS += "-fno-tree-slp-vectorize -fvisibility=default -rdynamic -w -s"


def arrays(c: InspectionParameters) -> dict[str, int]:
    """Returns the lengths of the double-precision arrays that page and module share, by name."""
    sizes = (
        (16, "state seen"),  # the true state, and the measured one
        (6, "desired control acting"),  # controls: desired, commanded, and acting
        (len(CONSTRAINTS), "values active"),  # h, and whether a row changes the control
        (3, "answer failed"),  # status, verified, backup; crash, out of bounds, out of power
        (3, "priority"),
        (1, "score"),
        (c.num_points, "weights lit inspected"),
        (3 * PLACES, "ahead way"),  # points of free flight, and of the backup trajectory
        (20, "plant"),  # the numbers of a plant with errors, and
        (19, "corner"),  # its errors now, see worst.c
    )
    return {name: size for size, names in sizes for name in names.split()}


def compiled(
    filters: Sequence[SafetyFilter], plant: PlantParameters | None, agent: Mapping[str, str]
) -> bytes:
    """Returns the module, which imports nothing.

    Args:
        filters: by their numbers; the last one has the error bounds, if there are any.
        plant: has the errors, if any; agent: C sources by file, see `study.export.policy`, may be empty.

    Raises:
        InputError: the compiler fails.
    """
    c = filters[0].c
    shared = [f"double {name}[{size}];" for name, size in arrays(c).items()]
    latency = int(bounds(plant.latency)[1]) if plant else 0
    shared += [f"double sent[{6 * (latency + 1)}];", "int sent_count;"]  # controls since `seen` was measured
    head = [
        *("#pragma once", "#include <math.h>", "#include <string.h>"),
        *(define(name, n) for name, n in (("POINTS", c.num_points), ("PLACES", PLACES), ("PAST", latency))),
        *(f"extern {each}" for each in shared),
    ]
    texts = {
        "play.h": head,
        "play.c": ['#include "play.h"', *shared, for_one(of_flight(filters[0])), BY_HAND["play"]],
        **{f"filter{i}.c": of_filter(each, i) for i, each in enumerate(filters)},
    }
    if plant:
        most = plant.missed_in_a_row if bounds(plant.missed_calls)[1] else 0
        own = define("MISSED_MOST", most), define("NEXT_TO_NOTHING", NEXT_TO_NOTHING)
        world = for_one(of_world(filters[-1], plant))
        texts["worst.c"] = ['#include "play.h"', *own, world, BY_HAND["worst"]]
    if agent:
        texts |= {name: [text] for name, text in agent.items()}
        texts["agent.c"] = ['#include "play.h"', BY_HAND["agent"]]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work:
        folder = Path(work)
        for name, parts in texts.items():
            (folder / name).write_text("\n".join(parts), encoding="utf-8")
        units = [name for name in texts if name.endswith(".c")]
        command = [sys.executable, "-m", "ziglang", "cc", *FLAGS.split(), *units, "-o", "play.wasm", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
        if done.returncode:
            said = [line.strip() for line in done.stderr.splitlines() if "error" in line]
            raise InputError(f"the compiler of ziglang failed ({done.returncode}): {''.join(said[:1])}")
        return (folder / "play.wasm").read_bytes()


def named(
    name: str, results: str, run: Callable[..., Sequence[Tensor]], long: int = 0, **given: Tensor
) -> Printed:
    """Prints a function of the given tensors, with one column each, whose results have these names."""
    names = list(given), results.split()
    return printed(run, *given.values(), name=name, names=names, long=long, single=True)


def of_flight(safety_filter: SafetyFilter) -> list[Printed]:
    """Prints the model, and the other functions that `play.c` calls."""
    c, (x, u) = safety_filter.c, safety_filter.probe()[:2]
    normals = fibonacci_sphere(c.num_points)
    n = c.num_points
    return [
        named("model_step", "y", lambda x, u: [step(x, u, c.substep, c)], x=x, u=u),
        named("constraint_values", "h", lambda x: [safety_filter.values(x)], x=x),
        named("failures", "f", lambda x: [torch.stack([f.double() for f in failures(x, c).values()])], x=x),
        named("in_view", "lit seen", lambda x: [*in_view(normals, x, c).double()], n, x=x),
        named("point_weights", "w", lambda p: [point_weights(normals, p)], n, p=x[:3]),
        named("adversary", "u", lambda x: [adversarial(safety_filter)(0.0, x)], x=x),
    ]


def to_rest(backup: NominalCheck, x: Tensor, u: Tensor) -> list[Tensor]:
    """Returns the states after a hold of controls (6, B), the laws' controls there, and whether motion has ended."""
    end = path(x, u, backup.flight)[-1]
    torque = slew(end, backup.pointing)
    arrived = (backup.terminal.room(end) >= 0.0)[list(ENDS[0])].all(0)
    return [end, torch.cat((brake(end, torque, backup.braking), torque)), arrived]


def of_filter(safety_filter: SafetyFilter, number: int) -> list[str]:
    """Returns the C source of a filter, and of controllers with its period."""
    c, every, (x, u) = safety_filter.c, safety_filter.period, safety_filter.probe()[:2]

    def assistant(x: Tensor) -> list[Tensor]:
        torque = pointing_torque(x, -unit(x[P]), sun_direction(x[THETA_S]), c, pointing_frequency(every))
        return [limited(torch.zeros_like(torque), torque, x, c)[TORQUE]]

    def guidance(x: Tensor, score: Tensor) -> list[Tensor]:
        return [natural_motion(c, every, GUIDANCE[PILOT], lambda: score)(0.0, x)]

    parts = [named("assistant", "t", assistant, x=x), named("guidance", "u", guidance, x=x, score=u[0])]
    backup = safety_filter.check
    if isinstance(backup, NominalCheck):
        long = if_long(len(c.planes))
        parts.append(named("turn_to_rest", "after law arrived", partial(to_rest, backup), long, x=x, u=u))
    given = sources_of_filter(safety_filter, only=("safety_filter.h", "safety_filter.c"))
    return [
        *(f"#define {name} {name}_{number}" for name in ("safety_filter", "safety_filter_names")),
        f"#define NAME(name) name##_{number}",
        given["safety_filter.c"].replace('#include "safety_filter.h"\n', given["safety_filter.h"]),
        for_one(parts),
        define("FLIES", int(isinstance(backup, NominalCheck))),
        '#include "play.h"',
        BY_HAND["filter"],
    ]


def of_world(safety_filter: SafetyFilter, parameters: PlantParameters) -> list[Printed]:
    """Prints a plant whose errors are worst, and the choice of its corners; `safety_filter` has its bounds."""
    c, (x, u) = safety_filter.c, safety_filter.probe()[:2]
    plant = Plant(replace(parameters, latency=0), c, 1, "cpu")  # worst.c keeps the old measurements
    greedy, now = Greedy(safety_filter), torch.zeros(1)
    ends, gains = (x.new_ones(part.stop - part.start, 1) for part in (ERRORS, GAINS))

    def outlook(x: Tensor, error: Tensor, u: Tensor, *along: Tensor) -> list[Tensor]:
        found: Any = torch.func.jvp(lambda e, v: greedy.ahead(x, e, v), (error, u), along)
        return [each.nan_to_num()[None] for each in found]

    def sensed(x: Tensor, ends: Tensor) -> list[Tensor]:
        here, corner = copy(plant), torch.cat((ends, ends.new_zeros(CORNER - ERRORS.stop, 1)))
        here.adversary = Recorded(corner[None] > 0.0, here.every)
        return [here.sense(now, x)]

    def actuated(thrust: Tensor, torque: Tensor, gains: Tensor, u: Tensor) -> list[Tensor]:
        here, nothing = copy(plant), gains.new_zeros(CORNER, 1)
        here.drawn = plant.drawn._replace(thrust=thrust, torque=torque)
        here.corner = torch.cat((nothing[ERRORS], gains, nothing[GAINS.stop :])) > 0.0
        return [here.actuate(now, u)]

    def moved(x: Tensor, acting: Tensor, body: Tensor) -> list[Tensor]:
        return [plant.integrate(x, acting, body, c.substep)]

    drawn = plant.drawn
    return [
        named("outlook", "margin slope", outlook, x=x, error=ends, u=u, along_error=ends, along_control=u),
        named("sensed", "seen", sensed, x=x, ends=ends),
        named("actuated", "acting", actuated, thrust=drawn.thrust, torque=drawn.torque, gains=gains, u=u),
        named("moved", "y", moved, x=x, acting=u, body=drawn.body),
    ]
