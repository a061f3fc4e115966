"""The flags of the command line: every sub-command's, with their units, defaults and limits."""

import argparse
from typing import NoReturn, TypeAlias

from inspection.parameters import AXES, InspectionParameters
from ppo.learner import PPOParameters
from rta.filter import SOLVERS
from rta.parameters import PERIODS
from study import config as configuration
from study.config import ARMS, StudyParameters, TrainParameters

# a flag's default is that of its key
TRAIN, PPO, TASK = TrainParameters(), PPOParameters(), InspectionParameters()
STUDY = StudyParameters()
DEFAULT_SOLVER = "piqp"  # of every command but train, study and verify
VERIFY = {"episodes": 1000, "policy": "random", "duration": 2000, "seed": 0}  # where no flag says otherwise
CONTROLLERS = ("lqr-pd", "natural-motion", "policy", "recorded", "zero", "random")

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"


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


def add_train(commands: Commands) -> None:
    """main.py train"""
    parser = commands.add_parser(
        "train", allow_abbrev=False, help="train an agent with or without run time assurance"
    )
    add_rta(parser)
    add_common(parser)
    add_solver(parser, TRAIN.qp_solver)
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
        parser.add_argument(
            f"--{name}", type=positive_integer, metavar="N", help=f"{text} (default: {default:,})"
        )
    parser.add_argument(
        "--learning-rate",
        type=positive_number,
        metavar="X",
        help=f"of Adam, annealed to 0 (default: {PPO.learning_rate:g})",
    )
    parser.add_argument(
        "--seed", type=seed_number, metavar="N", help=f"of everything random (default: {TRAIN.seed})"
    )
    parser.add_argument(
        "--run-dir", metavar="D", help="directory to create (default: runs/<arm>__<seed>__<time>)"
    )
    parser.add_argument(
        "--resume", metavar="D", help="continue the run in D exactly where it stopped (default: none)"
    )


def add_study(commands: Commands) -> None:
    """main.py study"""
    parser = commands.add_parser(
        "study",
        allow_abbrev=False,
        help="train many seeds of both arms and evaluate them; the same command continues an interrupted study",
    )
    add_common(parser)
    add_solver(parser, TRAIN.qp_solver)
    parser.add_argument(
        "--seeds",
        type=positive_integer,
        metavar="N",
        help=f"agents of each arm, trained as one batch (default: {STUDY.seeds})",
    )
    parser.add_argument(
        "--arms",
        type=arm_list,
        metavar="A,A",
        help=f"no_rta, rta or both, in this order (default: {','.join(STUDY.arms)})",
    )
    parser.add_argument(
        "--interactions",
        type=positive_integer,
        metavar="N",
        help=f"agent steps of 10 s of each seed in each arm, rounded up to whole updates "
        f"(default: {TRAIN.interactions:,})",
    )
    parser.add_argument(
        "--num-envs",
        type=positive_integer,
        metavar="N",
        help=f"episodes of each seed simulated at once (default: {TRAIN.num_envs})",
    )
    parser.add_argument(
        "--study-dir",
        default="runs/study",
        metavar="D",
        help="directory to create, or of the study to continue (default: runs/study)",
    )


def add_report(commands: Commands) -> None:
    """main.py report"""
    parser = commands.add_parser(
        "report",
        allow_abbrev=False,
        help="write a finished study's results as one page, with its figures and the data behind them",
    )
    parser.add_argument("--study", required=True, metavar="D", help="directory of a finished study")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        help="where tensors live (default: as in the study)",
    )


def add_evaluate(commands: Commands) -> None:
    """main.py evaluate"""
    parser = commands.add_parser(
        "evaluate",
        allow_abbrev=False,
        help="report an agent or a controller in the metrics of the paper's Tables 2 and 3",
    )
    add_rta(parser)
    add_common(parser)
    add_solver(parser)
    flown = parser.add_mutually_exclusive_group(required=True)
    flown.add_argument(
        "--checkpoint", metavar="F", help="the agent: policy.pt or checkpoint.pt of a run (default: none)"
    )
    flown.add_argument(
        "--controller",
        choices=("natural-motion",),
        help="a classical controller, which decides at every call of the filter, without it every second, "
        "instead of an agent (default: none)",
    )
    parser.add_argument(
        "--episodes", type=positive_integer, default=100, metavar="N", help="test cases (default: 100)"
    )
    parser.add_argument(
        "--seed", type=seed_number, default=0, metavar="N", help="of the test cases (default: 0)"
    )
    parser.add_argument("--json", metavar="F", help="also write the results there (default: none)")


