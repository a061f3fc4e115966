"""Every constant of the inspection task, with its unit, its source and its allowed values: model, limits and episode.

"Sec." and "Eq." refer to Dunlap et al., AFRL-2024-3223. Entries marked (decision) fill a gap or a contradiction in the
paper; docs/reference/differences.md gives the reason for each.
"""

import math
from dataclasses import dataclass

from settings import Settings, setting

SLOWEST_ORBIT = 1e-12  # rad/s; so slow that nothing turns
ALIGNED = (0.0, 0.0, 0.0, 1.0)  # the attitude of a frame whose axes are those of the other frame
FASTEST_CHIEF = 10.0  # deg/s; an action takes 10 s
MOST_UNEQUAL = 1000.0  # ratio of a chief's moments; the chief may come to turn faster by its square root
AXES = {"+x": (0, 1.0), "-x": (0, -1.0), "+y": (1, 1.0), "-y": (1, -1.0), "+z": (2, 1.0), "-z": (2, -1.0)}

# Groups of components that an agent may observe, see `inspection.observation`: the paper's, the axes of Hill's frame,
# where free flight passes the chief, and how the chief turns.
OBSERVED = (
    *("position", "velocity", "angular_velocity", "energy", "temperature"),
    *("sun", "priority", "uninspected", "score"),
)
OBSERVABLE = (*OBSERVED, "hill", "free_flight", "chief")


@dataclass(frozen=True)
class Model(Settings):
    """Holds the constants of a deputy spacecraft's motion, temperature and battery (Sec. Dynamics)."""

    mean_motion: float = setting(
        0.001027,
        "rad/s, of the chief's orbit",
        least=SLOWEST_ORBIT,
        note="Orbit and translation (Sec. Dynamics, Translational Motion)",
    )
    mass: float = setting(12.0, "kg, of the deputy", above=0)
    max_thrust: float = setting(1.0, "N, per body axis", above=0)

    hill_rotation: bool = setting(
        False,
        "(decision) body rates are relative to the stars, while Hill's frame turns",
        note="Attitude (Sec. Dynamics, Attitude)",
    )
    inertia: tuple[float, float, float] = setting(
        (0.0573, 0.0573, 0.0573), "kg m^2, principal moments", above=0
    )
    wheel_inertia: float = setting(4.1e-5, "kg m^2, D, of each reaction wheel", above=0)
    max_angular_acceleration: float = setting(0.017453, "rad/s^2, per body axis; limits the torque", above=0)
    max_wheel_acceleration: float = setting(
        181.3, "rad/s^2, of each reaction wheel; limits the torque", above=0
    )
    saturate_rates: bool = setting(True, "(decision) the plant holds each body rate within max_rate")

    thermal_axis: str = setting(
        "-y",
        "body axis of the tracked surface",
        among=AXES,
        note="Temperature of the -n_y side (Sec. Dynamics, Temperature)",
    )
    absorptivity: float = setting(0.13, "of the surface for sunlight, no unit", most=1)
    emissivity: float = setting(0.06, "of the surface, no unit", most=1)
    surface_area: float = setting(0.03, "m^2, also the solar panels' area", above=0)
    node_mass: float = setting(2.0, "kg, that is heated", above=0)
    specific_heat: float = setting(900.0, "J/(kg K), of that mass", above=0)
    solar_constant: float = setting(1367.0, "W/m^2, sunlight")
    albedo: float = setting(0.27, "share of the sunlight that the Earth reflects", most=1)
    view_factor: float = setting(0.8, "no unit, F_E = 0.8 cos(theta_EI)", most=1)
    earth_temperature: float = setting(255.0, "K, of the Earth as a radiator")
    stefan_boltzmann: float = setting(5.67051e-8, "W/(m^2 K^4), constant of radiation")
    zero_celsius: float = setting(273.15, "K, of 0 deg C", above=0)

    solar_panel_axis: str = setting(
        "-x",
        "body axis that the solar panels face (decision: the paper's text says +x, see docs/reference/differences.md)",
        among=AXES,
        note="Energy (Sec. Dynamics, Energy)",
    )
    panel_performance: float = setting(983.3, "W/m^2, P_I, in full sunlight")
    panel_degradation: float = setting(0.77, "share that degradation leaves, I_d", most=1)
    power_draw: float = setting(15.0, "W, P_out, of the spacecraft")

    substep: float = setting(1.0, "s, longest integration step", above=0, most=5, note="Simulation")

    def __post_init__(self) -> None:
        super().__post_init__()
        rounding = 1 + 1e-9  # for a flat plate, whose largest moment equals the sum of the others
        if 2 * max(self.inertia) > rounding * sum(self.inertia):
            raise ValueError(
                f"inertia = {list(self.inertia)}: no body has a moment above the sum of the other two"
            )

    @property
    def max_torque(self) -> float:
        """Returns tau_max = min(J domega_max, D dpsi_max) in N m, the smallest over the axes."""
        return min(
            min(self.inertia) * self.max_angular_acceleration,
            self.wheel_inertia * self.max_wheel_acceleration,
        )

    @property
    def control_limit(self) -> tuple[float, ...]:
        """Returns the actuator limits of the six controls: N, N, N, N m, N m, N m."""
        return (self.max_thrust,) * 3 + (self.max_torque,) * 3

    def largest_drift(self, distance: float, speed: float) -> float:
        """Returns the largest natural acceleration in m/s^2 within a distance in m of the chief, up to a speed in m/s.

        Gravity's gradient is at most 3 n^2 per m, the Coriolis acceleration 2 n per m/s.
        """
        n = self.mean_motion
        return 3 * n**2 * distance + 2 * n * speed


