"""Flights of a report: agents with other filters and in other plants, and the guidance."""

from dataclasses import replace
from pathlib import Path

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
from study.report.inputs import Arm

DEMONSTRATION = ROOT / "configs" / "demonstration.json"
DEMONSTRATION_DURATION = 2000.0  # s
SWITCHES = {"off": False, "on": True}  # of the filter
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
            switch: flown_with(arm, with_rta(arm.config, rta, arm.config.rta.period))
            for switch, rta in SWITCHES.items()
        }
        for name, arm in arms.items()
    }


def frequency(arm: Arm) -> dict[str, Results]:
    """Flies an arm's agents with the filter called every 1, 5 and 10 s."""
    return {f"{period:g}": flown_with(arm, with_rta(arm.config, True, period)) for period in PERIODS}


def with_rta(config: Config, rta: bool, period: float) -> Config:
    """Returns the configuration with the filter off or called every `period` s."""
    return replace(config, train=replace(config.train, rta=rta), rta=replace(config.rta, period=period))


def flown_with(arm: Arm, config: Config) -> Results:
    """Evaluates the arm's agents with a configuration; returns the study's own results if it is the arm's."""
    if config == arm.config:
        return arm.results
    record, config = flights_with(arm, config, config.train.final_episodes)
    return report(record, config, TEST_CASES, len(arm.digests))


def flights_with(arm: Arm, config: Config, cases: int) -> tuple[Episodes, Config]:
    """Flies the arm's agents on common test cases; returns their episodes and the settled configuration."""
    experiment = Experiment(config, len(arm.digests) * cases)
    return play(arm.policy.to(experiment.device), experiment, cases, TEST_CASES), experiment.config


def evaluate(name: str, config: Config) -> Results:
    """Evaluates a controller that is not trained on the study's test cases."""
    cases = config.train.final_episodes
    experiment = Experiment(config, cases)
    return report(play_controller(name, experiment, cases, TEST_CASES), experiment.config, TEST_CASES)


def baselines(config: Config) -> dict[str, dict[str, Results]]:
    """Evaluates every controller of BASELINES on the study's test cases, without and with the filter."""
    flown = {switch: with_rta(config, rta, config.rta.period) for switch, rta in SWITCHES.items()}
    return {name: {switch: evaluate(name, own) for switch, own in flown.items()} for name in BASELINES}


def front(config: Config) -> dict[str, Results]:
    """Evaluates by name each guidance that leads the Sun, with the filter; it decides at each call of the filter."""
    filtered = with_rta(config, True, FILTER_PERIOD)
    return {name: evaluate(name, filtered) for name, orbit in GUIDANCE.items() if orbit.lead}


def worlds(arms: dict[str, Arm]) -> dict[str, dict[str, dict[str, Results]]]:
    """Evaluates by plant and arm the agents without filter, with the nominal filter and with one that has error bounds.

    The filter is called every second, because its error bounds belong to a spacecraft with this filter period.
    """
    bounds = load(BOUNDS, Config()).uncertainty
    filters = {"off": (False, Uncertainty()), "nominal": (True, Uncertainty()), "robust": (True, bounds)}
    return {
        plant: {
            name: {switch: in_world(arm, plant, *given) for switch, given in filters.items()}
            for name, arm in arms.items()
        }
        for plant in WORLDS
    }


def in_world(arm: Arm, plant: str, rta: bool, uncertainty: Uncertainty) -> Results:
    """Evaluates the arm's agents in the plant of a file, the filter on or off and with this uncertainty.

    The results lack the configuration, which would be repeated often.
    """
    config = with_rta(arm.config, rta, FILTER_PERIOD)
    if not uncertainty.is_zero:  # the paper's filter has no error bounds
        config = replace(config, rta=replace(config.rta, filter="checked"))
    world = load(PLANTS / f"{plant}.toml", Config()).plant
    config = replace(config, plant=world, uncertainty=uncertainty)
    record, config = flights_with(arm, config, min(WORLDS_CASES, config.train.final_episodes))
    results = report(record, config, TEST_CASES, len(arm.digests))
    del results["config"]
    return results


def progress(arms: dict[str, Arm], config: Config) -> dict[str, dict[str, list[float]]]:
    """Returns by arm, and for "guidance" with the filter, the inspected weight over time, IQM over the test cases."""
    found = {}
    for name, arm in arms.items():
        seeds, cases = len(arm.digests), arm.config.train.final_episodes
        experiment = Experiment(arm.config, seeds * cases)
        env = experiment.env(cases, experiment.generators([TEST_CASES] * seeds), compiled=experiment.compiled)
        starts = test_cases(arm.config, cases, TEST_CASES).repeat(seeds)
        found[name] = weights_over_time(env, agent(arm.policy.to(experiment.device), env), starts)
    cases = config.train.final_episodes
    experiment = Experiment(with_rta(config, True, FILTER_PERIOD), cases)
    env = experiment.env(cases, decide_every=FILTER_PERIOD, compiled=experiment.compiled)
    guidance = classical(GUIDE, env, TEST_CASES, FILTER_PERIOD)
    return found | {"guidance": weights_over_time(env, guidance, test_cases(config, cases, TEST_CASES))}


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


def worst_success(path: Path) -> tuple[int, int] | None:
    """Returns seed's place and case of the success that violates limits for the largest share of its time, if any."""
    names = "outcome", "outcome_names", "violation_seconds"
    episodes = load_arrays(path, names, "episodes of an arm", "")
    with as_input_error(f"{path}: not the episodes of an arm", *MALFORMED):
        succeeded = episodes["outcome"] == list(episodes["outcome_names"]).index("success")
        share = np.where(succeeded, episodes["violation_seconds"][-1], 0.0)
    place, case = (int(i) for i in np.unravel_index(share.argmax(), share.shape))
    return (place, case) if share[place, case] > 0.0 else None


def episode(arm: Arm, place: int = 0, case: int = 0) -> Arrays:
    """Flies an arm's seed, counted from 0, from a test case, in the configuration of training."""
    experiment = Experiment(arm.config, 1)
    return common_episode(arm.of_seed(place).to(experiment.device), experiment, case)


def violation(arm: Arm, place: int, case: int) -> Arrays:
    """Flies an arm's seed from a test case; returns the episode with its `seed` and `case`."""
    seed = arm.results["seeds"][place]
    return episode(arm, place, case) | {"seed": np.array(seed), "case": np.array(case)}


def demonstration(config: Config, rta: bool) -> Arrays:
    """Flies a classical controller that heads for the limits, with or without the filter."""
    experiment = Experiment(with_rta(config, rta, config.rta.period), 1, DEMONSTRATION_DURATION)
    step = config.inspection.substep
    start = starting_point(str(DEMONSTRATION), experiment, TEST_CASES)
    env = experiment.env(1, decide_every=step, report_every=step)
    controller = classical("lqr-pd", env, TEST_CASES)
    return simulate(env, controller, start, DEMONSTRATION_DURATION)
