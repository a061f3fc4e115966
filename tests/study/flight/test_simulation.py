"""What `simulate` records, against the same flight step by step."""

import math
from pathlib import Path

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import main
from inspection.guidance import recorded
from inspection.model.dynamics import step as integrate
from inspection.model.parameters import InspectionParameters
from rta.fast.filter import batched
from rta.filter import SafetyFilter
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.experiment import test_cases as common_cases
from study.flight.figures import points_of_chief
from study.flight.fly import Starts
from study.flight.simulation import simulate

DURATION, DECIDE_EVERY, STEP = 40, 10, 5  # s, with a call of the filter each second


def test_intervened_tells_which_calls_since_the_row_changed_the_control_they_were_given() -> None:
    experiment = Experiment(
        override(Config(), {"train": {"device": "cpu", "compile": "off"}}, "test"), 1, DURATION
    )
    c = experiment.config.inspection
    x, priority, _ = common_cases(experiment.config, 1, 0)
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (DURATION // DECIDE_EVERY, 6))
    env = experiment.env(1, decide_every=DECIDE_EVERY, report_every=STEP)
    decisions = recorded(draws * c.control_limit, DECIDE_EVERY)
    run = simulate(env, decisions, Starts(x, priority), DURATION)

    correct = batched(SafetyFilter(c, experiment.config.rta))
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


SATELLITE = {"mesh": "configs/chiefs/satellite.stl", "moments": [1.0, 0.9, 0.6]}


def beside_a_chief(chief: dict, **inspection: object) -> Experiment:
    tables = {"train": {"device": "cpu", "rta": False}, "chief": chief, "inspection": inspection}
    return Experiment(override(Config(), tables, "test"), 1, DURATION)


def test_a_chief_tumbles_in_it_as_an_adaptive_integrator_has_it_and_is_seen_as_by_an_agent() -> None:
    rate, moments = np.radians([1.0, 0.5, 2.0]), np.array(SATELLITE["moments"])
    experiment = beside_a_chief(
        SATELLITE | {"rate": np.degrees(rate).tolist(), "attitude": [0.1, 0.2, 0.3, 0.9]}
    )
    x, priority, _ = common_cases(experiment.config, 1, 0)
    x[:3, 0], x[6:10, 0], x[15] = x.new_tensor([-60.0, 0.0, 0.0]), x.new_tensor([0.0, 0.0, 0.0, 1.0]), math.pi
    x[3:6], x[10:13] = 0.0, 0.0  # looks at the chief with the Sun behind
    env = experiment.env(1, report_every=STEP)
    run = simulate(env, lambda t, x: x.new_zeros(6, 1), Starts(x, priority), DURATION)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        (a, b, c, d), (p, q, r) = y[:4], y[4:]
        turned = [d * p + b * r - c * q, d * q + c * p - a * r, d * r + a * q - b * p, -a * p - b * q - c * r]
        return np.concatenate((np.array(turned) / 2, np.cross(moments * y[4:], y[4:]) / moments))

    start = np.array([0.1, 0.2, 0.3, 0.9])
    start = np.concatenate((start / np.linalg.norm(start), rate))
    path = solve_ivp(derivative, (0, DURATION), start, "DOP853", run["time"], rtol=1e-11, atol=1e-12).y[:4]
    apart = Rotation.from_quat(run["chief_attitude"]) * Rotation.from_quat(path.T).inv()
    assert apart.magnitude().max() < 1e-6 and Rotation.from_quat(path[:, -1]).magnitude() > 1.5

    drawn = points_of_chief(run, experiment.config.inspection)
    expected = Rotation.from_quat(path[:, -1]).apply(run["chief_points"])
    np.testing.assert_allclose(drawn, expected, atol=1e-4)

    other = experiment.env(1)
    other.start(x, priority)
    for i in range(1, DURATION // 10 + 1):
        seen = other.step(torch.zeros(1, 6)).inspected[:, 0].numpy()
        np.testing.assert_array_equal(run["inspected"][np.flatnonzero(run["time"] == 10.0 * i)[0]], seen)
    assert (run["inspected"][-1] != run["inspected"][0]).any()


def repeated(rows: np.ndarray, step: int, tmp_path: Path) -> list[str]:
    """Returns the command that repeats rows of controls and corners, with thrusters 50 % too weak or strong."""
    config, actions = (tmp_path / name for name in ("own.toml", "flight.npy"))
    config.write_text('[plant]\nerrors = "worst"\nthrust_gain = [0.5, 1.5]\n')
    np.save(actions, rows)
    words = ["simulate", "--config", str(config), "--controller", "recorded", "--actions", str(actions)]
    words += ["--initial-state", "configs/demonstration.json", "--step", str(step)]
    return [*words, "--duration", str(step * len(rows)), "--out", str(tmp_path / "flight.npz")]


def test_recorded_corners_say_at_which_end_each_error_is(tmp_path: Path) -> None:
    """Full thrust along the three axes, weak for two seconds and then strong along x alone."""
    rows = np.zeros((4, 25))
    rows[:, :3] = 1.0
    rows[2:, 6 + 12] = 1.0  # the first gain
    assert main.main([*repeated(rows, 1, tmp_path), "--no-rta"]) == 0
    flown = np.load(tmp_path / "flight.npz")
    attitude = Rotation.from_quat(flown["quaternion"][:-1])
    given = attitude.inv().apply(np.diff(flown["velocity"], axis=0)) * InspectionParameters().mass
    wanted = [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [1.5, 0.5, 0.5]]
    np.testing.assert_allclose(given, wanted, rtol=0, atol=0.05)  # the orbit's acceleration and the turn
