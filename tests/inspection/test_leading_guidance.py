"""The guidance that leads the Sun: its phase, where its camera looks, how it turns, and that it is safe by itself."""

import math
from dataclasses import replace

import pytest
import torch

from inspection import guidance
from inspection.guidance import natural_motion
from inspection.model.attitude import dot, rotate, unit
from inspection.model.dynamics import step, sun_direction
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from inspection.orbits import GUIDANCE, Lead, Orbit
from inspection.transition import METRICS
from study.config import Config
from study.experiment import Experiment
from study.experiment import test_cases as common_cases
from study.flight.evaluation import Episodes, run_episodes

C = InspectionParameters()
LEADING = [name for name, orbit in GUIDANCE.items() if orbit.lead]
LEAD = Lead(behind=math.radians(40), ahead=math.radians(60), begin=0.3, end=0.9)
UNSEEN = 3711  # seed of cases that neither the search nor the check has flown


def on_ellipse(orbit: Orbit, phase: float, theta_s: float) -> torch.Tensor:
    """Returns the state (16, 1) of the free motion at a phase, with the camera on the chief."""
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    n, a, b = C.mean_motion, orbit.out_of_plane, orbit.semi_minor
    cos, sin = math.cos(phase), math.sin(phase)
    x[P, 0] = torch.tensor([b * cos, 2 * b * sin, a * sin], dtype=torch.float64)
    x[V, 0] = n * torch.tensor([b * sin, -2 * b * cos, -a * cos], dtype=torch.float64)
    x[Q.start + 3], x[THETA_S], x[E] = 1.0, theta_s, 6.0
    return x


@pytest.mark.parametrize(
    ("score", "degrees"), [(0.0, -40), (0.3, -40), (0.6, 10), (0.75, 35), (0.9, 60), (1.0, 60)]
)
def test_the_phase_leads_the_sun_by_what_the_score_says(score: float, degrees: int) -> None:
    orbit = Orbit(semi_minor=55.0, out_of_plane=30.0, lead=LEAD)
    control = natural_motion(C, orbit=orbit, score=lambda: torch.tensor([score], dtype=torch.float64))
    theta = 0.7
    assert control(0.0, on_ellipse(orbit, theta - math.radians(degrees), theta))[:3].abs().max() < 1e-12
    assert control(0.0, on_ellipse(orbit, theta - math.radians(degrees + 1), theta))[:3].abs().max() > 1e-4


