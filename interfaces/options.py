"""The options of `reset`: which episodes restart, and from which states."""

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.model.attitude import norm, unit
from inspection.model.parameters import Limits
from inspection.model.state import SIZE, P, Q
from rta.filter_input import numbers
from settings import InputError, instead
from study.errors import as_input_error
from study.flight.state_files import LARGEST, check_states

MASK = "reset_mask"
STARTS = {"state": SIZE, "priority": 3}  # components


def check_names(options: Any, allowed: Collection[str]) -> None:
    """Raises InputError if options are no dictionary or hold a name that is not allowed."""
    if not isinstance(options, dict):
        raise InputError(f"options = {options!r}: must be a dictionary of {', '.join(allowed)}")
    for name in options:
        if name not in allowed:
            raise InputError(f"options: unknown {name!r}{instead(str(name), allowed)}")


def read(options: dict[str, Any] | None, batch: int, c: Limits) -> dict[str, Tensor]:
    """Returns options as the arguments of `InspectionEnv.reset`, on the CPU.

    Rows of states and priority vectors only count, and are only checked, where the mask is set.

    Raises:
        InputError: an unknown option, a wrong type or shape, or a state or priority from which no episode can begin.
    """
    options = {} if options is None else options
    check_names(options, (MASK, *STARTS))
    mask = mask_of(options.get(MASK, np.ones(batch, dtype=np.bool_)), batch)
    found = {"mask": mask}
    if "state" in options:
        possible = torch.zeros(SIZE, 1, dtype=torch.float64)  # where no state is given
        possible[P.start] = possible[Q.stop - 1] = 1.0
        states = torch.where(mask, rows("state", options["state"], batch), possible)
        found["x"] = check_states(states, c, "options: state")
    if "priority" in options:
        priority = torch.where(mask, rows("priority", options["priority"], batch), 1.0)
        length = norm(priority)
        if (wrong := ~((length > 0.0) & (length <= LARGEST))).any():
            raise InputError(
                f"options: priority in row {torch.nonzero(wrong)[0].item()}: "
                f"must be finite, not zero, and at most {LARGEST:g} long"
            )
        found["priority"] = unit(priority)
    return found


def mask_of(given: Any, batch: int) -> Tensor:
    """Returns the mask (B,) of the episodes that restart."""
    mask = given if torch.is_tensor(given) else np.asarray(given)
    if tuple(mask.shape) != (batch,) or mask.dtype not in (np.bool_, torch.bool):
        raise InputError(
            f"options: reset_mask of shape {tuple(mask.shape)} and type {mask.dtype}: must be ({batch},) bool"
        )
    if not mask.any():
        raise InputError("options: reset_mask is nowhere true: must be true for at least one episode")
    return torch.as_tensor(mask, device="cpu")


def rows(name: str, given: Any, batch: int) -> Tensor:
    """Returns one row for all episodes, or one row each, as (components, B) float64."""
    size = STARTS[name]
    with as_input_error("options", ValueError):
        part = numbers(name, given).to("cpu", torch.float64)
    if tuple(part.shape) not in ((size,), (batch, size)):
        raise InputError(
            f"options: {name} of shape {tuple(part.shape)}: must be ({size},) or ({batch}, {size})"
        )
    return part.expand(batch, size).T
