"""Simulation of one spacecraft under any controller, with all quantities over time."""

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
from inspection.model.state import THRUST, TORQUE, P
from inspection.termination import failures
from inspection.transition import METRICS, Transition
from ppo.network import Policy
from settings import InputError
from study.config import Config
from study.experiment import Experiment, check_clocks, test_cases
from study.flight.controllers import agent, classical, recorded
from study.flight.fly import Limits, Observer, Progress, Starts, fly
from study.flight.state_files import STATE_FIELDS, read_state
from study.machine import bar

MAX_ROWS = 10**7
BAR = "{desc}: {percentage:.0f} %|{bar}| [{elapsed}<{remaining}{postfix}]"


def check_rows(step: float, duration: float, config: Config, controller: str) -> None:
    """Raises InputError if rows every `step` s are too many, or do not fit the other clocks."""
    if step < 1e-3 or duration / min(step, config.inspection.substep) > MAX_ROWS:
        raise InputError(
            f"--duration {duration:g} at --step {step:g}: at most {MAX_ROWS:,} steps of at least 1 ms"
        )
    decide_every = decides_every(config, controller, step)
    check_clocks(config, decide_every, step, duration, f"--step {step:g}, --duration {duration:g}")


def starting_point(path: str | None, experiment: Experiment, seed: int) -> Starts:
    """Returns the first test case of a seed, in which a state file, if any, replaces the state and priority vector."""
    start = test_cases(experiment.config, 1, seed)
    if path is None:
        return start
    x, given = read_state(path, experiment.config.inspection)
    return Starts(x, start.priority if given is None else given, start.number)


