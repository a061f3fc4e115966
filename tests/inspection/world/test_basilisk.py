"""Basilisk as the plant: against Newton's gravity by an adaptive integrator, our own model, and closed forms.

What needs Basilisk skips itself where that is not installed; `.ci/run` has an environment with it.
"""

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from torch import Tensor

import main
from inspection.environment import InspectionEnv
from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, THRUST, TORQUE, E, P, Q, T, V
from inspection.transition import METRICS
from inspection.world import basilisk
from inspection.world.basilisk import (
    EARTH_J2,
    EARTH_MU,
    EARTH_RADIUS,
    INCLINATION,
    PULSE,
    BasiliskPlant,
    chief_in_space,
    hill,
    orbit_radius,
)
from inspection.world.parameters import PlantParameters
from study import experiment
from tests.test_main import call

C = InspectionParameters(saturate_rates=False)
FREE = PlantParameters(simulator="basilisk", saturate_rates=False)
needs_basilisk = pytest.mark.skipif(not find_spec("Basilisk"), reason="needs Basilisk (package bsk)")


def begun(parameters: PlantParameters, x: Tensor, c: InspectionParameters = C) -> BasiliskPlant:
    plant = BasiliskPlant(parameters, c, x.shape[1], "cpu")
    plant.begin(torch.arange(x.shape[1]), x, torch.linspace(0.1, 0.9, x.shape[1], dtype=torch.float64))
    return plant


def resting(batch: int = 1) -> Tensor:
    x = torch.zeros(SIZE, batch, dtype=torch.float64)
    x[P.start], x[Q.stop - 1], x[E], x[T] = 100.0, 1.0, 6.0, 5.0
    return x


def nothing(x: Tensor) -> Tensor:
    return torch.zeros_like(x[:6])


def test_without_basilisk_a_line_says_so(monkeypatch, capsys) -> None:
    monkeypatch.setattr(experiment, "find_spec", lambda name: None)
    assert main.main(["evaluate", "--plant", "basilisk", "--controller", "zero", "--episodes", "1"]) == 2
    (message,) = capsys.readouterr().err.strip().splitlines()
    assert message.startswith("error:") and "basilisk.md" in message


def test_states_go_into_space_and_come_back(random_states) -> None:
    x = random_states(20)
    frame = hill(chief_in_space(x[THETA_S], C))
    back = frame.inwards(*frame.outwards(x.numpy()))
    np.testing.assert_allclose(back[:6], x[:6], rtol=0, atol=1e-8)
    same = Rotation.from_quat(back[Q].T).inv() * Rotation.from_quat(x[Q].T.numpy())
    assert same.magnitude().max() < 1e-14
    np.testing.assert_array_equal(back[OMEGA], x[OMEGA])


def test_the_chief_is_on_its_circle_and_the_sun_where_its_angle_says(random_states) -> None:
    sun = random_states(20)[THETA_S]
    chief = chief_in_space(sun, C)
    r, v = chief[:3], chief[3:]
    radius = np.linalg.norm(r, axis=0)
    np.testing.assert_allclose(np.linalg.norm(v, axis=0), C.mean_motion * radius, rtol=1e-12)
    np.testing.assert_allclose((v * v).sum(0), EARTH_MU / radius, rtol=1e-12)  # of a circle
    np.testing.assert_allclose((r * v).sum(0) / (r * r).sum(0), 0.0, atol=1e-15)
    momentum = np.cross(r, v, axis=0)
    np.testing.assert_allclose(momentum[2] / np.linalg.norm(momentum, axis=0), math.cos(INCLINATION))
    seen = hill(chief).axes.inv().apply([1.0, 0.0, 0.0])  # the Sun, from Hill's frame
    np.testing.assert_allclose(seen, np.stack((sun.cos(), sun.sin(), 0 * sun), 1), atol=1e-12)


