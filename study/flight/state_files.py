"""Files of states and controls that a person gives, read and checked."""

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.model.attitude import norm, unit
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from inspection.model.state_checks import LARGEST, unit_warnings
from inspection.world.corners import CORNER
from settings import InputError, instead
from study import files

MAX_STATES = 10**6

STATE_FIELDS: dict[str, tuple[Any, int]] = {
    "position": (P, 3),
    "velocity": (V, 3),
    "quaternion": (Q, 4),
    "angular_velocity": (OMEGA, 3),
    "temperature": (T, 1),
    "energy": (E, 1),
    "sun_angle": (THETA_S, 1),
}


def check_states(x: Tensor, c: Limits, path: str) -> Tensor:
    """Returns states (16, N) with normalised quaternions; raises InputError for the first impossible state.

    Warns on stderr of numbers that look like another unit or order.
    """
    rules = {
        "state": (~(x.abs() <= LARGEST).all(0), f"must be finite, at most {LARGEST:g} in size"),
        "quaternion": ((norm(x[Q]) - 1.0).abs() > 1e-6, "must have length 1 (scalar last)"),
        "position": (norm(x[P]) == 0.0, "must not be the chief's centre"),
        "temperature": (x[T] <= -c.zero_celsius, f"must be above {-c.zero_celsius:g} deg C"),
        "energy": (x[E] < 0.0, "must not be negative"),
    }
    for what, (wrong, allowed) in rules.items():
        if wrong.any():
            raise InputError(f"{path}: {what} in row {torch.nonzero(wrong)[0].item()}: {allowed}")
    for warning in unit_warnings(x, c):
        print(f"{path}: {warning}", file=sys.stderr)
    return torch.cat((x[: Q.start], unit(x[Q]), x[Q.stop :]))


def read_state(path: str, c: Limits) -> tuple[Tensor, Tensor | None]:
    """Reads a state file: state (16, 1) and priority unit vector (3, 1), None where the file has none.

    Raises:
        InputError: the file is unreadable, not JSON, or has wrong keys or shapes, or see `check_states`.
    """
    content = files.read_json(path, "state file")
    if unknown := content.keys() - STATE_FIELDS.keys() - {"priority_vector"}:
        allowed = (*STATE_FIELDS, "priority_vector")
        raise InputError(f"{path}: unknown key {min(unknown)!r}{instead(min(unknown), allowed)}")
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    for key, (component, length) in STATE_FIELDS.items():
        if key not in content:
            raise InputError(f"{path}: {key} is missing")
        x[component, 0] = numbers(content[key], length, f"{path}: {key}").reshape(x[component, 0].shape)
    x = check_states(x, c, path)
    if "priority_vector" not in content:
        return x, None
    priority = numbers(content["priority_vector"], 3, f"{path}: priority_vector")[:, None]
    if priority.norm() == 0.0:
        raise InputError(f"{path}: priority_vector = {content['priority_vector']}: must not be zero")
    return x, unit(priority)


def numbers(value: Any, length: int, where: str) -> Tensor:
    """Returns a finite number or a list of `length` finite numbers as (length,) float64; else raises InputError."""
    items = value if isinstance(value, list) else [value]
    fine = isinstance(value, list) == (length > 1) and len(items) == length
    if not fine or not all(isinstance(i, (int, float)) and not isinstance(i, bool) for i in items):
        raise InputError(
            f"{where} = {value!r}: must be {f'a list of {length} numbers' if length > 1 else 'a number'}"
        )
    if not all(abs(i) <= LARGEST for i in items):  # False for NaN
        raise InputError(f"{where} = {str(value)[:80]}: must be finite, at most {LARGEST:g} in size")
    return torch.tensor(items, dtype=torch.float64)


def read_states(path: str, c: Limits) -> tuple[Tensor, Tensor]:
    """Reads `state` (N, 16) and `control_desired` (N, 6) from a .npz file: x (16, N) and u (6, N), float64.

    Raises:
        InputError: the file is unreadable, lacks a key or has wrong shapes, or see `check_states` and `check_finite`.
    """
    names = ("state", "control_desired")
    given = files.load_arrays(path, names, "states", f"; the file must hold {' and '.join(names)}")
    count = given["state"].shape[0] if given["state"].ndim else 0
    for name, width in zip(names, (SIZE, CONTROL_SIZE), strict=True):
        array = given[name]
        if array.shape != (count, width) or not 0 < count <= MAX_STATES:
            raise InputError(
                f"{path}: {name} has shape {array.shape}: must be (N, {width}), "
                f"with the same N from 1 to {MAX_STATES:,} in state and control_desired"
            )
        if array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} is of type {array.dtype}: must hold numbers")
    check_finite(given["control_desired"], f"{path}: control_desired")
    x, u = (torch.from_numpy(np.ascontiguousarray(given[name].T, dtype=np.float64)) for name in names)
    return check_states(x, c, path), u


def read_actions(path: str, limit: tuple[float, ...], rows: int) -> np.ndarray:
    """Reads an N x 6 array of controls in N and N m, or N x 25 with corners (`inspection.world.corners`) after them.

    Raises InputError for controls beyond the actuators' limits, corners other than 0 and 1, and N < `rows`.
    """
    try:
        actions = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the actions: no such file") from None
    except (Exception, MemoryError):  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the actions: not a .npy file of numbers") from None
    if not isinstance(actions, np.ndarray):
        raise InputError(f"{path}: cannot read the actions: an archive of arrays, not a .npy file of one")
    if actions.ndim != 2 or actions.shape[1] not in (CONTROL_SIZE, CONTROL_SIZE + CORNER) or not len(actions):
        raise InputError(
            f"{path}: shape {actions.shape}: must be (N, 6), in N and N m, or (N, 25) with corners, N 1 or more"
        )
    controls, corners = actions[:, :CONTROL_SIZE], actions[:, CONTROL_SIZE:]
    check_finite(controls, path)
    beyond = np.abs(controls) > np.array(limit) * (1.0 + 1e-9)
    wrong = np.hstack((beyond, (corners != 0.0) & (corners != 1.0)))  # also true for NaN
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        allowed = "a corner must be 0 or 1"
        if column < CONTROL_SIZE:
            allowed = f"must be within +-{limit[column]:g} {'N' if column < 3 else 'N m'}"
        raise InputError(f"{path}: row {row}, column {column} = {actions[row, column]:g}: {allowed}")
    if len(actions) < rows:
        raise InputError(f"{path}: {len(actions):,} rows: --duration and --step need {rows:,}")
    return actions


def check_finite(controls: np.ndarray, where: str) -> None:
    """Raises InputError for controls that are not finite numbers."""
    if controls.dtype.kind not in "fiu":
        raise InputError(f"{where}: must hold numbers, not {controls.dtype.name}")
    if not np.isfinite(controls).all():
        raise InputError(f"{where}: must hold finite numbers only")
