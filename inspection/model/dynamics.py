"""Equations of motion x' = f(x) + g(x) u and their RK4 step (Sec. Dynamics).

Every function is written for one spacecraft with the component axis first; batch axes trail and broadcast.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import (
    Components,
    body_axis,
    quaternion_rate,
    rate_in_hill,
    rotate_components,
    rotation_matrix,
    unit,
)
from inspection.model.orbit import clohessy_wiltshire
from inspection.model.parameters import AXES, Limits
from inspection.model.rk4 import rk4_step
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, THRUST, TORQUE, P, Q, T, V
from inspection.model.tensors import check_tensors


class Body(NamedTuple):
    """Describes a body that differs from the model's, see `inspection.world.plant`.

    Attributes:
        mass: (...) kg; inertia: three moments (...) in kg m^2.
        push: three components (...) of an acceleration in Hill's frame in m/s^2.
        in_turning_frame: omega is relative to the stars, while the attitude is relative to Hill's frame, which turns.
        saturates: each body rate stays within max_rate.
    """

    mass: Tensor
    inertia: Components
    push: Components
    in_turning_frame: bool
    saturates: bool


def sun_direction(theta_s: Tensor) -> Tensor:
    """Returns r_S = [cos, sin, 0] in Hill's frame, (...) rad to (3, ...)."""
    return torch.stack((theta_s.cos(), theta_s.sin(), torch.zeros_like(theta_s)))


def sun_and_earth_in_body(x: Tensor) -> tuple[Tensor, Tensor]:
    """Returns unit vectors to Sun and Earth (-x in Hill's frame) in the body frame: (16, ...) to (3, ...)."""
    check_tensors(x=x)
    hill_x, hill_y, _ = rotation_matrix(x[Q])
    theta_s = x[THETA_S]
    return theta_s.cos() * hill_x + theta_s.sin() * hill_y, -hill_x


def cosine_to(axis: str, direction: Tensor) -> Tensor:
    """Returns n . r for a body axis such as "-y" and a unit vector in the body frame, (3, ...) to (...)."""
    index, sign = AXES[axis]
    return direction[index] if sign > 0 else -direction[index]


def euler(omega: Any, inertia: Any) -> tuple[Any, Any, Any]:
    """Returns the components of J^-1 (-omega x J omega) in rad/s^2, the gyroscopic term, for tensors or numbers."""
    (w1, w2, w3), (j1, j2, j3) = omega, inertia
    return (j2 - j3) / j1 * w2 * w3, (j3 - j1) / j2 * w1 * w3, (j1 - j2) / j3 * w1 * w2


def most_gyroscopic(inertia: Any) -> float:
    """Returns the largest |J_j - J_k| / J_i: rad/s^2 about an axis per (rad/s)^2 about the others."""
    return max(abs(each) for each in euler((1.0,) * 3, inertia))


def attitude_rate(x: Components, turns: bool, c: Limits) -> tuple[Tensor, ...]:
    """Returns the components of dq/dt from those of x; `turns`: omega is relative to the stars, not Hill's frame."""
    omega = rate_in_hill(x[Q], x[OMEGA], c.mean_motion) if turns else x[OMEGA]
    return quaternion_rate(x[Q], omega)


def temperature_rate(cos_sun: Tensor, cos_earth: Tensor, temperature: Tensor, c: Limits) -> Tensor:
    """Returns dT/dt in deg C/s of one thermal node: solar + albedo + infrared - rejected heat."""
    area = c.surface_area
    view = c.view_factor * cos_earth.clamp(min=0.0)
    solar = c.absorptivity * area * c.solar_constant * cos_sun.clamp(min=0.0)
    albedo = c.absorptivity * area * c.solar_constant * c.albedo * view
    infrared = c.stefan_boltzmann * c.emissivity * area * c.earth_temperature**4 * view
    rejected = c.stefan_boltzmann * c.emissivity * area * (temperature + c.zero_celsius) ** 4
    return (solar + albedo + infrared - rejected) / (c.node_mass * c.specific_heat)


def energy_rate(cos_panel: Tensor, c: Limits) -> Tensor:
    """Returns dE/dt in kJ/s: P_I I_d A cos(theta) - P_out, with no power from behind the panels."""
    power_in = c.panel_performance * c.panel_degradation * c.surface_area * cos_panel.clamp(min=0.0)
    return (power_in - c.power_draw) / 1000.0