class Recording(Observer):
    """Records the first spacecraft of an environment over time, a row at every report of its clocks.

    Args:
        fails: the recording ends when the episode fails, even in the middle of an action.

    Attributes:
        ended: the last row has been added, and nothing more is recorded.
    """

    def __init__(self, fails: bool = True) -> None:
        self.fails = fails

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.env, self.ended, self.tumbling = env, False, env.sight.tumbling
        self.rows: list[dict[str, Tensor]] = []

    def hold(self, hold: Hold, running: Tensor) -> None:
        if self.ended:
            return
        self.last, self.begun = hold, float(self.env.time[0])
        if self.tumbling:  # kept now: at the end of the hold the next episode may have begun
            self.motion = self.tumbling.motion[:, :1]
        if hold.decided:
            self.decision = hold.desired[:, 0].clone()
        if hold.time == 0.0 or is_multiple(hold.time, self.env.clocks.report):
            self.add(hold.time, hold.state)
        if hold.correction is not None:
            changed = (hold.correction.control != hold.desired)[:, 0]
            self.rows[-1]["intervened"] |= torch.stack([changed[part].any() for part in (THRUST, TORQUE)])
        failed = any(bool(each[0]) for each in failures(hold.after, self.env.c).values())
        # at the end of an action `step` adds the last row, after the chief's points are inspected
        if self.fails and failed and hold.end < self.env.c.action_period:
            self.end()

    def step(self, transition: Transition, running: Tensor) -> None:
        if not self.ended and transition.done[0]:
            score = transition.metrics[METRICS.index("inspected_score"), 0]
            self.end(inspected_score=score, inspected=transition.inspected[:, 0])

    def end(self, **seen: Tensor) -> None:
        """Adds the last row, at the end of the hold; `seen` holds the quantities that the environment no longer has."""
        self.ended = True
        self.add(self.last.end, self.last.after)
        self.rows[-1] |= seen

    def add(self, time: float, x: Tensor) -> None:
        """Adds a row; the filter's calls before the next row write into this row's `intervened`."""
        env = self.env
        self.rows.append(
            {
                "time": x.new_tensor(self.begun + time),
                "x": x[:, 0].clone(),  # a view would keep the whole batch
                "control_desired": self.decision,
                "control_applied": self.last.applied[:, 0].clone(),
                "inspected_score": env.sight.score()[0].clone(),
                "inspected": env.sight.inspected[:, 0].clone(),  # the next inspection changes it
                "intervened": x.new_zeros(2, dtype=torch.bool),
            }
        )
        if self.tumbling:
            motion = self.tumbling.moved(self.motion, self.rows[-1]["time"][None])
            self.rows[-1]["chief_attitude"] = motion[ATTITUDE, 0]

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays of `simulate`."""
        env = self.env
        columns = {name: torch.stack([row[name] for row in self.rows]) for name in self.rows[0]}
        x = columns.pop("x").T
        h = env.constraint_values(x)
        columns |= {name: x[component].movedim(-1, 0) for name, (component, _) in STATE_FIELDS.items()}
        columns |= {f"h_{name}": h[i] for i, name in enumerate(env.safety.names)}
        if env.c.planes:
            columns["clearance"] = clearance(x[P], env.c)
        arrays = {name: column.cpu().numpy() for name, column in columns.items()}
        if self.tumbling:
            points, normals, _, triangles, _ = env.sight.surface
            of_chief = {"points": points.T, "normals": normals.T, "triangles": triangles}
            arrays |= {f"chief_{name}": each.cpu().numpy() for name, each in of_chief.items()}
        task = {field.name: getattr(env.c, field.name) for field in fields(InspectionParameters)}
        return arrays | {"parameters": np.array(tomli_w.dumps({"inspection": task}))}


def simulate(
    env: InspectionEnv, controller: Controller, start: Starts, duration: float
) -> dict[str, np.ndarray]:
    """Simulates one spacecraft for a duration in s, with a row at every report of the environment's clocks.

    Args:
        env: with one episode; its safety holds the filter, if any. Points are inspected every action period.

    Returns:
        Arrays by name over time, the initial state first. `control_applied` is the control from the row's time on, in
        the last row the control until then. `inspected` is (rows, points) bool. `intervened` is (rows, 2) bool: a call
        of the filter between this row and the next changed thrust, torque. `chief_attitude` (rows, 4) is included if
        the chief is not the paper's, and `clearance` (rows,) in m if its hull is the keep-out zone.
        Not over time are `parameters`, the task's table of a configuration file, and for a chief that is not the
        paper's `chief_points`, `chief_normals` (N, 3) and `chief_triangles` (F, 3, 3) in its own frame.
    """
    recording = Recording(fails=False)
    with bar(1, "flights", desc=f"flying {duration:g} s", leave=False, bar_format=BAR) as shown:
        fly(env, controller, start, duration, [recording, Progress(shown, duration)])
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
    """Flies what `simulate` of the command line flies; the arguments are named as its flags.

    Args:
        policy: with one seed, for the controller "policy".

    Raises:
        InputError: a file is missing or damaged.
    """
    start = starting_point(initial_state, experiment, seed)
    decide_every = decides_every(experiment.config, controller, step)
    env = experiment.env(1, None, decide_every, step, experiment.compiled)
    if controller == "untrained":
        policy = experiment.policy(experiment.generators([seed]))
    if policy:
        commander = agent(policy.to(experiment.device), env)
    elif actions:
        commander = recorded(actions, env, step, duration)
    else:
        commander = classical(controller, env, seed, decide_every)
    return simulate(env, commander, start, duration)


def decides_every(config: Config, controller: str, step: float) -> float:
    """Returns s between two decisions: the action period for an agent, trained or not, `step` for recorded controls.

    A classical controller decides at every row of the output, but not more often than the filter's calls or, without
    filter, the plant's steps. So rows that are closer in time do not change the flight.
    """
    if controller in ("policy", "untrained"):
        return config.inspection.action_period
    if controller == "recorded":
        return step
    return max(step, config.rta.period if config.train.rta else config.inspection.substep)


def described(episode: dict[str, np.ndarray]) -> str:
    """Describes a simulation in half a line."""
    violated = [name[2:] for name in episode if name.startswith("h_") and not (episode[name] >= 0).all()]
    return (
        f"{len(episode['time'])} rows over {episode['time'][-1]:g} s, inspected "
        f"{episode['inspected_score'][-1]:.3f}, violated constraints: {', '.join(violated) or 'none'}"
    )
