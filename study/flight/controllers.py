"""Controllers that can command a spacecraft: an agent, or a controller by its name on the command line."""

import torch
from torch import Tensor

from inspection import guidance
from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from inspection.orbits import GUIDANCE
from inspection.world.corners import Recorded
from ppo.network import Policy
from settings import InputError
from study.flight.state_files import read_actions


def agent(policy: Policy, env: InspectionEnv) -> Controller:
    """Returns a controller by the mean action of a policy of S seeds, whose columns follow one another in `env`."""
    seeds = policy.seeds

    def control(t: float, x: Tensor) -> Tensor:
        observation = env.observation(x).unflatten(0, (seeds, -1))
        return env.control(policy.mean_action(observation).flatten(0, 1))

    return control


def classical(name: str, env: InspectionEnv, seed: int, every: float = 1.0) -> Controller:
    """Returns a controller of `inspection.guidance` by its name; it decides every `every` s and is flown in `env`.

    The controller "random" draws from a random stream of its own, which the seed determines.
    """
    c = env.c
    if name in GUIDANCE:
        return guidance.natural_motion(c, every, GUIDANCE[name], env.sight.score)
    return {
        "lqr-pd": lambda: guidance.lqr_pd(c),
        "zero": guidance.zero,
        # seed + 1, because the test cases of this seed come from the stream of `seed`
        "random": lambda: guidance.random(c, torch.Generator().manual_seed(seed + 1)),
    }[name]()


def recorded(path: str, env: InspectionEnv, step: float, duration: float) -> Controller:
    """Returns a controller that replays the controls in a file, one every `step` s, enough for the duration in s.

    Corners beside the controls are put into the plant of `env`; raises InputError if the plant has no corners.
    """
    rows = read_actions(path, env.c.control_limit, round(duration / step))
    actions, corners = rows[:, :CONTROL_SIZE], rows[:, CONTROL_SIZE:]
    if corners.size:
        if env.plant is None or not env.plant.is_worst:
            raise InputError(
                f'{path}: has corners, which needs a world with `[plant] errors = "worst"`: '
                "give the flight.toml saved beside it"
            )
        env.plant.adversary = Recorded(torch.from_numpy(corners > 0.0)[..., None].to(env.x.device), step)
    return guidance.recorded(actions, step)
