"""The filter as people call it: any kind of numbers in, the same kind out, and what is wrong refused in a line."""

import math
import re
import warnings
from typing import Any

import numpy as np
import pytest
import torch

from inspection.model.attitude import norm
from inspection.model.state import Q
from rta.filter import SafetyFilter
from rta.result import Status
from tests.rta.test_filter import LIMIT, U, X
from tests.support.flights import way

STATE, CONTROL = X.numpy(), U.numpy()
KINDS = {"numpy": lambda x: x, "torch": torch.from_numpy}


@pytest.fixture(scope="module")
def safety() -> SafetyFilter:
    return way("C")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", [np.float64, np.float32])
@pytest.mark.parametrize("single", [True, False])
def test_the_answer_is_in_kind(safety: SafetyFilter, kind: str, precision: type, single: bool) -> None:
    columns = 3 if single else slice(40)
    x, u = (array[:, columns].astype(precision) for array in (STATE, 1.2 * CONTROL))
    result = safety(KINDS[kind](x), KINDS[kind](u))
    given, desired = (torch.from_numpy(part.astype(float)).view(len(part), -1) for part in (x, u))
    if precision is np.float32:
        given[Q] /= norm(given[Q])
    same = safety.correct(given, desired)
    for name, expected in vars(same).items():
        found = getattr(result, name)
        assert torch.is_tensor(found) == (kind == "torch")
        assert str(found.dtype).endswith(
            precision.__name__ if expected.is_floating_point() else str(expected.dtype)[6:]
        )
        expected = expected[..., 0] if single else expected
        assert found.shape == expected.shape
        rounding = 1e-6 if precision is np.float32 else 0.0
        np.testing.assert_allclose(np.asarray(found), expected.numpy(), rtol=rounding, atol=rounding / 1e3)
    control = np.asarray(result.control, dtype=float)
    assert (abs(control) <= (LIMIT[:, 0] if single else LIMIT).numpy()).all()


def test_lists_and_integers_are_answered_in_float64(safety: SafetyFilter) -> None:
    state = [60, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 5, 6, 2]  # the Sun beside the camera
    for one, other in (
        (state, [9, 0, 0, 0, 0, 0]),
        (np.array(state), np.array([9, 0, 0, 0, 0, 0])),
        (torch.tensor(state), [9, 0, 0, 0, 0, 0]),
        (np.array(state, np.uint16), np.array([9, 0, 0, 0, 0, 0], np.uint64)),
    ):
        result = safety(one, other)
        assert isinstance(result.control, np.ndarray) and result.control.dtype == float
        np.testing.assert_array_equal(result.control, [1, 0, 0, 0, 0, 0])
        assert result.intervened and result.status == Status.HARD
    assert safety(torch.tensor(state), torch.tensor([9, 0, 0, 0, 0, 0])).control.dtype == torch.float64


def test_what_is_given_is_not_changed(safety: SafetyFilter) -> None:
    x, u = STATE[:, :5].copy(), 9 * CONTROL[:, :5]
    asked = u.copy()
    x.flags.writeable = u.flags.writeable = False
    result = safety(x, u)
    assert (x == STATE[:, :5]).all() and (u == asked).all() and (result.control != asked).any()
    gradient = torch.tensor(asked, requires_grad=True)
    assert not safety(torch.from_numpy(x.copy()), gradient).control.requires_grad


def changed(**components: float) -> np.ndarray:
    x = STATE[:, 0].copy()
    for name, value in components.items():
        x[int(name[1:])] = value
    return x


HALF = np.float32(STATE[:, :4])
HALF[9, 2] += 0.1


@pytest.mark.parametrize(
    ("x", "u", "message"),
    [
        (STATE[:15, 0], CONTROL[:, 0], "state of shape (15,): must be (16,), or (16, B)"),
        (STATE[:, 0], CONTROL[:5, 0], "desired control of shape (5,): must be (6,), or (6, B)"),
        (STATE[:, :4], CONTROL[:, :4].T, "desired control of shape (4, 6): .*: transpose it"),
        (STATE[:, :0], CONTROL[:, :0], "state of shape (16, 0)"),
        (STATE[:, :4], CONTROL[:, :3], "state of shape (16, 4) with desired control of shape (6, 3)"),
        (changed(i9=3.0), CONTROL[:, 0], "quaternion (components 6 to 9 of the state): must have length 1 to 1e-06"),
        (HALF, CONTROL[:, :4], "quaternion .* in column 2: must have length 1 to 0.0001"),
        (changed(i13=-273.15), CONTROL[:, 0], "temperature -273.15 deg C (component 13 of the state): must be above"),
        (changed(i3=math.nan), CONTROL[:, 0], "state holds NaN or infinity: must be finite"),
        (STATE[:, 0], [math.inf] * 6, "desired control holds NaN or infinity"),
        (None, CONTROL[:, 0], "state: must be a NumPy array, a PyTorch tensor or a list of numbers"),
        (STATE[:, 0], "abcdef", "desired control: must be a NumPy array"),
        (STATE[:, 0], CONTROL[:, 0] * 1j, "desired control of type complex128: must be float64, float32"),
        (np.ma.masked_greater(STATE[:, 0], 5.0), CONTROL[:, 0], "state holds masked numbers"),
        (STATE[:, 0], torch.ones(6).to_sparse(), "desired control of layout torch.sparse_coo: must be dense"),
        (STATE[:, 0].astype(np.float16), CONTROL[:, 0], "state of type torch.float16: must be float64, float32"),
        (STATE[:, 0], torch.zeros(6, dtype=torch.bool), "desired control of type torch.bool"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_in_a_line(safety: SafetyFilter, x: Any, u: Any, message: str) -> None:
    pattern = re.escape(message).replace(r"\.\*", ".*")
    with pytest.raises(ValueError, match=f"^{pattern}") as refusal:
        safety(x, u)
    assert "\n" not in str(refusal.value)


def test_a_state_that_looks_like_other_units_is_answered_and_warned_of(safety: SafetyFilter) -> None:
    state, control = STATE[:, :3].copy(), CONTROL[:, :3]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        safety(state, control)
    state[13, 1] += 273.15
    with pytest.warns(UserWarning, match=r"^state: temperature above 160 deg C: is it in K") as warned:
        assert safety(state, control).control.shape == (6, 3)
    assert [warning.filename for warning in warned] == [__file__]  # where it was called


def test_a_quaternion_in_single_precision_is_taken_for_a_rotation(safety: SafetyFilter) -> None:
    """Its length is accepted up to 1e-4 from 1, which would otherwise be 2e-4 rad of the angle to the Sun."""
    half = math.radians(20.0 - 1e-3)  # the camera is turned to 40 deg from the Sun but for 0.002 deg
    state = np.zeros(16, dtype=np.float32)
    state[0], state[8], state[9], state[13], state[14] = 60.0, math.sin(half), math.cos(half), 5.0, 6.0
    exact = safety.names.index("attitude_exclusion")
    for length in (1.0 - 9e-5, 1.0, 1.0 + 9e-5):
        x = state.copy()
        x[6:10] *= length
        result = safety(x, np.zeros(6, dtype=np.float32))
        assert result.h[exact] == pytest.approx(2.0 * half - math.radians(40.0), abs=2e-6) and result.violated
        assert x[9] == state[9] * np.float32(length)  # what was given is left as it was
