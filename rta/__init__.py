"""Run time assurance: a filter of control barrier functions that corrects every unsafe command.

    result = SafetyFilter()(state, desired)

`SafetyFilter` takes the task's constants and `RtaParameters` (period, gains, margins), and each `Constraint` of your
own; it answers with a `FilterResult`, whose `Status` says how its control came about.
"""

from rta.constraints import Constraint
from rta.filter import FilterResult, SafetyFilter
from rta.parameters import RtaParameters
from rta.qp import Status

__all__ = ["Constraint", "FilterResult", "RtaParameters", "SafetyFilter", "Status"]
