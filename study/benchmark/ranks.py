"""The numbers of docs/guides/scaling.md: measures one process or the ranks of torchrun, then projects to more ranks.

    OMP_NUM_THREADS=1 python -m study.benchmark.ranks DIR
    OMP_NUM_THREADS=1 torchrun --standalone --nproc_per_node=2 -m study.benchmark.ranks DIR

Each writes DIR/ranks_<K>.json; once both are there, the tables are printed.
"""

import dataclasses
import json
import statistics
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE
from inspection.observation import components
from ppo.distributed import ranks
from ppo.rollout import collect
from settings import Parser, load, override
from study.benchmark.timing import typical_seconds
from study.config import Config
from study.files import ROOT, write_json
from study.machine.provenance import provenance
from study.training.run import Run

RANKS = (1, 2, 4, 8, 16, 32)  # of the projection
# bytes per s; None: as measured
LINKS = {"local": None, "1 Gb/s": 1.25e8, "10 Gb/s": 1.25e9, "100 Gb/s": 1.25e10}
FLOATS = len(components()) + CONTROL_SIZE + 4  # of an interaction in a batch
UPDATES = 3  # timed after one that is not
REPEATS = 100


def timed_run(config: Config, count: int = 1) -> Run:
    """A run of one rank of `count`, alone: as many times fewer episodes and interactions per gradient step."""
    train = dataclasses.replace(config.train, num_envs=config.train.num_envs // count)
    train = dataclasses.replace(train, interactions=(1 + UPDATES) * train.batch)
    ppo = dataclasses.replace(config.ppo, minibatch_size=config.ppo.minibatch_size // count)
    run = Run(dataclasses.replace(config, train=train, ppo=ppo), Path())
    run.env.reset()
    return run


def time_updates(run: Run) -> dict[str, float]:
    """Median times of whole updates in s, by all ranks."""
    log: list[dict[str, float]] = []
    run.trainer.run(run.monitor, log.append, lambda: False)
    names = ("rollout_s", "learning_s")
    return {name: statistics.median(each[f"time/{name}"] for each in log[1:]) for name in names}


def time_shares(config: Config) -> dict[str, dict[int, float]]:
    """Times in s of a step of all a rank's episodes and of a gradient step on its share, by the number of ranks."""
    steps, gradients = {}, {}
    for count in RANKS:
        run = timed_run(config, count)
        learner, rollout_steps = run.trainer.learner, config.train.rollout_steps
        batch = collect(run.env, learner, rollout_steps, run.trainer.generators)
        some = -(-rollout_steps // 4)
        act = partial(collect, run.env, learner, some, run.trainer.generators)
        learn = partial(learner.update, batch, 0.0)
        steps[count] = typical_seconds(act, run.device, 3) / some
        gradients[count] = typical_seconds(learn, run.device, 3) / gradient_steps(config)
    return {"environment_step": steps, "gradient_step": gradients}


def time_exchanges(run: Run) -> dict[str, float]:
    """Times in s of each kind of exchange among the ranks."""
    everyone, minibatch = run.ranks, run.config.ppo.minibatch_size
    gradient = [torch.zeros_like(weight) for weight in weights(run)]
    number = [torch.zeros(1, device=run.device)]
    share = torch.zeros(1, run.config.train.batch // everyone.size, FLOATS, device=run.device)
    exchanges = {
        "gradient": lambda: everyone.average(gradient, minibatch),
        "latency": lambda: everyone.average(number, minibatch),
        "batch": lambda: everyone.whole(share, 1),
        "turn": lambda: everyone.turn(1),
    }
    return {name: typical_seconds(exchange, run.device, REPEATS) for name, exchange in exchanges.items()}


def weights(run: Run) -> list[Tensor]:
    """Everything that has a gradient."""
    return [*run.trainer.learner.policy.parameters(), *run.trainer.learner.value.parameters()]


def gradient_steps(config: Config) -> int:
    """Gradient steps, and so gradient exchanges, of an update."""
    return config.ppo.epochs * -(-config.train.batch // config.ppo.minibatch_size)


def measure(config: Config) -> dict[str, Any]:
    """Everything that the page states about this machine with so many ranks."""
    run = timed_run(config)
    parameters = sum(weight.numel() for weight in weights(run))
    about = {
        "ranks": run.ranks.size,
        "parameters": parameters,
        "bytes_per_exchange": 4 * parameters,
        "bytes_per_batch": 4 * FLOATS * config.train.batch,
        "gradient_steps_per_update": gradient_steps(config),
        "rollout_steps": config.train.rollout_steps,
        "interactions_per_update": config.train.batch,
        "epochs": config.ppo.epochs,
        "provenance": provenance(run.device),
        "update_s": time_updates(run),
    }
    if run.ranks.size > 1:
        return about | {"exchange_s": time_exchanges(run)}
    return about | {"share_s": time_shares(config)}


def exchange(two: dict[str, Any], count: int, bytes_per_s: float | None) -> float:
    """s that an update's gradients and batch take around a ring of `count` ranks, in K - 1 or twice as many messages.

    A rank passes on (K - 1) / K of the batch, and twice that of each gradient: once to sum, once to spread the sum.
    """
    measured = two["exchange_s"]
    latency = measured["latency"] / 2  # two messages between two ranks
    here = two["bytes_per_exchange"] / (measured["gradient"] - measured["latency"])
    gradients = 2 * two["gradient_steps_per_update"]
    carried = gradients * two["bytes_per_exchange"] + two["bytes_per_batch"]
    return (gradients + 1) * (count - 1) * latency + carried * (count - 1) / count / (bytes_per_s or here)


def update(
    one: dict[str, Any], two: dict[str, Any], count: int, bytes_per_s: float | None
) -> dict[str, float]:
    """s of an update by `count` ranks, from the times of a rank's own work and of exchanges between two."""
    shares = {name: times[str(count)] for name, times in one["share_s"].items()}
    turn = two["exchange_s"]["turn"] * (count - 1)
    return {
        "rollout": one["rollout_steps"] * (shares["environment_step"] + turn),
        "gradients": one["gradient_steps_per_update"] * shares["gradient_step"],
        "exchanges": exchange(two, count, bytes_per_s),
    }


def updates(one: dict[str, Any], two: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Of one and two ranks: s of an update's rollout and of its learning, and what that makes per s."""
    batch, epochs = one["interactions_per_update"], one["epochs"]
    for measured in (one, two):
        rollout, learning = (measured["update_s"][name] for name in ("rollout_s", "learning_s"))
        rates = f"{batch / rollout:,.0f}", f"{epochs * batch / learning:,.0f}"
        yield f"{measured['ranks']}", f"{rollout:.2f}", f"{learning:.2f}", *rates


def exchanges(_: dict[str, Any], two: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """ms of each exchange between two ranks."""
    for name, value in two["exchange_s"].items():
        yield name, f"{1e3 * value:.2f}"


def projection(one: dict[str, Any], two: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Of each number of RANKS: s of an update's parts, and interactions per s over each of LINKS."""
    for count in RANKS:
        parts = [update(one, two, count, rate) for rate in LINKS.values()]
        rates = (f"{one['interactions_per_update'] / sum(each.values()):,.0f}" for each in parts)
        yield f"{count}", *(f"{value:.2f}" for value in parts[0].values()), *rates


TABLES = {
    "ranks, measured | rollout (s) | learning (s) | environment steps per s | samples learned per s": updates,
    "exchange between 2 ranks, measured | ms": exchanges,
    "ranks, projected | rollout (s) | gradients (s) | exchanges, local (s) | "
    f"interactions per s, {' | '.join(LINKS)}": projection,
}  # by their headings


def tables(one: dict[str, Any], two: dict[str, Any]) -> str:
    """The page's tables, in Markdown."""
    lines = [
        f"{one['parameters']:,} parameters, {one['bytes_per_exchange']:,} bytes per exchange, "
        f"{one['gradient_steps_per_update']} exchanges and {one['bytes_per_batch']:,} bytes of experience "
        f"per update of {one['interactions_per_update']:,} interactions"
    ]
    for heading, rows in TABLES.items():
        lines += ["", f"| {heading} |", "|---" * (heading.count("|") + 1) + "|"]
        lines += [f"| {' | '.join(row)} |" for row in rows(one, two)]
    return "\n".join(lines)


def main(directory: Path, config: Config) -> None:
    """Measures, writes and, once both files are there, prints the tables."""
    result = measure(config)
    if not ranks().first:
        return
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / f"ranks_{ranks().size}.json", result)
    files = [directory / f"ranks_{count}.json" for count in (1, 2)]
    if all(file.exists() for file in files):
        print(tables(*(json.loads(file.read_text(encoding="utf-8")) for file in files)))


if __name__ == "__main__":
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, metavar="DIR", help="for the measurements")
    directory = parser.parse_args().directory
    settings = load(ROOT / "configs" / "rta.toml", Config())
    main(directory, override(settings, {"train": {"compile": "on"}}, "ranks"))
