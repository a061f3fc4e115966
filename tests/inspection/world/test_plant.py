"""The world that differs from the model: against scipy, closed forms and counts by hand, and who is shown what."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.closed_loop import Clocks, Safety, closed_loop
from inspection.environment import InspectionEnv
from inspection.initial_state import sample_initial_state
from inspection.model.draws import counter_based_uniform
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, THRUST, TORQUE, E, P, Q, T, V
from inspection.world.parameters import DETAILS, PlantParameters
from inspection.world.plant import Plant
from tests.inspection.model.test_dynamics import MASS, UNEQUAL, N, paper_rate
from tests.support.states import seeded

C = InspectionParameters(inertia=UNEQUAL)
U1 = PlantParameters(
    mass_factor=(0.9, 1.1),
    inertia_factor=(0.9, 1.1),
    thrust_gain=(0.95, 1.05),
    torque_gain=(0.95, 1.05),
    thrust_misalignment=1.0,
    acceleration=1e-5,
    position_noise=0.2,
    velocity_noise=0.002,
    attitude_noise=0.1,
    rate_noise=0.01,
    latency=1,
    missed_calls=0.05,
    missed_in_a_row=2,
    hill_rotation=True,
    saturate_rates=False,
)


def begun(parameters: PlantParameters, batch: int = 1, seed: int = 0, c: InspectionParameters = C) -> Plant:
    plant = Plant(parameters, c, batch, "cpu")
    number = torch.rand(batch, generator=seeded(seed), dtype=torch.float64)
    plant.begin(torch.arange(batch), torch.zeros(SIZE, batch), number)
    return plant


def make(parameters: PlantParameters | None, batch: int = 4, seed: int = 0, **more: Any) -> InspectionEnv:
    return InspectionEnv(batch, C, [seeded(seed)], plant=parameters, **more)


def states(batch: int, seed: int = 3) -> tuple[Tensor, Tensor]:
    """Returns some of the paper's starts, moving and tumbling."""
    generator = seeded(seed)
    x, priority = sample_initial_state(batch, generator, C)
    x[V] = 0.2 * torch.randn(3, batch, generator=generator, dtype=torch.float64)
    x[OMEGA] = 0.01 * torch.randn(3, batch, generator=generator, dtype=torch.float64)
    return x, priority


def moments(batch: int, seconds: float = 0.0) -> Tensor:
    return torch.full((batch,), seconds, dtype=torch.float64)


# what is off


def test_a_plant_that_is_the_model_takes_no_draw_and_is_not_there() -> None:
    details: dict[str, Any] = {
        "errors": "worst",
        "noise_bound": 1.0,
        "missed_in_a_row": 3,
        "failing_from": 5.0,
        "failing_strength": 0.5,
    }
    assert details.keys() == DETAILS
    generators = seeded(1), seeded(1)
    for generator, plant in zip(generators, (None, PlantParameters(**details)), strict=True):
        env = InspectionEnv(3, C, [generator], plant=plant)
        env.reset()
        assert env.plant is None and torch.equal(env.observation(), env.observation(env.x))
        assert "plant" not in env.state_dict()
    assert torch.equal(generators[0].get_state(), generators[1].get_state())


# the body


def disturbed_rate(x: np.ndarray, u: np.ndarray, plant: Plant, k: int) -> np.ndarray:
    """Returns the paper's rate with the drawn body and the acting control in place of the model's and the command."""
    mass, *rest = plant.drawn.body[:, k].tolist()
    inertia, push = rest[:3], rest[3:]
    acting = np.concatenate(
        (plant.drawn.thrust[..., k].numpy() @ u[:3] * MASS / mass, plant.drawn.torque[:, k].numpy() * u[3:])
    )
    rate = paper_rate(x, acting, inertia)
    rate[3:6] += push
    if plant.parameters.hill_rotation:
        relative = x.copy()
        relative[10:13] -= Rotation.from_quat(x[6:10]).inv().apply([0.0, 0.0, N])
        rate[6:10] = paper_rate(relative, acting, inertia)[6:10]
    return rate


