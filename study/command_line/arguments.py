"""The command line: every command's flags, each with the setting or parameter that it reaches."""

import argparse
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from inspection.model.parameters import AXES
from inspection.world.plant import SIMULATORS
from kernels.build import VARIABLE
from rta.parameters import QP_SOLVERS
from study import config as configuration
from study.command_line.flags import (
    Command,
    Flag,
    Parser,
    arm_list,
    batch_list,
    constraint_list,
    count,
    directory,
    number,
    period,
    read,
    seed,
    verified_policy,
    written,
)
from study.command_line.paths import FIGURE, check_inputs, check_outputs
from study.commands import in_file
from study.config import BASELINES, LEARN_FROM, AnyConfig, StudyConfig
from study.errors import InputError

# What flags can set, and its value where nothing does: --config, and each key as "table.key".
SETTINGS = {"config": ()} | {
    f"{table}.{key}": value
    for table, part in vars(StudyConfig()).items()
    for key, value in vars(part).items()
}
OF_THE_PROCESS = {"threads": None, "cache_dir": None}  # what a flag can set that is no part of an experiment
Handler = Callable[..., None]  # of a command; its parameters are `configure` and the flags that set nothing


# of several commands
DEVICE = Flag("--device", "where tensors live", "train.device", choices=("auto", "cpu", "cuda"))
CONFIG = read(
    "--config",
    "TOML file with settings, under the flags; of several, each over the one before",
    metavar="FILE",
    action="append",
)
PERIOD = Flag(
    "--rta-period",
    "seconds between two calls of the filter: 1, 5 or 10",
    "rta.period",
    type=period,
    metavar="S",
)
PANELS = Flag(
    "--solar-panel-axis",
    "body axis that the solar panels face",
    "inspection.solar_panel_axis",
    choices=tuple(AXES),
)
CACHE = Flag(
    "--cache-dir",
    f"directory that keeps what is compiled (default: ${VARIABLE}, or rta-inspection in the user's cache directory)",
    metavar="DIR",
)
OF_THE_FILTER = ("--config", "--rta-period", "--solar-panel-axis", "--float")
COMMON = (
    CONFIG,
    PERIOD,
    PANELS,
    Flag(
        "--compile",
        "compile filter and simulator with the C compiler; auto: for runs long enough to repay it",
        "train.compile",
        choices=("auto", "on", "off"),
    ),
    CACHE,
    DEVICE,
    Flag(
        "--qp-solver",
        "solver of the filter's quadratic programs (default: {}; the faster one for the device and the spacecraft at "
        "once)",
        "rta.qp_solver",
        choices=QP_SOLVERS,
    ),
)
THREADS = count(
    "--threads",
    "processor threads (default: what a short measurement finds fastest, or OMP_NUM_THREADS; a run or a study that is "
    "continued keeps its own)",
)
RTA = Flag(
    "--rta",
    "filter every control by run time assurance",
    "train.rta",
    action=argparse.BooleanOptionalAction,
)
FLOWN_RTA = RTA.saying(f"{RTA.text} (default: {{}}; with --checkpoint as it was trained)")
INTERACTIONS = count(
    "--interactions", "agent steps of 10 s in all, rounded up to whole updates", "train.interactions"
)
PLANT = Flag(
    "--plant", "simulator of the motion; basilisk must be installed", "plant.simulator", choices=SIMULATORS
)
NUM_ENVS = count("--num-envs", "episodes simulated at once", "train.num_envs")
LEARN = Flag(
    "--learn-from",
    "behind the filter: the action that the agent desired, what the filter applied in its place, or the former with a "
    "price on corrections",
    "train.learn_from",
    choices=LEARN_FROM,
)
AGENT = read("--checkpoint", "the agent: policy.pt or checkpoint.pt of a run")


