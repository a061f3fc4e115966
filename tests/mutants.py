"""Changes functions of the code in a copy of it, one place at a time, and runs the test that has to fail then.

    python -m tests.mutants [--workers N] [--each N] [--log FILE] [WORDS]

A mutant turns a sign, takes < for <=, drops a clamp, makes a number a tenth larger, or swaps two names. One that the
test finds is killed. One that no test finds survives: either a test is missing, or the change means nothing. The rates
of killed mutants are printed by file. Compare them before and after a change of tests: no rate may fall.

The checkout is left as it is. Each run of a test has a new directory for what is compiled, so that no mutant is hidden
by a library of before.
"""

import argparse
import ast
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
# A file, its functions, and the test that has to find what is changed in them, as of pytest's -k.
FUNCTIONS = """
inspection/model/dynamics.py control_matrix energy_rate euler step temperature_rate | inspection/model/test_dynamics.py
inspection/model/rk4.py rk4_step | inspection/model/test_rk4.py
inspection/model/orbit.py closest_pass free_flight | inspection/model/test_orbit.py
inspection/model/orbit.py clohessy_wiltshire | inspection/model/test_dynamics.py
inspection/model/attitude.py quaternion_rate | inspection/model/test_attitude.py
inspection/model/attitude.py rate_in_hill | inspection/model/test_orbit.py -k inertial_one_turned_back
inspection/model/orbit.py closest_times | rta/test_limits.py -k infimum
inspection/model/draws.py isotropic | inspection/model/test_draws.py
inspection/model/state_checks.py is_state | inspection/model/test_state_checks.py
inspection/chief/points.py in_view nearest_cluster point_weights | inspection/chief/test_points.py
inspection/chief/surface.py light | inspection/chief/test_surface.py
inspection/chief/hull.py clearance planes_of | inspection/chief/test_hull.py
inspection/chief/tumbling.py Tumbling.moved Tumbling.step | inspection/chief/test_tumbling.py -k adaptive
inspection/reward.py distance_from_track orientation rewards | inspection/test_observation_and_reward.py
inspection/observation.py observe | inspection/test_observation_and_reward.py
inspection/termination.py outcome_of | inspection/test_environment.py -k names_the_outcome
inspection/termination.py failures | inspection/test_observation_and_reward.py
inspection/sight.py Sight.update_inspected | inspection/test_environment.py -k observation_points_at
inspection/privileged.py privileged | inspection/test_privileged.py
inspection/environment.py InspectionEnv.step | inspection/test_environment.py
inspection/closed_loop.py Smallest.note closed_loop | inspection/test_closed_loop.py
inspection/initial_state.py sample_initial_state | inspection/test_initial_state.py
inspection/guidance.py target_along_ellipse | inspection/test_guidance.py -k needs_no_thrust
inspection/guidance.py lqr_gain | inspection/test_guidance.py -k riccati
inspection/orbits.py Lead.at | inspection/test_leading_guidance.py -k phase_leads
inspection/world/plant.py Plant.actuate Plant.sense sample_plant | inspection/world/test_plant.py
inspection/world/uncertainty.py Uncertainty.quantised | inspection/world/test_uncertainty.py
rta/limits.py safe_separation dynamic_speed keep_in_zone axial_velocity attitude_exclusion | rta/test_limits.py
rta/limits.py temperature battery angular_velocity root | rta/test_limits.py
rta/paper.py PaperFilter.correct asif barrier_conditions hocbf | rta/test_paper.py
rta/nearest.py nearest_points | rta/test_paper.py
rta/vehicle.py check | rta/test_vehicle.py -k refused
rta/own.py check_value | rta/test_own.py -k refused
rta/beside_hull.py passes safe_separation | rta/test_beside_hull.py
rta/demand.py within_rates | rta/test_filter.py -k within_rates
rta/demand.py in_mid_hold | rta/test_filter.py -k mean_rate
rta/demand.py demanded | rta/test_filter.py -k no_wish or shortened
rta/filter.py SafetyFilter.enforced | rta/test_parameters.py
rta/filter.py SafetyFilter.accepts | rta/test_filter.py -k may_start or psi_is_kept
rta/keep_clear.py is_clear | rta/test_keep_clear.py
rta/check/motion_law.py planned thrust_along | rta/check/test_motion_law.py
rta/check/attitude_law.py rest_deviation slew | rta/check/test_attitude_law.py
rta/check/flight.py attitude_between path | rta/check/test_flight.py
rta/check/terminal_set.py TerminalSet.room hold_error | rta/check/test_terminal.py
rta/check/early_accept.py EarlyAccept.attitude EarlyAccept.motion | rta/check/test_early_accept.py
rta/check/commit.py Check.share | rta/check/test_nominal_check.py -k first_safe_share
rta/check/intersample_bounds.py between clearance | rta/check/test_intersample_bounds.py
rta/check/nominal.py NominalCheck.__init__ | rta/test_filter.py -k clamp
rta/check/commit.py Check.replaced | rta/check/test_nominal_check.py -k fail_later
rta/robust/filter.py RobustFilter.answer RobustFilter.largest_rate | rta/robust/test_robust_filter.py
rta/robust/terminal_set.py RobustTerminalSet.tuned | rta/robust/test_robust_terminal_set.py
rta/robust/error_tube.py between | rta/robust/test_error_tube.py
rta/robust/check.py RobustCheck.with_own | rta/robust/test_robust_motion_check.py -k some_values
rta/robust/motion_check.py may_be_kept | rta/robust/test_robust_motion_check.py -k kept
rta/robust/attitude_constants.py AttitudeConstants.dim | rta/robust/test_robust_attitude_check.py -k heat
rta/robust/attitude_check.py followed hold_bounds law | rta/robust/test_robust_attitude_check.py
rta/fast/program.py concluded scaled | rta/test_filter.py -k fast_program or slack_is
rta/fast/active_set.py begin cholesky kkt_residual stage | rta/fast/test_active_set.py
ppo/gae.py generalized_advantage | ppo/test_gae.py
ppo/learner.py PPO._clip_gradients PPO._loss PPO.update | ppo/test_learner.py
ppo/divergence.py KLPrice.update divergence | ppo/test_divergence.py
ppo/network.py Policy.forward Policy.shaped gaussian_entropy gaussian_log_prob | ppo/test_network.py
ppo/rollout.py as_applied collect | ppo/test_rollout.py
ppo/lagrangian.py Multiplier.update | ppo/test_lagrangian.py
ppo/distributed.py Ranks.share | ppo/test_distributed.py -k shares_cover
kernels/operations/expressions.py evenly_apart | kernels/test_control.py -k one_column_picks
kernels/operations/expressions.py Program.add Program.select | kernels/test_operations.py
kernels/waiting.py refilled straight | kernels/test_control.py -k goes_round or lanes_are
kernels/text.py Body.repeat | kernels/test_control.py -k bits_are or one_column
kernels/operations/scalars.py arithmetic | kernels/test_operations.py
kernels/compiled.py in_shares | kernels/test_compiled.py -k shares_cover
study/flight/summary.py iqm summary_of_runs upper_bound | study/flight/test_summary.py
study/flight/fly.py Calls.hold | study/flight/test_planted.py -k evaluate
study/flight/fly.py Limits.hold | study/verification/test_flight.py
study/verification/tally.py add | study/verification/test_tally.py
study/verification/adversaries.py adversarial | study/verification/test_adversaries.py
study/verification/starts.py states_of | study/verification/test_starts.py
study/training/run.py Run.train | study/training/test_run.py
study/training/adversary.py Adversary.turned | study/training/test_adversary.py -k nearness
study/paper.py measured | study/test_paper.py
interfaces/vector.py VectorInspection6DoF.step | interfaces/test_environment_interface.py
experiments/field.py exposure | experiments/test_field.py
study/training/monitor.py Exposure.__call__ | study/training/test_monitor.py
"""
SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}
BOUNDS = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">")}
CLAMPS = ("clamp", "clip", "maximum", "minimum")
PASSED, FAILED, LATE = 0, 1, -1  # exit codes of pytest, and of a run that took too long
# only a test that ran and failed, or did not end, has killed a mutant
VERDICTS = {PASSED: "survived", FAILED: "killed", LATE: "killed, the test does not end"}
SLOWER, MORE = 4.0, 60.0  # a test may take so many times as long as without a mutant, and so many s more
PYTEST = ("-m", "pytest", "-x", "-rfE", "-p", "no:xdist", "-p", "no:cacheprovider")
ALL = ("-m", "campaign or not campaign")  # of the tests


