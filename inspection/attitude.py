"""Quaternion helpers; scalar last, component axis first, batch axes trailing (Sec. Dynamics, Attitude)."""

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over the component axis: (k, ...) and (k, ...) to (...)."""
    return (a * b).sum(0)


def norm(a: Tensor) -> Tensor:
    """Euclidean norm over the component axis: (k, ...) to (...)."""
    return dot(a, a).sqrt()


def cross(a: Tensor, b: Tensor) -> Tensor:
    """a x b over the component axis: (3, ...) and (3, ...) to (3, ...).

    Written with rolls because the derivative of torch.linalg.cross does not trace under torch.compile.
    """
    return a.roll(-1, 0) * b.roll(1, 0) - a.roll(1, 0) * b.roll(-1, 0)


def unit(a: Tensor) -> Tensor:
    """a / |a|, zero where a is zero: (k, ...) to (k, ...)."""
    length = norm(a)
    return a / torch.where(length > 0, length, torch.ones_like(length))


def conjugate(q: Tensor) -> Tensor:
    """Inverse rotation of a unit quaternion: (4, ...) to (4, ...)."""
    return torch.cat((-q[:3], q[3:]))


def rotate(q: Tensor, a: Tensor) -> Tensor:
    """q a q*: turns a (3, ...) from the body frame into Hill's frame (with q* the other way).

    Expanded Hamilton product: a + 2 q4 (q_v x a) + 2 q_v x (q_v x a).
    """
    q_v, q_4 = q[:3], q[3]
    t = 2.0 * cross(q_v, a)
    return a + q_4 * t + cross(q_v, t)


def _rotation_coefficients() -> Tensor:
    """C (3, 3, 4, 4) with R_ij = C_ijkl q_k q_l, from R = (q4^2 - |q_v|^2) 1 + 2 q_v q_v' + 2 q4 [q_v x]."""
    c = torch.zeros(3, 3, 4, 4, dtype=torch.float64)
    for i in range(3):
        c[i, i, 3, 3] = 1.0
        c[i, i, range(3), range(3)] = -1.0
        for j in range(3):
            c[i, j, i, j] += 2.0
        j, k = (i + 1) % 3, (i + 2) % 3
        c[j, k, 3, i], c[k, j, 3, i] = -2.0, 2.0
    return c


ROTATION = _rotation_coefficients()


def rotation_matrix(q: Tensor) -> Tensor:
    """R (3, 3, ...) with R a = q a q*: columns are the body axes in Hill's frame, rows Hill's in the body's.

    One contraction instead of thirty products: it is differentiated twice at every call of the filter.
    """
    return torch.tensordot(ROTATION.to(q), q[:, None] * q[None], dims=2)


def quaternion_rate(q: Tensor, omega: Tensor) -> Tensor:
    """dq/dt = Xi(q) omega / 2, the paper's Eq. (dQuat1): (4, ...), (3, ...) to (4, ...)."""
    q_v, q_4 = q[:3], q[3]
    return 0.5 * torch.cat((q_4 * omega + cross(q_v, omega), -dot(q_v, omega)[None]))


def random_quaternion(count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Uniformly distributed rotations (4, count): normalised 4-D Gaussians."""
    return unit(torch.randn(4, count, generator=generator, device=generator.device, dtype=dtype))
