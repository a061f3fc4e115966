"""The adversary that looks ahead: what it tries, what it leaves alone, and that it finds what is planted."""

import functools
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.world.corners import CORNER, Recorded
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.verification.adversaries import Greedy, attacked, held_at_random
from study.verification.lookahead import Lookahead
from study.verification.starts import initial_states
from tests.study.verification.flown import flown as fly
from tests.study.verification.test_findings import verify
from tests.test_main import assert_refused, call

EPISODES, CANDIDATES = 16, 12
WORLD = {
    "mass_factor": 1.3,
    "hill_rotation": True,
    "position_noise": 0.02,
    "latency": 1,
    "missed_calls": 0.2,
}


@functools.cache
def experiment(world: bool) -> Experiment:
    """Returns an experiment in the model, or in a plant that the filter does not know."""
    tables = {"train": {"compile": "on", "device": "cpu"}, "plant": WORLD if world else {}}
    return Experiment(override(Config(), tables, "test"), EPISODES * CANDIDATES, seconds=1.0)


def flown(world: bool, looking: bool, duration: float = 10.0) -> tuple[SimpleNamespace, InspectionEnv]:
    """Flies the same starts and plants under lookahead or random controls."""
    here = experiment(world)
    env = here.env(EPISODES, None, 1.0, 1.0)
    x, priority, _ = initial_states(EPISODES, 3, here.filter)
    generator, number = torch.Generator().manual_seed(5), torch.linspace(0.1, 0.9, EPISODES)
    if looking:
        controller = Lookahead(env, here.env(EPISODES * CANDIDATES, None, 1.0, 1.0), 2, generator, EPISODES)
    else:
        controller = held_at_random(here.config.inspection, generator, EPISODES)
    return fly(env, controller, x, priority, duration, number=number.double()), env


def test_a_plant_heavier_than_the_filter_believes_is_broken_sooner_than_by_chance() -> None:
    """Of the same starts in the same plants it breaks more; in the model none."""
    ahead, random = (flown(True, looking)[0] for looking in (True, False))
    assert (ahead.violating[-1] > 0).sum() >= 4 + (random.violating[-1] > 0).sum()
    nominal, _ = flown(False, True, 5.0)
    assert not nominal.violating.any()


def test_the_same_seed_flies_the_same_and_leaves_the_plant_as_it_is() -> None:
    """The flight under recorded controls, without anybody looking ahead, passes through the same states."""
    (first, env), (again, _) = (flown(True, True, 4.0) for _ in range(2))
    for name in ("applied", "worst", "status"):
        assert torch.equal(getattr(first, name), getattr(again, name)), name
    recorded = first.desired
    alone = experiment(True).env(EPISODES, None, 1.0, 1.0)
    flight = fly(alone, lambda t, x: recorded[round(t)], *first.starts[:2], 4.0, number=first.starts.number)
    assert torch.equal(flight.applied, first.applied) and torch.equal(flight.worst, first.worst)
    for name, part in alone.plant.state_dict().items():
        assert torch.equal(part, env.plant.state_dict()[name]), name


@pytest.mark.parametrize("world", [False, True])
def test_what_is_tried_is_what_comes(world: bool) -> None:
    """The outcome of the candidate that every spacecraft then holds, recounted by flying on with it."""
    here = experiment(world)
    env, tried = (here.env(count, None, 1.0, 1.0) for count in (4, 4 * CANDIDATES))
    x, priority, _ = initial_states(4, 3, here.filter)
    env.start(x, priority, torch.tensor([0.2, 0.4, 0.6, 0.8], dtype=torch.float64))
    lookahead = Lookahead(env, tried, 3, torch.Generator().manual_seed(1), 4)
    promised: list[Tensor] = []

    def control(t: float, seen: Tensor) -> Tensor:
        desired = lookahead.draw()
        if t == 2.0:
            true = env.plant.true if world else seen
            promised.append(lookahead.outcome(env.time + t, true, desired)[:, 5])
            promised.append(desired[:, 5])
        return promised[1] if t >= 2.0 else desired[:, 1]

    came = [env.constraint_values(hold.after) for hold in env.fly(control, 5.0)][2:]
    expected = torch.stack(came).amin(0) / lookahead.scale
    np.testing.assert_allclose(promised[0], expected, rtol=1e-9, atol=1e-9)


