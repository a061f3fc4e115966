#!/usr/bin/env python
"""Run-time-assured reinforcement learning for spacecraft inspection: the command line.

Settings come from defaults, then from --config FILE.toml, then from flags.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

from inspection.parameters import AXES, InspectionParameters
from ppo.checkpoint import CheckpointError
from ppo.learner import NonFiniteError, PPOParameters
from rta.filter import SOLVERS
from rta.parameters import PERIODS
from study import config as configuration
from study.config import ARMS, AnyConfig, Config, StudyConfig, StudyParameters, TrainParameters
from study.errors import InputError, ReplayError, refusing

# flag: (TOML table, key, type, help); a flag's default is that of its key
TRAIN, PPO, TASK = TrainParameters(), PPOParameters(), InspectionParameters()
STUDY = StudyParameters()
DEFAULT_SOLVER = "piqp"  # of every command but train, study and verify
VERIFY = {"episodes": 1000, "policy": "random", "duration": 2000, "seed": 0}  # where no flag says otherwise
CONTROLLERS = ("lqr-pd", "natural-motion", "policy", "recorded", "zero", "random")


class Parser(argparse.ArgumentParser):
    """Bad usage ends with one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {self.prog}: {message} (see --help)\n")


def positive_integer(text: str) -> int:
    """A count for argparse."""
    try:
        value = int(text.replace("_", ""))
    except ValueError:
        value = 0
    if not 0 < value <= configuration.MAX_COUNT:
        raise argparse.ArgumentTypeError(
            f"{text[:40]!r}: must be a positive integer up to {configuration.MAX_COUNT:,}"
        )
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
    if not set(names) <= set(ARMS) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: must be {','.join(ARMS)} or one of the two")
    return names


def period(text: str) -> float:
    """A filter period for argparse."""
    if text not in {f"{p:g}" for p in PERIODS} | {f"{p:.1f}" for p in PERIODS}:
        raise argparse.ArgumentTypeError(f"{text!r}: must be 1, 5 or 10 (s)")
    return float(text)


def verified_policy(text: str) -> str:
    """A policy of verify for argparse."""
    if text not in ("random", "adversarial") and not text.startswith("checkpoint:"):
        raise argparse.ArgumentTypeError(f"{text!r}: must be random, adversarial or checkpoint:F")
    return text


def add_common(parser: Parser) -> None:
    """Flags that every sub-command shares."""
    parser.add_argument(
        "--config", metavar="FILE", help="TOML file with settings, under the flags (default: none)"
    )
    parser.add_argument(
        "--rta-period",
        type=period,
        metavar="S",
        help=f"seconds between two calls of the filter: 1, 5 or 10 (default: {TRAIN.rta_period:g})",
    )
    parser.add_argument(
        "--solar-panel-axis",
        choices=tuple(AXES),
        help=f"body axis that the solar panels face (default: {TASK.solar_panel_axis})",
    )
    parser.add_argument(
        "--compile",
        choices=("auto", "on", "off"),
        help="torch.compile filter, simulator and learner; auto: for runs long enough to repay it "
        f"(default: {TRAIN.compile})",
    )
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), help=f"where tensors live (default: {TRAIN.device})"
    )


def add_solver(parser: Parser, default: str = DEFAULT_SOLVER) -> None:
    """The choice of the filter's solver; only a training run may choose for itself."""
    parser.add_argument(
        "--qp-solver",
        choices=tuple(dict.fromkeys((default, *SOLVERS))),
        help=f"solver of the filter's quadratic programs (default: {default}"
        + ("; the faster one for the device and --num-envs)" if default == "auto" else ")"),
    )


def add_rta(parser: Parser) -> None:
    """The switch of the filter."""
    parser.add_argument(
        "--rta",
        action=argparse.BooleanOptionalAction,
        help="filter every control by run time assurance (default: on; with --checkpoint as it was trained)",
    )


