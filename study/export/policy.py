"""An agent as C99: what it observes, its network, and a test that compares it with PyTorch.

`policy.c` and `policy.h` are written by hand; this module adds the tables and the printed observation. The C computes
in double precision with the checkpoint's single-precision weights. The test compares it with PyTorch in double
precision, because PyTorch's own rounding in single precision is nearly the tolerance of the test. The page of `play`
flies the same C.
"""

import hashlib
import math
import shlex
import textwrap
from collections.abc import Iterable, Sequence
from copy import deepcopy
from pathlib import Path

import torch
from torch import Tensor

from inspection.chief.points import LLOYD_ITERATIONS, cluster, nearest_cluster
from inspection.model.attitude import unit
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from inspection.observation import components, observe, scales
from inspection.sight import Sight
from kernels.exported import REFUSES_FAST_MATH, check_directory, check_prefix, prefixed
from kernels.printer import Printed, printed
from ppo.network import Policy
from rta.fast.files import CONTROL, STATE
from rta.fast.source import define, for_one, table
from study.config import Config
from study.errors import as_input_error
from study.experiment import check_chief
from study.files import write_text

NAME = "policy"  # files, functions, types and macros begin with it
BUILT = "test_policy"  # the program that the Makefile builds
MARK = "Written by main.py export --c"  # on the first line of each file
VECTORS = 100  # states in the test
WIDTH = 110  # of a line of a table


def write(policy: Policy, config: Config, checkpoint: str, directory: Path, prefix: str = NAME) -> str:
    """Writes the agent of a checkpoint into a directory, which may hold an older one; returns a message about it.

    Args:
        prefix: of all files, functions, types and macros, so that several agents fit into one program.

    Raises:
        InputError: the chief's mesh cannot be read, or the directory holds other files or cannot be written.
    """
    check_chief(config)
    own = sources(policy, config, hashlib.sha256(Path(checkpoint).read_bytes()).hexdigest())
    own |= {
        "test_policy.c": by_hand("test_policy.c", vectors(policy, config)),
        "Makefile": by_hand("policy.mk"),
    }
    with as_input_error("--prefix", ValueError):
        check_prefix(prefix)
        texts = {prefixed(name, NAME, prefix): prefixed(text, NAME, prefix) for name, text in own.items()}
    built = prefixed(BUILT, NAME, prefix)
    with as_input_error(f"--c {directory}: cannot write there", OSError, ValueError):
        check_directory(directory, "agent", MARK, texts, (*(f"{name}.tmp" for name in texts), built))
        directory.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(directory / name, text)
    test = shlex.join(["make", "-C", str(directory), "test"])
    weights = len(numbers(policy))
    return f"{directory}: {', '.join(texts)}; {weights:,} weights and {VECTORS} of PyTorch's controls\nNext:\n  {test}"


def by_hand(name: str, printed_part: str = "") -> str:
    """Returns a file of this folder with MARK on its first line and the printed part in its place."""
    text = (Path(__file__).parent / name).read_text(encoding="utf-8")
    mark = f"# {MARK}." if name.endswith(".mk") else f"/* {MARK}. */"
    return f"{mark}\n{text.replace('/* PRINTED */', printed_part)}"


def sources(policy: Policy, config: Config, digest: str) -> dict[str, str]:
    """Returns policy.h and policy.c; `digest` is the checkpoint's SHA-256."""
    c, sight = config.inspection, Sight(config.chief, config.inspection, 1, torch.device("cpu"))
    observed = components(c)
    limits = [
        f"{CONTROL[name]}, at most {most!r}" for name, most in zip(CONTROL, c.control_limit, strict=True)
    ]
    sizes = [*(layer.weight.shape[1] for layer in policy.network.layers), CONTROL_SIZE]
    constants = [
        define("POLICY_CHECKPOINT", f'"{digest}"', "SHA-256"),
        define("POLICY_PERIOD", float(c.action_period), "s between two decisions"),
        define("POLICY_OBSERVATIONS", f"{len(observed)}U"),
        define("POLICY_CONTROLS", f"{CONTROL_SIZE}U"),
        define("POLICY_POINTS", f"{sight.points.shape[1]}U", "of the chief"),
        define("POLICY_CLUSTERS", f"{sight.centres.shape[1]}U", "of points, at most"),
        define("POLICY_OBSERVES_CHIEF", int("chief" in c.observed)),
        "",
        enumeration("state", STATE, STATE.values()),
        enumeration("observation", [each.name for each in observed], [each.unit for each in observed]),
        enumeration("command", CONTROL, limits),
    ]
    tables = [
        REFUSES_FAST_MATH.format(name="policy.c"),
        define("PER_CLUSTER", f"{c.points_per_cluster}U", "points at most"),
        define("ITERATIONS", f"{LLOYD_ITERATIONS}U", "of k-means"),
        define("LAYERS", f"{len(sizes) - 1}U"),
        define("WIDEST", f"{max(sizes)}U"),
        define("TANH_OUTPUTS", int(policy.tanh_outputs), "of the last layer, too"),
        define("POWER", float(policy.power)),
        table("size_t SIZE[LAYERS + 1U]", sizes, "from the observation to the control"),
        wrapped("double SCALE[POLICY_OBSERVATIONS]", [each.scale for each in observed]),
        wrapped("double LIMIT[POLICY_CONTROLS]", [float(limit) for limit in c.control_limit]),
        "/* of each layer, of each of its outputs: the bias, then a weight for each input */",
        wrapped("float WEIGHT[]", [f"{number:.8e}F" for number in numbers(policy)]),
        rows("double policy_points[POLICY_POINTS][3]", sight.points).removeprefix("static "),
        "",
        for_one([observation(c)]),
    ]
    return {
        "policy.h": by_hand("policy.h", "\n".join(constants)),
        "policy.c": by_hand("policy.c", "\n".join(tables)),
    }


