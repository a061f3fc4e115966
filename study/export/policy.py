"""An agent as C99: the network in loops, its tables, and a test that replays what PyTorch answers.

The sources stand in `policy*.j2`. The C computes in double precision with the checkpoint's weights, which are in
single, and is held against PyTorch in double: in single PyTorch itself strays by nearly TOLERANCE.
"""

import hashlib
import shlex
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from pathlib import Path

import torch
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, CONTROLS
from inspection.observation import GROUPS, components, scales
from kernels.exported import REFUSES_FAST_MATH, check_directory, check_prefix, prefixed
from ppo.network import Policy
from study.config import Config
from study.errors import refusing
from study.files import write_text

TEMPLATES = {  # by file
    "policy.h": "policy.h.j2",
    "policy.c": "policy.c.j2",
    "policy_vectors.h": "policy_vectors.h.j2",
    "test_policy.c": "policy_test.c.j2",
    "Makefile": "policy.mk.j2",
}
NAME = "policy"  # that files, functions, types and macros begin with
BUILT = "test_policy"  # by the Makefile
MARK = "Written by main.py export --c"  # on the first line of each
VECTORS = 100  # of the test
TOLERANCE = 1e-6  # of it, in units of the actuators' limits
WIDTH = 110  # of a line of a table
FLAGS = "-std=c99 -O2 -Wall -Wextra -Wpedantic -Wconversion -Werror"

# of each group, what is to be observed
MEANINGS = {
    "position": "distance of the deputy from the chief's centre; its direction from there",
    "velocity": "speed in Hill's frame; direction of motion there",
    "angular_velocity": "rates of the body, relative to {frame}",
    "energy": "in the battery",
    "temperature": "of the surface whose limit is kept",
    "sun": "direction of the Sun; its cosine with the deputy's direction",
    "priority": "direction around which the chief's points weigh most; its cosine with the deputy's direction",
    "uninspected": "direction of the nearest cluster of lit points left, 0 if none; its cosine with the deputy's",
    "score": "weight of the points inspected so far, of 1",
    "hill": "x axis of Hill's frame, away from the Earth; its y axis, along the orbit",
    "free_flight": "directions of the closest passes of coasting for {near:g} s and {far:g} s, {radius:g} m / distance "
    "long, at most 2",
    "chief": "the chief's own x axis; its y axis; its rate, relative to {frame}",
}


def write(policy: Policy, config: Config, checkpoint: str, directory: Path, prefix: str = NAME) -> str:
    """Writes the agent of a checkpoint into a directory, which may hold an older one; returns what to say of it.

    Args:
        prefix: of all files, functions, types and macros, so that several agents fit into one program.

    Raises:
        InputError: the directory holds anything else, or cannot be written.
    """
    own = sources(policy, config.inspection, hashlib.sha256(Path(checkpoint).read_bytes()).hexdigest())
    with refusing("--prefix", ValueError):
        check_prefix(prefix)
        texts = {prefixed(name, NAME, prefix): prefixed(text, NAME, prefix) for name, text in own.items()}
    built = prefixed(BUILT, NAME, prefix)
    with refusing(f"--c {directory}: cannot write there", OSError, ValueError):
        check_directory(directory, "agent", MARK, texts, (*(f"{name}.tmp" for name in texts), built))
        directory.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(directory / name, text)
    weights = sum(each.numel() for layer in layers(policy) for each in layer)
    test = shlex.join(["make", "-C", str(directory), "test"])
    return f"{directory}: {', '.join(texts)}; {weights:,} weights and {VECTORS} of PyTorch's controls\nNext:\n  {test}"


def sources(policy: Policy, c: InspectionParameters, digest: str) -> dict[str, str]:
    """The text of each file; `digest` is of the checkpoint."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"rows": rows, "single": single, "wrapped": wrapped}
    observation, control = vectors(policy, c)
    values = {
        "mark": MARK,
        "digest": digest,
        "period": float(c.action_period),
        "groups": [
            (meaning(name, c), [(each.name.upper(), each.unit) for each in group])
            for name, group in GROUPS.items()
            if name in c.observed
        ],
        "controls": [(name.upper(), "N" if name.startswith("thrust") else "N m") for name in CONTROLS],
        "scales": [each.scale for each in components(c.observed)],
        "limits": [float(limit) for limit in c.control_limit],
        "layers": [tuple(each.tolist() for each in layer) for layer in layers(policy)],
        "linear": policy.is_linear,
        "power": float(policy.power),
        "dead_zone": float(policy.dead_zone),
        "observation": observation.tolist(),
        "control": control.tolist(),
        "tolerance": TOLERANCE,
        "flags": FLAGS,
        "refuses_fast_math": REFUSES_FAST_MATH.format(name="policy.c"),
        "built": BUILT,
    }
    return {name: environment.get_template(template).render(values) for name, template in TEMPLATES.items()}


def meaning(group: str, c: InspectionParameters) -> str:
    """What a group holds, in words."""
    return MEANINGS[group].format(
        frame="the stars" if c.hill_rotation else "Hill's frame",
        near=c.passive_safety_horizon,
        far=c.free_flight_horizon,
        radius=c.collision_radius,
    )


def layers(policy: Policy) -> Iterator[tuple[Tensor, Tensor]]:
    """Weight (outputs, inputs) and bias (outputs,) of each layer; of the last one without the log-std's."""
    found = list(policy.network.layers)
    for layer in found:
        columns = slice(CONTROL_SIZE if layer is found[-1] else None)
        yield layer.weight[0, :, columns].detach().T, layer.bias[0, 0, columns].detach()


def vectors(policy: Policy, c: InspectionParameters) -> tuple[Tensor, Tensor]:
    """Observations (VECTORS, as many as observed) and what PyTorch answers (VECTORS, 6), in physical units.

    Divided by their scales they are of unit variance, but for a first one of zeros and ten that saturate the network.
    """
    exact = deepcopy(policy).double()
    scale = scales(torch.zeros(1).double(), c.observed)[:, 0]
    drawn = torch.randn(VECTORS, len(scale), generator=torch.Generator().manual_seed(0)).double()
    drawn[0] = 0.0
    drawn[-10:] *= 1e3
    observation = drawn * scale
    control = exact.mean_action((observation / scale)[None])[0] * scale.new_tensor(c.control_limit)
    return observation, control


def single(values: Iterable[float]) -> list[str]:
    """Numbers of single precision as exact literals."""
    return [f"{value:.8e}F" for value in values]


def wrapped(words: Sequence[object], indent: int) -> str:
    """Words or numbers with commas between, in lines of WIDTH."""
    lines, start = [""], " " * indent
    for word in map(str, words):
        if len(start) + len(lines[-1]) + len(word) + 2 > WIDTH:
            lines.append("")
        lines[-1] += f"{' ' if lines[-1] else ''}{word},"
    return "\n".join(start + line for line in lines).removesuffix(",")


def rows(table: Sequence[Sequence[object]]) -> str:
    """The rows of a table as initialisers."""
    return ",\n".join(f"    {{\n{wrapped(row, 8)}\n    }}" for row in table)
