"""Simulating one spacecraft under any controller, with everything over time."""

from dataclasses import fields

import numpy as np
import tomli_w
import torch
from torch import Tensor

from inspection.chief.hull import clearance
from inspection.chief.tumbling import ATTITUDE
from inspection.closed_loop import Controller, Hold, is_multiple
from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, THRUST, TORQUE, P
from ppo.network import Policy
from settings import InputError
from study.config import Config
from study.experiment import (
    Experiment,
    check_clocks,
    test_cases,
)
from study.flight.answers import in_full
from study.flight.controllers import agent, classical, recorded, untrained
from study.flight.state_files import STATE_FIELDS, read_state
from study.machine.progress import bar

MAX_ROWS = 10**7
SCALARS = ("time", "inspected_score", "temperature", "energy", "sun_angle")


def check_rows(step: float, duration: float, config: Config, controller: str) -> None:
    """Refuses rows every `step` s without end, or that do not fit the other clocks."""
    if step < 1e-3 or duration / min(step, config.inspection.substep) > MAX_ROWS:
        raise InputError(
            f"--duration {duration:g} at --step {step:g}: at most {MAX_ROWS:,} steps of at least 1 ms"
        )
    decide_every = decides_every(config, controller, step)
    check_clocks(config, decide_every, step, duration, f"--step {step:g}, --duration {duration:g}")


def starting_point(path: str | None, experiment: Experiment, seed: int) -> tuple[Tensor, Tensor]:
    """State (16, 1) and priority vector (3, 1) on the device; what no state file gives is drawn from the seed."""
    x, priority = test_cases(experiment.config, 1, seed)
    if path is not None:
        x, given = read_state(path, experiment.config.inspection)
        priority = priority if given is None else given
    return x.to(experiment.device), priority.to(experiment.device)


class Recording:
    """The first spacecraft of an environment over time, a row at every report of its clocks.

    Attributes:
        ended: the last row is there, and nothing more may be recorded.
    """

    def __init__(self, env: InspectionEnv) -> None:
        self.env, self.ended, self.tumbling = env, False, env.sight.tumbling
        self.rows: list[dict[str, Tensor]] = []

    def note(self, hold: Hold) -> None:
        """Adds what is new in a hold."""
        self.hold, self.begun = hold, float(self.env.time[0])
        if self.tumbling:  # of now: where the hold ends, the next episode may have begun
            self.motion = self.tumbling.motion[:, :1]
        if hold.decided:
            self.decision = hold.desired[:, 0].clone()
        if hold.time == 0.0 or is_multiple(hold.time, self.env.clocks.report):
            self.add(hold.time, hold.state)
        if hold.correction is not None:
            changed = (in_full(hold.correction).control != hold.desired)[:, 0]
            self.rows[-1]["intervened"] |= torch.stack([changed[part].any() for part in (THRUST, TORQUE)])

    def end(self, **seen: Tensor) -> None:
        """Adds the last row, at the end of the hold; `seen` is what of it the environment no longer knows."""
        self.ended = True
        self.add(self.hold.end, self.hold.after)
        self.rows[-1] |= seen

    def add(self, time: float, x: Tensor) -> None:
        """Adds a row; the filter's calls before the next one write into its `intervened`."""
        env = self.env
        self.rows.append(
            {
                "time": x.new_tensor([self.begun + time]),
                "x": x[:, 0].clone(),  # a view would keep the whole batch
                "control_desired": self.decision,
                "control_applied": self.hold.applied[:, 0].clone(),
                "inspected_score": env.sight.score()[:1].clone(),
                "inspected": env.sight.inspected[:, 0].clone(),  # which the next look writes into
                "intervened": x.new_zeros(2, dtype=torch.bool),
            }
        )
        if self.tumbling:
            motion = self.tumbling.moved(self.motion, self.rows[-1]["time"], x[THETA_S, :1])
            self.rows[-1]["chief_attitude"] = motion[ATTITUDE, 0]

    def arrays(self) -> dict[str, np.ndarray]:
        """What `simulate` returns."""
        env = self.env
        columns = {name: torch.stack([row[name] for row in self.rows]) for name in self.rows[0]}
        x = columns.pop("x").T
        h = env.constraint_values(x)
        columns |= {
            name: x[component].reshape(-1, x.shape[1]).T for name, (component, _) in STATE_FIELDS.items()
        }
        columns |= {f"h_{name}": h[i] for i, name in enumerate(env.safety.names)}
        if env.c.planes:
            columns["clearance"] = clearance(x[P], env.c)
        arrays = {name: column.cpu().numpy() for name, column in columns.items()}
        arrays = {name: array[:, 0] if name in SCALARS else array for name, array in arrays.items()}
        if self.tumbling:
            points, normals, _, triangles, _ = env.sight.surface
            of_chief = {"points": points.T, "normals": normals.T, "triangles": triangles}
            arrays |= {f"chief_{name}": each.cpu().numpy() for name, each in of_chief.items()}
        task = {field.name: getattr(env.c, field.name) for field in fields(InspectionParameters)}
        return arrays | {"parameters": np.array(tomli_w.dumps({"inspection": task}))}


