"""Gains, margins and weights of the filter. The paper publishes none of them for 6-DoF; each has its reason here."""

import math
from dataclasses import dataclass, fields
from itertools import pairwise

from settings import Settings, setting

FILTERS = ("checked", "paper")
PERIODS = (1.0, 5.0, 10.0)
QP_SOLVERS = ("auto", "piqp", "batched")
ROWS = ("auto", "paper", "sampled", "none")


@dataclass(frozen=True)
class RtaParameters(Settings):
    """Period and solver, class-kappa gains (alpha(h) = gain * h), margins subtracted from h, slack weights.

    A gain above 1 / period overshoots when its decay is sampled, so `gain` caps each at half of that. What
    a barrier can lose within one period beyond its linear prediction is derived beside the barrier
    (`rta.constraints.thrust`) and needs no parameter; the margins here come on top, for what that leaves out (the rows'
    own rounding, and for passive safety the shift of the closest time).
    """

    filter: str = setting(
        "checked",
        "which filter (checked: a control is applied only after its check; paper: the paper's program alone, which can "
        "fail)",
        among=FILTERS,
    )
    period: float = setting(1.0, "s between two calls of the filter", among=PERIODS)
    qp_solver: str = setting(
        "auto",
        "solver of the quadratic programs; auto: piqp for the paper's filter, batched for the checked one",
        among=QP_SOLVERS,
    )
    rows: str = setting(
        "auto",
        "conditions of the programs: paper (of the rate now; at 5 and 10 s and with bounds they allow for what happens "
        "in a hold), sampled (of a hold) or none (the check alone); auto: the paper's at 1 s without bounds, else "
        "sampled",
        among=ROWS,
    )

    collision_gain: float = setting(0.1, "1/s, safe separation", note="relative degree one, 1/s")
    speed_gain: float = setting(0.5, "1/s, dynamic speed limit")
    keep_in_gain: float = setting(0.1, "1/s, keep-in zone")
    passive_safety_gain: float = setting(
        0.03, "1/s; the nearest pass is minutes away: a slow approach is enough"
    )
    passive_safety_doubling: float = setting(
        30.0,
        "m, clearance at which passive safety's gain has doubled",
        above=0,
        note="Braking moves the path's far end by up to 480 m per m/s. With 3 % of the clearance a second as the "
        "only allowance, an end 165 m clear kept a spacecraft from braking for its dynamic speed limit. So "
        "the gain is gain * (1 + (clearance / doubling)^2), and far passes do not bind.",
    )
    velocity_gain: float = setting(0.2, "1/s, velocity limits")
    rate_gain: float = setting(0.5, "1/s, rate limits")

    exclusion_gains: tuple[float, float] = setting(
        (0.05, 0.2),
        "1/s, k1 and k2, attitude exclusion",
        note="HOCBF, Psi_1 = dh/dt + k1 h and dPsi_1/dt + k2 Psi_1 >= 0, 1/s",
    )
    temperature_gains: tuple[float, float] = setting(
        (0.0015, 0.2), "1/s, k1: act while a 90 deg turn still helps; k2"
    )
    battery_gains: tuple[float, float] = setting(
        (0.004, 0.1), "1/s, k1: 15 W of draw is held 3.75 kJ above it; k2"
    )

    collision_margin: float = setting(0.02, "m/s, safe separation", note="margins in the unit of each h")
    keep_in_margin: float = setting(0.02, "m/s, keep-in zone")
    passive_safety_margin: float = setting(
        1.0,
        "m, passive safety",
        note="Torque turns the thrust by up to alpha_max T^2 / 6 = 0.005 rad more than the rates do; thrust of "
        "0.25 N that far off moves a pass 2 minutes ahead by 0.015 m in a second, which the gain makes up for "
        "at 0.5 m.",
    )
    exclusion_margin: float = setting(0.01, "rad, attitude exclusion")
    temperature_margin: float = setting(0.05, "deg C, temperature")
    battery_margin: float = setting(0.02, "kJ, battery")
    rate_margin: float = setting(0.0, "rad^2/s^2; the plant saturates at the limit itself")

    incidence_rounding: float = setting(
        0.3,
        "rad, to either side",
        note="Where the surface turns into the light, the slope of (pi/2 - theta_SI)^+ jumps, and Psi_1 drops by "
        "delta_0 omega, up to 0.0017 deg C/s, which torque cannot prevent, having no influence in the dark. A "
        "terminator crossed again and again ate up every margin. Torque stops 2 deg/s within 0.035 rad, so "
        "the filter rounds the edge off over several times that angle.",
    )

    passive_safety_segments: tuple[float, ...] = setting(
        (0.0, 60.0, 160.0, 300.0, 420.0, 500.0),
        "s, their bounds",
        note="The free flight's closest approach is enforced once per segment, so that a second close pass is held "
        "off while the first one is being corrected.",
    )

    distance_floor: float = setting(
        0.05,
        "m, distances are taken as at least this",
        note="Bounded slopes of sqrt at 0 and arccos at +-1 in the filter's derivatives; reported values are "
        "exact.",
    )
    pole_angle: float = setting(
        0.2,
        "rad, least angle to a pole",
        below=math.pi / 2,
        note="Nearer to a pole, the angle's second derivative omega^2 / tan(angle) at three rates of 2 deg/s would "
        "exceed the 1 deg/s^2 that torque gives.",
    )

    slack_weight_critical: float = setting(
        1e5,
        "per slack squared: keep-in zone, passive safety, attitude exclusion",
        above=0,
        note="Slack weights on rows of unit length, highest priority first: the rows of a class are given slack "
        "only where they cannot all be held although lower classes yield (`rta.qp.programs.stages`). Safe "
        "separation has no slack at all. The paper's 1e12 is beyond what an interior-point solver resolves; "
        "of 255 infeasible programs recorded with random actions, PIQP solved 249 at 1e6 and all at 1e5.",
    )
    slack_weight_resource: float = setting(1e4, "per slack squared: temperature, battery", above=0)
    slack_weight_motion: float = setting(
        1e3, "per slack squared: dynamic speed, velocity and rate limits", above=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.filter == "paper":
            self._check_that_paper_has_all()
        segments = self.passive_safety_segments
        if len(segments) < 2 or segments[0] != 0 or any(a >= b for a, b in pairwise(segments)):
            raise ValueError(f"passive_safety_segments = {segments!r}: must rise from 0 s to the horizon")

    def _check_that_paper_has_all(self) -> None:
        """Refuses what the paper's filter does not have; its gains and weights are in `rta.limits`."""
        if self.qp_solver == "batched":
            raise ValueError('qp_solver = "batched": must be "piqp" or "auto" with filter = "paper"')
        for part in fields(self):
            value = getattr(self, part.name)
            if part.name not in ("filter", "period", "qp_solver") and value != part.default:
                raise ValueError(
                    f"{part.name} = {value!r}: the paper's filter has no such setting; must be the default with "
                    'filter = "paper", whose gains and weights are in rta/limits.py'
                )

    def gain(self, value: float, hold: float = 0.0) -> float:
        """A gain in 1/s as used at the period, or where a control may be held for longer, s."""
        return min(value, 0.5 / max(self.period, hold))