COMMANDS = {
    "train": Command(
        "train an agent with or without run time assurance",
        RTA,
        *COMMON,
        THREADS,
        INTERACTIONS,
        NUM_ENVS,
        count("--rollout-steps", "interactions of each episode between two updates", "train.rollout_steps"),
        count("--evaluation-interval", "interactions between two evaluations", "train.evaluation_interval"),
        count("--evaluation-episodes", "episodes of each periodic evaluation", "train.evaluation_episodes"),
        count("--final-episodes", "episodes of the evaluation after training", "train.final_episodes"),
        count("--epochs", "passes over each batch of experience", "ppo.epochs"),
        count("--minibatch-size", "interactions per gradient step", "ppo.minibatch_size"),
        number("--learning-rate", "of Adam, annealed to 0", "ppo.learning_rate", metavar="X"),
        LEARN,
        Flag(
            "--adversary",
            "constraints whose smallest h the agent is trained to lower, instead of the task",
            "train.adversary",
            type=constraint_list,
            metavar="C,C",
        ),
        seed("of everything random", "train.seed"),
        directory("--run-dir", "directory to create (default: runs/<arm>__<seed>__<time>)"),
        read(
            "--init-from",
            "start from the agent in F, policy.pt or checkpoint.pt of a run, which gives its value network, too",
        ),
        directory(
            "--resume",
            "continue the run in D exactly where it stopped; with --interactions N go on to N",
            alone="the run",
            beside=("--interactions",),
        ),
    ),
    "study": Command(
        "train many seeds of both arms and evaluate them; the same command continues an interrupted study",
        *COMMON,
        THREADS,
        count("--seeds", "agents of each arm, trained as one batch", "study.seeds"),
        Flag(
            "--arms",
            "no_rta, rta and those in --config's [arms], in this order",
            "study.arms",
            type=arm_list,
            metavar="A,A",
        ),
        INTERACTIONS.saying("agent steps of 10 s of each seed in each arm, rounded up to whole updates"),
        NUM_ENVS.saying("episodes of each seed simulated at once"),
        directory("--study-dir", "directory to create, or of the study to continue"),
    ),
    "report": Command(
        "write a finished study's results as one page, with its figures and the data behind them",
        directory("--study", "directory of a finished study"),
        Flag("--device", "where tensors live (default: as in the study)", **DEVICE.options),
        THREADS,
    ),
    "evaluate": Command(
        "report an agent or a controller in the metrics of the paper's Tables 2 and 3",
        FLOWN_RTA,
        *COMMON,
        PLANT,
        THREADS,
        count("--episodes", "test cases"),
        seed("of the test cases, of random controls and of an untrained agent"),
        written("evaluation", "--json", "also write the results there"),
        one_of=(
            AGENT,
            Flag(
                "--controller",
                "instead of an agent: untrained (as training begins), random or zero controls, which decide every "
                "10 s as an agent does, or natural-motion, a classical guidance that decides at every call of the "
                "filter, without it every second",
                choices=BASELINES,
            ),
        ),
    ),
    "simulate": Command(
        "simulate one spacecraft and write everything over time",
        FLOWN_RTA,
        *COMMON,
        PLANT,
        THREADS,
        Flag(
            "--controller",
            "who commands the spacecraft",
            choices=("policy", "recorded", "lqr-pd", *BASELINES),
        ),
        AGENT.saying("the agent, for --controller policy"),
        read(
            "--actions",
            "N x 6 controls in N and N m, a row per --step, for --controller recorded",
            metavar="F.npy",
        ),
        read("--initial-state", "state file (default: drawn from --seed)", metavar="F.json"),
        seed("of what is drawn"),
        number("--duration", "seconds", metavar="S"),
        number(
            "--step",
            "seconds between two rows of the output, two decisions of a classical controller and two rows of "
            "--actions; an agent, trained or not, decides every 10 s",
            metavar="S",
        ),
        written("run of simulate", "--out", "file to write", "F.npz"),
        written(FIGURE, "--figure", "also draw limits and controls over time there", "F.png"),
    ),
    "replay": Command(
        "write a page that plays one or two simulated runs in 3-D",
        read("runs", "a file of simulate, or two, side by side (required)", nargs="+", metavar="RUN.npz"),
        written("replay", "--out", "page to write", "F.html"),
    ),
    "filter": Command(
        "filter a batch of states from elsewhere and write out the quadratic programs",
        *COMMON,
        THREADS,
        read(
            "--states",
            "file with state (N x 16, the order of inspection/model/state.py) and control_desired (N x 6, N and N m)",
            metavar="F.npz",
        ),
        written("result of filter", "--out", "file to write", "G.npz"),
        imposed={"train.rta": True},
    ),
    "verify": Command(
        "count violations behind the filter over many random episodes",
        *COMMON,
        PLANT,
        THREADS,
        count(
            "--episodes",
            "in all, from starts that the filter can hold; the others met on the way are reported beside them",
        ),
        Flag(
            "--policy",
            "random actions held for random times, adversarial (down the worst constraint's slope), lookahead (the "
            "worst of many candidates, each tried in the true plant), learned:F (drawn from an agent of train "
            "--adversary) or checkpoint:F (any agent)",
            type=verified_policy,
            reads=True,
            metavar="P",
        ),
        count("--candidates", "of lookahead, per spacecraft and call of the filter (default: 24)"),
        count("--horizon", "of lookahead, calls of the filter that each candidate is tried for (default: 3)"),
        count("--duration", "whole seconds of each episode", metavar="S"),
        number("--check-every", "seconds between two checks of all constraints", metavar="S"),
        count(
            "--boundary",
            "instead of episodes, N single calls of the filter at states next to its limits, in whole batches",
            without=("--episodes", "--policy", "--duration", "--filter"),
        ),
        Flag(
            "--break-points",
            "instead of one world, one effect of [plant] at a time, up to where a limit breaks, with and without "
            "[uncertainty]; draw the table there",
            writes=FIGURE,
            metavar="F.png",
            without=("--check-every", "--keep-worst", "--candidates", "--horizon", "--boundary", "--filter"),
        ),
        Flag(
            "--filter",
            "what filters: python, or as `export --filter` writes it, c, or c-float in single precision",
            choices=("python", "c", "c-float"),
        ),
        seed("of everything random"),
        written("report of verify", "--json", "write the report there, and continue the one it holds"),
        Flag(
            "--keep-worst",
            "keep the worst episode of every constraint beside --json, not only of those violated",
            action=argparse.BooleanOptionalAction,
        ),
        read(
            "--replay",
            "fly the counter-example in a file instead, which holds all settings",
            alone="the file",
            metavar="F.npz",
        ),
        imposed={"train.rta": True},
    ),
    "benchmark": Command(
        "measure the speed of simulator, filter, solvers and learner",
        CONFIG,
        DEVICE,
        THREADS,
        Flag(
            "--compile",
            "compile filter and simulator with the C compiler",
            "train.compile",
            choices=("on", "off"),
        ),
        CACHE,
        Flag(
            "--batches",
            "episodes, spacecraft and samples at once (default: 256 to 65,536 in powers of 4)",
            type=batch_list,
            metavar="N,N,...",
        ),
        written("benchmark", "--json", "also write the results there"),
        written(FIGURE, "--figure", "also draw rates over batches there", "F.png"),
        imposed={"train.compile": "on"},
    ),
    "export": Command(
        "write an agent as an ONNX file, checked against PyTorch, or as C with a test that does so; or the filter as C",
        AGENT.saying("the agent to export"),
        CONFIG.saying("TOML file with the filter's settings; of several, each over the one before"),
        PERIOD,
        PANELS,
        Flag("--float", "the filter in single precision", action=argparse.BooleanOptionalAction),
        one_of=(
            written("exported agent", "--out", "ONNX file to write", "F.onnx", without=OF_THE_FILTER),
            directory(
                "--c",
                "directory to create for C99 sources, or that holds those of an agent",
                without=OF_THE_FILTER,
            ),
            directory(
                "--filter",
                "directory to create for the filter's C99 sources, or that holds those of a filter",
                without=("--checkpoint",),
            ),
        ),
    ),
}