@needs_basilisk
def test_coasting_is_newtons_gravity_and_our_turning_frame(random_states) -> None:
    """Position and velocity as DOP853 has them in an inertial frame; the rest as our model with `hill_rotation`."""
    x = random_states(8)
    plant = begun(FREE, x, C)
    there = plant.integrate(x, nothing(x), plant.body, 1.0, 1000)
    frame = hill(chief_in_space(x[THETA_S], C))
    r, v, *rest = frame.outwards(x.numpy())
    start = np.stack((frame.chief, np.concatenate((r.T, v.T))))
    end = solve_ivp(attracted, (0.0, 1000.0), start.ravel(), "DOP853", rtol=1e-13, atol=1e-9).y[:, -1]
    chief, deputy = end.reshape(start.shape)
    moved = hill(chief).inwards(deputy[:3].T, deputy[3:].T, *rest)
    np.testing.assert_allclose(there[P], moved[P], rtol=0, atol=1e-6)
    np.testing.assert_allclose(there[V], moved[V.start : V.stop], rtol=0, atol=1e-9)
    own = integrate(x, nothing(x), 1.0, replace(C, hill_rotation=True), 1000)
    turned = Rotation.from_quat(own[Q].T.numpy()).inv() * Rotation.from_quat(there[Q].T.numpy())
    assert math.degrees(turned.magnitude().max()) < 2e-5
    torch.testing.assert_close(there[OMEGA], own[OMEGA], rtol=0, atol=1e-14)
    torch.testing.assert_close(there[THETA_S], own[THETA_S], rtol=0, atol=1e-10)
    torch.testing.assert_close(there[[T, E]], own[[T, E]], rtol=0, atol=1e-3)
    papers = integrate(x, nothing(x), 1.0, C, 1000)  # the paper's, without the turning of Hill's frame
    assert (there[P] - papers[P]).norm(dim=0).max() > 1e-3
    turned = Rotation.from_quat(papers[Q].T.numpy()).inv() * Rotation.from_quat(there[Q].T.numpy())
    assert math.degrees(turned.magnitude().min()) > 45.0


def attracted(_: float, s: np.ndarray) -> np.ndarray:
    """Newton's gravity of a point mass on chiefs and deputies (2, 6, k), flat."""
    r, v = np.split(s.reshape(2, 6, -1), 2, axis=1)
    return np.concatenate((v, -EARTH_MU * r / np.linalg.norm(r, axis=1, keepdims=True) ** 3), axis=1).ravel()


def flattened(_: float, s: np.ndarray) -> np.ndarray:
    """Returns gravity of an Earth with J2 (Vallado 2013, Eq. 8-27)."""
    r, mu = s[:3], EARTH_MU
    size = np.linalg.norm(r)
    k, z = 1.5 * EARTH_J2 * mu * EARTH_RADIUS**2 / size**5, 5 * (r[2] / size) ** 2
    return np.concatenate((s[3:], -mu * r / size**3 + k * r * (z - np.array([1.0, 1.0, 3.0]))))


@needs_basilisk
def test_j2_is_that_of_an_adaptive_integrator(random_states) -> None:
    x = random_states(3)
    plant = begun(replace(FREE, j2=True), x)
    before = hill(plant.chief.numpy(), plant.flattening)
    r, v, _, _ = before.outwards(x.numpy())
    there = plant.integrate(x, nothing(x), plant.body, 1.0, 500)
    after_r, after_v, _, _ = hill(plant.chief.numpy(), plant.flattening).outwards(there.numpy())
    for i in range(3):
        start = np.concatenate((r[i], v[i]))
        end = solve_ivp(flattened, (0, 500), start, "DOP853", rtol=1e-13, atol=1e-9).y[:, -1]
        np.testing.assert_allclose(after_r[i], end[:3], rtol=0, atol=1e-5)
        np.testing.assert_allclose(after_v[i], end[3:], rtol=0, atol=1e-8)
    still = begun(FREE, x)
    assert (still.integrate(x, nothing(x), still.body, 1.0, 500)[P] - there[P]).norm(dim=0).max() > 0.01


@needs_basilisk
def test_a_state_read_within_a_step_is_near_basilisks_and_moves_nothing(random_states) -> None:
    """Of a whole second; J2 is not in what is read."""
    x = random_states(8)
    plant = begun(replace(FREE, j2=True), x)
    u = nothing(x) + x.new_tensor([0.9, -0.5, 0.3, 5e-4, -3e-4, 2e-4])[:, None]
    before = plant.state_dict()
    read = plant.read(x, u, plant.body, torch.ones_like(x[0]))
    assert all(torch.equal(before[name], now) for name, now in plant.state_dict().items())
    there = plant.integrate(x, u, plant.body, 1.0)
    assert (read - there)[P].norm(dim=0).max() < 1e-4 and (read - there)[V].norm(dim=0).max() < 1e-4
    assert (read - there)[OMEGA].norm(dim=0).max() < 1e-6
    turned = Rotation.from_quat(read[Q].T.numpy()).inv() * Rotation.from_quat(there[Q].T.numpy())
    assert math.degrees(turned.magnitude().max()) < 1e-3


