"""Flights of a report: agents with other filters and in other plants, and the guidance."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.orbits import GUIDANCE
from inspection.transition import METRICS, Transition
from inspection.world.uncertainty import Uncertainty
from rta.parameters import PERIODS
from settings import load
from study.config import BASELINES, GUIDE, TEST_CASES, Config
from study.errors import MALFORMED, as_input_error
from study.experiment import Experiment, test_cases
from study.files import ROOT, load_arrays
from study.flight.controllers import agent, classical
from study.flight.evaluation import Episodes, common_episode, play, play_controller, report
from study.flight.fly import Limits, Observer, Starts, fly
from study.flight.simulation import simulate, starting_point
from study.flight.summary import iqm
from study.paper import Results
from study.report.agents import Arm, stacked

DEMONSTRATION = ROOT / "configs" / "demonstration.json"
DEMONSTRATION_DURATION = 2000.0  # s
FILTER_PERIOD = 1.0  # s between two calls of the filter
PLANTS = ROOT / "configs" / "plants"
WORLDS = ("nominal", "typical", "u1", "harsh")  # names of files in PLANTS
BOUNDS = PLANTS / "u1.toml"  # has the error bounds of the robust filter
WORLDS_CASES = 10  # test cases of each seed in each plant
PROGRESS_UNTIL = 5000.0  # s
Arrays = dict[str, np.ndarray]


def cross(arms: dict[str, Arm]) -> dict[str, dict[str, Results]]:
    """Flies each arm's agents without and with the filter, called as often as in the study."""
    return {
        name: {
            "off": evaluate(arm, rta=False, period=arm.config.rta.period),
            "on": evaluate(arm, rta=True, period=arm.config.rta.period),
        }
        for name, arm in arms.items()
    }


def frequency(arm: Arm) -> dict[str, Results]:
    """Flies an arm's agents with the filter called every 1, 5 and 10 s."""
    return {f"{period:g}": evaluate(arm, rta=True, period=period) for period in PERIODS}


def with_rta(config: Config, rta: bool, period: float) -> Config:
    """Returns the configuration with the filter off or called every `period` s."""
    return replace(config, train=replace(config.train, rta=rta), rta=replace(config.rta, period=period))


def evaluate(arm: Arm, rta: bool, period: float) -> Results:
    """Evaluates the arm's agents on the study's test cases, with the filter off or called every `period` s."""
    return flown_with(arm, with_rta(arm.config, rta, period))


def flown_with(arm: Arm, config: Config) -> Results:
    """Evaluates the arm's agents with a configuration; returns the study's own results if it is the arm's."""
    if config == arm.config:
        return arm.results
    record, config = flights_with(arm, config)
    return report(record, config, TEST_CASES, len(arm.digests))


def flights_with(arm: Arm, config: Config) -> tuple[Episodes, Config]:
    """Flies the arm's agents on the study's test cases; returns their episodes and the settled configuration."""
    episodes = config.train.final_episodes
    experiment = Experiment(config, len(arm.digests) * episodes)
    return play(arm.policy.to(experiment.device), experiment, episodes, TEST_CASES), experiment.config


def unlearned(config: Config, rta: bool, episodes: int) -> Experiment:
    """Returns an experiment for controllers that are not trained, with the filter off or called as in the study."""
    return Experiment(with_rta(config, rta, config.rta.period), episodes)


def baselines(config: Config) -> dict[str, dict[str, Results]]:
    """Evaluates every controller of BASELINES on the study's test cases, without and with the filter."""
    episodes = config.train.final_episodes
    experiments = {"off": unlearned(config, False, episodes), "on": unlearned(config, True, episodes)}

    def flown(name: str, experiment: Experiment) -> Results:
        record = play_controller(name, experiment, episodes, TEST_CASES)
        return report(record, experiment.config, TEST_CASES)

    return {
        name: {switch: flown(name, experiment) for switch, experiment in experiments.items()}
        for name in BASELINES
    }


def front(config: Config) -> dict[str, Results]:
    """Evaluates by name each guidance that leads the Sun, with the filter; it decides at each call of the filter."""
    cases = config.train.final_episodes
    experiment = Experiment(with_rta(config, True, FILTER_PERIOD), cases)

    def flown(name: str) -> Results:
        record = play_controller(name, experiment, cases, TEST_CASES)
        return report(record, experiment.config, TEST_CASES)

    return {name: flown(name) for name, orbit in GUIDANCE.items() if orbit.lead}


def worlds(arms: dict[str, Arm]) -> dict[str, dict[str, dict[str, Results]]]:
    """Evaluates by plant and arm the agents without filter, with the nominal filter and with one that has error bounds.

    The filter is called every second, because its error bounds belong to a spacecraft with this filter period.
    """
    bounds = load(BOUNDS, Config()).uncertainty
    filters = {"off": (False, Uncertainty()), "nominal": (True, Uncertainty()), "robust": (True, bounds)}
    found: dict[str, dict[str, dict[str, Results]]] = {plant: {name: {} for name in arms} for plant in WORLDS}
    for names in side_by_side(arms):
        for plant, (switch, (rta, uncertainty)) in product(WORLDS, filters.items()):
            flown = in_world([arms[name] for name in names], plant, rta, uncertainty)
            for name, results in zip(names, flown, strict=True):
                found[plant][name][switch] = results
    return found


def side_by_side(arms: dict[str, Arm]) -> list[list[str]]:
    """Returns names of arms in groups whose agents can fly in one environment, since their settings agree."""
    groups: list[tuple[tuple[Any, ...], list[str]]] = []
    for name, arm in arms.items():
        config = with_rta(arm.config, True, FILTER_PERIOD)
        train, ppo = config.train, config.ppo
        needs = (
            *(config.inspection, config.rta, config.chief, len(arm.digests)),
            *(train.device, train.compile, train.final_episodes),
            *(ppo.hidden, ppo.log_std_bounds, ppo.tanh_outputs, ppo.action_power),
        )
        group = next((names for others, names in groups if others == needs), None)
        if group is None:
            groups.append((needs, [name]))
        else:
            group.append(name)
    return [names for _, names in groups]