class Mutant(NamedTuple):
    """Holds a replacement for a part of a file, and the test that must detect it.

    Attributes:
        begin, end: the part's place in the file's text; old, new: the texts.
        test: a file below tests/, and which of its tests, as of pytest's -k.
    """

    path: str
    function: str
    begin: int
    end: int
    old: str
    new: str
    test: str

    def __str__(self) -> str:
        return f"{self.path} {self.function} at {self.begin}: {self.old!r} is {self.new!r}"


def listed() -> Iterator[tuple[str, list[str], str]]:
    """Yields of each line of FUNCTIONS the file, its functions and the test."""
    for line in FUNCTIONS.split("\n"):
        if line:
            place, _, test = line.partition(" | ")
            path, *names = place.split()
            yield path, names, test


def function_in(tree: ast.AST, name: str) -> ast.AST:
    """Returns the function or method of this name; raises LookupError where there is none."""
    for part in name.split("."):
        named = [node for node in ast.iter_child_nodes(tree) if getattr(node, "name", "") == part]
        if len(named) != 1:
            raise LookupError(name)
        (tree,) = named
    return tree


def mutants_of(path: str, name: str, test: str, text: str) -> list[Mutant]:
    """Returns all mutants of a function in a file's text, in the order of their places."""
    lines = [0]
    for line in text.encode().split(b"\n"):
        lines.append(lines[-1] + len(line) + 1)
    code = text.encode()  # ast counts bytes

    def begin(node: ast.expr) -> int:
        return lines[node.lineno - 1] + node.col_offset

    def end(node: ast.expr) -> int:
        assert node.end_lineno and node.end_col_offset is not None
        return lines[node.end_lineno - 1] + node.end_col_offset

    def part(first: int, last: int, new: str) -> Mutant:
        return Mutant(path, name, first, last, code[first:last].decode(), new, test)

    def operator(left: ast.expr, right: ast.expr, pair: tuple[str, str]) -> Mutant:
        place = code.index(pair[0].encode(), end(left), begin(right))
        return part(place, place + len(pair[0]), pair[1])

    found: list[Mutant] = []
    for node in ast.walk(function_in(ast.parse(text), name)):
        if isinstance(node, ast.BinOp) and (signs := SIGNS.get(type(node.op))):
            found.append(operator(node.left, node.right, signs))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            found.append(part(begin(node), begin(node) + 1, ""))
        elif isinstance(node, ast.Compare) and (bounds := BOUNDS.get(type(node.ops[0]))):
            found.append(operator(node.left, node.comparators[0], bounds))
        elif isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
            found.append(part(begin(node), end(node), repr(1.1 * node.value)))
        elif isinstance(node, ast.Call):
            if isinstance(node.func, ast.Attribute) and node.func.attr in CLAMPS:
                if isinstance(node.func.value, ast.Name) and node.func.value.id in ("torch", "np"):
                    first = node.args[0]
                    found.append(part(begin(node), end(node), code[begin(first) : end(first)].decode()))
                else:
                    found.append(part(code.rindex(b".", 0, end(node.func)), end(node), ""))
            names = [each for each in node.args if isinstance(each, ast.Name)]
            if len(names) > 1 and names[0].id != names[1].id:
                one, other = names[:2]
                between = code[end(one) : begin(other)].decode()
                found.append(part(begin(one), end(other), f"{other.id}{between}{one.id}"))
    return sorted(found, key=lambda each: (each.begin, each.end))


