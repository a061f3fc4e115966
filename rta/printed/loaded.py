"""The filter in C as it is exported, called column by column in the place of `SafetyFilter.correct`."""

from typing import TYPE_CHECKING

from torch import Tensor

from kernels.build import library
from rta.printed.batch import Columns, by_column
from rta.printed.files import sources
from rta.printed.source import driver_text

if TYPE_CHECKING:
    from rta.filter import SafetyFilter
from rta.result import FilterResult

SECONDS = 1e-5  # of a call, about


class InC:
    """`correct` of a filter by the C that `rta.printed.files` writes, for batches on a CPU.

    Raises NoCompilerError where there is no working C compiler.
    """

    def __init__(self, safety_filter: "SafetyFilter") -> None:
        texts = sources(safety_filter, only=("safety_filter.h", "safety_filter.c"))
        head = texts["safety_filter.h"]
        source = texts["safety_filter.c"].replace('#include "safety_filter.h"\n', head)
        loop = ["#include <math.h>", head, by_column(safety_filter), driver_text("batch/alone.c")]
        found = library({"filter": source, "columns": "\n".join(loop)})
        self.columns = Columns(found, safety_filter, SECONDS)

    def correct(
        self, x: Tensor, desired: Tensor, sent: Tensor | None = None, left: Tensor | None = None
    ) -> "FilterResult":
        """As `SafetyFilter.correct`."""
        from rta.result import FilterResult

        room = self.columns.latency
        if sent is not None and len(sent) > room:
            raise ValueError(f"{len(sent)} controls sent: the C was exported for {room}")
        answer, _ = self.columns(x, desired, sent, left)
        return FilterResult(*answer)
