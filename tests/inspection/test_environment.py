"""The batch of episodes: ends, autoreset, statistics, determinism and resuming."""

import math
import shutil
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from inspection import initial_state
from inspection.closed_loop import Safety
from inspection.environment import InspectionEnv
from inspection.initial_state import InitialStates
from inspection.model.state import THETA_S, E, P, Q, T, V
from inspection.reward import REWARDS, distance_from_track, shaping
from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from kernels.compiled import Compiled
from tests.support.states import seeded


def make(c, num_envs=1, seeds=(0,), safety=None):
    return InspectionEnv(num_envs, c, [seeded(seed) for seed in seeds], safety)


def idle(batch):
    """Returns states at rest 60 m ahead of the chief, an equilibrium; n_x looks away and the panels are lit."""
    x = torch.zeros(16, batch, dtype=torch.float64)
    x[1], x[9], x[T], x[E], x[THETA_S] = 60.0, 1.0, 5.0, 6.0, math.pi
    priority = torch.zeros(3, batch, dtype=torch.float64)
    priority[0] = 1.0
    return x, priority


def started(c, batch=1, safety=None):
    env = make(c, batch, safety=safety)
    env.start(*idle(batch))
    return env


def force(env, column, end):
    """Puts a column where the next idle step meets the given end."""
    if end == "crash":
        env.x[P, column], env.x[V, column] = torch.tensor([[0, 16, 0], [0, -0.3, 0]]).double()
    elif end == "out_of_bounds":
        env.x[P, column], env.x[V, column] = torch.tensor([[0, 799, 0], [0, 0.3, 0]]).double()
    elif end == "out_of_power":
        env.x[E, column], env.x[THETA_S, column] = 0.14, 0.0  # -15 W for 10 s takes 0.15 kJ
    elif end == "success":
        env.sight.inspected[:, column] = True
    else:
        env.time[column] = 12230.0


def coast(env, steps=1):
    for _ in range(steps):
        transition = env.step(torch.zeros(env.time.numel(), 6))
    return transition


def play(env, actions):
    """Returns the results of steps with actions (steps, B, 6), by name and with the batch last, one dict per step."""
    names, history = ("state", "reward", "done", "outcome", "metrics"), []
    for action in actions:
        step = env.step(action)
        seen = {"observation": step.observation.T, "final_observation": step.final_observation.T}
        history.append(seen | {name: getattr(step, name) for name in names} | step.reward_terms)
    return history


def random_actions(steps, batch):
    return torch.rand(steps, batch, 6, generator=seeded(9)) * 2.4 - 1.2


def test_the_first_end_names_the_outcome_and_only_the_timeout_truncates(c):
    cases = [(), *((end,) for end in range(5))]
    cases += [pair for pair in combinations(range(5), 2) if pair != (0, 1)]
    env = started(c, len(cases))
    for column, case in enumerate(cases):
        for end in case:
            force(env, column, OUTCOMES[end])
    end = coast(env)
    assert end.outcome.tolist() == [case[0] if case else -1 for case in cases]
    assert end.truncated.tolist() == [case == (4,) for case in cases]
    assert end.terminated.tolist() == [bool(case) and case != (4,) for case in cases]
    assert end.done.tolist() == [bool(case) for case in cases]


@pytest.mark.parametrize("end", ["crash", "out_of_bounds", "out_of_power"])
def test_an_episode_fails_in_any_second_of_an_action(c, end):
    """Each is over again where the action ends: past the chief, back inside 800 m, battery charged."""
    env, action = started(c, 2), torch.zeros(2, 6)
    if end == "crash":
        env.x[P, 0], env.x[V, 0] = torch.tensor([[14.9, -10, 0], [0, 2, 0]]).double()
    elif end == "out_of_bounds":
        env.x[P, 0], env.x[V, 0] = torch.tensor([[0, 799.99, 0], [0, 0.3, 0]]).double()
        action[0, 1] = -1.0  # brakes by 0.08 m/s^2
    else:
        env.x[E, 0], env.x[12, 0] = 0.001, -c.max_rate
        env.x[THETA_S, 0] = math.radians(125.0)  # the panels turn towards it, enough from 49 deg on
    states = []
    transition = env.step(lambda t, x: env.control(action), lambda hold: states.append(hold.after))
    assert len(states) == 10
    assert transition.outcome.tolist() == [OUTCOMES.index(end), -1]
    assert transition.terminated.tolist() == [True, False]
    x = transition.state[:, 0]
    assert (x[P].norm() > 15.0, x[P].norm() < 800.0, x[E] > 0.0) == (True, True, True)


