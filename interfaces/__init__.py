"""The task for other learners: importing this package registers Inspection6DoF-v0 with Gymnasium.

`VectorInspection6DoF` is the batch of episodes, `Inspection6DoF` one episode. `VectorRunTimeAssurance` and
`RunTimeAssurance` put the filter between actions and actuators. For Stable-Baselines3 there is
`interfaces.stable_baselines`.
"""

try:
    import gymnasium
except ModuleNotFoundError as error:
    if error.name != "gymnasium":
        raise
    raise ImportError("interfaces needs Gymnasium: pip install gymnasium") from None

from interfaces.environment import Inspection6DoF
from interfaces.safety import RunTimeAssurance, VectorRunTimeAssurance
from interfaces.vector import ID, VectorInspection6DoF

__all__ = ["Inspection6DoF", "RunTimeAssurance", "VectorInspection6DoF", "VectorRunTimeAssurance"]

gymnasium.register(
    ID,
    entry_point="interfaces.environment:Inspection6DoF",
    vector_entry_point="interfaces.vector:VectorInspection6DoF",
)
