"""Run time assurance: a filter of control barrier functions that corrects every unsafe command.

    result = SafetyFilter()(state, desired)

`SafetyFilter` takes the task's constants and `RtaParameters` (period, gains, margins), each `Constraint` of your own,
and `Uncertainty`, what it is told about the world's bounds; it answers with a `FilterResult`, whose `Status` says how
its control came about.
"""

from typing import TYPE_CHECKING

from on_demand import on_demand

if TYPE_CHECKING:
    from rta.bounds.uncertainty import Uncertainty
    from rta.constraints.constraint import Constraint
    from rta.filter import SafetyFilter
    from rta.parameters import RtaParameters
    from rta.qp.programs import Status
    from rta.result import FilterResult

__all__ = ["Constraint", "FilterResult", "RtaParameters", "SafetyFilter", "Status", "Uncertainty"]

__getattr__ = on_demand(
    __name__,
    {
        "Uncertainty": "rta.bounds.uncertainty.Uncertainty",
        "Constraint": "rta.constraints.constraint.Constraint",
        "SafetyFilter": "rta.filter.SafetyFilter",
        "RtaParameters": "rta.parameters.RtaParameters",
        "Status": "rta.qp.programs.Status",
        "FilterResult": "rta.result.FilterResult",
    },
)
