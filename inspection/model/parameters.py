"""Every constant of the inspection task, with its unit and its source, as one frozen dataclass.

"Sec." and "Eq." refer to Dunlap et al., AFRL-2024-3223. Entries marked (decision) fill a gap or a
contradiction in the paper; docs/reference/differences.md gives the reason for each.
"""

import math
from dataclasses import dataclass, fields

ORBITS = ("clohessy-wiltshire", "two-body")
SLOWEST_ORBIT = 1e-12  # rad/s; that slow, nothing turns
MOST_ECCENTRIC = (
    0.3  # beyond, Kepler's equation may not converge in the steps that `inspection.model.orbit` takes
)
ALIGNED = (0.0, 0.0, 0.0, 1.0)  # an attitude: the axes of one frame are those of the other
FASTEST_CHIEF = 10.0  # deg/s; an action takes 10 s
MOST_UNEQUAL = 1000.0  # moments of a chief, which may come to turn faster by the root of that
AXES = {"+x": (0, 1.0), "-x": (0, -1.0), "+y": (1, 1.0), "-y": (1, -1.0), "+z": (2, 1.0), "-z": (2, -1.0)}

POSITIVE = (
    "mean_motion gravitational_parameter mass max_thrust wheel_inertia max_angular_acceleration max_wheel_acceleration "
    "surface_area node_mass "
    "specific_heat zero_celsius deputy_radius chief_radius max_distance max_speed passive_safety_horizon field_of_view "
    "max_rate num_points points_per_cluster success_score action_period substep max_time orientation_width "
    "free_flight_horizon"
)
# Zero is what is not there: a surface that absorbs nothing, a limit without slope. The rewards may have any sign.
NOT_NEGATIVE = (
    "absorptivity emissivity solar_constant albedo view_factor earth_temperature stefan_boltzmann panel_performance "
    "panel_degradation power_draw docking_speed speed_slope exclusion_buffer temperature_sun_slope "
    "temperature_earth_slope min_energy energy_sun_slope time_reward_until terminal_reward"
)
AT_MOST_ONE = "absorptivity emissivity albedo view_factor panel_degradation success_score"

# What an agent may observe, see `inspection.observation`: the paper's, the axes of Hill's frame, where free flight
# passes the chief, and how the chief turns.
OBSERVED = (
    "position",
    "velocity",
    "angular_velocity",
    "energy",
    "temperature",
    "sun",
    "priority",
    "uninspected",
    "score",
)
OBSERVABLE = (*OBSERVED, "hill", "free_flight", "chief")