@needs_basilisk
def test_velocity_is_the_change_of_position_in_a_frame_that_j2_tilts(random_states) -> None:
    """By central differences over two seconds; the frame's small turn about x comes to a thousand times more."""
    x = random_states(20)
    plant = begun(replace(FREE, j2=True), x)
    path = [x]
    for _ in range(2):
        path.append(plant.integrate(path[-1], nothing(x), plant.body, 1.0))
    change = (path[2][P] - path[0][P]) / 2
    assert (change - path[1][V]).abs().max() < 1e-6
    untilted = hill(plant.chief.numpy())
    tilt = hill(plant.chief.numpy(), plant.flattening).turning - untilted.turning
    assert np.abs(tilt[0]).max() * x[P].norm(dim=0).max() > 1e-4


@needs_basilisk
def test_drag_brakes_chief_and_deputy_by_their_areas() -> None:
    x = resting()
    air, none = begun(replace(FREE, drag=True), x), begun(FREE, x)
    seconds = 1000
    with_air, without = (each.integrate(x, nothing(x), each.body, 1.0, seconds) for each in (air, none))
    n = C.mean_motion
    radius = orbit_radius(C)
    density = basilisk.AIR * math.exp(-(radius - EARTH_RADIUS - basilisk.AIR_BASE) / basilisk.AIR_SCALE)
    pressure = 0.5 * density * (radius * n) ** 2 * basilisk.DRAG_COEFFICIENT
    apart = pressure * (basilisk.CHIEF_AREA_PER_MASS - basilisk.DEPUTY_AREA / C.mass)  # m/s^2 along the track
    # an acceleration along the track moves by a (4 (1 - cos nt) / n^2 - 3 t^2 / 2), Clohessy and Wiltshire
    expected = apart * (4 * (1 - math.cos(n * seconds)) / n**2 - 1.5 * seconds**2)
    found = (with_air - without)[P.start + 1].item()
    assert found == pytest.approx(expected, rel=0.02)


@needs_basilisk
def test_forces_and_torques_act_on_the_body_that_was_drawn() -> None:
    plant = begun(replace(FREE, mass_factor=1.25, inertia_factor=0.8, acceleration=0.01), resting())
    x = plant.integrate(resting(), nothing(resting()), plant.body, 1.0)
    torch.testing.assert_close(x[V].norm(), torch.tensor(0.01).double(), rtol=0.05, atol=0)
    u = nothing(resting())
    u[1], u[5] = 0.5, 1e-4
    forced = plant.integrate(resting(), u, plant.body, 1.0)
    assert (forced - x)[V.start + 1].item() == pytest.approx(0.5 / 15.0, rel=1e-3)
    assert forced[OMEGA.start + 2].item() == pytest.approx(1e-4 / (0.8 * 0.0573), rel=1e-9)


@needs_basilisk
def test_wheels_turn_the_body_by_their_reaction_and_keep_the_momentum() -> None:
    plant = begun(replace(FREE, actuators="real"), resting())
    u = nothing(resting())
    u[TORQUE.start] = 1e-4
    x = plant.integrate(resting(), u, plant.body, 1.0, 1)
    x = plant.integrate(x, u, plant.body, 1.0, 1)
    rate, wheel = x[OMEGA.start].item(), plant.wheels[0].item()
    assert rate == pytest.approx(2e-4 / (0.0573 - C.wheel_inertia), rel=1e-6)
    assert 0.0573 * rate + C.wheel_inertia * wheel == pytest.approx(0.0, abs=1e-12)
    assert not plant.wheels[1:].abs().max() > 1e-9


@needs_basilisk
def test_thrusters_give_pulses_of_full_thrust() -> None:
    """A sixth of a step of the integrator short."""
    thrust = torch.tensor([0.0, 0.009, 0.011, 0.3, -0.513, 1.0], dtype=torch.float64)
    x = resting(len(thrust))
    plant, coasting = begun(replace(FREE, actuators="real"), x), begun(FREE, x)
    u = nothing(x)
    u[THRUST.start + 2] = thrust
    gained = plant.integrate(x, u, plant.body, 1.0) - coasting.integrate(x, nothing(x), coasting.body, 1.0)
    steps = (thrust.abs() / PULSE).round()
    expected = thrust.sign() * PULSE * (steps - 1 / 6).clamp(min=0.0) / C.mass
    torch.testing.assert_close(gained[V.start + 2], expected, rtol=0, atol=1e-6)
    acting = plant.actuate(torch.zeros_like(thrust), u)[THRUST.start + 2]
    torch.testing.assert_close(acting / C.mass, expected, rtol=0, atol=1e-6)


