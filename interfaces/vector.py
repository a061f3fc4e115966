"""The batch of episodes as a Gymnasium vector environment."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE
from inspection.observation import components
from inspection.termination import OUTCOMES
from inspection.transition import METRICS, Transition
from interfaces.options import read
from rta.names import CONSTRAINTS
from settings import InputError, load, override, typed
from study.config import Config
from study.errors import as_input_error
from study.experiment import Experiment

ID = "Inspection6DoF-v0"
LARGEST = float(np.finfo(np.float32).max)  # stands for no limit, since Gymnasium warns of infinite limits


class VectorInspection6DoF(VectorEnv):
    """Runs num_envs episodes as one `InspectionEnv`; there is no filter unless `VectorRunTimeAssurance` adds one.

    Args:
        num_envs: episodes at once, B.
        config: a configuration or a TOML file, by its path or the name of a shipped one, of which [inspection],
            [chief], [plant] and [rta] count; None means the defaults.
        device: cpu, cuda or auto.
        compile: compile the simulator at the first `reset`, and the filter if there is one; this takes seconds the
            first time.
        tensors: `reset` returns tensors on the device; `step` answers in the kind of its actions.
        max_episode_steps: after which an episode is truncated as by the configuration's max_time, if this is not
            reached before; None or -1: by max_time alone.

    Attributes:
        experiment: the task, plant and filter; simulator: the episodes.

    Raises:
        InputError: an option or the configuration is wrong.
    """

    metadata = VectorEnv.metadata | {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "constraints": CONSTRAINTS,
        "outcomes": OUTCOMES,
    }

    def __init__(
        self,
        num_envs: int = 1,
        config: Config | str | Path | None = None,
        device: str = "cpu",
        compile: bool = False,
        tensors: bool = False,
        max_episode_steps: int | None = None,
    ) -> None:
        base = config if isinstance(config, Config) else load(str(config), Config()) if config else Config()
        compiled = typed(compile, bool, f"{ID}: compile")
        here = {"num_envs": num_envs, "device": device, "rta": False, "compile": "on" if compiled else "off"}
        end = {"max_time": end_of(max_episode_steps, base.inspection)}
        config = override(base, {"train": here, "inspection": end}, ID)
        self.tensors = typed(tensors, bool, f"{ID}: tensors")
        self.num_envs = num_envs
        size = len(components(config.inspection))
        self.single_observation_space = spaces.Box(-LARGEST, LARGEST, (size,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (CONTROL_SIZE,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.config = config  # as given, `auto` not resolved
        self.begin(Experiment(config, num_envs))

    def begin(self, experiment: Experiment) -> None:
        """Discards the simulator, so that a new one is made for an experiment; `reset` must follow."""
        self.experiment = experiment
        self.started = False
        vars(self).pop("simulator", None)

    @cached_property
    def simulator(self) -> InspectionEnv:
        """Returns the simulator, made at first use: compiling takes long, and the filter must be set before."""
        return self.experiment.env(self.num_envs, compiled=self.experiment.compiled)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Restarts episodes; without a seed the draws continue, at first from a random seed.

        Args:
            options: reset_mask (B,) bool: only these episodes restart, and the others continue; state (16,) or (B, 16)
                and priority (3,) or (B, 3), a unit vector: their initial values, one for all or row by row. Other
                values are drawn. A given state need not be accepted by the filter, and may violate limits.

        Returns:
            Observations (B, 26) float32 of all episodes and an empty info.

        Raises:
            InputError: an option is wrong, no initial state satisfies the constraints, or the memory is too small for
                so many episodes. ResetNeeded: some episodes are to continue, and none has begun.
        """
        given = read(options, self.num_envs, self.experiment.task)
        if not self.started and not given["mask"].all():
            raise gymnasium.error.ResetNeeded(f"{ID}: call reset() without reset_mask first")
        super().reset(seed=seed)
        if seed is None and not self.started:
            seed = self.np_random_seed
        if seed is not None:
            for starts in self.simulator.starts:
                starts.seed(seed % 2**63)  # a random seed of NumPy has 128 bits
        with as_input_error("[inspection]", RuntimeError):  # no start within the constraints
            device = self.experiment.device
            observation = self.simulator.reset(**{name: each.to(device) for name, each in given.items()})
        self.started = True
        return in_kind(observation, self.tensors), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Holds one action for one action period (10 s); episodes that end restart at once.

        Args:
            actions: (B, 6) array or tensor, thrust and torque in units of the actuators' limits; clipped to [-1, 1].

        Returns:
            Observations (B, 26) float32, rewards (B,), terminated and truncated (B,) bool, and an info about the step:
            reward_terms by name (B,); at its end violated (B, constraints) bool, cost (B,) float32, 1 where any limit
            is violated and else 0, and h by name (B,), the constraints' values, negative where violated; outcome (B,),
            index into OUTCOMES or -1; metrics of the episode so far by name (B,). Where an episode ended, info also has
            final_obs (B, 26) and final_info, the same entries and `episode` with return r and steps l; their masks (B,)
            are _final_obs, _final_info and _episode.

        Raises:
            ResetNeeded: `reset` was not called. ValueError: wrong shape, or actions that are not finite.
        """
        if not self.started:
            raise gymnasium.error.ResetNeeded(f"{ID}: call reset() before step()")
        tensors = torch.is_tensor(actions)
        given = actions.detach() if tensors else torch.from_numpy(np.array(actions, dtype=np.float64))
        if not given.isfinite().all():
            raise ValueError("actions contain NaN or infinity: must be finite")
        transition = self.simulator.step(given.to(self.experiment.device))
        info = about(transition, self.experiment.safety.names)
        done = transition.done
        if done.any():
            episode = {"r": info["metrics"]["reward"], "l": transition.steps}
            final_info = info | {"episode": episode, "_episode": done}
            info |= {"final_info": final_info, "_final_info": done}
            info |= {"final_obs": transition.final_observation, "_final_obs": done}
        answer = transition.observation, transition.reward, transition.terminated, transition.truncated, info
        return tuple(in_kind(part, tensors) for part in answer)


def end_of(max_episode_steps: int | None, c: InspectionParameters) -> float:
    """Returns the time in s at which an episode is truncated; raises InputError if the steps are not allowed."""
    if max_episode_steps in (None, -1):
        return c.max_time
    if (steps := typed(max_episode_steps, int, f"{ID}: max_episode_steps")) < 1:
        raise InputError(
            f"{ID}: max_episode_steps = {steps}: must be positive, or -1 for no limit but max_time"
        )
    return min(c.max_time, (steps - 0.5) * c.action_period)  # within the last step, since times are rounded


def about(transition: Transition, constraints: Sequence[str]) -> dict[str, Any]:
    """Returns the step's info, tensors with the batch first."""
    return {
        "reward_terms": transition.reward_terms,
        "cost": transition.violated.any(0).float(),
        "violated": transition.violated.T,
        "h": dict(zip(constraints, transition.h, strict=True)),
        "outcome": transition.outcome,
        "metrics": dict(zip(METRICS, transition.metrics, strict=True)),
    }


def in_kind(value: Any, tensors: bool) -> Any:
    """Returns a tensor, or each tensor of a dictionary, as it is or as a NumPy array."""
    if isinstance(value, dict):
        return {name: in_kind(part, tensors) for name, part in value.items()}
    return value if tensors else value.cpu().numpy()
