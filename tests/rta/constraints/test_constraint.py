"""A constraint of one's own that is not as it must be ends in a ValueError that says what is allowed."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from rta.constraints.constraint import Constraint
from rta.filter import SafetyFilter

SLOW = "slow"


def h(x: torch.Tensor) -> torch.Tensor:
    return 10.0 - x[3:6].norm(dim=0)


def of(**changed: Any) -> Constraint:
    return Constraint(**{"name": SLOW, "h": h, "actuator": "thrust", "gains": (0.2,)} | changed)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gains": 0.2}, r"gains = 0\.2: must be a tuple of one or two positive numbers, 1/s: \(0\.2,\)"),
        ({"gains": None}, "gains = None: must be a tuple"),
        ({"gains": "ab"}, "gains = 'ab': must be a tuple"),
        ({"gains": ("a",)}, "one or two positive numbers"),
        ({"gains": (0.1, 0.1, 0.1)}, "one or two positive numbers"),
        ({"gains": (0.0,)}, "one or two positive numbers"),
        ({"margin": "x"}, "margin = 'x': must be a finite number, not negative"),
        ({"margin": -1.0}, r"margin = -1\.0: must be a finite number, not negative"),
        ({"weight": 0.0}, r"weight = 0\.0: must be a positive number or None"),
        ({"weight": "much"}, "weight = 'much': must be a positive number or None"),
        ({"actuator": "wheels"}, "actuator = 'wheels': must be thrust or torque"),
        ({"h": 3.0}, r"h = 3\.0: must be a function of states"),
    ],
)
def test_what_does_not_fit_is_refused(changed: dict[str, Any], words: str) -> None:
    assert of().gains == (0.2,)
    with pytest.raises(ValueError, match=f"^{SLOW}: .*{words}"):
        of(**changed)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda x: 10.0 - x[3:6], r"shape \(3, \d+\): must be \(B,\)"),
        (lambda x: (10.0 - x[3]).sum(), r"shape \(\): must be \(B,\)"),
        (lambda x: 1.0, "of type float: must be a tensor"),
        (lambda x: x[17], r"cannot be computed: index 17 .*; must be a tensor \(B,\)"),
        (lambda x: torch.ones(3) @ x[3:6], r"float64 cannot be computed: .*; must be a tensor \(B,\)"),
        (lambda x: h(x) / (x[0] * 0.0), "not finite"),
        (lambda x: 10.0 - (torch.ones(3, 1) * x[3:6]).norm(dim=0), r"must have shape \(\d, B\)"),
    ],
)
def test_an_h_of_another_shape_or_type_is_refused(wrong: Callable[[torch.Tensor], Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"^{SLOW}: h .*{words}"):
        SafetyFilter(extra=[of(h=wrong)])
