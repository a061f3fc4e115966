"""What a filter of ours answers in flight, in full: the task knows of an answer only what a `Correction` has."""

from inspection.closed_loop import Correction
from rta.result import FilterResult


def in_full(correction: Correction | None) -> FilterResult:
    """The whole answer; TypeError where there is none, or one of another filter, which does not say as much."""
    if not isinstance(correction, FilterResult):
        raise TypeError(f"{type(correction).__name__}: must be a FilterResult")
    return correction
