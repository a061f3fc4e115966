"""Configuration: TOML round trip and errors that name key, value and what is allowed."""

import pytest

from study import config as configuration
from study.config import Config
from study.errors import InputError


def test_defaults_survive_a_round_trip_through_toml() -> None:
    assert configuration.from_toml(Config().to_toml(), "text") == Config()


def test_file_overrides_defaults_key_by_key() -> None:
    config = configuration.from_toml("[train]\nseed = 7\n[inspection]\nmass = 20\n", "text")
    assert (config.train.seed, config.inspection.mass) == (7, 20.0)
    assert config.train.num_envs == Config().train.num_envs


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[train]\nseeds = 1", ["[train]", "'seeds'", "seed"]),
        ("[learner]\nx = 1", ["[learner]", "train", "ppo"]),
        ("train = 3", ["train = 3", "table"]),
        ("[train]\nseed = 1.5", ["seed = 1.5", "integer"]),
        ("[train]\nrta = 1", ["rta = 1", "true or false"]),
        ("[train]\nnum_envs = 0", ["num_envs = 0", "positive"]),
        ("[train]\nrta_period = 2.0", ["rta_period = 2", "1, 5 or 10"]),
        ("[train]\nrta_period = true", ["rta_period = True", "number"]),
        ("[train]\ndevice = 'tpu'", ["device", "'tpu'", "cuda"]),
        ("[inspection]\nsolar_panel_axis = 'x'", ["solar_panel_axis", "'x'", "+x"]),
        ("[inspection]\ninertia = [1.0, 2.0]", ["inertia", "3"]),
        ("[inspection]\nmass = -1.0", ["mass = -1", "positive"]),
        ("[inspection]\nmass = nan", ["mass = nan", "positive"]),
        ("[rta]\nspeed_gain = -0.1", ["speed_gain = -0.1", "negative"]),
        ("[ppo]\ngamma = 1.5", ["gamma", "1.5"]),
        ("not toml", ["TOML"]),
    ],
)
def test_bad_configuration_is_named(text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        configuration.from_toml(text, "file.toml")
    message = str(caught.value)
    assert message.startswith("file.toml")
    assert "\n" not in message
    for word in words:
        assert word in message