def add_simulate(commands: Commands) -> None:
    """main.py simulate"""
    parser = commands.add_parser(
        "simulate", allow_abbrev=False, help="simulate one spacecraft and write everything over time"
    )
    add_rta(parser)
    add_common(parser)
    add_solver(parser)
    parser.add_argument(
        "--controller", required=True, choices=CONTROLLERS, help="who commands the spacecraft"
    )
    parser.add_argument(
        "--checkpoint", metavar="F", help="the agent, for --controller policy (default: none)"
    )
    parser.add_argument(
        "--actions",
        metavar="F.npy",
        help="N x 6 controls in N and N m, a row per --step, for --controller recorded (default: none)",
    )
    parser.add_argument("--initial-state", metavar="F.json", help="state file (default: drawn from --seed)")
    parser.add_argument(
        "--seed", type=seed_number, default=0, metavar="N", help="of what is drawn (default: 0)"
    )
    parser.add_argument("--duration", type=positive_number, required=True, metavar="S", help="seconds")
    parser.add_argument(
        "--step",
        type=positive_number,
        default=1.0,
        metavar="S",
        help="seconds between two rows of the output, two decisions of a classical controller and two rows of "
        "--actions; a policy decides every 10 s (default: 1)",
    )
    parser.add_argument("--out", required=True, metavar="F.npz", help="file to write")
    parser.add_argument(
        "--figure", metavar="F.png", help="also draw limits and controls over time there (default: none)"
    )


def add_replay(commands: Commands) -> None:
    """main.py replay"""
    parser = commands.add_parser(
        "replay", allow_abbrev=False, help="write a page that plays one or two simulated runs in 3-D"
    )
    parser.add_argument(
        "runs", nargs="+", metavar="RUN.npz", help="a file of simulate, or two, side by side (required)"
    )
    parser.add_argument("--out", required=True, metavar="F.html", help="page to write")


def add_filter(commands: Commands) -> None:
    """main.py filter"""
    parser = commands.add_parser(
        "filter",
        allow_abbrev=False,
        help="filter a batch of states from elsewhere and write out the quadratic programs",
    )
    add_common(parser)
    add_solver(parser)
    parser.add_argument(
        "--states",
        required=True,
        metavar="F.npz",
        help="file with state (N x 16, the order of inspection/state.py) and control_desired (N x 6, N and N m)",
    )
    parser.add_argument("--out", required=True, metavar="G.npz", help="file to write")
    parser.set_defaults(rta=True)


def add_verify(commands: Commands) -> None:
    """main.py verify"""
    parser = commands.add_parser(
        "verify", allow_abbrev=False, help="count violations behind the filter over many random episodes"
    )
    add_common(parser)
    add_solver(parser, "batched")
    parser.add_argument(
        "--episodes",
        type=positive_integer,
        metavar="N",
        help="in all, from starts that the filter can hold; the others met on the way are reported beside them "
        f"(default: {VERIFY['episodes']:,})",
    )
    parser.add_argument(
        "--policy",
        type=verified_policy,
        metavar="P",
        help="random actions held for random times, adversarial (down the worst constraint's slope) or "
        f"checkpoint:F (default: {VERIFY['policy']})",
    )
    parser.add_argument(
        "--duration",
        type=positive_integer,
        metavar="S",
        help=f"whole seconds of each episode, every one of them checked (default: {VERIFY['duration']:,})",
    )
    parser.add_argument(
        "--seed", type=seed_number, metavar="N", help=f"of everything random (default: {VERIFY['seed']})"
    )
    parser.add_argument(
        "--json", metavar="F", help="write the report there, and continue the one it holds (default: none)"
    )
    parser.add_argument(
        "--replay",
        metavar="F.npz",
        help="fly the counter-example in a file instead, which holds all settings (default: none)",
    )


def add_benchmark(commands: Commands) -> None:
    """main.py benchmark"""
    parser = commands.add_parser(
        "benchmark", allow_abbrev=False, help="measure the speed of simulator, filter, solvers and learner"
    )
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), help=f"where tensors live (default: {TRAIN.device})"
    )
    parser.add_argument(
        "--compile",
        choices=("on", "off"),
        default="on",
        help="torch.compile filter, simulator and learner (default: on)",
    )
    parser.add_argument(
        "--batches",
        type=batch_list,
        metavar="N,N,...",
        help="episodes, spacecraft and samples at once (default: 256 to 65,536 in powers of 4)",
    )
    parser.add_argument("--json", metavar="F", help="also write the results there (default: none)")
    parser.add_argument(
        "--figure", metavar="F.png", help="also draw rates over batches there (default: none)"
    )
    parser.set_defaults(config=None)


def add_export(commands: Commands) -> None:
    """main.py export"""
    parser = commands.add_parser(
        "export", allow_abbrev=False, help="write an agent as an ONNX file, checked against PyTorch"
    )
    parser.add_argument(
        "--checkpoint", required=True, metavar="F", help="the agent: policy.pt or checkpoint.pt of a run"
    )
    parser.add_argument("--out", required=True, metavar="F.onnx", help="file to write")


COMMANDS = {
    "train": add_train,
    "study": add_study,
    "report": add_report,
    "evaluate": add_evaluate,
    "simulate": add_simulate,
    "replay": add_replay,
    "filter": add_filter,
    "verify": add_verify,
    "benchmark": add_benchmark,
    "export": add_export,
}


def build_parser(description: str | None = None) -> Parser:
    """The whole command line."""
    parser = Parser(prog="main.py", description=description, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar=" | ".join(COMMANDS))
    for add in COMMANDS.values():
        add(commands)
    return parser
