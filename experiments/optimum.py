"""Finds how little fuel a known case needs in a given time: the best found, and a certified lower bound.

    python -m experiments.optimum --out runs/reference/optimum

The first common test cases, each by itself and known in advance (experiments/learning_log.md). *Best found*: for each
time many settings of the guidance that leads the Sun are flown, the best of each case are improved by gradients through
the motion, and the outcome is flown in the simulator, with attitude and every limit. *Bound*: a mixed-integer linear
program of the first few of them (`experiments.optimum_bound`). Writes optimum.json and optimum.png; `--draw` only draws
the figure anew, with the agents of runs/reference. Takes an hour on one core.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from torch import Tensor

from experiments.optimum_bound import Task, climbed
from inspection.chief.points import fibonacci_sphere, point_weights
from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.guidance import (
    TILT,
    balanced,
    camera_direction,
    limited,
    natural_motion,
    pointing_torque,
    tilted,
)
from inspection.model.attitude import cross, dot, norm, rotate, unit
from inspection.model.dynamics import sun_direction
from inspection.model.orbit import clohessy_wiltshire, free_flight
from inspection.model.parameters import InspectionParameters, Model
from inspection.model.state import THETA_S, THRUST, P, Q, V
from inspection.orbits import GUIDANCE, Lead, Orbit
from inspection.reward import stays_clear
from settings import Parser, positive_integer
from study.config import ARMS, TEST_CASES, Config
from study.experiment import paper_task, test_cases
from study.files import ROOT, read_json, write_json, writing
from study.flight.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from study.machine import set_threads
from study.paper import PAPER_METRICS

TIMES = (3600.0, 3400.0, 3200.0, 3000.0)  # s, the longest first, whose bounds hold for the shorter ones
LONGEST = 6000.0  # s, that the guidance is given
TEACHERS = tuple(name for name, orbit in GUIDANCE.items() if orbit.lead)
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
HIGHEST = 0.8  # m/s, of a bound; above it `optimum_bound.TOLERANCE` would have to grow
FOUND = "time_s", "delta_v_m_s", "length_m_s"  # of the best flight of a case

# of a flight in the simulator
EVERY = 1.0  # s between decisions
POINTING = 0.1  # rad/s, of the camera's law
TRACKING = 0.02  # rad/s, of the critically damped law that keeps a flight to its plan

# of the search
STEPS = 500  # of Adam
RATE = 4e-5, 1e-6  # N, of Adam at first and at last
SOFT = 5.0, 0.3  # m, in which a point comes to be counted as inspected, at first and at last
SPARE = 0.5  # m above the horizon and its share below: what is asked for beyond the rules
SCORE_SPARE = 0.007
TURNED = 100.0  # s, until the camera is on the chief
TWILIGHT = 30.0  # m per cosine of the angle between the deputy and the Sun
NEAREST = 30.0  # m, from which on the camera, 18 deg off the chief at most, has all of it in view
CLEAR = 2.0  # m beyond the collision radius, of free flight
SLOWER = 0.03  # m/s below the speed limits
SAMPLES = 16  # times of free flight
MISSING, BROKEN = 100.0, 0.02  # prices in m/s, of the score, and of a limit's m or 100 * m/s in one knot


# the deputy's translation as a linear map of its thrust, exact where thrust is held in Hill's frame


def held(seconds: float, c: Model) -> tuple[Tensor, Tensor]:
    """Returns what (p, v) in m and m/s becomes in some s: of itself (6, 6), and of a thrust in N that is held (6, 3).

    The exponential of the system beside its constant input (Van Loan 1978).
    """
    one, whole = torch.eye(6, dtype=torch.float64), torch.zeros(9, 9, dtype=torch.float64)
    whole[:6, :6] = torch.cat((one[3:], torch.stack(clohessy_wiltshire(one[:3], one[3:], c.mean_motion))))
    whole[3:6, 6:] = one[:3, :3] / c.mass
    end = torch.matrix_exp(whole * seconds)
    return end[:6, :6], end[:6, 6:]


def motion(knots: int, seconds: float, c: Model) -> tuple[Tensor, Tensor]:
    """Returns what (p, v) at the knots k T, k = 1..K, is, where thrust is held for T s at a time.

    Returns:
        (K 6, 6), of the (p, v) in m and m/s at the start; (K 6, K 3), of the thrusts in N.
    """
    step, push = held(seconds, c)
    free = [step]
    for _ in range(knots - 1):
        free.append(step @ free[-1])
    answers = torch.cat([push, *(power @ push for power in free[:-1])])  # of one thrust, from its end on
    forced = torch.zeros(6 * knots, 3 * knots, dtype=torch.float64)
    for k in range(knots):
        forced[6 * k :, 3 * k : 3 * k + 3] = answers[: 6 * (knots - k)]
    return torch.cat(free), forced


# the search


class Cases(NamedTuple):
    """B cases of a search, and the motion in them, in float32.

    Attributes:
        start: (6, B), p and v; weights: (N, B); normals: (3, N); suns: (3, K, B), at the knots.
        free, forced: see `motion`.
    """

    start: Tensor
    weights: Tensor
    normals: Tensor
    suns: Tensor
    free: Tensor
    forced: Tensor

    @classmethod
    def of(cls, x: Tensor, priority: Tensor, knots: int, c: InspectionParameters) -> "Cases":
        """Returns the cases of states (16, B) and priority vectors (3, B)."""
        normals = fibonacci_sphere(c.num_points)
        times = torch.arange(1, knots + 1, dtype=x.dtype) * c.action_period
        suns = sun_direction(x[THETA_S] - c.mean_motion * times[:, None])
        found = torch.cat((x[P], x[V])), point_weights(normals, priority), normals, suns
        return cls(*(part.float() for part in (*found, *motion(knots, c.action_period, c))))

    def states(self, thrust: Tensor) -> Tensor:
        """Returns (p, v) at the knots, (K, 6, B), of thrusts (K, 3, B) in N, Hill's frame."""
        return (self.free @ self.start + self.forced @ thrust.flatten(0, 1)).unflatten(0, (-1, 6))