def build_parser() -> Parser:
    """The whole command line."""
    parser = Parser(prog="main.py", description=__doc__, allow_abbrev=False)
    commands = parser.add_subparsers(
        dest="command",
        required=True,
        metavar="train | study | report | evaluate | simulate | filter | verify | benchmark",
    )

    train = commands.add_parser(
        "train", allow_abbrev=False, help="train an agent with or without run time assurance"
    )
    add_rta(train)
    add_common(train)
    add_solver(train, TRAIN.qp_solver)
    counts = (
        ("interactions", TRAIN.interactions, "agent steps of 10 s in all, rounded up to whole updates"),
        ("num-envs", TRAIN.num_envs, "episodes simulated at once"),
        ("rollout-steps", TRAIN.rollout_steps, "interactions of each episode between two updates"),
        ("evaluation-interval", TRAIN.evaluation_interval, "interactions between two evaluations"),
        ("evaluation-episodes", TRAIN.evaluation_episodes, "episodes of each periodic evaluation"),
        ("final-episodes", TRAIN.final_episodes, "episodes of the evaluation after training"),
        ("epochs", PPO.epochs, "passes over each batch of experience"),
        ("minibatch-size", PPO.minibatch_size, "interactions per gradient step"),
    )
    for name, default, text in counts:
        train.add_argument(
            f"--{name}", type=positive_integer, metavar="N", help=f"{text} (default: {default:,})"
        )
    train.add_argument(
        "--learning-rate",
        type=positive_number,
        metavar="X",
        help=f"of Adam, annealed to 0 (default: {PPO.learning_rate:g})",
    )
    train.add_argument(
        "--seed", type=seed_number, metavar="N", help=f"of everything random (default: {TRAIN.seed})"
    )
    train.add_argument(
        "--run-dir", metavar="D", help="directory to create (default: runs/<arm>__<seed>__<time>)"
    )
    train.add_argument(
        "--resume", metavar="D", help="continue the run in D exactly where it stopped (default: none)"
    )
    train.set_defaults(run=run_train)

    study = commands.add_parser(
        "study",
        allow_abbrev=False,
        help="train many seeds of both arms and evaluate them; the same command continues an interrupted study",
    )
    add_common(study)
    add_solver(study, TRAIN.qp_solver)
    study.add_argument(
        "--seeds",
        type=positive_integer,
        metavar="N",
        help=f"agents of each arm, trained as one batch (default: {STUDY.seeds})",
    )
    study.add_argument(
        "--arms",
        type=arm_list,
        metavar="A,A",
        help=f"no_rta, rta or both, in this order (default: {','.join(STUDY.arms)})",
    )
    study.add_argument(
        "--interactions",
        type=positive_integer,
        metavar="N",
        help=f"agent steps of 10 s of each seed in each arm, rounded up to whole updates "
        f"(default: {TRAIN.interactions:,})",
    )
    study.add_argument(
        "--num-envs",
        type=positive_integer,
        metavar="N",
        help=f"episodes of each seed simulated at once (default: {TRAIN.num_envs})",
    )
    study.add_argument(
        "--study-dir",
        default="runs/study",
        metavar="D",
        help="directory to create, or of the study to continue (default: runs/study)",
    )
    study.set_defaults(run=run_study)

    report = commands.add_parser(
        "report",
        allow_abbrev=False,
        help="write a finished study's results as one page, with its figures and the data behind them",
    )
    report.add_argument("--study", required=True, metavar="D", help="directory of a finished study")
    report.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        help="where tensors live (default: as in the study)",
    )
    report.set_defaults(run=run_report)

    evaluate = commands.add_parser(
        "evaluate",
        allow_abbrev=False,
        help="report an agent or a controller in the metrics of the paper's Tables 2 and 3",
    )
    add_rta(evaluate)
    add_common(evaluate)
    add_solver(evaluate)
    flown = evaluate.add_mutually_exclusive_group(required=True)
    flown.add_argument(
        "--checkpoint", metavar="F", help="the agent: policy.pt or checkpoint.pt of a run (default: none)"
    )
    flown.add_argument(
        "--controller",
        choices=("natural-motion",),
        help="a classical controller, which decides at every call of the filter, without it every second, "
        "instead of an agent (default: none)",
    )
    evaluate.add_argument(
        "--episodes", type=positive_integer, default=100, metavar="N", help="test cases (default: 100)"
    )
    evaluate.add_argument(
        "--seed", type=seed_number, default=0, metavar="N", help="of the test cases (default: 0)"
    )
    evaluate.add_argument("--json", metavar="F", help="also write the results there (default: none)")
    evaluate.set_defaults(run=run_evaluate)

    simulate = commands.add_parser(
        "simulate", allow_abbrev=False, help="simulate one spacecraft and write everything over time"
    )
    add_rta(simulate)
    add_common(simulate)
    add_solver(simulate)
    simulate.add_argument(
        "--controller", required=True, choices=CONTROLLERS, help="who commands the spacecraft"
    )
    simulate.add_argument(
        "--checkpoint", metavar="F", help="the agent, for --controller policy (default: none)"
    )
    simulate.add_argument(
        "--actions",
        metavar="F.npy",
        help="N x 6 controls in N and N m, a row per --step, for --controller recorded (default: none)",
    )
    simulate.add_argument("--initial-state", metavar="F.json", help="state file (default: drawn from --seed)")
    simulate.add_argument(
        "--seed", type=seed_number, default=0, metavar="N", help="of what is drawn (default: 0)"
    )
    simulate.add_argument("--duration", type=positive_number, required=True, metavar="S", help="seconds")
    simulate.add_argument(
        "--step",
        type=positive_number,
        default=1.0,
        metavar="S",
        help="seconds between two rows of the output, two decisions of a classical controller and two rows of "
        "--actions; a policy decides every 10 s (default: 1)",
    )
    simulate.add_argument("--out", required=True, metavar="F.npz", help="file to write")
    simulate.add_argument(
        "--figure", metavar="F.png", help="also draw limits and controls over time there (default: none)"
    )
    simulate.set_defaults(run=run_simulate)

    offline = commands.add_parser(
        "filter",
        allow_abbrev=False,
        help="filter a batch of states from elsewhere and write out the quadratic programs",
    )
    add_common(offline)
    add_solver(offline)
    offline.add_argument(
        "--states",
        required=True,
        metavar="F.npz",
        help="file with state (N x 16, the order of inspection/state.py) and control_desired (N x 6, N and N m)",
    )
    offline.add_argument("--out", required=True, metavar="G.npz", help="file to write")
    offline.set_defaults(run=run_filter, rta=True)

    verify = commands.add_parser(
        "verify", allow_abbrev=False, help="count violations behind the filter over many random episodes"
    )
    add_common(verify)
    add_solver(verify, "batched")
    verify.add_argument(
        "--episodes",
        type=positive_integer,
        metavar="N",
        help="in all, from starts that the filter can hold; the others met on the way are reported beside them "
        f"(default: {VERIFY['episodes']:,})",
    )
    verify.add_argument(
        "--policy",
        type=verified_policy,
        metavar="P",
        help="random actions held for random times, adversarial (down the worst constraint's slope) or "
        f"checkpoint:F (default: {VERIFY['policy']})",
    )
    verify.add_argument(
        "--duration",
        type=positive_integer,
        metavar="S",
        help=f"whole seconds of each episode, every one of them checked (default: {VERIFY['duration']:,})",
    )
    verify.add_argument(
        "--seed", type=seed_number, metavar="N", help=f"of everything random (default: {VERIFY['seed']})"
    )
    verify.add_argument(
        "--json", metavar="F", help="write the report there, and continue the one it holds (default: none)"
    )
    verify.add_argument(
        "--replay",
        metavar="F.npz",
        help="fly the counter-example in a file instead, which holds all settings (default: none)",
    )
    verify.set_defaults(run=run_verify)

    bench = commands.add_parser(
        "benchmark", allow_abbrev=False, help="measure the speed of simulator, filter, solvers and learner"
    )
    bench.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), help=f"where tensors live (default: {TRAIN.device})"
    )
    bench.add_argument(
        "--compile",
        choices=("on", "off"),
        default="on",
        help="torch.compile filter, simulator and learner (default: on)",
    )
    bench.add_argument(
        "--batches",
        type=batch_list,
        metavar="N,N,...",
        help="episodes, spacecraft and samples at once (default: 256 to 65,536 in powers of 4)",
    )
    bench.add_argument("--json", metavar="F", help="also write the results there (default: none)")
    bench.add_argument("--figure", metavar="F.png", help="also draw rates over batches there (default: none)")
    bench.set_defaults(run=run_benchmark, config=None)
    return parser


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
    keys = set(vars(TRAIN)) - {"seed"} | set(places) | ({"seed"} if arguments.command == "train" else set())
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
        if value is not None and key not in ("command", "run", flag)
    ]
    if given:
        raise InputError(f"--{flag} takes its settings from the {source}; drop {', '.join(given)}")


