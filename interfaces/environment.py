"""One episode at a time as a Gymnasium environment."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from interfaces.options import STARTS, check_names
from interfaces.vector import VectorInspection6DoF
from study.config import Config


class Inspection6DoF(gymnasium.Env):
    """Wraps a `VectorInspection6DoF` of one episode; arguments and errors are the same.

    Attributes:
        batch: this vector environment, or a wrapper around it.
    """

    metadata = gymnasium.Env.metadata | {
        name: value for name, value in VectorInspection6DoF.metadata.items() if name != "autoreset_mode"
    }

    def __init__(
        self, config: Config | str | Path | None = None, device: str = "cpu", compile: bool = False
    ) -> None:
        self.batch: VectorEnv = VectorInspection6DoF(1, config, device, compile)
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; returns its observation (26,) float32 and an empty info.

        Args:
            options: state (16,) and priority (3,), as for the vector environment.

        Raises:
            InputError: as in the vector environment.
        """
        check_names({} if options is None else options, STARTS)
        observation, info = self.batch.reset(seed=seed, options=options)
        super().reset(seed=seed)
        self.running = True
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds an action (6,) for one action period; returns and raises what the vector environment does.

        Raises:
            ResetNeeded: no episode is running.
        """
        if not self.running:
            raise gymnasium.error.ResetNeeded("Inspection6DoF-v0: call reset() to begin an episode")
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        observation = info.get("final_obs", observation)
        own = {name: only(value) for name, value in info.items() if "final_" not in name}
        self.running = not (terminated[0] or truncated[0])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), own


def only(value: Any) -> Any:
    """Returns the single column of an array, or of each array of a dictionary."""
    return {name: only(part) for name, part in value.items()} if isinstance(value, dict) else value[0]
