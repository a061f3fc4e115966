"""Simulating one spacecraft under any controller, and the files that go in and out."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
from torch import Tensor

from inspection import guidance
from inspection.attitude import unit
from inspection.dynamics import step as integrate
from inspection.environment import InspectionEnv, Safety
from inspection.guidance import Controller
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from inspection.termination import terminal_conditions
from ppo.network import Policy
from rta.qp import Status
from study import experiment as build
from study.config import Config
from study.errors import InputError
from study.flight.evaluation import test_cases

LARGEST = 1e6  # of any number in a state file
MAX_ROWS = 10**7

STATE_FIELDS: dict[str, tuple[Any, int]] = {
    "position": (P, 3),
    "velocity": (V, 3),
    "quaternion": (Q, 4),
    "angular_velocity": (OMEGA, 3),
    "temperature": (T, 1),
    "energy": (E, 1),
    "sun_angle": (THETA_S, 1),
}


def read_state(path: str) -> tuple[Tensor, Tensor | None]:
    """Reads a state file: state (16, 1) and priority unit vector (3, 1), None where the file has none.

    Raises:
        InputError: unreadable, not JSON, unknown or missing keys, wrong shapes, not finite, not a unit quaternion.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot read the state file: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file: {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: must hold one JSON object with {', '.join(STATE_FIELDS)}")
    for key in content:
        if key not in STATE_FIELDS and key != "priority_vector":
            raise InputError(
                f"{path}: unknown key {key!r}; allowed are {', '.join(STATE_FIELDS)}, priority_vector"
            )
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    for key, (component, length) in STATE_FIELDS.items():
        if key not in content:
            raise InputError(f"{path}: {key} is missing")
        x[component, 0] = numbers(content[key], length, f"{path}: {key}").reshape(x[component, 0].shape)
    deviation = abs(x[Q].norm().item() - 1.0)
    if deviation > 1e-6:
        raise InputError(
            f"{path}: quaternion = {content['quaternion']}: must have length 1 (scalar last), has {x[Q].norm():.6g}"
        )
    if x[T].item() <= -273.15:
        raise InputError(f"{path}: temperature = {content['temperature']}: must be above -273.15 deg C")
    if x[E].item() < 0.0:
        raise InputError(f"{path}: energy = {content['energy']}: must not be negative")
    if x[P].norm() == 0.0:
        raise InputError(f"{path}: position = {content['position']}: must not be the chief's centre")
    x[Q] = unit(x[Q])
    if "priority_vector" not in content:
        return x, None
    priority = numbers(content["priority_vector"], 3, f"{path}: priority_vector")[:, None]
    if priority.norm() == 0.0:
        raise InputError(f"{path}: priority_vector = {content['priority_vector']}: must not be zero")
    return x, unit(priority)


def numbers(value: Any, length: int, where: str) -> Tensor:
    """A finite number or a list of `length` finite numbers as (length,) float64."""
    items = value if isinstance(value, list) else [value]
    fine = isinstance(value, list) == (length > 1) and len(items) == length
    if not fine or not all(isinstance(i, (int, float)) and not isinstance(i, bool) for i in items):
        raise InputError(
            f"{where} = {value!r}: must be {f'a list of {length} numbers' if length > 1 else 'a number'}"
        )
    if not all(abs(i) <= LARGEST for i in items):  # False for NaN
        raise InputError(f"{where} = {str(value)[:80]}: must be finite, at most {LARGEST:g} in size")
    return torch.tensor(items, dtype=torch.float64)


def read_actions(path: str, limit: tuple[float, ...]) -> np.ndarray:
    """Reads an N x 6 array of controls in N and N m; refuses what the actuators cannot do."""
    try:
        actions = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the actions: no such file") from None
    except (Exception, MemoryError):  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the actions: not a .npy file of numbers") from None
    if (
        not isinstance(actions, np.ndarray)
        or actions.ndim != 2
        or actions.shape[1] != CONTROL_SIZE
        or not len(actions)
    ):
        raise InputError(f"{path}: shape {getattr(actions, 'shape', None)}: must be (N, 6), in N and N m")
    check_controls(actions, limit, path)
    return actions


def check_controls(controls: np.ndarray, limit: tuple[float, ...], where: str) -> None:
    """Refuses controls (N, 6) in N and N m that are not finite or beyond what the actuators can do."""
    if controls.dtype.kind not in "fiu" or not np.isfinite(controls).all():
        raise InputError(f"{where}: must hold finite numbers only")
    excess = np.abs(controls) > np.array(limit) * (1.0 + 1e-9)
    if excess.any():
        row, column = np.argwhere(excess)[0]
        raise InputError(
            f"{where}: row {row}, column {column} = {controls[row, column]:g}: "
            f"must be within +-{limit[column]:g} {'N' if column < 3 else 'N m'}"
        )


def check_step(step: float, duration: float, rta_period: float | None, c: InspectionParameters) -> None:
    """Refuses steps that do not fit the other clocks of a simulation."""
    if step < 1e-3 or duration / min(step, c.substep) > MAX_ROWS:
        raise InputError(
            f"--duration {duration:g} at --step {step:g}: at most {MAX_ROWS:,} steps of at least 1 ms"
        )
    for name, other in (("--rta-period", rta_period), ("the agent's period", c.action_period)):
        if other is not None and not (is_multiple(step, other) or is_multiple(other, step)):
            raise InputError(f"--step {step:g}: must divide {name}, {other:g} s, or be a multiple of it")
    if step > c.substep and not is_multiple(step, c.substep):
        raise InputError(f"--step {step:g}: must be a multiple of the integration step, {c.substep:g} s")
    if not is_multiple(duration, step):
        raise InputError(f"--duration {duration:g}: must be a multiple of --step, {step:g} s")


def is_multiple(a: float, b: float) -> bool:
    """Whether a is a whole multiple of b, to rounding."""
    return round(a / b) >= 1 and abs(a / b - round(a / b)) < 1e-9


def starting_point(
    given: tuple[Tensor, Tensor | None] | None, config: Config, seed: int
) -> tuple[Tensor, Tensor]:
    """The given state and priority vector; what is not given is drawn from the seed."""
    drawn = test_cases(config, 1, seed)
    if given is None:
        return drawn
    return given[0], drawn[1] if given[1] is None else given[1]


def classical(name: str, actions: str | None, config: Config, step: float, seed: int) -> Controller:
    """A controller of `inspection.guidance` by its name on the command line."""
    c = config.inspection
    if actions is not None:
        return guidance.recorded(read_actions(actions, c.control_limit), step)
    return {
        "lqr-pd": lambda: guidance.lqr_pd(c),
        "natural-motion": lambda: guidance.natural_motion(c),
        "zero": guidance.zero,
        "random": lambda: guidance.random(c, torch.Generator().manual_seed(seed)),
    }[name]()


def policy_controller(policy: Policy, env: InspectionEnv) -> Controller:
    """The agent's mean action; `env` supplies what it observes of the chief beside its own state."""

    def control(t: float, x: Tensor) -> Tensor:
        env.x = x
        action = policy.mean_action(env.observation()[None])[0]
        return action.T.to(x.dtype).clamp(-1.0, 1.0) * env.limit

    return control


@torch.no_grad()
def simulate(
    env: InspectionEnv,
    controller: Controller,
    x: Tensor,
    priority: Tensor,
    duration: float,
    step: float,
    decide_every: float,
    until_ended: bool = False,
) -> dict[str, np.ndarray]:
    """Simulates one spacecraft.

    Args:
        env: of one episode; its safety holds the filter, if any.
        controller: asked every `decide_every` s; in between the filter is given its own last control.
        x, priority: initial state (16, 1) and priority vector (3, 1).
        duration: s; step: s between two rows of the result. Points are inspected every action period.
        until_ended: stop at the first terminal condition of an episode.

    Returns:
        Arrays by name over time, the initial state first; `control_applied` is the control from the row's
        time on, and the last row repeats the one before it. `inspected` is (rows, points) bool. `intervened`
        is (rows, 2) bool, whether a call of the filter from the row up to the next corrected thrust, torque.
        `parameters`, the only one not over time, is the task's table of a configuration file.
    """
    c, safety = env.c, env.safety
    env.start(x, priority)
    interval = min(step, c.substep, safety.period if safety.correct else step, decide_every)
    rows: list[dict[str, Tensor]] = []
    desired = applied = x.new_zeros(CONTROL_SIZE, 1)

    def due(i: int, every: float) -> bool:
        return i % max(1, round(every / interval)) == 0

    def row(i: int) -> dict[str, Tensor]:
        fields = {name: x[component].reshape(-1) for name, (component, _) in STATE_FIELDS.items()}
        return fields | {
            "time": torch.tensor([i * interval]),
            "control_desired": desired[:, 0],
            "control_applied": applied[:, 0],
            "inspected_score": env.score,
            "inspected": env.inspected[:, 0].clone(),  # `look` writes in place
            "intervened": intervened,  # calls before the next row write into it
            "h": safety.values(x)[:, 0],
        }

    steps = round(duration / interval)
    for i in range(steps + 1):
        ended = False
        if i > 0 and due(i, c.action_period):
            env.x = x
            env.look()
            conditions = terminal_conditions(x, env.score, x.new_tensor([i * interval]), c)
            ended = until_ended and any(bool(condition) for condition in conditions.values())
        recorded = due(i, step) or i == steps or ended
        if recorded:
            intervened = torch.zeros_like(x[:2, 0], dtype=torch.bool)
        if i < steps:
            fresh = due(i, decide_every)
            if fresh:
                desired = controller(i * interval, x)
            if safety.correct is None:
                applied = desired
            elif due(i, safety.period):
                correction = safety.correct(x, desired if fresh else applied)
                applied = correction.control
                intervened |= correction.program_status[:, 0] > Status.UNTOUCHED
        if recorded:
            rows.append(row(i))
        if ended:
            break
        if i < steps:
            x = integrate(x, applied, interval, c)
    arrays = {name: torch.stack([r[name] for r in rows]).cpu().numpy() for name in rows[0]}
    h = arrays.pop("h")
    arrays |= {f"h_{name}": h[:, i] for i, name in enumerate(safety.names)}
    scalars = ("time", "inspected_score", "temperature", "energy", "sun_angle")
    arrays = {name: array[:, 0] if name in scalars else array for name, array in arrays.items()}
    return arrays | {"parameters": np.array(tomli_w.dumps({"inspection": asdict(c)}))}


def common_episode(
    policy: Policy, config: Config, safety: Safety, device: torch.device
) -> dict[str, np.ndarray]:
    """`simulate` of the agent from the first common test case until the episode ends, a row per integration step."""
    x, priority = test_cases(config, 1, 0)
    env = build.one_episode(config, safety, device)
    return simulate(
        env,
        policy_controller(policy, env),
        x.to(device),
        priority.to(device),
        duration=config.inspection.max_time,
        step=min(config.train.rta_period, config.inspection.substep),
        decide_every=config.inspection.action_period,
        until_ended=True,
    )