def cost(cases: Cases, thrust: Tensor, c: InspectionParameters, soft: float = 1.0) -> Tensor:
    """Returns m/s (B,) of thrusts (K, 3, B) in N: what is spent, and the prices of what is missing or broken."""
    thrust = thrust.float()
    y = cases.states(thrust)
    p = y[:, :3].transpose(0, 1)
    # the body's axes as the guidance turns them while the battery is full, without its roll to the thrust
    outward = unit(p)
    angle = dot(outward, cases.suns).clamp(-0.9999, 0.9999).arccos()
    camera = tilted(outward, cases.suns, (angle - balanced(c)).clamp(0.0, TILT))
    side = unit(cases.suns - dot(cases.suns, camera) * camera)
    axes = camera, side, torch.stack(cross(camera, side))
    along = torch.stack([dot(axis, thrust.transpose(0, 1)) for axis in axes])
    spent = ((along**2 + 1e-10).sqrt() - 1e-5).sum((0, 1)) * (c.action_period / c.mass)
    return spent + MISSING * missing(p, cases, soft, c) + BROKEN * broken(y, c)


def missing(p: Tensor, cases: Cases, soft: float, c: InspectionParameters) -> Tensor:
    """Returns how much of the wanted score is missing, (B,): a point counts by the best knot (3, K, B) that sees it.

    By the height above its horizon in m; not before the camera has been turned to the chief, and not from the dark,
    where the guidance's law turns it away.
    """
    lit = torch.einsum("in,ikb->nkb", cases.normals, cases.suns) > 0.0
    lit[:, : round(TURNED / c.action_period)] = False
    height = torch.einsum("in,ikb->nkb", cases.normals, p) - c.chief_radius - SPARE
    height = torch.minimum(height, TWILIGHT * dot(unit(p), cases.suns))
    best = height.masked_fill(~lit, -1e3).amax(1)
    score = (cases.weights * torch.sigmoid(best / soft)).sum(0)
    return (c.success_score + SCORE_SPARE - score).clamp(min=0.0)


