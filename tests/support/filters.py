"""Filters that tests take apart."""

import torch
from torch import Tensor

from columns import call, if_long
from rta.filter import SafetyFilter
from rta.result import FilterResult, Status


def without_check(safety: SafetyFilter) -> SafetyFilter:
    """Returns the filter with its programs alone, which users cannot have: `check` is fixed."""
    object.__setattr__(safety, "check", None)
    return safety


class Unproposed(SafetyFilter):
    """Acts as a filter that proposes the desired control, clipped to the actuators' limits, so the check decides."""

    def proposed(self, x: Tensor, asked: Tensor) -> FilterResult:
        """Returns the desired control, whatever the conditions say."""
        control = call(clipped, asked, list(self.c.control_limit))
        h = call(self.program.values, x, long=if_long(len(self.c.planes)))
        changed = (control != asked).any(0)
        status = torch.where(changed, Status.HARD, Status.UNTOUCHED)
        no = torch.zeros_like(changed)
        slack = torch.zeros_like(h)
        return FilterResult(control, changed, no, no, slack > 0.0, slack, status, h)


def clipped(u: Tensor, limit: list[float]) -> Tensor:
    """Returns controls (6, B) within the actuators' limits."""
    most = u.new_tensor(limit)[:, None]
    return u.clamp(-most, most)
