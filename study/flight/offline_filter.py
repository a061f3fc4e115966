"""Filtering states from elsewhere, with every number of the quadratic programs, so that others can check them."""

import numpy as np
import torch
from torch import Tensor

from inspection.attitude import norm, unit
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, E, P, Q, T
from rta import constraints
from rta.constraints import CONSTRAINTS
from rta.filter import SHORTEST_ROW, SafetyFilter
from rta.qp import FEASIBLE, Status
from study import arrays
from study.errors import InputError
from study.flight.simulation import LARGEST, check_controls

MAX_STATES = 10**6
CHUNK = 4096  # states filtered at once, so that memory does not grow with their number


def read_states(path: str, c: InspectionParameters) -> tuple[Tensor, Tensor]:
    """Reads `state` (N, 16) and `control_desired` (N, 6) from a .npz file: x (16, N) and u (6, N), float64.

    Raises:
        InputError: unreadable, a key is missing, wrong shapes, not finite, a quaternion that is not of unit
            length, a state that does not exist, a control beyond the actuators.
    """
    given = read_arrays(path, ("state", "control_desired"))
    state, desired = given["state"], given["control_desired"]
    count = state.shape[0] if state.ndim else 0
    for name, array, width in (("state", state, SIZE), ("control_desired", desired, CONTROL_SIZE)):
        if array.shape != (count, width) or not 0 < count <= MAX_STATES:
            raise InputError(
                f"{path}: {name} has shape {array.shape}: must be (N, {width}), "
                f"with the same N from 1 to {MAX_STATES:,} in state and control_desired"
            )
        if array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} is of type {array.dtype}: must hold numbers")
    x = torch.from_numpy(np.ascontiguousarray(state.T, dtype=np.float64))
    refuse_rows(path, "state", ~(x.abs() <= LARGEST).all(0), f"must be finite, at most {LARGEST:g} in size")
    wrong = (norm(x[Q]) - 1.0).abs() > 1e-6
    refuse_rows(path, "quaternion, columns 6 to 9 of state,", wrong, "must have length 1 (scalar last)")
    refuse_rows(path, "position", norm(x[P]) == 0.0, "must not be the chief's centre")
    refuse_rows(path, "temperature", x[T] <= -c.zero_celsius, f"must be above {-c.zero_celsius:g} deg C")
    refuse_rows(path, "energy", x[E] < 0.0, "must not be negative")
    x[Q] = unit(x[Q])
    check_controls(desired, c.control_limit, f"{path}: control_desired")
    return x, torch.from_numpy(np.ascontiguousarray(desired.T, dtype=np.float64))


