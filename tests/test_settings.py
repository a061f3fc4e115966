"""What a setting says of itself: what is allowed, in the check and in words."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from setting import Settings, setting, settings


@dataclass(frozen=True)
class Table(Settings):
    """One of each kind."""

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
        ({"share": -0.1}, "share = -0.1: must be finite, not negative and below 1 (of the light)"),
        ({"norm": math.nan}, "norm = nan: must be positive (of a gradient)"),
        ({"count": 2.5}, "count = 2.5: must be an integer, positive and at most 1,000 (points)"),
        ({"count": 1001}, "count = 1001: must be an integer, positive and at most 1,000 (points)"),
        ({"frame": "sun"}, "frame = 'sun': must be hill or body (of the position)"),
        ({"axes": (1.0,)}, "axes = [1.0]: must be 2 numbers, each finite and positive (m)"),
        ({"axes": (1.0, 0.0)}, "axes = [1.0, 0.0]: must be 2 numbers, each finite and positive (m)"),
        ({"span": (2.0, 1.0)}, "span = [2.0, 1.0]: must be [low, high] with low <= high, finite and at least -1 (s)"),
        ({"gain": (2.0, 1.0)}, "gain = [2.0, 1.0]: must be a value or [low, high] with low <= high, finite, not "
         "negative and at most 2 (no unit)"),
        ({"gain": (1.0, 3.0)}, "gain = [1.0, 3.0]: must be a value or [low, high]"),
        ({"gain": 3.0}, "gain = 3.0: must be a value or [low, high]"),
        ({"widths": ()}, "widths = []: must be one or more numbers, each an integer and positive (of layers)"),
        ({"widths": (8, 0)}, "widths = [8, 0]: must be one or more numbers, each an integer and positive (of layers)"),
        ({"mass": "2"}, "mass = '2': must be a number, finite and positive (kg, of the body)"),
        ({"mass": None}, "mass = None: must be a number, finite and positive (kg, of the body)"),
        ({"mass": True}, "mass = True: must be a number, finite and positive (kg, of the body)"),
        ({"mass": (2.0,)}, "mass = [2.0]: must be finite and positive (kg, of the body)"),
        ({"count": "3"}, "count = '3': must be an integer, positive and at most 1,000 (points)"),
        ({"count": True}, "count = True: must be an integer, positive and at most 1,000 (points)"),
        ({"frame": ["hill"]}, "frame = ['hill']: must be hill or body (of the position)"),
        ({"axes": ("1", 2.0)}, "axes = ['1', 2.0]: must be 2 numbers, each a number, finite and positive (m)"),
        ({"axes": [1.0, 2.0]}, "axes = [1.0, 2.0]: must be a tuple, 2 numbers, each finite and positive (m)"),
        ({"widths": 8}, "widths = 8: must be one or more numbers, each an integer and positive (of layers)"),
        ({"gain": "1"}, "gain = '1': must be a value or [low, high] with low <= high, a number, finite, not negative "
         "and at most 2 (no unit)"),
        ({"name": 3}, "name = 3: must be a string (anything)"),
        ({"on": "yes"}, "on = 'yes': must be true or false (whether)"),
        ({"on": 1}, "on = 1: must be true or false (whether)"),
        ({"named": ("hill", "sun")}, "named = ['hill', 'sun']: must be some of hill or body (frames)"),
    ],
)  # fmt: skip
def test_what_is_not_allowed_is_refused_with_what_is(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as refusal:
        Table(**values)
    assert str(refusal.value).startswith(said)


@pytest.mark.parametrize(
    "values",
    [
        {"offset": -1.0, "share": 0, "norm": math.inf, "count": 1, "axes": (2.0, 1.0)},
        {"mass": np.float32(3.0), "offset": 1, "count": np.int64(2), "axes": (np.float64(1.0), 3)},
        {"span": (-1.0, -1.0), "gain": (0.0, 2.0), "widths": (1, 2, 3), "named": ("body", "hill")},
    ],
)
def test_what_is_allowed_is_not_refused(values: dict[str, Any]) -> None:
    assert replace(Table(), **values) != Table()


def test_a_table_below_others_has_their_settings_and_checks() -> None:
    @dataclass(frozen=True)
    class More(Table):
        """With one more."""

        last: float = setting(1.0, "s")

    assert [*settings(More)] == [*settings(Table), "last"]
    assert settings(More)["mass"].about == "kg, of the body" and settings(More)["mass"].note == "Body"
    assert settings(More)["frame"].comment == "of the position: hill or body"
    for values in ({"mass": -1.0}, {"last": -1.0}):
        with pytest.raises(ValueError, match=next(iter(values))):
            More(**values)
