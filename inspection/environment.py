"""InspectionEnv: the whole batch of episodes as one set of tensors, with autoreset."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from inspection.chief import points as chief
from inspection.chief.surface import directions, groups, in_view, seen_from, surface
from inspection.chief.tumbling import RATE, Tumbling
from inspection.closed_loop import Clocks, Controller, Correction, Hold, Safety, closed_loop
from inspection.initial_state import InitialStates
from inspection.model.attitude import conjugate, rotate
from inspection.model.draws import uniform
from inspection.model.dynamics import integrate
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, THETA_S, THRUST, TORQUE, P
from inspection.observation import normalised
from inspection.reward import REWARDS, rewards, shaping
from inspection.termination import OUTCOMES, ends, failures
from inspection.world.basilisk import BasiliskPlant
from inspection.world.plant import Plant, PlantParameters
from kernels import Compiled
from kernels.printer import LEAST_LONG

METRICS = ("inspected_score", "reward", "episode_length_s", "delta_v_m_s", "torque_n_m", "violation_percent")


def clocks_of(
    c: InspectionParameters,
    filter_period: float | None,
    decide_every: float | None = None,
    report_every: float | None = None,
) -> Clocks:
    """The clocks of an `InspectionEnv` behind a filter of that period.

    The chief is looked at every action period, and whether an episode failed after every integration step.
    """
    every = c.action_period
    report = report_every or min(c.substep, decide_every or every, filter_period or every)
    return Clocks(decide_every or every, report, c.substep, filter_period, look=every)


@dataclass
class Transition:
    """The outcome of one interaction, before autoreset; tensors over the batch B.

    Attributes:
        observation: (B, size) float32, of the next episode where one ended.
        final_observation: (B, size) float32, of the state that the action led to (terminal where it ended).
        state: (16, B) that the action led to; inspected: (N, B) bool, the points seen by then.
        reward: (B,); reward_terms: what it is the sum of, by name, the nine and those of our own that have a weight.
        terminated, truncated: (B,) bool, true end or time limit; an episode that failed within the step flew on to its
            end.
        violated: (constraints, B) bool at the end of the step.
        corrections: the filter's answers, one per filter call of the step; see `calls`.
        held: (6, B) each control that was applied, in N and N m, all for as long; limit: (6, 1) the actuators' limits.
        outcome: (B,) index into OUTCOMES, -1 while running.
        metrics: (6, B) the episode so far in the order of METRICS.
        violation_steps: (constraints, B) and steps (B,): violated and all steps of the episode so far.
        truths: of each filter call, (B,) bool where it was not missed and (constraints, B) values of the true states;
            None where the plant is the model.
    """

    observation: Tensor
    final_observation: Tensor
    state: Tensor
    inspected: Tensor
    reward: Tensor
    reward_terms: dict[str, Tensor]
    terminated: Tensor
    truncated: Tensor
    violated: Tensor
    corrections: list[Correction]
    held: list[Tensor]
    limit: Tensor
    outcome: Tensor
    metrics: Tensor
    violation_steps: Tensor
    steps: Tensor
    truths: list[tuple[Tensor, Tensor]] | None = None

    def calls(self) -> Iterator[tuple[Any, Tensor, Tensor]]:
        """Each call of the filter: its answer, (B,) bool where it was not missed, (constraints, B) true values."""
        if self.truths is None:
            everyone = torch.ones_like(self.terminated)
            yield from ((correction, everyone, correction.h) for correction in self.corrections)
        else:
            yield from ((each, *truth) for each, truth in zip(self.corrections, self.truths, strict=True))

    @property
    def applied(self) -> Tensor:
        """(B, 6) mean of the controls that were applied, in units of the actuators' limits."""
        return (torch.stack(self.held).mean(0) / self.limit).T

    @property
    def done(self) -> Tensor:
        """(B,) bool: the episode ended."""
        return self.terminated | self.truncated