def test_candidates_are_the_last_control_all_vertices_and_random_ones_within_the_limits() -> None:
    here = experiment(False)
    env, tried = (here.env(count, None, 1.0, 1.0) for count in (5, 5 * 40))
    whole, part = (
        Lookahead(env, tried, 2, torch.Generator().manual_seed(2), batch, first)
        for batch, first in ((20, 7), (20, 9))
    )
    whole.last += 1e-4
    drawn, other = whole.draw(), part.draw()
    assert drawn.shape == (6, 40, 5) and (drawn[:, 0] == 1e-4).all()
    units = drawn[:, 1:] / env.limit[..., None]
    assert units.abs().max() <= 1.0
    for group in (units[:3, :8], units[3:, :8]):
        assert len({tuple(vertex) for vertex in group[..., 0].T.tolist()}) == 8 and (group.abs() == 1.0).all()
    assert units[:, 8:].abs().max() < 1.0 and units[:, 8:].unique().numel() == units[:, 8:].numel()
    assert torch.equal(drawn[:, 9:, 2:], other[:, 9:, :3])  # by the column's number


def test_the_command_line_flies_and_continues_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "ahead.json"
    arguments = [
        *verify(path, "--policy", "lookahead", "--episodes", "4", "--duration", "3"),
        "--horizon",
        "1",
    ]
    code, _, err = call([*arguments, "--candidates", "3"], capsys)
    assert code == 0, err
    campaign = json.loads(path.read_text())["campaign"]
    assert (campaign["policy"], campaign["candidates"], campaign["horizon"]) == ("lookahead", 3, 1)
    assert_refused([*arguments, "--candidates", "4"], [str(path), "another campaign"], capsys)
    words = ["--policy random", "--candidates and --horizon", "lookahead"]
    assert_refused(["verify", "--policy", "random", "--candidates", "3"], words, capsys)
    assert_refused(["verify", "--policy", "adversarial", "--horizon", "3"], words[1:], capsys)


# at the worst


@functools.cache
def at_worst() -> Experiment:
    """Returns an experiment in a plant with worst errors that the filter does not know."""
    gains = {"errors": "worst", "thrust_gain": [0.8, 1.2], "missed_in_a_row": 2}
    tables = {"train": {"compile": "on", "device": "cpu"}, "plant": WORLD | gains}
    return Experiment(override(Config(), tables, "test"), EPISODES * CANDIDATES, seconds=1.0)


def choosing(batch: int, horizon: int) -> tuple[InspectionEnv, Lookahead, tuple[Tensor, Tensor, Tensor]]:
    """Returns an environment, the adversary of its world and of its controls, and starts."""
    here = at_worst()
    env, tried = (here.env(count, None, 1.0, 1.0) for count in (batch, batch * CANDIDATES))
    greedy = Greedy(here.filter, attacked(torch.arange(batch)))
    generator = torch.Generator().manual_seed(5)
    lookahead = Lookahead(env, tried, horizon, generator, batch, 0, greedy)
    env.plant.adversary = lookahead
    x, priority, _ = initial_states(batch, 3, here.filter)
    return env, lookahead, (x, priority, torch.linspace(0.1, 0.9, batch, dtype=torch.float64))


def test_what_is_tried_at_a_corner_is_what_comes() -> None:
    """The outcome of a candidate and its corners, recounted by flying on with both."""
    env, lookahead, start = choosing(4, 3)
    env.plant.adversary = None
    env.start(*start)
    desired, corners = lookahead.draw(), lookahead.draw_corners(env.time, env.x)
    promised = lookahead.outcome(env.time, env.x, desired, corners)[:, 7]
    env.start(*start)
    env.plant.adversary = Recorded(corners[:, :, 7], 1.0)
    came = [env.constraint_values(hold.after) for hold in env.fly(lambda t, x: desired[:, 7], 3.0)]
    np.testing.assert_allclose(promised, torch.stack(came).amin(0) / lookahead.scale, rtol=1e-9, atol=1e-9)


def test_its_flight_is_flown_again_by_its_controls_and_corners_and_misses_calls() -> None:
    env, lookahead, start = choosing(EPISODES, 2)
    first = fly(env, lookahead, *start[:2], 12.0, number=start[2])
    assert first.corners.shape == (12, CORNER, EPISODES)
    alone = at_worst().env(EPISODES, None, 1.0, 1.0)
    alone.plant.adversary = Recorded(first.corners, 1.0)
    again = fly(alone, lambda t, x: first.desired[round(t)], *start[:2], 12.0, number=start[2])
    assert torch.equal(again.applied, first.applied) and torch.equal(again.worst, first.worst)
    missed = 12 - first.status.sum(0)
    assert (missed > 0).sum() > EPISODES // 2
    # chance at the same worst breaks less
    by_chance = at_worst().env(EPISODES, None, 1.0, 1.0)
    random = held_at_random(at_worst().config.inspection, torch.Generator().manual_seed(5), EPISODES)
    chance = fly(by_chance, random, *start[:2], 12.0, number=start[2])
    assert (first.violating[-1] > 0).sum() >= 4 + (chance.violating[-1] > 0).sum()