def broken(y: Tensor, c: InspectionParameters) -> Tensor:
    """Returns by how much limits are broken at the knots (K, 6, B), in all, (B,): m, and 100 times m/s.

    And 10 times the m that free flight from the last knot comes too near to the chief's track within an orbit.
    """
    p, v = y[:, :3].transpose(0, 1), y[:, 3:].transpose(0, 1)
    distance = norm(p)
    near = (NEAREST - distance).clamp(min=0.0)
    far = (distance - c.max_distance + NEAREST).clamp(min=0.0)
    fast = (norm(v) + SLOWER - c.docking_speed - c.speed_slope * distance).clamp(min=0.0)
    axis = (v.abs().amax(0) + SLOWER - c.max_speed).clamp(min=0.0)
    times = torch.linspace(0.0, c.passive_safety_horizon, SAMPLES, dtype=y.dtype)
    coming = free_flight(p[:, None], v[:, None], times[:, None, None], c.mean_motion)
    passes = (c.collision_radius + CLEAR - norm(coming)).clamp(min=0.0).amax(0)
    times = torch.linspace(0.0, 2 * math.pi / c.mean_motion, 4 * SAMPLES, dtype=y.dtype)
    x, _, z = free_flight(p[:, -1:], v[:, -1:], times[:, None], c.mean_motion)
    drifts = c.collision_radius + CLEAR - (x**2 + z**2 + 1e-6).sqrt().amin(0)
    return (near + far + 100.0 * (fast + axis) + passes).sum(0) + 10.0 * drifts.clamp(min=0.0)


def searched(cases: Cases, thrust: Tensor, c: InspectionParameters, steps: int = STEPS) -> Tensor:
    """Improves thrusts (K, 3, B) in N by so many steps of Adam; a case's do not depend on the others'."""
    thrust = thrust.float().clone().requires_grad_()
    optimiser = torch.optim.Adam([thrust], lr=RATE[0], betas=(0.9, 0.99))
    for i in range(steps):
        rate, soft = (first * (last / first) ** (i / steps) for first, last in (RATE, SOFT))
        optimiser.param_groups[0]["lr"] = rate
        optimiser.zero_grad()
        cost(cases, thrust, c, soft).sum().backward()
        optimiser.step()
        with torch.no_grad():
            # along any axis of the body still below the limit
            thrust.clamp_(-c.max_thrust / 2, c.max_thrust / 2)
    return thrust.detach().double()


# flights in the simulator


class Flown(NamedTuple):
    """What came of B flights, until their success or, without it, their end.

    Attributes:
        succeeded: (B,) bool, the score was reached.
        clean: (B,) bool, and two days of free flight stay clear of the chief then, and no limit was violated after any
            integration step.
        time: (B,) s.
        delta_v: (B,) m/s, as the task counts it: of thrusts along the body's axes.
        length: (B,) m/s, of the length of the thrust: what it would be if the body's axes were along it.
        thrust: (K, 3, B) N in Hill's frame, the mean of each action period, to the end of the flight.
    """

    succeeded: Tensor
    clean: Tensor
    time: Tensor
    delta_v: Tensor
    length: Tensor
    thrust: Tensor


