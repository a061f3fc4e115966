"""What a setting says of itself: its unit and meaning, and what is allowed.

A table of settings is a frozen dataclass below `Settings` whose fields are made by `setting`. Its checks, the comments
of a written configuration and whoever else explains a setting read the same words.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from types import UnionType
from typing import Any, TypeVar, get_args

Default = TypeVar("Default")
RANGE = "[low, high] with low <= high"
KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}  # in words


@dataclass(frozen=True)
class Setting:
    """What is known of a setting beside its name, type and default.

    Attributes:
        about: its unit and meaning, and where its value comes from unless the note says so.
        note: subject and source of this setting and the next ones, or the reason for its value.
        above, least, below, most: bounds of each number. By default it is not negative; it is finite unless `most` is
            infinity.
        among: the values that are allowed, each alone or in a list.
        ordered: it is [low, high], as is every pair that may stand in place of a single value.
    """

    about: str
    note: str = ""
    above: float | None = None
    least: float | None = 0.0
    below: float | None = None
    most: float | None = None
    among: Collection[Any] = ()
    ordered: bool = False

    def allows(self, item: Any, kind: type) -> bool:
        """Whether this may be the value, or an item of the list, of this type, which it is of."""
        if self.among or kind in (bool, str):
            return not self.among or item in self.among
        return (
            (kind is int or math.isfinite(item) or self.most == math.inf)
            and (self.above is None or item > self.above)
            and (self.least is None or item >= self.least)
            and (self.below is None or item < self.below)
            and (self.most is None or item <= self.most)
        )

    @property
    def comment(self) -> str:
        """What it is about, with the values that are allowed."""
        return f"{self.about}: {self.rule(str)}" if self.among else self.about

    def rule(self, kind: type) -> str:
        """What `allows` asks for, in words."""
        if self.among:
            return joined(map(shown, self.among), "or")
        if kind in (bool, str):
            return ""
        words = ["an integer"] if kind is int else ["finite"] if self.most != math.inf else []
        for bound, of_zero, otherwise in (
            (self.above, "positive", "above"),
            (self.least if self.above is None else None, "not negative", "at least"),
            (self.below, "negative", "below"),
            (self.most, "not positive", "at most"),
        ):
            if bound not in (None, math.inf):
                words.append(f"{otherwise} {shown(bound)}" if bound else of_zero)
        return joined(words, "and")


def setting(default: Default, about: str, **more: Any) -> Default:
    """A field of `Settings` with this default; the other arguments are those of `Setting`."""
    return field(default=default, metadata={"setting": Setting(about, **more)})


@dataclass(frozen=True)
class Settings:
    """A table of settings; raises ValueError, naming the setting and what is allowed, where one is not."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if each.metadata:
                check(each, getattr(self, each.name))


def settings(table: type[Settings]) -> dict[str, Setting]:
    """What a table's settings say of themselves, by name."""
    return {each.name: each.metadata["setting"] for each in fields(table)}


def check(of: Field, value: Any) -> None:
    """Raises ValueError where a field of `Settings` may not have a value."""
    own, kind, form = of.metadata["setting"], of.type, ""
    if isinstance(kind, UnionType):
        single, pair = get_args(kind)
        kind, form = pair if isinstance(value, tuple) else single, f"a value or {RANGE}, "
    items = list(value) if isinstance(value, tuple) else [value]
    element, *others = get_args(kind) or (kind,)
    count, is_open = 1 + len(others), others == [...]
    if own.ordered:
        form = f"{RANGE}, "
    elif is_open:
        form = (
            "some of " if own.among else "one or more numbers, each " if element is not str else "one or more"
        )
    elif count > 1 and not form:
        form = f"{count} numbers, each "
    is_tuple = bool(get_args(kind))
    fits = isinstance(value, tuple) == is_tuple
    fits = fits and ((bool(items) or of.default == ()) if is_open else len(items) == count)
    right = all(is_a(element, item) for item in items)
    fits = fits and right and all(own.allows(item, element) for item in items)
    if not fits or (RANGE in form and items[0] > items[-1]):
        text, rule = items if isinstance(value, tuple) else value, own.rule(element)
        if is_tuple and isinstance(value, list):
            form = f"a tuple, {form}"
        elif not right and element is not int and not own.among:
            rule = f"{KINDS[element]}, {rule}" if rule else KINDS[element]
        raise ValueError(f"{of.name} = {text!r}: must be {form}{rule} ({own.about})")


def is_a(kind: type, item: Any) -> bool:
    """Whether it is a number, text or truth value as wanted; NumPy's numbers are numbers, true and false are none."""
    if kind in (bool, str):
        return isinstance(item, kind)
    return isinstance(item, Integral if kind is int else Real) and not isinstance(item, bool)


def shown(value: Any) -> str:
    """A bound or a choice in words."""
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else value


def joined(words: Iterable[str], conjunction: str) -> str:
    """Words as a list in a sentence."""
    *first, last = words
    return f"{', '.join(first)} {conjunction} {last}" if first else last
