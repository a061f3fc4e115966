"""The filter in C as it is exported, called column by column in the place of `SafetyFilter.correct`."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.state import CONTROL_SIZE
from kernels import library
from kernels.compiled import in_shares, pointers, strided
from rta.export_files import driver_text, sources
from rta.qp import Status

if TYPE_CHECKING:
    from rta.filter import FilterResult, SafetyFilter

REALS = {"c": "double", "c-float": "float"}
SECONDS = 1e-5  # of a call, about


class InC:
    """`correct` of a filter by the C that `rta.export_files` writes, for batches on a CPU.

    Args:
        real: "double", or "float" for single precision.

    Raises NoCompilerError where there is no working C compiler.
    """

    def __init__(self, safety_filter: "SafetyFilter", real: str = "double") -> None:
        self.constraints, self.known = len(safety_filter.names), safety_filter.known
        texts = sources(safety_filter, real=real, only=("safety_filter.h", "safety_filter.c"))
        head = texts["safety_filter.h"]
        source = texts["safety_filter.c"].replace('#include "safety_filter.h"\n', head)
        loop = "\n".join(["#include <math.h>", head, driver_text("columns.c")])
        self.run = library({"filter": source, "columns": loop}).filter_columns
        self.run.restype = None

    def correct(
        self, x: Tensor, desired: Tensor, sent: Tensor | None = None, left: Tensor | None = None
    ) -> "FilterResult":
        """As `SafetyFilter.correct`."""
        from rta.filter import FilterResult

        columns = x.shape[1]
        room = self.known.latency
        old = x.new_full((room, CONTROL_SIZE, columns), torch.nan)
        if sent is not None and len(sent):
            if len(sent) > room:
                raise ValueError(f"{len(sent)} controls sent: the C was exported for {room}")
            old[room - len(sent) :] = sent
        left = torch.ones_like(desired) if left is None else left
        numbers = torch.empty(CONTROL_SIZE + 4 * self.constraints, columns, dtype=torch.float64)
        integers = torch.empty(2 + self.constraints, columns, dtype=torch.int32)
        given = [strided(x), strided(desired), strided(old.flatten(0, 1)), strided(left)]
        arguments = (*pointers(given), *pointers([numbers, integers]))
        if columns:
            in_shares(lambda first, last: self.run(first, last, *arguments), columns, SECONDS)
        control, slack, h, uncertainty, tightened = numbers.split([CONTROL_SIZE, *[self.constraints] * 4])
        program_status, active = integers[:2].long(), integers[2:] > 0
        status = program_status.amax(0)
        return FilterResult(
            control,
            status > Status.UNTOUCHED,
            active,
            slack,
            status,
            program_status,
            h,
            uncertainty,
            tightened,
        )