def test_the_disturbed_flight_is_scipys() -> None:
    parameters = PlantParameters(
        mass_factor=(0.8, 1.3),
        inertia_factor=(0.9, 1.1),
        thrust_gain=(0.8, 1.2),
        torque_gain=(0.8, 1.2),
        thrust_misalignment=(1.0, 5.0),
        acceleration=(1e-4, 2e-3),
        hill_rotation=True,
        saturate_rates=False,
    )
    env, (x, priority) = make(parameters, 3), states(3)
    env.start(x, priority)
    u = torch.tensor([[0.5, -0.3, 0.8, 3e-5, -5e-5, 4e-5]], dtype=torch.float64).T.repeat(1, 3)
    *_, last = env.fly(lambda t, seen: u, 60.0)
    for k in range(3):
        found = solve_ivp(
            lambda _, s, k=k: disturbed_rate(s, u[:, k].numpy(), env.plant, k),
            (0.0, 60.0),
            x[:, k].numpy(),
            method="DOP853",
            rtol=1e-9,
            atol=1e-11,
        ).y[:, -1]
        same = np.sign(found[6:10] @ last.after[Q, k].numpy())
        found[6:10] *= same / np.linalg.norm(found[6:10])
        found[T : E + 1] = last.after[T : E + 1, k]  # not compared: they bend where light changes
        np.testing.assert_allclose(last.after[:, k], found, rtol=1e-6, atol=1e-7)
    assert (last.after[OMEGA].abs() > C.max_rate).any()  # nothing saturates


# what is drawn


def test_an_episode_draws_from_its_ranges_and_keeps_what_it_drew() -> None:
    parameters = PlantParameters(
        mass_factor=(0.9, 1.1), inertia_factor=(0.9, 1.1), acceleration=(1e-5, 3e-5), latency=(0, 3)
    )
    plant = begun(parameters, 4000)
    body = plant.drawn.body
    for row, model, low, high in ((0, MASS, 0.9, 1.1), *((1 + i, UNEQUAL[i], 0.9, 1.1) for i in range(3))):
        share = (body[row] / model - low) / (high - low)
        assert stats.kstest(share.numpy(), "uniform").pvalue > 1e-3
    size = body[4:].norm(dim=0)
    assert stats.kstest((size.numpy() - 1e-5) / 2e-5, "uniform").pvalue > 1e-3
    for component in (body[4:] / size).numpy():  # of a uniform direction, as Archimedes found
        assert stats.kstest(component, "uniform", (-1.0, 2.0)).pvalue > 1e-3
    assert np.abs(np.corrcoef(body.numpy()) - np.eye(7)).max() < 0.06
    counts = torch.bincount(plant.drawn.latency, minlength=4)
    assert len(counts) == 4 and stats.chisquare(counts.numpy()).pvalue > 1e-3


def test_thrust_leaves_its_axis_by_the_angle_asked_for_and_keeps_its_gain() -> None:
    parameters = PlantParameters(thrust_misalignment=3.0, thrust_gain=(0.9, 1.1), torque_gain=(0.9, 1.1))
    plant = begun(parameters, 500)
    gain = torch.stack([plant.drawn.thrust[:, i].norm(dim=0) for i in range(3)])
    assert 0.9 <= gain.min() < 0.91 and 1.09 < gain.max() <= 1.1
    for i in range(3):
        u = torch.zeros(6, 500, dtype=torch.float64)
        u[i] = -0.5
        acting = plant.actuate(moments(500), u)
        angle = (-acting[i] / acting[THRUST].norm(dim=0)).arccos().rad2deg()
        np.testing.assert_allclose(angle, 3.0, rtol=1e-9)
        j, k = (i + 1) % 3, (i + 2) % 3
        side = torch.atan2(acting[j], acting[k])
        assert stats.kstest((side.numpy() + math.pi) / (2 * math.pi), "uniform").pvalue > 1e-3
        assert not acting[TORQUE].any()
    u = torch.ones(6, 500, dtype=torch.float64)
    torch.testing.assert_close(plant.actuate(moments(500), u)[TORQUE], plant.drawn.torque)


