"""How little fuel a known case needs in a given time: the best found, and a certified lower bound.

    python -m study.optimum --out runs/reference/optimum

The first common test cases, each by itself and known in advance. *Best found*: for each time many settings of the
guidance that leads the Sun are flown, the best of each case are improved by gradients through the motion
(`study.optimum.search`), and the outcome is flown in the simulator, with attitude and every limit
(`study.optimum.flights`). *Bound*: a mixed-integer linear program of the first few of them (`study.optimum.bound`).
Every time of the one and every case of the other is a line of flights.jsonl and bounds.jsonl; the same command
continues after the last one. Then optimum.json and optimum.png are written. `--draw` only draws them anew, with the
agents of runs/reference/study. Takes an hour on one core.
"""

import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.guidance import natural_motion
from inspection.model.state import P, V
from inspection.orbits import Lead, Orbit
from settings import Parser, positive_integer
from study.config import TEST_CASES, Config
from study.experiment import paper_task, test_cases
from study.files import write_json
from study.optimum.bound import Task, climbed
from study.optimum.figure import draw
from study.optimum.flights import EVERY, TEACHERS, Flown, flown, guided, planned
from study.optimum.search import STEPS, Cases, cost, searched

TIMES = (3600.0, 3400.0, 3200.0, 3000.0)  # s, the longest first, whose bounds hold for the shorter ones
LONGEST = 6000.0  # s, that the guidance is given
SETTINGS = 256  # of the guidance, from which searches begin
KEPT = 5  # of a case
AT_ONCE = 320  # flights whose fuel is computed together
SEED = 37  # of the settings
# lowest and highest, as `Orbit` and `Lead` have them; those of a ratio are drawn by their logarithm
KNOBS = {
    "semi_minor": (40.0, 100.0),
    "out_of_plane": (15.0, 80.0),
    "tracking": (0.002, 0.015),
    "look_ahead": (0.3, 1.2),
    "approach": (0.1, 1.0),
    "behind": (0.0, math.radians(90)),
    "ahead": (0.0, math.radians(120)),
    "begin": (0.0, 0.6),
    "end": (0.65, 1.2),
}
RATIOS = ("semi_minor", "out_of_plane", "tracking", "approach")
HIGHEST = 0.8  # m/s, of a bound; above it `bound.TOLERANCE` would have to grow


def lines(path: Path) -> list[Any]:
    """The whole lines of a file, which keeps no others."""
    if not path.exists():
        return []
    whole = path.read_text(encoding="utf-8").split("\n")[:-1]
    path.write_text("".join(f"{line}\n" for line in whole), encoding="utf-8")
    return [json.loads(line) for line in whole]


def append(path: Path, line: Any) -> None:
    """One more line."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def begun(x: Tensor, priority: Tensor, settings: int) -> Tensor:
    """Thrusts (K, 3, settings x B) in N of the guidance with random knobs, each setting in all cases, to TIMES[0]."""
    cases = x.shape[1]
    _, env = paper_task(settings * cases, SEED)
    draws = torch.tensor(np.random.default_rng(SEED).random((settings, len(KNOBS))))
    low, high = torch.tensor(list(KNOBS.values()), dtype=torch.float64).T
    ratio = torch.tensor([name in RATIOS for name in KNOBS])
    knobs = torch.where(ratio, low * (high / low) ** draws, low + draws * (high - low)).T
    *ellipse, behind, ahead, begin, end = knobs.repeat_interleave(cases, 1)
    orbit = replace(Orbit(*ellipse), lead=Lead(behind, ahead, begin, end))
    guidance = natural_motion(env.c, env.c.action_period, orbit, env.sight.score)
    return flown(env, guidance, x.repeat(1, settings), priority.repeat(1, settings), max(TIMES)).thrust


def best_starts(thrust: Tensor, x: Tensor, priority: Tensor, kept: int) -> Tensor:
    """Of thrusts (K, 3, settings x B) those of the `kept` best settings of each case, (K, 3, kept x B)."""
    c, count = Config().inspection, x.shape[1]
    batch = AT_ONCE // count
    losses = []
    for part in thrust.split(batch * count, -1):
        settings = part.shape[-1] // count
        cases = Cases.of(x.repeat(1, settings), priority.repeat(1, settings), len(thrust), c)
        losses.append(cost(cases, part, c).view(settings, count))
    best = torch.cat(losses).argsort(0)[:kept]
    return thrust[..., (best * count + torch.arange(count)).flatten()]


def summary(found: Flown, cases: int) -> dict[str, Any]:
    """Of the flights of each case the clean one with the least delta v; None where there is none."""
    fuel = torch.where(found.clean, found.delta_v, math.inf).view(-1, cases)
    best = fuel.argmin(0) * cases + torch.arange(cases)

    def of_best(values: Tensor) -> list[float | None]:
        return [
            round(value, 6) if clean else None
            for value, clean in zip(values[best].tolist(), found.clean[best].tolist(), strict=True)
        ]

    return {
        "time_s": of_best(found.time),
        "delta_v_m_s": of_best(found.delta_v),
        "length_m_s": of_best(found.least),
        "flights": found.clean.numel(),
        "clean_flights": int(found.clean.sum()),
        "succeeded_flights": int(found.succeeded.sum()),
    }


def best_found(out: Path, x: Tensor, priority: Tensor, steps: int) -> list[dict[str, Any]]:
    """The best flights of each time, those already in flights.jsonl as they are there."""
    path = out / "flights.jsonl"
    found = lines(path)
    missing = TIMES[len(found) :]
    thrust = begun(x, priority, SETTINGS) if missing else None
    for time in missing:
        assert thrust is not None
        _, env = paper_task(KEPT * x.shape[1], SEED, decide_every=EVERY)
        first = best_starts(thrust[: round(time / env.c.action_period)], x, priority, KEPT)
        states, priorities = x.repeat(1, KEPT), priority.repeat(1, KEPT)
        plan = searched(Cases.of(states, priorities, len(first), env.c), first, env.c, steps)
        start = torch.cat((states[P], states[V]))
        flights = flown(env, planned(start, plan, env.c), states, priorities, time)
        found.append({"allowed_s": time} | summary(flights, x.shape[1]))
        append(path, found[-1])
        print(f"{time:,.0f} s: {found[-1]['clean_flights']} of {flights.time.numel()} clean", flush=True)
    return found


def cheapest(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The same with each case's cheapest flight of those that take no longer than a time, also of shorter ones."""
    names = "time_s", "delta_v_m_s", "length_m_s"
    rows = []
    for flights in found:
        within = [each for each in found if each["allowed_s"] <= flights["allowed_s"]]
        best = [
            min(
                (flown for flown in of_case if flown[1] is not None),
                key=lambda flown: flown[1],
                default=(None,) * len(names),
            )
            for of_case in zip(
                *(zip(*(each[name] for name in names), strict=True) for each in within), strict=True
            )
        ]
        rows.append(flights | dict(zip(names, map(list, zip(*best, strict=True)), strict=True)))
    return rows