def run_train(arguments: argparse.Namespace) -> None:
    """main.py train"""
    from study import training

    if arguments.resume:
        refuse_other_flags(arguments, "resume", "run")
        run = training.resume(Path(arguments.resume))
    else:
        config = resolve(arguments, Config())
        train = config.train
        arm = f"rta_{train.rta_period:g}s" if train.rta else "no_rta"
        name = f"{arm}__{train.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
        run = training.start(config, Path(arguments.run_dir or Path("runs") / name))
    print(training.describe(run), flush=True)
    try:
        run.train()
    except training.Stopped as stopped:
        print(stopped)
        return
    print(run.conclude())


def run_study(arguments: argparse.Namespace) -> None:
    """main.py study"""
    from study import arms, training

    directory = Path(arguments.study_dir)
    config = resolve(arguments, arms.settings(directory) or StudyConfig())
    try:
        print(arms.run(config, directory))
    except training.Stopped as stopped:
        print(stopped)


def run_report(arguments: argparse.Namespace) -> None:
    """main.py report"""
    from study import html, report_tables, supplements

    directory = Path(arguments.study)
    supplements.compute(directory, arguments.device)
    report_tables.write(directory)
    html.write(directory)
    print(f"Written to {directory}: report.html and, in report, its figures and the data behind them")


