"""The barrier conditions a u + b >= 0 of all constraints at a batch of states."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.attitude import quaternion_rate, unit
from inspection.dynamics import control_matrix, drift
from inspection.parameters import InspectionParameters
from inspection.state import OMEGA, THRUST, TORQUE, Q
from rta import constraints
from rta.constraints import Smoothing
from rta.lie_derivatives import high_order, lie_derivatives
from rta.parameters import RtaParameters


class Row(NamedTuple):
    """What is fixed about one row: its constraint, alpha(psi) = gain * (psi - margin), and its slack weight.

    `lead` is what the margin of h inside Psi_1 takes away from Psi_1, zero at relative degree one. `fall` is
    how far psi can fall within one period below its linear prediction, over the period: half the period times
    the largest second derivative. Without it a state on the boundary could leave the safe set in one period.
    `doubling` is the psi at which the gain has doubled, gain * (1 + (psi / doubling)^2): alpha is then an odd cubic.
    """

    constraint: str
    gain: float
    margin: float
    weight: float
    lead: float = 0.0
    fall: float = 0.0
    doubling: float = math.inf


@dataclass
class Rows:
    """Conditions of one actuator group on u in N or N m.

    Attributes:
        h: (R, B) constraint values; psi: (R, B) Psi_1 where the relative degree is two, else h.
        a: (R, 3, B); b: (R, B) with margins and `Row.fall`; b_bare: (R, B) without margins, but with `fall`.
    """

    h: Tensor
    psi: Tensor
    a: Tensor
    b: Tensor
    b_bare: Tensor

    def followed_by(self, others: "Rows") -> "Rows":
        """These rows and, after them, others of the same actuator group."""
        return Rows(*(torch.cat((part, getattr(others, name))) for name, part in vars(self).items()))


class Barriers:
    """Builds the rows of a filter that is called every `period` s; raises ValueError where parameters disagree.

    Attributes:
        thrust, torque: what is fixed about each row of the two actuator groups, in the rows' order.
    """

    def __init__(self, c: InspectionParameters, r: RtaParameters, period: float) -> None:
        if r.passive_safety_segments[-1] != c.passive_safety_horizon:
            raise ValueError(
                f"passive_safety_segments end at {r.passive_safety_segments[-1]} s: "
                f"must be the passive_safety_horizon, {c.passive_safety_horizon} s"
            )
        if c.max_acceleration <= 0.0:
            raise ValueError("max_thrust / mass must exceed the natural acceleration within max_distance")
        self.c, self.r, self.period = c, r, period
        # the slope of sqrt(2 a z) is at most sqrt(2 a / floor) = 1 / T, else it could overshoot within one period
        floor = max(r.distance_floor, 2 * c.max_acceleration * period**2)
        self.smoothing = Smoothing(floor, r.pole_angle, r.incidence_rounding)
        critical, resource, motion = r.slack_weight_critical, r.slack_weight_resource, r.slack_weight_motion

        def gain(value: float) -> float:
            return r.gain(value, period)

        # In a period T an acceleration a changes v_i^2 by 2 a v_i T + a^2 T^2, and |v| by a . v T / |v| and at most
        # a^2 T^2 / (2 |v|). The latter counts near the limit, which then takes the place of |v| in `fall`.
        # Besides, thrust turns with the body, by at most alpha_max T^2 / 6 otherwise than the constant rates that
        # `half_a_period_ahead` takes into account, and v_t^2 / |p| grows with thrust along v.
        thrust = math.sqrt(3.0) * c.max_thrust / c.mass
        acceleration = thrust + (c.max_thrust / c.mass - c.max_acceleration)
        bend = acceleration**2 * period
        angular = math.sqrt(3.0) * c.max_torque / min(c.inertia)
        turn = thrust * (angular / 6 + c.max_rate**2 / 8) * period**2
        fastest = c.docking_speed + c.speed_slope * c.max_distance
        swing = fastest * thrust / c.max_distance * period
        passes = len(r.passive_safety_segments) - 1
        self.thrust = [
            Row("collision", gain(r.collision_gain), r.collision_margin, math.inf, fall=turn),
            Row("dynamic_speed", gain(r.speed_gain), 0.0, motion, fall=turn),
            Row("keep_in_zone", gain(r.keep_in_gain), r.keep_in_margin, critical, fall=turn + swing),
            *[
                Row(
                    "passive_safety",
                    gain(r.passive_safety_gain),
                    r.passive_safety_margin,
                    critical,
                    doubling=r.passive_safety_doubling,
                )
            ]
            * passes,
            *[
                Row(f"velocity_{i}", gain(r.velocity_gain), 0.0, motion, fall=bend + 2 * c.max_speed * turn)
                for i in "xyz"
            ],
        ]
        self.bend = bend
        # constraint, (k1, k2), margin of h, slack weight
        high_order_table = (
            ("attitude_exclusion", r.exclusion_gains, r.exclusion_margin, critical),
            ("temperature", r.temperature_gains, r.temperature_margin, resource),
            ("battery", r.battery_gains, r.battery_margin, resource),
        )
        self.first = [(gain(k1), margin) for _, (k1, _), margin, _ in high_order_table]
        self.torque = [
            *[
                Row(name, gain(k2), 0.0, weight, lead=gain(k1) * margin)
                for name, (k1, k2), margin, weight in high_order_table
            ],
            *[Row(f"angular_velocity_{i}", gain(r.rate_gain), r.rate_margin, motion) for i in "xyz"],
        ]

    def translational(self, x: Tensor, times: Tensor) -> Tensor:
        """Barriers of the thrust rows, (16, ...) and pass times (segments, ...) to (R, ...)."""
        c, s = self.c, self.smoothing
        speeds = (
            constraints.collision(x, c, s),
            constraints.dynamic_speed(x, c),
            constraints.keep_in_curve(x, c, s),
        )
        return torch.cat(
            (torch.stack(speeds), constraints.clearance_at(x, times, c), constraints.velocity(x, c))
        )

    def orientation(self, x: Tensor) -> Tensor:
        """h of relative degree two, (16, ...) to (3, ...)."""
        return constraints.orientation(x, self.c, self.smoothing)

    def first_psi(self, x: Tensor) -> Tensor:
        """Psi_1 = dh/dt + k1 (h - margin) of the constraints of relative degree two, (16, ...) to (3, ...)."""

        def alpha(h: Tensor) -> Tensor:
            return torch.stack([k1 * (h[i] - margin) for i, (k1, margin) in enumerate(self.first)])

        return high_order(self.orientation, alpha, lambda y: drift(y, self.c))(x)

    def __call__(self, x: Tensor) -> tuple[Rows, Rows]:
        """The conditions on thrust and on torque at states (16, B)."""
        c = self.c
        f, g = drift(x, c), control_matrix(self.half_a_period_ahead(x), c)
        times = constraints.closest_times(x, self.r.passive_safety_segments, c)
        times = times[:, None].expand(-1, 4, -1)  # the same for f and each of three controls
        psi, lf, lg = lie_derivatives(lambda y: self.translational(y, times), x, f, g[:, THRUST])
        h = torch.cat((psi[:2], constraints.keep_in_zone(x, c, self.smoothing)[None], psi[3:]))
        thrust = self.condition(self.thrust, h, psi, lf, lg, self.thrust_fall(x))

        def psi_and_rates(y: Tensor) -> Tensor:
            return torch.cat((self.first_psi(y), constraints.angular_velocity(y, c)))

        psi, lf, lg = lie_derivatives(psi_and_rates, x, f, g[:, TORQUE])
        reported = constraints.orientation(x, c, replace(self.smoothing, incidence=0.0))
        h = torch.cat((reported, psi[3:]))
        return thrust, self.condition(self.torque, h, psi, lf, lg, torch.zeros_like(psi))

    def condition(
        self, rows: list[Row], h: Tensor, psi: Tensor, lf: Tensor, lg: Tensor, fall: Tensor
    ) -> Rows:
        """BC: L_f psi + L_g psi u + alpha(psi) >= 0, with margins and without."""
        gain, margin, lead, doubling = (
            psi.new_tensor([getattr(row, name) for row in rows])[:, None]
            for name in ("gain", "margin", "lead", "doubling")
        )
        gain = (gain * (1 + (psi / doubling) ** 2)).clamp(max=self.r.gain(math.inf, self.period))
        return Rows(h, psi, lg, lf + gain * (psi - margin) - fall, lf + gain * (psi + lead) - fall)

    def half_a_period_ahead(self, x: Tensor) -> Tensor:
        """States (16, B) with the attitude that the body has in the middle of the period.

        Thrust is fixed in the body, so over a period it acts along that attitude. With the attitude at the
        beginning instead, thrust across a pass minutes away turned into it: at 3 deg/s and 0.02 m/s^2 by
        0.02 m of clearance a second, as much as passive safety's gain asks for at the margin.
        """
        q = x[Q] + 0.5 * self.period * torch.stack(quaternion_rate(x[Q], x[OMEGA]))
        return torch.cat((x[: Q.start], unit(q), x[Q.stop :]))

    def thrust_fall(self, x: Tensor) -> Tensor:
        """`Row.fall` of the thrust rows at states (16, B): (R, B) in psi's unit per s."""
        fall = x.new_tensor([row.fall for row in self.thrust])[:, None].expand(-1, x.shape[1])
        speed_limit = constraints.speed_limit(x, self.c)
        # at 5 and 10 s it would exceed what a spacecraft at rest can satisfy
        speed = (fall[1] + self.bend / (2 * speed_limit)).minimum(0.5 * self.thrust[1].gain * speed_limit)
        return torch.cat((fall[:1], speed[None], fall[2:]))

    def is_in_safe_set(self, x: Tensor) -> Tensor:
        """(B,) bool: every h and every Psi_1 is non-negative."""
        return (constraints.values(x, self.c) >= 0.0).all(0) & (self.first_psi(x) >= 0.0).all(0)

    def can_brake(self, x: Tensor) -> Tensor:
        """(B,) bool: in any attitude thrust can keep the zone, see `constraints.keep_in_curve`."""
        return constraints.keep_in_curve(x, self.c, self.smoothing) >= 0.0

    def is_safe(self, x: Tensor) -> Tensor:
        """(B,) bool: the filter can keep every constraint from here on."""
        return self.is_in_safe_set(x) & self.can_brake(x)
