"""The vector environment for Stable-Baselines3, which has a vector interface of its own."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from stable_baselines3.common.vec_env import VecEnv

from interfaces.options import MASK, STARTS, check_names
from interfaces.vector import VectorInspection6DoF
from settings import InputError

Indices = int | Iterable[int] | None


class StableBaselinesEnv(VecEnv):
    """Wraps a `VectorInspection6DoF`, wrapped or not, for Stable-Baselines3.

    Both restart an ended episode in the same step. An info is that of the environment for one episode, with arrays
    without the axis B. In steps that end an episode it also holds terminal_observation, TimeLimit.truncated, and
    episode with the return r and the steps l. The episodes share one simulator, so its attributes and methods are those
    of all episodes, and `indices` only give the number of answers.

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
        """Restarts every episode, after `seed` from its seed; returns observations (B, 26).

        After `set_options`, each episode begins from its own state (16,) and priority (3,), if its dictionary has
        these.

        Raises:
            InputError: other options, or wrong ones.
        """
        given = self.starts()
        observation, _ = self.env.reset(seed=self._seeds[0])
        for options in given:
            observation, _ = self.env.reset(options=options)
        self._reset_seeds()
        self._reset_options()
        return observation

    def starts(self) -> list[dict[str, np.ndarray]]:
        """Returns the options from `set_options` as options of the environment's `reset`, one for each set of names."""
        if len(self._options) != self.num_envs:
            raise InputError(f"set_options: {len(self._options)} of them: must be one, or {self.num_envs}")
        groups: dict[frozenset[str], dict[str, np.ndarray]] = {}
        for i, each in enumerate(self._options):
            check_names(each, STARTS)
            own = groups.setdefault(frozenset(each), {MASK: np.zeros(self.num_envs, dtype=np.bool_)})
            own[MASK][i] = True
            for name, value in each.items():
                if np.shape(value) != (STARTS[name],):
                    raise InputError(
                        f"set_options: {name} of episode {i} has shape {np.shape(value)}: must be ({STARTS[name]},)"
                    )
                own.setdefault(name, np.zeros((self.num_envs, STARTS[name])))[i] = value
        return [own for names, own in groups.items() if names]

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps actions (B, 6) for `step_wait`."""
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Returns observations (B, 26), rewards (B,), done (B,) and one info per episode."""
        observation, reward, terminated, truncated, info = self.env.step(self.actions)
        done = terminated | truncated
        # entries with a mask `_name` belong only to episodes that end; `final_info` holds them
        masked = {name[1:] for name in info if name.startswith("_")}
        infos = by_episode(
            {name: part for name, part in info.items() if name[0] != "_" and name not in masked}
        )
        for i in np.flatnonzero(done):
            episode = info["final_info"]["episode"]
            infos[i] |= {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {"r": float(episode["r"][i]), "l": int(episode["l"][i])},
            }
        return observation, reward, done, infos

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of the environment or of a wrapper, once per requested episode."""
        return [getattr(self.owner(attr_name), attr_name)] * self.count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute for all episodes; raises ValueError if `indices` leave some out."""
        if self.count(indices) != self.num_envs:
            raise ValueError(
                f"set_attr {attr_name!r}: the episodes share it: indices must be None, or all of them"
            )
        setattr(self.owner(attr_name), attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any) -> list[Any]:
        """Calls a method of the environment or of a wrapper once; returns its result once per requested episode."""
        count = self.count(indices)
        return [getattr(self.owner(method_name), method_name)(*args, **kwargs)] * count

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Returns whether a wrapper of this class is around the environment, once per requested episode."""
        found = any(isinstance(each, wrapper_class) for each in self.layers()[:-1])
        return [found] * self.count(indices)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns None per episode, since nothing is rendered."""
        return [None] * self.num_envs

    def count(self, indices: Indices) -> int:
        """Returns the number of requested episodes; raises IndexError if one does not exist."""
        return len([range(self.num_envs)[i] for i in self._get_indices(indices)])

    def layers(self) -> list[VectorEnv]:
        """Returns the wrappers and the environment in them, the outermost first."""
        layers = [self.env]
        while isinstance(layers[-1], VectorWrapper):
            layers.append(layers[-1].env)
        return layers

    def owner(self, name: str) -> VectorEnv:
        """Returns the outermost layer that has an attribute, or the environment if none has."""
        return next((each for each in self.layers() if hasattr(each, name)), self.env.unwrapped)


def by_episode(value: Any) -> list[Any]:
    """Returns an array (B, ...), or a dictionary of arrays, as one per episode; numbers as Python's."""
    if isinstance(value, dict):
        parts = zip(*map(by_episode, value.values()), strict=True)
        return [dict(zip(value, own, strict=True)) for own in parts]
    return value.tolist() if value.ndim == 1 else list(value)
