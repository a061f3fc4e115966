"""Counter-examples: the worst episode of a violated constraint in a file, and flying it again."""

import math

import numpy as np
import torch

from inspection.environment import InspectionEnv
from inspection.state import SIZE
from rta.constraints import CONSTRAINTS
from study import experiment as build
from study.config import Config, from_toml
from study.errors import ReplayError, refusing
from study.flight.offline_filter import read_arrays
from study.verification.flight import Flight

# A replay flies the recorded controls, so only the plant's rounding differs: compiled or not, on a CPU or a GPU.
REPLAYED = 1e-8  # relative to the value or to 1 in the unit of h


def counter_example(flight: Flight, constraint: int, period: float, config: Config) -> dict[str, np.ndarray]:
    """The flight's worst episode for a constraint, up to its worst moment: all that `replay_file` needs."""
    k = int(flight.worst[constraint].argmin())
    steps = int(flight.when[constraint, k])
    return {
        "state": flight.start[:SIZE, k].cpu().numpy(),
        "control_desired": flight.desired[:steps, :, k].cpu().numpy(),
        "control_applied": flight.applied[:steps, :, k].cpu().numpy(),
        "constraint": np.array(CONSTRAINTS[constraint]),
        "value": flight.worst[constraint, k].cpu().numpy(),
        "period": np.array(period),
        "config": np.array(config.to_toml()),
    }


@torch.no_grad()
def replay(env: InspectionEnv, example: dict[str, np.ndarray]) -> tuple[float, int, float]:
    """Flies the example's applied controls from its state, and asks the filter for each of them again.

    Where rows change places from call to call, the closed loop multiplies the rounding of another batch size or of
    compiled code: by 20 per call at 10 s. The flight under the recorded controls does not.

    Returns:
        The smallest value of the example's constraint, when in s, and by how much the filter's controls now
        differ at most, in units of the actuators' limits.
    """
    constraint, period = CONSTRAINTS.index(str(example["constraint"])), round(env.safety.period)
    x, desired, applied = (
        torch.from_numpy(example[name]).to(env.x)[..., None]
        for name in ("state", "control_desired", "control_applied")
    )
    values, difference = [env.constraint_values(x)[constraint].item()], 0.0
    for i, (wanted, u) in enumerate(zip(desired, applied, strict=True)):
        if i % period == 0:
            again = env.safety.correct(x, wanted).control
            difference = max(difference, ((again - u).abs() / env.limit).max().item())
        x = env.integrate(x, u, round(1.0 / env.interval))
        values.append(env.constraint_values(x)[constraint].item())
    when = int(np.argmin(values))
    return values[when], when, difference


def replay_file(path: str) -> str:
    """Flies the counter-example in a file, with the filter that the file describes, and says what came of it.

    Raises:
        InputError: not such a file.
        ReplayError: the constraint falls to another value than the recorded one, by more than REPLAYED.
    """
    names = ("state", "control_desired", "control_applied", "constraint", "value", "period", "config")
    example = read_arrays(path, names)
    mistakes = ValueError, TypeError, RuntimeError, LookupError, ArithmeticError
    with refusing(f"{path}: not a counter-example of verify", *mistakes):
        config = from_toml(str(example["config"]), path)
        safety_filter = build.make_filter(config, float(example["period"]))
        env = build.make_env(config, 1, [torch.Generator().manual_seed(0)], safety_filter.safety())
        value, when, difference = replay(env, example)
        recorded = float(example["value"])
    outcome = (
        f"{path}: {example['constraint']} falls to {value:.12g} at {when} s; recorded {recorded:.12g}; "
        f"the filter's controls differ by at most {difference:.1e} of their limits"
    )
    if not math.isclose(value, recorded, rel_tol=REPLAYED, abs_tol=REPLAYED):
        raise ReplayError(f"{outcome}: not what was recorded")
    return outcome