@dataclass(frozen=True)
class InspectionParameters:
    """Constants of dynamics, limits, chief, episode and reward; values are the paper's unless marked."""

    # Orbit and translation (Sec. Dynamics, Translational Motion)
    mean_motion: float = 0.001027  # rad/s, of the chief's orbit
    orbit: str = "clohessy-wiltshire"  # gravity: linear around a circular orbit, or exact, "two-body"
    eccentricity: float = 0.0  # of the chief's orbit, which "two-body" may have
    sun_from_perigee: float = 0.0  # rad, from the perigee of that orbit along it to the Sun
    gravitational_parameter: float = 3.986004418e14  # m^3/s^2, of the Earth, for "two-body"
    mass: float = 12.0  # kg, of the deputy
    max_thrust: float = 1.0  # N, per body axis

    # Attitude (Sec. Dynamics, Attitude)
    hill_rotation: bool = False  # (decision) body rates are relative to the stars, while Hill's frame turns
    inertia: tuple[float, float, float] = (0.0573, 0.0573, 0.0573)  # kg m^2, principal moments
    wheel_inertia: float = 4.1e-5  # kg m^2, D, of each reaction wheel
    max_angular_acceleration: float = 0.017453  # rad/s^2, per body axis; limits the torque
    max_wheel_acceleration: float = 181.3  # rad/s^2, of each reaction wheel; limits the torque
    saturate_rates: bool = True  # (decision) the plant holds each body rate within max_rate

    # Temperature of the -n_y side (Sec. Dynamics, Temperature)
    thermal_axis: str = "-y"  # body axis of the tracked surface
    absorptivity: float = 0.13  # of the surface for sunlight, no unit
    emissivity: float = 0.06  # of the surface, no unit
    surface_area: float = 0.03  # m^2, also the solar panels' area
    node_mass: float = 2.0  # kg, that is heated
    specific_heat: float = 900.0  # J/(kg K), of that mass
    solar_constant: float = 1367.0  # W/m^2, sunlight
    albedo: float = 0.27  # share of the sunlight that the Earth reflects
    view_factor: float = 0.8  # no unit, F_E = 0.8 cos(theta_EI)
    earth_temperature: float = 255.0  # K, of the Earth as a radiator
    stefan_boltzmann: float = 5.67051e-8  # W/(m^2 K^4), constant of radiation
    zero_celsius: float = 273.15  # K, of 0 deg C

    # Energy (Sec. Dynamics, Energy)
    solar_panel_axis: str = "-x"  # (decision) the paper's text says +x; see docs/reference/differences.md
    panel_performance: float = 983.3  # W/m^2, P_I, in full sunlight
    panel_degradation: float = 0.77  # share that degradation leaves, I_d
    power_draw: float = 15.0  # W, P_out, of the spacecraft

    # Safety limits (Sec. Safety Constraints)
    deputy_radius: float = 5.0  # m, r_d, of the deputy's sphere
    chief_radius: float = 10.0  # m, r_c, of the chief's sphere
    max_distance: float = 800.0  # m, r_max, keep-in zone
    docking_speed: float = 0.2  # m/s, nu_0, speed limit at the chief
    speed_slope: float = 7.5 * 0.001027  # 1/s, nu_1 = 7.5 n, by which that limit grows with distance
    max_speed: float = 5.0  # m/s per Hill axis, v_max
    passive_safety_horizon: float = 500.0  # s, T_f, of free flight that stays clear of the chief
    field_of_view: float = math.radians(60.0)  # rad, alpha_FOV, full cone angle
    exclusion_buffer: float = math.radians(10.0)  # rad, beta, kept beyond half the field of view
    max_temperature: float = 10.0  # deg C, of the surface
    temperature_sun_slope: float = 0.05  # deg C/rad, delta_0
    temperature_earth_slope: float = 0.01  # deg C/rad, delta_1
    min_energy: float = 1.0  # kJ, in the battery
    energy_sun_slope: float = 0.05  # kJ/rad, delta_2
    max_rate: float = math.radians(2.0)  # rad/s, omega_max, per body axis

    # Episode (Sec. RL Environment)
    num_points: int = 100  # points on the chief
    points_per_cluster: int = 10  # (decision) k = ceil(n / 10)
    success_score: float = 0.95  # inspected score, 0 to 1, that ends an episode
    action_period: float = 10.0  # s between two actions of the agent
    observed: tuple[str, ...] = OBSERVED  # by the agent: the paper's, some, or more of `OBSERVABLE`
    substep: float = 1.0  # s, longest integration step
    max_time: float = 12236.0  # s, an episode at its longest: two orbits
    initial_radius: tuple[float, float] = (50.0, 100.0)  # m, range of the first distance
    initial_energy: tuple[float, float] = (5.0, 7.0)  # kJ, range of the first energy
    initial_temperature: tuple[float, float] = (3.0, 7.0)  # deg C, range of the first temperature

    # Reward (Sec. Rewards)
    points_reward: float = 1.0  # per score gained
    delta_v_reward: float = -0.02  # per m/s
    torque_reward: float = -0.1  # per N m
    orientation_reward: float = 0.0005  # per action, at its most
    orientation_width: float = 0.15  # misalignment, 1 - cos, of the decay by e
    time_reward: float = 0.001  # per action
    time_reward_until: float = 3000.0  # s, of the episode
    terminal_reward: float = 1.0  # magnitude of success, crash, distance and energy terms
    free_flight_horizon: float = 172800.0  # s, two days of free flight: rewarded at success, and observed

    # Our own terms, which the learner is given beside the paper's; the reward that is reported is without them
    rate_reward: float = 0.0  # per action and axis turning at max_rate, by its square
    correction_reward: float = 0.0  # per action, where the filter corrects all of its calls
    limit_reward: float = 0.0  # per action and limit reached; less from `reward.NEAR` on, more beyond
    drift_reward: float = 0.0  # per action, where free flight crosses the chief's track; less up to 30 m off

    def __post_init__(self) -> None:
        for name in ("solar_panel_axis", "thermal_axis"):
            if getattr(self, name) not in AXES:
                raise ValueError(f"{name} = {getattr(self, name)!r}: allowed are {', '.join(AXES)}")
        if not self.observed or not set(self.observed) <= set(OBSERVABLE):
            raise ValueError(f"observed = {list(self.observed)!r}: must be some of {', '.join(OBSERVABLE)}")
        for name in POSITIVE.split():
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be a positive number")
        if self.mean_motion < SLOWEST_ORBIT:
            raise ValueError(f"mean_motion = {self.mean_motion:g}: must be at least {SLOWEST_ORBIT:g} rad/s")
        for field in fields(InspectionParameters):
            value = getattr(self, field.name)
            if isinstance(value, str) or field.name == "observed":
                continue
            numbers = value if isinstance(value, tuple) else (value,)
            if isinstance(field.default, tuple) and len(numbers) != len(field.default):
                raise ValueError(f"{field.name} = {value!r}: must be {len(field.default)} numbers")
            if not all(math.isfinite(number) for number in numbers):
                raise ValueError(f"{field.name} = {value!r}: must be finite")
        if self.orbit not in ORBITS:
            raise ValueError(f"orbit = {self.orbit!r}: must be one of {', '.join(ORBITS)}")
        if not 0 <= self.eccentricity <= MOST_ECCENTRIC:
            raise ValueError(
                f"eccentricity = {self.eccentricity!r}: must be a number from 0 to {MOST_ECCENTRIC}"
            )
        if self.eccentricity and self.orbit != "two-body":
            raise ValueError(f'eccentricity = {self.eccentricity!r}: needs orbit = "two-body"')
        for name in ("num_points", "points_per_cluster"):
            if not isinstance(getattr(self, name), int):
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be an integer")
        for name in NOT_NEGATIVE.split():
            if getattr(self, name) < 0:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must not be negative")
        for name in AT_MOST_ONE.split():
            if getattr(self, name) > 1:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be at most 1")
        steps = self.action_period / self.substep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-9:
            raise ValueError(
                f"substep = {self.substep:g}: must divide action_period, {self.action_period:g} s"
            )
        if self.substep > 5.0:
            raise ValueError(f"substep = {self.substep:g}: must be at most 5 s")
        if self.field_of_view > math.pi or self.num_points > 100_000:
            raise ValueError("field_of_view must be at most pi rad and num_points at most 100,000")
        if self.field_of_view / 2 + self.exclusion_buffer >= math.pi:
            raise ValueError("field_of_view / 2 + exclusion_buffer must be below pi rad")
        if self.max_distance <= self.collision_radius:
            raise ValueError(
                f"max_distance = {self.max_distance:g}: must exceed deputy_radius + chief_radius, "
                f"{self.collision_radius:g} m"
            )
        if min(self.inertia) <= 0:
            raise ValueError(f"inertia = {list(self.inertia)}: must be three positive moments in kg m^2")
        rounding = 1 + 1e-9  # of a flat plate, whose largest moment is that sum
        if 2 * max(self.inertia) > rounding * sum(self.inertia):
            raise ValueError(
                f"inertia = {list(self.inertia)}: no body has a moment above the sum of the other two"
            )
        for name in ("initial_radius", "initial_energy", "initial_temperature"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} = {[low, high]!r}: must be [low, high] with low <= high")
        if self.initial_radius[0] <= 0:
            raise ValueError(f"initial_radius = {list(self.initial_radius)!r}: must be positive, in m")
        if self.initial_energy[0] < 0:
            raise ValueError(f"initial_energy = {list(self.initial_energy)!r}: must not be negative, in kJ")
        if self.initial_temperature[0] <= -self.zero_celsius:
            raise ValueError(
                f"initial_temperature = {list(self.initial_temperature)!r}: must be above absolute zero, in deg C"
            )

    @property
    def collision_radius(self) -> float:
        """r_d + r_c in m."""
        return self.deputy_radius + self.chief_radius

    @property
    def planes(self) -> tuple[tuple[float, ...], ...]:
        """Around the chief where its hull is what to stay clear of, see `inspection.chief.hull`; none: a sphere is."""
        return ()

    @property
    def least_distance(self) -> float:
        """m from the chief's centre at which the deputy touches it, at the nearest."""
        return self.collision_radius

    @property
    def max_torque(self) -> float:
        """tau_max = min(J domega_max, D dpsi_max) in N m, the smallest over the axes."""
        return min(
            min(self.inertia) * self.max_angular_acceleration,
            self.wheel_inertia * self.max_wheel_acceleration,
        )

    @property
    def control_limit(self) -> tuple[float, ...]:
        """Actuator limits of the six controls: N, N, N, N m, N m, N m."""
        return (self.max_thrust,) * 3 + (self.max_torque,) * 3

    @property
    def max_acceleration(self) -> float:
        """a_max of the collision and keep-in constraints in m/s^2 (decision): thrust less the worst drift.

        F_max / m - 3 n^2 r_max - 2 n v_max with v_max = min(max_speed, nu_0 + nu_1 r_max).
        """
        speed = min(self.max_speed, self.docking_speed + self.speed_slope * self.max_distance)
        return self.max_thrust / self.mass - self.largest_drift(self.max_distance, speed)

    def largest_drift(self, distance: float, speed: float) -> float:
        """Largest natural acceleration in m/s^2 within a distance in m from the chief and at most a speed in m/s.

        Of the tide 2 mu / r^3, the centrifugal w^2, the quickening w' = -2 e sin(f) mu / r^3 and Coriolis' 2 w, each
        where it is largest, at perigee; on a circle these are 3 n^2 and 2 n. What the exact tide has beyond the linear
        one, mu / r^2 sum (k + 1) (d / r)^k over k >= 2, is at most 3 mu / r^3 d^2 / (r - 3 d).
        """
        e, n = self.eccentricity, self.mean_motion
        if self.orbit == "clohessy-wiltshire":
            return 3 * n**2 * distance + 2 * n * speed
        perigee = self.semi_major_axis * (1 - e)
        tide = self.gravitational_parameter / perigee**3
        quickening = 2 * e * tide  # (mu / r^3) 2 e sin f, at most
        beyond = 3 * tide * distance / (perigee - 3 * distance)
        turning = self.fastest_turning
        return (2 * tide + turning**2 + quickening + beyond) * distance + 2 * turning * speed

    @property
    def fastest_turning(self) -> float:
        """Of Hill's frame in rad/s, at perigee."""
        e = self.eccentricity
        return self.mean_motion * ((1 + e) / (1 - e) ** 3) ** 0.5

    @property
    def is_circular(self) -> bool:
        """Whether Hill's frame turns at the mean motion."""
        return self.eccentricity == 0.0

    @property
    def semi_major_axis(self) -> float:
        """Of the chief's orbit in m, by Kepler's third law."""
        return (self.gravitational_parameter / self.mean_motion**2) ** (1 / 3)