def resource_rates(x: Components, c: Limits) -> tuple[Tensor, Tensor]:
    """Returns dT/dt in deg C/s and dE/dt in kJ/s, from the components of the state."""
    q, theta_s = x[Q], x[THETA_S]
    cos, sin = theta_s.cos(), theta_s.sin()

    def cosines(axis: str) -> tuple[Tensor, Tensor]:
        """Returns n . r_S and n . r_E of a body axis."""
        index, sign = AXES[axis]
        n_x, n_y, _ = body_axis(q, index)
        return sign * (cos * n_x + sin * n_y), -sign * n_x

    cos_sun, cos_earth = cosines(c.thermal_axis)
    cos_panel, _ = cosines(c.solar_panel_axis)
    return temperature_rate(cos_sun, cos_earth, x[T], c), energy_rate(cos_panel, c)


def natural_rates(x: Components, c: Limits) -> list[Tensor]:
    """Returns f(x): the 16 components of the state (...) to their rates in the state's units per second."""
    p, v, omega = x[P], x[V], x[OMEGA]
    return [
        *v,
        *clohessy_wiltshire(p, v, c.mean_motion),
        *attitude_rate(x, c.hill_rotation, c),
        *euler(omega, c.inertia),
        *resource_rates(x, c),
        torch.full_like(x[THETA_S], -c.mean_motion),
    ]


def drift(x: Tensor, c: Limits) -> Tensor:
    """Returns f(x), (16, ...) to (16, ...) in the state's units per second; raises TypeError if x is no tensor."""
    check_tensors(x=x)
    return torch.stack(natural_rates(x.unbind(0), c))


def control_matrix(x: Tensor, c: Limits) -> Tensor:
    """Returns g(x), (16, ...) to (16, 6, ...): thrust by attitude, torque by inertia; raises as `drift`."""
    check_tensors(x=x)
    g = x.new_zeros(x.shape[0], CONTROL_SIZE, *x.shape[1:])
    g[V, THRUST] = rotation_matrix(x[Q]) / c.mass
    for i, moment in enumerate(c.inertia):
        g[OMEGA.start + i, TORQUE.start + i] = 1.0 / moment
    return g


def derivative(x: Components, u: Components, c: Limits, body: Body | None = None) -> list[Tensor]:
    """Returns the components of f(x) + g(x) u, from those of x and of u in N and N m.

    Without a `body` the body is the model's.
    """
    rate = natural_rates(x, c)
    mass, inertia = (body.mass, body.inertia) if body else (c.mass, c.inertia)
    if body:
        rate[V] = [f_i + push_i for f_i, push_i in zip(rate[V], body.push, strict=True)]
        rate[OMEGA] = euler(x[OMEGA], inertia)
        rate[Q] = attitude_rate(x, body.in_turning_frame, c)
    force, torque = rotate_components(x[Q], u[THRUST]), u[TORQUE]
    rate[V] = [f_i + force_i / mass for f_i, force_i in zip(rate[V], force, strict=True)]
    rate[OMEGA] = [f_i + t_i / j_i for f_i, t_i, j_i in zip(rate[OMEGA], torque, inertia, strict=True)]
    return rate


def step(x: Tensor, u: Tensor, duration: Tensor | float, c: Limits, body: Body | None = None) -> Tensor:
    """Returns the state after one RK4 step of `duration` s with u held.

    The step renormalises q and saturates the body rates if the body or the model does so.

    Args:
        x: states (16, ...); u: controls (6, ...) in N and N m.

    Raises:
        TypeError: x or u is no tensor.
    """
    check_tensors(x=x, u=u)
    held = u.unbind(0)
    end = rk4_step(lambda components: derivative(components, held, c, body), x.unbind(0), duration)
    if body.saturates if body else c.saturate_rates:
        end[OMEGA] = [omega_i.clamp(-c.max_rate, c.max_rate) for omega_i in end[OMEGA]]
    end[Q] = unit(torch.stack(end[Q]))
    return torch.stack(end)


def integrate(
    x: Tensor,
    u: Tensor,
    duration: float,
    c: Limits,
    times: int = 1,
    body: Body | None = None,
) -> Tensor:
    """Returns the state after `times` steps of `step`."""
    for _ in range(times):
        x = step(x, u, duration, c, body)
    return x
