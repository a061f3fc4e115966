"""What `simulate` records, against the same flight step by step."""

import numpy as np

from inspection.dynamics import step as integrate
from inspection.guidance import recorded
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.config import Config, override
from study.experiment import Experiment
from study.experiment import test_cases as common_cases
from study.flight.simulation import simulate

DURATION, DECIDE_EVERY, STEP = 60, 10, 5  # s, with a call of the filter each second


def test_intervened_tells_which_calls_since_the_row_changed_the_control_they_were_given() -> None:
    experiment = Experiment(override(Config(), {"train": {"device": "cpu"}}, "test"), 1, DURATION)
    c = experiment.config.inspection
    x, priority = common_cases(experiment.config, 1, 0)
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (DURATION // DECIDE_EVERY, 6))
    env = experiment.env(1, decide_every=DECIDE_EVERY, report_every=STEP)
    decisions = recorded(draws * c.control_limit, DECIDE_EVERY)
    run = simulate(env, decisions, x, priority, DURATION)

    correct = SafetyFilter(c, RtaParameters())
    changed, applied = np.zeros((DURATION, 2), dtype=bool), x.new_zeros(6, 1)
    for t in range(DURATION):
        given = decisions(t, x) if t % DECIDE_EVERY == 0 else applied
        applied = correct(x, given).control
        changed[t] = [(applied[group] != given[group]).any() for group in (slice(0, 3), slice(3, 6))]
        x = integrate(x, applied, 1.0, c)
    expected = changed.reshape(-1, STEP, 2).any(1)
    np.testing.assert_array_equal(run["position"][-1], x[:3, 0])
    np.testing.assert_array_equal(run["intervened"][:-1], expected)
    assert not run["intervened"][-1].any()  # no call follows
    # neither the calls at the rows alone nor the difference of the controls tell as much
    differs = run["control_desired"] != run["control_applied"]
    differs = np.stack((differs[:-1, :3].any(1), differs[:-1, 3:].any(1)), 1)
    assert 0 < expected.sum() < expected.size
    assert (differs != expected).any() and (changed[::STEP] != expected).any()