def enumeration(kind: str, names: Iterable[str], meanings: Iterable[str]) -> str:
    """Returns a C enumeration whose members have comments."""
    members = [
        f"    POLICY_{kind.upper()}_{name.upper()} /* {meaning} */"
        for name, meaning in zip(names, meanings, strict=True)
    ]
    return "\n".join([f"enum policy_{kind} {{", ",\n".join(members), "};", ""])


def numbers(policy: Policy) -> list[float]:
    """Returns biases and weights in the order of WEIGHT, without the last layer's columns for the log-std."""
    found: list[float] = []
    for layer in policy.network.layers:
        columns = slice(CONTROL_SIZE if layer is policy.network.layers[-1] else None)
        found += torch.cat((layer.bias[0, :, columns], layer.weight[0, :, columns])).T.flatten().tolist()
    return found


def observation(c: InspectionParameters) -> Printed:
    """Prints the observation as C, in physical units."""
    x = torch.ones(SIZE, 1, dtype=torch.float64)
    chief = {"chief": x[:7]} if "chief" in c.observed else {}
    given = {"x": x, "priority": x[:3], "uninspected": x[:3], "score": x[0], **chief}

    def run(x: Tensor, priority: Tensor, uninspected: Tensor, score: Tensor, *chief: Tensor) -> list[Tensor]:
        return [observe(x, priority, uninspected, score, c, *chief)]

    return printed(run, *given.values(), name="observe", names=(list(given), ["o"]))


def vectors(policy: Policy, config: Config) -> str:
    """Returns tables of states and of PyTorch's controls, in the units of policy.h."""
    c, generator = config.inspection, torch.Generator().manual_seed(0)

    def normal(scale: float, size: int) -> Tensor:
        return scale * torch.randn(size, VECTORS, generator=generator, dtype=torch.float64)

    def even(size: int) -> Tensor:
        return torch.rand(size, VECTORS, generator=generator, dtype=torch.float64)

    x = torch.zeros(SIZE, VECTORS, dtype=torch.float64)
    x[P], x[V], x[Q], x[OMEGA] = normal(100.0, 3), normal(0.5, 3), unit(normal(1.0, 4)), normal(0.02, 3)
    x[T], x[E], x[THETA_S] = normal(10.0, 1)[0], 10.0 * even(1)[0], 2.0 * math.pi * even(1)[0]
    priority, score = unit(normal(1.0, 3)), even(1)
    chief = torch.cat((unit(normal(1.0, 4)), normal(0.01, 3)))
    sight = Sight(config.chief, c, 1, torch.device("cpu"))
    points, centres, alive = sight.points.double(), sight.centres.double(), sight.alive
    wanted = even(points.shape[1]) < even(1)
    uninspected = torch.zeros_like(priority)
    for n in range(VECTORS):
        centres, alive = cluster(points, wanted[:, n : n + 1], centres, alive, c.points_per_cluster)
        uninspected[:, n] = nearest_cluster(centres, alive, x[P, n : n + 1])[:, 0]
    observed = observe(x, priority, uninspected, score[0], c, chief)
    exact = deepcopy(policy).double()
    action = exact.mean_action((observed / scales(observed, c)).T[None])[0]
    control = (action * action.new_tensor(c.control_limit)).T
    shown = [f'"{"".join(str(int(each)) for each in column)}"' for column in wanted.T]
    tables = {"STATES": x, "PRIORITIES": priority, "SCORES": score, "CHIEFS": chief, "EXPECTED": control}
    return "\n".join(
        [
            define("VECTORS", f"{VECTORS}U"),
            wrapped("double MOST[POLICY_CONTROLS]", [float(limit) for limit in c.control_limit]),
            wrapped("char *const WANTED[VECTORS]", shown),
            *(rows(f"double {name}[VECTORS][{len(values)}]", values) for name, values in tables.items()),
        ]
    )


def wrapped(declaration: str, values: Sequence[object]) -> str:
    """Returns a one-dimensional table in lines of WIDTH."""
    text = textwrap.fill(", ".join(map(str, values)), WIDTH, break_long_words=False, break_on_hyphens=False)
    return f"static const {declaration} = {{\n{textwrap.indent(text, '    ')}\n}};"


def rows(declaration: str, values: Tensor) -> str:
    """Returns a table (columns, rows) with a line for each of its rows."""
    return table(declaration, values.T.tolist()).replace("{{", "{\n    {").replace("}, {", "},\n    {")
