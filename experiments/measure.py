"""Measures a filter: how much it corrects, what its check changes, its speed, and the share of accepted states.

    python -m experiments.measure --demand random --rta-period 10

The numbers serve to compare designs of a filter. `--json F` keeps them.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.guidance import limited, point
from inspection.initial_state import sample_initial_state
from inspection.model.attitude import unit
from inspection.model.draws import isotropic
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, P, V
from ppo.errors import CheckpointError
from ppo.network import Policy
from rta.filter import SafetyFilter
from rta.result import FilterResult
from settings import InputError, Parser, add_flags, configured, override, positive_integer, positive_number
from study.config import Config
from study.experiment import Experiment, check_is_checked, load_policy
from study.files import write_json
from study.flight.controllers import agent
from study.flight.fly import Starts, fly
from study.machine import set_threads
from study.verification.adversaries import held_at_random
from study.verification.lookahead import CANDIDATES, HORIZON, Lookahead
from study.verification.starts import NUMBERS, safe_set, states_of
from study.verification.tape import CHECK_EVERY
from study.verified import fingerprint

SHORT = {"--rta-filter": "rta.filter", "--rta-period": "rta.period"}
DRAWN = 4000  # states for the share of accepted ones
HELD = 60.0  # s, hold of full control
WAYPOINT, NEAREST, FARTHEST = 100.0, 30.0, 400.0  # s between two waypoints; m from the chief
FREQUENCY = 0.02  # rad/s, of the controller to waypoints, which is critically damped
EDGE = 0.95  # starts at the edge of the zone have the largest 5 % of the safe set's distances


def full(c: InspectionParameters, generator: torch.Generator, batch: int) -> Controller:
    """Returns a controller of full thrust and torque along every axis, with signs that are drawn anew every HELD s."""
    sign = torch.ones(CONTROL_SIZE, batch, dtype=torch.float64)

    def control(t: float, x: Tensor) -> Tensor:
        if math.isclose(t % HELD, 0.0):
            sign.copy_(2.0 * torch.randint(0, 2, sign.shape, generator=generator) - 1.0)
        return sign.to(x) * x.new_tensor(c.control_limit)[:, None]

    return control


def to_waypoints(c: InspectionParameters, generator: torch.Generator, batch: int) -> Controller:
    """Returns a proportional-derivative controller to one waypoint after another, with the camera at the chief."""
    target = torch.zeros(3, batch, dtype=torch.float64)

    def control(t: float, x: Tensor) -> Tensor:
        if math.isclose(t % WAYPOINT, 0.0):
            drawn = torch.rand(3, batch, generator=generator, dtype=torch.float64)
            target.copy_((NEAREST + (FARTHEST - NEAREST) * drawn[2]) * isotropic(drawn[:2]))
        thrust = -c.mass * (FREQUENCY**2 * (x[P] - target.to(x)) + 2.0 * FREQUENCY * x[V])
        return limited(thrust, point(x, "+x", -unit(x[P]), c), x, c)

    return control


def opposite(safety_filter: SafetyFilter) -> Controller:
    """Returns a controller of full control opposite to the backup laws', which leaves the backup trajectory."""
    if not (check := safety_filter.check):
        raise InputError("--demand opposite: this filter has no backup laws to oppose")

    def control(t: float, x: Tensor) -> Tensor:
        seen = torch.cat((x, x.new_zeros(check.size - len(x), x.shape[1])))
        return -check.law(seen).sign() * x.new_tensor(safety_filter.c.control_limit)[:, None]

    return control


DEMANDS: dict[str, Callable[[InspectionParameters, torch.Generator, int], Controller]] = {
    "random": held_at_random,
    "full": full,
    "waypoints": to_waypoints,
}
AGENT, OPPOSITE, LOOKAHEAD, BARELY = "agent", "opposite", "lookahead", "barely"
STARTS = "paper", "safe-set", "edge", BARELY
HALVINGS = 40  # of the way between an accepted and a rejected state


