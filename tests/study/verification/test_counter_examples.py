"""Counter-examples, and flying them again."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rta.names import CONSTRAINTS
from rta.result import FilterResult
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.verification import campaign
from study.verification.adversaries import adversarial
from study.verification.counter_examples import counter_example, refly
from study.verification.starts import initial_states
from tests.study.verification.flown import flown as fly
from tests.study.verification.test_findings import verify
from tests.support.flights import FILTER
from tests.test_main import call

pytestmark = pytest.mark.usefixtures("small_pools")


@pytest.fixture(scope="module")
def violated(small_pools: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a report with violations: mass 4 times and velocity 2 m/s off the filter's values, called every 10 s."""
    import main

    path = tmp_path_factory.mktemp("violated") / "report.json"
    config = path.with_name("weak.toml")
    config.write_text("[inspection]\nmax_thrust = 1.05\n[plant]\nmass_factor = 4.0\nvelocity_bias = 2.0\n")
    arguments = ["--policy", "adversarial", "--rta-period", "10", "--duration", "30", "--episodes", "24"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign, "BATCH", 24)  # it draws the starts of no more episodes than it flies
        assert main.main(verify(path, *arguments, "--config", str(config))) == 0
    return path


def test_a_violation_leaves_a_counter_example_that_flies_again_exactly(
    violated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = json.loads(violated.read_text())
    names = [name for name in CONSTRAINTS if report["violating_steps"][name]]
    files = {path.name for path in violated.parent.glob("*.npz")}
    assert names and files == {f"{violated.name}.{name}.npz" for name in names}
    for name in names[:2]:
        path = violated.with_name(f"{violated.name}.{name}.npz")
        example: dict[str, Any] = dict(np.load(path))
        case = report["worst_case"][name]
        np.testing.assert_array_equal(example["state"], case["initial_state"])
        assert example["value"] == report["worst_value"][name] < 0
        assert len(example["control_desired"]) == -(-case["time_s"] // 10)
        assert np.abs(example["control_applied"]).max() <= 1.5
        code, out, err = call(["refly", str(path)], capsys)
        assert code == 0, err
        words = out.split()
        value, when = float(words[words.index("to") + 1]), float(words[words.index("at") + 1])
        assert value == pytest.approx(report["worst_value"][name], rel=0, abs=1e-9)
        assert float(words[words.index("most") + 1]) < 1e-6
        assert when == case["time_s"]


@pytest.mark.parametrize("factor", [1 + 1e-6, np.nan])
def test_a_flight_again_that_comes_out_otherwise_fails(
    factor: float, violated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = dict(np.load(violated.with_name(f"{violated.name}.dynamic_speed.npz")))
    path = tmp_path / "example.npz"
    np.savez(path, **(example | {"value": factor * example["value"]}))
    code, out, err = call(["refly", str(path)], capsys)
    assert (code, out) == (1, "") and err.count("\n") == 1
    assert "not what was recorded" in err and str(path) in err


def rounded(correct: Callable[..., FilterResult], x: Tensor, desired: Tensor) -> FilterResult:
    """Returns the answer of a program with slightly different rounding."""
    answer = correct(x, desired)
    return replace(answer, control=answer.control + 1e-10)  # 1e-7 of the torque


@pytest.mark.campaign
def test_refly_does_not_depend_on_the_solvers_last_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 10 s the closed loop can multiply any rounding by some 20 per call."""
    first, second = (
        Experiment(
            override(
                Config(),
                {
                    "train": {"rta": rta, "compile": "on" if rta else "off"},
                    "rta": {"period": 10.0, "qp_solver": name},
                    "plant": {"mass_factor": 0.5},
                },
                "it",
            ),
            1,
        )
        for rta, name in ((True, "batched"), (False, "piqp"))
    )
    env = first.env(64, decide_every=10.0, report_every=1.0)
    x, priority, _ = initial_states(
        64, 3, FILTER
    )  # whether 10 s can be held from there is not asked: it is slow
    flight = fly(env, adversarial(first.filter), x, priority, 50)
    example = counter_example(
        flight.record, flight.tape, torch.ones(64, dtype=torch.bool), "dynamic_speed", first.config, 1.0
    )
    program = second.filter.program
    monkeypatch.setattr(program, "correct", partial(rounded, program.correct))
    value, when, difference = refly(second, example)
    assert example["value"] < 0
    assert value == pytest.approx(float(example["value"]), abs=1e-9)
    assert -(-when // 10) == len(example["control_desired"])
    assert 0.0 < difference < 1e-6
