"""The flags: each reaches the setting or the parameter that it names, and says its default."""

import inspect
from pathlib import Path
from typing import Any

import pytest

import main
from study.command_line import arguments, commands, flags
from study.command_line.arguments import (
    OF_THE_PROCESS,
    SETTINGS,
    build_parser,
    join_axis,
    parameters,
    resolve,
)
from study.command_line.commands import COMMANDS
from study.command_line.flags import Command, Flag
from study.config import Config, StudyConfig
from study.errors import InputError

TEXTS = {  # what each kind of flag takes, two of each
    flags.positive_integer: ("7", "1_000"),
    flags.seed_number: ("7", "8"),
    flags.positive_number: ("0.5", "2"),
    flags.batch_list: ("3,4", "5"),
    flags.arm_list: ("rta", "no_rta"),
    flags.constraint_list: ("battery", "collision,temperature"),
    flags.period: ("5", "10.0"),
    flags.verified_policy: ("adversarial", "checkpoint:x.pt"),
    None: ("here", "there"),
}


def words(flag: Flag, choice: int = 0) -> list[str]:
    """The flag on a command line with one of two values."""
    if "action" in flag.options:
        return [(flag.name.replace("--", "--no-"), flag.name)[choice]]
    texts = flag.options.get("choices") or TEXTS[flag.options.get("type")]
    if not flag.name.startswith("--"):
        return [texts[choice]]
    return [f"{flag.name}={texts[min(choice, len(texts) - 1)]}"]


def needed(name: str, beside: str = "") -> dict[str, list[str]]:
    """By destination, the words of the flags that a command is not called without, nor together with another flag."""
    command, parameters = COMMANDS[name], inspect.signature(main.HANDLERS[name]).parameters
    given = {
        flag.dest: words(flag)
        for flag in command.flags
        if flag.dest in parameters and parameters[flag.dest].default is inspect.Parameter.empty
    }
    fitting = [flag for flag in command.one_of if beside not in flag.without]
    return given | {flag.dest: words(flag) for flag in fitting[:1]}


def parse(name: str, given: dict[str, list[str]]) -> Any:
    return build_parser(main.HANDLERS).parse_args([name, *(word for each in given.values() for word in each)])


def flags_of_all(sets: bool) -> list[Any]:
    """Every flag of every command that sets something, or that does not."""
    return [
        pytest.param(name, flag, id=f"{name}{flag.name}")
        for name, command in COMMANDS.items()
        for flag in command.flags
        if (flag.dest in SETTINGS) == sets and flag.dest not in ("config", *OF_THE_PROCESS)
    ]


@pytest.mark.parametrize(("name", "flag"), flags_of_all(sets=True))
def test_a_flag_changes_the_setting_it_names_and_no_other(name: str, flag: Flag) -> None:
    table, key = flag.dest.split(".")
    base = StudyConfig()
    before = resolve(parse(name, needed(name)), base)
    values = set()
    for choice in (0, 1):
        config = resolve(parse(name, needed(name) | {flag.dest: words(flag, choice)}), base)
        values.add(getattr(getattr(config, table), key))
        for other, value in settings(before).items():
            assert other == flag.dest or settings(config)[other] == value
    assert len(values) == 2


def settings(config: Config) -> dict[str, Any]:
    return {
        f"{table}.{key}": value for table, part in vars(config).items() for key, value in vars(part).items()
    }


@pytest.mark.parametrize(("name", "flag"), flags_of_all(sets=False))
def test_a_flag_reaches_the_parameter_it_names(name: str, flag: Flag) -> None:
    given = {} if flag in COMMANDS[name].one_of or flag.alone else needed(name, flag.name)
    reached = set()
    for choice in (0, 1):
        values = parameters(parse(name, given | {flag.dest: words(flag, choice)}))
        inspect.signature(main.HANDLERS[name]).bind(**values)
        reached.add(str(values[flag.dest]))
    choices = flag.options.get("choices", (0, 1))
    assert len(reached) == min(2, len(choices))


@pytest.mark.parametrize("name", COMMANDS)
def test_flags_that_are_not_given_change_nothing(name: str) -> None:
    config = resolve(parse(name, needed(name)), StudyConfig())
    assert settings(config) == settings(StudyConfig()) | COMMANDS[name].imposed


@pytest.mark.parametrize(
    "planted",
    [
        Flag("--nonsense", "?"),
        Flag("--nonsense", "?", "train.nonsense"),
        Flag("--nonsense", "?", "train.updates"),
    ],
)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_flag_that_reaches_nothing_is_an_error(
    name: str, planted: Flag, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = COMMANDS[name]
    more = Command("?", *command.flags, planted, imposed=command.imposed)
    monkeypatch.setitem(COMMANDS, name, more)
    with pytest.raises(ValueError, match=rf"main\.py {name} --nonsense reaches nothing"):
        build_parser(main.HANDLERS)


def test_a_flag_of_a_command_that_has_no_configuration_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, "replay", Command("?", *COMMANDS["replay"].flags, commands.RTA))
    with pytest.raises(ValueError, match="--rta reaches nothing"):
        build_parser(main.HANDLERS)