class InspectionEnv:
    """A batch of inspection episodes.

    Seed k owns the columns k E to (k+1) E, and all draws for them come from generators[k], so that its
    episodes do not depend on how many other seeds run beside it.

    Args:
        num_envs: episodes per seed, E.
        parameters: the task's constants.
        generators: one per seed, on the device of the batch.
        safety: constraint values, admissible starts and the control filter.
        decide_every, report_every: clocks of `fly` in s; None: the action period and the integration step.
        plant: in what the plant differs from `parameters`; None: in nothing.
        target: the chief; None: the paper's.

    Attributes:
        x: true states (16, B); inspected: (N, B) bool; time: (B,) s; priority: (3, B) in the chief's frame.
        tumbling: how the chiefs turn; None: the chief is the paper's, its frame Hill's.
        clocks: how often what happens.
        plant: of each episode; None: the model.

    Raises:
        ValueError: the clocks do not divide, or the plant does not fit the parameters.
    """

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
    ) -> None:
        self.c = parameters
        self.asked_for = decide_every, report_every
        self.clocks = clocks_of(parameters, None, *self.asked_for)
        batch = num_envs * len(generators)
        device = generators[0].device
        differs = plant is not None and not plant.is_nominal
        self.plant = None
        if differs:
            kind = BasiliskPlant if plant.simulator == "basilisk" else Plant
            self.plant = kind(plant, parameters, batch, device)
        self.put_behind(safety or Safety())
        target = target or ChiefParameters()
        self.tumbling = None
        if not target.is_the_papers or "chief" in parameters.observed:
            self.tumbling = Tumbling(target, parameters, batch, device)
        numbered = differs or target.is_drawn
        self.starts = [
            InitialStates(generator, parameters, self.safety.is_safe, numbered) for generator in generators
        ]
        self.num_envs = num_envs
        self.surface = surface(target, parameters, device)
        # k-means in float32 on coordinates rounded to 2^-13 m, which sum exactly in any order
        self.points = (self.surface.points * 2**13).round().div(2**13).float()
        points = self.points.shape[1]
        clusters = chief.max_clusters(self.surface.normals, parameters, self.tumbling is not None)
        self.limit = torch.tensor(parameters.control_limit, dtype=torch.float64, device=device)[:, None]

        def zeros(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
            return torch.zeros(*shape, batch, dtype=dtype, device=device)

        self.x = zeros(SIZE)
        self.priority = zeros(3)
        self.weights = zeros(points)
        self.inspected = zeros(points, dtype=torch.bool)
        self.centres = zeros(3, clusters, dtype=torch.float32)
        self.alive = zeros(clusters, dtype=torch.bool)
        self.uninspected = zeros(3)
        self.time = zeros()
        self.steps = zeros(dtype=torch.int64)
        self.totals = zeros(3)  # reward, delta v, torque
        self.violation_steps = zeros(len(self.safety.names), dtype=torch.int64)
        self.any_violation_steps = zeros(dtype=torch.int64)
        # functions of states column by column, which `compile` replaces
        if self.plant:
            self._integrate = partial(self.plant.integrate, duration=self.clocks.step)
        else:
            self._integrate = partial(integrate, duration=self.clocks.step, c=parameters)
        self._normalised = partial(normalised, c=parameters)
        self._values = self.safety.values
        see = (
            partial(in_view, self.surface) if self.tumbling else partial(chief.in_view, self.surface.normals)
        )
        self._in_view = partial(see, c=parameters)
        self._seen = partial(chief.by_chunks, lambda *given: [self._in_view(*given)])
        self._settle = partial(chief.by_chunks, partial(chief.settled, self.points))

    def put_behind(self, safety: Safety) -> None:
        """Has the episodes fly behind another filter of the same constraints.

        Raises ValueError where its clock does not divide the others or would need a shorter integration step.
        """
        clocks = clocks_of(self.c, safety.period if safety.correct else None, *self.asked_for)
        if "_integrate" in vars(self) and clocks.step != self.clocks.step:
            raise ValueError(
                f"a filter every {safety.period:g} s: the simulator takes {self.clocks.step:g} s a step"
            )
        self.safety, self.clocks = safety, clocks
        if self.plant:
            self.plant.every, self.plant.acts_for = clocks.filter or clocks.decision, clocks.hold

    STATE = (
        "x",
        "priority",
        "weights",
        "inspected",
        "centres",
        "alive",
        "uninspected",
        "time",
        "steps",
        "totals",
        "violation_steps",
        "any_violation_steps",
    )

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs beside the generators' states, as tensors."""
        own: dict[str, Any] = {name: getattr(self, name).clone() for name in self.STATE}
        if self.plant:
            own["plant"] = self.plant.state_dict()
        if self.tumbling:
            own["chief"] = self.tumbling.motion.clone()
        return own | {"pools": [starts.pool.clone() for starts in self.starts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores `state_dict`; raises KeyError or ValueError where it does not fit."""
        for name in self.STATE:
            own, saved = getattr(self, name), state[name]
            if (own.shape, own.dtype) != (saved.shape, saved.dtype):
                raise ValueError(
                    f"{name} is {saved.dtype} {tuple(saved.shape)}, not {own.dtype} {tuple(own.shape)}"
                )
            setattr(self, name, saved.clone())
        if self.plant:
            self.plant.load_state_dict(state["plant"])
        if self.tumbling:
            self.tumbling.motion = state["chief"].clone()
        for starts, pool in zip(self.starts, state["pools"], strict=True):
            starts.pool = pool.clone()

    def compile(self) -> None:
        """Compiles integration, observation, constraint values, visibility and k-means for about as many episodes.

        Raises as `Compiled`, and changes nothing then.
        """
        state = self.x, self._towards_priority, self.uninspected, self.time, *self._chiefs(slice(None))
        own = {"_normalised": self._compiled(self._normalised, *state)}
        if not (self.plant and not self.plant.is_traceable):
            own["_integrate"] = self._compiled(self._integrate, self.x, self.x[:CONTROL_SIZE], *self._bodies)
        if self.safety.values:
            own["_values"] = self._compiled(self.safety.values, self.x, points=len(self.c.planes))
        own["_seen"] = self._looking(self.x, *self._frames(slice(None)))
        settle = self._several(partial(chief.lloyd, self.points), self.centres, self.inspected, self.alive)
        own["_settle"] = partial(settle, times=chief.LLOYD_ITERATIONS)
        vars(self).update(own)

    def _looking(self, *examples: Tensor) -> Callable[..., list[Tensor]]:
        """What sees the points, compiled for tensors like the examples; of a mesh, each group of points by itself."""
        if not self.tumbling:
            return self._several(lambda *given: [self._in_view(*given)], *examples)
        where = self._several(lambda *given: [directions(*given)], *examples)
        runs = []
        for part, count in groups(self.surface, LEAST_LONG):
            points = len(part.areas)
            run = self._several(
                lambda seen, part=part: [seen_from(part, seen, self.c)], *where(*examples), points=points
            )
            runs.append((run, count))

        def look(*given: Tensor) -> list[Tensor]:
            seen = where(*given)
            return [torch.cat([run(*seen)[0][:, :count] for run, count in runs], 1)]

        return look

    def _several(
        self, function: Callable[..., list[Tensor]], *examples: Tensor, points: int | None = None
    ) -> Compiled:
        """A function compiled for tensors like the examples, with loops over so many points, None: all of them."""
        columns = [example[..., :1] for example in examples]
        return Compiled(function, *columns, batch=self.time.numel(), long=points or self.points.shape[1])

    def _compiled(
        self, function: Callable[..., Tensor], *examples: Tensor, points: int | None = None
    ) -> Callable[..., Tensor]:
        """A function to one tensor, compiled for tensors like the examples; `points` as of `_several`."""
        run = self._several(lambda *tensors: [function(*tensors)], *examples, points=points)
        return lambda *tensors, **times: run(*tensors, **times)[0]

    @property
    def score(self) -> Tensor:
        """w_p, inspected weight (B,)."""
        return self._score(slice(None))

    def _score(self, columns: Tensor | slice) -> Tensor:
        """w_p (k,) of the given columns."""
        return torch.where(self.inspected[:, columns], self.weights[:, columns], 0.0).sum(0)

    def reset(self) -> Tensor:
        """Starts every episode anew from the initial distribution; returns observations."""
        self._restart(torch.ones_like(self.time, dtype=torch.bool))
        return self.observation()

    def start(self, x: Tensor, priority: Tensor, number: Tensor | None = None) -> Tensor:
        """Starts every episode from given states (16, B) and priority vectors (3, B); returns observations.

        Args:
            number: (B,) in [0, 1), from which the episodes' plants follow; None: the first ones of the seeds, by
                episode, the same at every call and on every device.
        """
        if (self.plant or self.tumbling) and number is None:
            seeds = [torch.Generator().manual_seed(starts.generator.initial_seed()) for starts in self.starts]
            number = torch.cat([uniform(0.0, 1.0, self.num_envs, seed) for seed in seeds]).to(x.device)
        self._begin(torch.arange(self.time.numel(), device=x.device), x, priority, number)
        return self.observation()

    @property
    def seen(self) -> Tensor:
        """What agent and filter take the present states for, (16, B)."""
        return self.plant.sense(self.time, self.x) if self.plant else self.x

    @property
    def _bodies(self) -> tuple[Tensor, ...]:
        """What the integration takes beside states and controls."""
        return (self.plant.body,) if self.plant else ()

    def observation(self) -> Tensor:
        """Normalised observations (B, size) float32 of the present states as they are seen."""
        return self._observe(slice(None), self.score)

    def _observe(self, columns: Tensor | slice, score: Tensor) -> Tensor:
        """Observations (k, size) of the given columns, whose inspected weights are score (k,)."""
        state = (part[:, columns] for part in (self.seen, self._towards_priority, self.uninspected))
        return self._normalised(*state, score, *self._chiefs(columns)).T

    @property
    def _towards_priority(self) -> Tensor:
        """Priority vectors (3, B) in Hill's frame."""
        return rotate(self.tumbling.attitude, self.priority) if self.tumbling else self.priority

    def _frames(self, columns: Tensor | slice) -> tuple[Tensor, ...]:
        """The attitude (4, k) of the given chiefs, if it is not Hill's frame."""
        return (self.tumbling.attitude[:, columns],) if self.tumbling else ()

    def _chiefs(self, columns: Tensor | slice) -> tuple[Tensor, ...]:
        """Attitude and rate (7, k) of the given chiefs, if they are observed."""
        return (self.tumbling.motion[: RATE.stop, columns],) if "chief" in self.c.observed else ()

    def step(self, action: Tensor) -> Transition:
        """Holds one action for one action period.

        Args:
            action: (B, 6), thrust and torque in units of the actuators' limits; clipped to [-1, 1].

        Raises:
            ValueError: wrong shape.
        """
        if action.shape != (self.time.numel(), CONTROL_SIZE):
            raise ValueError(
                f"action has shape {tuple(action.shape)}: must be ({self.time.numel()}, {CONTROL_SIZE})"
            )
        desired = self.control(action)
        return self.advance(lambda t, x: desired)

    def control(self, action: Tensor) -> Tensor:
        """An action (B, 6) in units of the actuators' limits as a control (6, B) in N and N m, clipped to them."""
        return action.T.to(self.x.dtype).clamp(-1.0, 1.0) * self.limit

    def advance(
        self, controller: Controller, watch: Callable[[Hold], None] = lambda hold: None
    ) -> Transition:
        """Flies every episode for one action period, at whose beginning the controller's time is 0 s.

        Args:
            watch: is shown every hold of a control.
        """
        c = self.c
        corrections: list[Correction] = []
        truths: list[tuple[Tensor, Tensor]] = []
        mass = self.plant.mass if self.plant else c.mass
        delta_v, torque, corrected, answered = (torch.zeros_like(self.time) for _ in range(4))
        held: list[Tensor] = []
        flown: list[Hold] = []
        for hold in self.fly(controller, c.action_period):
            if hold.correction is not None:
                corrections.append(hold.correction)
                if c.correction_reward:
                    answer = (
                        ~hold.missed
                        if hold.missed is not None
                        else torch.ones_like(hold.correction.intervened)
                    )
                    answered += answer
                    corrected += answer & hold.correction.intervened
            if hold.correction is not None and hold.missed is not None:
                truths.append((~hold.missed, self.constraint_values(hold.state)))
            held.append(hold.applied)
            flown.append(hold)
            watch(hold)
        acting = torch.stack([each.acting for each in flown]).abs()  # (holds, 6, B)
        for thrust, turn in zip(acting[:, THRUST].sum(1), acting[:, TORQUE].sum(1), strict=True):
            delta_v += thrust / mass * hold.seconds
            torque += turn * (hold.seconds / c.action_period)
        ends_of_holds = torch.stack([each.after for each in flown], 1)  # (16, holds, B)
        failed = {name: each.any(0) for name, each in failures(ends_of_holds, c).items()}
        self.time += c.action_period
        self.steps += 1

        before = self.score
        self.see(hold.after)
        score = self.score
        ended = failed | ends(score, self.time, c)
        terms = rewards(self.x, score - before, delta_v, torque, self.time, ended, c)
        reward = torch.stack([terms[name] for name in REWARDS]).sum(0)
        h = self.constraint_values(self.x)
        named = dict(zip(self.safety.names, h, strict=True))
        own = shaping(self.x, named, corrected / answered.clamp(min=1.0), c)
        self.totals += torch.stack((reward, delta_v, torque))
        violated = self._count(h < 0.0)

        truncated = ended["timeout"]
        terminated = ended["crash"] | ended["out_of_bounds"] | ended["out_of_power"] | ended["success"]
        truncated = truncated & ~terminated
        outcome = torch.full_like(self.steps, -1)
        for i in reversed(range(len(OUTCOMES))):
            outcome[ended[OUTCOMES[i]]] = i
        final_observation = self._observe(slice(None), score)
        transition = Transition(
            observation=final_observation,
            final_observation=final_observation,
            state=self.x,
            inspected=self.inspected.clone(),  # `look` writes in place
            reward=sum(own.values(), reward),
            reward_terms=terms | own,
            terminated=terminated,
            truncated=truncated,
            violated=violated,
            corrections=corrections,
            held=held,
            limit=self.limit,
            outcome=outcome,
            metrics=self._metrics(score),
            violation_steps=self.violation_steps.clone(),
            steps=self.steps.clone(),
            truths=truths if self.plant else None,
        )
        fresh = self._restart(transition.done)
        if fresh.numel():
            transition.observation = final_observation.clone()
            transition.observation[fresh] = self._observe(fresh, self._score(fresh))
        return transition

    def fly(self, controller: Controller, duration: float) -> Iterator[Hold]:
        """`closed_loop` from the present states, by the environment's clocks and behind its filter."""
        return closed_loop(
            self.x,
            controller,
            self.safety.correct,
            self.integrate,
            self.clocks,
            duration,
            self.plant,
            self.time.clone() if self.plant else 0.0,
            self.safety.informed,
        )

    def integrate(self, x: Tensor, u: Tensor, seconds: float) -> Tensor:
        """The states (16, B) after u has acted for some s."""
        return self._integrate(x, u, *self._bodies, times=round(seconds / self.clocks.step))

    def see(self, x: Tensor, seconds: float = 0.0) -> None:
        """Puts every spacecraft into states x (16, B) and looks at the chief from there, unless it has.

        Where x is what a controller in flight is shown, it is put into the true states. `seconds` have passed since the
        episodes' time.
        """
        if self.plant:
            x = self.plant.behind(x)
        if self.tumbling:
            self.tumbling.at(self.time + seconds, x[THETA_S])
        if x is not self.x:
            self.x = x
            self.look()

    def look(self, columns: Tensor | slice = slice(None)) -> None:
        """Marks the points in view and points r_UPS at the nearest cluster of those lit and left."""
        x = self.x[:, columns]
        ((lit, seen),) = self._seen(x, *self._frames(columns))
        inspected = self.inspected[:, columns] | seen
        wanted = lit & ~inspected
        centres, alive = chief.cluster(
            self.points,
            wanted,
            self.centres[..., columns],
            self.alive[:, columns],
            self.c.points_per_cluster,
            self._settle,
        )
        self.inspected[:, columns] = inspected
        self.centres[..., columns] = centres
        self.alive[:, columns] = alive
        if self.tumbling:
            attitude = self.tumbling.attitude[:, columns]
            p = rotate(conjugate(attitude), x[P])
            direction = rotate(attitude, chief.nearest_cluster(centres.to(x.dtype), alive, p))
        else:
            direction = chief.nearest_cluster(centres.to(x.dtype), alive, x[P])
        self.uninspected[:, columns] = direction

    def constraint_values(self, x: Tensor) -> Tensor:
        """Constraint values (constraints, B) at states (16, B)."""
        if self._values is None:
            return self.x.new_zeros(self.violation_steps.shape)
        return self._values(x)

    def _count(self, violated: Tensor) -> Tensor:
        """What is violated (constraints, B) at this step, added to the episode's counts."""
        self.violation_steps += violated
        self.any_violation_steps += violated.any(0)
        return violated

    def _metrics(self, score: Tensor) -> Tensor:
        """(6, B) in the order of METRICS."""
        percent = 100.0 * self.any_violation_steps / self.steps
        return torch.stack((score, self.totals[0], self.time, self.totals[1], self.totals[2], percent))

    def _restart(self, mask: Tensor) -> Tensor:
        """Draws new initial conditions where mask (B,) is set, each seed's from its own generator; returns where."""
        columns = torch.nonzero(mask).flatten()
        counts = torch.bincount(columns // self.num_envs, minlength=len(self.starts)).tolist()
        for starts, own in zip(self.starts, columns.split(counts), strict=True):
            states = starts.take(own.numel())  # none, too: others may be taking theirs
            if own.numel():
                self._begin(own, *states)
        return columns

    def _begin(self, columns: Tensor, x: Tensor, priority: Tensor, number: Tensor | None = None) -> None:
        """Puts fresh episodes into the given columns; points visible at the start count as inspected."""
        if self.plant:
            self.plant.begin(columns, x, number)
        if self.tumbling:
            self.tumbling.begin(columns, number)
        self.x = self.x.clone()  # the finished step's Transition still holds the old one
        for name in self.STATE:
            getattr(self, name)[..., columns] = 0
        self.x[:, columns] = x
        self.priority[:, columns] = priority
        self.weights[:, columns] = chief.point_weights(self.surface.normals, priority, self.surface.areas)
        self.look(columns)