def test_the_way_leads_along_a_great_circle_to_the_ellipse() -> None:
    orbit, n, draws = GUIDANCE["quick"], C.mean_motion, torch.Generator().manual_seed(0)
    away = 50.0 + 100.0 * torch.rand(1000, generator=draws, dtype=torch.float64)
    p = unit(torch.randn(3, 1000, generator=draws, dtype=torch.float64)) * away
    wanted = 2.0 * math.pi * torch.rand(1000, generator=draws, dtype=torch.float64)
    aim, velocity = guidance.target_on_great_circle(p, wanted, orbit, n)
    ends = [on_ellipse(orbit, phase, 0.0) for phase in wanted.tolist()]
    end, moving = (torch.cat([x[part] for x in ends], 1) for part in (P, V))
    # directions from the chief where the ellipse is a circle
    here, there, to = (unit(torch.stack((x, y / 2, z))) for x, y, z in (p, end, aim))
    angle, ahead, left = (
        dot(*pair).clamp(-1.0, 1.0).arccos() for pair in ((here, there), (here, to), (to, there))
    )
    torch.testing.assert_close(ahead, angle.clamp(max=orbit.look_ahead), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(left, angle - ahead, rtol=1e-5, atol=1e-5)  # on the circle between the two
    arrived = angle < orbit.look_ahead
    assert 100 < arrived.sum() < 900
    torch.testing.assert_close(aim[:, arrived], end[:, arrived])
    torch.testing.assert_close(velocity[:, arrived], moving[:, arrived])


def seen_from(angle: float, energy: float, sun_to_camera: float = 180.0) -> tuple[float, float]:
    """Returns angles in deg of `watch` off chief and Sun, from the angles of position and camera off the Sun."""
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    x[E], x[THETA_S] = energy, 0.0
    half = math.radians(sun_to_camera) / 2  # of a turn about z
    x[Q, 0] = torch.tensor([0.0, 0.0, math.sin(half), math.cos(half)], dtype=torch.float64)
    sun = sun_direction(x[THETA_S])
    radians = math.radians(angle)
    outward = torch.tensor([[math.cos(radians)], [0.0], [math.sin(radians)]], dtype=torch.float64)
    camera = guidance.camera_direction(x, outward, sun, C)
    assert camera.norm().item() == pytest.approx(1.0)
    off_chief, off_sun = (
        math.degrees(dot(camera, each).clamp(-1, 1).arccos().item()) for each in (-outward, sun)
    )
    return off_chief, off_sun


def test_the_camera_is_on_the_chief_as_far_as_the_battery_allows() -> None:
    balanced = math.degrees(
        math.acos(15.0 / (983.3 * 0.77 * 0.03))
    )  # the panels make 15 W so far off the Sun
    for angle, tilt in ((0, 0.0), (45, 0.0), (60, 60 - balanced), (80, 18.0)):  # of a full battery
        assert seen_from(angle, 7.0) == pytest.approx((tilt, 180 - angle + tilt), abs=1e-4)
    # half a turn takes 90 s and 1.35 kJ, and moves the limit by 0.16 kJ: in all 1.51 kJ above 1 kJ
    assert seen_from(80, 2.5) == pytest.approx((80.0, 180.0), abs=1e-4)
    off_chief, _ = seen_from(80, 1.0 + 2 * 1.507)  # half way to that
    assert off_chief == pytest.approx(80 - balanced / 2, abs=0.1)
    # nothing of the dark side can be seen
    assert seen_from(120, 7.0) == pytest.approx((120.0, 180.0), abs=1e-4)
    # and not past the Sun
    assert seen_from(60, 7.0, sun_to_camera=50) == pytest.approx((60.0, 180.0), abs=1e-4)


@pytest.mark.parametrize("every", [pytest.param(1.0, marks=pytest.mark.campaign), 10.0])
@pytest.mark.parametrize("turned", [pytest.param(60.0, marks=pytest.mark.campaign), 178.0])
def test_a_camera_that_looks_the_other_way_turns_in_time_and_the_thermal_side_to_the_shade(
    turned: float, every: float
) -> None:
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    half = math.radians(turned) / 2
    x[Q, 0] = torch.tensor([0.0, math.sin(half), 0.0, math.cos(half)], dtype=torch.float64)
    x[E], x[T] = 6.0, 5.0
    direction = torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64)
    sun = unit(torch.tensor([[-1.0], [-1.0], [0.2]], dtype=torch.float64))  # unturned, n_y looks away from it
    fastest = 0.0
    frequency = min(guidance.POINTING_FREQUENCY, guidance.HELD / every)
    for _ in range(round(600 / every)):
        u = torch.cat((torch.zeros(3, 1).double(), guidance.pointing_torque(x, direction, sun, C, frequency)))
        limit = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
        u = u.clamp(-limit, limit)
        for _ in range(round(every)):
            x = step(x, u, 1.0, replace(C, saturate_rates=False))
            fastest = max(fastest, x[OMEGA].abs().max().item())
    camera, cold = (
        rotate(x[Q], torch.tensor(axis, dtype=torch.float64)[:, None])
        for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    )
    assert dot(camera, direction).arccos().item() < math.radians(2)
    # the cold side's part across the camera's axis
    assert dot(cold, unit(sun - dot(sun, camera) * camera)).item() > math.cos(math.radians(5))
    assert fastest < C.max_rate


