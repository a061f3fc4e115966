"""The vector environment for Stable-Baselines3, which has a vector interface of its own."""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from interfaces.vector import VectorInspection6DoF


class StableBaselinesEnv(VecEnv):
    """A `VectorInspection6DoF`, wrapped or not, as Stable-Baselines3 wants it.

    Both begin an ended episode anew in the same step. An info is empty but for the steps that end an episode: these
    have terminal_observation, TimeLimit.truncated, and episode with the return r and the steps l. The episodes
    share one simulator, so its attributes and methods are those of all, whatever `indices` says.

    Raises:
        TypeError: another environment. ValueError: it returns tensors.
    """

    def __init__(self, env: VectorEnv) -> None:
        if not isinstance(env.unwrapped, VectorInspection6DoF):
            raise TypeError(f"{type(env.unwrapped).__name__}: must be a VectorInspection6DoF")
        if env.unwrapped.tensors:
            raise ValueError(
                "tensors=True: Stable-Baselines3 takes NumPy arrays, make the environment without it"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Starts every episode anew, after `seed` from its seed; returns observations (B, 26)."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps actions (B, 6) for `step_wait`."""
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations (B, 26), rewards (B,), done (B,) and one info per episode."""
        observation, reward, terminated, truncated, info = self.env.step(self.actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in done]
        for i in np.flatnonzero(done):
            episode = info["final_info"]["episode"]
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {"r": float(episode["r"][i]), "l": int(episode["l"][i])},
            }
        return observation, reward, done, infos

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, once per episode."""
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the environment."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Calls a method of the environment once; returns its result once per episode."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Whether Gymnasium's wrapper for single environments is around each episode: never."""
        return [False] * self.num_envs
