"""The table [uncertainty]: read, written, refused in a line, and told to the filter that an experiment builds."""

from pathlib import Path

import pytest

from rta.bounds.uncertainty import Uncertainty
from settings import CONFIGS, InputError, from_toml, to_toml
from study.config import Config

PLANTS = sorted((CONFIGS / "plants").glob("*.toml"))


def test_without_the_table_the_filter_is_told_of_nothing() -> None:
    assert Config().uncertainty.is_nil
    assert from_toml("[train]\nseed = 1\n", "text", Config()).uncertainty == Uncertainty()


def test_what_is_told_survives_a_round_trip_through_toml() -> None:
    text = "[uncertainty]\nmass = 0.1\nlatency = 2\nhealth = true\nsaturates_rates = false\n"
    config = from_toml(text, "text", Config())
    assert config.uncertainty == Uncertainty(mass=0.1, latency=2, health=True, saturates_rates=False)
    assert from_toml(to_toml(config), "text", Config()) == config


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("mass = 1.0", ["mass = 1", "below 1"]),
        ("mass = -0.1", ["mass = -0.1", "not negative"]),
        ("mass = nan", ["mass = nan", "finite"]),
        ("mass = 'heavy'", ["mass", "'heavy'", "number"]),
        ("masses = 0.1", ["'masses'", "mass"]),
        ("latency = 1.5", ["latency = 1.5", "integer"]),
        ("latency = 11", ["latency", "at most 10 (calls"]),
        ("health = 1", ["health = 1", "true or false"]),
        ("minimum_thrust = 0.1\nthrust_quantum = 0.1", ["minimum_thrust", "thrust_quantum"]),
    ],
)
def test_a_bad_bound_ends_with_one_line_that_names_it(line: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        from_toml(f"[uncertainty]\n{line}\n", "file.toml", Config())
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("path", PLANTS, ids=lambda path: path.stem)
def test_every_world_that_is_shipped_can_be_told_to_a_filter(path: Path) -> None:
    config = from_toml(path.read_text(), path.name, Config())
    config.uncertainty.check(config.inspection, config.rta)
