"""Settings: frozen dataclasses whose fields have a unit and bounds; TOML files override them, and flags the files.

A table of settings is a subclass of `Settings` whose fields are made by `setting`. A configuration is a dataclass whose
fields are tables.
"""

import argparse
import dataclasses
import math
import os
import tomllib
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from difflib import get_close_matches
from functools import partial
from numbers import Integral, Real
from pathlib import Path
from textwrap import wrap
from types import UnionType
from typing import Any, TypeVar

import tomli_w

CONFIGS = Path(__file__).parent / "configs"  # configurations that come with the code
RANGE = "[low, high] with low <= high"
KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}  # in words
FEW = 20  # largest number of words that a message lists
Value = TypeVar("Value")
Configuration = TypeVar("Configuration")


class InputError(ValueError):
    """Signals bad input from a person: the message says what was wrong, where, and what is allowed."""


# allowed values


@dataclass(frozen=True)
class Rule:
    """Describes a setting and the values that it may have.

    Attributes:
        about: unit and meaning, and where the value comes from unless the note says so.
        note: subject and source of this setting and the next ones, or the reason for its value.
        above, least, below, most: bounds of a number. The number must be finite unless `most` is infinity.
        among: the allowed values, alone or in a list.
        ordered: the value is [low, high], as is every pair that may stand in place of a single value.
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
        """Tells whether a value, or an item of a list, of this type is allowed."""
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
        """Returns unit and meaning, with the allowed values if these are listed."""
        return f"{self.about}: {self.words(str)}" if self.among else self.about

    def words(self, kind: type) -> str:
        """Returns in words which values `allows` allows."""
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


def setting(default: Value, about: str, **rule: Any) -> Value:
    """Makes a field of `Settings`; `rule` holds further arguments of `Rule`."""
    return field(default=default, metadata={"rule": Rule(about, **rule)})


@dataclass(frozen=True)
class Settings:
    """Holds a table of settings; raises ValueError, naming the setting and what is allowed, for a value that is not."""

    def __post_init__(self) -> None:
        for part in fields(self):
            if part.metadata:
                check(part, getattr(self, part.name))


def rules(table: type[Settings]) -> dict[str, Rule]:
    """Returns the rules of a table's settings by name."""
    return {part.name: part.metadata["rule"] for part in fields(table)}


def check(part: Field, value: Any) -> None:
    """Raises ValueError if a field of `Settings` may not have the value."""
    rule, kind, form = part.metadata["rule"], part.type, ""
    if isinstance(kind, UnionType):  # a value or a range
        single, pair = typing.get_args(kind)
        kind, form = pair if isinstance(value, tuple) else single, f"a value or {RANGE}, "
    items = list(value) if isinstance(value, tuple) else [value]
    element, *others = typing.get_args(kind) or (kind,)
    is_tuple, is_open = bool(typing.get_args(kind)), others == [...]
    if rule.ordered:
        form = f"{RANGE}, "
    elif is_open:
        numbers = "one or more" if element is str else "one or more numbers, each "
        form = "some of " if rule.among else numbers
    elif is_tuple and not form:
        form = f"{1 + len(others)} numbers, each "
    long_enough = bool(items) or part.default == () if is_open else len(items) == 1 + len(others)
    typed = all(is_a(element, item) for item in items)
    fits = isinstance(value, tuple) == is_tuple and long_enough and typed
    fits = fits and all(rule.allows(item, element) for item in items)
    if fits and (RANGE not in form or items[0] <= items[-1]):
        return
    words = rule.words(element)
    if is_tuple and isinstance(value, list):
        form = f"a tuple, {form}"
    elif not typed and element is not int and not rule.among:
        words = f"{KINDS[element]}, {words}" if words else KINDS[element]
    text = items if isinstance(value, tuple) else value
    raise ValueError(f"{part.name} = {text!r}: must be {form}{words} ({rule.about})")


def is_a(kind: type, item: Any) -> bool:
    """Tells whether an item is of a kind; numbers of NumPy count as numbers, true and false do not."""
    if kind in (bool, str):
        return isinstance(item, kind)
    return isinstance(item, Integral if kind is int else Real) and not isinstance(item, bool)


