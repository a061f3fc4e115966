"""The adversary that tries: candidates go through the filter and the true plant for some calls, the worst is flown."""

import itertools

import torch
from torch import Tensor

from inspection.closed_loop import Smallest
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE, THRUST, TORQUE
from rta.constraints.constraint import ATTITUDE, TRANSLATIONAL
from study.scales import scales

CANDIDATES, HORIZON = 24, 3  # by default
# Rows of the constraints by who holds them, and the controls of theirs.
GROUPS = (
    (slice(0, len(TRANSLATIONAL)), THRUST),
    (slice(len(TRANSLATIONAL), len(TRANSLATIONAL) + len(ATTITUDE)), TORQUE),
)
VERTICES = torch.tensor(tuple(itertools.product((-1.0, 1.0), repeat=3)), dtype=torch.float64)  # (8, 3)


class Lookahead:
    """A `Controller` that knows the true states, the plant, its noise to come and the calls that will be missed.

    At every call K desired controls per spacecraft are held over H calls of the filter from the true state on. Thrust
    is then that of the candidate by which the smallest h of thrust's constraints, over all these checks and in filter
    calls (`study.scales`), becomes smallest; torque likewise. Programs of thrust and of torque are apart,
    so that neither has to wait for the other.

    What an episode attacks: one constraint of thrust and one of torque, or all of a group at once, in turns by the
    number of its column. A body rate is at its limit within seconds and would else be all that is attacked.

    The candidates are the control last chosen, the vertices of both boxes, and uniformly random ones.

    Args:
        env: that is flown; its plant is read and left as it is.
        tried: of K times as many episodes, behind the same filter and in a plant of the same parameters.
        horizon: H.
        generator, batch, first: numbers are drawn for a whole batch, of which env has the columns from `first` on.
    """

    def __init__(
        self,
        env: InspectionEnv,
        tried: InspectionEnv,
        horizon: int,
        generator: torch.Generator,
        batch: int,
        first: int = 0,
    ) -> None:
        self.env, self.tried, self.generator, self.batch, self.first = env, tried, generator, batch, first
        period = env.safety.period
        self.duration = horizon * period
        self.candidates = tried.time.numel() // env.time.numel()
        self.scale = env.x.new_tensor(scales(env.c, period))[:, None]
        self.attacked = attacked(torch.arange(first, first + env.time.numel(), device=env.x.device))
        self.last = torch.zeros_like(env.x[:CONTROL_SIZE])

    def __call__(self, t: float, x: Tensor) -> Tensor:
        desired = self.draw()  # (6, K, B)
        h = self.outcome(t, self.env.plant.behind(x) if self.env.plant else x, desired)
        h = h.masked_fill(~self.attacked[:, None], torch.inf)
        chosen = [h[rows].amin(0).argmin(0).expand(3, 1, -1) for rows, _ in GROUPS]
        parts = [
            desired[controls].gather(1, worst)[:, 0]
            for (_, controls), worst in zip(GROUPS, chosen, strict=True)
        ]
        self.last = torch.cat(parts)
        return self.last

    def draw(self) -> Tensor:
        """The candidates (6, K, B) in N and N m."""
        vertices = VERTICES.to(self.last).T.repeat(2, 1)[..., None].expand(-1, -1, self.last.shape[1])
        count = max(self.candidates - 1 - vertices.shape[1], 0)
        random = torch.rand(CONTROL_SIZE, count, self.batch, generator=self.generator, dtype=torch.float64)
        random = random[..., self.first : self.first + self.last.shape[1]].to(self.last)
        new = torch.cat((vertices, 2.0 * random - 1.0), 1) * self.env.limit[..., None]
        return torch.cat((self.last[:, None], new), 1)[:, : self.candidates]

    def outcome(self, t: float, x: Tensor, desired: Tensor) -> Tensor:
        """The smallest h (13, K, B), in filter calls, over the checks after true states x (16, B) at t s."""
        env, tried, control = self.env, self.tried, desired.flatten(1)
        x, time = x.repeat(1, self.candidates), (env.time + t).repeat(self.candidates)
        if env.plant and tried.plant:
            state = env.plant.state_dict()  # whose last axes are the episodes
            tried.plant.load_state_dict(
                {name: part.repeat(*(1,) * (part.dim() - 1), self.candidates) for name, part in state.items()}
            )
        smallest = Smallest(len(self.scale), x)
        for hold in tried.fly(lambda _, seen: control, self.duration, x, time):
            smallest.note(tried.constraint_values(hold.after))
        return (smallest.value / self.scale).unflatten(1, desired.shape[1:])


def attacked(column: Tensor) -> Tensor:
    """(13, B) bool: which constraints are attacked in the columns (B,) of a batch."""
    thrust, torque = (rows.stop - rows.start for rows, _ in GROUPS)
    pair = column // 2  # starts of two kinds alternate

    def one_or_all(number: Tensor, count: int) -> Tensor:
        target = number % (count + 1)  # the last one: all
        return (target == torch.arange(count, device=column.device)[:, None]) | (target == count)

    return torch.cat((one_or_all(pair, thrust), one_or_all(pair // (thrust + 1), torque)))