@needs_basilisk
def test_delta_v_is_of_the_pulses_that_acted_and_not_of_what_was_asked_for() -> None:
    c = InspectionParameters()
    plant = PlantParameters(simulator="basilisk", actuators="real")
    for asked, pulses in ((0.008, 0), (0.013, 1), (0.5, 25)):
        env = InspectionEnv(1, c, [torch.Generator().manual_seed(0)], plant=plant)
        env.reset()
        step = env.step(torch.tensor([[asked, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        gained = c.action_period * PULSE * max(pulses - 1 / 6, 0.0) / c.mass
        assert step.metrics[METRICS.index("delta_v_m_s")].item() == pytest.approx(gained, abs=1e-9)


def test_what_a_simulator_does_not_have_is_refused() -> None:
    for parameters, words in (
        (PlantParameters(j2=True), "j2: needs --plant basilisk"),
        (PlantParameters(simulator="own", actuators="real"), "actuators: needs --plant basilisk"),
        (replace(FREE, actuators="real", thrust_gain=1.1), "thrust_gain: is not there"),
    ):
        with pytest.raises(ValueError, match=words):
            parameters.check_simulator()
    with pytest.raises(ValueError, match="j2"):
        InspectionEnv(1, C, [torch.Generator()], plant=PlantParameters(j2=True))


@needs_basilisk
def test_an_orbit_below_the_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="5,848 km from the Earth's centre: must stay above its radius"):
        BasiliskPlant(FREE, replace(C, mean_motion=0.0014117), 1, "cpu")


@needs_basilisk
@pytest.mark.parametrize(("saturates", "rate"), [(True, math.radians(2.0)), (False, 0.05)])
def test_rates_saturate_only_where_the_plant_has_them_do_so(saturates: bool, rate: float) -> None:
    x = resting()
    x[OMEGA.start] = 0.05
    plant = begun(replace(FREE, saturate_rates=saturates), x, InspectionParameters())
    found = plant.integrate(x, nothing(x), plant.body, 1.0)[OMEGA.start].item()
    assert found == pytest.approx(rate, rel=1e-4)


@needs_basilisk
def test_a_world_at_its_corners_flies_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "report.json"
    flags = ["--config", "configs/plants/u1_basilisk.toml", "--errors", "worst", "--policy", "adversarial"]
    more = ["--episodes", "2", "--duration", "8", "--compile", "off", "--device", "cpu", "--json", str(path)]
    assert call(["verify", *flags, *more, "--keep-worst"], capsys)[0] == 0
    for constraint in ("keep_in_zone", "dynamic_speed"):
        code, _, err = call(["refly", f"{path}.{constraint}.npz"], capsys)
        assert code == 0, err


@needs_basilisk
def test_episodes_restart_and_a_resumed_run_goes_on_bit_by_bit() -> None:
    c = InspectionParameters(max_time=50.0, saturate_rates=False)
    parameters = replace(FREE, actuators="real", mass_factor=(0.9, 1.1))

    def made() -> InspectionEnv:
        return InspectionEnv(2, c, [torch.Generator().manual_seed(0)], plant=parameters)

    g = torch.Generator().manual_seed(1)
    actions = 0.2 * (2 * torch.rand(8, 2, 6, generator=g) - 1)
    env = made()
    env.reset()
    wheels = []
    for k, action in enumerate(actions):
        if k == 3:
            saved, states = env.state_dict(), [starts.generator.get_state() for starts in env.starts]
        env.step(action)
        wheels.append(env.plant.wheels.abs().max().item())
    assert wheels[3] > wheels[0] > 0.0 == wheels[4]  # the fifth step ended both episodes
    again = made()
    again.load_state_dict(saved)
    for starts, state in zip(again.starts, states, strict=True):
        starts.generator.set_state(state)
    for action in actions[3:]:
        again.step(action)
    assert torch.equal(again.x, env.x) and torch.equal(again.plant.chief, env.plant.chief)


@needs_basilisk
@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "--controller", "natural-motion", "--duration", "30", "--out", "run.npz"],
        ["verify", "--policy", "random", "--episodes", "4", "--duration", "20"],
    ],
)
def test_commands_fly_in_basilisk(words: list[str], tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call([*words, "--plant", "basilisk", "--compile", "off"], capsys)
    assert code == 0, err
    assert "violat" in out