def read_arrays(path: str, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The named arrays of a .npz file."""
    return arrays.load(path, names, "states", where_missing=f"; the file must hold {' and '.join(names)}")


def refuse_rows(path: str, what: str, wrong: Tensor, allowed: str) -> None:
    """Refuses the first row (N,) that is wrong."""
    if wrong.any():
        raise InputError(f"{path}: {what} in row {torch.nonzero(wrong)[0].item()}: {allowed}")


def filter_states(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> dict[str, np.ndarray]:
    """Filters states (16, N) and desired controls (6, N) in N and N m.

    Constraints are in the order of CONSTRAINTS, rows in that of the filter, thrust before torque. Units are SI:
    a row of A and b is the rate of h (of Psi_1 where the relative degree is two) in h's unit per s (per s^2),
    columns of A are per N and per N m. `control_safe` is the u that minimises

        |(u - control_desired) / limit|^2 + sum slack_weight delta^2

    subject to A_all u + b_all >= delta and |u| <= limit, with delta = 0 where slack_weight is infinite. That it is in
    a class of rows, equal in weight, wherever some control holds the class and those of larger weight.

    Returns:
        control_safe: (N, 6).
        h: (N, 13) constraint values, exactly as in the paper.
        A: (N, 13, 6), b: (N, 13) barrier conditions A u + b >= 0, one per constraint: where the filter has several
            rows (passive safety, one per time segment), that with the smallest A control_safe + b.
        active: (N, 13) bool, a row of the constraint binds a corrected control.
        slack: (N, 13) delta <= 0 of A control_safe + b >= delta, zero where a program held without slack.
        status: (N,) `Status`, the worse of the thrust and the torque program.
        constraints: (13,) names.
        A_all: (N, R, 6), b_all: (N, R) every row as it was finally enforced. b contains the margin if its program
            held with all margins, and does not if they had to be given up.
        constraint_of_row: (R,) index into constraints.
        slack_weight: (N, R) per squared unit of the row, infinite where the row was held. A row's shortfall beyond
            100 |A limit| counts as that much (`rta.qp.HOPELESS`).
        with_margins: (N, 2) bool, the thrust and the torque program held with all margins.
    """
    chunks = [
        filter_chunk(safety_filter, *part)
        for part in zip(x.split(CHUNK, 1), desired.split(CHUNK, 1), strict=True)
    ]
    result = {name: torch.cat([chunk[name] for chunk in chunks]).cpu().numpy() for name in chunks[0]}
    fixed = (*safety_filter.barriers.thrust, *safety_filter.barriers.torque)
    result["constraints"] = np.array(CONSTRAINTS)
    result["constraint_of_row"] = np.array([CONSTRAINTS.index(row.constraint) for row in fixed])
    return result


def filter_chunk(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> dict[str, Tensor]:
    """`filter_states` of a few states: its arrays that have a row per state."""
    barriers, limit = safety_filter.barriers, safety_filter.c.control_limit
    result = safety_filter(x, desired)
    programs = []
    for rows, fixed, group, status in zip(
        safety_filter.rows(x),
        (barriers.thrust, barriers.torque),
        (THRUST, TORQUE),
        result.program_status,
        strict=True,
    ):
        length = (rows.a * limit[group.start]).norm(dim=1).clamp(min=SHORTEST_ROW)
        reached = (rows.a * result.control[group]).sum(1)
        with_margins = ((reached + rows.b) / length >= -FEASIBLE).all(0) & (status <= Status.HARD)
        b = torch.where(with_margins, rows.b, rows.b_bare)
        a = rows.a.new_zeros(len(fixed), len(limit), x.shape[1])
        a[:, group] = rows.a
        weight = rows.a.new_tensor([row.weight for row in fixed])[:, None]
        short = (reached + b < -FEASIBLE * length) & weight.isfinite() & (status >= Status.SLACK)
        soft = weight <= torch.where(short, weight, 0.0).amax(0)  # as far up as a row had to yield
        programs.append(
            {
                "A_all": a,
                "b_all": b,
                "slack_weight": torch.where(soft, weight / length**2, torch.inf),
                "delta": torch.where(soft, (reached + b).clamp(max=0.0), 0.0),
                "with_margins": with_margins[None],
            }
        )
    every = {name: torch.cat([program[name] for program in programs]) for name in programs[0]}

    left = (every["A_all"] * result.control).sum(1) + every["b_all"]  # (R, N)
    names = [row.constraint for row in (*barriers.thrust, *barriers.torque)]
    binding = []
    for name in CONSTRAINTS:
        first, count = names.index(name), names.count(name)
        binding.append(first + left[first : first + count].argmin(0))
    binding = torch.stack(binding)  # (13, N) row of each constraint
    columns = torch.arange(x.shape[1], device=x.device)
    by_state = {
        "control_safe": result.control,
        "h": constraints.values(x, safety_filter.c),
        "A": every["A_all"][binding, :, columns].movedim(2, 1),
        "b": every["b_all"][binding, columns],
        "active": result.active,
        "slack": every.pop("delta")[binding, columns],
        "status": result.status,
        **every,
    }
    return {name: array.movedim(-1, 0) for name, array in by_state.items()}