def test_an_ended_column_shows_its_last_state_and_the_start_of_a_new_episode(c):
    envs = started(c, 2), started(replace(c, max_distance=1e6), 2)
    for env in envs:
        force(env, 0, "out_of_bounds")
    end, going_on = map(coast, envs)
    assert end.terminated.tolist() == [True, False] and not going_on.done.any()
    assert torch.equal(end.final_observation, going_on.observation)
    assert torch.equal(end.state, going_on.state)
    assert torch.equal(end.observation[1], going_on.observation[1])
    x, priority = InitialStates(seeded(0), c).take(1)
    env = envs[0]
    assert torch.equal(env.x[:, :1], x) and torch.equal(env.sight.priority[:, :1], priority)
    np.testing.assert_allclose(end.observation[0, 0], x[P].norm() / 100.0, rtol=1e-6)
    np.testing.assert_allclose(end.observation[0, 11:13], x[[E, T], 0] / 10.0, rtol=1e-6)
    assert torch.equal(end.observation, env.observation())


def test_statistics_restart_with_the_episode(c):
    safety = Safety(names=("always",), values=lambda x: -torch.ones_like(x[:1]))
    env = started(c, 2, safety)
    for _ in range(2):
        env.step(torch.ones(2, 6))
    force(env, 0, "out_of_power")
    end = coast(env)
    assert end.done.tolist() == [True, False]
    assert end.steps.tolist() == [3, 3] and end.metrics[2].tolist() == [30.0, 30.0]
    first = coast(env)
    assert first.steps.tolist() == [1, 4] and first.metrics[2].tolist() == [10.0, 40.0]
    assert first.violation_steps.tolist() == [[1, 4]]
    assert first.metrics[3, 0] == 0.0 and first.metrics[1, 0] == first.reward[0]


def test_metrics_of_a_constant_action_and_the_sum_of_its_rewards(c):
    env, total = started(c), 0.0
    for _ in range(3):
        end = env.step(torch.tensor([[0.5, -1.0, 0.0, 0.2, 0.0, -7.0]]))
        total += torch.stack([end.reward_terms[name] for name in REWARDS]).sum(0)
    metrics = dict(zip(METRICS, end.metrics[:, 0].tolist(), strict=True))
    assert metrics["delta_v_m_s"] == pytest.approx(3 * 1.5 / 12.0 * 10.0)
    assert metrics["torque_n_m"] == pytest.approx(3 * 1.2 * 0.0573 * 0.017453)  # -7 is clipped to -1
    assert metrics["episode_length_s"] == 30.0 and metrics["violation_percent"] == 0.0
    assert end.reward_terms["delta_v"].item() == pytest.approx(-0.02 * 1.5 / 12.0 * 10.0)
    assert end.reward_terms["torque"].item() == pytest.approx(-0.1 * 1.2 * 0.0573 * 0.017453)
    assert end.reward.shape == (1,) and tuple(end.reward_terms) == REWARDS
    torch.testing.assert_close(end.metrics[1], total, rtol=1e-14, atol=1e-15)


def test_terms_of_our_own_are_the_learners_alone(c):
    def push(x, desired):
        """Corrects all calls of the first spacecraft, and of the second those that want less than 0.4 N."""
        intervened = torch.stack((torch.tensor(True), desired[0, 1] < 0.4))
        return SimpleNamespace(control=desired + 0.25, intervened=intervened)

    own = replace(
        c, fuel_reward=-0.3, duration_reward=-0.7, rate_reward=-0.5, correction_reward=-0.1, drift_reward=-0.2
    )
    safety = Safety(correct=push, period=5.0)
    ends = []
    for parameters in (c, own):
        env = started(parameters, 2, safety)
        env.x[10:13, 0] = torch.tensor([0.5, 0.0, -1.0]) * c.max_rate
        ends.append(env.step(torch.tensor([0.2] + 5 * [0.0]).expand(2, 6)))
    plain, shaped = ends
    assert tuple(shaped.reward_terms) == (*REWARDS, "fuel", "duration", "rate", "correction", "drift")
    rates = (shaped.state[10:13] / c.max_rate).square().sum(0)
    assert rates[0] > 1.0
    corrected = torch.tensor([1.0, 0.5], dtype=torch.float64)  # two calls that desire 0.2 N and 0.45 N
    torch.testing.assert_close(shaped.reward_terms["rate"], -0.5 * rates)
    torch.testing.assert_close(shaped.reward_terms["correction"], -0.1 * corrected)
    near = 1.0 - distance_from_track(shaped.state, c) / 30.0
    assert near.min() > 0.0
    torch.testing.assert_close(shaped.reward_terms["drift"], -0.2 * near)
    fuel = plain.reward_terms["delta_v"] / c.delta_v_reward  # in m/s
    torch.testing.assert_close(shaped.reward_terms["fuel"], -0.3 * fuel)
    priced = shaping(shaped.state, {}, corrected, fuel, 0.25, own)["fuel"]  # a quarter of a training
    torch.testing.assert_close(priced, 0.25 * -0.3 * fuel)
    assert fuel.min() > 0.1
    expected = plain.reward - 0.3 * fuel - 0.7 - 0.5 * rates - 0.1 * corrected - 0.2 * near
    torch.testing.assert_close(shaped.reward, expected)
    torch.testing.assert_close(shaped.metrics, plain.metrics)


