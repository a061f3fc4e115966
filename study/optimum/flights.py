"""Flights of given cases for a given time in the simulator itself, and what came of them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from inspection.guidance import limited, look, natural_motion, watch
from inspection.model.attitude import rotate, unit
from inspection.model.dynamics import sun_direction
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, THRUST, P, Q, V
from inspection.orbits import GUIDANCE, Lead, Orbit
from inspection.reward import stays_clear
from study.optimum.motion import held

EVERY = 1.0  # s between decisions
POINTING = 0.1  # rad/s, of the camera's law
TRACKING = 0.02  # rad/s, of the critically damped law that keeps a flight to its plan
TEACHERS = tuple(name for name, orbit in GUIDANCE.items() if orbit.lead)


@dataclass(frozen=True)
class Flown:
    """What came of B flights, until their success or, without it, their end.

    Attributes:
        succeeded, clear: (B,) bool, the score was reached; two days of free flight stay clear of the chief then.
        time: (B,) s.
        delta_v: (B,) m/s, as the task counts it: of thrusts along the body's axes.
        least: (B,) m/s, of the length of the thrust: what it would be if the body's axes were along it.
        score: (B,) the inspected weight.
        worst: (limits, B) the smallest constraint value after any integration step.
        thrust: (K, 3, B) N in Hill's frame, the mean of each action period, to the end of the flight.
    """

    succeeded: Tensor
    clear: Tensor
    time: Tensor
    delta_v: Tensor
    least: Tensor
    score: Tensor
    worst: Tensor
    thrust: Tensor

    @property
    def clean(self) -> Tensor:
        """(B,) bool: succeeded, clear in free flight, and no limit violated after any integration step."""
        return self.succeeded & self.clear & (self.worst >= 0.0).all(0)


@torch.no_grad()
def flown(env: InspectionEnv, controller: Controller, x: Tensor, priority: Tensor, duration: float) -> Flown:
    """Flies from states x (16, B) with priority vectors (3, B) for a duration in s, in the environment's own loop."""
    c = env.c
    env.start(x, priority)
    last = env.sight.score()
    done, clear = torch.zeros_like(last, dtype=torch.bool), torch.zeros_like(last, dtype=torch.bool)
    time, delta_v, least = (torch.zeros_like(last) for _ in range(3))
    worst = env.constraint_values(x)
    mean, thrusts = torch.zeros_like(x[P]), []
    looks = 0
    for hold in env.fly(controller, duration):
        if hold.time >= (looks + 1) * c.action_period:  # the chief has been looked at since the last hold
            looks += 1
            done, clear, last = ended(env, done, clear, hold.state)
            thrusts.append(mean / c.action_period)
            mean = torch.zeros_like(mean)
        force = hold.acting[THRUST]
        running = (~done).to(x.dtype)
        time += running * hold.seconds
        delta_v += running * force.abs().sum(0) / c.mass * hold.seconds
        least += running * force.norm(dim=0) / c.mass * hold.seconds
        worst = torch.where(done, worst, torch.minimum(worst, env.constraint_values(hold.after)))
        mean += rotate(hold.state[Q], force) * hold.seconds
    done, clear, last = ended(env, done, clear, hold.after)
    thrusts.append(mean / c.action_period)
    return Flown(done, clear, time, delta_v, least, last, worst, torch.stack(thrusts))


def ended(env: InspectionEnv, done: Tensor, clear: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Who has succeeded by now, whose free flight from there is clear, and the scores, (B,) each."""
    score = env.sight.score()
    new = (score >= env.c.success_score) & ~done
    return done | new, clear | stays_clear(x, new, env.c), score


def guided(env: InspectionEnv, names: tuple[str, ...], cases: int) -> Controller:
    """The guidance of each name, for as many cases each, which follow one another."""

    def each(values: list[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64).repeat_interleave(cases)

    orbits = [GUIDANCE[name] for name in names]
    leads = [vars(orbit.lead) for orbit in orbits if orbit.lead]
    lead = Lead(**{knob: each([lead[knob] for lead in leads]) for knob in leads[0]})
    knobs = {
        knob: each([vars(orbit)[knob] for orbit in orbits]) for knob in vars(orbits[0]) if knob != "lead"
    }
    orbit = Orbit(**knobs, lead=lead)
    return natural_motion(env.c, EVERY, orbit, env.sight.score)


def planned(start: Tensor, thrust: Tensor, c: InspectionParameters) -> Controller:
    """Follows the flight of thrusts (K, 3, B) in N from (p, v) (6, B), with the attitude of the guidance that leads.

    The body does not roll to the thrust. The controller's own law takes away what turning within a second adds.
    """
    step, push = held(EVERY, c)
    reference, per_action = [start], round(c.action_period / EVERY)
    for force in thrust:
        for _ in range(per_action):
            reference.append(step @ reference[-1] + push @ force)

    def control(t: float, x: Tensor) -> Tensor:
        i = round(t / EVERY)
        off = reference[i] - torch.cat((x[P], x[V]))
        back = c.mass * (TRACKING**2 * off[:3] + 2.0 * TRACKING * off[3:])
        sun = sun_direction(x[THETA_S])
        torque = look(x, watch(x, unit(x[P]), sun, c), sun, c, POINTING)
        return limited(thrust[i // per_action] + back, torque, x, c)

    return control
