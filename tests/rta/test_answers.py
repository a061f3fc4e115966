"""Every answer of the programs, by every solver and in C: what is called solved satisfies every condition.

States are in flight and far beyond several limits at once; demands are up to three times the actuators' limits.
"""

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import unit
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, THRUST, E, P, Q, T, V
from rta.fast.program import FEASIBLE, NO_INFLUENCE
from rta.filter import SafetyFilter
from rta.paper import GIVEN
from rta.result import Status
from tests import golden
from tests.support.flights import way as filter_of

C = InspectionParameters()
LIMIT = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
WAYS = ("piqp", "batched", "C")

# Found by a search beyond several limits: safe separation, the only limit without slack, needs more control than there
# is, so that only one corner of the control box is left.
AT_A_CORNER = (
    5.961792261560334, 2.420776071811913, 10.777491537179833, -0.04067360815199077, 0.9032787149492831,
    -2.1248603609408696, -0.2905903818264934, 0.9210267934877242, 0.22055702102567587, 0.13646052961912933,
    -0.03490658503988659, -0.03490658503988659, 0.03490658503988659, 4.991607961114055, 5.043783332255021,
    5.284155651694332,
)  # fmt: skip
DESIRED = (
    5.822986070904938, 5.826917697430897, -2.004925070609198,
    0.006180503459317654, 0.0014174160838219395, 0.005341735511732319,
)  # fmt: skip
CORNER = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)


def near_and_beyond(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Returns states (16, count), half in flight and half beyond several limits, and desired controls (6, count)."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, count, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, count, generator=generator, dtype=torch.float64)

    beyond = torch.arange(count) % 2 == 0
    x = torch.empty(SIZE, count, dtype=torch.float64)
    x[P] = unit(normal(3)) * torch.where(beyond, 10.0 ** uniform(0.7, 3.0), uniform(16.0, 400.0))
    x[V] = unit(normal(3)) * torch.where(beyond, 10.0 ** uniform(-1.5, 1.0), uniform(0.05, 1.0))
    x[Q] = unit(normal(4))
    rates = torch.where(beyond, 0.03 * normal(3), uniform(-0.03, 0.03, 3))
    at_the_limit = beyond & (uniform(0.0, 1.0, 3) < 0.3)
    x[OMEGA] = torch.where(at_the_limit, C.max_rate * rates.sign(), rates)
    x[T] = torch.where(beyond, uniform(-5.0, 25.0), uniform(-20.0, 9.0))
    x[E] = torch.where(beyond, uniform(0.0, 8.0), uniform(4.0, 8.0))
    x[THETA_S] = uniform(0.0, 6.28)
    return x, 3.0 * LIMIT * normal(6) * torch.where(uniform(0.0, 1.0) < 0.5, 1.0, 0.2)


def kept(way: str, safety: SafetyFilter, x: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
    """Tells where (B,) controls (6, B) satisfy all conditions up to rounding, in their unit by PIQP, else per length.

    First all conditions, then those that are solved for: PIQP's all, else those that a control changes.
    """
    a, b, *_ = safety.program.evaluated(x)
    length = (a * LIMIT).norm(dim=1)
    rounding = torch.full_like(length, GIVEN) if way == "piqp" else FEASIBLE * length
    holds = (a * control).sum(1) + b >= -1.001 * rounding
    fixed = torch.zeros_like(holds) if way == "piqp" else length <= NO_INFLUENCE
    return holds.all(0), (holds | fixed).all(0)


@pytest.mark.parametrize("way", WAYS)
def test_what_programs_call_solved_satisfies_every_condition(way: str) -> None:
    safety = filter_of(way, checked=False)
    x, desired = near_and_beyond(800, 1)
    answer, within = safety.correct(x, desired), desired.clamp(-LIMIT, LIMIT)
    assert not answer.verified.any() and not answer.backup.any()
    all_hold, holds = kept(way, safety, x, answer.control)
    _, would_hold = kept(way, safety, x, within)
    applied, clipped = (answer.control == desired).all(0), (answer.control == within).all(0)
    solved = answer.status <= Status.HARD
    assert solved.sum() > 80 and holds[solved].all()
    assert torch.equal(applied, answer.status == Status.UNTOUCHED)
    assert not all_hold[answer.status == Status.SLACK].any()
    breaks = ~would_hold & solved
    assert breaks.sum() > 16 and not clipped[breaks].any()
    assert (answer.control.abs() <= LIMIT).all()


def test_the_checked_filters_statuses_say_what_they_promise() -> None:
    """A verified control may break conditions, which keep more than limits; what is not verified has its slack said."""
    safety = filter_of("C")
    x, desired = near_and_beyond(800, 2)
    answer = safety.correct(x, desired)
    assert (answer.control.abs() <= LIMIT).all() and (answer.status < Status.UNSOLVED).all()
    assert torch.equal(answer.intervened, (answer.control != desired).any(0))
    assert torch.equal(answer.status == Status.UNTOUCHED, ~answer.intervened & (answer.status < Status.SLACK))
    assert (answer.status[answer.verified] <= Status.HARD).all()
    assert (answer.slack[:, answer.verified] == 0.0).all()
    slack = answer.status == Status.SLACK
    assert (answer.slack[:, slack] > 0.0).any(0).all() and slack.sum() > 80
    assert answer.verified.any() and answer.backup.sum() > 40


@pytest.mark.parametrize("way", ["piqp", "C"])
def test_every_way_gives_the_same_answer_beyond_several_limits(way: str) -> None:
    x = torch.cat((torch.tensor(AT_A_CORNER, dtype=torch.float64)[:, None], near_and_beyond(200, 3)[0]), 1)
    u = torch.cat((torch.tensor(DESIRED, dtype=torch.float64)[:, None], near_and_beyond(200, 3)[1]), 1)
    ours, theirs = (filter_of(each, checked=False).correct(x, u) for each in (way, "batched"))
    solved = theirs.status <= Status.HARD
    torch.testing.assert_close(theirs.control[THRUST, 0], LIMIT[THRUST, 0] * CORNER, rtol=0.0, atol=1e-6)
    if way == "C":
        assert torch.equal(ours.status, theirs.status)
        torch.testing.assert_close(ours.control / LIMIT, theirs.control / LIMIT, rtol=0.0, atol=2e-6)
    else:  # where safe separation asks for more than there is PIQP has no solution, and 1e12 leaves few digits of slack
        assert torch.equal((ours.status <= Status.HARD), solved)
        off = ((ours.control - theirs.control) / LIMIT).abs().amax(0)[solved]
        assert off.max() < 2e-4 and (off < 1e-5).double().mean() > 0.9


def test_no_state_that_is_finite_is_left_open() -> None:
    x, u = golden.states(3000, 0)
    finite = x.isfinite().all(0)
    assert (filter_of("C").correct(x, u).status == Status.UNSOLVED).sum() == (~finite).sum() > 100
    found = filter_of("batched").program.correct(x[:, finite], u[:, finite])
    assert (found.status < Status.UNSOLVED).all()
