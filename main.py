#!/usr/bin/env python
"""Run-time-assured reinforcement learning for spacecraft inspection: the command line.

Settings come from defaults, then from --config FILE.toml, then from flags.
"""

import os
import signal
import sys
import time


def interrupted(*_: object) -> None:
    """Ends the program in one line where nothing has begun: while the imports below are made."""
    print("interrupted", file=sys.stderr)
    os._exit(130)


IS_PROGRAM = __name__ == "__main__" or os.path.basename(sys.argv[0]).startswith(
    "rta-inspection"
)  # and no library
if IS_PROGRAM:
    signal.signal(signal.SIGINT, interrupted)

from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

from kernels.build import VARIABLE
from ppo.errors import CheckpointError, NonFiniteError, RankLostError
from ppo.torchrun import is_first
from study.command_line.arguments import Configure, Handler, build_parser, check_files, join_axis, parameters
from study.command_line.output import CLOSED, NAME, Output, open_error_output
from study.config import ARMS, TEST_CASES, Config, StudyConfig, override
from study.errors import ExportError, InputError, ReflyError, Stopped, in_one_line, refusing
from study.files import write_json, write_npz, writing

if TYPE_CHECKING:  # help and refusals do not wait for PyTorch
    from ppo.network import Policy

# A command's parameters are its flags, whose help, limits and order are in `study.command_line.commands`. `configure`
# puts --config and the other flags, those that set something, over a configuration; it goes no further than this file.


def agent_and_config(configure: Configure, checkpoint: str | None) -> "tuple[Policy | None, Config]":
    """The agent in a file, if one is named, and the configuration to fly it in: its own under --config and the flags.

    Its solver is chosen anew.
    """
    from study.experiment import check_observed, load_policy

    if checkpoint is None:
        return None, configure(Config())
    policy, trained = load_policy(checkpoint)
    config = configure(trained.unsettled())
    check_observed(config, trained)
    return policy, config


def with_filter(configure: Configure, trained: Config | None = None) -> Config:
    """The configuration with the filter on, over an agent's."""
    return override(configure((trained or Config()).unsettled()), ARMS["rta"], "the filter")


def run_train(
    configure: Configure, run_dir: str | None = None, init_from: str | None = None, resume: str | None = None
) -> None:
    """main.py train"""
    from ppo.distributed import ranks
    from study.machine.provenance import recorded_threads
    from study.machine.threads import THREADS
    from study.training import session as training
    from study.verified import say_doubts

    if resume:
        THREADS.recorded = recorded_threads(Path(resume))
        config = configure(training.settings(Path(resume)))
        session = training.resuming(Path(resume), config)
    else:
        config = configure(Config())
        arm = f"rta_{config.rta.period:g}s" if config.train.rta else "no_rta"
        name = f"{arm}__{config.train.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
        directory = Path(run_dir or Path("runs") / ranks().agree(name))
        session = training.starting(config, directory, Path(init_from) if init_from else None)
    with session as run:
        print(run, flush=True)
        say_doubts(run.config, [run.directory / "config.toml"])
        run.train()
        if run.ranks.first:
            print(run.conclude())


def run_study(configure: Configure, study_dir: str = "runs/study") -> None:
    """main.py study"""
    from study.machine.provenance import recorded_threads
    from study.machine.threads import THREADS
    from study.training.study import read_settings, train_and_evaluate

    directory = Path(study_dir)
    config = configure(read_settings(directory) or StudyConfig())
    THREADS.recorded = recorded_threads(directory)
    print(train_and_evaluate(config, directory))


def run_report(study: str, device: str | None = None) -> None:
    """main.py report"""
    from study.machine.progress import step

    with refusing("report needs the package jinja2 (pip install '.[report]')", ImportError):
        from study.report import figures, inputs, page, tables
    from study.report.compute import compute

    directory = Path(study)
    compute(directory, device)
    with step("drawing the figures and the page, seconds"):
        found = inputs.read(directory)
        tables.write(found)
        figures.draw(found)
        page.write(found)
    print(f"Written to {directory}: report.html and, in report, its figures and the data behind them")
    print(f"Open it in a browser: {(directory / 'report.html').absolute().as_uri()}")


def run_evaluate(
    configure: Configure,
    checkpoint: str | None = None,
    controller: str | None = None,
    episodes: int = 100,
    seed: int = TEST_CASES,
    json: str | None = None,
) -> None:
    """main.py evaluate"""
    from study.commands import after_evaluation
    from study.experiment import Experiment
    from study.flight.evaluation import evaluate
    from study.paper import tables
    from study.verified import say_doubts

    policy, config = agent_and_config(configure, checkpoint)
    experiment = Experiment(config, episodes)
    say_doubts(config, configure.files, checkpoint)
    commander = policy or controller
    assert commander is not None  # the parser sees to it
    results = evaluate(commander, experiment, episodes, seed)
    print(tables(results))
    print(after_evaluation(results, checkpoint, controller, configure.words))
    if json:  # which may be standard output
        write_json(json, results)