def shown(value: Any) -> str:
    """Returns a bound or a choice in words."""
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else value


def joined(words: Iterable[str], conjunction: str) -> str:
    """Returns words as a list in a sentence."""
    *first, last = words
    return f"{', '.join(first)} {conjunction} {last}" if first else last


def instead(word: str, allowed: Collection[str]) -> str:
    """Ends a message about an unknown word: returns the closest allowed words or, if none is close, all of a few."""
    if near := get_close_matches(word, allowed, 3, 0.7):
        return f"; did you mean {joined(near, 'or')}?"
    return f"; allowed are {', '.join(allowed)}" if len(allowed) <= FEW else ""


# files


def load(name: str | Path, base: Configuration) -> Configuration:
    """Reads a TOML file, or the configuration of this name that comes with the code, over a base.

    Args:
        name: a path, or a name such as `quickstart`, `vehicles/12u` or `12u`.

    Raises:
        InputError: neither exists, the text is not TOML, or it holds an unknown table or key or a value not allowed.
    """
    path = find(str(name))
    try:
        text = path.read_text(encoding="utf-8-sig")  # without the byte order mark that some editors write
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{name}: cannot read the configuration: {reason}") from None
    return from_toml(text, str(name), base)


def find(name: str) -> Path:
    """Returns the file of this path or, if none exists, the configuration of this name among CONFIGS."""
    if os.path.exists(name) and not os.path.isdir(name):
        return Path(name)
    paths = {path.relative_to(CONFIGS).with_suffix("").as_posix(): path for path in CONFIGS.rglob("*.toml")}
    key = name.removesuffix(".toml").removeprefix(f"{CONFIGS.name}/")
    found = [path for own, path in paths.items() if own == key or own.endswith(f"/{key}")]
    if key in paths or len(found) == 1:
        return paths.get(key, found[0])
    if found:
        several = ", ".join(sorted(own for own in paths if own.endswith(f"/{key}")))
        raise InputError(f"{name}: could be any of {several}; give one of these")
    words = {*paths, *(own.rpartition("/")[2] for own in paths)}
    meant = instead(key.lower(), words) or instead(key.lower().rpartition("/")[2], words)
    raise InputError(
        f"{name or 'an empty name'}: cannot read the configuration: neither a file nor one that comes with the code"
        f"{meant or ', such as quickstart, vehicles/12u or plants/u1'}"
    )


def from_toml(
    text: str,
    source: str,
    base: Configuration,
    change: Callable[[dict[str, Any]], dict[str, Any]] = lambda tables: tables,
) -> Configuration:
    """Reads TOML text over a base; tables that only a study has are ignored for the base of an experiment.

    Args:
        source: the name of the text in an error, usually the file's path.
        change: maps the tables to those that are read.

    Raises:
        InputError: see `load`.
    """
    try:
        tables = change(tomllib.loads(text))
    except (ValueError, RecursionError) as error:  # ValueError also for an integer that is too long to read
        reason = str(error).partition("; use sys.")[0]
        raise InputError(f"{source}: not valid TOML: {reason}") from None
    passed_over = {"study", "arms"} - set(vars(base))
    return override(base, {name: table for name, table in tables.items() if name not in passed_over}, source)


def override(config: Configuration, tables: Mapping[str, Any], source: str) -> Configuration:
    """Returns a configuration with the given tables' keys replaced, after checking them.

    Raises:
        InputError: a table or key is unknown or a value is not allowed; the message begins with `source`.
    """
    parts = vars(config)
    replaced: dict[str, Any] = {}
    for table, entries in tables.items():
        if table not in parts:
            owner = table_of(table, parts)
            if owner:
                raise InputError(f"{source}: {table} = {entries!r}: must stand below a table, [{owner}]")
            raise InputError(f"{source}: unknown table [{table}]{instead(table, parts)}")
        if not isinstance(entries, dict):
            raise InputError(f"{source}: {table} = {entries!r}: must be a table, [{table}]")
        if isinstance(parts[table], Settings):
            replaced[table] = override_table(parts[table], entries, parts, f"{source}: [{table}]")
        else:  # a study's arms, which hold tables themselves
            replaced[table] = entries
    try:
        return dataclasses.replace(config, **replaced)  # type: ignore[type-var]  # a dataclass of tables
    except ValueError as error:
        raise InputError(f"{source}: {error}") from None


