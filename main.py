#!/usr/bin/env python
"""Run-time-assured reinforcement learning for spacecraft inspection: the command line.

Settings come from defaults, then from each --config FILE.toml, then from flags.
"""

import os
import re
import signal
import sys
import time
from argparse import ArgumentTypeError, BooleanOptionalAction, Namespace
from collections.abc import Callable, Collection
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from inspection.orbits import GUIDANCE
from ppo.errors import CheckpointError, NonFiniteError, RankLostError
from ppo.files import is_written_in_place
from settings import (
    InputError,
    Parser,
    add_flags,
    configured,
    in_one_line,
    override,
    positive_integer,
    positive_number,
    shown,
    to_toml,
    whole,
)
from study.config import EVALUATED, TEST_CASES, Config, StudyConfig
from study.errors import MALFORMED, ExportError, ReflyError, Stopped, as_input_error
from study.files import check_writable, read_json, write_json, write_npz, writing

if TYPE_CHECKING:  # help and bad usage do not wait for PyTorch; only commands import it
    from ppo.network import Policy

COMMANDS: dict[str, Callable[[Namespace], None]] = {}
DECLARED: dict[str, Callable[[Any], None]] = {}  # functions that add each command to the parser

# Packages that may be removed with `rm -r` (docs/reference/layout.md).
WINGS = ("rta.robust", "rta.fast", "kernels", "study.web", "study.export", "interfaces", "experiments")

# Short names of flags; every setting also has --table.key. Settings that are changed most often come first.
SHORT = {
    "--rta": "train.rta",
    "--rta-filter": "rta.filter",
    "--rta-period": "rta.period",
    "--seeds": "study.seeds",
    "--arms": "study.arms",
    "--seed": "train.seed",
    "--interactions": "train.interactions",
    "--num-envs": "train.num_envs",
    "--rollout-steps": "train.rollout_steps",
    "--evaluation-interval": "train.evaluation_interval",
    "--evaluation-episodes": "train.evaluation_episodes",
    "--final-episodes": "train.final_episodes",
    "--epochs": "ppo.epochs",
    "--minibatch-size": "ppo.minibatch_size",
    "--learning-rate": "ppo.learning_rate",
    "--errors": "plant.errors",
    "--plant": "plant.simulator",
    "--keep-clear": "train.keep_clear",
    "--learn-from": "train.learn_from",
    "--adversary": "train.adversary",
    "--device": "train.device",
    "--compile": "train.compile",
    "--qp-solver": "rta.qp_solver",
    "--solar-panel-axis": "inspection.solar_panel_axis",
}
# Settings that the commands' flags can set: tables, or single settings.
FILTER = ("inspection", "chief", "rta", "uncertainty")
MACHINE = ("train.device", "train.compile")
FLOWN = (*FILTER, "plant", *MACHINE)
CHOSEN_ANEW = ("rta.qp_solver",)  # not taken from an agent's training
TRAINED = (*FILTER, "plant", "train", "ppo")


def command(
    about: str,
    example: str,
    *flags: Any,
    settings: Collection[str] = (),
    one_of: Collection[Any] = (),
    of_agent: bool = False,
) -> Any:
    """Makes a function a command of the same name without "run_".

    Args:
        about: the command's line in --help; example: the words of a call.
        flags: see `flag`; one_of: flags, exactly one of which must be given.
        settings: tables, or settings as "table.key", that flags can also set.
        of_agent: an agent's own settings replace the defaults of these settings.
    """

    def declare(function: Callable[[Namespace], None]) -> Callable[[Namespace], None]:
        name = function.__name__.removeprefix("run_").replace("_", "-")

        def add_to(commands: Any) -> None:
            parser = commands.add_parser(
                name,
                help=about,
                description=f"{about[0].upper()}{about[1:]}.",
                epilog=f"example: python main.py {name} {example}",
            )
            if one_of:
                group = parser.add_mutually_exclusive_group(required=True)
                for names, options in one_of:
                    group.add_argument(*names, **options)
            for names, options in flags:
                parser.add_argument(*names, **options)
            if settings:
                config = StudyConfig() if "study" in settings else Config()
                add_flags(parser, config, settings, SHORT, CHOSEN_ANEW if of_agent else None)
            machine = parser.add_argument_group("machine")
            for names, options in (THREADS, CACHE):
                machine.add_argument(*names, **options)

        COMMANDS[name], DECLARED[name] = function, add_to
        return function

    return declare