def test_violations_are_counted_per_constraint_and_together(c):
    safety = Safety(names=("late", "never"), values=lambda x: torch.stack((0.5 - x[14], x[14])))
    env = started(c, 2, safety)
    env.x[E] = torch.tensor([0.6, 0.6])
    env.x[THETA_S, 1] = 0.0  # the second column drains 0.15 kJ per step and so ends its violation
    end = coast(env, 2)
    assert end.violation_steps.tolist() == [[2, 0], [0, 0]]
    assert end.metrics[5].tolist() == [100.0, 0.0]
    assert end.violated.tolist() == [[True, False], [False, False]]
    assert end.cost.tolist() == [1.0, 0.0]  # of any limit


def test_a_flight_looks_at_the_end_of_every_action_period_and_leaves_the_episodes(c, monkeypatch):
    env, looked, flown = started(c), [], []
    monkeypatch.setattr(env.sight, "update_inspected", looked.append)
    x, nothing = env.x, torch.zeros(6, 1).double()
    for hold in env.fly(lambda t, x: nothing, 30.0):
        assert len(looked) == len(flown) // 10  # not before the hold is handed out
        flown.append(hold)
    assert all(at is hold.after for at, hold in zip(looked, flown[9::10], strict=True))
    assert env.x is x and env.time == 0.0
    again = list(env.fly(lambda t, x: nothing, 30.0, env.x))  # a prediction, which must change nothing
    assert torch.equal(again[-1].after, hold.after) and len(looked) == 3
    (later,) = list(env.fly(lambda t, x: nothing, 1.0, hold.state))
    assert torch.equal(later.after, hold.after)


def test_points_in_view_at_the_start_are_inspected_at_once(c):
    x, priority = idle(1)
    x[Q, 0] = torch.tensor([0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)]).double()  # n_x at the chief
    x[THETA_S] = math.pi / 2
    env = make(c)
    start = env.start(x, priority)
    assert 0.2 < env.sight.score().item() < 0.5 and start[0, 25].item() == pytest.approx(
        env.sight.score().item()
    )
    assert coast(env).reward_terms["points"].item() == 0.0  # nothing new in view


def test_observation_points_at_uninspected_lit_points_until_none_is_left(c):
    env = started(c)
    sun = torch.tensor([-1.0, 0.0, 0.0])
    assert env.observation()[0, 21:24] @ sun > 0.0  # identity attitude: body is Hill
    env.sight.inspected[:] = True
    env.sight.inspected[env.sight.surface.normals[0] > 0.5] = False  # left, but dark
    assert (coast(env).final_observation[0, 21:25] == 0.0).all()


@pytest.fixture
def short(c, monkeypatch):
    """Episodes of 50 s and small pools, so that 20 steps meet resets and fresh draws."""
    monkeypatch.setattr(initial_state, "POOL", 5)
    return replace(c, max_time=50.0)


@pytest.mark.skipif(not shutil.which("c++"), reason="torch.compile needs a C++ compiler")
def test_compiled_steps_equal_the_others(short):
    """Over a chunk and a filled-up one, with a filter call between substeps and with resets."""
    safety = Safety(
        names=("energy", "speed"),
        values=lambda x: torch.stack((x[E] - 6.0, 0.1 - x[V].norm(dim=0))),
        correct=lambda x, desired: SimpleNamespace(control=desired / 2),
        period=5.0,
    )
    actions, histories, envs = random_actions(8, 520), [], []
    for compiled in (False, True):
        env = make(short, 520, safety=safety)
        if compiled:
            env.compile(Compiled)
        env.reset()
        histories.append(play(env, actions))
        envs.append(env)
    for name in ("inspected", "alive", "centres"):
        assert torch.equal(*(getattr(env.sight, name) for env in envs))
    for plain, compiled in zip(*histories, strict=True):
        for name in plain:
            torch.testing.assert_close(plain[name], compiled[name], rtol=1e-6, atol=1e-6)


def test_seeds_side_by_side_equal_each_alone(short):
    actions, together = random_actions(20, 6), make(short, 3, seeds=(5, 8))
    together.reset()
    history = play(together, actions)
    for k, seed in enumerate((5, 8)):
        columns, alone = slice(3 * k, 3 * k + 3), make(short, 3, seeds=(seed,))
        alone.reset()
        for both, one in zip(history, play(alone, actions[:, columns]), strict=True):
            for name in both:
                torch.testing.assert_close(both[name][..., columns], one[name], rtol=1e-12, atol=1e-12)


def test_a_resumed_run_continues_bit_identically(short):
    actions, env, resumed = random_actions(20, 6), *(make(short, 3, seeds=(5, 8)) for _ in range(2))
    env.reset()
    play(env, actions[:10])
    resumed.load_state_dict(env.state_dict())
    for theirs, ours in zip(resumed.starts, env.starts, strict=True):
        theirs.generator.set_state(ours.generator.get_state())
    for one, other in zip(play(resumed, actions[10:]), play(env, actions[10:]), strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one)