def build_parser(handlers: Mapping[str, Handler], description: str | None = None) -> Parser:
    """The whole command line, for the commands' functions; raises ValueError if a flag reaches nothing."""
    parser = Parser(prog="main.py", description=description, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar=" | ".join(COMMANDS))
    for name, command in COMMANDS.items():
        add_flags(commands.add_parser(name, allow_abbrev=False, help=command.about), command, handlers[name])
    return parser


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
        return getattr(self.arguments, "config", [])

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
    """Refuses files that the command would write in the place of what it reads, see `check_outputs`."""
    given = [
        (each, vars(arguments)[each.dest])
        for each in COMMANDS[arguments.command].flags
        if vars(arguments).get(each.dest) is not None
    ]
    inputs = {}
    for each, value in given:
        paths = value if isinstance(value, list) else [value]
        if each.reads:
            inputs |= {f"{each.name} {path}": in_file(path) for path in paths}
    check_inputs(inputs)
    check_outputs({each.name: (value, each.writes) for each, value in given if each.writes}, inputs)


def resolve(arguments: argparse.Namespace, base: AnyConfig) -> AnyConfig:
    """The base configuration under each --config under the flags."""
    values = {name: value for name, value in vars(arguments).items() if name in SETTINGS}
    for file in values.pop("config", []):
        base = configuration.load(file, base)
    tables: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        table, key = name.split(".")
        tables.setdefault(table, {})[key] = value
    return configuration.override(base, tables, "command line")
