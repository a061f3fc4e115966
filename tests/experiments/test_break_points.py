"""`break-points`: what a world is, what counts as its break point, and that a report goes on."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments import break_points
from experiments.break_points import EFFECTS, Effect, figure, outcome, said, table
from inspection.world.parameters import PlantParameters
from rta.names import CONSTRAINTS
from settings import override
from study.config import Config
from tests.test_main import assert_refused, call


def world(effect: str, size: float, told: bool, *violated: str) -> dict[str, Any]:
    counts = {name: 2 * (name in violated) for name in CONSTRAINTS} | {"any": 2 * bool(violated)}
    return {"effect": effect, "size": size, "told": told, "violating_episodes": counts}


@pytest.mark.parametrize("effect", EFFECTS)
def test_what_is_told_bounds_what_is_flown(effect: str) -> None:
    own = EFFECTS[effect]
    assert list(own.sizes) == sorted(set(own.sizes))
    for size in own.sizes:
        tables = {"plant": own.plant(size), "uncertainty": own.told(size, 1.0)}
        config = override(Config(), tables, effect)
        plant, uncertainty = config.plant, config.uncertainty
        assert plant != PlantParameters() and not uncertainty.is_zero
        for name, factor in (("mass", plant.mass_factor), ("inertia", plant.inertia_factor)):
            if isinstance(factor, tuple):
                assert max(factor) - 1 <= getattr(uncertainty, name) + 1e-12
        for kind in ("position", "velocity", "attitude", "rate"):
            most = getattr(plant, f"{kind}_noise") * plant.noise_bound
            assert most <= getattr(uncertainty, kind) + 1e-12
        if plant.missed_calls:
            assert uncertainty.longest_hold == plant.missed_in_a_row + 1


def test_a_break_point_is_the_smallest_size_that_was_violated() -> None:
    worlds = [
        world("mass", 0.3, False, "keep_in_zone", "velocity_y"),
        world("mass", 0.03, False),
        world("mass", 0.1, False, "keep_in_zone"),
        world("mass", 0.03, True),
        world("mass", 0.1, True),
        {"effect": "mass", "size": 0.3, "told": True, "refused": "leaves no braking"},
    ]
    report = {"worlds": worlds}
    found = outcome(report, "mass", told=False)
    assert found.broken == {"zone": 0.1, "velocity": 0.3} and found.held == 0.03 and found.refused is None
    assert outcome(report, "mass", told=True) == (0.1, {}, 0.3)
    lines = table(report).splitlines()
    assert lines[1].endswith(" holds 0.03, breaks at 0.1 (zone)")
    assert lines[2].endswith(" holds 0.1, refuses 0.3")
    texts = [text.get_text() for ax in figure(report).axes for text in ax.texts]
    assert texts.count("0.1") == 1 and texts.count("0.3") == 1 and "refused from 0.3" in texts


def test_a_size_that_is_refused_never_holds() -> None:
    flown = [world("mass", size, True) for size in (0.03, 0.1)]
    worlds = [{"effect": "mass", "size": 0.3, "told": True, "refused": "no check is known"}, *flown]
    report = {"worlds": [*worlds, world("mass", 0.5, True, "keep_in_zone")]}
    assert outcome(report, "mass", told=True).held == 0.1
    assert said(report, "mass", told=True) == "holds 0.1, breaks at 0.5 (zone), refuses 0.3"
    hatched = [patch for ax in figure(report).axes for patch in ax.patches if patch.get_hatch()]
    assert len(hatched) == 8  # all columns of the panel with bounds but the zone, which broke


@pytest.mark.campaign
def test_worlds_are_flown_once_and_break_where_they_must(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that nothing changes, one in which the filter is wrong about the speed."""
    effect = Effect(
        "", (1e-9, 0.99), lambda size: {"velocity_bias": 3.0 * size}, lambda size, _: {"thrust_gain": size}
    )
    monkeypatch.setattr(break_points, "EFFECTS", {"mass": effect})
    path, picture = tmp_path / "report.json", tmp_path / "figure.png"
    flags = ["--episodes", "12", "--duration", "10", "--json", str(path), "--compile", "on"]
    command = ["break-points", "--figure", str(picture), *flags]
    code, out, err = call(command, capsys)
    assert code == 0, err
    worlds = json.loads(path.read_text())["worlds"]
    known = [(world["size"], world["told"]) for world in worlds]
    assert known == [(1e-9, False), (1e-9, True), (0.99, False), (0.99, True)]
    violated = [world["violating_episodes"]["any"] for world in worlds[:3]]
    assert violated[:2] == [0, 0] and violated[2] > 0
    assert "thrust_gain = 0.99" in worlds[3]["refused"]
    assert "holds 1e-09, breaks at 0.99 (speed" in out and "refuses 0.99" in out
    assert picture.stat().st_size > 10_000
    monkeypatch.setattr(break_points, "fly_world", None)  # nothing is left to fly
    assert call(command, capsys)[0] == 0
    assert_refused([*command, "--policy", "nobody"], ["'nobody'", "random", "lookahead"], capsys)
