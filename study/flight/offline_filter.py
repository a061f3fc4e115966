"""Filtering states from elsewhere, with every number of the quadratic programs, so that others can check them."""

import numpy as np
import torch
from torch import Tensor

from rta.barrier import ActuatorGroup, Rows
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.flown_paper import FlownPaperFilter
from rta.qp.programs import FEASIBLE, Status
from rta.qp.scaled import SHORTEST_ROW
from study.config import Config
from study.experiment import AnyFilter, Experiment
from study.flight.state_files import read_states
from study.machine import bar

CHUNK = 4096  # states filtered at once, so that memory does not grow with their number


def run(config: Config, states: str) -> dict[str, np.ndarray]:
    """What `filter` of the command line writes, of the states in a file."""
    x, desired = read_states(states, config.inspection)
    calls = -(-x.shape[1] // CHUNK)
    experiment = Experiment(config, x.shape[1], calls * config.rta.period)
    return filter_states(experiment.filter, x.to(experiment.device), desired.to(experiment.device))


def filter_states(safety_filter: AnyFilter, x: Tensor, desired: Tensor) -> dict[str, np.ndarray]:
    """Filters states (16, N) and desired controls (6, N) in N and N m.

    Constraints are in the order of CONSTRAINTS, rows in that of the filter, thrust before torque. Units are SI:
    a row of A and b is the rate of h (of Psi_1 where the relative degree is two) in h's unit per s (per s^2),
    columns of A are per N and per N m. `control_safe` is the u that minimises

        |(u - control_desired) / limit|^2 + sum slack_weight delta^2

    subject to A_all u + b_all >= delta and |u| <= limit, with delta = 0 where slack_weight is infinite. That it is in a
    class of rows, equal in weight, wherever some control holds the class and those of larger weight. What is desired of
    a group beyond LARGEST_DEMAND limits is shortened to that first, see `rta.propose.demanded`. The paper's filter has
    a row for each limit, no margins, and its one weight wherever there may be slack.

    Returns:
        Of N states, H constraints and R rows:
        control_safe: (N, 6).
        h: (N, H) constraint values, exactly as in the paper.
        A: (N, H, 6), b: (N, H) barrier conditions A u + b >= 0, one per constraint: where the filter has several
            rows (passive safety, one per time segment), that with the smallest A control_safe + b.
        active: (N, H) bool, a row of the constraint binds a corrected control.
        slack: (N, H) delta <= 0 of A control_safe + b >= delta, zero where a program held without slack.
        status: (N,) `Status`, the worse of the thrust and the torque program.
        verified, backup: (N,) bool, see `FilterResult`. Where backup is set, control_safe is not that u. Slack of a
            program whose control is verified is not said: its status is HARD, slack zero, slack_weight infinite.
        constraints: (H,) names.
        A_all: (N, R, 6), b_all: (N, R) every row as it was finally enforced. b contains the margin if its program
            held with all margins, and does not if they had to be given up.
        constraint_of_row: (R,) index into constraints.
        slack_weight: (N, R) per squared unit of the row, infinite where the row was held. A row's shortfall beyond
            100 |A limit| counts as that much (`rta.qp.programs.HOPELESS`).
        with_margins: (N, 2) bool, the thrust and the torque program held with all margins.
    """
    parts = list(zip(x.split(CHUNK, 1), desired.split(CHUNK, 1), strict=True))
    shown = bar(len(parts), f"times {CHUNK:,} states", iterable=parts, leave=False)
    chunks = [
        paper_chunk(safety_filter, *part)
        if isinstance(safety_filter, FlownPaperFilter)
        else filter_chunk(safety_filter, *part)
        for part in shown
    ]
    result = {name: torch.cat([chunk[name] for chunk in chunks]).cpu().numpy() for name in chunks[0]}
    result["constraints"] = np.array(CONSTRAINTS)
    result["constraint_of_row"] = np.array([CONSTRAINTS.index(name) for name in names_of_rows(safety_filter)])
    return result


def names_of_rows(safety_filter: AnyFilter) -> list[str]:
    """The constraint of every row, thrust before torque."""
    if isinstance(safety_filter, FlownPaperFilter):
        return list(safety_filter.names)
    return [each.name for group in safety_filter.groups for each in group.of_row]


def enforced(group: ActuatorGroup, rows: Rows, control: Tensor, status: Tensor) -> dict[str, Tensor]:
    """The rows of one program as they were finally enforced on controls (6, N), last axis the states."""
    length = (rows.a * group.limit).norm(dim=1).clamp(min=SHORTEST_ROW)
    reached = (rows.a * control[group.controls]).sum(1)
    with_margins = ((reached + rows.b) / length >= -FEASIBLE).all(0) & (status < Status.UNSOLVED)
    b = torch.where(with_margins, rows.b, rows.b_no_margin)
    a = rows.a.new_zeros(len(b), *control.shape)
    a[:, group.controls] = rows.a
    weight = rows.a.new_tensor(group.weights)[:, None]
    short = (reached + b < -FEASIBLE * length) & weight.isfinite() & (status >= Status.SLACK)
    soft = weight <= torch.where(short, weight, 0.0).amax(0)  # as far up as a row had to yield
    return {
        "A_all": a,
        "b_all": b,
        "slack_weight": torch.where(soft, weight / length**2, torch.inf),
        "delta": torch.where(soft, (reached + b).clamp(max=0.0), 0.0),
        "with_margins": with_margins[None],
    }


def paper_chunk(paper: FlownPaperFilter, x: Tensor, desired: Tensor) -> dict[str, Tensor]:
    """`filter_chunk` of the paper's filter."""
    result, (a, b, *_) = paper.correct(x, desired), paper.evaluated(x)
    weights = [torch.inf if limit.weight is None else limit.weight for limit in paper.limits.values()]
    by_state = {
        "control_safe": result.control,
        "h": result.h,
        "A": a,
        "b": b,
        "active": result.active,
        "slack": -result.slack,
        "status": result.status,
        "violated": result.violated,
        "verified": result.verified,
        "backup": result.backup,
        "shortfall": result.slack,
        "A_all": a,
        "b_all": b,
        "slack_weight": x.new_tensor(weights)[:, None].expand_as(b),
        "with_margins": torch.ones_like(result.program_status, dtype=torch.bool),
    }
    return {name: array.movedim(-1, 0) for name, array in by_state.items()}


def filter_chunk(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> dict[str, Tensor]:
    """`filter_states` of a few states: its arrays that have a row per state."""
    result = safety_filter.correct(x, desired)
    parts = zip(
        safety_filter.groups, safety_filter.rows(x, result.control), result.program_status, strict=True
    )
    programs = [enforced(group, rows, result.control, status) for group, rows, status in parts]
    every = {name: torch.cat([program[name] for program in programs]) for name in programs[0]}

    left = (every["A_all"] * result.control).sum(1) + every["b_all"]  # (R, N)
    of_row = np.array(names_of_rows(safety_filter))
    own = (torch.from_numpy(np.flatnonzero(of_row == name)).to(x.device) for name in CONSTRAINTS)
    binding = torch.stack([rows[left[rows].argmin(0)] for rows in own])  # (H, N) row of each constraint
    columns = torch.arange(x.shape[1], device=x.device)
    by_state = {
        "control_safe": result.control,
        "h": safety_filter.values(x),
        "A": every["A_all"][binding, :, columns].movedim(2, 1),
        "b": every["b_all"][binding, columns],
        "active": result.active,
        "slack": every.pop("delta")[binding, columns],
        "status": result.status,
        "violated": result.violated,
        "verified": result.verified,
        "backup": result.backup,
        "shortfall": result.slack,
        **every,
    }
    return {name: array.movedim(-1, 0) for name, array in by_state.items()}
