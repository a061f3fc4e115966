"""Golden numbers: what the code computed when they were recorded, and what has moved since.

    python -m tests.golden                     # all parts, two minutes
    python -m tests.golden filter campaign/u1  # the parts whose names begin so
    python -m tests.golden training --renew    # record these parts anew, and show what is replaced

prints a line per quantity and ends with exit code 1 if one is beyond its tolerance. golden.json holds a digest of each
quantity's bits and, of each of its rows, samples, a summary and the totals of successive blocks. A digest says whether
bits have moved. Samples and totals say by how much, in units of the row's largest magnitude: a single number that moved
shows in the total of its block.
"""

import argparse
import hashlib
import io
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import main as command_line
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROLS
from inspection.observation import components
from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from ppo.network import Policy
from rta.fast.filter import fast
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from rta.result import Status
from settings import InputError, load
from study.config import TEST_CASES, Config
from study.experiment import Experiment, filter_of, load_policy
from study.experiment import test_cases as common_cases
from study.flight.evaluation import play

ROOT = Path(__file__).parents[1]
FILE = Path(__file__).with_suffix(".json")
AGENT = ROOT / "runs/reference/from_nothing/rta/seed0/policy.pt"
SAMPLES, BLOCKS = 90, 10  # samples of a quantity, at least one of each row; blocks of a row
# By how much a quantity may move, in units of a row's largest magnitude. Other processors and versions of PyTorch round
# otherwise. Behind each stands by how much it did on a processor with AVX-512: network, training and agent between any
# two of MKL's kernels (MKL_CBWR unset, COMPATIBLE, AVX2, AVX512), filter and campaign from the recording to the
# default. A flight of an agent, whose network computes in single precision, multiplies that: case by case up to a
# seventh, so that means of twenty cases count, and outcomes. Training multiplies it faster still: two short updates
# count. Labels may not move.
TOLERANCES = {
    "filter": 1e-9,  # 4e-15
    "network": 1e-5,  # 4e-7
    "campaign": 1e-8,  # 3e-11
    "training": 5e-4,  # 5e-5
    "agent": 5e-3,  # 1.4e-3
}
SAME = "same bits"
TRAINING = """
[train]
num_envs = 256
rollout_steps = 4
interactions = 2048
jump_start = 0
evaluation_interval = 1_000_000
early_evaluations = 1
final_episodes = 1
[inspection]
max_time = 40.0 # s; every episode ends with an update
"""

Labels = list[str]
Rows = Mapping[str, Any]  # by name: what NumPy takes for an array of float64
Quantities = dict[str, Labels | Rows]
Recorded = dict[str, Any]


def rows(names: tuple[str, ...], values: Any) -> Rows:
    """Returns rows by name, where there are as many of both."""
    return dict(zip(names, values, strict=True))


