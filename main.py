#!/usr/bin/env python
"""Run-time-assured reinforcement learning for spacecraft inspection: the command line.

Settings come from defaults, then from --config FILE.toml, then from flags.
"""

import os
import signal
import sys
import time


def interrupted(*_: object) -> None:
    """Ends the program in one line where nothing has begun: the imports below take seconds."""
    print("interrupted", file=sys.stderr)
    os._exit(130)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, interrupted)

from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from kernels.build import VARIABLE
from ppo.checkpoint import CheckpointError
from ppo.distributed import RankLostError, is_first, ranks
from ppo.learner import NonFiniteError
from study.command_line.arguments import Configure, build_parser, check_files, join_axis, parameters
from study.config import TEST_CASES, Config, StudyConfig
from study.errors import ExportError, InputError, ReplayError, in_one_line, refusing
from study.files import write_json, write_npz, writing
from study.machine.threads import THREADS

# A command's parameters are its flags, whose help, limits and order are in `study.command_line.arguments`. `configure`
# puts --config and the other flags, those that set something, over a configuration.


def run_train(
    configure: Configure, run_dir: str | None = None, init_from: str | None = None, resume: str | None = None
) -> None:
    """main.py train"""
    from study.machine.provenance import recorded_threads
    from study.training import session as training
    from study.training.run import Stopped
    from study.verified import say_unless_verified

    if resume:
        THREADS.recorded = recorded_threads(Path(resume))
        session = training.resuming(Path(resume), configure)
    else:
        config = configure(Config())
        arm = f"rta_{config.rta.period:g}s" if config.train.rta else "no_rta"
        name = f"{arm}__{config.train.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
        directory = Path(run_dir or Path("runs") / ranks().agree(name))
        session = training.starting(config, directory, Path(init_from) if init_from else None)
    with session as run:
        print(run, flush=True)
        say_unless_verified(run.config, [run.directory / "config.toml"])
        try:
            run.train()
            if run.ranks.first:
                print(run.conclude())
        except Stopped as stopped:
            print(stopped)


def run_study(configure: Configure, study_dir: str = "runs/study") -> None:
    """main.py study"""
    from study.machine.provenance import recorded_threads
    from study.training.run import Stopped
    from study.training.study import read_settings, train_and_evaluate

    directory = Path(study_dir)
    config = configure(read_settings(directory) or StudyConfig())
    THREADS.recorded = recorded_threads(directory)
    try:
        print(train_and_evaluate(config, directory))
    except Stopped as stopped:
        print(stopped)


def run_report(study: str, device: str | None = None) -> None:
    """main.py report"""
    from study.machine.progress import step

    with refusing("report needs the packages jinja2 and plotly (pip install '.[report]')", ImportError):
        from study.report import figures, inputs, page, replay, tables
    from study.report.compute import compute

    directory = Path(study)
    compute(directory, device)
    with step("drawing the figures and the page, seconds"):
        found = inputs.read(directory)
        tables.write(found)
        figures.draw(found)
        replay.write(found)
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
    from study.flight import evaluation
    from study.paper import tables

    results = evaluation.run(configure, configure.files, episodes, seed, checkpoint, controller)
    print(tables(results))
    print(evaluation.how_to_watch(results, configure.words, checkpoint, controller))
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
    from study.flight import simulation
    from study.flight.figures import constraint_figure

    flown, config = simulation.run(
        configure, configure.files, controller, duration, step, seed, checkpoint, actions, initial_state
    )
    write_npz(out, flown)
    if figure:
        constraint_figure(flown, config.inspection, Path(figure))
    print(f"{out}: {simulation.described(flown)}")


def run_replay(runs: list[str], out: str) -> None:
    """main.py replay"""
    with refusing("replay needs the packages jinja2 and plotly (pip install '.[report]')", ImportError):
        from study.replay import page, scene
    if len(runs) > 2:
        raise InputError(f"{len(runs)} runs: at most two are shown side by side")
    size = page.write(runs, Path(out))
    print(f"{scene.printable(out)}: {1e-6 * size:.1f} MB, opens in a browser without a network")


