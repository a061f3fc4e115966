"""Counter-examples: the worst episode of a violated constraint in a file, and its repetition."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Hold
from inspection.model.attitude import unit
from inspection.model.state import P
from inspection.world.corners import Recorded
from rta.names import CONSTRAINTS
from rta.result import FilterResult
from settings import override, to_toml
from study.config import Config, recorded
from study.errors import MALFORMED, ReflyError, as_input_error
from study.experiment import Experiment, check_clocks
from study.files import load_arrays
from study.flight.fly import Observer, Record, Starts, fly
from study.verification.tape import Tape

# A repetition flies the recorded controls, so only the plant's rounding differs: compiled or not, on a CPU or a GPU.
AGREES = 1e-8  # relative to the value, or absolute in the unit of h


def counter_example(
    record: Record, tape: Tape, chosen: Tensor, constraint: str, config: Config, check_every: float
) -> dict[str, np.ndarray]:
    """Returns the worst episode for a constraint up to its worst moment, with all data that `refly_file` needs.

    Args:
        chosen: (B,) bool, the episodes to choose from; check_every: s between two checks of the flight.
    """
    row = CONSTRAINTS.index(constraint)
    k = int(torch.where(chosen, record.limits.worst[row], math.inf).argmin())
    calls = max(1, math.ceil(record.limits.when[row, k].item() / config.rta.period - 1e-9))
    corners = {"corners": tape.corners[:calls, :, k].cpu().numpy()} if tape.corners.shape[1] else {}
    return corners | {
        "state": record.starts.x[:, k].cpu().numpy(),
        "control_desired": tape.desired[:calls, :, k].cpu().numpy(),
        "control_applied": tape.applied[:calls, :, k].cpu().numpy(),
        "constraint": np.array(constraint),
        "value": record.limits.worst[row, k].cpu().numpy(),
        "period": np.array(config.rta.period),
        "check_every": np.array(check_every),
        "config": np.array(to_toml(config)),
        "number": np.array(0.0 if record.starts.number is None else record.starts.number[k].item()),
    }


class Asking(Observer):
    """Replaces a filter: applies recorded controls, and compares them with the answers of another filter.

    Attributes:
        difference: largest difference between answers and recorded controls, in units of the actuators' limits.
    """

    def __init__(
        self, correct: Callable[..., FilterResult], desired: Tensor, applied: Tensor, limit: Tensor
    ) -> None:
        self.correct, self.desired, self.applied, self.limit = correct, desired, applied, limit
        self.calls, self.difference = 0, 0.0

    def __call__(self, seen: Tensor, _: Tensor, **told: Tensor) -> FilterResult:
        answer = self.correct(seen, self.desired[self.calls], **told)
        applied = self.applied[self.calls]
        self.calls += 1
        self.last = ((answer.control - applied).abs() / self.limit).max().item()
        return replace(answer, control=applied)

    def hold(self, hold: Hold, running: Tensor) -> None:
        if hold.correction is not None and not (hold.missed is not None and hold.missed.any()):
            self.difference = max(self.difference, self.last)


@torch.no_grad()
def refly(experiment: Experiment, example: dict[str, np.ndarray]) -> tuple[float, float, float]:
    """Flies the example's applied controls from its state, and asks the filter for each of them again.

    If the active rows alternate from call to call, the closed loop amplifies the rounding differences of another batch
    size or of compiled code: by 20 per call at 10 s. The flight under recorded controls does not amplify them.

    Args:
        experiment: without the filter in its loop.

    Returns:
        The smallest value of the example's constraint, its time in s, and the largest difference of the filter's
        controls from the recorded ones, in units of the actuators' limits.
    """
    period = experiment.filter.period
    names = ("state", "control_desired", "control_applied")
    x, desired, applied = (torch.from_numpy(example[name]).to(experiment.device)[..., None] for name in names)
    asking = Asking(
        experiment.filter.correct, desired, applied, x.new_tensor(experiment.task.control_limit)[:, None]
    )
    safety = replace(experiment.safety, correct=asking, period=period)
    env = experiment.env(1, None, period, float(example["check_every"]), safety=safety)
    if env.plant and env.plant.is_worst:
        corners = torch.from_numpy(example["corners"])[..., None].to(env.x.device)
        env.plant.adversary = Recorded(corners, period)
    number = torch.as_tensor(example.get("number", 0.0)).reshape(1).to(x)
    starts, duration = Starts(x, unit(x[P]), number), len(applied) * period
    limits = fly(env, lambda t, x: desired[round(t / period)], starts, duration, [asking]).limits
    row = env.safety.names.index(str(example["constraint"]))
    return limits.worst[row].item(), limits.when[row].item(), asking.difference


def refly_file(path: str) -> str:
    """Flies the counter-example in a file, with the filter that the file describes, and returns the outcome as text.

    Raises:
        InputError: the file is not a counter-example.
        ReflyError: the constraint falls to another value than the recorded one, by more than AGREES.
    """
    names = (
        "state",
        "control_desired",
        "control_applied",
        "constraint",
        "value",
        "period",
        "check_every",
        "config",
    )
    example = load_arrays(path, names, "counter-example", where_missing="")
    with as_input_error(f"{path}: not a counter-example of verify", *MALFORMED):
        # any machine can repeat the flight: the filter is called beside the loop
        beside = {"train": {"rta": False, "device": "cpu"}, "rta": {"period": float(example["period"])}}
        config = override(recorded(str(example["config"]), path, Config()), beside, path)
        check_clocks(config, config.rta.period, float(example["check_every"]), where=path)
        if not config.plant.is_nominal:
            more = ("number", "corners") if config.plant.errors == "worst" else ("number",)
            example |= load_arrays(path, more, "counter-example", where_missing="")
        value, when, difference = refly(Experiment(config, 1), example)
        was = float(example["value"])
    outcome = (
        f"{path}: {example['constraint']} falls to {value:.12g} at {when:g} s; recorded {was:.12g}; "
        f"the filter's controls differ by at most {difference:.1e} of their limits"
    )
    if not math.isclose(value, was, rel_tol=AGREES, abs_tol=AGREES):
        raise ReflyError(f"{outcome}: not what was recorded")
    return outcome