def test_a_parameter_without_a_flag_is_an_error() -> None:
    def replay(runs: list[str], out: str, colour: str = "red") -> None: ...

    with pytest.raises(ValueError, match=r"main\.py replay: no flag reaches colour of replay"):
        build_parser(main.HANDLERS | {"replay": replay})


def help_of(name: str) -> dict[str, Any]:
    """A command's flags as argparse has them."""
    parser = build_parser(main.HANDLERS)._subparsers._group_actions[0].choices[name]
    return {action.dest: action for action in parser._actions if action.dest != "help"}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_gives_every_flag_a_default_or_says_it_is_required(name: str) -> None:
    for dest, action in help_of(name).items():
        assert action.help, dest
        assert action.required or "(default: " in action.help, dest
        assert "{" not in action.help


@pytest.mark.parametrize(("name", "flag"), flags_of_all(sets=True))
def test_help_shows_the_default_of_the_setting(
    name: str, flag: Flag, monkeypatch: pytest.MonkeyPatch
) -> None:
    if flag.dest in COMMANDS[name].imposed:
        assert f"(default: {COMMANDS[name].imposed[flag.dest]})" in help_of(name)[flag.dest].help
        return
    for value, shown in (
        (12345, "12,345"),
        (0.25, "0.25"),
        ("other", "other"),
        (("a", "b"), "a,b"),
        (False, "off"),
    ):
        monkeypatch.setitem(arguments.SETTINGS, flag.dest, value)
        assert f"(default: {shown}" in help_of(name)[flag.dest].help


@pytest.mark.parametrize(
    ("name", "dest", "shown"),
    [
        ("train", "train.interactions", "5,000,000"),
        ("train", "ppo.learning_rate", "0.0003"),
        ("train", "rta.period", "1"),
        ("train", "resume", "none"),
        ("study", "study.arms", "no_rta,rta"),
        ("filter", "rta.qp_solver", "auto"),
        ("evaluate", "train.rta", "on; with --checkpoint as it was trained"),
        ("train", "train.rta", "on"),
        ("evaluate", "episodes", "100"),
        ("simulate", "step", "1"),
        ("verify", "duration", "2,000"),
        ("report", "device", "as in the study"),
    ],
)
def test_help_shows_numbers_as_people_write_them(name: str, dest: str, shown: str) -> None:
    assert help_of(name)[dest].help.endswith(f"(default: {shown})")


@pytest.mark.parametrize("axis", ["-x", "+y"])
@pytest.mark.parametrize("joint", [" ", "="])
def test_an_axis_may_look_like_a_flag(axis: str, joint: str) -> None:
    argv = f"train --solar-panel-axis{joint}{axis} --seed 3".split()
    config = resolve(build_parser(main.HANDLERS).parse_args(join_axis(argv)), Config())
    assert (config.inspection.solar_panel_axis, config.train.seed) == (axis, 3)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["train", "--resume", "d", "--no-rta", "--rta-period", "5"],
            "--resume takes .* run; drop --rta, --rta-period",
        ),
    ],
)
def test_a_flag_that_holds_all_settings_stands_alone(argv: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        parameters(build_parser(main.HANDLERS).parse_args(argv))
    assert parameters(build_parser(main.HANDLERS).parse_args(argv[:3]))


def test_configure_puts_the_file_under_the_flags(tmp_path: Any) -> None:
    (tmp_path / "some.toml").write_text("[train]\nrta = false\n[rta]\nperiod = 10.0\nspeed_gain = 0.25\n")
    argv = [
        "filter",
        "--states",
        "s",
        "--out",
        "o",
        "--config",
        str(tmp_path / "some.toml"),
        "--rta-period",
        "5",
    ]
    values = parameters(build_parser(main.HANDLERS).parse_args(argv))
    configure = values.pop("configure")
    assert values == {"states": "s", "out": "o"}
    config = configure(Config())
    assert (config.train.rta, config.rta.period, config.rta.speed_gain) == (True, 5.0, 0.25)


def test_of_several_files_each_goes_over_the_one_before(tmp_path: Path) -> None:
    files = [tmp_path / "one.toml", tmp_path / "two.toml"]
    files[0].write_text("[inspection]\nmass = 20.0\nmax_thrust = 2.0\n", encoding="utf-8")
    files[1].write_text("[inspection]\nmass = 30.0\n", encoding="utf-8")
    words = [word for file in files for word in ("--config", str(file))]
    arguments = build_parser(main.HANDLERS).parse_args(["evaluate", *words, "--controller", "zero"])
    configured = parameters(arguments)["configure"]
    task = configured(Config()).inspection
    assert (task.mass, task.max_thrust) == (30.0, 2.0)
    assert configured.words == words
