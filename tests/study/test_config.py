"""Configuration: TOML round trip and errors that name key, value and what is allowed."""

import dataclasses
import math
import re
from pathlib import Path

import pytest

from settings import CONFIGS, InputError, find, from_toml, load, override, to_toml
from study.config import Config, StudyConfig, of_today, recorded


def test_file_overrides_defaults_key_by_key() -> None:
    config = from_toml("[train]\nseed = 7\n[inspection]\nmass = 20\n", "text", Config())
    assert (config.train.seed, config.inspection.mass) == (7, 20.0)
    assert config.train.num_envs == Config().train.num_envs


@pytest.mark.parametrize(
    "name", ["vehicles/12u", "12u", "12u.toml", "configs/vehicles/12u.toml", "vehicles/12u.toml"]
)
def test_a_shipped_configuration_is_found_by_name_in_any_directory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(find(name)).samefile(CONFIGS / "vehicles" / "12u.toml")
    (tmp_path / "12u").mkdir()  # a directory is no configuration
    assert Path(find(name)).samefile(CONFIGS / "vehicles" / "12u.toml")
    own = tmp_path / name
    if own.is_dir():
        return
    own.parent.mkdir(parents=True, exist_ok=True)
    own.write_text("[inspection]\nmass = 3.0\n")
    assert load(name, Config()).inspection.mass == 3.0  # a file comes first


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[train]\nseeds = 1", ["[train]", "'seeds'", "seed"]),
        ("[learner]\nx = 1", ["[learner]", "train", "ppo"]),
        ("train = 3", ["train = 3", "table"]),
        ("[trian]\nseed = 1", ["unknown table [trian]; did you mean train?"]),
        ("mass = 3", ["mass = 3", "must stand below a table, [inspection]"]),
        ("[train]\ngamma = 0.9", ["[train] unknown key 'gamma'; it stands in [ppo]"]),
        ("[inspection]\nmas = 3", ["[inspection] unknown key 'mas'; did you mean mass?"]),
        ("[inspection]\nweight = 3", ["[inspection] unknown key 'weight'; `config.toml` of a run lists all"]),
        ("[studies]\nseeds = 3", ["unknown table [studies]; allowed are train, inspection"]),
        ("[plant]\nmass_factor = [0.9, 1.0, 1.1]", ["mass_factor", "list of 2"]),
        ("[plant]\nmass_factor = [1.1, 0.9]", ["mass_factor = [1.1, 0.9]", "low <= high"]),
        ("[plant]\nlatency = [0, 1.5]", ["latency = 1.5", "integer"]),
        ("not toml", ["TOML"]),
    ],
)
def test_bad_configuration_is_named(text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        from_toml(text, "file.toml", Config())
    message = str(caught.value)
    assert message.startswith("file.toml")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_value_or_a_range_of_them_survives_a_round_trip() -> None:
    config = from_toml(
        "[plant]\nmass_factor = [1, 1.2]\nrate_bias = 2\nlatency = [0, 3]\nfailing = 'torque_z'\n",
        "text",
        Config(),
    )
    plant = config.plant
    assert (plant.mass_factor, plant.rate_bias, plant.latency) == ((1.0, 1.2), 2.0, (0, 3))
    assert "mass_factor = [1.0, 1.2] # true mass" in to_toml(config)
    assert from_toml(to_toml(config), "text", Config()) == config
    assert StudyConfig(**vars(config)).of_arm("rta").plant == plant


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("plants/*.toml")), ids=lambda path: path.stem)
def test_the_shipped_plants_can_be_flown(path: Path) -> None:
    """Each states its effect and where it comes from, and nominal.toml takes every one of them away."""
    config = load(path, Config())
    assert config.plant.is_nominal == (path.stem == "nominal")
    assert path.read_text(encoding="utf-8").startswith("# ")
    robust = path.stem.startswith("u1")
    assert config.uncertainty.is_zero == (not robust)
    model = Config()
    assert dataclasses.replace(config, plant=model.plant, uncertainty=model.uncertainty) == model
    config.plant.check_body(config.inspection)
    taken = load(CONFIGS / "plants/nominal.toml", config)
    assert dataclasses.replace(taken, uncertainty=model.uncertainty) == model


