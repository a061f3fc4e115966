"""An adversary that simulates: candidates pass filter and true plant for some calls, and the worst one is flown."""

import itertools

import torch
from torch import Tensor

from inspection.closed_loop import Smallest
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from inspection.world.corners import CORNER, ENDS, ERRORS, GAINS, MISSED, Recorded
from study.scales import scales
from study.verification.adversaries import GROUPS, Greedy, attacked

CANDIDATES, HORIZON = 24, 3  # defaults
VERTICES = torch.tensor(tuple(itertools.product((-1.0, 1.0), repeat=3)), dtype=torch.float64)  # (8, 3)
# ends of a corner that come from thrust's worst candidate: errors of position and velocity, gains of thrust
OF_THRUST = torch.tensor([end < 6 or GAINS.start <= end < GAINS.start + 3 for end in range(CORNER)])
CHANGES = 0.125  # probability that a candidate flips an end of the corner that it starts from


class Lookahead:
    """Chooses controls as a `Controller` that knows the true states, the plant, its future noise and missed calls.

    At every call, K desired controls per spacecraft are held over H calls of the filter from the true state on. Thrust
    is then taken from the candidate with the smallest h of thrust's constraints, over all checks and in filter calls
    (`study.scales`); torque likewise. The filter's programs for thrust and torque are separate, so that thrust and
    torque can come from different candidates.

    An episode attacks one constraint of thrust and one of torque, or all of a group at once, in turns by the number of
    its column (`attacked`).

    The candidates are the control chosen last, the vertices of both control boxes, and uniformly random controls.

    In a plant with worst errors it is also the plant's `Adversary`. Then it chooses when a state is measured, and a
    candidate also has a corner of the errors for these calls, and says which calls are missed. The corner is the one
    chosen last with some ends flipped, or has the errors of `Greedy` with random gains. Errors of position and velocity
    and gains of thrust come from thrust's candidate, the others from torque's. Whether the call is missed comes from
    either, in turns.

    Args:
        env: the flown environment; its plant is read and not changed.
        tried: an environment with K times as many episodes, the same filter and a plant with the same parameters.
        horizon: H.
        generator, batch, first: numbers are drawn for a whole batch; env has its columns from `first` on.
        greedy: proposes corners and attacks the same constraints; None: no corners are chosen.
    """

    def __init__(
        self,
        env: InspectionEnv,
        tried: InspectionEnv,
        horizon: int,
        generator: torch.Generator,
        batch: int,
        first: int = 0,
        greedy: Greedy | None = None,
    ) -> None:
        self.env, self.tried, self.generator, self.batch, self.first = env, tried, generator, batch, first
        self.greedy, self.horizon, self.period = greedy, horizon, env.safety.period
        self.candidates = tried.time.numel() // env.time.numel()
        self.scale = env.x.new_tensor(scales(env.c, self.period))[:, None]
        column = torch.arange(first, first + env.time.numel(), device=env.x.device)
        self.attacked = attacked(column)
        self.thrust_leads = column // (2 * 8 * 7) % 2 == 0  # changes after all pairs of constraints
        self.last = torch.zeros_like(env.x[:CONTROL_SIZE])
        self.corner = torch.zeros(CORNER, env.time.numel(), dtype=torch.bool, device=env.x.device)

    def __call__(self, t: float, x: Tensor) -> Tensor:
        if self.greedy is None:
            plant = self.env.plant
            self.choose(self.env.time + t, plant.true if plant and x is plant.seen else x)
        return self.last

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """Chooses, and returns which errors are positive, see `Adversary`."""
        self.choose(time, x)
        return self.corner[ERRORS]

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """Returns the gains and whether the call is missed, see `Adversary`."""
        return self.corner[GAINS.start :]

    def choose(self, time: Tensor, x: Tensor) -> None:
        """Chooses the worst candidates at true states x (16, B) at the episodes' time (B,) in s."""
        desired = self.draw()  # (6, K, B)
        corners = self.draw_corners(time, x) if self.greedy else None  # (H, 19, K, B)
        h = self.outcome(time, x, desired, corners).masked_fill(~self.attacked[:, None], torch.inf)
        chosen = [h[rows].amin(0).argmin(0) for rows, _ in GROUPS]

        def of(part: Tensor, worst: Tensor) -> Tensor:
            return part.gather(1, worst.expand(len(part), 1, -1))[:, 0]

        self.last = torch.cat(
            [of(desired[own], worst) for (_, own), worst in zip(GROUPS, chosen, strict=True)]
        )
        if corners is not None:
            thrust, torque = (of(corners[0], worst) for worst in chosen)
            self.corner = torch.where(OF_THRUST.to(x.device)[:, None], thrust, torque)
            self.corner[MISSED] = torch.where(self.thrust_leads, thrust[MISSED], torque[MISSED])

    def draw(self) -> Tensor:
        """Returns the candidates (6, K, B) in N and N m."""
        vertices = VERTICES.to(self.last).T.repeat(2, 1)[..., None].expand(-1, -1, self.last.shape[1])
        count = max(self.candidates - 1 - vertices.shape[1], 0)
        new = (
            torch.cat((vertices, 2.0 * self.random(CONTROL_SIZE, count) - 1.0), 1) * self.env.limit[..., None]
        )
        return torch.cat((self.last[:, None], new), 1)[:, : self.candidates]

    def draw_corners(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns the candidates' corners (H, 19, K, B) bool, the same for all calls except which are missed.

        The first candidate has the corner chosen last. The others use in turns this corner and the greedy errors.
        """
        assert self.greedy
        ends, missed = self.random(ENDS, self.candidates), self.random(self.horizon, self.candidates) < 0.5
        kept = self.corner[:ENDS, None] ^ (ends < CHANGES)
        greedy = ends < 0.5
        greedy[ERRORS] = self.greedy.errors(time, x)[:, None]
        ends = torch.where(torch.arange(self.candidates, device=x.device)[:, None] % 2 == 0, kept, greedy)
        ends[:, 0], missed[:, 0] = self.corner[:ENDS], False
        return torch.cat((ends.expand(self.horizon, -1, -1, -1), missed[:, None]), 1)

    def random(self, *size: int) -> Tensor:
        """Draws numbers (*size, B) in [0, 1) for a whole batch; returns those of this environment's columns."""
        numbers = torch.rand(*size, self.batch, generator=self.generator, dtype=torch.float64)
        return numbers[..., self.first : self.first + self.last.shape[1]].to(self.last)

    def outcome(self, time: Tensor, x: Tensor, desired: Tensor, corners: Tensor | None = None) -> Tensor:
        """Returns the smallest h (constraints, K, B) in filter calls, over the checks after x (16, B) at time (B,)."""
        env, tried, control = self.env, self.tried, desired.flatten(1)
        x, time = x.repeat(1, self.candidates), time.repeat(self.candidates)
        if env.plant and tried.plant:
            state = env.plant.state_dict()  # the last axes are the episodes
            tried.plant.load_state_dict(
                {name: part.repeat(*(1,) * (part.dim() - 1), self.candidates) for name, part in state.items()}
            )
            if corners is not None:
                tried.plant.adversary = Recorded(corners.flatten(2), self.period, time[0].item())
        smallest = Smallest(len(self.scale), x)
        for hold in tried.fly(lambda _, seen: control, self.horizon * self.period, x, time):
            smallest.note(tried.constraint_values(hold.after))
        return (smallest.value / self.scale).unflatten(1, desired.shape[1:])
