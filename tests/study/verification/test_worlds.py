"""Campaigns in a plant that is not the model: continued, flown again, and judged by what is true."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import main
from inspection.model.attitude import conjugate, rotate, unit
from inspection.model.draws import isotropic
from inspection.model.state import SIZE, THETA_S, E, P, Q, T, V
from inspection.world.corners import CORNER, Recorded
from rta.names import CONSTRAINTS
from rta.result import FilterResult, Status
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.verification import campaign
from study.verification.adversaries import held_at_random
from study.verification.starts import initial_states
from tests.study.verification.flown import flown as fly
from tests.study.verification.test_findings import verify
from tests.test_main import assert_refused, call

WORLD = """
[inspection]
max_rate = 0.05
[plant]
mass_factor = [0.5, 3.0]
thrust_gain = [0.5, 1.5]
thrust_misalignment = [0.0, 20.0]
position_noise = 5.0
velocity_noise = 0.1
attitude_noise = 3.0
latency = [0, 3]
missed_calls = 0.4
missed_in_a_row = 3
failing = "any"
failing_from = [0.0, 30.0]
hill_rotation = true
saturate_rates = false
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("worlds") / "world.toml"
    path.write_text(WORLD)
    return path


def flags(config: Path, report: str, episodes: int) -> list[str]:
    more = ["--config", str(config), "--rta-period", "1", "--duration", "40", "--episodes", str(episodes)]
    more += ["--compile", "on"]
    return [*verify(config.with_name(report)), *more]


@pytest.mark.campaign
def test_a_campaign_goes_on_and_its_violations_fly_again(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(campaign, "BATCH", 24)
    for report, counts in (("parts", (10, 20)), ("whole", (20,))):
        for count in counts:
            assert main.main(flags(config, f"{report}.json", count)) == 0
    parts, whole = (json.loads(config.with_name(f"{name}.json").read_text()) for name in ("parts", "whole"))
    assert parts == whole
    assert whole["config"]["plant"]["mass_factor"] == [0.5, 3.0]
    violated = [name for name in CONSTRAINTS if whole["violating_episodes"][name]]
    assert len(violated) > 2
    assert sum(whole["filter_calls"].values()) < 0.75 * 20 * 40  # the missed ones are none
    for name in violated[:3]:
        capsys.readouterr()
        example = config.with_name(f"whole.json.{name}.npz")
        code, out, err = call(["refly", str(example)], capsys)
        assert code == 0, err
        words = out.split()
        assert float(words[words.index("most") + 1]) < 1e-6
    other = config.with_name("other.toml")
    other.write_text(WORLD.replace("latency = [0, 3]", "latency = 2"))
    assert_refused(
        flags(other, "whole.json", 22), ["whole.json", "another campaign or configuration"], capsys
    )


def let_pass(x: Tensor, desired: Tensor) -> FilterResult:
    """Returns the desired control, as a filter that corrects nothing."""
    nothing = x.new_zeros(len(CONSTRAINTS), x.shape[1])
    none, status = nothing > 0.0, nothing[0].long()
    checks = (none[0], none[0], none[0])
    return FilterResult(desired, *checks, none, nothing, status, nothing)


def test_what_violates_is_the_true_state() -> None:
    """Sensors far off, a filter that lets everything pass: nothing is violated that was not before."""
    tables = {"train": {"compile": "off", "device": "cpu", "rta": False}}
    flights = []
    for plant in ({}, {"position_bias": 5000.0, "velocity_bias": 90.0, "attitude_bias": 170.0}):
        experiment = Experiment(override(Config(), tables | {"plant": plant}, "test"), 16)
        x, priority, _ = initial_states(16, 3, experiment.filter)
        safety = dataclasses.replace(experiment.safety, correct=let_pass)
        env = experiment.env(16, None, 1.0, 1.0, safety=safety)
        controller = held_at_random(env.c, torch.Generator().manual_seed(1), 16)
        flights.append(fly(env, controller, x, priority, 40.0))
    honest, blind = flights
    np.testing.assert_allclose(blind.worst, honest.worst, rtol=1e-9, atol=1e-9)
    assert torch.equal(blind.violating, honest.violating) and honest.violating.any()
    assert (env.plant.sense(env.time, env.x)[P] - env.x[P]).norm(dim=0).min() > 4999.0


# at the corners of the filter's bounds


@pytest.mark.parametrize(
    "policy",
    ["random", *(pytest.param(policy, marks=pytest.mark.campaign) for policy in ("pressing", "lookahead"))],
)
def test_a_campaign_at_the_worst_goes_on_and_its_violations_fly_again(
    policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(campaign, "BATCH", 12)
    path = tmp_path / "worst.toml"
    path.write_text(WORLD)
    more = ["--policy", policy, "--errors", "worst", "--duration", "20"]
    more += ["--candidates", "4", "--horizon", "2"] if policy == "lookahead" else []
    for report, counts in (("parts", (5, 16)), ("whole", (16,))):
        for count in counts:
            assert main.main([*flags(path, f"{report}.json", count), *more]) == 0
    parts, whole = (json.loads(path.with_name(f"{name}.json").read_text()) for name in ("parts", "whole"))
    assert parts == whole and whole["config"]["plant"]["errors"] == "worst"
    violated = [name for name in CONSTRAINTS if whole["violating_episodes"][name]]
    assert len(violated) > 2
    example = path.with_name(f"whole.json.{violated[0]}.npz")
    capsys.readouterr()
    code, out, err = call(["refly", str(example)], capsys)
    assert code == 0, err
    words = out.split()
    assert float(words[words.index("most") + 1]) < 1e-6
    held = dict(np.load(example))
    for corners in (held["corners"][:1], held["corners"][:, :3]):
        damaged = tmp_path / "damaged.npz"
        np.savez(damaged, **(held | {"corners": corners}))
        assert_refused(["refly", str(damaged)], [str(damaged)], capsys)


ERROR = 0.6  # m, of each axis; U1's


@pytest.mark.campaign
def test_a_position_error_that_stays_at_its_bound_does_not_lead_out_of_the_zone() -> None:
    """Full thrust outwards from 700 m, each axis taken to be nearer to the chief than it is, in twelve directions."""
    tables = {
        "train": {"compile": "on", "device": "cpu"},
        "plant": {"errors": "worst", "position_bias": ERROR},
        "uncertainty": {"position": ERROR},
    }
    here = Experiment(override(Config(), tables, "test"), 12)
    outwards = isotropic(torch.rand(2, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64))
    x = torch.zeros(SIZE, 12, dtype=torch.float64)
    x[P], x[V] = 700.0 * outwards, 3.0 * outwards  # m, m/s
    x[Q.stop - 1], x[T], x[E], x[THETA_S] = 1.0, 5.0, 6.0, 3.0
    assert here.filter.is_safe(x).all()
    env = here.env(12, None, 1.0, 1.0)
    corner = torch.zeros(CORNER, 12, dtype=torch.bool)
    corner[P] = outwards < 0.0
    env.plant.adversary = Recorded(corner.expand(80, -1, -1), 1.0)

    def push(t: float, seen: Tensor) -> Tensor:
        thrust = rotate(conjugate(seen[Q]), unit(seen[P]))
        return torch.cat((thrust / thrust.abs().amax(0), torch.zeros_like(thrust)))

    flight = fly(env, push, x, unit(x[P]), 80.0)
    assert not flight.status[Status.SLACK].any() and not flight.status[Status.UNSOLVED].any()
    assert (flight.worst[CONSTRAINTS.index("keep_in_zone")] >= 0.0).all()
