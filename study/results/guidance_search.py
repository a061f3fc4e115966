"""Searches the knobs of the guidance that leads the Sun for time against delta v (docs/results/learning.md).

    python -m study.results.guidance_search --out runs/guidance_search
    python -m study.results.guidance_search --out runs/guidance_search --start runs/reference/guidance/front.json

NSGA-II (Deb et al. 2002) over KNOBS: each generation flies its candidates through the same cases at once, with a
decision every 10 s and without the filter, as an agent flies. Candidates that fail in a case, come nearer to a limit
than MARGINS in some second or would drift into the chief afterwards rank behind those that do not: a copy is not as
exact as its teacher. The first generation is by chance, or of an earlier front. Every generation is a line of
search.jsonl; the same command continues after the last one. At the end the front flies cases of its own, into
front.json. Takes a quarter of an hour on one core.
"""

import json
import math
import os
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from inspection.guidance import natural_motion
from inspection.orbits import Lead, Orbit
from inspection.transition import METRICS
from rta.constraints.names import CONSTRAINTS
from settings import Parser, positive_integer
from study.experiment import paper_task, test_cases
from study.files import write_json
from study.flight.evaluation import run_episodes

SEARCH_CASES, CONFIRM_CASES = 3701, 3702  # seeds of the cases; those of tests and checks are others
CONFIRMED = 480  # cases
MARGINS = {"passive_safety": 10.0, "dynamic_speed": 0.03}  # m, m/s
LONGEST = 6000.0  # s; an episode that takes longer has failed
SEED = 37  # of the search
# lowest and highest, as `Orbit` and `Lead` have them; those of a ratio are searched by their logarithm
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
LEADS = ("behind", "ahead", "begin", "end")
MUTATED = 0.3  # of a child's knobs
STEP = 0.1  # standard deviation of a mutation, of a knob's range
OVERSHOOT = 0.25  # of a child beyond its parents, of their distance


class Candidate(NamedTuple):
    """Knobs, and what came of them over all cases: means, and how many cases were not clean by MARGINS."""

    knobs: tuple[float, ...]
    time_s: float
    delta_v_m_s: float
    unclean: int


def ranges() -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest of each knob, (knobs,), as they are searched."""
    bounds = [np.log(bound) if name in RATIOS else np.array(bound) for name, bound in KNOBS.items()]
    low, high = np.stack(bounds, 1)
    return low, high


def knobs_at(place: np.ndarray) -> tuple[float, ...]:
    """The knobs at a place in the unit cube, to four digits, which is what is flown and kept."""
    low, high = ranges()
    values = low + place * (high - low)
    return tuple(
        float(f"{math.exp(value) if name in RATIOS else value:.4g}")
        for name, value in zip(KNOBS, values, strict=True)
    )


def place_of(knobs: Sequence[float]) -> np.ndarray:
    """The inverse of `knobs_at`, to rounding."""
    low, high = ranges()
    values = [math.log(v) if name in RATIOS else v for name, v in zip(KNOBS, knobs, strict=True)]
    return np.clip((np.array(values) - low) / (high - low), 0.0, 1.0)


def orbit_of(knobs: dict[str, Any]) -> Orbit:
    """The guidance's orbit with the given knobs, each a number or (B,)."""
    lead = Lead(**{name: knobs[name] for name in LEADS})
    return Orbit(**{name: value for name, value in knobs.items() if name not in LEADS}, lead=lead)


class Flights:
    """Flies many candidates through the same cases at once.

    Args:
        cases: of each candidate; seed: of the cases.
    """

    def __init__(self, candidates: int, cases: int, seed: int) -> None:
        self.cases, self.candidates = cases, candidates
        experiment, self.env = paper_task(candidates * cases, seed + 1, max_time=LONGEST)
        self.starts = test_cases(experiment.config, cases, seed)

    def fly(self, knobs: Sequence[tuple[float, ...]]) -> list[Candidate]:
        """What comes of as many candidates as the environment has room for."""
        env = self.env
        each = torch.tensor(knobs, dtype=torch.float64).T.repeat_interleave(self.cases, 1)
        orbit = orbit_of(dict(zip(KNOBS, each, strict=True)))
        x, priority = (part.repeat(1, self.candidates) for part in self.starts)
        record = run_episodes(
            env, natural_motion(env.c, env.c.action_period, orbit, env.sight.score), x, priority
        )

        def of_each(values: Tensor) -> Tensor:
            return values.double().unflatten(0, (self.candidates, self.cases))

        time, fuel = (
            of_each(record.metrics[METRICS.index(name)]).mean(1).tolist()
            for name in ("episode_length_s", "delta_v_m_s")
        )
        clear = [record.worst[CONSTRAINTS.index(name)] >= least for name, least in MARGINS.items()]
        clean = torch.stack((record.clean, *clear)).all(0)
        unclean = of_each(~clean).sum(1).int().tolist()
        return [Candidate(*found) for found in zip(knobs, time, fuel, unclean, strict=True)]


def ranks(candidates: Sequence[Candidate]) -> np.ndarray:
    """Of each candidate, the front that it is on, 0 for the first: fewer unclean cases first, then Pareto's order."""
    values = np.array([(each.unclean, each.time_s, each.delta_v_m_s) for each in candidates])
    mine, theirs = values[:, None], values[None]
    no_worse, better = (theirs[..., 1:] <= mine[..., 1:]).all(-1), (theirs[..., 1:] < mine[..., 1:]).any(-1)
    cleaner, as_clean = theirs[..., 0] < mine[..., 0], theirs[..., 0] == mine[..., 0]
    beaten = cleaner | (as_clean & no_worse & better)
    rank, left, front = np.full(len(values), -1), np.ones(len(values), bool), 0
    while left.any():
        first = left & ~(beaten & left[None]).any(1)
        rank[first], left, front = front, left & ~first, front + 1
    return rank