def name(text: str) -> str:
    """Returns the name of a file or directory; refuses an empty name, which an unset shell variable may give."""
    if not text:
        raise ArgumentTypeError("an empty name")
    return text


def flag(*names: str, **options: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Returns the arguments of `add_argument`; the help ends with the default, if there is one."""
    if options.get("default") is not None:
        default = options["default"]
        text = ("on" if default else "off") if isinstance(default, bool) else shown(default)
        options["help"] += f" (default: {text})"
    return names, options


def file_flag(*names: str, **options: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Returns the arguments of `add_argument` for a flag that takes the name of a file or a directory."""
    return flag(*names, type=name, **options)


def to_write(suffix: str) -> Callable[[str], Path]:
    """Returns a function that reads an output's name, which must have this suffix unless it is not a regular file."""

    def read(text: str) -> Path:
        if not text.endswith(suffix) and not is_written_in_place(Path(text)):
            raise ArgumentTypeError(f"{text[:40]!r}: must end in {suffix}")
        return Path(text)

    return read


def check_replaced(path: Path | None, key: str) -> None:
    """Raises InputError if a file has content other than results with this key, so that it is not overwritten."""
    if path and path.is_file() and not is_written_in_place(path) and path.stat().st_size:
        with suppress(InputError):
            if key in read_json(path, "results"):
                return
        raise InputError(f"--json {path}: holds other things than results of this command; name another file")


def count(name: str, default: int | None, text: str) -> Any:
    """Returns a flag with a positive integer."""
    return flag(name, type=positive_integer, metavar="N", default=default, help=text)


def seconds(name: str, default: float | None, text: str, **options: Any) -> Any:
    """Returns a flag with a positive number of seconds."""
    return flag(name, type=positive_number, metavar="S", default=default, help=text, **options)


def seed(default: int, text: str) -> Any:
    """Returns the flag of a seed."""
    return flag("--seed", type=seed_number, metavar="N", default=default, help=text)


def seed_number(text: str) -> int:
    """Returns a seed from its text."""
    with suppress(ValueError):
        if 0 <= (number := whole(text)) < 2**63:
            return number
    raise ArgumentTypeError(f"{text[:40]!r}: must be an integer from 0 to 2^63 - 1")


def counts(text: str) -> tuple[int, ...]:
    """Returns positive integers from their text with commas."""
    return tuple(positive_integer(word) for word in text.split(","))


THREADS = count(
    "--threads",
    None,
    "processor threads (default: OMP_NUM_THREADS, else 1 for PyTorch, whose last digits depend on this number, and all "
    "for compiled functions; a continued run or study keeps its number)",
)
CACHE = file_flag(
    "--cache-dir",
    metavar="DIR",
    help="directory for compiled code (default: $RTA_CACHE_DIR, or rta-inspection in the user's "
    "cache directory)",
)
AGENT = file_flag("--checkpoint", metavar="F", help="the agent: policy.pt or checkpoint.pt of a run")
REPORT = flag(
    "--json",
    type=to_write(".json"),
    metavar="F",
    help="write the report to F; if F holds a report, continue it",
)
RESULTS = flag("--json", type=to_write(".json"), metavar="F", help="also write the results to F")


def agent_and_config(given: Namespace) -> "tuple[Policy | None, Config]":
    """Returns the agent of --checkpoint, if given, and the settings of its training, changed by files and flags.

    Without an agent, the defaults are changed.
    """
    from study.experiment import check_observed, load_policy

    if given.checkpoint is None:
        return None, configured(given, Config())
    policy, trained = load_policy(given.checkpoint)
    config = configured(given, trained)
    check_observed(config, trained)
    return policy, config


def filtered(config: Config) -> Config:
    """Returns the configuration with the filter on and keep_clear off, so that nothing else changes controls."""
    return override(config, {"train": {"rta": True, "keep_clear": False}}, "the filter")


@command(
    "train an agent with or without run time assurance (RTA, the filter)",
    "--config quickstart --run-dir runs/first",
    file_flag("--run-dir", metavar="D", help="directory to create (default: runs/<arm>__<seed>__<time>)"),
    file_flag(
        "--init-from",
        metavar="F",
        help="start from the agent in F: policy.pt of a run, or checkpoint.pt, which also has the value network",
    ),
    file_flag(
        "--resume",
        metavar="D",
        help="continue the run in D exactly where it stopped; only --interactions, the new total, and "
        "--final-episodes may be changed",
    ),
    settings=TRAINED,
)
def run_train(given: Namespace) -> None:
    from ppo.distributed import ranks
    from study.machine import recorded_threads, set_threads
    from study.training import session as training
    from study.verified import warn_if_unverified

    if given.resume is not None:
        changed = {name for name in vars(given) if "." in name} - {
            "train.interactions",
            "train.final_episodes",
        }
        if changed or given.config or given.run_dir or given.init_from:
            raise InputError(
                "--resume takes its settings from the run; only --interactions and --final-episodes may stand beside it"
            )
        set_threads(given.threads, recorded_threads(Path(given.resume)))
        config = configured(given, training.settings(Path(given.resume)))
        session = training.resuming(Path(given.resume), config)
    else:
        config = configured(given, Config())
        arm = f"rta_{config.rta.period:g}s" if config.train.rta else "no_rta"
        name = f"{arm}__{config.train.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
        directory = Path(given.run_dir or Path("runs") / ranks().agree(name))
        session = training.starting(config, directory, Path(given.init_from) if given.init_from else None)
    with session as run:
        print(run, flush=True)
        print(run.plan, flush=True)
        warn_if_unverified(run.config)
        run.train()
        if run.ranks.first:
            print(run.conclude())


@command(
    "train many seeds of each arm and evaluate them; the same command continues an interrupted study",
    "--config study --study-dir runs/study",
    file_flag(
        "--study-dir",
        metavar="D",
        default="runs/study",
        help="directory of a study, to create or to continue",
    ),
    settings=(*TRAINED, "study"),
)
def run_study(given: Namespace) -> None:
    from study.machine import recorded_threads, set_threads
    from study.training.study import read_settings, train_and_evaluate

    directory = Path(given.study_dir)
    config = configured(given, read_settings(directory) or StudyConfig())
    fixed = [name for name in config.study.arms if "rta" in config.all_arms[name].get("train", {})]
    if "train.rta" in vars(given) and len(fixed) == len(config.study.arms):
        raise InputError(f"--rta, --no-rta: the arms {', '.join(fixed)} say it; choose among them by --arms")
    set_threads(given.threads, recorded_threads(directory))
    print(train_and_evaluate(config, directory))


@command(
    "write a page with a finished study's results, its figures and their data",
    "--study runs/study",
    file_flag("--study", metavar="D", required=True, help="directory of a finished study"),
    flag(
        "--device",
        choices=("auto", "cpu", "cuda"),
        help="where tensors live (default: as in the study)",
    ),
)
def run_report(given: Namespace) -> None:
    from jinja2 import UndefinedError  # for a damaged file that lacks a value

    from study.machine import announced
    from study.report import figures, inputs, page, tables
    from study.report.compute import compute

    directory = Path(given.study)
    compute(directory, given.device)
    where = f"--study {directory}: cannot read what its report is made from"
    with (
        announced("drawing the figures and the page, seconds"),
        as_input_error(where, UndefinedError, *MALFORMED),
    ):
        found = inputs.read(directory)
        tables.write(found)
        figures.draw(found)
        page.write(found)
    print(f"Written to {directory}: report.html and, in report, its figures and the data behind them")
    print(f"Open it in a browser: {(directory / 'report.html').absolute().as_uri()}")


@command(
    "evaluate an agent or a controller by the metrics of the paper's Tables 2 and 3",
    "--checkpoint runs/first/policy.pt --episodes 1000",
    count("--episodes", 100, "test cases"),
    seed(TEST_CASES, "seed of the test cases, of random controls and of an untrained agent"),
    RESULTS,
    settings=("train.rta", "train.keep_clear", *FLOWN),
    one_of=(
        AGENT,
        flag(
            "--controller",
            choices=EVALUATED,
            help="instead of an agent: untrained (an agent before training), random or zero controls, which decide "
            "every 10 s as an agent does, or a classical guidance, which decides at every call of the filter, or "
            f"without filter every second: {', '.join(GUIDANCE)}",
        ),
    ),
    of_agent=True,
)
def run_evaluate(given: Namespace) -> None:
    from study.experiment import Experiment
    from study.flight.evaluation import evaluate
    from study.paper import tables
    from study.verified import warn_if_unverified

    check_replaced(given.json, "metrics")
    policy, config = agent_and_config(given)
    experiment = Experiment(config, given.episodes)
    warn_if_unverified(config)
    results = evaluate(policy or given.controller, experiment, given.episodes, given.seed)
    print(tables(results))
    if given.json:  # which may be standard output
        write_json(given.json, results)


@command(
    "simulate one spacecraft and write all quantities over time",
    "--controller quick --duration 3600 --out runs/flight.npz",
    flag(
        "--controller",
        required=True,
        choices=("policy", "recorded", "lqr-pd", *EVALUATED),
        help="the controller",
    ),
    AGENT,
    file_flag(
        "--actions",
        metavar="F.npy",
        help="controls for --controller recorded: N x 6 in N and N m, a row per --step; or N x 25, with the corners of "
        "a flight that was saved by play, if [plant] errors are worst",
    ),
    file_flag("--initial-state", metavar="F.json", help="state file (default: drawn from --seed)"),
    seed(TEST_CASES, "seed of all random numbers"),
    seconds("--duration", None, "seconds to simulate", required=True),
    seconds(
        "--step",
        1.0,
        "seconds between two rows of the output, two rows of --actions and two decisions of a classical controller; "
        "it decides at most once per call of the filter, or without filter once per [inspection] substep; an agent, "
        "trained or not, decides every 10 s",
    ),
    flag("--out", type=to_write(".npz"), required=True, metavar="F.npz", help="file to write"),
    flag(
        "--figure",
        type=to_write(".png"),
        metavar="F.png",
        help="also draw limits and controls over time in this file",
    ),
    settings=("train.rta", "train.keep_clear", *FLOWN),
    of_agent=True,
)
def run_simulate(given: Namespace) -> None:
    from study.experiment import Experiment
    from study.flight import simulation
    from study.flight.figures import constraint_figure
    from study.verified import warn_if_unverified

    if (given.controller == "policy") != bool(given.checkpoint):
        raise InputError("--checkpoint F is needed by --controller policy and by no other")
    if (given.controller == "recorded") != bool(given.actions):
        raise InputError("--actions F.npy is needed by --controller recorded and by no other")
    policy, config = agent_and_config(given)
    simulation.check_rows(given.step, given.duration, config, given.controller)
    experiment = Experiment(config, 1, given.duration)
    warn_if_unverified(config)
    flown = simulation.run(
        experiment,
        given.controller,
        given.duration,
        given.step,
        given.seed,
        policy,
        given.actions,
        given.initial_state,
    )
    write_npz(given.out, flown)
    if given.figure:
        constraint_figure(flown, config.inspection, given.figure)
    print(f"{given.out}: {simulation.described(flown)}")


@command(
    "write a page that plays one or two simulated runs in 3-D",
    "runs/flight.npz --out runs/flight.html",
    flag("runs", nargs="+", metavar="RUN.npz", help="one file of simulate, or two to show side by side"),
    flag("--out", type=to_write(".html"), required=True, metavar="F.html", help="page to write"),
)
def run_replay(given: Namespace) -> None:
    from study.web import replay

    if len(given.runs) > 2:
        raise InputError(f"{len(given.runs)} runs: at most two are shown side by side")
    size = replay.write(given.runs, given.out)
    print(f"{given.out}: {1e-6 * size:.1f} MB, opens in a browser without a network")


@command(
    "write a page to fly the spacecraft in a browser, with the filter on or off",
    "--out runs/play.html",
    AGENT,
    flag("--out", type=to_write(".html"), required=True, metavar="F.html", help="page to write"),
    settings=(*FILTER, "plant"),
    of_agent=True,
)
def run_play(given: Namespace) -> None:
    from study.web import play

    policy, config = agent_and_config(given)
    size = play.write(filtered(config), given.out, policy)
    print(f"{given.out}: {1e-6 * size:.1f} MB, opens in a browser without a network")


@command(
    "filter the states in a file and write the controls and the quadratic programs",
    "--states states.npz --out filtered.npz",
    file_flag(
        "--states",
        required=True,
        metavar="F.npz",
        help="file with state (N x 16, the order of inspection/model/state.py) and control_desired (N x 6, N and N m)",
    ),
    flag("--out", type=to_write(".npz"), required=True, metavar="G.npz", help="file to write"),
    settings=(*FILTER, *MACHINE),
)
def run_filter(given: Namespace) -> None:
    from rta.result import Status
    from study.flight import offline_filter

    if os.path.realpath(given.states) == os.path.realpath(given.out):
        raise InputError(f"--out {given.out}: is the file of --states; name another one")
    result = offline_filter.run(filtered(configured(given, Config())), given.states)
    write_npz(given.out, result)
    counted = [f"{(result['status'] == status).sum():,} {status.name.lower()}" for status in Status]
    print(f"{given.out}: {len(result['status']):,} states, {', '.join(counted)}")


@command(
    "count violations with the filter on over many random episodes",
    "--policy adversarial --json runs/verify.json",
    count(
        "--episodes",
        1000,
        "number of episodes, from initial states that the filter accepts; rejected states are counted separately",
    ),
    flag(
        "--policy",
        metavar="P",
        default="random",
        help="random (each action is held for a random time), adversarial (down the worst constraint's slope), "
        "pressing (full control against one constraint per episode), lookahead (the worst of many candidates, each "
        "simulated in the true plant), learned:F (actions drawn from an agent of train --adversary) or checkpoint:F "
        "(any agent)",
    ),
    count("--candidates", None, "lookahead's candidates per spacecraft and call of the filter (default: 24)"),
    count("--horizon", None, "calls of the filter for which lookahead simulates each candidate (default: 3)"),
    flag(
        "--starts",
        choices=("anywhere", "limits"),
        default="anywhere",
        help="anywhere in the safe set, half of them from the paper's distribution; or next to one or two limits",
    ),
    count("--duration", 2000, "whole seconds of each episode"),
    seconds("--check-every", 1.0, "seconds between two checks of all constraints"),
    flag(
        "--filter",
        choices=("python", "c"),
        default="python",
        help="form of the filter: python, or c, as `export --filter` writes it",
    ),
    seed(0, "seed of all random numbers"),
    REPORT,
    flag(
        "--keep-worst",
        action=BooleanOptionalAction,
        default=False,
        help="keep the worst episode of every constraint beside --json, not only of violated ones",
    ),
    settings=FLOWN,
    of_agent=True,
)
def run_verify(given: Namespace) -> None:
    from study.experiment import check_observed
    from study.verification.campaign import BATCH, digest, load_commander, looking_ahead, verify
    from study.verification.findings import Campaign, table, what_next
    from study.verified import warn_if_unchecked

    if given.keep_worst and not given.json:
        raise InputError("--keep-worst keeps episodes beside --json F: name one")
    network, trained = load_commander(given.policy)
    config = filtered(configured(given, trained or Config()))
    warn_if_unchecked(config)
    if network:
        check_observed(config, trained)
    campaign = Campaign(
        given.policy,
        config.rta.period,
        given.duration,
        given.seed,
        BATCH,
        digest(network),
        given.check_every,
        *looking_ahead(given.policy, given.candidates, given.horizon),
        given.filter,
        given.starts,
    )
    report = verify(campaign, given.episodes, config, network, given.json, given.keep_worst)
    print(table(report))
    print(what_next(report, given.json))


@command(
    "find the size at which each effect of [plant] leads to a violation, with and without [uncertainty]; errors are at "
    "the corners of their bounds",
    "--json runs/break_points.json",
    count(
        "--episodes", 96, "episodes per effect and size with steady errors, and as many with the worst errors"
    ),
    flag(
        "--policy",
        choices=("random", "adversarial", "pressing", "lookahead"),
        default="pressing",
        help="the controller, see verify",
    ),
    count("--duration", 300, "whole seconds of each episode"),
    seed(0, "seed of all random numbers"),
    REPORT,
    flag("--figure", type=to_write(".png"), metavar="F.png", help="also draw the table in this file"),
    settings=(*FILTER, *MACHINE),
)
def run_break_points(given: Namespace) -> None:
    from experiments import break_points

    config = filtered(configured(given, Config()))
    at_corners = " and ".join(break_points.ERRORS)
    worlds = break_points.Worlds(
        given.policy, config.rta.period, given.duration, given.seed, given.episodes, errors=at_corners
    )
    report = break_points.measure(worlds, config, given.json)
    print(break_points.table(report))
    if given.figure:
        with writing(given.figure) as file:
            break_points.figure(report).savefig(file, dpi=90)


@command(
    "fly a counter-example of verify again",
    "runs/verify.json.collision.npz",
    file_flag("file", metavar="F.npz", help="file that verify wrote beside --json; it holds all settings"),
)
def run_refly(given: Namespace) -> None:
    from study.verification.counter_examples import refly_file

    print(refly_file(given.file))


@command(
    "measure the speed of simulator, filter, solvers and learner",
    "--json runs/benchmark.json",
    flag(
        "--batches",
        type=counts,
        metavar="N,N,...",
        help="batch sizes: episodes, spacecraft or samples at once (default: 256 to 65,536 in powers of 4)",
    ),
    RESULTS,
    flag(
        "--figure", type=to_write(".png"), metavar="F.png", help="also draw rates over batches in this file"
    ),
    settings=(*FLOWN, "ppo"),
)
def run_benchmark(given: Namespace) -> None:
    from experiments import benchmark

    config = configured(given, Config())
    if "train.compile" not in vars(given):  # only a flag counts, not a file
        config = override(config, {"train": {"compile": "on"}}, "benchmark")
    check_replaced(given.json, "closed_loop_us")
    results = benchmark.benchmark(config, given.batches or benchmark.BATCHES)
    print(benchmark.table(results))
    if given.json:
        write_json(given.json, results)
    if given.figure:
        with writing(given.figure) as file:
            benchmark.figure(results, file)


@command(
    "write an agent as an ONNX file or as C, both checked against PyTorch, or write the filter as C",
    "--filter runs/filter",
    AGENT,
    flag(
        "--prefix",
        metavar="NAME",
        help="prefix of the C's files, functions, types and macros, so that several exports fit into one program "
        "(default: policy, or safety_filter)",
    ),
    settings=FILTER,
    one_of=(
        flag("--out", type=to_write(".onnx"), metavar="F.onnx", help="ONNX file to write"),
        file_flag(
            "--c",
            metavar="D",
            help="directory for the agent's C99 sources, new or with those of an earlier export",
        ),
        file_flag(
            "--filter",
            metavar="D",
            help="directory for the filter's C99 sources, new or with those of an earlier export",
        ),
    ),
)
def run_export(given: Namespace) -> None:
    from study.experiment import load_policy

    named = {} if given.prefix is None else {"prefix": given.prefix}
    if given.filter is not None:
        from study.export import filter as export_filter

        if given.checkpoint:
            raise InputError("--filter has no use for --checkpoint; drop it")
        print(export_filter.export(filtered(configured(given, Config())), Path(given.filter), **named))
        return
    if given.config or any("." in name for name in vars(given)):
        raise InputError("--config and settings are of --filter; an agent has those of its training")
    if given.checkpoint is None:
        raise InputError(f"--checkpoint F is needed by {'--out' if given.c is None else '--c'}")
    policy, config = load_policy(given.checkpoint)
    if given.c is not None:
        from study.export import policy as export_policy

        print(export_policy.write(policy, config, given.checkpoint, Path(given.c), **named))
        return
    if named:
        raise InputError("--out has no use for --prefix; drop it")
    from study.export import onnx as export

    model = export.to_onnx(policy, config.inspection, config.chief)
    difference = export.check(model, policy)
    with writing(given.out) as file:
        file.write(model)
    print(
        f"{given.out}: {len(model):,} bytes, at most {difference:.1g} from PyTorch's controls "
        f"over {export.SAMPLES:,} observations"
    )


@command(
    "print all settings as TOML, with unit and meaning, after files and flags have changed the defaults",
    "--config 12u --rta-period 5",
    AGENT,
    settings=(*TRAINED, "study"),
)
def run_config(given: Namespace) -> None:
    from study.experiment import load_policy

    base = StudyConfig()
    if given.checkpoint:
        base = StudyConfig(**vars(load_policy(given.checkpoint)[1]))
    print(to_toml(configured(given, base)), end="")


def build_parser() -> Parser:
    """Returns the parser of the whole command line."""
    parser = Parser(prog="main.py", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar=" | ".join(COMMANDS))
    for add_to in DECLARED.values():
        add_to(commands)
    return parser


def with_values(words: Collection[str]) -> list[str]:
    """Returns the words with "--flag -x" and "--flag -0.1,2" joined by "=", because argparse takes -x for a flag."""
    joined: list[str] = []
    for word in words:
        if re.fullmatch(r"-[xyz\d.].*", word) and joined and re.fullmatch(r"--[^=]+", joined[-1]):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def main(argv: list[str] | None = None) -> int:
    """Runs a command and returns the exit code; with many ranks, only the first one prints."""
    os.environ["MPLBACKEND"] = (
        "agg"  # figures go to files; a shell below Jupyter may name a backend that is not here
    )
    first = os.environ.get("RANK", "0") == "0"
    with redirect_stdout(sys.stdout if first else None):
        return outcome(with_values(sys.argv[1:] if argv is None else argv), sys.stderr if first else None)


def outcome(words: list[str], errors: TextIO | None) -> int:
    """Runs a command and returns the exit code; errors of bad input are caught here and end in one line.

    Args:
        errors: stream for messages about bad usage; None: no messages.
    """
    try:
        try:
            with redirect_stderr(errors):
                given = build_parser().parse_args(words or ["--help"])
            run(given)
        finally:
            print(end="", flush=True)
    except SystemExit as end:  # from the parser, after help or bad usage
        return int(end.code or 0)
    except (InputError, CheckpointError) as error:
        return complain(f"{error}", 2)
    except ModuleNotFoundError as error:
        return complain(f"needs the package {error.name}: python -m pip install -r requirements.txt", 2)
    except BrokenPipeError:  # the reader of our output, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python sends the rest there when it ends
        return 0
    except OSError as error:
        return complain(f"{error.filename}: {error.strerror}" if error.filename else f"{error}", 2)
    except Stopped as stopped:
        print(stopped)
        # zero with many ranks: torchrun takes other codes for a failure, and restarts
        return 128 + stopped.number if "RANK" not in os.environ else 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ReflyError, ExportError) as error:
        return complain(f"{error}", 1)
    except RankLostError as error:
        # torchrun sends SIGTERM when it also notices the loss; this process ends anyway
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        return complain(f"{error}", 1)
    except NonFiniteError as error:
        return complain(f"training stopped at {error}", 1)
    return 0


def run(given: Namespace) -> None:
    """Runs the command of a parsed command line."""
    from ppo.distributed import ranks
    from study.machine import set_threads

    if ranks().size > 1 and given.command not in ("train", "study"):
        raise InputError(f"torchrun: {given.command} runs in one process; only train and study in many")
    for name, path in vars(given).items():
        if isinstance(path, Path):  # an output, see `to_write`
            with as_input_error(f"--{name} {str(path)!r}: cannot write it", OSError, ValueError):
                check_writable(path)
    set_threads(given.threads)
    try:
        if given.cache_dir:
            from kernels.build import VARIABLE

            os.environ[VARIABLE] = given.cache_dir
        COMMANDS[given.command](given)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if not missing.startswith(WINGS):
            raise
        raise InputError(f"{given.command}: needs {missing.replace('.', '/')}, which is not here") from None


def complain(reason: str, code: int) -> int:
    """Prints an error line on stderr, with many ranks on each of them; returns the exit code."""
    rank = os.environ.get("RANK", "0")
    where = f"rank {rank}: " if rank != "0" else ""
    print(f"error: {where}{in_one_line(reason)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