class Counted:
    """Wraps `SafetyFilter.correct` and counts its corrections.

    Attributes:
        calls: number of calls, each for one spacecraft; seconds: their duration.
        corrected, moved, unverified: calls with a control that is not the desired one, that the check changed from the
        programs', and that is not verified.
        change, chatter: (2,) sums of |u - u_des| and of |u - u of the last call| in limits, for thrust and for torque.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self.filter = safety_filter
        self.calls, self.seconds = 0, 0.0
        self.corrected = self.moved = self.unverified = 0
        self.change, self.chatter = torch.zeros(2, 2, dtype=torch.float64)
        self.last: Tensor | None = None

    def correct(self, x: Tensor, desired: Tensor, **told: Tensor) -> FilterResult:
        """Calls `SafetyFilter.correct` and counts its answers."""
        started = time.perf_counter()
        answer = self.filter.correct(x, desired, **told)
        self.seconds += time.perf_counter() - started
        self.calls += x.shape[1]
        self.corrected += int(answer.intervened.sum())
        self.moved += int(answer.backup.sum())
        self.unverified += int((~answer.verified).sum())
        limit = x.new_tensor(self.filter.c.control_limit)[:, None]
        last = answer.control if self.last is None else self.last
        for total, other in ((self.change, desired), (self.chatter, last)):
            total += ((answer.control - other) / limit).unflatten(0, (2, 3)).norm(dim=1).sum(1).cpu()
        self.last = answer.control
        return answer


def starts(where: str, count: int, seed: int, safety_filter: SafetyFilter) -> tuple[Tensor, Tensor]:
    """Returns states (16, count) that the filter accepts, and priority vectors (3, count); `where` is one of STARTS."""
    if where == "safe-set":
        return safe_set(count, seed, safety_filter)[:2]
    if where == BARELY:
        return barely(count, seed, safety_filter)
    generator = torch.Generator().manual_seed(seed)
    if where == "paper":
        return sample_initial_state(count, generator, safety_filter.c, safety_filter.is_safe)
    found: list[Tensor] = []
    while sum(part.shape[1] for part in found) < count:
        s = torch.rand(NUMBERS, DRAWN, generator=generator, dtype=torch.float64)
        s[0] = EDGE + (1.0 - EDGE) * s[0]
        drawn = torch.cat(states_of(s, safety_filter.c))
        found.append(drawn[:, safety_filter.is_safe(drawn[:16])])
    both = torch.cat(found, 1)[:, :count]
    return both[:16], both[16:]


def barely(count: int, seed: int, safety_filter: SafetyFilter) -> tuple[Tensor, Tensor]:
    """Returns barely accepted states: the last accepted ones on the way to rejected states within all limits."""
    generator, c = torch.Generator().manual_seed(seed), safety_filter.c

    def accepts(s: Tensor) -> Tensor:
        return safety_filter.is_safe(states_of(s, c)[0])

    inside, outside = (
        torch.zeros(NUMBERS, 0, dtype=torch.float64),
        torch.zeros(NUMBERS, 0, dtype=torch.float64),
    )
    while min(inside.shape[1], outside.shape[1]) < count:
        s = torch.rand(NUMBERS, 8 * DRAWN, generator=generator, dtype=torch.float64)
        safe, kept = accepts(s), (safety_filter.values(states_of(s, c)[0]) >= 0.0).all(0)
        inside, outside = (
            torch.cat(both, 1) for both in ((inside, s[:, safe]), (outside, s[:, kept & ~safe]))
        )
    inside, outside = inside[:, :count], outside[:, :count]
    for _ in range(HALVINGS):
        middle = (inside + outside) / 2
        safe = accepts(middle)
        inside, outside = torch.where(safe, middle, inside), torch.where(safe, outside, middle)
    return states_of(inside, c)


def accepted(safety_filter: SafetyFilter, seed: int) -> float:
    """Returns the share of accepted starts among the states with every h >= 0, from DRAWN states."""
    generator = torch.Generator().manual_seed(seed)
    x, _ = states_of(torch.rand(NUMBERS, DRAWN, generator=generator, dtype=torch.float64), safety_filter.c)
    x = x[:, (safety_filter.values(x) >= 0.0).all(0)]
    return safety_filter.is_safe(x).double().mean().item()


def measure(
    config: Config, demand: str, where: str, episodes: int, duration: float, policy: Policy | None = None
) -> dict[str, Any]:
    """Flies episodes with the filter under a demand, for a duration in s.

    Args:
        demand: one of DEMANDS, "opposite", "lookahead", or "agent" for `policy`; where: as in `starts`.

    Returns:
        Shares of calls in percent, mean changes in units of the actuators' limits, a rate, the share of accepted starts
        in percent, the number of episodes with a violation, and the settings of the measurement.
    """
    experiment = Experiment(config, episodes, math.inf)  # compiled, however short the flight
    counted = Counted(experiment.filter)
    decide = None if policy else config.rta.period
    safety = replace(experiment.safety, correct=counted.correct)
    env = experiment.env(episodes, decide_every=decide, compiled=experiment.compiled, safety=safety)
    x, priority = starts(where, episodes, 0, experiment.filter)
    generator = torch.Generator().manual_seed(1)
    if policy:
        controller = agent(policy, env)
    elif demand == OPPOSITE:
        check_is_checked(experiment.config)
        controller = opposite(experiment.filter)
    elif demand == LOOKAHEAD:
        tried = experiment.env(episodes * CANDIDATES, None, config.rta.period, CHECK_EVERY, True)
        controller = Lookahead(env, tried, HORIZON, generator, episodes)
    else:
        controller = DEMANDS[demand](env.c, generator, episodes)
    worst = fly(env, controller, Starts(x, priority), duration).limits.worst
    share = 100.0 / counted.calls
    change, chatter = ((each / counted.calls).tolist() for each in (counted.change, counted.chatter))
    return {
        "corrected_percent": share * counted.corrected,
        "change_of_thrust": change[0],
        "change_of_torque": change[1],
        "chatter_of_thrust": chatter[0],
        "chatter_of_torque": chatter[1],
        "moved_by_check_percent": share * counted.moved,
        "unverified_percent": share * counted.unverified,
        "calls_per_s": counted.calls / counted.seconds,
        "starts_percent": 100.0 * accepted(experiment.filter, 2),
        "broken_episodes": int((worst < 0.0).any(0).sum()),
        "calls": counted.calls,
        "measured": {"demand": demand, "starts": where, "episodes": episodes, "duration": duration},
        "threads": torch.get_num_threads(),
        "fingerprint": fingerprint(config),
    }


def table(found: dict[str, Any]) -> str:
    """Returns the numbers as text, a line each."""
    words = {
        "corrected_percent": "calls corrected, %",
        "change_of_thrust": "mean |u - u_des| of thrust, in limits",
        "change_of_torque": "mean |u - u_des| of torque, in limits",
        "chatter_of_thrust": "mean |u - u of the last call| of thrust",
        "chatter_of_torque": "mean |u - u of the last call| of torque",
        "moved_by_check_percent": "calls moved by the check, %",
        "unverified_percent": "calls not verified, %",
        "calls_per_s": "calls per s, with all that they compute",
        "starts_percent": "states with every h >= 0 that are starts, %",
        "broken_episodes": f"episodes of {found['measured']['episodes']:,} in which a limit was broken",
    }
    return "\n".join(f"{text:48}{found[name]:>12,.4g}" for name, text in words.items())


def main(argv: list[str] | None = None) -> None:
    """Measures, and prints the numbers."""
    parser = Parser(prog=f"python -m {__package__}.measure", description=__doc__.partition("\n")[0])
    add_flags(parser, Config(), ("inspection", "chief", "rta", "uncertainty"), SHORT)
    parser.add_argument(
        "--demand", choices=(*DEMANDS, OPPOSITE, LOOKAHEAD, AGENT), default="random", help="who demands"
    )
    parser.add_argument("--checkpoint", metavar="F", help="of --demand agent")
    parser.add_argument("--starts", choices=STARTS, default="safe-set", help="from where")
    parser.add_argument("--episodes", type=positive_integer, default=256, metavar="N", help="at once")
    parser.add_argument("--duration", type=positive_number, default=300.0, metavar="S", help="of each, in s")
    parser.add_argument("--json", type=Path, metavar="F", help="also write the numbers there")
    arguments = parser.parse_args(argv)
    try:
        print(table(measured(arguments)))
    except (InputError, CheckpointError) as error:
        parser.error(str(error))


def measured(arguments: argparse.Namespace) -> dict[str, Any]:
    """Measures what the command line asks for, and writes the numbers to its file, if any."""
    if (arguments.demand == AGENT) != bool(arguments.checkpoint):
        raise InputError("--checkpoint F is needed by --demand agent and by no other")
    set_threads(None)
    policy, config = load_policy(arguments.checkpoint) if arguments.checkpoint else (None, Config())
    config = override(configured(arguments, config), {"train": {"rta": True}}, "the filter")
    found = measure(
        config, arguments.demand, arguments.starts, arguments.episodes, arguments.duration, policy
    )
    if arguments.json:
        write_json(arguments.json, found)
    return found


if __name__ == "__main__":
    main()
