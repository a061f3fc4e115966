"""The filter: it corrects a desired control minimally, and from an accepted state applies only checked controls.

1. The paper's program (`rta.paper`) proposes a control, with gains that do not overshoot in a hold.
2. The check (`rta.check`) simulates the hold of this control, then the backup laws up to their terminal set.
3. Where a limit would be violated, controls on the way to those of the laws are tried; the last is the laws' own.
4. The answer reports which control was applied.
"""

from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor

from columns import call, if_long, when
from inspection.closed_loop import Safety
from inspection.fixed import Fixed
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, P, Q
from inspection.model.state_checks import is_state
from inspection.model.tensors import check_tensors
from precision import in_full_precision
from rta import own, vehicle
from rta.beside_hull import BESIDE_HULL
from rta.check.commit import Check, NoCheckError
from rta.check.nominal import NominalCheck
from rta.demand import FULL_RATE, demanded, in_mid_hold, known, within_rates
from rta.filter_input import FilterInput
from rta.limits import PAPER, Limit
from rta.names import PAPERS
from rta.paper import PaperFilter
from rta.parameters import RtaParameters
from rta.result import FilterResult, Status


class SafetyFilter(Fixed):
    """Corrects a desired control minimally.

    Call it as a function; `correct` is the same without checks of its input, for batches in float64. Any thread may
    call it. The code is written to be read; commands fly a compiled copy (docs/reference/filter.md, *Solvers*).

    Args:
        c: the task's constants; None: the paper's.
        parameters: which filter and its period; None: the defaults.
        extra: limits of your own by name, see `rta.own`.

    Attributes:
        limits: all enforced limits by name, the paper's and your own, with the gains that are used.
        names: of `limits`; program: proposes controls; check: decides; None: proposals are applied without a check.
        answer, accepts: compute `correct` and `is_safe`; `rta.fast` replaces them by compiled ones.

    Raises:
        ValueError: the vehicle cannot hold its limits, a limit of your own is malformed, or no check is known.
    """

    FIXED: tuple[str, ...] = ("c", "parameters", "extra", "limits", "names", "check")

    @in_full_precision
    def __init__(
        self,
        c: InspectionParameters | None = None,
        parameters: RtaParameters | None = None,
        extra: Mapping[str, Limit] | None = None,
    ) -> None:
        self.c, self.parameters = c or InspectionParameters(), parameters or RtaParameters()
        self.extra = dict(extra or {})
        vehicle.check(self.c)
        for name, limit in self.extra.items():
            if name in PAPERS:
                raise ValueError(f"{name}: is a limit of the paper: your own must have another name")
            own.check(name, limit, self.c)
        self.limits = self.enforced()
        self.names = tuple(self.limits)
        self.program = PaperFilter(self.c, self.limits)
        self.check = self.known_check() if self.parameters.filter == "checked" else None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.c, self.parameters, self.extra)

    @property
    def period(self) -> float:
        """Returns the time in s between two calls."""
        return self.parameters.period

    def enforced(self) -> dict[str, Limit]:
        """Returns all limits; with a check, gains are at most 0.5 / T, since larger ones overshoot in a hold of T s."""
        limits = {**PAPER, **(BESIDE_HULL if self.c.planes else {}), **self.extra}
        if self.parameters.filter == "paper":
            return limits
        most = 0.5 / self.longest_hold
        return {
            name: limit._replace(gains=tuple(min(gain, most) for gain in limit.gains))
            for name, limit in limits.items()
        }

    @property
    def largest_rate(self) -> float:
        """Returns the largest body rate in rad/s at the end of a proposed hold."""
        return FULL_RATE * self.c.max_rate

    @property
    def longest_hold(self) -> float:
        """Returns the longest time in s for which a control is held."""
        return self.period

    def known_check(self) -> Check | None:
        """Returns the check; raises ValueError if none is known, unless the settings allow that."""
        try:
            check = self.find_check()
        except NoCheckError as error:
            if self.parameters.unverified:
                return None
            raise ValueError(
                f"no check is known: {error}; [rta] unverified = true flies it without"
            ) from None
        missing = [name for name, known in zip(("motion", "attitude"), check.knows, strict=True) if not known]
        if missing and not self.parameters.unverified:
            raise ValueError(
                f"no check is known of {' and '.join(missing)}: {check.reason}; "
                "[rta] unverified = true flies it without"
            )
        return check

    def find_check(self) -> Check:
        """Returns the check for a plant that is the model; raises NoCheckError."""
        return NominalCheck(self.c, self.period)

    def with_parts(self: Self, program: PaperFilter, check: Check | None) -> Self:
        """Returns a copy with another program and check, which computes `answer` and `accepts` itself."""
        found = object.__new__(type(self))
        vars(found).update(vars(self), program=program, check=check)
        for name in ("answer", "accepts"):
            vars(found).pop(name, None)
        return found

    @property
    def checked(self) -> tuple[bool, bool]:
        """Returns whether thrust is checked, and whether torque is."""
        return self.check.knows if self.check else (False, False)

    @in_full_precision
    def values(self, x: Tensor) -> Tensor:
        """Returns every limit's h, exactly as in the paper: (16, B) to (limits, B)."""
        check_tensors(x=x)
        return self.program.values(x)

    @in_full_precision
    def is_safe(self, x: Tensor) -> Tensor:
        """Checks which states (16, B) may start an episode, (B,) bool (docs/reference/proof.md).

        It is true where a spacecraft can be in the state (`is_state`), every h >= 0, and the backup trajectory
        satisfies the limits. Without a check, and for limits of your own, every Psi_1 must be >= 0.
        """
        check_tensors(x=x)
        with torch.no_grad():
            return self.accepts(x)

    def accepts(self, x: Tensor) -> Tensor:
        """Computes `is_safe`."""
        _, _, psi, h = call(self.program.evaluated, x, long=if_long(len(self.c.planes)))
        unchecked = [i for i, name in enumerate(self.names) if not (all(self.checked) and name in PAPERS)]
        kept = is_state(x, self.c) & torch.stack([*h, *(psi[i] for i in unchecked)]).ge(0.0).all(0)
        if self.check:
            (kept,) = when(kept, self._has_backup_trajectory, [kept], x, waits=True)
        return kept

    def _has_backup_trajectory(self, x: Tensor) -> list[Tensor]:
        assert self.check
        return [self.check.has_backup_trajectory(x)]

    def probe(self, device: torch.device | str = "cpu") -> list[Tensor]:
        """Returns the arguments of `answer` for one spacecraft, to try functions of the batch with."""
        x = torch.zeros(SIZE, 1, dtype=torch.float64, device=device)
        x[P.start], x[Q.stop - 1] = self.c.max_distance / 2, 1.0
        return [x, torch.zeros_like(x[:CONTROL_SIZE])]

    def safety(self, enabled: bool = True) -> Safety:
        """Returns the environment's `Safety`: constraint values, safe initial states and, if enabled, this filter."""
        return Safety(
            names=self.names,
            values=self.values,
            is_safe=self.is_safe,
            correct=self.correct if enabled else None,
            period=self.period,
        )

    @in_full_precision
    def __call__(self, x: Any, desired: Any) -> FilterResult:
        """Filters a desired control of one spacecraft, or one of each spacecraft of a batch.

        Args:
            x: state (16,) or states (16, B), components in the order of `inspection.model.state`.
            desired: control (6,) or controls (6, B) in N and N m in the body frame, perhaps beyond the actuators'
                limits.

        Both are NumPy arrays, PyTorch tensors or lists, of float64, float32 or integers.

        Returns:
            Everything in the kind (list: NumPy), precision (integers: float64) and shape (one spacecraft: no axis B) of
            `desired`. The control is within the actuators' limits in float32, too.

        Raises:
            ValueError: another type or shape, a number that is not finite, a quaternion that is not of length 1, or a
                temperature below absolute zero.

        Warns if a state seems to be in other units, see `inspection.model.state_checks`.
        """
        given = FilterInput(x, desired, self.c)
        given.warn()
        return given.answer(self.correct(given.x, given.desired))

    @in_full_precision
    def correct(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters one control per spacecraft without checking its input.

        A state with NaN or infinity has status UNSOLVED and zero control.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, float64, perhaps beyond the actuators' limits. Thrust or torque that
                contains NaN counts as zero, and is filtered.
        """
        check_tensors(x=x, desired=desired)
        with torch.no_grad():
            return self.answer(x, desired)

    def answer(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Proposes, checks and commits: the order of a call."""
        x = call(known, x)
        asked = call(demanded, desired, list(self.c.control_limit))
        if self.parameters.filter == "paper":
            return differing(self.program.correct(x, asked), desired)
        return self.committed(x, desired, self.proposed(x, asked))

    def committed(self, y: Tensor, desired: Tensor, proposed: FilterResult) -> FilterResult:
        """Returns the applied control for a proposal at states y (n, B) as the check knows them."""
        return self.check.commit(y, desired, proposed) if self.check else differing(proposed, desired)

    def proposed(self, x: Tensor, asked: Tensor) -> FilterResult:
        """Returns the program's proposal for a hold, given the desired controls `asked` (6, B)."""
        hold, inertia, rate = self.longest_hold, self.c.inertia, self.largest_rate
        most = x.new_tensor(self.c.control_limit)[:, None]
        asked = call(within_rates, x, asked, hold, inertia, rate)
        middle = call(in_mid_hold, x, asked.maximum(-most).minimum(most), hold, inertia)
        found = self.program.correct(middle, asked)
        held = call(within_rates, x, found.control, hold, inertia, rate)
        lost = found.status == Status.UNSOLVED
        found.control = torch.where(lost, 0.0, held.maximum(-most).minimum(most))
        found.h = call(self.program.values, x, long=if_long(len(self.c.planes)), name="limit_values")
        return found


def differing(result: FilterResult, desired: Tensor) -> FilterResult:
    """Marks an answer as intervened where its control differs from the desired one, for example from NaN."""
    result.intervened = (result.control != desired).any(0)
    result.status = torch.where(result.intervened, result.status.clamp(min=Status.HARD), result.status)
    return result
