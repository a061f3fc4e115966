"""Counter-examples: the worst episode of a violated constraint in a file, and flying it again."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Smallest
from inspection.model.attitude import unit
from inspection.model.state import SIZE, P
from inspection.world.corners import Recorded
from rta.constraints.names import CONSTRAINTS
from rta.result import FilterResult
from settings import from_toml, override, to_toml
from study.config import Config
from study.errors import MALFORMED, ReflyError, refusing
from study.experiment import Experiment, check_clocks
from study.files import load_arrays
from study.machine.progress import bar
from study.verification.flight import Flight

# Flying again flies the recorded controls, so only the plant's rounding differs: compiled or not, on a CPU or a GPU.
AGREES = 1e-8  # relative to the value or to 1 in the unit of h


def counter_example(
    flight: Flight, constraint: str, config: Config, check_every: float
) -> dict[str, np.ndarray]:
    """The flight's worst episode for a constraint, up to its worst moment: all that `refly_file` needs.

    Args:
        check_every: s between two checks of the flight.
    """
    row = CONSTRAINTS.index(constraint)
    k = int(flight.worst[row].argmin())
    calls = max(1, math.ceil(flight.when[row, k].item() / config.rta.period - 1e-9))
    corners = {"corners": flight.corners[:calls, :, k].cpu().numpy()} if flight.corners.shape[1] else {}
    return corners | {
        "state": flight.start[:SIZE, k].cpu().numpy(),
        "control_desired": flight.desired[:calls, :, k].cpu().numpy(),
        "control_applied": flight.applied[:calls, :, k].cpu().numpy(),
        "constraint": np.array(constraint),
        "value": flight.worst[row, k].cpu().numpy(),
        "period": np.array(config.rta.period),
        "check_every": np.array(check_every),
        "config": np.array(to_toml(config)),
        "number": flight.number[k].cpu().numpy(),
    }


@torch.no_grad()
def refly(experiment: Experiment, example: dict[str, np.ndarray]) -> tuple[float, float, float]:
    """Flies the example's applied controls from its state, and asks the filter for each of them again.

    Where rows change places from call to call, the closed loop multiplies the rounding of another batch size or of
    compiled code: by 20 per call at 10 s. The flight under the recorded controls does not.

    Args:
        experiment: without the filter in its loop.

    Returns:
        The smallest value of the example's constraint, when in s, and by how much the filter's controls now
        differ at most, in units of the actuators' limits.
    """
    safety_filter, period = experiment.filter, experiment.filter.period
    env = experiment.env(1, None, period, float(example["check_every"]))
    x, desired, applied = (
        torch.from_numpy(example[name]).to(env.x)[..., None]
        for name in ("state", "control_desired", "control_applied")
    )
    if env.plant and env.plant.is_worst:
        corners = torch.from_numpy(example["corners"])[..., None].to(env.x.device)
        env.plant.adversary = Recorded(corners, period)
    row = env.safety.names.index(str(example["constraint"]))
    again: list[Tensor] = []

    def correct(seen: Tensor, _: Tensor, **told: Tensor) -> FilterResult:
        """Flies what was flown then, and asks the filter."""
        i = len(again)
        answer = safety_filter.correct(seen, desired[i], **told)
        again.append(answer.control)
        return replace(answer, control=applied[i])

    env.put_behind(replace(env.safety, correct=correct, period=period))
    env.start(x, unit(x[P]), torch.as_tensor(example.get("number", 0.0)).reshape(1).to(x))
    smallest, difference = Smallest(len(env.safety.names), x), 0.0
    smallest.note(env.constraint_values(x))
    duration = len(applied) * period
    holds = env.fly(lambda t, x: desired[round(t / period)], duration)
    for hold in bar(env.clocks.count(duration), "checks", iterable=holds, leave=False):
        if hold.correction is not None and not (hold.missed is not None and hold.missed.any()):
            difference = max(difference, ((again[-1] - hold.applied).abs() / env.limit).max().item())
        smallest.note(env.constraint_values(hold.after), hold.end)
    return smallest.value[row].item(), smallest.when[row].item(), difference


def refly_file(path: str) -> str:
    """Flies the counter-example in a file, with the filter that the file describes, and says what came of it.

    Raises:
        InputError: not such a file.
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
    with refusing(f"{path}: not a counter-example of verify", *MALFORMED, LookupError, ArithmeticError):
        # any machine can fly it: the filter is asked beside the loop
        beside = {"train": {"rta": False, "device": "cpu"}, "rta": {"period": float(example["period"])}}
        config = override(from_toml(str(example["config"]), path, Config()), beside, path)
        check_clocks(config, config.rta.period, float(example["check_every"]), where=path)
        if not config.plant.is_nominal:
            more = ("number", "corners") if config.plant.errors == "worst" else ("number",)
            example |= load_arrays(path, more, "counter-example", where_missing="")
        value, when, difference = refly(Experiment(config, 1), example)
        recorded = float(example["value"])
    outcome = (
        f"{path}: {example['constraint']} falls to {value:.12g} at {when:g} s; recorded {recorded:.12g}; "
        f"the filter's controls differ by at most {difference:.1e} of their limits"
    )
    if not math.isclose(value, recorded, rel_tol=AGREES, abs_tol=AGREES):
        raise ReflyError(f"{outcome}: not what was recorded")
    return outcome