def test_a_shipped_study_is_read_and_written_back() -> None:
    text = (CONFIGS.parent / "runs/reference/our_learner/config.toml").read_text(encoding="utf-8")
    study = recorded(text, "text", StudyConfig())
    assert from_toml(to_toml(study), "text", StudyConfig()) == study


def test_settings_that_filters_before_had_are_passed_over_in_records_alone() -> None:
    text = '[train]\nseed = 5\n[rta]\nrows = "paper"\nspeed_gain = 0.5 # 1/s\nperiod = 5.0\n'
    config = recorded(text, "text", Config())
    assert (config.train.seed, config.rta.period) == (5, 5.0)
    assert of_today({"rta": {"rows": "paper", "period": 5.0}}) == {"rta": {"period": 5.0}}
    with pytest.raises(InputError, match="unknown key 'rows'"):
        from_toml(text, "text", Config())


@pytest.mark.parametrize(
    ("table", "key", "off", "on"),
    [
        ("inspection", "orbit", '"clohessy-wiltshire"', '"two-body"'),
        ("inspection", "eccentricity", "0.0", "0.1"),
        ("ppo", "action_dead_zone", "0.0", "0.1"),
    ],
)
def test_a_record_of_a_removed_feature_is_read_only_where_the_feature_was_off(
    table: str, key: str, off: str, on: str
) -> None:
    assert recorded(f"[{table}]\n{key} = {off}\n", "text", Config()) == Config()
    assert recorded(f"[arms.a.{table}]\n{key} = {off}\n", "text", StudyConfig()).of_arm("a") == Config()
    with pytest.raises(InputError, match=f"unknown key '{key}'"):
        recorded(f"[{table}]\n{key} = {on}\n", "text", Config())


def test_every_key_is_explained_and_read_back() -> None:
    config = override(
        StudyConfig(),
        {"ppo": {"max_grad_norm": math.inf, "hidden": [64, 64, 64]}, "inspection": {"thermal_axis": "+z"}},
        "test",
    )
    text = to_toml(config)
    assert from_toml(text, "text", StudyConfig()) == config
    keys = [line for line in text.splitlines() if " = " in line and not line.startswith("#")]
    assert len(keys) == sum(len(getattr(part, "__dict__", ())) for part in vars(config).values())
    assert not [line for line in keys if not re.search(r" # \S+", line)]
    assert "hidden = [64, 64, 64] # widths of the hidden layers of policy and value network\n" in text
    assert "\n\n# Orbit and translation (Sec. Dynamics, Translational Motion)\nmean_motion = " in text


OWN_ARMS = """
[study]
arms = ["no_rta", "squared"]
[arms.squared.train]
rta = false
[arms.squared.ppo]
action_power = 2.0
hidden = [32, 32]
"""


def test_a_study_has_arms_of_its_own() -> None:
    study = from_toml(OWN_ARMS, "s.toml", StudyConfig())
    squared = study.of_arm("squared")
    assert (squared.train.rta, squared.ppo.action_power, squared.ppo.hidden) == (False, 2.0, (32, 32))
    assert study.of_arm("no_rta").ppo == Config().ppo and study.of_arm("rta").train.rta
    assert from_toml(to_toml(study), "s.toml", StudyConfig()) == study


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[study]\narms = ["cubed"]', "[study] arms (--arms): 'cubed' must be one of no_rta, rta"),
        ("[arms]\ncubed = 3", "[arms] cubed: must be tables, as [arms.cubed.ppo]"),
        ("[arms.rta.ppo]\ngamma = 0.9", "[arms.rta]: must be a name of its own"),
        ('[arms."../x".ppo]\ngamma = 0.9', "[arms.../x]: must be a name of its own"),
        ("[arms.cubed.train]\nseed = 7", "[arms.cubed.train] seed: must be the study's, in [train]"),
        ("[arms.cubed.ppo]\ncube = 3", "[arms.cubed]: [ppo] unknown key 'cube'"),
        (
            "[arms.cubed.ppo]\ngamma = 3",
            "[arms.cubed]: [ppo] gamma = 3.0: must be finite, positive and at most 1 (discount",
        ),
    ],
)
def test_arms_that_make_no_sense_are_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        from_toml(text, "s.toml", StudyConfig())
