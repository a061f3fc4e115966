"""What takes tensors says so, in a line, where it is given anything else."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from inspection.model import attitude, dynamics
from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter

C = InspectionParameters()
SAFETY = SafetyFilter(C)
X, U = torch.zeros(16, 1, dtype=torch.float64), torch.zeros(6, 1, dtype=torch.float64)
X[0], X[9], X[13], X[14] = 50.0, 1.0, 5.0, 6.0
CALLS: dict[str, tuple[Callable[..., Any], tuple[torch.Tensor, ...]]] = {
    "step": (lambda x, u: dynamics.step(x, u, 1.0, C), (X, U)),
    "drift": (lambda x: dynamics.drift(x, C), (X,)),
    "control_matrix": (lambda x: dynamics.control_matrix(x, C), (X,)),
    "sun_and_earth_in_body": (dynamics.sun_and_earth_in_body, (X,)),
    "unit": (attitude.unit, (X[6:10],)),
    "rotate": (attitude.rotate, (X[6:10], X[:3])),
    "values": (SAFETY.values, (X,)),
    "is_safe": (SAFETY.is_safe, (X,)),
    "correct": (SAFETY.correct, (X, U)),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_tensor_is_refused_by_name(name: str) -> None:
    call, given = CALLS[name]
    call(*given)
    for place in range(len(given)):
        for made in (torch.Tensor.numpy, torch.Tensor.tolist):
            mixed = [made(part) if place == i else part for i, part in enumerate(given)]
            with pytest.raises(
                TypeError, match=r"^\w+ is of type (ndarray|list): must be a PyTorch tensor; torch\.as"
            ):
                call(*mixed)