def test_an_episode_is_the_same_whatever_flies_beside_it_or_else_is_set() -> None:
    alone, among = begun(U1, 3), Plant(U1, C, 7, "cpu")
    numbers = torch.rand(3, generator=seeded(0), dtype=torch.float64)
    among.begin(torch.tensor([5, 1, 4]), torch.zeros(SIZE, 3), numbers)
    for one, other in zip(alone.drawn, among.drawn, strict=True):
        assert torch.equal(one, other[..., [5, 1, 4]])
    x, _ = states(7)
    seen = among.sense(moments(7, 12.0), x)
    assert torch.equal(alone.sense(moments(3, 12.0), x[:, [5, 1, 4]]), seen[:, [5, 1, 4]])
    lighter = begun(PlantParameters(mass_factor=U1.mass_factor), 3)
    assert torch.equal(lighter.body[0], alone.body[0])


# sensors


def error_of(plant: Plant, x: Tensor, time: float) -> np.ndarray:
    """Returns the errors (12, B) of a measurement, in m, m/s, rad, rad/s."""
    seen = plant.sense(moments(x.shape[1], time), x.clone())
    turned = Rotation.from_quat(x[Q].T.numpy()).inv() * Rotation.from_quat(seen[Q].T.numpy())
    difference = (seen - x).numpy()
    np.testing.assert_array_equal(difference[[T, E, THETA_S]], 0.0)
    np.testing.assert_allclose(seen[Q].norm(dim=0), 1.0, rtol=1e-14)
    return np.concatenate((difference[P], difference[V], turned.as_rotvec().T, difference[OMEGA]))


def test_noise_has_its_sigma_its_bound_and_its_bias_and_nothing_in_common() -> None:
    sigma = np.repeat([0.2, 0.002, math.radians(0.1), math.radians(0.01)], 3)
    noise = {"position_noise": 0.2, "velocity_noise": 0.002, "attitude_noise": 0.1, "rate_noise": 0.01}
    biases = {"position_bias": 3.0, "velocity_bias": 0.03, "attitude_bias": 1.0, "rate_bias": 0.1}
    batch, times = 60, 400
    plant, (x, _) = begun(PlantParameters(noise_bound=2.0, **noise, **biases), batch), states(batch)
    # time, component, episode
    error = np.stack([error_of(plant, x, float(t)) for t in range(times)])
    bias = error.mean(0)
    sizes = np.linalg.norm(bias.reshape(4, 3, batch), axis=1)
    asked = np.array([3.0, 0.03, math.radians(1.0), math.radians(0.1)])
    np.testing.assert_allclose(sizes, np.repeat(asked[:, None], batch, 1), rtol=0.02)
    for kind in bias.reshape(4, 3, batch):
        assert (np.ptp(kind, axis=1) > 1.2 * np.linalg.norm(kind[:, 0])).all()  # all directions
    noise = (error - bias) / sigma[:, None]
    assert np.abs(noise).max() < 2.3  # a mean over the times beside the bound
    clipped = math.sqrt(2 * stats.norm.cdf(2) - 1 - 4 * stats.norm.pdf(2) + 8 * stats.norm.sf(2))
    np.testing.assert_allclose(noise.std((0, 2)), clipped, rtol=0.03)
    for axis in range(3):  # at other times, in other components, of other episodes
        rows = np.moveaxis(noise, axis, 0).reshape(noise.shape[axis], -1)
        assert np.abs(np.corrcoef(rows) - np.eye(len(rows))).max() < 5.5 / math.sqrt(rows.shape[1])


# actuators


@pytest.mark.parametrize(
    ("thrusters", "asked", "given"),
    [
        ({"minimum_thrust": 0.02}, [0.019, -0.021, 0.3], [0.0, -0.021, 0.3]),
        ({"thrust_quantum": 0.05}, [0.024, -0.026, 1.0], [0.0, -0.05, 1.0]),
        ({"thrust_quantum": 0.4}, [0.024, -0.026, 1.0], [0.0, 0.0, 0.8]),
        ({"thrust_quantum": 0.6}, [0.0, 0.0, 1.0], [0.0, 0.0, 0.6]),  # two are more than the thruster has
    ],
)
def test_small_thrust_is_not_given_and_what_is_comes_in_quanta(
    thrusters: dict[str, float], asked: list[float], given: list[float]
) -> None:
    torque = [1e-5, -1e-4, 9e-4]
    u = torch.tensor([*asked, *torque], dtype=torch.float64)[:, None]
    acting = begun(PlantParameters(**thrusters)).actuate(moments(1), u)
    np.testing.assert_allclose(acting[:, 0], [*given, *torque], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("failing", "rows"),
    [("thrust", {0, 1, 2}), ("any", set(range(6))), ("torque_y", {4})],
)
def test_one_actuator_fails_at_its_time(failing: str, rows: set[int]) -> None:
    parameters = PlantParameters(failing=failing, failing_from=(100.0, 200.0), failing_strength=(0.25, 0.5))
    plant, u = begun(parameters, 300), torch.ones(6, 300, dtype=torch.float64)
    assert torch.equal(plant.actuate(moments(300, 99.0), u), u)
    end = plant.actuate(moments(300, 200.0), u)
    weak = end < 1.0
    assert (weak.sum(0) == 1).all()
    assert set(torch.nonzero(weak)[:, 0].tolist()) == rows
    assert end.min() >= 0.25 and 0.45 < end[weak].max() <= 0.5
    failed = (plant.actuate(moments(300, 150.0), u) < 1.0).any(0).double().mean()
    assert 0.4 < failed < 0.6