def run_simulate(
    configure: Configure,
    controller: str,
    duration: float,
    out: str,
    checkpoint: str | None = None,
    actions: str | None = None,
    initial_state: str | None = None,
    seed: int = TEST_CASES,
    step: float = 1.0,
    figure: str | None = None,
) -> None:
    """main.py simulate"""
    from study.experiment import Experiment
    from study.flight import simulation
    from study.flight.figures import constraint_figure
    from study.verified import say_doubts

    if (controller == "policy") != bool(checkpoint):
        raise InputError("--checkpoint F is needed by --controller policy and by no other")
    if (controller == "recorded") != bool(actions):
        raise InputError("--actions F.npy is needed by --controller recorded and by no other")
    policy, config = agent_and_config(configure, checkpoint)
    simulation.check_rows(step, duration, config, controller)
    experiment = Experiment(config, 1, duration)
    say_doubts(config, configure.files, checkpoint)
    flown = simulation.run(experiment, controller, duration, step, seed, policy, actions, initial_state)
    write_npz(out, flown)
    if figure:
        constraint_figure(flown, config.inspection, Path(figure))
    print(f"{out}: {simulation.described(flown)}")


def run_replay(runs: list[str], out: str) -> None:
    """main.py replay"""
    with refusing("replay needs the package jinja2 (pip install '.[report]')", ImportError):
        from study.replay import page, scene
    if len(runs) > 2:
        raise InputError(f"{len(runs)} runs: at most two are shown side by side")
    size = page.write(runs, Path(out))
    print(f"{scene.printable(out)}: {1e-6 * size:.1f} MB, opens in a browser without a network")


def run_play(configure: Configure, out: str, checkpoint: str | None = None) -> None:
    """main.py play"""
    with refusing("play needs the package jinja2 (pip install '.[play]')", ImportError):
        from study.play import page
    from study.replay.scene import printable

    policy, trained = agent_and_config(configure, checkpoint)
    size = page.write(with_filter(configure, trained), Path(out), policy)
    print(f"{printable(out)}: {1e-6 * size:.1f} MB, opens in a browser without a network")


def run_filter(configure: Configure, states: str, out: str) -> None:
    """main.py filter"""
    from rta.qp.programs import Status
    from study.flight import offline_filter

    config = configure(Config())
    result = offline_filter.run(config, states)
    write_npz(out, result)
    counts = [f"{(result['status'] == status).sum():,} {status.name.lower()}" for status in Status]
    print(f"{out}: {len(result['status']):,} states, {', '.join(counts)}")


def run_verify(
    configure: Configure,
    episodes: int = 1000,
    policy: str = "random",
    candidates: int | None = None,
    horizon: int | None = None,
    duration: int = 2000,
    check_every: float = 1.0,
    filter: str = "python",
    seed: int = 0,
    json: str | None = None,
    keep_worst: bool = False,
) -> None:
    """main.py verify"""
    from study.experiment import check_observed
    from study.verification.campaign import BATCH, digest, load_commander, looking_ahead, verify
    from study.verification.findings import Campaign, table, what_next
    from study.verified import say_unchecked

    network, trained = load_commander(policy)
    config = with_filter(configure, trained)
    say_unchecked(config)
    if network:
        check_observed(config, trained)
    ahead = looking_ahead(policy, candidates, horizon)
    period, weights = config.rta.period, digest(network)
    campaign = Campaign(policy, period, duration, seed, BATCH, weights, check_every, *ahead, filter)
    kept = Path(json) if json else None
    report = verify(campaign, episodes, config, network, kept, keep_worst)
    print(table(report))
    print(what_next(report, kept))


def run_boundary(configure: Configure, draws: int = 4096, seed: int = 0, json: str | None = None) -> None:
    """main.py boundary"""
    from study.boundary.boundary import BATCH, Boundary, search
    from study.boundary.report import table
    from study.verified import say_unchecked

    config = with_filter(configure)
    say_unchecked(config)
    print(
        table(search(Boundary(config.rta.period, seed, BATCH), draws, config, Path(json) if json else None))
    )


def run_break_points(
    configure: Configure,
    episodes: int = 96,
    policy: str = "pressing",
    duration: int = 300,
    seed: int = 0,
    json: str | None = None,
    figure: str | None = None,
) -> None:
    """main.py break-points"""
    from study.verification import break_points

    config = with_filter(configure)
    at_corners = " and ".join(break_points.ERRORS)
    worlds = break_points.Worlds(policy, config.rta.period, duration, seed, episodes, errors=at_corners)
    report = break_points.measure(worlds, config, Path(json) if json else None)
    print(break_points.table(report))
    if figure:
        with writing(figure) as file:
            break_points.figure(report).savefig(file, dpi=90)


def run_refly(file: str) -> None:
    """main.py refly"""
    from study.verification.counter_examples import refly_file

    print(refly_file(file))


