"""`export --filter` and `verify --filter`: what the header says of campaigns, what is refused, what the C flies."""

import json
import re
from pathlib import Path

import pytest

from kernels import build
from rta.fast import files
from study import verified
from study.config import Config
from tests.test_main import assert_refused, call


@pytest.fixture
def no_vectors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omits the C's comparison vectors, which take seconds; `tests.rta.fast.test_export` uses them."""
    monkeypatch.setattr(files, "vectors_header", lambda safety_filter: "")


@pytest.mark.usefixtures("no_vectors")
def test_the_header_names_the_campaigns_of_its_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(["export", "--filter", str(tmp_path / "c")], capsys)
    assert code == 0, err
    head = (tmp_path / "c" / "safety_filter.h").read_text()
    assert "SAFETY_FILTER_VERIFIED 1" in head and "random.json: random, 10,000 episodes" in head
    digest = re.findall(r'CONFIGURATION "([0-9a-f]{64})"', head)
    assert digest == [verified.settings_digest(Config())] and verified.fingerprint(Config()) in head
    assert "make -C" in out and "Verified" in out


@pytest.mark.usefixtures("no_vectors")
def test_a_changed_filter_says_that_it_is_not_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.toml").write_text("[inspection]\nmass = 13.0\n")
    arguments = ["export", "--filter", str(tmp_path / "c"), "--config", str(tmp_path / "own.toml")]
    code, out, err = call(arguments, capsys)
    assert code == 0, err
    assert "NOT VERIFIED" in out
    head = (tmp_path / "c" / "safety_filter.h").read_text()
    assert "SAFETY_FILTER_VERIFIED 0" in head and "NOT VERIFIED" in head.splitlines()[2]


def test_a_campaign_flies_through_the_c(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        build.compilers()
    except build.NoCompilerError as error:
        pytest.skip(str(error))
    flight, reports = ["verify", "--episodes", "16", "--duration", "60", "--device", "cpu"], []
    for form in ("python", "c"):
        path = tmp_path / f"{form}.json"
        code, _, err = call([*flight, "--threads", "1", "--filter", form, "--json", str(path)], capsys)
        assert code == 0, err
        reports.append(json.loads(path.read_text()))
    assert [each["campaign"]["filter"] for each in reports] == ["python", "c"]
    assert reports[0]["filter_calls"] == reports[1]["filter_calls"]
    arguments = [*flight, "--filter", "c", "--json"]
    assert_refused([*arguments, str(tmp_path / "python.json")], ["holds another campaign"], capsys)
