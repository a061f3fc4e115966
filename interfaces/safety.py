"""The filter as a wrapper: it corrects the controls within each step, and reports every call in `info`."""

from dataclasses import replace
from typing import Any

import gymnasium
import torch
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import Tensor

from interfaces.environment import Inspection6DoF
from interfaces.vector import VectorInspection6DoF, in_kind
from rta.filter import SafetyFilter
from rta.result import FilterResult
from settings import override
from study.experiment import Experiment


class VectorRunTimeAssurance(VectorWrapper):
    """Puts the filter between actions and actuators; `reset` must follow.

    The filter is called every `period` s of the action period, and its last control is its next desired one. So it
    works inside the wrapped environment. `step` adds to the environment's info, per episode and call,

        u_des, u_safe: (B, calls, 6), desired and safe control in N and N m; the safe control is applied, unless [plant]
            misses the call,
        intervened: (B, calls) bool, whether u_safe differs from u_des,
        backup: (B, calls) bool, whether the check replaced the program's control, which could not be verified,
        verified: (B, calls) bool, whether u_safe keeps every limit in the model, see `rta.result.FilterResult`,
        active: (B, calls, constraints) bool, whether the barrier condition is active at the program's control,
        status: (B, calls), `rta.result.Status`.

    Args:
        env: a `VectorInspection6DoF`, wrapped or not.
        period: s between two calls, 1, 5 or 10; None takes the configuration's.

    Raises:
        TypeError: another environment. InputError: another period. ValueError: there is a filter already.
    """

    def __init__(self, env: VectorEnv, period: float | None = None) -> None:
        super().__init__(env)
        base = env.unwrapped
        if not isinstance(base, VectorInspection6DoF):
            raise TypeError(f"{type(base).__name__}: must be a VectorInspection6DoF")
        if base.experiment.safety.correct:
            raise ValueError("the environment is behind a filter already")
        own = {"train": {"rta": True}, "rta": {} if period is None else {"period": period}}
        config = override(base.config, own, "RunTimeAssurance")
        experiment = Experiment(config, base.num_envs)
        self._filter = experiment.filter
        self.calls: list[tuple[Tensor, FilterResult]] = []
        experiment.safety = replace(experiment.safety, correct=self.correct)
        base.begin(experiment)

    @property
    def filter(self) -> SafetyFilter:
        """Returns the filter, which cannot be changed: initial states and limits depend on it."""
        return self._filter

    def correct(self, x: Tensor, desired: Tensor, **told: Tensor) -> FilterResult:
        """Calls the filter and records its desired controls and answers."""
        self.calls.append((desired, self.filter.correct(x, desired, **told)))
        return self.calls[-1][1]

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps as `VectorInspection6DoF.step`, with the filter's report in the info."""
        self.calls.clear()
        *rest, info = self.env.step(actions)
        report = in_kind(self.report(), torch.is_tensor(actions))
        info |= report
        if "final_info" in info:
            info["final_info"] |= report
        return *rest, info

    def report(self) -> dict[str, Tensor]:
        """Returns desired controls and answers of the calls of the last step."""
        desired, results = zip(*self.calls, strict=True)
        parts = {"u_des": desired, "u_safe": [result.control for result in results]}
        for name in ("intervened", "backup", "verified", "active", "status"):
            parts[name] = [getattr(result, name) for result in results]
        return {name: torch.stack(list(part)).movedim(-1, 0) for name, part in parts.items()}


class RunTimeAssurance(gymnasium.Wrapper, RecordConstructorArgs):
    """Puts the filter around an `Inspection6DoF`, as `VectorRunTimeAssurance`; its info has no axis B."""

    def __init__(self, env: gymnasium.Env, period: float | None = None) -> None:
        RecordConstructorArgs.__init__(self, period=period)
        gymnasium.Wrapper.__init__(self, env)
        base = env.unwrapped
        if not isinstance(base, Inspection6DoF):
            raise TypeError(f"{type(base).__name__}: must be an Inspection6DoF")
        base.batch = VectorRunTimeAssurance(base.batch, period)
        base.running = False
