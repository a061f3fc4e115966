"""Fixtures of the tests of compiled code."""

import pytest

from kernels import build
from tests.optimised import OPTIMISED


@pytest.fixture(autouse=True)
def optimised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Builds as users do."""
    monkeypatch.setattr(build, "FLAGS", OPTIMISED)