def run_benchmark(
    configure: Configure,
    batches: tuple[int, ...] | None = None,
    json: str | None = None,
    figure: str | None = None,
) -> None:
    """main.py benchmark"""
    from study.benchmark import measure, presentation

    with refusing("benchmark needs the package gymnasium (pip install '.[gymnasium]')", ImportError):
        from interfaces.vector import VectorInspection6DoF
    config = configure(Config())
    results = measure.benchmark(config, batches or measure.BATCHES, VectorInspection6DoF)
    print(presentation.table(results))
    if json:
        write_json(json, results)
    if figure:
        with writing(figure) as file:
            presentation.figure(results, file)


def run_export(
    configure: Configure,
    checkpoint: str | None = None,
    out: str | None = None,
    c: str | None = None,
    filter: str | None = None,
    prefix: str | None = None,
) -> None:
    """main.py export"""
    named = {} if prefix is None else {"prefix": prefix}
    from study.experiment import load_policy

    if filter is not None:
        from study.export import filter as export_filter

        print(export_filter.export(with_filter(configure), Path(filter), **named))
        return
    if checkpoint is None:
        raise InputError(f"--checkpoint F is needed by {'--out' if c is None else '--c'}")
    policy, config = load_policy(checkpoint)
    if c is not None:
        with refusing("export --c needs the package jinja2 (pip install '.[report]')", ImportError):
            from study.export import policy as export_policy
        print(export_policy.write(policy, config, checkpoint, Path(c), **named))
        return
    with refusing("export needs the packages onnx and onnxruntime of requirements.txt", ImportError):
        from study.export import onnx as export
    model = export.to_onnx(policy, config.inspection, config.chief)
    difference = export.check(model, policy)
    assert out is not None  # the parser sees to it
    with writing(out) as file:
        file.write(model)
    print(
        f"{out}: {len(model):,} bytes, at most {difference:.1g} from PyTorch's controls "
        f"over {export.SAMPLES:,} observations"
    )


HANDLERS: dict[str, Handler] = {
    "train": run_train,
    "study": run_study,
    "report": run_report,
    "evaluate": run_evaluate,
    "simulate": run_simulate,
    "replay": run_replay,
    "play": run_play,
    "filter": run_filter,
    "verify": run_verify,
    "boundary": run_boundary,
    "break-points": run_break_points,
    "refly": run_refly,
    "benchmark": run_benchmark,
    "export": run_export,
}


def main(argv: list[str] | None = None) -> int:
    """Parses and dispatches; returns the exit code."""
    open_error_output()
    if sys.stdout is None:
        return complain(CLOSED, 2)
    code, output = 0, Output(sys.stdout)
    try:
        with redirect_stdout(output if is_first() else None):  # one of many ranks speaks for all
            code = call(sys.argv[1:] if argv is None else argv)
        output.flush()
    except BrokenPipeError:  # the reader of our output, such as head, has left
        output.discard()
    except OSError as error:
        if error.filename != NAME:
            raise
        output.discard()
        code = code or complain(f"{NAME}: {error.strerror}", 2)
    return code


def call(words: list[str]) -> int:
    """What `main` does where standard output can be written."""
    try:
        with redirect_stderr(sys.stderr if is_first() else None):
            arguments = build_parser(HANDLERS, __doc__).parse_args(join_axis(words) or ["--help"])
        from ppo.distributed import ranks
        from study.machine.threads import THREADS

        if ranks().size > 1 and arguments.command not in ("train", "study"):
            raise InputError(
                f"torchrun: {arguments.command} runs in one process; only train and study in many"
            )
        check_files(arguments)
        THREADS.ask(getattr(arguments, "threads", None))
        if cache := getattr(arguments, "cache_dir", None):
            os.environ[VARIABLE] = cache
        HANDLERS[arguments.command](**parameters(arguments))
    except SystemExit as end:  # of the parser: help, or bad usage
        return int(end.code or 0)
    except (InputError, CheckpointError) as error:
        return complain(f"{error}", 2)
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.filename is None:
            raise
        return complain(f"{error.filename}: {error.strerror}", 2, "end")
    except Stopped as stopped:
        print(stopped)
        # of many ranks zero: all else torchrun calls a failure, and begins anew
        return 128 + stopped.number if ranks().size == 1 else 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ReflyError, ExportError) as error:
        return complain(f"{error}", 1)
    except RankLostError as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # from torchrun, which has noticed, too; we are leaving
        return complain(f"{error}", 1, "end")
    except NonFiniteError as error:
        return complain(f"training stopped at {error}", 1, "end")
    return 0


def complain(reason: str, code: int, event: str = "") -> int:
    """One line on stderr, of ranks with the same reason, or of the same event, from one; returns the exit code."""
    from ppo.distributed import ranks

    if ranks().first_to_say(event or reason):
        unfinished = "" if ranks().first else "\n"  # the first rank's progress bar, where it ended midway
        print(f"{unfinished}error: {in_one_line(reason)}", file=sys.stderr)
    return code


def program() -> None:
    """The installed command, and this file as it is called: ends the process with the exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())


if __name__ == "__main__":
    program()