# the computer


class Recorded:
    """Acts as controller, filter and plant without motion, and shows their inputs."""

    def __init__(self) -> None:
        self.seen: list[float] = []
        self.desired: list[float] = []

    def controller(self, t: float, x: Tensor) -> Tensor:
        return torch.full((6, 1), 100.0 + t, dtype=torch.float64)

    def correct(self, x: Tensor, desired: Tensor) -> SimpleNamespace:
        self.seen.append(x[0, 0].item())
        self.desired.append(desired[0, 0].item())
        return SimpleNamespace(control=desired + 0.5)

    @staticmethod
    def integrate(x: Tensor, u: Tensor, seconds: float) -> Tensor:
        return x + seconds


def test_a_state_so_many_calls_old_is_seen() -> None:
    """A position that counts the seconds; before the first ones are old enough, the first one is seen."""
    for latency, period, expected in (
        (0, 1.0, list(range(12))),
        (1, 1.0, [0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]),
        (3, 1.0, [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8]),
        (2, 2.0, [0, 0, 0, 2, 4, 6]),
    ):
        plant = begun(PlantParameters(latency=latency, mass_factor=1.1))
        plant.every = period
        recorded, x = Recorded(), torch.zeros(16, 1, dtype=torch.float64)
        for start in (moments(1), moments(1, 6.0)):  # a loop goes on where another one ended
            x[9] = 1.0
            clocks = Clocks(6.0, 6.0, 1.0, period)
            loop = closed_loop(
                x, recorded.controller, recorded.correct, recorded.integrate, clocks, 6.0, plant, start
            )
            *_, last = loop
            x = last.after
        assert recorded.seen == expected


def test_a_missed_call_holds_the_control_and_the_next_one_is_asked_for_the_same() -> None:
    plant = begun(PlantParameters(missed_calls=0.5, missed_in_a_row=2))
    recorded, x = Recorded(), torch.zeros(16, 1, dtype=torch.float64)
    clocks = Clocks(10.0, 10.0, 1.0, 1.0)
    parts = recorded.controller, recorded.correct, recorded.integrate
    holds = list(closed_loop(x, *parts, clocks, 40.0, plant, moments(1)))
    missed = [bool(hold.missed) for hold in holds]
    times = 1000 * torch.arange(40)
    chances = counter_based_uniform(plant.key.expand(40), times, 1, first=12)[0]
    expected = (chances < 0.5).tolist()
    expected[0] = False  # there is nothing to hold before
    for t in range(2, 40):  # by hand: the third in a row is made
        if expected[t] and expected[t - 1] and expected[t - 2]:
            expected[t] = False
    assert missed == expected and 10 < sum(missed) < 30
    control, desired = 0.0, 0.0
    for t, hold in enumerate(holds):
        if t % 10 == 0:
            desired = 100.0 + t
        assert hold.desired[0] == desired and hold.decided == (t % 10 == 0)
        if not missed[t]:
            control = desired = desired + 0.5
        assert hold.applied[0] == hold.acting[0] == control


# who is shown what


def facing(batch: int) -> tuple[Tensor, Tensor]:
    """Starts with the camera on the chief and the Sun behind it."""
    x, priority = states(batch)
    for k in range(batch):
        turn, _ = Rotation.align_vectors([-x[P, k].numpy()], [[1.0, 0.0, 0.0]])
        x[Q, k] = torch.from_numpy(turn.as_quat())
    x[THETA_S] = torch.atan2(x[1], x[0])
    return x, priority


