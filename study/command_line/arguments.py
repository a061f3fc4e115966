"""The command line: what the words of a call are, and what they set."""

import argparse
import importlib.metadata
import inspect
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from study import config as configuration
from study.command_line.commands import COMMANDS, CONFIG
from study.command_line.flags import Command, Parser
from study.command_line.paths import check_inputs, check_outputs, check_replaced
from study.commands import INSTALLED, called, in_file
from study.config import AnyConfig, StudyConfig
from study.errors import InputError
from study.files import ROOT

# What flags can set, and its value where nothing does: --config, and each key as "table.key".
SETTINGS = {"config": ()} | {
    f"{table}.{key}": value
    for table, part in vars(StudyConfig()).items()
    for key, value in vars(part).items()
}
OF_THE_PROCESS = {"threads": None, "cache_dir": None}  # what a flag can set that is no part of an experiment
Handler = Callable[..., None]  # of a command; its parameters are `configure` and the flags that set nothing


def build_parser(handlers: Mapping[str, Handler], description: str | None = None) -> Parser:
    """The whole command line, for the commands' functions; raises ValueError if a flag reaches nothing."""
    parser = Parser(prog=called(), description=description, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"{INSTALLED} {version()}")
    commands = parser.add_subparsers(dest="command", required=True, metavar=" | ".join(COMMANDS))
    for name, command in COMMANDS.items():
        about = command.about[0].upper() + command.about[1:] + "."
        own = commands.add_parser(name, allow_abbrev=False, help=command.about, description=about)
        add_flags(own, command, handlers[name])
    return parser


def version() -> str:
    """Of this code: what its pyproject.toml says or, where it is installed without one, the package."""
    source = ROOT / "pyproject.toml"
    if source.is_file():
        return tomllib.loads(source.read_text(encoding="utf-8"))["project"]["version"]
    return importlib.metadata.version(INSTALLED)


def add_flags(parser: Parser, command: Command, handler: Handler) -> None:
    """Gives a command's parser its flags; those not given stay out of the parsed arguments."""
    wanted = {name: each.default for name, each in inspect.signature(handler).parameters.items()}
    reached = OF_THE_PROCESS | (SETTINGS | command.imposed if "configure" in wanted else {}) | wanted
    group = parser.add_mutually_exclusive_group(required=True) if command.one_of else parser
    for each in command.flags:
        if each.dest not in reached:
            raise ValueError(f"{parser.prog} {each.name} reaches nothing: there is no {each.dest}")
        default, options = reached[each.dest], dict(each.options)
        required = default is inspect.Parameter.empty
        if each.name.startswith("--"):
            options |= {"dest": each.dest, "required": required}
        (group if each in command.one_of else parser).add_argument(
            each.name,
            default=argparse.SUPPRESS,
            help=each.text if required else with_default(each.text, default),
            **options,
        )
    if idle := wanted.keys() - {"configure"} - {each.dest for each in command.flags}:
        raise ValueError(f"{parser.prog}: no flag reaches {', '.join(sorted(idle))} of {handler.__name__}")
    parser.set_defaults(**command.imposed)


def with_default(text: str, default: Any) -> str:
    """The help of a flag with its default."""
    if default is None or isinstance(default, bool):
        default = {None: "none", True: "on", False: "off"}[default]
    elif isinstance(default, int):
        default = f"{default:,}"
    elif isinstance(default, float):
        default = f"{default:g}"
    elif isinstance(default, tuple):
        default = ",".join(default) or "none"
    return (text if "(default: " in text else text + " (default: {})").format(default)


def join_axis(argv: list[str]) -> list[str]:
    """Writes "--solar-panel-axis -x" with an equals sign, since argparse takes a lone -x for a flag."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] == "--solar-panel-axis":
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command's function is called with, among it `configure` if the command has settings.

    Raises:
        InputError: there are other flags beside one that names where all settings come from, or that mean nothing
            beside another.
    """
    values, command = vars(arguments), COMMANDS[arguments.command]
    given = [each for each in command.flags if each.dest in values]
    for each in given:
        allowed = each.name, *each.beside
        others = [
            other.name for other in given if other.name not in allowed and other.dest not in OF_THE_PROCESS
        ]
        if each.alone and others:
            raise InputError(f"{each.name} takes its settings from {each.alone}; drop {', '.join(others)}")
        if idle := [other.name for other in given if other.name in each.without]:
            raise InputError(f"{each.name} has no use for {', '.join(idle)}; drop it")
    own = {each.dest: values[each.dest] for each in given if each.dest not in SETTINGS | OF_THE_PROCESS}
    has_settings = any(each.dest in SETTINGS for each in command.flags)
    return own | ({"configure": Configure(arguments)} if has_settings else {})


@dataclass(frozen=True)
class Configure:
    """Puts each --config and the flags over a configuration; `files` are those of --config."""

    arguments: argparse.Namespace

    def __call__(self, base: AnyConfig) -> AnyConfig:
        return resolve(self.arguments, base)

    @property
    def files(self) -> list[str]:
        return [configuration.find(each) for each in getattr(self.arguments, "config", [])]

    @property
    def words(self) -> list[str]:
        """The flags of settings that were given, as they are written."""
        values, words = vars(self.arguments), []
        for each in COMMANDS[self.arguments.command].flags:
            if each.dest in SETTINGS and each.dest in values:
                value = values[each.dest]
                if isinstance(value, bool):
                    words.append(each.name if value else each.name.replace("--", "--no-"))
                elif each is CONFIG:
                    words += [word for file in value for word in (each.name, file)]
                else:
                    words += [each.name, f"{value:g}" if isinstance(value, float) else str(value)]
        return words


def check_files(arguments: argparse.Namespace) -> None:
    """Refuses to write over what the command reads, and over files that are not its own, see `check_outputs`."""
    given = [
        (each, vars(arguments)[each.dest])
        for each in COMMANDS[arguments.command].flags
        if vars(arguments).get(each.dest) is not None
    ]
    inputs: dict[str, str] = {}
    for each, value in given:
        paths = value if isinstance(value, list) else [value]
        if each.reads:
            inputs |= {f"{each.name} {path}": in_file(path) for path in paths}
    check_inputs(inputs)
    check_outputs({each.name: (value, each.writes) for each, value in given if each.writes}, inputs)
    for each, value in given:
        if each.key:
            check_replaced(value, arguments.command, each.key)


def resolve(arguments: argparse.Namespace, base: AnyConfig) -> AnyConfig:
    """The base configuration under each --config under the flags."""
    values = {name: value for name, value in vars(arguments).items() if name in SETTINGS}
    for file in values.pop("config", []):
        base = configuration.load(configuration.find(file), base)
    tables: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        table, key = name.split(".")
        tables.setdefault(table, {})[key] = value
    return configuration.override(base, tables, "command line")
