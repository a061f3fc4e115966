"""The paper's initial distribution (Sec. Initial and Terminal Conditions), with attitude resampling."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from inspection.model.draws import random_quaternion, spherical, uniform
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THETA_S, E, P, Q, T
from precision import in_full_precision

# The filter rejects at most 29 % of the attitudes at any of 4000 initial states of the paper, so 100 draws always found
# an accepted one; a constraint on position may reject all attitudes.
MAX_ATTITUDES = 100
MAX_STATES = 1000
# After so many rejected whole states in a row, drawing stops before MAX_STATES. For any distribution and number of
# states, a draw that would have found all of them gets that far with a chance below 1e-20.
IN_VAIN = 20_000
POOL = 2048


@in_full_precision
def sample_initial_state(
    count: int,
    generator: torch.Generator,
    c: InspectionParameters,
    is_safe: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Draws states at rest and priority vectors until `is_safe` accepts them.

    At first only attitudes are redrawn. Where none of MAX_ATTITUDES was accepted, whole states are redrawn.

    Args:
        count: number of states.
        generator: source of every draw; its device is the result's.
        is_safe: maps states (16, k) to (k,) bool; None accepts any state.

    Returns:
        States (16, count) and priority unit vectors (3, count), float64.

    Raises:
        RuntimeError: none of MAX_STATES states was accepted either, or none of IN_VAIN in a row.
    """

    def angles() -> tuple[Tensor, Tensor]:
        return (
            uniform(0.0, 2 * math.pi, count, generator),
            uniform(-math.pi / 2, math.pi / 2, count, generator),
        )

    x = torch.zeros(SIZE, count, dtype=torch.float64, device=generator.device)
    x[P] = spherical(uniform(*c.initial_radius, count, generator), *angles())
    x[E] = uniform(*c.initial_energy, count, generator)
    x[T] = uniform(*c.initial_temperature, count, generator)
    x[THETA_S] = uniform(0.0, 2 * math.pi, count, generator)
    priority = spherical(torch.ones_like(x[T]), *angles())

    x[Q] = random_quaternion(count, generator, x.dtype)
    if is_safe is None:
        return x, priority
    rejected = torch.nonzero(~is_safe(x)).flatten()
    attempts = in_vain = 0
    while rejected.numel():
        if attempts == MAX_ATTITUDES + MAX_STATES or in_vain >= IN_VAIN:
            raise RuntimeError(
                f"no safe initial state in {MAX_ATTITUDES} draws of an attitude and {attempts - MAX_ATTITUDES} of a "
                f"whole state, for {rejected.numel():,} spacecraft"
            )
        if attempts < MAX_ATTITUDES:
            x[Q, rejected] = random_quaternion(rejected.numel(), generator, x.dtype)
        else:
            x[:, rejected], priority[:, rejected] = sample_initial_state(rejected.numel(), generator, c)
        left = rejected[~is_safe(x[:, rejected])]
        if attempts >= MAX_ATTITUDES:
            in_vain = in_vain + rejected.numel() if left.numel() == rejected.numel() else 0
        rejected = left
        attempts += 1
    return x, priority


class InitialStates:
    """Supplies a seed's initial states without end, drawn POOL at a time because few are needed at once.

    `numbered` states come with a number in [0, 1) each, from which the episode's plant follows
    (`inspection.world.plant`).

    Attributes:
        pool: (16 + 3, k) states and priority vectors not handed out yet; one row more if `numbered`.
    """

    def __init__(
        self,
        generator: torch.Generator,
        c: InspectionParameters,
        is_safe: Callable[[Tensor], Tensor] | None = None,
        numbered: bool = False,
    ) -> None:
        self.generator, self.c, self.is_safe, self.numbered = generator, c, is_safe, numbered
        self.pool = torch.zeros(SIZE + 3 + numbered, 0, dtype=torch.float64, device=generator.device)

    def seed(self, seed: int) -> None:
        """Restarts the supply from a seed (0 to 2^63 - 1)."""
        self.generator.manual_seed(seed)
        self.pool = self.pool[:, :0]

    def take(self, count: int) -> tuple[Tensor, ...]:
        """Returns the next states (16, count), priority vectors (3, count) and, if `numbered`, numbers (count,)."""
        while self.pool.shape[1] < count:
            drawn: tuple[Tensor, ...] = sample_initial_state(POOL, self.generator, self.c, self.is_safe)
            if self.numbered:
                drawn = *drawn, uniform(0.0, 1.0, POOL, self.generator)[None]
            self.pool = torch.cat((self.pool, torch.cat(drawn)), 1)
        taken, self.pool = self.pool[:, :count], self.pool[:, count:]
        own = taken[:SIZE], taken[SIZE : SIZE + 3]
        return (*own, taken[-1]) if self.numbered else own