def crowding(candidates: Sequence[Candidate], rank: np.ndarray) -> np.ndarray:
    """How far apart each one's neighbours on its front are, as a share of the front; infinite at its ends."""
    distance = np.zeros(len(candidates))
    for front in np.unique(rank):
        members = np.flatnonzero(rank == front)
        for name in ("time_s", "delta_v_m_s"):
            values = np.array([getattr(candidates[int(i)], name) for i in members])
            order = members[np.argsort(values)]
            values = np.sort(values)
            distance[order[[0, -1]]] = math.inf
            distance[order[1:-1]] += (values[2:] - values[:-2]) / max(values[-1] - values[0], 1e-12)
    return distance


def survivors(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """The best of the candidates: by front, within one the least crowded first."""
    rank = ranks(candidates)
    order = np.lexsort((-crowding(candidates, rank), rank))
    return [candidates[int(i)] for i in order[:count]]


def children(
    parents: Sequence[Candidate], count: int, generation: int, start: Sequence[tuple[float, ...]] = ()
) -> list[tuple[float, ...]]:
    """The knobs of a generation, which follow from its number and its parents.

    Those of the first are evenly of the start's, in its order, or fill the ranges.
    """
    draws = np.random.default_rng((SEED, generation))
    if not parents:
        if start:
            return [start[round(i)] for i in np.linspace(0, len(start) - 1, count)]
        strata = np.stack([draws.permutation(count) for _ in KNOBS], 1)
        return [knobs_at(place) for place in (strata + draws.random(strata.shape)) / count]
    born = []
    for _ in range(count):
        # of two, the one that stands before the other among the survivors
        one, other = (place_of(parents[draws.integers(len(parents), size=2).min()].knobs) for _ in range(2))
        place = one + draws.uniform(-OVERSHOOT, 1.0 + OVERSHOOT, len(KNOBS)) * (other - one)
        mutated = draws.random(len(KNOBS)) < MUTATED
        place = place + mutated * STEP * draws.standard_normal(len(KNOBS))
        born.append(knobs_at(np.clip(place, 0.0, 1.0)))
    return born


def searched(path: Path) -> list[list[Candidate]]:
    """The generations in a file; what follows the last whole line is dropped."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    return [[Candidate(tuple(knobs), *rest) for knobs, *rest in json.loads(line)] for line in lines]


def search(
    path: Path, population: int, generations: int, cases: int, start: Sequence[tuple[float, ...]] = ()
) -> list[Candidate]:
    """All candidates of the generations, those already in the file as they are there; `start` as of `children`."""
    found = searched(path)
    flights = Flights(population, cases, SEARCH_CASES) if len(found) < generations else None
    path.write_text("".join(line(each) for each in found), encoding="utf-8")
    while flights and len(found) < generations:
        parents = survivors([each for born in found for each in born], population) if found else []
        found.append(flights.fly(children(parents, population, len(found), start)))
        with path.open("a", encoding="utf-8") as file:
            file.write(line(found[-1]))
        clean = [each for each in found[-1] if not each.unclean]
        print(f"generation {len(found)} of {generations}: {len(clean)} of {population} clean", flush=True)
    return [each for born in found for each in born]


def line(generation: Sequence[Candidate]) -> str:
    """A generation as a line of the file."""
    return json.dumps(generation) + "\n"


def front(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those that are clean and that none of the others beats, the quickest first."""
    clean = [each for each in candidates if not each.unclean]
    best = [each for each, rank in zip(clean, ranks(clean), strict=True) if rank == 0] if clean else []
    return sorted(best, key=lambda each: each.time_s)


def known(name: str) -> list[tuple[float, ...]]:
    """The knobs of the front in a front.json.

    Raises:
        ArgumentTypeError: it is no such file.
    """
    try:
        rows = json.loads(Path(name).read_text(encoding="utf-8"))["front"]
        return [tuple(float(row["knobs"][name]) for name in KNOBS) for row in rows]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ArgumentTypeError(f"{name}: not the front of a search: {error!r}") from error


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m study.results.guidance_search")
    parser.add_argument("--out", type=Path, required=True, help="directory for search.jsonl and front.json")
    parser.add_argument("--population", type=positive_integer, default=40, help="candidates (default: 40)")
    parser.add_argument("--generations", type=positive_integer, default=25, help="(default: 25)")
    parser.add_argument("--cases", type=positive_integer, default=96, help="of each candidate (default: 96)")
    parser.add_argument(
        "--start", type=known, default=[], metavar="F", help="front.json to begin with (default: by chance)"
    )
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    arguments.out.mkdir(parents=True, exist_ok=True)
    sizes = arguments.population, arguments.generations, arguments.cases
    best = front(search(arguments.out / "search.jsonl", *sizes, arguments.start))
    confirmed = Flights(len(best), CONFIRMED, CONFIRM_CASES).fly([each.knobs for each in best])
    rows = [
        {"knobs": dict(zip(KNOBS, each.knobs, strict=True))}
        | {"search": dict(zip(Candidate._fields[1:], each[1:], strict=True))}
        | {"confirmed": dict(zip(Candidate._fields[1:], again[1:], strict=True))}
        for each, again in zip(best, confirmed, strict=True)
    ]
    sized = dict(zip(("population", "generations", "cases"), sizes, strict=True))
    write_json(arguments.out / "front.json", sized | {"confirmed_cases": CONFIRMED, "front": rows})


if __name__ == "__main__":
    main()