def in_world(arms: Sequence[Arm], plant: str, rta: bool, uncertainty: Uncertainty) -> list[Results]:
    """Flies the agents of arms side by side in the plant of a file, the filter on or off and with this uncertainty."""
    first = arms[0]
    own = with_rta(first.config, rta, FILTER_PERIOD)
    if not uncertainty.is_zero:  # the paper's filter has no error bounds
        own = replace(own, rta=replace(own.rta, filter="checked"))
    config = replace(
        own,
        plant=load(PLANTS / f"{plant}.toml", Config()).plant,
        uncertainty=uncertainty,
    )
    seeds = len(first.digests)
    cases = min(WORLDS_CASES, config.train.final_episodes)
    experiment = Experiment(config, seeds * cases)
    agents = stacked(config, [arm.policy for arm in arms]).to(experiment.device)
    record = play(agents, experiment, cases, TEST_CASES)
    return [in_short(own, experiment.config, seeds) for own in record.split(len(arms))]


def in_short(record: Episodes, config: Config, seeds: int) -> Results:
    """Returns `report` with the reward of each seed, and without the configuration, which would be repeated often."""
    rewards = record.metrics[METRICS.index("reward")].unflatten(0, (seeds, -1)).cpu().numpy()
    results = report(record, config, TEST_CASES, seeds)
    del results["config"]
    return results | {"reward_of_seeds": [float(value) for value in iqm(rewards)]}


def progress(arms: dict[str, Arm], config: Config) -> dict[str, dict[str, list[float]]]:
    """Returns by arm, and for "guidance" with the filter, the inspected weight over time, IQM over the test cases."""
    cases = config.train.final_episodes
    every = FILTER_PERIOD
    experiment = Experiment(with_rta(config, True, every), cases)
    env = experiment.env(cases, decide_every=every, compiled=experiment.compiled)
    controller = classical(GUIDE, env, TEST_CASES, every)
    curve = weights_over_time(env, controller, test_cases(config, cases, TEST_CASES))
    return {name: arm_progress(arm) for name, arm in arms.items()} | {"guidance": curve}


def arm_progress(arm: Arm) -> dict[str, list[float]]:
    """Returns the inspected weight over time of an arm's agents."""
    seeds, cases = len(arm.digests), arm.config.train.final_episodes
    experiment = Experiment(arm.config, seeds * cases)
    env = experiment.env(cases, experiment.generators([TEST_CASES] * seeds), compiled=experiment.compiled)
    starts = test_cases(arm.config, cases, TEST_CASES).repeat(seeds)
    return weights_over_time(env, agent(arm.policy.to(experiment.device), env), starts)


class Weights(Observer):
    """Keeps every episode's inspected weight at the start and after each action; ended episodes keep their last."""

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.weights = [env.sight.score()]

    def step(self, transition: Transition, running: Tensor) -> None:
        score = transition.metrics[METRICS.index("inspected_score")]
        self.weights.append(torch.where(running, score, self.weights[-1]))


def weights_over_time(env: InspectionEnv, controller: Controller, starts: Starts) -> dict[str, list[float]]:
    """Returns `time_s` and the inspected `weight` then, mean of the middle half; ended episodes keep their last."""
    flown, every = Weights(), env.c.action_period
    fly(env, controller, starts, observers=[flown])
    count = round(PROGRESS_UNTIL / every) + 1
    weights = (flown.weights + flown.weights[-1:] * count)[:count]
    return {
        "time_s": [i * every for i in range(count)],
        "weight": [float(iqm(weight.cpu().numpy())) for weight in weights],
    }


def episode(arm: Arm) -> Arrays:
    """Flies the first seed from the first test case, in the configuration of training."""
    experiment = Experiment(arm.config, 1)
    return common_episode(arm.of_seed(0).to(experiment.device), experiment)


def worst_success(path: Path) -> tuple[int, int] | None:
    """Returns seed's place and case of the success that violates limits for the largest share of its time, if any."""
    names = "outcome", "outcome_names", "violation_seconds"
    episodes = load_arrays(path, names, "episodes of an arm", "")
    with as_input_error(f"{path}: not the episodes of an arm", *MALFORMED):
        succeeded = episodes["outcome"] == list(episodes["outcome_names"]).index("success")
        share = np.where(succeeded, episodes["violation_seconds"][-1], 0.0)
    place, case = (int(i) for i in np.unravel_index(share.argmax(), share.shape))
    return (place, case) if share[place, case] > 0.0 else None


def violation(arm: Arm, place: int, case: int) -> Arrays:
    """Flies an arm's seed from a test case; returns the episode with its `seed` and `case`."""
    experiment = Experiment(arm.config, 1)
    flown = common_episode(arm.of_seed(place).to(experiment.device), experiment, case)
    return flown | {"seed": np.array(arm.results["seeds"][place]), "case": np.array(case)}


def demonstration(config: Config, rta: bool) -> Arrays:
    """Flies a classical controller that heads for the limits, with or without the filter."""
    experiment = Experiment(with_rta(config, rta, config.rta.period), 1, DEMONSTRATION_DURATION)
    step = config.inspection.substep
    start = starting_point(str(DEMONSTRATION), experiment, TEST_CASES)
    env = experiment.env(1, decide_every=step, report_every=step)
    controller = classical("lqr-pd", env, TEST_CASES)
    return simulate(env, controller, start, DEMONSTRATION_DURATION)
