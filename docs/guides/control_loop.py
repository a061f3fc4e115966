"""An exported agent and the filter in the control loop of one spacecraft, and how long their calls take.

    python main.py export --checkpoint runs/reference/from_nothing/rta/seed0/policy.pt --out runs/policy.onnx
    python -m docs.guides.control_loop runs/policy.onnx --compile

Without --compile 1,000 calls take about a minute.
Every 10 s the agent observes and decides, every second the filter corrects, in between the spacecraft flies. The agent
runs in ONNX Runtime, the filter in PyTorch, both on one thread.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from inspection.chief.hull import with_hull
from inspection.environment import InspectionEnv
from inspection.model.parameters import ChiefParameters, InspectionParameters
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from settings import Parser, positive_integer

TABLES = (("inspection", InspectionParameters), ("chief", ChiefParameters))
Constants = TypeVar("Constants", InspectionParameters, ChiefParameters)


def load(path: str) -> onnxruntime.InferenceSession:
    """An ONNX file as a single-threaded session; raises ValueError if it holds no agent, else ONNX Runtime's errors."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    if not {"inspection", "chief"} <= session.get_modelmeta().custom_metadata_map.keys():
        raise ValueError("not an agent that main.py export wrote, or that an older version did")
    return session


def control_loop(
    session: onnxruntime.InferenceSession, safety_filter: SafetyFilter, seconds: int
) -> tuple[dict[str, list[float]], int]:
    """Flies from a random start; returns the s that each call took, and after how many seconds any h was below 0."""
    spent: dict[str, list[float]] = {"policy": [], "filter": []}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns the function, whose calls are timed."""

        def run(*args: Any, **kwargs: Any) -> Any:
            started = perf_counter()
            result = function(*args, **kwargs)
            spent[name].append(perf_counter() - started)
            return result

        return run

    about = session.get_modelmeta().custom_metadata_map
    scale = torch.tensor([[component["scale"]] for component in json.loads(about["control"])]).double()
    decide = timed("policy", session.run)
    safety = replace(safety_filter.safety(), correct=timed("filter", safety_filter.correct))
    env = InspectionEnv(
        1,
        safety_filter.c,
        [torch.Generator().manual_seed(0)],
        safety,
        decide_every=json.loads(about["action_period"]),
        report_every=1.0,
        target=constants(session, "chief", ChiefParameters),
    )
    env.reset()

    def agent(t: float, x: Tensor) -> Tensor:
        """The control that follows from what the camera sees of the chief."""
        (action,) = decide(None, {"observation": env.observation(x).numpy()})
        return torch.from_numpy(action.T) * scale

    violated = [safety_filter.values(hold.after) < 0.0 for hold in env.fly(agent, seconds)]
    return spent, sum(bool(each.any()) for each in violated)


def constants(session: onnxruntime.InferenceSession, name: str, kind: type[Constants]) -> Constants:
    """Those that the agent was trained with, on which its observations depend, too."""
    table = json.loads(session.get_modelmeta().custom_metadata_map[name])
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m docs.guides.control_loop")
    parser.add_argument("policy", help="ONNX file")
    parser.add_argument("--seconds", type=positive_integer, default=1000, help="to fly (default: 1000)")
    parser.add_argument(
        "--compile", action="store_true", help="compile the filter, which takes some seconds the first time"
    )
    arguments = parser.parse_args(argv)
    try:
        session = load(arguments.policy)
    except Exception as error:  # ONNX Runtime's have nothing else in common
        parser.error(f"{arguments.policy}: {str(error).splitlines()[0]}")
    torch.set_num_threads(1)
    task = with_hull(*(constants(session, *each) for each in TABLES))
    safety_filter = SafetyFilter(task, RtaParameters())
    if arguments.compile:
        safety_filter = fast(safety_filter)
    control_loop(session, safety_filter, 2)  # the first calls take longer
    latency, violated = control_loop(session, safety_filter, arguments.seconds)
    for name, calls in latency.items():
        median, slow = 1e3 * np.percentile(calls, (50, 99))
        print(f"{name}: median {median:.3f} ms, 99th percentile {slow:.3f} ms of {len(calls):,} calls")
    print(f"a constraint was violated in {violated:,} of {arguments.seconds:,} seconds")


if __name__ == "__main__":
    main()