def run_evaluate(arguments: argparse.Namespace) -> None:
    """main.py evaluate"""
    from study import build, evaluation
    from study.tables import tables

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

    from study import build, simulation

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
        from study.figures import constraint_figure

        with refusing(f"--figure {arguments.figure}: cannot write it", OSError):
            constraint_figure(result, config.inspection, Path(arguments.figure))
    violated = [
        name[2:] for name, values in result.items() if name.startswith("h_") and not (values >= 0).all()
    ]
    print(
        f"{arguments.out}: {len(result['time'])} rows over {result['time'][-1]:g} s, "
        f"inspected {result['inspected_score'][-1]:.3f}, violated constraints: {', '.join(violated) or 'none'}"
    )


def run_filter(arguments: argparse.Namespace) -> None:
    """main.py filter"""
    import numpy as np

    from rta.qp import Status
    from study import build, offline

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
    from study import verification

    if arguments.replay:
        refuse_other_flags(arguments, "replay", "file")
        print(verification.replay_file(arguments.replay))
        return
    missing = {key: value for key, value in VERIFY.items() if getattr(arguments, key) is None}
    vars(arguments).update(missing, rta=True)
    if arguments.json:
        check_writable(arguments.json, "--json")
    report = verification.verify(
        arguments.policy,
        arguments.episodes,
        arguments.duration,
        arguments.seed,
        lambda base: resolve(arguments, base),
        Path(arguments.json) if arguments.json else None,
    )
    print(verification.table(report))


def run_benchmark(arguments: argparse.Namespace) -> None:
    """main.py benchmark"""
    from study import benchmark

    config = resolve(arguments, Config())
    for flag in ("json", "figure"):
        if path := getattr(arguments, flag):
            check_writable(path, f"--{flag}")
    results = benchmark.benchmark(config, arguments.batches or benchmark.BATCHES)
    print(benchmark.table(results))
    if arguments.json:
        with refusing(f"--json {arguments.json}: cannot write it", OSError):
            Path(arguments.json).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    if arguments.figure:
        with refusing(f"--figure {arguments.figure}: cannot write it", OSError):
            benchmark.figure(results, Path(arguments.figure))


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


def main(argv: list[str] | None = None) -> int:
    """Parses and dispatches; returns the exit code."""
    arguments = build_parser().parse_args(join_axis(sys.argv[1:] if argv is None else argv))
    try:
        arguments.run(arguments)
    except (InputError, CheckpointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except ReplayError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except NonFiniteError as error:
        print(f"error: training stopped at {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
