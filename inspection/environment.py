"""InspectionEnv: the whole batch of episodes as one set of tensors, with autoreset."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from columns import if_long
from inspection.closed_loop import Clocks, Controller, Hold, Safety, closed_loop, is_multiple
from inspection.fixed import Fixed
from inspection.initial_state import InitialStates
from inspection.model.dynamics import integrate, step
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE
from inspection.observation import normalised
from inspection.privileged import privileged
from inspection.reward import REWARDS, rewards, shaping
from inspection.sight import ALL, Sight
from inspection.termination import ends, failures, outcome_of
from inspection.transition import Transition
from inspection.world.basilisk import BasiliskPlant
from inspection.world.parameters import PlantParameters
from inspection.world.plant import Plant
from precision import in_full_precision

# Compiles a function by one column's examples for about `batch` columns, with loops over an axis of length `long`.
Compiler = Callable[..., Callable[..., list[Tensor]]]


def clocks_of(
    c: InspectionParameters,
    filter_period: float | None,
    decide_every: float | None = None,
    report_every: float | None = None,
) -> Clocks:
    """Returns the clocks of an `InspectionEnv` behind a filter of the given period.

    The chief is looked at every action period. Failures are checked after every integration step.
    """
    every = c.action_period
    report = report_every or min(c.substep, decide_every or every, filter_period or every)
    return Clocks(decide_every or every, report, c.substep, filter_period, look=every)


class InspectionEnv(Fixed):
    """Runs a batch of inspection episodes.

    Seed k owns the columns k E to (k+1) E, and all its draws come from generators[k]. So its episodes do not depend on
    how many other seeds run beside it. The arguments cannot be changed later.

    Args:
        num_envs: episodes per seed, E.
        parameters: the task's constants.
        generators: one per seed, on the device of the batch.
        safety: constraint values, admissible initial states and the control filter.
        decide_every: s between two decisions of a controller; None: the action period.
        report_every: the longest time in s between two reported holds; None: the plant's step.
        plant: the plant's differences from `parameters`; None: none.
        target: the chief; None: the paper's.
        privileged: observations also hold what a critic is shown, see `inspection.privileged`.

    Attributes:
        x: true states (16, B); time: (B,) s, since the episodes began.
        sight: what has been seen of the chief.
        clocks: the periods of the closed loop.
        plant: the plants of the episodes; None: the model.
        progress: share of training that is done, see `reward.shaping`.

    Raises:
        ValueError: the clocks do not divide, or the plant does not fit the parameters.
    """

    FIXED = ("c", "safety", "clocks", "plant", "sight", "num_envs", "privileged", "limit")

    @in_full_precision
    def __init__(
        self,
        num_envs: int,
        parameters: InspectionParameters,
        generators: Sequence[torch.Generator],
        safety: Safety | None = None,
        decide_every: float | None = None,
        report_every: float | None = None,
        plant: PlantParameters | None = None,
        target: ChiefParameters | None = None,
        privileged: bool = False,
    ) -> None:
        self.c, self.safety = parameters, safety or Safety()
        filter_period = self.safety.period if self.safety.correct else None
        self.clocks = clocks_of(parameters, filter_period, decide_every, report_every)
        batch, device = num_envs * len(generators), generators[0].device
        # allocated first, so that a batch beyond the memory fails here
        self.x = torch.zeros(SIZE, batch, dtype=torch.float64, device=device)
        made: Plant | None = None
        if plant is not None and not plant.is_nominal:
            kind = BasiliskPlant if plant.simulator == "basilisk" else Plant
            made = kind(plant, parameters, batch, device)
            made.every, made.acts_for = self.clocks.filter or self.clocks.decision, self.clocks.step
        self.plant = made
        target = target or ChiefParameters()
        self.sight = Sight(target, parameters, batch, device)
        numbered = self.plant is not None or target.is_drawn
        self.starts = [
            InitialStates(generator, parameters, self.safety.is_safe, numbered) for generator in generators
        ]
        self.num_envs, self.privileged = num_envs, privileged
        self.limit = self.x.new_tensor(parameters.control_limit)[:, None]
        self.progress = 1.0
        self.time = self.x.new_zeros(batch)
        self.totals = self.x.new_zeros(3, batch)  # reward, delta v, torque
        self.steps = self.x.new_zeros(batch, dtype=torch.int64)
        self.violation_steps = self.steps.new_zeros(len(self.safety.names), batch)
        self.any_violation_steps = self.steps.new_zeros(batch)
        # functions of states column by column, which `compile` replaces
        if self.plant:
            self._integrate = partial(self.plant.integrate, duration=self.clocks.step)
            self._read: Callable[..., Tensor] = self.plant.read
        else:
            self._integrate = partial(integrate, duration=self.clocks.step, c=parameters)
            self._read = partial(step, c=parameters)
        self._normalised = partial(normalised, c=parameters)
        self._values = self.safety.values

    STATE = ("x", "time", "steps", "totals", "violation_steps", "any_violation_steps")

    def _kept(self) -> list[tuple[Any, str]]:
        """Returns the attributes that a resumed run needs, with their owners."""
        return [(part, name) for part in (self, self.sight) for name in part.STATE]

    def state_dict(self) -> dict[str, Any]:
        """Returns all tensors that a resumed run needs, except the states of the generators."""
        own: dict[str, Any] = {name: getattr(part, name).clone() for part, name in self._kept()}
        if self.plant:
            own["plant"] = self.plant.state_dict()
        if self.sight.tumbling:
            own["chief"] = self.sight.tumbling.motion.clone()
        return own | {"pools": [starts.pool.clone() for starts in self.starts]}

    @in_full_precision
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores `state_dict`; raises KeyError or ValueError if it does not fit."""
        for part, name in self._kept():
            own, saved = getattr(part, name), state[name]
            if (own.shape, own.dtype) != (saved.shape, saved.dtype):
                raise ValueError(
                    f"{name} is {saved.dtype} {tuple(saved.shape)}, not {own.dtype} {tuple(own.shape)}"
                )
            setattr(part, name, saved.clone())
        if self.plant:
            self.plant.load_state_dict(state["plant"])
        if self.sight.tumbling:
            self.sight.tumbling.motion = state["chief"].clone()
        for starts, pool in zip(self.starts, state["pools"], strict=True):
            starts.pool = pool.clone()

    @in_full_precision
    def compile(self, compiler: Compiler) -> None:
        """Compiles integration, observation, constraint values, visibility and k-means for about as many episodes.

        Args:
            compiler: such as `kernels.compiled.Compiled`. If it raises, nothing is changed.
        """
        own = {"_normalised": self._compiled(compiler, self._normalised, self.x, *self.sight.observed())}
        if not (self.plant and not self.plant.is_recordable):
            own["_integrate"] = self._compiled(
                compiler, self._integrate, self.x, self.x[:CONTROL_SIZE], *self._bodies
            )
        if not is_multiple(self.clocks.hold, self.clocks.step):
            own["_read"] = self._compiled(
                compiler, self._read, self.x, self.x[:CONTROL_SIZE], *self._bodies, self.time
            )
        if self.safety.values:
            own["_values"] = self._compiled(compiler, self.safety.values, self.x, points=len(self.c.planes))
        self.sight.compile(partial(self._several, compiler), self.x)
        vars(self).update(own)

    def _several(
        self,
        compiler: Compiler,
        function: Callable[..., list[Tensor]],
        *examples: Tensor,
        points: int | None = None,
    ) -> Callable[..., list[Tensor]]:
        """Returns a function compiled for tensors like the examples, with loops over `points` points, None: all."""
        columns = [example[..., :1] for example in examples]
        return compiler(
            function,
            *columns,
            batch=self.time.numel(),
            long=if_long(points or self.sight.points.shape[1]),
        )

    def _compiled(
        self,
        compiler: Compiler,
        function: Callable[..., Tensor],
        *examples: Tensor,
        points: int | None = None,
    ) -> Callable[..., Tensor]:
        """Returns a function with one result compiled for tensors like the examples; `points` as in `_several`."""
        run = self._several(compiler, lambda *tensors: [function(*tensors)], *examples, points=points)
        return lambda *tensors, **times: run(*tensors, **times)[0]

    @in_full_precision
    def reset(
        self, mask: Tensor | None = None, x: Tensor | None = None, priority: Tensor | None = None
    ) -> Tensor:
        """Restarts the episodes where mask (B,) is set, or all; returns observations of all.

        Args:
            x: initial states (16, B) and priority: unit vectors (3, B); None: drawn from the initial distribution. The
                other draws do not depend on these two.
        """
        everyone = torch.ones_like(self.time, dtype=torch.bool)
        self._restart(everyone if mask is None else mask, x, priority)
        return self.observation()

    @in_full_precision
    def start(self, x: Tensor, priority: Tensor, number: Tensor | None = None) -> Tensor:
        """Starts every episode from given states (16, B) and priority vectors (3, B); returns observations.

        Args:
            number: (B,) in [0, 1), from which the episodes' plants and chiefs follow; None: 0.
        """
        number = torch.zeros_like(self.time) if number is None else number
        self._begin(torch.arange(self.time.numel(), device=x.device), x, priority, number)
        return self.observation()

    @property
    def _bodies(self) -> tuple[Tensor, ...]:
        """Returns the tensors that the integration takes beside states and controls."""
        return (self.plant.body,) if self.plant else ()

    @in_full_precision
    def observation(
        self, seen: Tensor | None = None, columns: Tensor | slice = ALL, score: Tensor | None = None
    ) -> Tensor:
        """Returns normalised observations (k, size) float32 of the given columns, by what has been seen so far.

        If the environment is `privileged`, the critic's additional inputs follow.

        Args:
            seen: states (16, B) as they are sensed, which a controller is shown; None: the present ones.
            score: `Sight.score` of the columns, if it is known.
        """
        if seen is None:
            seen = self.plant.sense(self.time, self.x) if self.plant else self.x
        observed = self._normalised(seen[:, columns], *self.sight.observed(columns, score)).T
        if not self.privileged:
            return observed
        known = privileged(self.x[:, columns], *self.sight.left(columns), self.time[columns], self.c)
        return torch.cat((observed, known.T.float()), 1)

    def control(self, action: Tensor) -> Tensor:
        """Returns an action (B, 6) in actuator limits as a control (6, B) in N and N m, clipped to the limits."""
        return action.T.to(self.x.dtype).clamp(-1.0, 1.0) * self.limit

    @in_full_precision
    def step(
        self, command: Tensor | Controller, watch: Callable[[Hold], None] = lambda hold: None
    ) -> Transition:
        """Flies every episode for one action period and restarts the episodes that end.

        Args:
            command: actions (B, 6), thrust and torque in units of the actuators' limits, clipped to [-1, 1] and held;
                or a controller, whose time is 0 s at the beginning.
            watch: is shown every hold of a control.

        Raises:
            ValueError: actions of another shape.
        """
        controller: Controller
        if isinstance(command, Tensor):
            if command.shape != (self.time.numel(), CONTROL_SIZE):
                wanted = (self.time.numel(), CONTROL_SIZE)
                raise ValueError(f"action has shape {tuple(command.shape)}: must be {wanted}")
            desired = self.control(command)
            controller = lambda t, x: desired  # noqa: E731
        else:
            controller = command
        c, before, holds = self.c, self.sight.score(), []
        for hold in self.fly(controller, c.action_period):
            holds.append(hold)
            watch(hold)
        self.x = hold.after
        self.time += c.action_period
        self.steps += 1

        score, h = self.sight.score(), self.constraint_values(self.x)
        violated = h < 0.0
        self.violation_steps += violated
        self.any_violation_steps += violated.any(0)
        # at the end of any of the holds, (16, holds, B)
        failed = failures(torch.stack([hold.after for hold in holds], 1), c)
        ended = {name: each.any(0) for name, each in failed.items()} | ends(score, self.time, c)
        delta_v, torque = effort(holds, self.plant.body[0] if self.plant else c.mass, c)
        terms = rewards(self.x, score - before, delta_v, torque, self.time, ended, c)
        reward = torch.stack([terms[name] for name in REWARDS]).sum(0)
        named = dict(zip(self.safety.names, h, strict=True))
        own = shaping(self.x, named, self._corrected(holds), delta_v, self.progress, c)
        self.totals += torch.stack((reward, delta_v, torque))
        percent = 100.0 * self.any_violation_steps / self.steps
        metrics = torch.stack((score, self.totals[0], self.time, *self.totals[1:], percent))

        terminated = ended["crash"] | ended["out_of_bounds"] | ended["out_of_power"] | ended["success"]
        observation = self.observation(score=score)
        transition = Transition(
            observation=observation,
            final_observation=observation,
            state=self.x,
            inspected=self.sight.inspected.clone(),  # the next look writes into the original
            reward=sum(own.values(), reward),
            reward_terms=terms | own,
            terminated=terminated,
            truncated=ended["timeout"] & ~terminated,
            violated=violated,
            h=h,
            corrections=[hold.correction for hold in holds if hold.correction is not None],
            applied_controls=[hold.applied for hold in holds],
            limit=self.limit,
            outcome=outcome_of(ended),
            metrics=metrics,
            violation_steps=self.violation_steps.clone(),
            steps=self.steps.clone(),
            truths=self._truths(holds),
        )
        fresh = self._restart(transition.done)
        if fresh.numel():
            transition.observation = observation.clone()
            transition.observation[fresh] = self.observation(columns=fresh)
        return transition

    def fly(
        self, controller: Controller, duration: float, x: Tensor | None = None, time: Tensor | None = None
    ) -> Iterator[Hold]:
        """Runs the closed loop for a duration in s, without ends of episodes and without rewards.

        After the last hold of every action period, once it is yielded, the chief is looked at.

        Args:
            x: states (16, B) to fly from at times (B,) in s, without changing the episodes; None: the episodes' states.
        """
        holds = closed_loop(
            self.x if x is None else x,
            controller,
            self.safety.correct,
            self.integrate,
            self.clocks,
            duration,
            self.plant,
            self.time.clone() if time is None else time,
            self.safety.takes_plant_data,
        )
        for hold in holds:
            yield hold
            if x is None and is_multiple(hold.end, self.c.action_period):
                self.sight.look(hold.after, self.time + hold.end)

    @in_full_precision
    def integrate(self, x: Tensor, u: Tensor, seconds: float) -> Tensor:
        """Returns the states (16, B) after u has acted for whole steps of the plant, or for a part of a step."""
        if is_multiple(seconds, self.clocks.step):
            return self._integrate(x, u, *self._bodies, times=round(seconds / self.clocks.step))
        return self._read(x, u, *self._bodies, torch.full_like(x[0], seconds))

    @in_full_precision
    def constraint_values(self, x: Tensor) -> Tensor:
        """Returns constraint values (constraints, B) at states (16, B)."""
        if self._values is None:
            return self.x.new_zeros(self.violation_steps.shape)
        return self._values(x)

    def _restart(self, mask: Tensor, x: Tensor | None = None, priority: Tensor | None = None) -> Tensor:
        """Draws initial conditions where mask (B,) is set, each seed's from its own generator; returns these columns.

        Given states x (16, B) and priority vectors (3, B) replace drawn ones.
        """
        columns = torch.nonzero(mask).flatten()
        counts = torch.bincount(columns // self.num_envs, minlength=len(self.starts)).tolist()
        for starts, own in zip(self.starts, columns.split(counts), strict=True):
            drawn = starts.take(own.numel())  # called for 0, too: supplies that share a sequence stay in step
            if own.numel():
                fixed = (each if each is None else each[:, own] for each in (x, priority))
                states = (a if b is None else b for a, b in zip(drawn[:2], fixed, strict=True))
                self._begin(own, *states, *drawn[2:])
        return columns

    def _begin(self, columns: Tensor, x: Tensor, priority: Tensor, number: Tensor | None = None) -> None:
        """Puts fresh episodes into the given columns."""
        if self.plant:
            self.plant.begin(columns, x, number)
        self.x = self.x.clone()  # the finished step's Transition still holds the old one
        for name in self.STATE:
            getattr(self, name)[..., columns] = 0
        self.x[:, columns] = x
        self.sight.begin(columns, self.x[:, columns], priority, number)

    def _corrected(self, holds: Sequence[Hold]) -> Tensor:
        """Returns the share (B,) of the filter's calls that it corrected; zeros if no reward term needs it."""
        corrected, answered = torch.zeros_like(self.time), torch.zeros_like(self.time)
        for hold in holds if self.c.correction_reward else ():
            if hold.correction is not None:
                intervened = hold.correction.intervened
                answer = torch.ones_like(intervened) if hold.missed is None else ~hold.missed
                answered += answer
                corrected += answer & intervened
        return corrected / answered.clamp(min=1.0)

    def _truths(self, holds: Sequence[Hold]) -> list[tuple[Tensor, Tensor]] | None:
        """Returns `Transition.truths`."""
        if not self.plant:
            return None
        return [
            (~hold.missed, self.constraint_values(hold.state))
            for hold in holds
            if hold.correction is not None and hold.missed is not None
        ]


def effort(holds: Sequence[Hold], mass: Tensor | float, c: InspectionParameters) -> tuple[Tensor, Tensor]:
    """Returns delta v in m/s and mean torque in N m of an action's holds, (B,) each, |F| and |tau| summed over axes."""
    acting = torch.stack([hold.acting for hold in holds]).abs()  # (holds, 6, B)
    thrusts, torques = acting[:, THRUST].sum(1), acting[:, TORQUE].sum(1)
    delta_v, torque_sum = torch.zeros_like(thrusts[0]), torch.zeros_like(torques[0])
    for hold, thrust, torque in zip(holds, thrusts, torques, strict=True):
        delta_v += thrust / mass * hold.seconds
        torque_sum += torque * (hold.seconds / c.action_period)
    return delta_v, torque_sum