def states(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns states (16, N) and desired controls (6, N), some beyond the actuators' limits.

    Of each 20, 8 are slow and well inside the zone, 8 within some limits and beyond others, 3 far beyond, and 1 has a
    number that is none.
    """
    rng = np.random.default_rng(seed)
    kind = rng.permutation(np.arange(count) % 20)
    p, v, q = rng.standard_normal((3, 4, count))
    near = rng.choice((18.0, 50.0, 200.0, 790.0), count) * rng.uniform(1.0, 1.01, count)
    distance = np.where(kind < 8, rng.uniform(50.0, 600.0, count), near)
    distance = np.where(kind >= 16, distance * rng.uniform(0.3, 1.5, count), distance)
    share = rng.uniform(0.0, 1.1, count) * np.where(kind < 8, 0.3, np.where(kind < 16, 1.0, 3.0))
    p, v = (each[:3] / np.linalg.norm(each[:3], axis=0) for each in (p, v))
    omega = np.radians(rng.uniform(-2.0, 2.0, (3, count))) * np.where(kind < 16, 1.0, 2.0)
    x = np.vstack(
        (
            distance * p,
            share * (0.2 + 0.0077 * distance) * v,
            q / np.linalg.norm(q, axis=0),
            omega,
            rng.uniform(0.0, np.where(kind < 16, 10.0, 60.0)),
            rng.uniform(np.where(kind < 16, 1.0, -1.0), 5.0),
            rng.uniform(0.0, 2.0 * np.pi, count),
        )
    )
    x[rng.integers(0, 16, count)[kind == 19], kind == 19] = rng.choice(
        (np.nan, np.inf, -np.inf), (kind == 19).sum()
    )
    desired = rng.uniform(-1.1, 1.1, (6, count))
    desired = np.where(rng.random(count) < 0.3, 1.1 * np.sign(desired), desired)
    limit = np.array(InspectionParameters().control_limit)[:, None]
    return torch.from_numpy(x), torch.from_numpy(desired * limit)


def filtered(count: int, period: float, config: str | None = None) -> Quantities:
    """Returns the compiled filter's answers at states, with a period and the bounds of a shipped configuration."""
    base = load(config, Config()) if config else Config()
    try:
        own = fast(filter_of(replace(base, rta=RtaParameters(period=period))), "cpu", count)
    except InputError as error:
        return {"refused": [str(error)]}
    x, desired = states(count, seed=0)
    result = own.correct(x, desired)
    return {
        "control": rows(CONTROLS, result.control),
        "h": rows(own.names, result.h),
        "slack": rows(own.names, result.slack),
        "status": [Status(status).name for status in result.status.tolist()],
        "verified": [str(verified) for verified in result.verified.tolist()],
        "backup": [str(backup) for backup in result.backup.tolist()],
    }


def shipped_agent(cases: int, rta: bool) -> tuple[Policy, Experiment]:
    """Returns a shipped agent, and the experiment in which it flies `cases` cases."""
    policy, trained = load_policy(AGENT)
    return policy, Experiment(replace(trained, train=replace(trained.train, rta=rta, device="cpu")), cases)


def decided(cases: int) -> Quantities:
    """Returns a shipped agent's observation, action and reward after one random step of common test cases."""
    policy, experiment = shipped_agent(cases, rta=False)
    env = experiment.env(cases)
    env.start(*common_cases(experiment.config, cases, TEST_CASES))
    seen = env.step(2.0 * torch.rand(cases, 6, generator=torch.Generator().manual_seed(0)) - 1.0)
    observed = components(experiment.config.inspection)
    action = policy.mean_action(seen.final_observation[None])[0]
    return {
        "observation": rows(tuple(each.name for each in observed), seen.final_observation.T),
        "action": rows(CONTROLS, action.T),
        "reward": seen.reward_terms,
    }


def flown(cases: int, rta: bool) -> Quantities:
    """Returns the outcomes of common test cases that a shipped agent flies."""
    record = play(*shipped_agent(cases, rta), cases, TEST_CASES)
    return {
        "means": rows(METRICS, record.metrics.mean(1)),
        "outcome": [OUTCOMES[i] for i in record.outcome.tolist()],
        "clean": [str(clean) for clean in record.clean.tolist()],
    }


def command(*words: str) -> None:
    """Runs a command of main.py, without what it prints; raises RuntimeError where it fails."""
    with redirect_stdout(io.StringIO()):
        code = command_line.main(list(words))
    if code:
        raise RuntimeError(f"main.py {' '.join(words)}: exit code {code}")


def verified(policy: str, *flags: str) -> Quantities:
    """Returns a campaign's counts, its smallest h, and the controls of the episodes with these values."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.json"
        campaign = "--episodes", "64", "--duration", "300", "--device", "cpu", "--json", str(path)
        command("verify", "--policy", policy, *campaign, "--keep-worst", *flags)
        report = json.loads(path.read_text())
        worst = [np.load(f"{path}.{name}.npz")["control_applied"] for name in CONSTRAINTS]
    counts = "episodes", "steps", "starts_rejected", "backup_calls", "controls_outside_bounds"
    tables = "violating_episodes", "violating_steps", "filter_calls"
    of_tables = {f"{table} {key}": value for table in tables for key, value in report[table].items()}
    return {
        "counts": {name: report[name] for name in counts} | of_tables,
        "least h": report["worst_value"],
        "controls": rows(CONTROLS, np.concatenate(worst).T),
    }


def trained(*flags: str) -> Quantities:
    """Returns the weights of an agent after two updates, and the statistics of the last one."""
    with tempfile.TemporaryDirectory() as folder:
        settings, run = Path(folder) / "golden.toml", Path(folder) / "run"
        settings.write_text(TRAINING)
        files = "--config", "study", "--config", str(settings)
        command("train", *files, "--device", "cpu", "--run-dir", str(run), *flags)
        policy, _ = load_policy(run / "policy.pt")
        events = EventAccumulator(str(run))
        events.Reload()
        tags = sorted(
            tag for tag in events.Tags()["scalars"] if not tag.startswith(("charts/", "time/", "evaluation/"))
        )
        return {
            "weights": {name: weight.flatten() for name, weight in policy.state_dict().items()},
            "statistics": {tag: events.Scalars(tag)[-1].value for tag in tags},
        }


U1 = "plants/u1"
PARTS: dict[str, Callable[[], Quantities]] = {
    "filter/quick": partial(filtered, 500, 1.0),
    "network/quick": partial(decided, 500),
    "filter/1": partial(filtered, 20_000, 1.0),
    "filter/5": partial(filtered, 20_000, 5.0),
    "filter/10": partial(filtered, 20_000, 10.0),
    "filter/u1/1": partial(filtered, 20_000, 1.0, U1),
    "filter/u1/5": partial(filtered, 20_000, 5.0, U1),
    "filter/u1/10": partial(filtered, 20_000, 10.0, U1),
    "agent/no_rta": partial(flown, 20, rta=False),
    "agent/rta": partial(flown, 20, rta=True),
    **{
        f"campaign/{name}/{policy}": partial(verified, policy, *flags)
        for name, flags in {
            **{period: ("--rta-period", period) for period in ("1", "5", "10")},
            "u1": ("--config", U1),
        }.items()
        for policy in ("random", "adversarial")
    },
    "training/no_rta": partial(trained, "--no-rta"),
    "training/rta": partial(trained, "--rta", "--rta-period", "1"),
}


def recorded(quantity: Labels | Rows) -> Recorded:
    """Returns golden.json's entry for a quantity: counts and samples of labels, or for rows `recorded_row`."""
    if isinstance(quantity, list):
        bits = "\n".join(quantity).encode()
        samples = quantity[:: max(1, len(quantity) // SAMPLES)][:SAMPLES]
        return {"digest": digest(bits), "counts": dict(sorted(Counter(quantity).items())), "samples": samples}
    values = {name: np.atleast_1d(np.asarray(row, np.float64)) for name, row in quantity.items()}
    values = {name: np.where(np.isnan(row), np.nan, row) for name, row in values.items()}  # NaN has many bits
    bits = b"".join(name.encode() + row.tobytes() for name, row in values.items())
    count = max(1, SAMPLES // len(values))
    return {
        "digest": digest(bits),
        "rows": {name: recorded_row(row, count) for name, row in values.items()},
    }


def digest(bits: bytes) -> str:
    """Returns the digest of bytes, 64 hexadecimal digits."""
    return hashlib.sha256(bits).hexdigest()


def recorded_row(row: np.ndarray, count: int) -> Recorded:
    """Returns about so many samples of a row and, for a longer row, extremes, mean and totals of its finite numbers."""
    if len(row) <= max(count, 2 * BLOCKS):
        return {"samples": row.tolist()}
    finite = row[np.isfinite(row)]
    return {
        "samples": row[:: len(row) // count][:count].tolist(),
        "finite": len(finite),
        "least": finite.min(initial=np.inf),
        "most": finite.max(initial=-np.inf),
        "mean": finite.sum() / max(1, len(finite)),
        "totals": [float(block[np.isfinite(block)].sum()) for block in np.array_split(row, BLOCKS)],
    }


def moved(old: Recorded, new: Recorded, tolerance: float) -> tuple[bool, str]:
    """Tells whether a quantity is within its tolerance, and in words what has moved."""
    if old["digest"] == new["digest"]:
        return True, SAME
    if old.keys() != new.keys() or old.get("rows", {}).keys() != new.get("rows", {}).keys():
        return False, "OTHER ROWS"
    if "counts" in old:
        return False, moved_labels(old, new)
    pairs = [(name, row.get("finite"), new["rows"][name].get("finite")) for name, row in old["rows"].items()]
    for name, then, now in pairs:
        if then != now:
            return False, f"OTHER FINITE NUMBERS in {name}: {then} -> {now}"
    moves = list(moves_of(old["rows"], new["rows"]))
    if not moves:
        return False, "OTHER LENGTHS"
    furthest = max(moves, key=lambda move: move[0])
    apart = {kind: [move[0] for move in moves if move[1] == kind] for kind in ("samples", "totals")}
    counts = ", ".join(
        f"{sum(size > 0 for size in sizes):,} of {len(sizes):,} {kind} moved"
        for kind, sizes in apart.items()
        if sizes
    )
    size, _, name, before, after = furthest
    where = f" in {name}: {before!r} -> {after!r}" if size else ""
    within = size <= tolerance
    limit = f"{'within' if within else 'BEYOND'} {tolerance:g}"
    return within, f"bits differ, {limit}; {counts}, by at most {size:.1e}{where}"


def moved_labels(old: Recorded, new: Recorded) -> str:
    """Returns in words which labels have moved."""
    then, now = old["counts"], new["counts"]
    changes = [
        f"{then.get(label, 0):,} {label} -> {now.get(label, 0):,}"
        for label in sorted(then.keys() | now.keys())
        if then.get(label) != now.get(label)
    ]
    pairs = list(zip(old["samples"], new["samples"], strict=False))
    others = f"{sum(a != b for a, b in pairs)} of {len(pairs)} samples differ"
    return f"MOVED: {', '.join(changes or ['same counts in other places'])}; {others}"


def moves_of(old: Recorded, new: Recorded) -> Iterator[tuple[float, str, str, float, float]]:
    """Yields for each sample and total by how much it moved, its kind, its row, and its numbers then and now."""
    for name, then in old.items():
        now = new[name]
        finite = [abs(value) for value in then["samples"] if np.isfinite(value)]
        if "totals" in then:
            finite += [abs(then["least"]), abs(then["most"])]
        scale = max(finite, default=0.0)
        if len(then["samples"]) == 1:  # a number by itself may be close to zero by chance
            scale = max(scale, 1.0)
        for kind in ("samples", "totals"):
            for before, after in zip(then.get(kind, []), now.get(kind, []), strict=False):
                same = before == after or (before != before and after != after)
                size = 0.0 if same else abs(after - before) / (scale or 1.0)
                yield size if size == size else np.inf, kind, name, before, after


def compare(name: str, old: dict[str, Recorded], new: dict[str, Recorded]) -> list[tuple[bool, str]]:
    """Prints a line per quantity of a part; returns what `moved` says of each."""
    tolerance, verdicts = TOLERANCES[name.partition("/")[0]], []
    for quantity in {**old, **new}:
        if quantity in old and quantity in new:
            verdicts.append(moved(old[quantity], new[quantity], tolerance))
        else:
            verdicts.append((False, "NO LONGER THERE" if quantity in old else "NEW"))
        print(f"{name:24} {quantity:18} {verdicts[-1][1]}", flush=True)
    return verdicts


def text_of(golden: dict[str, dict[str, Recorded]]) -> str:
    """Returns the content of golden.json, a line per row, so that a difference of two versions can be read."""

    def lines(value: Any, depth: int) -> str:
        if depth == 0 or not isinstance(value, dict):
            return json.dumps(value)
        inner = ",\n".join(f"{json.dumps(key)}: {lines(part, depth - 1)}" for key, part in value.items())
        return "{\n" + inner + "\n}"

    return lines(golden, 4) + "\n"


def main(words: list[str] | None = None) -> int:
    """Computes parts and compares them with golden.json; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help=f"how names of parts begin: {', '.join(PARTS)}")
    parser.add_argument("--renew", action="store_true", help="record these parts anew")
    arguments = parser.parse_args(words)
    for given in arguments.names:
        if not any(name.startswith(given) for name in PARTS):
            parser.error(f"{given}: no part's name begins so")
    golden = json.loads(FILE.read_text()) if FILE.exists() else {}
    verdicts = []
    for name, part in PARTS.items():
        if name.startswith(tuple(arguments.names) or ""):
            found = {quantity: recorded(values) for quantity, values in part().items()}
            verdicts += compare(name, golden.get(name, {}), found)
            golden[name] = found
            if arguments.renew:
                FILE.write_text(text_of({name: golden[name] for name in PARTS if name in golden}))
    same, beyond = sum(said == SAME for _, said in verdicts), sum(not within for within, _ in verdicts)
    print(
        f"Of {len(verdicts)} quantities {same} have the same bits, and {beyond} moved beyond their tolerances."
    )
    return int(beyond > 0 and not arguments.renew)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