def mutants(each: int = 10**9) -> list[Mutant]:
    """Returns at most so many mutants of each function, evenly chosen."""
    chosen = []
    for path, names, test in listed():
        text = (ROOT / path).read_text(encoding="utf-8")
        for name in names:
            every = mutants_of(path, name, test, text)
            count = min(each, len(every))
            chosen += [every[i * len(every) // count] for i in range(count)]
    return chosen


def copy_of_the_code(directory: Path) -> Path:
    """Returns a copy of all files but those that git ignores."""
    command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():  # it may have been deleted and not committed
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, directory / name)
    return directory


@contextmanager
def planted(mutant: Mutant, tree: Path) -> Iterator[None]:
    """Has a copy of the code hold a mutant."""
    path = tree / mutant.path
    code = path.read_bytes()
    assert code[mutant.begin : mutant.end].decode() == mutant.old
    path.write_bytes(code[: mutant.begin] + mutant.new.encode() + code[mutant.end :])
    try:
        yield
    finally:
        path.write_bytes(code)


def tested(test: str, tree: Path, patience: float | None = None) -> tuple[int, float, str]:
    """Runs a test in a copy of the code, for so many s at most; returns exit code, s, and the test that failed.

    No bytecode is kept: a mutant of the same length, planted in the same second, would be taken for the file before.
    """
    file, _, names = test.partition(" -k ")
    command = [sys.executable, *PYTEST, *ALL, f"tests/{file}", *(["-k", names] if names else [])]
    own = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
        environment = os.environ | own | {"RTA_CACHE_DIR": cache}
        try:
            done = subprocess.run(
                command, cwd=tree, env=environment, capture_output=True, text=True, timeout=patience
            )
        except subprocess.TimeoutExpired:
            return LATE, time.perf_counter() - started, ""
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return done.returncode, time.perf_counter() - started, found[1] if found else ""


def key_of(mutant: Mutant) -> str:
    """Returns what tells a mutant from others, and from itself in other code or before other tests."""
    files = ROOT / mutant.path, ROOT / "tests" / mutant.test.partition(" -k ")[0]
    content = str(mutant).encode() + b"".join(path.read_bytes() for path in files)
    return hashlib.sha256(content).hexdigest()[:12]


class Log:
    """Writes the outcome of each mutant as a line on stdout and in a file, from which a stopped run continues."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        lines = path.read_text().splitlines() if path and path.exists() else []
        parts = [line.split("\t") for line in lines]
        self.known = {key: outcome for outcome, _, key, *_ in parts if outcome in VERDICTS.values()}

    def outcome(self, mutant: Mutant) -> str:
        """Returns what a mutant came to; empty where it was not tried."""
        return self.known.get(key_of(mutant), "")

    def note(self, mutant: Mutant, outcome: str, seconds: float, failed: str) -> None:
        """Adds a mutant's line."""
        line = "\t".join((outcome, f"{seconds:.0f} s", key_of(mutant), str(mutant), failed))
        self.known[key_of(mutant)] = outcome
        print(line, flush=True)
        if self.path:
            with self.path.open("a") as file:
                file.write(f"{line}\n")


def tried(group: Sequence[Mutant], tree: Path, log: Log) -> None:
    """Tries mutants that the same test has to find, once it passes without any."""
    code, sound, failed = tested(group[0].test, tree)
    for mutant in group:
        if code != PASSED:
            log.note(mutant, f"no verdict, the test fails without it (exit code {code})", sound, failed)
            continue
        with planted(mutant, tree):
            came, seconds, by = tested(mutant.test, tree, SLOWER * sound + MORE)
        log.note(mutant, VERDICTS.get(came, f"no verdict, exit code {came}"), seconds, by)


def main(arguments: Sequence[str] | None = None) -> None:
    """Tries the mutants that are asked for, and prints the rates of those killed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "words", nargs="?", default="", help="only mutants whose file, function or test has these"
    )
    parser.add_argument("--workers", type=int, default=1, help="tests at once")
    parser.add_argument(
        "--each", type=int, default=10**9, help="mutants of a function at most (default: all)"
    )
    parser.add_argument("--log", type=Path, help="file of outcomes, which a later run goes on with")
    given = parser.parse_args(arguments)
    log = Log(given.log)
    chosen = [mutant for mutant in mutants(given.each) if given.words in f"{mutant}\t{mutant.test}"]
    todo = sorted((mutant for mutant in chosen if not log.outcome(mutant)), key=lambda each: each.test)
    trees: SimpleQueue[Path] = SimpleQueue()
    with tempfile.TemporaryDirectory() as directory:
        for i in range(given.workers):
            trees.put(copy_of_the_code(Path(directory) / str(i)))

        def in_a_tree(group: Sequence[Mutant]) -> None:
            tree = trees.get()
            try:
                tried(group, tree, log)
            finally:
                trees.put(tree)

        groups = [list(group) for _, group in groupby(todo, key=lambda mutant: mutant.test)]
        with ThreadPoolExecutor(given.workers) as workers:
            list(workers.map(in_a_tree, groups))
    every = Counter(mutant.path for mutant in chosen)
    killed = Counter(mutant.path for mutant in chosen if log.outcome(mutant).startswith("killed"))
    for path, count in every.items():
        print(f"{killed[path]:4d} of {count:4d} killed ({killed[path] / count:.0%}) in {path}")
    print(f"{killed.total():4d} of {every.total():4d} killed ({killed.total() / max(1, every.total()):.0%})")


if __name__ == "__main__":
    main()