def witness(seen: list[Tensor]) -> Safety:
    """Returns a filter that keeps its inputs, and corrects nothing."""

    def values(x: Tensor) -> Tensor:
        return torch.stack((500.0 - x[P].norm(dim=0), 1.0 - x[V].norm(dim=0)))

    def correct(x: Tensor, desired: Tensor) -> SimpleNamespace:
        seen.append(x)
        return SimpleNamespace(control=desired, h=x[:2])

    return Safety(("far", "fast"), values, None, correct)


SENSORS = PlantParameters(position_bias=900.0, velocity_bias=7.0, attitude_bias=120.0, rate_bias=5.0)


def test_agent_and_filter_see_what_is_measured_and_all_that_is_reported_is_true() -> None:
    x, priority = facing(4)
    shown, told, others = [], [], []  # to the agent, to its filter, and to that without errors
    env, honest = make(SENSORS, safety=witness(told)), make(None, safety=witness(others))
    first, expected = env.start(x, priority), honest.start(x, priority)
    assert (first[:, 0] > 8.0).all() and (expected[:, 0] < 1.1).all()  # distances of hundreds of metres
    for step in range(5):
        actions = torch.randn(4, 6, generator=seeded(step))

        def control(t: float, seen: Tensor, actions: Tensor = actions) -> Tensor:
            shown.append(seen)
            return actions.T.double() * 0.1 * env.limit

        one, other = env.step(control), honest.step(control)
        torch.testing.assert_close(one.state, other.state, rtol=1e-12, atol=1e-12)
        for name in ("reward", "metrics", "terminated", "truncated", "violated", "outcome"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)
        assert torch.equal(env.sight.inspected, honest.sight.inspected) and honest.sight.inspected.any()
        # a part of what is observed says so
        seen = env.plant.sense(env.time, one.state)
        assert ((seen[P] - one.state[P]).norm(dim=0) - 900.0).abs().max() < 1e-9
        np.testing.assert_allclose(one.observation[:, 0], seen[P].norm(dim=0).float() / 100.0, rtol=1e-6)
        np.testing.assert_allclose(one.observation[:, 8:11], (seen[OMEGA] / 0.035).T, rtol=1e-4, atol=1e-5)
        for (_, answered, true), (_, _, given) in zip(one.calls(), other.calls(), strict=True):
            assert answered.all() and true.shape == given.shape and (true[0] > 300.0).all()
    for at, was in zip(told, others, strict=True):
        assert ((at[P] - was[P]).norm(dim=0) - 900.0).abs().max() < 1e-6
    assert torch.equal(shown[-2], told[-10])  # the agent's, at the beginning of the last step
    assert not torch.equal(shown[-2], shown[-1])


@pytest.mark.parametrize("errors", ["drawn", pytest.param("steady", marks=pytest.mark.campaign), "worst"])
def test_a_resumed_flight_goes_on_bit_for_bit(errors: str) -> None:
    c = InspectionParameters(max_time=60.0)
    more = {"missed_calls": 0.5, "latency": (1, 3), "failing": "any", "errors": errors}
    world = PlantParameters(**(vars(U1) | more))

    def fresh() -> InspectionEnv:
        return InspectionEnv(3, c, [seeded(0), seeded(1)], witness([]), plant=world)

    def play(env: InspectionEnv, steps: range) -> list[Tensor]:
        found = [env.observation()]
        for step in steps:
            transition = env.step(torch.randn(6, 6, generator=seeded(step)))
            sent = env.plant.filter_inputs(env.time)["sent"].nan_to_num()
            found += [transition.observation, transition.state, transition.reward, env.plant.held, sent]
        return found

    env, other = fresh(), fresh()
    env.reset()
    play(env, range(9))
    other.load_state_dict(env.state_dict())
    for theirs, ours in zip(other.starts, env.starts, strict=True):
        theirs.generator.set_state(ours.generator.get_state())
    for one, wanted in zip(play(other, range(9, 20)), play(env, range(9, 20)), strict=True):
        assert torch.equal(one, wanted)