@dataclass(frozen=True)
class Limits(Model):
    """Holds the model and the limits: all of the task on which a filter's guarantee depends."""

    deputy_radius: float = setting(
        5.0, "m, r_d, of the deputy's sphere", above=0, note="Safety limits (Sec. Safety Constraints)"
    )
    chief_radius: float = setting(10.0, "m, r_c, of the chief's sphere", above=0)
    max_distance: float = setting(800.0, "m, r_max, keep-in zone", above=0)
    docking_speed: float = setting(0.2, "m/s, nu_0, speed limit at the chief")
    speed_slope: float = setting(
        7.5 * 0.001027, "1/s, nu_1 = 7.5 n, by which that limit grows with distance", least=0
    )
    max_speed: float = setting(5.0, "m/s per Hill axis, v_max", above=0)
    passive_safety_horizon: float = setting(
        500.0, "s, T_f, of free flight that stays clear of the chief", above=0
    )
    field_of_view: float = setting(
        math.radians(60.0), "rad, alpha_FOV, full cone angle", above=0, most=math.pi
    )
    exclusion_buffer: float = setting(
        math.radians(10.0), "rad, beta, kept beyond half the field of view", least=0
    )
    max_temperature: float = setting(10.0, "deg C, of the surface", least=None)
    temperature_sun_slope: float = setting(0.05, "deg C/rad, delta_0")
    temperature_earth_slope: float = setting(0.01, "deg C/rad, delta_1")
    min_energy: float = setting(1.0, "kJ, in the battery")
    energy_sun_slope: float = setting(0.05, "kJ/rad, delta_2")
    max_rate: float = setting(math.radians(2.0), "rad/s, omega_max, per body axis", above=0)

    initial_energy: tuple[float, float] = setting(
        (5.0, 7.0),
        "kJ, range of the first energy",
        ordered=True,
        note="Where episodes begin, and campaigns that verify a filter (Sec. Initial and Terminal Conditions)",
    )
    initial_temperature: tuple[float, float] = setting(
        (3.0, 7.0), "deg C, range of the first temperature", ordered=True, least=None
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.field_of_view / 2 + self.exclusion_buffer >= math.pi:
            raise ValueError("field_of_view / 2 + exclusion_buffer must be below pi rad")
        if self.max_distance <= self.collision_radius:
            raise ValueError(
                f"max_distance = {self.max_distance:g}: must exceed deputy_radius + chief_radius, "
                f"{self.collision_radius:g} m"
            )
        if self.initial_temperature[0] <= -self.zero_celsius:
            raise ValueError(
                f"initial_temperature = {list(self.initial_temperature)!r}: must be above absolute zero, in deg C"
            )

    @property
    def collision_radius(self) -> float:
        """Returns r_d + r_c in m."""
        return self.deputy_radius + self.chief_radius

    @property
    def planes(self) -> tuple[tuple[float, ...], ...]:
        """Returns the planes of the chief's hull if the task avoids it (`inspection.chief.hull`), none for a sphere."""
        return ()

    @property
    def least_distance(self) -> float:
        """Returns the smallest distance in m from the chief's centre at which the deputy touches the chief."""
        return self.collision_radius

    @property
    def max_acceleration(self) -> float:
        """Returns a_max of the collision and keep-in constraints in m/s^2 (decision): thrust less the worst drift.

        a_max = F_max / m - 3 n^2 r_max - 2 n v_max with v_max = min(max_speed, nu_0 + nu_1 r_max).
        """
        speed = min(self.max_speed, self.docking_speed + self.speed_slope * self.max_distance)
        return self.max_thrust / self.mass - self.largest_drift(self.max_distance, speed)


@dataclass(frozen=True)
class Episode(Settings):
    """Holds the agent's task, observations and rewards; a filter's guarantee does not depend on them."""

    num_points: int = setting(
        100, "points on the chief", above=0, most=100_000, note="Episode (Sec. RL Environment)"
    )
    points_per_cluster: int = setting(10, "(decision) k = ceil(n / 10)", above=0)
    success_score: float = setting(0.95, "inspected score, 0 to 1, that ends an episode", above=0, most=1)
    action_period: float = setting(10.0, "s between two actions of the agent", above=0)
    observed: tuple[str, ...] = setting(OBSERVED, "by the agent; by default the paper's", among=OBSERVABLE)
    observation_scales: tuple[float, float, float] = setting(
        (100.0, 0.866, 0.035),
        "(decision) m, m/s and rad/s by which distance, speed and body rates are divided for the network",
        above=0,
    )
    max_time: float = setting(12236.0, "s, an episode at its longest: two orbits", above=0)
    initial_radius: tuple[float, float] = setting(
        (50.0, 100.0), "m, range of the first distance", above=0, ordered=True
    )

    points_reward: float = setting(1.0, "per score gained", note="Reward (Sec. Rewards)", least=None)
    delta_v_reward: float = setting(-0.02, "per m/s", least=None)
    torque_reward: float = setting(-0.1, "per N m", least=None)
    orientation_reward: float = setting(0.0005, "per action, at its most", least=None)
    orientation_width: float = setting(0.15, "misalignment, 1 - cos, of the decay by e", above=0)
    time_reward: float = setting(0.001, "per action", least=None)
    time_reward_until: float = setting(3000.0, "s, of the episode")
    terminal_reward: float = setting(1.0, "magnitude of success, crash, distance and energy terms")
    free_flight_horizon: float = setting(
        172800.0, "s, two days of free flight: rewarded at success, and observed", above=0
    )

    fuel_reward: float = setting(
        0.0,
        "per m/s, on top of delta_v_reward; grows from 0 at the start of training to this at its end",
        note="Our own terms, which the learner is given beside the paper's; the reward that is reported has none",
        least=None,
    )
    duration_reward: float = setting(0.0, "per action", least=None)
    rate_reward: float = setting(0.0, "per action and axis turning at max_rate, by its square", least=None)
    correction_reward: float = setting(
        0.0, "per action, where the filter corrects all of its calls", least=None
    )
    limit_reward: float = setting(
        0.0, "per action and limit reached; less from `reward.NEAR` on, more beyond", least=None
    )
    drift_reward: float = setting(
        0.0, "per action, where free flight crosses the chief's track; less up to 30 m off", least=None
    )


@dataclass(frozen=True)
class InspectionParameters(Episode, Limits):
    """Holds the constants of dynamics, limits, chief, episode and reward; values are the paper's unless marked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = self.action_period / self.substep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-9:
            raise ValueError(
                f"substep = {self.substep:g}: must divide action_period, {self.action_period:g} s"
            )


@dataclass(frozen=True)
class ChiefParameters(Settings):
    """Describes what is inspected, and how it turns; by default the paper's sphere, fixed in Hill's frame."""

    mesh: str = setting(
        "",
        "in m, .npz, .stl or another that trimesh reads; `#` and how its sha256 begins are added where it is used",
    )
    attitude: tuple[float, float, float, float] = setting(
        ALIGNED, "at first, from its axes to Hill's, scalar last", least=None
    )
    random_attitude: bool = setting(False, "drawn for each episode instead, any")
    rate: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "deg/s, at first, about its principal axes", least=None
    )
    largest_rate: float = setting(
        0.0,
        "deg/s; above 0 the rate is drawn: any axis, any size up to this",
        most=FASTEST_CHIEF,
    )
    moments: tuple[float, float, float] = setting(
        (1.0, 1.0, 1.0), "principal moments; only their ratios count", above=0
    )
    collision: str = setting(
        "sphere",
        "what to stay clear of (the sphere of chief_radius, or the mesh's convex hull)",
        among=("sphere", "hull"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.attitude):
            raise ValueError(f"attitude = {list(self.attitude)}: must not be zero")
        if math.hypot(*self.rate) > FASTEST_CHIEF:
            raise ValueError(f"rate = {list(self.rate)}: must be at most {FASTEST_CHIEF:g} deg/s")
        if self.largest_rate and any(self.rate):
            raise ValueError(
                f"rate = {list(self.rate)}: is drawn, since largest_rate is {self.largest_rate:g}"
            )
        if 2.0 * max(self.moments) > (1.0 + 1e-9) * sum(self.moments):
            raise ValueError(f"moments = {list(self.moments)}: must have none above the sum of the other two")
        if max(self.moments) > MOST_UNEQUAL * min(self.moments):
            raise ValueError(
                f"moments = {list(self.moments)}: must not differ by more than a factor of {MOST_UNEQUAL:g}"
            )
        if self.collision == "hull" and not self.mesh:
            raise ValueError("collision = 'hull': needs a mesh")
        if self.collision == "hull" and (self.turns or self.random_attitude):
            raise ValueError(
                "collision = 'hull': must be of a mesh that holds still, without rate, largest_rate and random_attitude"
            )

    @property
    def is_the_papers(self) -> bool:
        """Checks whether the chief is the sphere, fixed in Hill's frame."""
        return self == ChiefParameters()

    @property
    def is_drawn(self) -> bool:
        """Checks whether the chief differs between episodes."""
        return self.random_attitude or self.largest_rate > 0.0

    @property
    def turns(self) -> bool:
        """Checks whether the chief's attitude changes over time."""
        return any(self.rate) or self.largest_rate > 0.0
