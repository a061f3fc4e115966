"""The filter with error bounds: it predicts old states, rounds to what thrusters give, and has its own check."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from columns import call
from inspection.closed_loop import Safety
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, THRUST, TORQUE
from inspection.model.tensors import check_tensors
from inspection.world.uncertainty import Uncertainty
from precision import in_full_precision
from rta.check.commit import Check
from rta.demand import demanded, known
from rta.filter import SafetyFilter
from rta.limits import Limit
from rta.parameters import RtaParameters
from rta.result import FilterResult, Status
from rta.robust.check import RobustCheck
from rta.robust.prediction import KINDS, predicted


class RobustFilter(SafetyFilter):
    """Filters as `SafetyFilter`; its controls are safe for all errors within bounds.

    Args:
        uncertainty: bounds of the errors of the model and of the measured state.
    """

    FIXED: tuple[str, ...] = (*SafetyFilter.FIXED, "uncertainty")

    def __init__(
        self,
        c: InspectionParameters | None = None,
        parameters: RtaParameters | None = None,
        extra: Mapping[str, Limit] | None = None,
        *,
        uncertainty: Uncertainty,
    ) -> None:
        self.uncertainty = uncertainty
        uncertainty.check(c or InspectionParameters(), (parameters or RtaParameters()).period)
        super().__init__(c, parameters, extra)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), uncertainty=self.uncertainty), (self.c, self.parameters, self.extra)

    @property
    def longest_hold(self) -> float:
        """Returns the longest time in s for which a control is held."""
        return self.uncertainty.hold(self.period)

    @property
    def largest_rate(self) -> float:
        """Returns `SafetyFilter.largest_rate` less the error of the rates."""
        *_, rate = self.uncertainty.radii
        return max(0.0, super().largest_rate - rate - self.uncertainty.unknown_turning(self.c))

    def find_check(self) -> Check:
        """Returns the check within the bounds; raises NoCheckError."""
        return RobustCheck(self.c, self.period, self.uncertainty)

    def probe(self, device: torch.device | str = "cpu") -> list[Tensor]:
        """Returns the arguments of `SafetyFilter.probe` and the controls held since the measurement."""
        x, u = super().probe(device)
        return [x, u, u.expand(self.uncertainty.latency, CONTROL_SIZE, 1)]

    def safety(self, enabled: bool = True) -> Safety:
        """Returns `SafetyFilter.safety`, whose filter also takes the controls held since the measurement."""
        return replace(super().safety(enabled), takes_plant_data=True)

    @in_full_precision
    def correct(self, x: Tensor, desired: Tensor, sent: Tensor | None = None) -> FilterResult:
        """Filters one control per spacecraft, as `SafetyFilter.correct`.

        Args:
            sent: (k, 6, B) the controls held since the states were measured, the oldest first, each for a period; NaN
                for controls before the measurement. With more than `latency` controls the state is too old: the status
                is UNSOLVED, and the control is not verified.
        """
        check_tensors(x=x, desired=desired)
        with torch.no_grad():
            return self.unless_old(self.answer(x, desired, self.newest(x, sent)), sent)

    def newest(self, x: Tensor, sent: Tensor | None) -> Tensor:
        """Returns the newest controls sent (latency, 6, B), NaN where there are fewer."""
        latency = self.uncertainty.latency
        count = 0 if sent is None else min(len(sent), latency)
        never = x.new_full((latency - count, CONTROL_SIZE, x.shape[1]), torch.nan)
        return never if sent is None or not count else torch.cat((never, sent[-count:]))

    def unless_old(self, result: FilterResult, sent: Tensor | None) -> FilterResult:
        """Returns the answer, neither solved nor verified where more than `latency` controls were sent."""
        if sent is None:
            return result
        old = (~sent.isnan().any(1)).sum(0) > self.uncertainty.latency
        status = torch.where(old, Status.UNSOLVED, result.status)
        return replace(result, verified=result.verified & ~old, status=status)

    def answer(self, x: Tensor, desired: Tensor, *told: Tensor) -> FilterResult:
        """Predicts, rounds, proposes, checks and commits: the order of a call; told: `newest`."""
        x = call(known, x)
        error_bound = torch.zeros_like(x[:KINDS])
        for u in told[0] if told else ():
            x, error_bound = call(self.predict, x, error_bound, u)
        asked = call(self.possible, call(demanded, desired, list(self.c.control_limit)))
        proposed = self.proposed(x, asked)
        proposed.control = call(self.possible, proposed.control)
        return self.committed(torch.cat((x, error_bound)), desired, proposed)

    def predict(self, x: Tensor, error_bound: Tensor, u: Tensor) -> list[Tensor]:
        """Returns `predicted` by the filter's model, for states (16, B) and bounds (4, B) under controls (6, B)."""
        return list(predicted(x, error_bound, u, self.c, self.period, self.uncertainty))

    def possible(self, u: Tensor) -> Tensor:
        """Rounds controls (6, B) to what the thrusters can give."""
        if not self.uncertainty.is_quantised:
            return u
        return torch.cat((self.uncertainty.quantised(u[THRUST], self.c.max_thrust), u[TORQUE]))