@torch.no_grad()
def simulate(
    env: InspectionEnv,
    controller: Controller,
    x: Tensor,
    priority: Tensor,
    duration: float,
    number: Tensor | None = None,
) -> dict[str, np.ndarray]:
    """Simulates one spacecraft, with a row at every report of the environment's clocks.

    Args:
        env: of one episode; its safety holds the filter, if any. Points are inspected every action period.
        x, priority: initial state (16, 1) and priority vector (3, 1).
        duration: s.
        number: (1,) as of `InspectionEnv.start`.

    Returns:
        Arrays by name over time, the initial state first; `control_applied` is the control from the row's
        time on, and the last row repeats the one before it. `inspected` is (rows, points) bool. `intervened`
        is (rows, 2) bool, whether a call of the filter from the row up to the next corrected thrust, torque.
        `chief_attitude` (rows, 4) is there where the chief is not the paper's, and `clearance` (rows,) in m where its
        hull is what to stay clear of.
        Not over time are `parameters`, the task's table of a configuration file, and such a chief's `chief_points`,
        `chief_normals` (N, 3) and `chief_triangles` (F, 3, 3) in its own frame.
    """
    env.start(x, priority, number)
    recording = Recording(env)
    holds = env.inspect(controller, duration)
    count = env.clocks.count(duration)
    for hold in bar(count, "steps", iterable=holds, desc=f"flying {duration:g} s", leave=False):
        recording.note(hold)
    recording.end()
    return recording.arrays()


def run(
    experiment: Experiment,
    controller: str,
    duration: float,
    step: float,
    seed: int,
    policy: Policy | None = None,
    actions: str | None = None,
    initial_state: str | None = None,
) -> dict[str, np.ndarray]:
    """What `simulate` of the command line flies, by the names of its flags.

    Args:
        policy: of one seed, for the controller "policy".

    Raises:
        InputError: a file is missing or damaged.
    """
    start = starting_point(initial_state, experiment, seed)
    # the plant is that of the first test case of `evaluate` with this seed
    decide_every = decides_every(experiment.config, controller, step)
    env = experiment.env(1, experiment.generators([seed + 1]), decide_every, step, experiment.compiled)
    if controller == "untrained":
        policy = untrained(experiment, seed)
    if policy:
        commander = agent(policy.to(experiment.device), env)
    elif actions:
        commander = recorded(actions, env, step, duration)
    else:
        commander = classical(controller, env, seed, step)
    return simulate(env, commander, *start, duration)


def decides_every(config: Config, controller: str, step: float) -> float:
    """s between two decisions: of an agent, trained or not, its own; of the others a row of the output."""
    return config.inspection.action_period if controller in ("policy", "untrained") else step


def described(episode: dict[str, np.ndarray]) -> str:
    """A simulation in half a line."""
    violated = [name[2:] for name in episode if name.startswith("h_") and not (episode[name] >= 0).all()]
    return (
        f"{len(episode['time'])} rows over {episode['time'][-1]:g} s, inspected "
        f"{episode['inspected_score'][-1]:.3f}, violated constraints: {', '.join(violated) or 'none'}"
    )
