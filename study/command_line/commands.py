"""Every command's flags, each with the setting or the parameter that it reaches.

What a flag that sets something says in --help is what its setting says of itself, unless it has a text of its own here.
"""

import argparse

from inspection.orbits import GUIDANCE
from kernels.build import VARIABLE
from study.command_line.flags import (
    Command,
    Flag,
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
from study.config import EVALUATED

# of several commands
DEVICE = Flag("--device", sets="train.device")
CONFIG = read(
    "--config",
    "TOML file with settings, or the name of a shipped one (12u, plants/u1), under the flags; of several, each over "
    "the one before",
    metavar="FILE",
    action="append",
)
PERIOD = Flag("--rta-period", sets="rta.period", type=period, metavar="S")
PANELS = Flag(
    "--solar-panel-axis",
    "body axis that the solar panels face",
    "inspection.solar_panel_axis",
)
CACHE = Flag(
    "--cache-dir",
    f"directory that keeps what is compiled (default: ${VARIABLE}, or rta-inspection in the user's cache directory)",
    metavar="DIR",
)
OF_THE_FILTER = ("--config", "--rta-period", "--solar-panel-axis")
COMMON = (
    CONFIG,
    PERIOD,
    PANELS,
    Flag("--compile", sets="train.compile"),
    CACHE,
    DEVICE,
    Flag("--qp-solver", sets="rta.qp_solver"),
)
THREADS = count(
    "--threads",
    "processor threads (default: OMP_NUM_THREADS, else 1 for PyTorch, whose last digits depend on it, and all for "
    "compiled functions; a run or a study that is continued keeps its own)",
)
RTA = Flag("--rta", sets="train.rta", action=argparse.BooleanOptionalAction)
KEEP_CLEAR = Flag("--keep-clear", sets="train.keep_clear", action=argparse.BooleanOptionalAction)
AS_TRAINED = "{} (default: {{}}; with --checkpoint as it was trained)"
FLOWN = [each.saying(AS_TRAINED.format(each.text)) for each in (RTA, KEEP_CLEAR)]
FILTERED = {"train.rta": True, "train.keep_clear": False}  # of what tries the filter itself
INTERACTIONS = count("--interactions", sets="train.interactions")
PLANT = Flag("--plant", sets="plant.simulator")
ERRORS = Flag("--errors", sets="plant.errors")
NUM_ENVS = count("--num-envs", sets="train.num_envs")
LEARN = Flag("--learn-from", sets="train.learn_from")
DURATION = count("--duration", "whole seconds of each episode", metavar="S")
EVERYTHING = seed("of everything random")
REPORT = written(".json", "--json", "write the report there, and continue the one it holds")
AGENT = read("--checkpoint", "the agent: policy.pt or checkpoint.pt of a run")


COMMANDS = {
    "train": Command(
        "train an agent with or without run time assurance",
        RTA,
        KEEP_CLEAR,
        *COMMON,
        THREADS,
        INTERACTIONS,
        NUM_ENVS,
        count("--rollout-steps", sets="train.rollout_steps"),
        count("--evaluation-interval", sets="train.evaluation_interval"),
        count("--evaluation-episodes", sets="train.evaluation_episodes"),
        count("--final-episodes", sets="train.final_episodes"),
        count("--epochs", sets="ppo.epochs"),
        count("--minibatch-size", sets="ppo.minibatch_size"),
        number("--learning-rate", sets="ppo.learning_rate", metavar="X"),
        LEARN,
        Flag("--adversary", sets="train.adversary", type=constraint_list, metavar="C,C"),
        seed(sets="train.seed"),
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
        "train many seeds of each arm and evaluate them; the same command continues an interrupted study",
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
        INTERACTIONS.saying("agent steps of each seed in each arm, rounded up to whole updates"),
        NUM_ENVS,
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
        *FLOWN,
        *COMMON,
        PLANT,
        ERRORS,
        THREADS,
        count("--episodes", "test cases"),
        seed("of the test cases, of random controls and of an untrained agent"),
        written(".json", "--json", "also write the results there", key="metrics"),
        one_of=(
            AGENT,
            Flag(
                "--controller",
                "instead of an agent: untrained (as training begins), random or zero controls, which decide every "
                "10 s as an agent does, or a classical guidance, which decides at every call of the filter, without "
                f"it every second: {', '.join(GUIDANCE)}",
                choices=EVALUATED,
            ),
        ),
    ),
    "simulate": Command(
        "simulate one spacecraft and write everything over time",
        *FLOWN,
        *COMMON,
        PLANT,
        ERRORS,
        THREADS,
        Flag(
            "--controller",
            "who commands the spacecraft",
            choices=("policy", "recorded", "lqr-pd", *EVALUATED),
        ),
        AGENT.saying("the agent, for --controller policy"),
        read(
            "--actions",
            "N x 6 controls in N and N m, a row per --step, for --controller recorded; N x 25 with the corners of a "
            "flight that play saved, where [plant] errors are worst",
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
        written(".npz", "--out", "file to write", "F.npz"),
        written(".png", "--figure", "also draw limits and controls over time there", "F.png"),
    ),
    "replay": Command(
        "write a page that plays one or two simulated runs in 3-D",
        read("runs", "a file of simulate, or two, side by side (required)", nargs="+", metavar="RUN.npz"),
        written(".html", "--out", "page to write", "F.html"),
    ),
    "play": Command(
        "write a page on which anybody flies the spacecraft in a browser, with the filter on or off",
        AGENT.saying("an agent that can be let fly: policy.pt or checkpoint.pt of a run"),
        CONFIG,
        PANELS,
        written(".html", "--out", "page to write", "F.html"),
        imposed=FILTERED,
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
        written(".npz", "--out", "file to write", "G.npz"),
        imposed=FILTERED,
    ),
    "verify": Command(
        "count violations behind the filter over many random episodes",
        *COMMON,
        PLANT,
        ERRORS,
        THREADS,
        count(
            "--episodes",
            "in all, from starts that the filter can hold; the others met on the way are reported beside them",
        ),
        Flag(
            "--policy",
            "random actions held for random times, adversarial (down the worst constraint's slope), pressing (full "
            "control against one constraint of an episode), lookahead (the worst of many candidates, each tried in the "
            "true plant), learned:F (drawn from an agent of train "
            "--adversary) or checkpoint:F (any agent)",
            type=verified_policy,
            reads=True,
            metavar="P",
        ),
        count("--candidates", "of lookahead, per spacecraft and call of the filter (default: 24)"),
        count("--horizon", "of lookahead, calls of the filter that each candidate is tried for (default: 3)"),
        DURATION,
        number("--check-every", "seconds between two checks of all constraints", metavar="S"),
        Flag(
            "--filter",
            "what filters: python, or c, as `export --filter` writes it",
            choices=("python", "c"),
        ),
        EVERYTHING,
        REPORT,
        Flag(
            "--keep-worst",
            "keep the worst episode of every constraint beside --json, not only of those violated",
            action=argparse.BooleanOptionalAction,
        ),
        imposed=FILTERED,
    ),
    "boundary": Command(
        "try single calls of the filter at states next to its limits",
        *COMMON,
        PLANT,
        THREADS,
        count("--draws", "states next to one limit or two, in whole batches"),
        EVERYTHING,
        REPORT,
        imposed=FILTERED,
    ),
    "break-points": Command(
        "find the size at which each effect of [plant] breaks a limit, with and without [uncertainty], its errors at "
        "the corners of their bounds",
        *COMMON,
        THREADS,
        count(
            "--episodes", "of each effect and size, with errors that are steady and as many with the worst"
        ),
        Flag(
            "--policy", "who commands, see verify", choices=("random", "adversarial", "pressing", "lookahead")
        ),
        DURATION,
        EVERYTHING,
        REPORT,
        written(".png", "--figure", "also draw the table there", "F.png"),
        imposed=FILTERED,
    ),
    "refly": Command(
        "fly a counter-example of verify again",
        read("file", "what verify kept beside --json, with all settings (required)", metavar="F.npz"),
        THREADS,
        CACHE,
    ),
    "benchmark": Command(
        "measure the speed of simulator, filter, solvers and learner",
        CONFIG,
        DEVICE,
        THREADS,
        Flag("--compile", "compile what is measured", "train.compile", choices=("on", "off")),
        CACHE,
        Flag(
            "--batches",
            "episodes, spacecraft and samples at once (default: 256 to 65,536 in powers of 4)",
            type=batch_list,
            metavar="N,N,...",
        ),
        written(".json", "--json", "also write the results there", key="closed_loop_us"),
        written(".png", "--figure", "also draw rates over batches there", "F.png"),
        imposed={"train.compile": "on"},
    ),
    "export": Command(
        "write an agent as an ONNX file, checked against PyTorch, or as C with a test that does so; or the filter as C",
        AGENT.saying("the agent to export"),
        CONFIG.saying("TOML file with the filter's settings; of several, each over the one before"),
        PERIOD,
        PANELS,
        Flag(
            "--prefix",
            "what files, functions, types and macros of the C begin with, so that several fit into one program "
            "(default: policy, or safety_filter)",
            metavar="NAME",
        ),
        one_of=(
            written(".onnx", "--out", "ONNX file to write", "F.onnx", without=(*OF_THE_FILTER, "--prefix")),
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
