"""What a flag is: the setting or parameter that it reaches, and how its text is read and checked."""

import argparse
import sys
from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any, NoReturn

from rta.constraints.names import CONSTRAINTS
from rta.parameters import PERIODS
from setting import Setting, Settings, settings
from study.commands import FILES
from study.config import ARMS, MAX_COUNT, StudyConfig
from study.errors import in_one_line, instead, nearest


class Parser(argparse.ArgumentParser):
    """Bad usage ends with one line and exit code 2, and names what may have been meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self.given = list(args or [])
        known, rest = super().parse_known_args(args, namespace)
        if rest:  # here, where a command's own flags are known
            self.error(f"unrecognized: {' '.join(rest)}{self.meant(rest)}")
        return known, rest

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            raise argparse.ArgumentError(
                None, f"there is no command {value!r}{instead(value, action.choices)}"
            )
        super()._check_value(action, value)

    def _print_message(self, message: str, file: Any = None) -> None:
        print(message, end="", file=file or sys.stderr)  # argparse would hide that it cannot be written

    def meant(self, words: Sequence[str]) -> str:
        """Which flags were meant by the first of words that looks like one; empty where none does."""
        given = next((word for word in words if word.startswith("-")), "")
        return nearest(given.partition("=")[0], self._option_string_actions)

    def error(self, message: str) -> NoReturn:
        flags = [word.partition("=")[0] for word in self.given if word.startswith("--")]
        unknown = [flag for flag in flags if flag not in self._option_string_actions]
        if "required" in message and unknown:  # one of those, mistyped
            message += f"; unrecognized: {' '.join(unknown)}{self.meant(unknown)}"
        self.exit(2, f"error: {self.prog}: {in_one_line(message)} (see --help)\n")


def positive_integer(text: str) -> int:
    """A count for argparse."""
    try:
        value = int(text.replace("_", ""))
    except ValueError:
        value = 0
    if not 0 < value <= MAX_COUNT:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be a positive integer up to {MAX_COUNT:,}")
    return value


def seed_number(text: str) -> int:
    """A seed for argparse."""
    if not (text.isascii() and text.isdecimal() and len(text) < 20) or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be an integer from 0 to 2^63 - 1")
    return int(text)


def positive_number(text: str) -> float:
    """A positive finite number for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a positive number")
    return value


def batch_list(text: str) -> tuple[int, ...]:
    """Comma-separated counts for argparse."""
    return tuple(positive_integer(word) for word in text.split(","))


def arm_list(text: str) -> list[str]:
    """Comma-separated arms of a study for argparse."""
    names = text.split(",")
    if len(set(names)) < len(names) or not all(names):
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be {','.join(ARMS)} or others, each once")
    return names


def constraint_list(text: str) -> list[str]:
    """Comma-separated constraints for argparse."""
    names = text.split(",")
    if unknown := [name for name in names if name not in CONSTRAINTS]:
        raise argparse.ArgumentTypeError(
            f"{unknown[0][:40]!r}: must be one or more of {', '.join(CONSTRAINTS)}"
        )
    return names


def period(text: str) -> float:
    """A filter period for argparse."""
    if text not in {f"{p:g}" for p in PERIODS} | {f"{p:.1f}" for p in PERIODS}:
        raise argparse.ArgumentTypeError(f"{text!r}: must be 1, 5 or 10 (s)")
    return float(text)


def verified_policy(text: str) -> str:
    """A policy of verify for argparse."""
    names_file = text.startswith(FILES) and text not in FILES
    if text not in ("random", "adversarial", "pressing", "lookahead") and not names_file:
        raise argparse.ArgumentTypeError(
            f"{text!r}: must be random, adversarial, pressing, lookahead, learned:F or checkpoint:F"
        )
    return text


def setting_of(name: str) -> Setting:
    """What a setting, "table.key", says of itself; nothing where there is none."""
    table, _, key = name.partition(".")
    part: Settings = getattr(StudyConfig(), table, Settings())
    return settings(type(part)).get(key, Setting(""))


class Flag:
    """A flag: what it reaches, how it is read and what --help says.

    Args:
        name: as it is written; without dashes it is a positional argument.
        text: of --help, which goes on with the default, unless the text has it or a {} for it; without one, what the
            setting says of itself.
        sets: the setting it reaches, as "table.key"; without one, the parameter of the command's function by its name.
        alone: what it names, if that holds all settings, so that no other flag is allowed beside it but those `beside`.
        without: flags that mean nothing beside it.
        reads: it names a file that is read; writes: the suffix of one that is written.
        key: of the JSON that is written, by which the command knows a file that it may replace; "": it looks itself.
        options: what else `add_argument` takes: type, metavar, ...; without a type its choices are the setting's.
    """

    def __init__(
        self,
        name: str,
        text: str = "",
        sets: str = "",
        alone: str = "",
        beside: tuple[str, ...] = (),
        without: tuple[str, ...] = (),
        reads: bool = False,
        writes: str = "",
        key: str = "",
        **options: Any,
    ) -> None:
        own = setting_of(sets)
        if own.among and "type" not in options:
            options = {"choices": tuple(own.among)} | options
        self.name, self.text = name, text or own.comment.replace("%", "%%")
        self.alone, self.beside, self.options = alone, beside, options
        self.reads, self.writes, self.key, self.without = reads, writes, key, without
        self.dest = sets or name.removeprefix("--").replace("-", "_")

    def saying(self, text: str) -> "Flag":
        """The same flag with another text."""
        other = copy(self)
        other.text = text
        return other


class Command:
    """A command: its line in the help, its flags and those of which exactly one must be given.

    `imposed` holds settings, as "table.key", over those of --config and under the flags.
    """

    def __init__(
        self, about: str, *flags: Flag, one_of: tuple[Flag, ...] = (), imposed: dict[str, Any] | None = None
    ) -> None:
        self.about, self.flags, self.one_of, self.imposed = about, (*flags, *one_of), one_of, imposed or {}


count = partial(Flag, type=positive_integer, metavar="N")
number = partial(Flag, type=positive_number)
seed = partial(Flag, "--seed", type=seed_number, metavar="N")
directory = partial(Flag, metavar="D")
read = partial(Flag, reads=True, metavar="F")


def written(suffix: str, name: str, text: str, metavar: str = "F", **options: Any) -> Flag:
    """A flag for a file that is written; the options are those of `Flag`."""
    return Flag(name, text, writes=suffix, metavar=metavar, **options)
