"""The task: a deputy spacecraft inspects a passive chief, thousands of episodes as one batch of tensors.

`InspectionEnv` plays it, with the constants of `InspectionParameters` and, if there is one, a filter (`Safety`). Who
flies alone takes `sample_initial_state` and `step`, the motion of a second or so. A state's components are found by
their names: x[P] is the position, x[Q] the attitude, see `inspection.model.state`; `rotate(x[Q], v)` turns a vector
from body axes to Hill's frame, `rotate(conjugate(x[Q]), v)` back.
"""

from typing import TYPE_CHECKING

from on_demand import on_demand

if TYPE_CHECKING:
    from inspection.closed_loop import Correction, Safety
    from inspection.environment import InspectionEnv
    from inspection.initial_state import sample_initial_state
    from inspection.model.attitude import conjugate, rotate, unit
    from inspection.model.dynamics import step
    from inspection.model.parameters import InspectionParameters
    from inspection.model.state import OMEGA, THETA_S, THRUST, TORQUE, E, P, Q, T, V
    from inspection.transition import Transition

__all__ = [
    "OMEGA",
    "THETA_S",
    "THRUST",
    "TORQUE",
    "Correction",
    "E",
    "InspectionEnv",
    "InspectionParameters",
    "P",
    "Q",
    "Safety",
    "T",
    "Transition",
    "V",
    "conjugate",
    "rotate",
    "sample_initial_state",
    "step",
    "unit",
]

__getattr__ = on_demand(
    __name__,
    {
        "Correction": "inspection.closed_loop.Correction",
        "Safety": "inspection.closed_loop.Safety",
        "InspectionEnv": "inspection.environment.InspectionEnv",
        "sample_initial_state": "inspection.initial_state.sample_initial_state",
        "conjugate": "inspection.model.attitude.conjugate",
        "rotate": "inspection.model.attitude.rotate",
        "unit": "inspection.model.attitude.unit",
        "step": "inspection.model.dynamics.step",
        "InspectionParameters": "inspection.model.parameters.InspectionParameters",
        "OMEGA": "inspection.model.state.OMEGA",
        "THETA_S": "inspection.model.state.THETA_S",
        "THRUST": "inspection.model.state.THRUST",
        "TORQUE": "inspection.model.state.TORQUE",
        "E": "inspection.model.state.E",
        "P": "inspection.model.state.P",
        "Q": "inspection.model.state.Q",
        "T": "inspection.model.state.T",
        "V": "inspection.model.state.V",
        "Transition": "inspection.transition.Transition",
    },
)