def override_table(
    part: Settings, entries: dict[str, Any], tables: Mapping[str, Any], where: str
) -> Settings:
    """Returns a table with entries replaced; raises InputError as `override` does."""
    types = typing.get_type_hints(type(part))
    for key in entries:
        if key not in types:
            owner = table_of(key, tables)
            meant = f"; it stands in [{owner}]" if owner else instead(key, types)
            raise InputError(f"{where} unknown key {key!r}{meant or '; `config.toml` of a run lists all'}")
    try:
        values = {key: typed(value, types[key], key) for key, value in entries.items()}
        return dataclasses.replace(part, **values)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where} {error}") from None


def table_of(key: str, tables: Mapping[str, Any]) -> str | None:
    """Returns the name of the first table that has this key."""
    return next((name for name, part in tables.items() if key in getattr(part, "__dict__", ())), None)


def typed(value: Any, wanted: Any, name: str) -> Any:
    """Returns a value of TOML as the annotated type; raises InputError if the value has another type."""
    if isinstance(wanted, UnionType):
        wanted = typing.get_args(wanted)[isinstance(value, list)]
    if typing.get_origin(wanted) is tuple:
        element, *rest = typing.get_args(wanted)
        length = None if rest == [...] else 1 + len(rest)
        if not isinstance(value, list) or length not in (None, len(value)):
            raise InputError(
                f"{name} = {value!r}: must be a list of {length or 'several'} {element.__name__}s"
            )
        return tuple(typed(item, element, name) for item in value)
    if wanted is float and type(value) is int:
        return float(value)
    if wanted is int and type(value) is float and is_whole(value):  # 1e5
        return int(value)
    if type(value) is not wanted:
        raise InputError(f"{name} = {value!r}: must be {KINDS[wanted]}")
    return value


def to_toml(config: Any) -> str:
    """Returns TOML text that `from_toml` reads back, with unit and meaning beside each key and notes above."""
    lines: list[str] = []
    for name, part in vars(config).items():
        if not isinstance(part, Settings):
            lines += ["", tomli_w.dumps({name: part})] if part else []
            continue
        lines += ["", f"[{name}]"]
        for key, rule in rules(type(part)).items():
            note = wrap(rule.note, 118, initial_indent="# ", subsequent_indent="# ")
            lines += ["", *note] if note else []
            lines.append(f"{key} = {literal(getattr(part, key))} # {rule.comment}")
    return "\n".join(lines).lstrip() + "\n"


def literal(value: Any) -> str:
    """Returns a value as TOML, a tuple in one line."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(literal, value))}]"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip()


# flags


class Parser(argparse.ArgumentParser):
    """Parses flags; ends bad usage with one line and exit code 2, and suggests what may have been meant."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = [word.partition("=")[0] for word in args or ()]
        self.unknown = [
            word for word in words if word[:2] == "--" and word not in self._option_string_actions
        ]
        found, rest = super().parse_known_args(args, namespace)
        if rest:  # checked here because a command's own flags are known here
            self.error(f"unrecognized: {' '.join(rest)}{self.meant(rest[0])}")
        return found, rest

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            raise argparse.ArgumentError(
                None, f"there is no command {value!r}{instead(value, action.choices)}"
            )
        super()._check_value(action, value)

    def meant(self, word: str) -> str:
        flags = self._option_string_actions
        return instead(word.partition("=")[0], flags) if word.startswith("-") and len(flags) > FEW else ""

    def error(self, message: str) -> typing.NoReturn:
        if "required" in message and self.unknown:  # perhaps the required flag, mistyped
            message += f"; unrecognized: {' '.join(self.unknown)}{self.meant(self.unknown[0])}"
        self.exit(2, f"error: {self.prog}: {in_one_line(message)} (see --help)\n")


