#!/usr/bin/env python
"""Run-time-assured reinforcement learning for spacecraft inspection: the command line.

Settings come from defaults, then from --config FILE.toml, then from flags.
"""

import argparse
import json
import os
import signal
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from ppo.checkpoint import CheckpointError
from ppo.distributed import RankLostError, is_first, ranks
from ppo.learner import NonFiniteError
from study import config as configuration
from study.arguments import DEFAULT_SOLVER, VERIFY, build_parser
from study.config import AnyConfig, Config, StudyConfig, TrainParameters
from study.errors import ExportError, InputError, ReplayError, refusing


def resolve(arguments: argparse.Namespace, base: AnyConfig) -> AnyConfig:
    """The base configuration under --config under the flags."""
    own = base.train.qp_solver
    solver = {"train": own, "study": own, "verify": "batched"}.get(arguments.command, DEFAULT_SOLVER)
    base = configuration.override(base, {"train": {"qp_solver": solver}}, "default")
    if arguments.config:
        base = configuration.load(arguments.config, base)
        if base.train.qp_solver == "auto":  # a choice for training
            base = configuration.override(base, {"train": {"qp_solver": solver}}, "default")
    places = {
        "solar_panel_axis": "inspection",
        "learning_rate": "ppo",
        "epochs": "ppo",
        "minibatch_size": "ppo",
        "seeds": "study",
        "arms": "study",
    }
    keys = (
        set(vars(TrainParameters())) - {"seed"}
        | set(places)
        | ({"seed"} if arguments.command == "train" else set())
    )
    tables: dict[str, dict[str, Any]] = {}
    for key, value in vars(arguments).items():
        if key in keys and value is not None:
            tables.setdefault(places.get(key, "train"), {})[key] = value
    return configuration.override(base, tables, "command line")


def refuse_other_flags(arguments: argparse.Namespace, flag: str, source: str) -> None:
    """Refuses every flag beside one that names where all settings come from."""
    given = [
        f"--{key.replace('_', '-')}"
        for key, value in vars(arguments).items()
        if value is not None and key not in ("command", flag)
    ]
    if given:
        raise InputError(f"--{flag} takes its settings from the {source}; drop {', '.join(given)}")


def run_train(arguments: argparse.Namespace) -> None:
    """main.py train"""
    from study.training import run as training

    if arguments.resume:
        refuse_other_flags(arguments, "resume", "run")
        run = training.resume(Path(arguments.resume))
    else:
        config = resolve(arguments, Config())
        train = config.train
        arm = f"rta_{train.rta_period:g}s" if train.rta else "no_rta"
        name = f"{arm}__{train.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
        run = training.start(config, Path(arguments.run_dir or Path("runs") / ranks().agree(name)))
    print(training.describe(run), flush=True)
    try:
        run.train()
    except training.Stopped as stopped:
        print(stopped)
        return
    if run.ranks.first:
        print(run.conclude())


def run_study(arguments: argparse.Namespace) -> None:
    """main.py study"""
    from study.training import run as training
    from study.training import study as arms

    directory = Path(arguments.study_dir)
    config = resolve(arguments, arms.settings(directory) or StudyConfig())
    try:
        print(arms.run(config, directory))
    except training.Stopped as stopped:
        print(stopped)


def run_report(arguments: argparse.Namespace) -> None:
    """main.py report"""
    from study.report import figures, inputs, page, tables
    from study.report.compute import compute

    directory = Path(arguments.study)
    compute(directory, arguments.device)
    found = inputs.read(directory)
    tables.write(found)
    figures.draw(found)
    page.write(found)
    print(f"Written to {directory}: report.html and, in report, its figures and the data behind them")


def run_evaluate(arguments: argparse.Namespace) -> None:
    """main.py evaluate"""
    from study import experiment as build
    from study.flight import evaluation
    from study.paper import tables

    policy, base = None, Config()
    if arguments.checkpoint:
        policy, base = build.load_policy(arguments.checkpoint)
    config = resolve(arguments, base)
    safety, device = build.for_command(config, build.TYPICAL_EPISODE, arguments.episodes)
    if arguments.json:
        check_writable(arguments.json, "--json")
    cases = config, arguments.episodes, arguments.seed, device, safety
    record = evaluation.play(policy.to(device), *cases) if policy else evaluation.play_guidance(*cases)
    results = evaluation.report(record, config, config.train.rta, config.train.rta_period, arguments.seed)
    print(tables(results))
    if arguments.json:
        with refusing(f"--json {arguments.json}: cannot write it", OSError):
            Path(arguments.json).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def run_simulate(arguments: argparse.Namespace) -> None:
    """main.py simulate"""
    import numpy as np

    from study import experiment as build
    from study.flight import simulation

    check_writable(arguments.out, "--out")
    if arguments.figure:
        check_writable(arguments.figure, "--figure")
    base, policy = Config(), None
    if (arguments.controller == "policy") != bool(arguments.checkpoint):
        raise InputError("--checkpoint F is needed by --controller policy and by no other")
    if (arguments.controller == "recorded") != bool(arguments.actions):
        raise InputError("--actions F.npy is needed by --controller recorded and by no other")
    if arguments.checkpoint:
        policy, base = build.load_policy(arguments.checkpoint)
    config = resolve(arguments, base)
    train, step = config.train, arguments.step
    simulation.check_step(
        step, arguments.duration, train.rta_period if train.rta else None, config.inspection
    )
    safety, device = build.for_command(config, arguments.duration, 1)
    given = simulation.read_state(arguments.initial_state) if arguments.initial_state else None
    x, priority = simulation.starting_point(given, config, arguments.seed)
    env = build.one_episode(config, safety, device)
    if policy is not None:
        controller, decide_every = (
            simulation.policy_controller(policy.to(device), env),
            config.inspection.action_period,
        )
    else:
        controller = simulation.classical(
            arguments.controller, arguments.actions, config, step, arguments.seed
        )
        decide_every = step
    result = simulation.simulate(
        env, controller, x.to(device), priority.to(device), arguments.duration, step, decide_every
    )
    with refusing(f"--out {arguments.out}: cannot write it", OSError), open(arguments.out, "wb") as file:
        np.savez_compressed(file, **result)
    if arguments.figure:
        from study.flight.figures import constraint_figure

        with refusing(f"--figure {arguments.figure}: cannot write it", OSError):
            constraint_figure(result, config.inspection, Path(arguments.figure))
    violated = [
        name[2:] for name, values in result.items() if name.startswith("h_") and not (values >= 0).all()
    ]
    print(
        f"{arguments.out}: {len(result['time'])} rows over {result['time'][-1]:g} s, "
        f"inspected {result['inspected_score'][-1]:.3f}, violated constraints: {', '.join(violated) or 'none'}"
    )