def guidance(x: Tensor, priority: Tensor) -> dict[str, Any]:
    """What the guidance by its names needs in the same cases."""
    cases = x.shape[1]
    _, env = paper_task(len(TEACHERS) * cases, SEED, decide_every=EVERY)
    many = x.repeat(1, len(TEACHERS)), priority.repeat(1, len(TEACHERS))
    record = flown(env, guided(env, TEACHERS, cases), *many, LONGEST)
    return {
        name: {
            "time_s": record.time.view(-1, cases)[i].tolist(),
            "delta_v_m_s": [round(each, 6) for each in record.delta_v.view(-1, cases)[i].tolist()],
            "clean": int(record.clean.view(-1, cases)[i].sum()),
        }
        for i, name in enumerate(TEACHERS)
    }


def bounds(
    out: Path, x: Tensor, priority: Tensor, best: list[dict[str, Any]], count: int, seconds: float
) -> Iterator[dict[str, Any]]:
    """Lower bounds of the first cases in each time, those already in bounds.jsonl as they are there."""
    path = out / "bounds.jsonl"
    known = {(line["allowed_s"], line["case"]): line for line in lines(path)}
    for case in range(count):
        task, proven = Task.of(x[:, case], priority[:, case], Config().inspection), 0.0
        for time, flights in zip(TIMES, best, strict=True):
            if (time, case) not in known:
                most = flights["length_m_s"][case] or math.inf
                proven = climbed(task, time, proven, seconds, min(most, HIGHEST))
                known[time, case] = {"allowed_s": time, "case": case, "bound_m_s": proven}
                append(path, known[time, case])
                print(f"{time:,.0f} s, case {case}: at least {proven:.3f} m/s", flush=True)
            proven = known[time, case]["bound_m_s"]
            yield known[time, case]


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m study.optimum")
    parser.add_argument("--out", type=Path, required=True, help="directory for optimum.json and optimum.png")
    parser.add_argument("--cases", type=positive_integer, default=20, help="that are flown (default: 20)")
    parser.add_argument("--bounded", type=positive_integer, default=8, help="of them (default: 8)")
    parser.add_argument("--steps", type=positive_integer, default=STEPS, help=f"of Adam (default: {STEPS})")
    parser.add_argument("--rung", type=float, default=30.0, help="s of a proof at most (default: 30)")
    parser.add_argument("--draw", action="store_true", help="only draw optimum.json anew")
    arguments = parser.parse_args(argv)
    out = arguments.out
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    if not arguments.draw:
        out.mkdir(parents=True, exist_ok=True)
        x, priority, _ = test_cases(Config(), arguments.cases, TEST_CASES)
        best = cheapest(best_found(out, x, priority, arguments.steps))
        proven = list(bounds(out, x, priority, best, min(arguments.bounded, arguments.cases), arguments.rung))
        for flights in best:
            own = [line["bound_m_s"] for line in proven if line["allowed_s"] == flights["allowed_s"]]
            flights["bound_m_s"] = [round(math.floor(each * 1e6) / 1e6, 6) for each in own]
        write_json(
            out / "optimum.json",
            {
                "cases": arguments.cases,
                "seed": TEST_CASES,
                "starts": SETTINGS,
                "kept": KEPT,
                "steps": arguments.steps,
                "times": best,
                "guidance": guidance(x, priority),
            },
        )
    draw(json.loads((out / "optimum.json").read_text(encoding="utf-8")), out / "optimum.png")


if __name__ == "__main__":
    main()