def in_one_line(text: str) -> str:
    """Returns a message as one line of printable characters, whatever names it holds."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


def add_flags(
    parser: argparse.ArgumentParser,
    config: Any,
    reached: Collection[str],
    short: Mapping[str, str],
    chosen_anew: Collection[str] | None = None,
) -> None:
    """Adds --config and a flag for every setting of `reached`, such as --rta.period 5.

    Args:
        config: the configuration whose settings the flags set, see `configured`.
        reached: tables, or settings as "table.key".
        short: short names of flags, with the setting of each. Only these flags are listed in --help, in this order.
        chosen_anew: settings that do not come from an agent's run; None: there is no agent.
    """
    group = parser.add_argument_group(
        "settings",
        "flags replace the settings of --config files, which replace those of an agent's run; every other setting also "
        "has a flag, --table.key VALUE (`python main.py config` prints all)",
    )
    add = group.add_argument
    text = "TOML file, or the name of a shipped one (12u, plants/u1); of several, later files replace earlier ones"
    add("--config", action="append", default=[], metavar="FILE", help=text)
    tables = {table: part for table, part in vars(config).items() if isinstance(part, Settings)}
    every = {
        f"{t}.{key}": (t, p, key, rule) for t, p in tables.items() for key, rule in rules(type(p)).items()
    }
    hints = {table: typing.get_type_hints(type(part)) for table, part in tables.items()}
    first = [meant for meant in short.values() if meant in every]
    for name in dict.fromkeys((*first, *every)):
        table, part, key, rule = every[name]
        if not {table, name} & set(reached):
            continue
        names = [flag for flag, meant in short.items() if meant == name]
        kind = hints[table][key]
        among = "{" + ",".join(map(shown, rule.among)) + "}" if 0 < len(rule.among) < 7 else "X"
        options: dict[str, Any] = {"metavar": "N" if kind is int else among, "type": partial(read, kind)}
        if kind is bool:
            options = {"action": argparse.BooleanOptionalAction}
        usual = literal(getattr(part, key))
        if chosen_anew is not None and name not in chosen_anew:
            usual = f"the agent's, else {usual}"
        text = f"{rule.comment} (default: {usual})"
        if names:
            add(*names, dest=name, default=argparse.SUPPRESS, help=text.replace("%", "%%"), **options)
        add(f"--{name}", dest=name, default=argparse.SUPPRESS, help=argparse.SUPPRESS, **options)


def read(kind: Any, text: str) -> Any:
    """Returns a flag's text as the value that TOML would give; a list has commas, with or without brackets."""
    if isinstance(kind, UnionType):
        kind = typing.get_args(kind)["," in text]
    if typing.get_origin(kind) is tuple:
        words = text.strip("[] ").split(",") if text.strip("[] ") else []
        return [read(typing.get_args(kind)[0], word.strip()) for word in words]
    try:
        return text.strip("\"'") if kind is str else whole(text) if kind is int else kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be {KINDS[kind]}") from None


def whole(text: str) -> int:
    """Returns an integer from its text, such as 100_000 or 1e5; raises ValueError for other text."""
    with suppress(ValueError):
        return int(text)
    if not is_whole(number := float(text)):
        raise ValueError(text)
    return int(number)


def is_whole(number: float) -> bool:
    """Tells whether a number is an integer of at most 2^53, and so exact."""
    return number.is_integer() and abs(number) <= 2**53


def positive_integer(text: str) -> int:
    """Returns a positive integer from a flag's text."""
    with suppress(ValueError):
        if 0 < (number := whole(text)) <= 10**12:
            return number
    raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be a positive integer up to 1,000,000,000,000")


def positive_number(text: str) -> float:
    """Returns a positive finite number from a flag's text."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be a positive number")
    return value


def configured(arguments: argparse.Namespace, base: Configuration) -> Configuration:
    """Returns the base, overridden by each --config in turn and then by the flags."""
    for name in arguments.config:
        base = load(name, base)
    tables: dict[str, dict[str, Any]] = {}
    for name, value in vars(arguments).items():
        table, dot, key = name.partition(".")
        if dot:
            tables.setdefault(table, {})[key] = value
    return override(base, tables, "command line")