def run_replay(arguments: argparse.Namespace) -> None:
    """main.py replay"""
    from study.replay import page as replay
    from study.replay import scene as replay_data

    if len(arguments.runs) > 2:
        raise InputError(f"{len(arguments.runs)} runs: at most two are shown side by side")
    check_writable(arguments.out, "--out")
    size = replay.write(arguments.runs, Path(arguments.out))
    out = replay_data.printable(arguments.out)
    print(f"{out}: {1e-6 * size:.1f} MB, opens in a browser without a network")


def run_filter(arguments: argparse.Namespace) -> None:
    """main.py filter"""
    import numpy as np

    from rta.qp import Status
    from study import experiment as build
    from study.flight import offline_filter as offline

    config = resolve(arguments, Config())
    x, desired = offline.read_states(arguments.states, config.inspection)
    check_writable(arguments.out, "--out")
    calls = -(-x.shape[1] // offline.CHUNK)
    safety, device = build.for_command(config, calls * config.train.rta_period, x.shape[1])
    result = offline.filter_states(safety.correct, x.to(device), desired.to(device))
    with refusing(f"--out {arguments.out}: cannot write it", OSError), open(arguments.out, "wb") as file:
        np.savez_compressed(file, **result)
    counts = [f"{(result['status'] == status).sum():,} {status.name.lower()}" for status in Status]
    print(f"{arguments.out}: {len(result['status']):,} states, {', '.join(counts)}")


def run_verify(arguments: argparse.Namespace) -> None:
    """main.py verify"""
    from study.verification.campaign import verify
    from study.verification.counter_examples import replay_file
    from study.verification.findings import table

    if arguments.replay:
        refuse_other_flags(arguments, "replay", "file")
        print(replay_file(arguments.replay))
        return
    missing = {key: value for key, value in VERIFY.items() if getattr(arguments, key) is None}
    vars(arguments).update(missing, rta=True)
    if arguments.json:
        check_writable(arguments.json, "--json")
    report = verify(
        arguments.policy,
        arguments.episodes,
        arguments.duration,
        arguments.seed,
        lambda base: resolve(arguments, base),
        Path(arguments.json) if arguments.json else None,
    )
    print(table(report))


def run_export(arguments: argparse.Namespace) -> None:
    """main.py export"""
    from study import experiment as build

    with refusing("export needs the packages onnx and onnxruntime of requirements.txt", ImportError):
        from study import export
    check_writable(arguments.out, "--out")
    policy, config = build.load_policy(arguments.checkpoint)
    model = export.to_onnx(policy, config.inspection)
    difference = export.check(model, policy)
    with refusing(f"--out {arguments.out}: cannot write it", OSError):
        Path(arguments.out).write_bytes(model)
    print(
        f"{arguments.out}: {len(model):,} bytes, at most {difference:.1g} from PyTorch's controls "
        f"over {export.SAMPLES:,} observations"
    )


def run_benchmark(arguments: argparse.Namespace) -> None:
    """main.py benchmark"""
    from study.benchmark import measure as benchmark
    from study.benchmark import presentation as benchmark_report

    config = resolve(arguments, Config())
    for flag in ("json", "figure"):
        if path := getattr(arguments, flag):
            check_writable(path, f"--{flag}")
    results = benchmark.benchmark(config, arguments.batches or benchmark.BATCHES)
    print(benchmark_report.table(results))
    if arguments.json:
        with refusing(f"--json {arguments.json}: cannot write it", OSError):
            Path(arguments.json).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    if arguments.figure:
        with refusing(f"--figure {arguments.figure}: cannot write it", OSError):
            benchmark_report.figure(results, Path(arguments.figure))


def check_writable(path: str, flag: str) -> None:
    """Refuses an output file that cannot be written before any work is done; leaves nothing behind."""
    with refusing(f"{flag} {path!r}: cannot write it", OSError, ValueError):
        existed = Path(path).exists()
        with open(path, "ab"):
            pass
        if not existed:
            Path(path).unlink()


def join_axis(argv: list[str]) -> list[str]:
    """Writes "--solar-panel-axis -x" with an equals sign, since argparse takes a lone -x for a flag."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] == "--solar-panel-axis":
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


COMMANDS = {
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
        arguments = build_parser(__doc__).parse_args(join_axis(sys.argv[1:] if argv is None else argv))
    try:
        with redirect_stdout(out):
            if ranks().size > 1 and arguments.command not in ("train", "study"):
                raise InputError(
                    f"torchrun: {arguments.command} runs in one process; only train and study in many"
                )
            COMMANDS[arguments.command](arguments)
    except (InputError, CheckpointError) as error:
        return complain(f"{error}", 2)
    except BrokenPipeError:  # the reader of our output, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
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
        print(f"{unfinished}error: {reason}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