@pytest.mark.parametrize("every", [1.0, 30.0])
def test_the_nearest_body_axis_rolls_to_the_thrust_and_the_camera_stays(every: float) -> None:
    degrees = torch.tensor([-170.0, -130.0, -100.0, -50.0, -20.0, 5.0, 40.0, 50.0, 85.0, 140.0])
    radians, axes = degrees.double().deg2rad(), torch.eye(3, dtype=torch.float64)
    x = torch.zeros(SIZE, len(degrees), dtype=torch.float64)
    x[Q.start + 3], x[E], x[T], x[THETA_S] = 1.0, 6.0, 5.0, math.radians(100)
    direction, limit = axes[:, :1].expand(-1, len(degrees)), torch.tensor(C.control_limit).double()[:, None]
    thrust = 0.05 * torch.stack((torch.ones_like(radians), radians.cos(), radians.sin()))
    frequency, steps = guidance.pointing_frequency(every), math.ceil(every / 5.0)
    fastest, unsaturated = 0.0, replace(C, saturate_rates=False)
    for _ in range(max(60, round(200 / every))):
        torque = guidance.pointing_torque(x, direction, sun_direction(x[THETA_S]), C, frequency, thrust)
        u = torch.cat((torch.zeros_like(torque), torque)).clamp(-limit, limit)
        for _ in range(steps):
            x = step(x, u, every / steps, unsaturated)
            fastest = max(fastest, x[OMEGA].abs().max().item())
    camera, y = (rotate(x[Q], axes[:, [i]]) for i in (0, 1))
    rolled = torch.atan2(y[2], y[1]).rad2deg()
    nearest = (degrees / 90).round() * 90
    torch.testing.assert_close(rolled, (degrees - nearest).double(), atol=0.1, rtol=0.0)
    assert camera[0].min() > math.cos(1e-3) and fastest < C.max_rate


def flown(cases: int) -> Episodes:
    """Flies all leading guidance one after the other, every 10 s and without filter, in the same unseen cases."""
    config = Config()
    config = replace(config, train=replace(config.train, rta=False, device="cpu", compile="on"))
    count = cases * len(LEADING)
    experiment = Experiment(config, count)
    env = experiment.env(count, experiment.generators([1]), compiled=True)
    controllers = [natural_motion(env.c, 10.0, GUIDANCE[name], env.sight.score) for name in LEADING]

    def control(t: float, x: torch.Tensor) -> torch.Tensor:
        every = [controller(t, x).split(cases, 1)[i] for i, controller in enumerate(controllers)]
        return torch.cat(every, 1)

    return run_episodes(env, control, common_cases(config, cases, UNSEEN).repeat(len(LEADING)))


@pytest.fixture(scope="module", params=[2, pytest.param(32, marks=pytest.mark.campaign)])
def record(request: pytest.FixtureRequest) -> Episodes:
    return flown(request.param)


def means(record: Episodes) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns each guidance's mean time in s and delta v in m/s."""
    rows = (record.metrics[METRICS.index(name)] for name in ("episode_length_s", "delta_v_m_s"))
    time, fuel = (row.unflatten(0, (len(LEADING), -1)).mean(1) for row in rows)
    return time, fuel


def test_every_lead_is_safe_by_itself_and_who_spends_more_is_quicker(record: Episodes) -> None:
    assert record.clean.all()
    time, fuel = means(record)
    assert LEADING == ["thrifty", "calm", "even", "brisk", "quick"]
    assert (time.diff() < 0.0).all() and (fuel.diff() > 0.0).all()


@pytest.mark.campaign
def test_the_roll_saves_fuel_of_every_lead_and_takes_no_time(
    record: Episodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guidance, "MUCH", math.inf)  # the roll is to the shade alone
    (time, fuel), (shaded_time, shaded_fuel) = (
        means(record),
        means(flown(record.metrics.shape[1] // len(LEADING))),
    )
    assert (fuel < 0.97 * shaded_fuel).all() and fuel.sum() < 0.95 * shaded_fuel.sum()
    assert (time < 1.005 * shaded_time).all()


@pytest.mark.campaign
def test_a_camera_that_never_leaves_the_chief_is_found_to_break_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(guidance, "camera_direction", lambda x, outward, sun, c: -outward)
    assert not flown(4).clean.all()