@dataclass(frozen=True)
class ChiefParameters:
    """What is inspected, and how it turns; by default the paper's sphere, fixed in Hill's frame."""

    mesh: str = ""  # .npz or .stl file in m; `#` and how its sha256 begins are added where it is used
    attitude: tuple[float, ...] = ALIGNED  # at first, from its axes to Hill's, scalar last
    random_attitude: bool = False  # drawn for each episode instead, any
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)  # deg/s, at first, about its principal axes
    largest_rate: float = 0.0  # deg/s; above 0 the rate is drawn: any axis, any size up to this
    moments: tuple[float, float, float] = (1.0, 1.0, 1.0)  # principal moments; only their ratios count
    collision: str = "sphere"  # what to stay clear of: the sphere of chief_radius, or the mesh's convex hull

    def __post_init__(self) -> None:
        for name, count in (("attitude", 4), ("rate", 3), ("moments", 3)):
            numbers = getattr(self, name)
            if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
                raise ValueError(f"{name} = {list(numbers)}: must be {count} finite numbers")
        if not any(self.attitude):
            raise ValueError(f"attitude = {list(self.attitude)}: must not be zero")
        if not 0.0 <= self.largest_rate <= FASTEST_CHIEF or math.hypot(*self.rate) > FASTEST_CHIEF:
            raise ValueError(
                f"rate = {list(self.rate)}, largest_rate = {self.largest_rate:g}: must be at most "
                f"{FASTEST_CHIEF:g} deg/s"
            )
        if self.largest_rate and any(self.rate):
            raise ValueError(
                f"rate = {list(self.rate)}: is drawn, since largest_rate is {self.largest_rate:g}"
            )
        if min(self.moments) <= 0.0 or 2.0 * max(self.moments) > (1.0 + 1e-9) * sum(self.moments):
            raise ValueError(
                f"moments = {list(self.moments)}: must be positive, and none above the sum of the other two"
            )
        if max(self.moments) > MOST_UNEQUAL * min(self.moments):
            raise ValueError(
                f"moments = {list(self.moments)}: must not differ by more than a factor of {MOST_UNEQUAL:g}"
            )
        if self.collision not in ("sphere", "hull"):
            raise ValueError(f"collision = {self.collision!r}: must be sphere or hull")
        if self.collision == "hull" and not self.mesh:
            raise ValueError("collision = 'hull': needs a mesh")
        if self.collision == "hull" and (self.turns or self.random_attitude):
            raise ValueError(
                "collision = 'hull': must be of a mesh that holds still, without rate, largest_rate and random_attitude"
            )

    @property
    def is_the_papers(self) -> bool:
        """Whether it is the sphere, fixed in Hill's frame."""
        return self == ChiefParameters()

    @property
    def is_drawn(self) -> bool:
        """Whether episodes differ in it."""
        return self.random_attitude or self.largest_rate > 0.0

    @property
    def turns(self) -> bool:
        """Whether its attitude changes over time."""
        return any(self.rate) or self.largest_rate > 0.0