def run_filter(configure: Configure, states: str, out: str) -> None:
    """main.py filter"""
    from rta.qp.programs import Status
    from study.flight import offline_filter

    result = offline_filter.run(configure, states)
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
    seed: int = 0,
    json: str | None = None,
    keep_worst: bool = False,
    replay: str | None = None,
    boundary: int | None = None,
    break_points: str | None = None,
    filter: str = "python",
) -> None:
    """main.py verify"""
    from study.boundary import report as boundary_report
    from study.boundary.boundary import search
    from study.verification import break_points as breaking
    from study.verification.campaign import verify
    from study.verification.counter_examples import replay_file
    from study.verification.findings import table, what_next

    if replay:
        print(replay_file(replay))
        return
    kept = Path(json) if json else None
    if boundary:
        print(boundary_report.table(search(boundary, seed, configure, kept)))
        return
    if break_points:
        report = breaking.measure(policy, episodes, duration, seed, configure, kept)
        print(breaking.table(report))
        with writing(break_points) as file:
            breaking.figure(report).savefig(file, dpi=90)
        return
    report = verify(
        policy,
        episodes,
        duration,
        seed,
        configure,
        kept,
        check_every,
        candidates,
        horizon,
        keep_worst,
        filter,
    )
    print(table(report))
    print(what_next(report, kept))


def run_benchmark(
    configure: Configure,
    batches: tuple[int, ...] | None = None,
    json: str | None = None,
    figure: str | None = None,
) -> None:
    """main.py benchmark"""
    from study.benchmark import measure, presentation

    results = measure.benchmark(configure(Config()), batches or measure.BATCHES)
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
    float: bool = False,
) -> None:
    """main.py export"""
    from study.experiment import load_policy

    if filter is not None:
        from study.export import filter as export_filter

        config = configure(StudyConfig()).of_arm("rta")
        print(export_filter.export(config, Path(filter), "float" if float else "double"))
        return
    if checkpoint is None:
        raise InputError(f"--checkpoint F is needed by {'--out' if c is None else '--c'}")
    policy, config = load_policy(checkpoint)
    if c is not None:
        with refusing("export --c needs the package jinja2 (pip install '.[report]')", ImportError):
            from study.export import policy as export_policy
        print(export_policy.write(policy, config, checkpoint, Path(c)))
        return
    with refusing("export needs the packages onnx and onnxruntime of requirements.txt", ImportError):
        from study.export import onnx as export
    model = export.to_onnx(policy, config.inspection, config.chief)
    difference = export.check(model, policy)
    with writing(out) as file:
        file.write(model)
    print(
        f"{out}: {len(model):,} bytes, at most {difference:.1g} from PyTorch's controls "
        f"over {export.SAMPLES:,} observations"
    )


HANDLERS = {
    "train": run_train,
    "study": run_study,
    "report": run_report,
    "evaluate": run_evaluate,
    "simulate": run_simulate,
    "replay": run_replay,
    "filter": run_filter,
    "verify": run_verify,
    "benchmark": run_benchmark,
    "export": run_export,
}


def main(argv: list[str] | None = None) -> int:
    """Parses and dispatches; returns the exit code."""
    out, err = (sys.stdout, sys.stderr) if is_first() else (None, None)  # one of many ranks speaks for all
    with redirect_stdout(out), redirect_stderr(err):
        arguments = build_parser(HANDLERS, __doc__).parse_args(
            join_axis(sys.argv[1:] if argv is None else argv)
        )
    try:
        with redirect_stdout(out):
            if ranks().size > 1 and arguments.command not in ("train", "study"):
                raise InputError(
                    f"torchrun: {arguments.command} runs in one process; only train and study in many"
                )
            check_files(arguments)
            THREADS.ask(getattr(arguments, "threads", None))
            if cache := getattr(arguments, "cache_dir", None):
                os.environ[VARIABLE] = cache
            HANDLERS[arguments.command](**parameters(arguments))
    except (InputError, CheckpointError) as error:
        return complain(f"{error}", 2)
    except BrokenPipeError:  # the reader of our output, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        if error.filename is None:
            raise
        return complain(f"{error.filename}: {error.strerror}", 2, "end")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ReplayError, ExportError) as error:
        return complain(f"{error}", 1)
    except RankLostError as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # from torchrun, which has noticed, too; we are leaving
        return complain(f"{error}", 1, "end")
    except NonFiniteError as error:
        return complain(f"training stopped at {error}", 1, "end")
    return 0


def complain(reason: str, code: int, event: str = "") -> int:
    """One line on stderr, of ranks with the same reason, or of the same event, from one; returns the exit code."""
    if ranks().first_to_say(event or reason):
        unfinished = "" if ranks().first else "\n"  # the first rank's progress bar, where it ended midway
        print(f"{unfinished}error: {in_one_line(reason)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
