"""Fixtures shared by all tests: the paper's parameters, a seeded generator and random plausible states."""

import math

import pytest
import torch
from hypothesis import settings

from inspection.parameters import InspectionParameters
from inspection.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V

torch.set_num_threads(1)
settings.register_profile("project", deadline=None, derandomize=True, max_examples=40, database=None)
settings.load_profile("project")


@pytest.fixture(scope="session")
def c():
    """The paper's constants."""
    return InspectionParameters()


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def random_states(generator):
    """A function of the batch size B: states (16, B) such as occur in flight, float64."""

    def draw(batch):
        def uniform(low, high, *shape):
            return low + (high - low) * torch.rand(*shape, batch, generator=generator, dtype=torch.float64)

        def direction(size):
            vector = torch.randn(size, batch, generator=generator, dtype=torch.float64)
            return vector / vector.norm(dim=0)

        x = torch.empty(SIZE, batch, dtype=torch.float64)
        x[P] = uniform(16.0, 400.0) * direction(3)
        x[V] = uniform(0.05, 1.0) * direction(3)
        x[Q] = direction(4)
        x[OMEGA] = uniform(-0.03, 0.03, 3)
        x[T] = uniform(-20.0, 12.0)
        x[E] = uniform(0.5, 8.0)
        x[THETA_S] = uniform(0.0, 2 * math.pi)
        return x

    return draw