@torch.no_grad()
def flown(env: InspectionEnv, controller: Controller, x: Tensor, priority: Tensor, duration: float) -> Flown:
    """Flies from states x (16, B) with priority vectors (3, B) for a duration in s, in the environment's own loop."""
    c = env.c
    env.start(x, priority)
    done, clear = torch.zeros(2, x.shape[1], dtype=torch.bool)
    time, delta_v, length = torch.zeros(3, x.shape[1], dtype=x.dtype)
    within = (env.constraint_values(x) >= 0.0).all(0)
    mean, thrusts = torch.zeros_like(x[P]), []

    def looked(x: Tensor) -> None:
        """Notes who has succeeded by now, and ends an action period."""
        new = (env.sight.score() >= c.success_score) & ~done
        clear.logical_or_(stays_clear(x, new, c))
        done.logical_or_(new)
        thrusts.append(mean / c.action_period)
        mean.zero_()

    for hold in env.fly(controller, duration):
        if (
            hold.time >= (len(thrusts) + 1) * c.action_period
        ):  # the chief has been looked at since the last hold
            looked(hold.state)
        force = hold.acting[THRUST]
        running = (~done).to(x.dtype)
        time += running * hold.seconds
        delta_v += running * force.abs().sum(0) / c.mass * hold.seconds
        length += running * force.norm(dim=0) / c.mass * hold.seconds
        within &= done | (env.constraint_values(hold.after) >= 0.0).all(0)
        mean += rotate(hold.state[Q], force) * hold.seconds
    looked(hold.after)
    return Flown(done, done & clear & within, time, delta_v, length, torch.stack(thrusts))


