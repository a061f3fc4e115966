"""One call of the filter at a time, next to its limits: is every h still >= 0, and can all of it still be held?

A draw is a state (`study.boundary.limits`) and TRIES desired controls, each of which goes through the filter and
the plant for one period. Every h is checked every CHECK_BETWEEN s, and at the end the filter is asked again: a row that
has slack there, where none had before, is *lost*. Rows of the body rates are left out of that where the plant saturates
them. Draws are independent of each other, so that the bound per draw is Clopper and Pearson's.
"""

import dataclasses
import sys
from collections.abc import Iterator
from copy import copy
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.closed_loop import Smallest
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from kernels.compiled import Compiled
from rta.filter import SafetyFilter
from rta.lie_derivatives import Function
from rta.qp.programs import Status
from study.boundary.limits import BISECTIONS, CANDIDATES, barriers, near_limits
from study.boundary.report import Tried, add, empty_report, held_by_the_plant
from study.config import Config
from study.errors import refusing
from study.experiment import Experiment, check_clocks
from study.files import write_json
from study.machine import bar, compile_or_explain
from study.verification.adversaries import adversarial
from study.verification.campaign import blamed
from study.verification.findings import report_in
from study.verification.starts import spawned

BATCH = 4096  # states drawn at once
TRIES = 4  # desired controls at each of them
CHECK_BETWEEN = 0.1  # s
CALLS = 2 + 3 * sum(BISECTIONS)  # of the filter's rows in a batch, about


@dataclasses.dataclass(frozen=True)
class Boundary:
    """What determines the numbers beside the configuration; `period` is that of the filter in s."""

    period: float
    seed: int
    batch_size: int
    tries: int = TRIES
    candidates: int = CANDIDATES
    kind: str = "boundary"


def controls(x: Tensor, safety_filter: SafetyFilter, generator: torch.Generator) -> Tensor:
    """Desired controls at states (16, B), (TRIES, 6, B).

    The adversary's, the vertex of the box that is nearest to it, another vertex and one of all controls, at random.
    """
    limit = x.new_tensor(safety_filter.c.control_limit)[:, None]
    down = adversarial(safety_filter)(0.0, x)
    number = torch.rand(2, CONTROL_SIZE, x.shape[1], generator=generator, dtype=torch.float64).to(x)
    vertex, anywhere = 2.0 * number[0].round() - 1.0, 2.0 * number[1] - 1.0
    nearest = torch.where(down == 0.0, vertex, down.sign())
    return torch.stack((down, limit * nearest, limit * vertex, limit * anywhere))


@torch.no_grad()
def tried(
    env: InspectionEnv, safety_filter: SafetyFilter, x: Tensor, desired: Tensor, number: Tensor
) -> Tried:
    """Each of the desired controls (TRIES, 6, B) at states x (16, B), for one period.

    Args:
        env: of TRIES * B episodes; number: (B,) in [0, 1), from which the plants follow.
    """
    tries, _, batch = desired.shape
    flat = desired.transpose(0, 1).flatten(1)
    start = x.repeat(1, tries)
    if env.plant:
        env.plant.begin(torch.arange(tries * batch, device=x.device), start, number.repeat(tries))
    h, holds = (
        Smallest(len(env.safety.names), start),
        env.fly(lambda t, seen: flat, safety_filter.period, start),
    )
    for hold in chain((first := next(holds),), holds):
        last = h.note(env.constraint_values(hold.after))
    again = safety_filter.correct(hold.after, flat)

    def apart(part: Tensor) -> Tensor:
        return part.unflatten(-1, (tries, batch))

    smallest, worst = apart(h.value).min(1)
    answers: tuple[Any, Any] = first.correction, again
    before, after = (apart(answer.slack).amax(1) for answer in answers)

    def of_worst(control: Tensor) -> Tensor:
        return apart(control).expand(len(worst), -1, -1, -1).gather(2, chosen)[:, :, 0]

    chosen = worst[:, None, None].expand(-1, CONTROL_SIZE, -1, -1)
    unsolved = sum(int((answer.status == Status.UNSOLVED).sum()) for answer in answers)
    return Tried(
        smallest,
        apart(last).amin(1),
        of_worst(flat),
        of_worst(first.applied),
        before,
        after,
        unsolved,
        backup=sum(int(answer.backup.sum()) for answer in answers),
        calls=2 * tries * batch,
    )


def barriers_of(experiment: Experiment) -> Function:
    """`barriers` of the experiment's filter; compiled with it, which halves the time of a draw."""
    safety_filter, compiled = experiment.filter, []

    def compile() -> None:
        bare = copy(safety_filter)  # not compiled: compiled code cannot be recorded
        x, _ = safety_filter.probe(experiment.device)
        compiled.append(Compiled(lambda y: [barriers(y, bare)], x, batch=BATCH))

    if experiment.filter_compiled and compile_or_explain("barriers", compile):
        return lambda x: compiled[0](x)[0]
    return partial(barriers, safety_filter=safety_filter)


def run(
    campaign: Boundary, draws: int, experiment: Experiment, path: Path | None
) -> Iterator[dict[str, Any]]:
    """Draws batch after batch and yields the report so far, which `path` holds too and is resumed from.

    A batch is always drawn whole, so that there may be more draws than asked for.
    """
    config, safety_filter = experiment.config, experiment.filter
    report = report_in(path, campaign, config, empty_report)
    barriers_at = barriers_of(experiment)
    columns = campaign.batch_size * campaign.tries
    env = experiment.env(columns, None, campaign.period, CHECK_BETWEEN, experiment.filter_compiled)
    yield report
    while report["draws"] < draws:
        batch_seed = np.random.SeedSequence((campaign.seed, report["batches"])).generate_state(1)[0]
        of_states, of_controls, of_plants = spawned(int(batch_seed), 3)
        with refusing(blamed(config), RuntimeError):
            near = near_limits(campaign.batch_size, of_states, safety_filter, barriers_at, experiment.device)
        desired = controls(near.state, safety_filter, torch.Generator().manual_seed(of_controls))
        plants = torch.Generator().manual_seed(of_plants)
        number = torch.rand(campaign.batch_size, generator=plants, dtype=torch.float64).to(near.state)
        result = tried(env, safety_filter, near.state, desired, number)
        add(report, near, result, number, held_by_the_plant(config))
        if path is not None:
            write_json(path, report)
        yield report


def search(campaign: Boundary, draws: int, config: Config, path: Path | None) -> dict[str, Any]:
    """All draws, with a progress bar; returns the report.

    Args:
        config: with the filter on; path: see `run`.
    """
    period = campaign.period
    check_clocks(config, period, CHECK_BETWEEN, period, f"boundary, checked every {CHECK_BETWEEN:g} s")
    experiment = Experiment(config, BATCH * TRIES, seconds=-(-draws // BATCH) * CALLS * period)
    reports = run(campaign, draws, experiment, path)
    report = next(reports)  # refuses before there is a bar
    if report["draws"] >= draws:
        print(f"{path}: holds {report['draws']:,} draws already", file=sys.stderr)
    with bar(draws, "draws", initial=report["draws"]) as shown:
        for report in reports:
            shown.set_postfix_str(f"{report['violating_draws']['any']:,} violating", refresh=False)
            shown.update(min(report["draws"], draws) - shown.n)
    return report
