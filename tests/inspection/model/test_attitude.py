"""Quaternion helpers against scipy's rotations and numpy."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from inspection.model import attitude
from inspection.model.draws import random_quaternion


def vectors(size):
    return arrays(np.float64, size, elements=st.floats(-100.0, 100.0))


quaternions = vectors(4).filter(lambda q: np.linalg.norm(q) > 0.1).map(lambda q: q / np.linalg.norm(q))


def xi(q):
    """Returns the quaternion's derivative as the paper writes it out (Sec. Attitude)."""
    q1, q2, q3, q4 = q
    return np.array([[q4, -q3, q2], [q3, q4, -q1], [-q2, q1, q4], [-q1, -q2, -q3]])


def close(actual, expected, atol=1e-11):
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-12, atol=atol)


@given(quaternions, vectors(3))
def test_rotate_and_conjugate_agree_with_scipy(q, a):
    rotation, q, tensor = Rotation.from_quat(q), torch.tensor(q), torch.tensor(a)
    close(attitude.rotate(q, tensor), rotation.apply(a))
    close(attitude.rotate(attitude.conjugate(q), tensor), rotation.inv().apply(a))


@given(quaternions)
def test_body_axes_are_the_columns_of_the_rotation(q):
    axes = torch.stack([torch.stack(attitude.body_axis(torch.tensor(q), i)) for i in range(3)], 1)
    close(axes, Rotation.from_quat(q).as_matrix())


@given(quaternions, vectors(3))
def test_quaternion_rate_is_half_xi_omega(q, omega):
    close(torch.stack(attitude.quaternion_rate(torch.tensor(q), torch.tensor(omega))), 0.5 * xi(q) @ omega)


@given(vectors(3), vectors(3))
def test_cross_dot_and_norm_agree_with_numpy(a, b):
    close(torch.stack(attitude.cross(torch.tensor(a), torch.tensor(b))), np.cross(a, b), atol=1e-9)
    close(attitude.dot(torch.tensor(a), torch.tensor(b)), a @ b, atol=1e-9)
    close(attitude.norm(torch.tensor(a)), np.linalg.norm(a))


def test_unit_has_length_one_and_keeps_zero():
    units = attitude.unit(torch.tensor([[3.0, 0.0], [0.0, 0.0], [-4.0, 0.0]], dtype=torch.float64))
    close(units, [[0.6, 0.0], [0.0, 0.0], [-0.8, 0.0]])


def test_a_batch_is_its_columns(generator):
    q = random_quaternion(7, generator, torch.float64)
    a = torch.randn(3, 7, generator=generator, dtype=torch.float64)
    rotations = Rotation.from_quat(q.T.numpy())
    close(attitude.rotate(q, a).T, rotations.apply(a.T.numpy()))
    close(attitude.rotation_matrix(q).permute(2, 0, 1), rotations.as_matrix())