def planned(start: Tensor, thrust: Tensor, c: InspectionParameters) -> Controller:
    """Follows the flight of thrusts (K, 3, B) in N from (p, v) (6, B), with the attitude of the guidance that leads.

    The body does not roll to the thrust. The controller's own law takes away what turning within a second adds.
    """
    step, push = held(EVERY, c)
    reference, per_action = [start], round(c.action_period / EVERY)
    for force in thrust.repeat_interleave(per_action, 0):
        reference.append(step @ reference[-1] + push @ force)

    def control(t: float, x: Tensor) -> Tensor:
        i = round(t / EVERY)
        off = reference[i] - torch.cat((x[P], x[V]))
        back = c.mass * (TRACKING**2 * off[:3] + 2.0 * TRACKING * off[3:])
        sun = sun_direction(x[THETA_S])
        torque = pointing_torque(x, camera_direction(x, unit(x[P]), sun, c), sun, c, POINTING)
        return limited(thrust[i // per_action] + back, torque, x, c)

    return control


# the program


def begun(x: Tensor, priority: Tensor, settings: int) -> Tensor:
    """Flies random settings of the guidance, each in all cases, to TIMES[0]: thrusts (K, 3, settings x B) in N."""
    cases = x.shape[1]
    _, env = paper_task(settings * cases, SEED)
    draws = torch.tensor(np.random.default_rng(SEED).random((settings, len(KNOBS))))
    low, high = torch.tensor(list(KNOBS.values()), dtype=torch.float64).T
    ratio = torch.tensor([name in RATIOS for name in KNOBS])
    drawn = torch.where(ratio, low * (high / low) ** draws, low + draws * (high - low)).T
    knobs = dict(zip(KNOBS, drawn.repeat_interleave(cases, 1), strict=True))
    lead = Lead(**{name: knobs.pop(name) for name in vars(Lead(0.0, 0.0))})
    guidance = natural_motion(env.c, env.c.action_period, Orbit(**knobs, lead=lead), env.sight.score)
    return flown(env, guidance, x.repeat(1, settings), priority.repeat(1, settings), TIMES[0]).thrust


def best_starts(thrust: Tensor, x: Tensor, priority: Tensor, kept: int) -> Tensor:
    """Returns, of thrusts (K, 3, settings x B), those of the `kept` best settings of each case, (K, 3, kept x B)."""
    c, count = Config().inspection, x.shape[1]
    losses = []
    for part in thrust.split(AT_ONCE // count * count, -1):
        settings = part.shape[-1] // count
        cases = Cases.of(x.repeat(1, settings), priority.repeat(1, settings), len(thrust), c)
        losses.append(cost(cases, part, c).view(settings, count))
    best = torch.cat(losses).argsort(0)[:kept]
    return thrust[..., (best * count + torch.arange(count)).flatten()]


def summary(found: Flown, cases: int) -> dict[str, Any]:
    """Returns, of the flights of each case, the clean one with the least delta v; None where there is none."""
    fuel = torch.where(found.clean, found.delta_v, math.inf).view(-1, cases)
    best = fuel.argmin(0) * cases + torch.arange(cases)
    chosen = torch.stack((found.time, found.delta_v, found.length))[:, best].tolist()
    clean = found.clean[best].tolist()
    return {
        name: [round(value, 6) if ok else None for value, ok in zip(values, clean, strict=True)]
        for name, values in zip(FOUND, chosen, strict=True)
    } | {
        "flights": found.clean.numel(),
        "clean_flights": int(found.clean.sum()),
        "succeeded_flights": int(found.succeeded.sum()),
    }


def best_found(x: Tensor, priority: Tensor, steps: int) -> list[dict[str, Any]]:
    """Searches the best flights of each time."""
    found, thrust = [], begun(x, priority, SETTINGS)
    for time in TIMES:
        _, env = paper_task(KEPT * x.shape[1], SEED, decide_every=EVERY)
        first = best_starts(thrust[: round(time / env.c.action_period)], x, priority, KEPT)
        states, priorities = x.repeat(1, KEPT), priority.repeat(1, KEPT)
        plan = searched(Cases.of(states, priorities, len(first), env.c), first, env.c, steps)
        start = torch.cat((states[P], states[V]))
        flights = flown(env, planned(start, plan, env.c), states, priorities, time)
        found.append({"allowed_s": time} | summary(flights, x.shape[1]))
        print(f"{time:,.0f} s: {found[-1]['clean_flights']} of {flights.time.numel()} clean", flush=True)
    return found


def cheapest(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the same with each case's cheapest flight that takes no longer than a time, also of the shorter times."""
    rows = []
    for flights in found:
        row = flights | {name: list(flights[name]) for name in FOUND}
        for case in range(len(flights["time_s"])):
            within = [each for each in found if each["allowed_s"] <= flights["allowed_s"]]
            flying = [each for each in within if each["delta_v_m_s"][case] is not None]
            best = min(flying, key=lambda each: each["delta_v_m_s"][case], default=flights)
            for name in FOUND:
                row[name][case] = best[name][case]
        rows.append(row)
    return rows


def bounds(x: Tensor, priority: Tensor, best: list[dict[str, Any]], count: int, seconds: float) -> None:
    """Adds lower bounds of the first `count` cases to each time's best flights, "bound_m_s"."""
    for flights in best:
        flights["bound_m_s"] = []
    for case in range(count):
        task, proven = Task.of(x[:, case], priority[:, case], Config().inspection), 0.0
        for flights in best:
            most = min(flights["length_m_s"][case] or math.inf, HIGHEST)
            proven = climbed(task, flights["allowed_s"], proven, seconds, most)
            flights["bound_m_s"].append(math.floor(proven * 1e6) / 1e6)
            print(f"{flights['allowed_s']:,.0f} s, case {case}: at least {proven:.3f} m/s", flush=True)


def guided(x: Tensor, priority: Tensor) -> dict[str, Any]:
    """Returns what the guidance by its names needs in the same cases."""
    found = {}
    for name in TEACHERS:
        _, env = paper_task(x.shape[1], SEED, decide_every=EVERY)
        guidance = natural_motion(env.c, EVERY, GUIDANCE[name], env.sight.score)
        flights = flown(env, guidance, x, priority, LONGEST)
        found[name] = {
            "time_s": flights.time.tolist(),
            "delta_v_m_s": [round(value, 6) for value in flights.delta_v.tolist()],
            "clean": int(flights.clean.sum()),
        }
    return found


def draw(found: dict[str, Any], path: Path) -> None:
    """Draws the content of optimum.json: time against fuel, with the shipped agents and guidance."""

    def shipped(name: str) -> Any:
        return read_json(ROOT / "runs/reference" / name, "results of a study")

    def middle(results: dict[str, Any]) -> list[float]:
        return [results["metrics"][name]["iqm"] for name in ("episode_length_s", "delta_v_m_s")]

    def means(rows: Any) -> list[tuple[float, float]]:
        return [tuple(np.mean([row[name][case] for case in cases]) for name in FOUND[:2]) for row in rows]

    axis = (drawn := Figure(figsize=(8, 6), layout="constrained")).subplots()
    times = found["times"]
    fuel = zip(*(flights["delta_v_m_s"] for flights in times), strict=True)
    cases = [
        case for case, of_case in enumerate(fuel) if None not in of_case
    ]  # those that were solved in all times
    taught = [
        *shipped("teachers/results.json")["arms"].values(),
        shipped("study/results.json")["arms"]["rta"],
    ]
    bounded = [case for case in cases if case < len(times[0]["bound_m_s"])]
    proven = [(row["allowed_s"], np.mean([row["bound_m_s"][case] for case in bounded])) for row in times]
    led = shipped("from_nothing/report/front.json").values()
    lines = [
        (map(middle, taught), "D-", SKY, "agents taught by the guidance, with RTA"),
        (map(middle, led), "o--", BLUE, "guidance that leads the Sun, the same cases"),
        (means(found["guidance"].values()), "o-", BLUE, "guidance, the cases of the best found"),
        (means(times), "o-", GREEN, "best found, case known in advance"),
        (proven, "v--", RED, "nobody needs less: proven"),
    ]
    for arm, marker, name in zip(ARMS, "sD", ("without RTA", "with RTA"), strict=True):
        papers = [PAPER_METRICS[metric].by_arm[arm].value for metric in ("episode_length_s", "delta_v_m_s")]
        lines.append(([papers], marker, GREY, f"the paper's agents, {name}"))
        for study, colour, learner in (
            ("our_learner", PURPLE, "our learner, the paper's task"),
            ("from_nothing", ORANGE, "ours, from nothing"),
        ):
            agents = shipped(f"{study}/results.json")["arms"][arm]
            lines.append(([middle(agents)], marker, colour, f"{learner}, {name}"))
    long = middle(shipped("long/results.json")["arms"]["rta"])
    lines.append(([long], "*", ORANGE, "ours, with RTA, one seed, ten times as long"))
    for points, style, colour, label in lines:
        axis.plot(*zip(*points, strict=True), style, color=colour, label=label, ms=8 if style in "sD*" else 5)
    axis.set(xlabel="time to success (s)", ylabel="delta v (m/s), logarithmic", yscale="log")
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axis.set_yticks([0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0])
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)
    drawn.legend(fontsize=9, loc="outside lower center", ncols=2)
    with writing(path) as file:
        drawn.savefig(file, dpi=100, format="png")


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m experiments.optimum", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="directory for optimum.json and optimum.png")
    parser.add_argument("--cases", type=positive_integer, default=20, help="that are flown (default: 20)")
    parser.add_argument("--bounded", type=positive_integer, default=8, help="of them (default: 8)")
    parser.add_argument("--steps", type=positive_integer, default=STEPS, help=f"of Adam (default: {STEPS})")
    parser.add_argument("--rung", type=float, default=30.0, help="s of a proof at most (default: 30)")
    parser.add_argument("--draw", action="store_true", help="only draw optimum.json anew")
    given = parser.parse_args(argv)
    set_threads(None)
    path = given.out / "optimum.json"
    if not given.draw:
        given.out.mkdir(parents=True, exist_ok=True)
        x, priority, _ = test_cases(Config(), given.cases, TEST_CASES)
        best = cheapest(best_found(x, priority, given.steps))
        bounds(x, priority, best, min(given.bounded, given.cases), given.rung)
        about = {
            "cases": given.cases,
            "seed": TEST_CASES,
            "starts": SETTINGS,
            "kept": KEPT,
            "steps": given.steps,
        }
        write_json(path, about | {"times": best, "guidance": guided(x, priority)})
    draw(read_json(path, "flights"), given.out / "optimum.png")


if __name__ == "__main__":
    main()
