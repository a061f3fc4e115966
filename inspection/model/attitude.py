"""Quaternion helpers; scalar last, component axis first, batch axes trailing (Sec. Dynamics, Attitude).

Functions on sequences of components are those of the equations of motion: torch.compile fuses arithmetic on separate
components into a single loop, but not across a stack of them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from inspection.model.tensors import check_tensors

Vector = tuple[Tensor, Tensor, Tensor]
Components = Sequence[Tensor] | Tensor  # a sequence of components, or a tensor with them as the first axis


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Returns the inner product over the component axis: (k, ...) and (k, ...) to (...)."""
    return (a * b).sum(0)


def norm(a: Tensor) -> Tensor:
    """Returns the Euclidean norm over the component axis: (k, ...) to (...)."""
    return dot(a, a).sqrt()


def cross(a: Components, b: Components) -> Vector:
    """Returns a x b of three components each, as three components (...)."""
    (a1, a2, a3), (b1, b2, b3) = a, b
    return a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1


def unit(a: Tensor) -> Tensor:
    """Returns a / |a|, zero where a is zero: (k, ...) to (k, ...); raises TypeError if a is no tensor."""
    check_tensors(a=a)
    length = norm(a)
    return a / torch.where(length > 0, length, torch.ones_like(length))


def conjugate(q: Tensor) -> Tensor:
    """Returns the inverse of a unit quaternion: (4, ...) to (4, ...); raises TypeError if q is no tensor."""
    check_tensors(q=q)
    return torch.cat((-q[:3], q[3:]))


def rotate_components(q: Components, a: Components) -> Vector:
    """Returns the components of q a q*, from those of q and a.

    The Hamilton product is expanded: a + 2 q4 (q_v x a) + 2 q_v x (q_v x a).
    """
    *q_v, q_4 = q
    t = [2.0 * component for component in cross(q_v, a)]
    a1, a2, a3 = (a_i + q_4 * t_i + qt_i for a_i, t_i, qt_i in zip(a, t, cross(q_v, t), strict=True))
    return a1, a2, a3


def rotate(q: Tensor, a: Tensor) -> Tensor:
    """Turns a (3, ...) from the body frame into Hill's, q a q*, with q* back; raises TypeError if one is no tensor."""
    check_tensors(q=q, a=a)
    return torch.stack(rotate_components(q, a))


def body_axis(q: Components, i: int) -> Vector:
    """Returns the i-th body axis in Hill's frame, column i of `rotation_matrix`, from the components of q."""
    j, k = (i + 1) % 3, (i + 2) % 3
    column = {
        i: q[3] ** 2 + q[i] ** 2 - q[j] ** 2 - q[k] ** 2,
        j: 2.0 * (q[i] * q[j] + q[k] * q[3]),
        k: 2.0 * (q[i] * q[k] - q[j] * q[3]),
    }
    return column[0], column[1], column[2]


def rotation_matrix(q: Tensor) -> Tensor:
    """Returns R (3, 3, ...) with R a = q a q*: columns are the body axes in Hill's frame, rows Hill's in the body's.

    R = (q4^2 - |q_v|^2) 1 + 2 q_v q_v' + 2 q4 [q_v x], by components of a few tensors: every call of the filter
    differentiates it twice, and a contraction with coefficients would mostly multiply by zero. Raises TypeError if q is
    no tensor.
    """
    check_tensors(q=q)
    vector = q[:3]
    next_one, one_after = torch.cat((q[1:3], q[:1])), torch.cat((q[2:3], q[:2]))
    along, aside = next_one * one_after, vector * q[3]
    plus, minus = (2.0 * (along + aside)).unbind(), (2.0 * (along - aside)).unbind()
    xx, yy, zz, ww = (q * q).unbind()
    rows = (
        torch.stack((xx - yy - zz + ww, minus[2], plus[1])),
        torch.stack((plus[2], yy - xx - zz + ww, minus[0])),
        torch.stack((minus[1], plus[0], zz - (xx + yy) + ww)),
    )
    return torch.stack(rows)


def quaternion_rate(q: Components, omega: Components) -> tuple[Tensor, ...]:
    """Returns the four components of dq/dt = Xi(q) omega / 2, the quaternion's derivative (Sec. Attitude)."""
    (q1, q2, q3, q4), (w1, w2, w3) = q, omega
    return (
        0.5 * (q4 * w1 + q2 * w3 - q3 * w2),
        0.5 * (q4 * w2 + q3 * w1 - q1 * w3),
        0.5 * (q4 * w3 + q1 * w2 - q2 * w1),
        -0.5 * (q1 * w1 + q2 * w2 + q3 * w3),
    )


def rotated_by(q: Tensor, angle: Tensor) -> Tensor:
    """Turns the attitude q (4, ...) on by a rotation vector (3, ...) in rad, in the body frame."""
    size = norm(angle)
    half = 0.5 * torch.sinc(size / (2.0 * torch.pi)) * angle, (0.5 * size).cos()
    vector = torch.stack(cross(q[:3], half[0])) + q[3] * half[0] + half[1] * q[:3]
    return unit(torch.cat((vector, (q[3] * half[1] - dot(q[:3], half[0]))[None])))


def rate_in_hill(q: Components, omega: Components, n: Tensor | float) -> Vector:
    """Returns the components in rad/s of the body's rate relative to Hill's frame, which turns at n rad/s about z.

    This is the rate omega relative to the stars, as a gyro measures it, less R^T (0, 0, n); both in the body frame.
    """
    w1, w2, w3 = (omega_i - n * body_axis(q, i)[2] for i, omega_i in enumerate(omega))
    return w1, w2, w3
