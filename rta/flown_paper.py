"""The paper's filter in a closed loop: called every so many seconds, its rows compiled, its input checked."""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Safety
from inspection.fixed import Fixed
from inspection.model.parameters import InspectionParameters
from inspection.model.state_checks import is_state
from inspection.model.tensors import check_tensors
from kernels.compiled import Compiled
from kernels.modes import in_full_precision
from rta.filter_input import FilterInput, compiled_for_one, probe
from rta.limits import PAPER, Limit
from rta.paper import PaperFilter
from rta.result import FilterResult


class FlownPaperFilter(Fixed, PaperFilter):
    """`PaperFilter` with what commands ask of a filter. Call it as a function, of one spacecraft or of many.

    Args:
        c: the task's constants; None: the paper's.
        period: s between two calls, of which no row knows; limits: another table than the paper's.

    Attributes:
        unchecked: all that it enforces, since nothing is checked.
        compiled: `evaluated`; None: it is not. PIQP solves the programs all the same.
    """

    FIXED = ("c", "limits", "names", "period")
    unchecked = ["motion", "attitude"]  # noqa: RUF012
    c: InspectionParameters

    def __init__(
        self,
        c: InspectionParameters | None = None,
        period: float = 1.0,
        limits: dict[str, Limit] = PAPER,
    ) -> None:
        super().__init__(c or InspectionParameters(), limits)
        self.period = period
        self.compiled: Compiled | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.c, self.period, self.limits)

    @in_full_precision
    def compile(self, device: torch.device | str, batch: int) -> None:
        """Compiles the rows for tensors on this device and calls of about so many spacecraft.

        Takes some seconds, once: what was compiled is kept across runs. Raises as `kernels.compiled.Compiled`, and
        changes nothing then.
        """

        x = probe(self.c, device)[0]
        self.compiled = Compiled(lambda x: list(PaperFilter.evaluated(self, x)), x, batch=batch)

    @in_full_precision
    def values(self, x: Tensor) -> Tensor:
        """Returns every h, (16, B) to (13, B); never compiled, so that others can record and differentiate it."""
        check_tensors(x=x)
        return super().values(x)

    @in_full_precision
    def evaluated(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns a, b and Psi of `barrier_conditions`, and every h."""
        if self.compiled is None:
            return super().evaluated(x)
        a, b, psi, h = self.compiled(x)
        return a, b, psi, h

    @in_full_precision
    def is_safe(self, x: Tensor) -> Tensor:
        """Tells which states (16, B) may start an episode, (B,) bool: every h >= 0 and every Psi_1 >= 0."""
        _, _, psi, h = self.evaluated(x)
        return is_state(x, self.c) & (h >= 0.0).all(0) & (psi >= 0.0).all(0)

    @in_full_precision
    def __call__(self, x: Any, desired: Any) -> FilterResult:
        """Filters a desired control of one spacecraft, or of each of a batch; as `SafetyFilter.__call__`."""
        call = FilterInput(x, desired, self.c)
        call.warn()
        fit = call.single and call.x.device.type == "cpu" and not self.compiled
        return call.answer((self._for_one if fit else self).correct(call.x, call.desired))

    @cached_property
    def _for_one(self) -> "FlownPaperFilter":
        """This filter, compiled where it can be."""
        return compiled_for_one(FlownPaperFilter(self.c, self.period, self.limits))

    def safety(self, enabled: bool = True) -> Safety:
        """Returns what the environment needs; `enabled`: this filter, too."""
        correct = self.correct if enabled else None
        return Safety(self.names, self.values, self.is_safe, correct, self.period)
