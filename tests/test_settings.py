"""Settings: what is allowed, in the check and in words; files over defaults, and flags over files."""

import argparse
import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import pytest

import main
from settings import (
    CONFIGS,
    InputError,
    Settings,
    configured,
    find,
    literal,
    load,
    override,
    positive_integer,
    rules,
    setting,
    whole,
)
from study.config import Config, StudyConfig


@dataclass(frozen=True)
class Table(Settings):
    """Holds one setting of each kind."""

    mass: float = setting(2.0, "kg, of the body", above=0, note="Body")
    offset: float = setting(0.0, "m", least=None)
    share: float = setting(0.5, "of the light", below=1)
    norm: float = setting(0.5, "of a gradient", above=0, most=math.inf)
    count: int = setting(3, "points", above=0, most=1000)
    frame: str = setting("hill", "of the position", among=("hill", "body"))
    axes: tuple[float, float] = setting((1.0, 2.0), "m", above=0)
    span: tuple[float, float] = setting((1.0, 2.0), "s", least=-1, ordered=True)
    gain: float | tuple[float, float] = setting(1.0, "no unit", most=2)
    widths: tuple[int, ...] = setting((8,), "of layers", above=0)
    named: tuple[str, ...] = setting((), "frames", among=("hill", "body"))
    name: str = setting("", "anything")
    on: bool = setting(False, "whether")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"mass": 0.0}, "mass = 0.0: must be finite and positive (kg, of the body)"),
        ({"mass": math.inf}, "mass = inf: must be finite and positive (kg, of the body)"),
        ({"offset": math.nan}, "offset = nan: must be finite (m)"),
        ({"share": 1.0}, "share = 1.0: must be finite, not negative and below 1 (of the light)"),
        ({"norm": math.nan}, "norm = nan: must be positive (of a gradient)"),
        ({"count": 2.5}, "count = 2.5: must be an integer, positive and at most 1,000 (points)"),
        ({"frame": "sun"}, "frame = 'sun': must be hill or body (of the position)"),
        ({"axes": (1.0,)}, "axes = [1.0]: must be 2 numbers, each finite and positive (m)"),
        ({"span": (2.0, 1.0)}, "span = [2.0, 1.0]: must be [low, high] with low <= high, finite and at least -1 (s)"),
        ({"gain": (2.0, 1.0)}, "gain = [2.0, 1.0]: must be a value or [low, high] with low <= high, finite, not "
         "negative and at most 2 (no unit)"),
        ({"gain": 3.0}, "gain = 3.0: must be a value or [low, high]"),
        ({"widths": ()}, "widths = []: must be one or more numbers, each an integer and positive (of layers)"),
        ({"mass": "2"}, "mass = '2': must be a number, finite and positive (kg, of the body)"),
        ({"mass": (2.0,)}, "mass = [2.0]: must be finite and positive (kg, of the body)"),
        ({"count": True}, "count = True: must be an integer, positive and at most 1,000 (points)"),
        ({"axes": [1.0, 2.0]}, "axes = [1.0, 2.0]: must be a tuple, 2 numbers, each finite and positive (m)"),
        ({"widths": 8}, "widths = 8: must be one or more numbers, each an integer and positive (of layers)"),
        ({"gain": "1"}, "gain = '1': must be a value or [low, high] with low <= high, a number, finite, not negative "
         "and at most 2 (no unit)"),
        ({"name": 3}, "name = 3: must be a string (anything)"),
        ({"on": "yes"}, "on = 'yes': must be true or false (whether)"),
        ({"named": ("hill", "sun")}, "named = ['hill', 'sun']: must be some of hill or body (frames)"),
    ],
)  # fmt: skip
def test_what_is_not_allowed_is_refused_with_what_is(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as refusal:
        Table(**values)
    assert str(refusal.value).startswith(said)


def test_a_table_below_others_has_their_settings_and_checks() -> None:
    @dataclass(frozen=True)
    class More(Table):
        """Adds a setting to Table."""

        last: float = setting(1.0, "s")

    assert [*rules(More)] == [*rules(Table), "last"]
    assert rules(More)["mass"].about == "kg, of the body" and rules(More)["mass"].note == "Body"
    assert rules(More)["frame"].comment == "of the position: hill or body"
    for values in ({"mass": -1.0}, {"last": -1.0}):
        with pytest.raises(ValueError, match=next(iter(values))):
            More(**values)


# all settings of the program


EVERY = [
    pytest.param(table, key, id=f"{table}.{key}")
    for table, part in vars(StudyConfig()).items()
    if isinstance(part, Settings)
    for key in rules(type(part))
]


def beyond(rule: Any, kind: type) -> list[Any]:
    """Returns values beyond each bound of a setting, and of other types."""
    if rule.among or kind in (str, bool):
        return [3.5, *(["no such word"] if rule.among else [])]
    found: list[Any] = ["word", True]
    step = 1 if kind is int else 1e-6
    found += [rule.above, rule.above - step] if rule.above is not None else []
    found += [rule.least - step] if rule.above is None and rule.least is not None else []
    found += [rule.below] if rule.below is not None else []
    found += [math.nan, math.inf] if kind is float and rule.most != math.inf else []
    return found + ([rule.most + max(step, rule.most * 1e-9)] if rule.most not in (None, math.inf) else [])


@pytest.mark.parametrize(("table", "key"), EVERY)
def test_every_declared_bound_is_enforced(table: str, key: str) -> None:
    part = vars(StudyConfig())[table]
    rule, kind = rules(type(part))[key], get_type_hints(type(part))[key]
    if isinstance(kind, UnionType):
        kind = get_args(kind)[0]
    element = (get_args(kind) or (kind,))[0]
    value = getattr(part, key)
    for bad in beyond(rule, element):
        items = tuple(bad for _ in value) or (bad,) if isinstance(value, tuple) else bad
        with pytest.raises(ValueError, match=rf"^{key} = .*: must be "):
            replace(part, **{key: items})


parser = functools.cache(main.build_parser)  # which takes a tenth of a second


@pytest.mark.parametrize(("table", "key"), EVERY)
def test_every_setting_has_a_flag_and_a_meaning(table: str, key: str) -> None:
    part = vars(StudyConfig())[table]
    assert rules(type(part))[key].about
    value = getattr(part, key)
    text = f"--{table}.{key}={literal(value).strip(chr(34))}"
    if isinstance(value, bool):
        text = f"--{'' if value else 'no-'}{table}.{key}"
    given = parser().parse_args(["study", text])
    assert f"{table}.{key}" in vars(given)
    assert configured(given, StudyConfig()) == StudyConfig()


@pytest.mark.parametrize(
    ("words", "table", "key", "value"),
    [
        ("--no-rta", "train", "rta", False),
        ("--no-train.rta", "train", "rta", False),
        ("--rta-period 5", "rta", "period", 5.0),
        ("--rta.period 10.0", "rta", "period", 10.0),
        ("--inspection.mass 1e1", "inspection", "mass", 10.0),
        ("--interactions 1_000", "train", "interactions", 1000),
        ("--solar-panel-axis -z", "inspection", "solar_panel_axis", "-z"),
        ("--solar-panel-axis=+z", "inspection", "solar_panel_axis", "+z"),
        ("--adversary battery,collision", "train", "adversary", ("battery", "collision")),
        ("--inspection.inertia 0.1,0.1,0.15", "inspection", "inertia", (0.1, 0.1, 0.15)),
        ("--inspection.initial_temperature -1,2", "inspection", "initial_temperature", (-1.0, 2.0)),
        ("--plant.mass_factor 1.1", "plant", "mass_factor", 1.1),
        ("--plant.mass_factor [0.9,1.1]", "plant", "mass_factor", (0.9, 1.1)),
        ("--plant.latency 0,2", "plant", "latency", (0, 2)),
    ],
)
def test_a_flag_changes_its_setting_and_no_other(words: str, table: str, key: str, value: Any) -> None:
    given = parser().parse_args(main.with_values(["train", *words.split()]))
    config = configured(given, Config())
    assert getattr(vars(config)[table], key) == value
    assert config == replace(Config(), **{table: replace(vars(Config())[table], **{key: value})})


def test_files_go_over_the_base_in_their_order_and_flags_over_them(tmp_path: Path) -> None:
    files = [tmp_path / "one.toml", tmp_path / "two.toml"]
    files[0].write_text("[inspection]\nmass = 20.0\nmax_thrust = 2.0\n[train]\nseed = 5\n", encoding="utf-8")
    files[1].write_text("[inspection]\nmass = 30.0\n", encoding="utf-8")
    words = [word for file in files for word in ("--config", str(file))]
    base = override(Config(), {"inspection": {"mass": 40.0, "deputy_radius": 4.0}}, "test")
    found = configured(main.build_parser().parse_args(["train", *words, "--seed", "6"]), base)
    task = found.inspection
    assert (task.mass, task.max_thrust, task.deputy_radius, found.train.seed) == (30.0, 2.0, 4.0, 6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[train]\nseed = true", "[train] seed = True: must be an integer"),
        (
            "[inspection]\ninertia = [1.0, 2.0]",
            "[inspection] inertia = [1.0, 2.0]: must be a list of 3 floats",
        ),
    ],
)
def test_a_value_of_another_type_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refusal:
        configured(main.build_parser().parse_args(["train", "--config", str(path)]), Config())
    assert str(refusal.value) == f"{path}: {said}"


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("100_000", 100_000),
        ("1e5", 100_000),
        ("2.5e3", 2500),
        ("1E0", 1),
        ("7", 7),
    ],
)
def test_a_whole_number_is_an_integer_wherever_one_is_asked_for(
    text: str, number: int, tmp_path: Path
) -> None:
    assert whole(text) == positive_integer(text) == number
    path = tmp_path / "c.toml"
    path.write_text(f"[train]\nseed = {text}\n")
    seed = load(path, Config()).train.seed
    assert seed == number and type(seed) is int
    given = main.build_parser().parse_args(["train", "--seed", text])
    assert configured(given, Config()).train.seed == number
    given = main.build_parser().parse_args(
        ["evaluate", "--controller", "zero", "--seed", text, "--episodes", text]
    )
    assert given.seed == given.episodes == number


@pytest.mark.parametrize("text", ["1.5", "1e-1", "1e16", "1e400", "nan", "inf", "", "x", "1" * 5000])
def test_what_is_no_integer_or_not_exactly_one_is_none(text: str) -> None:
    with pytest.raises(ValueError):
        whole(text)
    with pytest.raises(argparse.ArgumentTypeError, match="must be a positive integer"):
        positive_integer(text)


@pytest.mark.parametrize("name", ["from_nothing", "paper", "sweeps/paper"])
def test_a_name_finds_the_file_of_just_this_name_first(name: str) -> None:
    assert find(name) == CONFIGS / f"{name}.toml"
