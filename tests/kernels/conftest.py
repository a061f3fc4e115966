"""Fixtures of the tests of compiled code: a cache of their own."""

from pathlib import Path

import pytest

from kernels import build
from tests.shared import OPTIMISED


@pytest.fixture(scope="session")
def kernels_cache(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In pytest's own, so that nothing is compiled twice: what is kept goes by sources, flags, compiler and processor.

    `pytest --cache-clear` empties it. Tests of the cache itself have empty ones.
    """
    kept = getattr(pytestconfig, "cache", None)  # None under -p no:cacheprovider
    return kept.mkdir("kernels") if kept else tmp_path_factory.mktemp("kernels")


@pytest.fixture(autouse=True)
def own_cache(kernels_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(build.VARIABLE, str(kernels_cache))


@pytest.fixture(autouse=True)
def optimised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Builds as users do."""
    monkeypatch.setattr(build, "FLAGS", OPTIMISED)
