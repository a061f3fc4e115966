"""The page of `play`: what is in it, what it asks a network for, and that the shipped one is of this code."""

import base64
import gzip
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from settings import from_toml, load
from study.config import Config
from study.web import play
from tests.study.web.browser import Browser, asks_nothing, chromium
from tests.study.web.test_flight import AGENT, PAGE
from tests.test_main import assert_refused, call

__all__ = ["chromium"]  # a fixture
TEXT = PAGE.read_text(encoding="utf-8")
NUMBER = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"


def inside(text: str, name: str) -> str:
    """Returns a page's value of a name."""
    found = re.search(rf'id="{name}">(.*?)</script>', text, re.DOTALL)
    assert found
    return found[1]


@pytest.mark.campaign
def test_a_page_is_built_and_the_shipped_one_is_of_this_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shipped module is flown beside Python in `test_flight`."""
    if find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed (requirements-optional.txt)")
    out = tmp_path / "page.html"
    words = ["play", "--config", "configs/plants/u1.toml", "--checkpoint", str(AGENT), "--out", str(out)]
    code, said, err = call(words, capsys)
    assert code == 0, err
    assert "page.html: 0.7 MB" in said
    made = out.read_text(encoding="utf-8")
    ours, shipped = (inside(text, "data") for text in (made, TEXT))
    assert re.sub(NUMBER, "", ours) == re.sub(NUMBER, "", shipped)
    numbers = (np.array(re.findall(NUMBER, each), dtype=float) for each in (ours, shipped))
    np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-9)  # processors may round otherwise
    assert len(made) == pytest.approx(len(TEXT), rel=0.02)


def test_the_shipped_page_is_of_this_template_and_asks_no_network() -> None:
    assert play.document(inside(TEXT, "module"), Markup(inside(TEXT, "data")), True, True) == TEXT
    three = gzip.decompress(base64.b64decode(inside(TEXT, "three")))
    asks_nothing(TEXT + f"<script>{three.decode()}</script>")
    assert len(TEXT.encode()) < 900_000


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("[inspection]\nsubstep = 0.3\naction_period = 9.0\n", "substep"),
        ("[chief]\nrandom_attitude = true\n", "chief"),
        ("[uncertainty]\nlatency = 1\n", "[plant]"),
        ("[plant]\nmass_factor = 0.9\n", "[uncertainty]"),
        ("[plant]\nlatency = [0, 2]\n[uncertainty]\nlatency = 1\n", "latency is above"),
        ('[plant]\nfailing = "any"\n[uncertainty]\nmass = 0.1\n', "failures"),
        ('[plant]\nsimulator = "basilisk"\n[uncertainty]\nmass = 0.1\n', "simulator"),
        ("", "ziglang"),
    ],
)
def test_what_it_cannot_fly_or_build_is_refused(
    settings: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(play, "find_spec", lambda name: None)
    (tmp_path / "own.toml").write_text(settings)
    words = ["play", "--config", str(tmp_path / "own.toml"), "--out", str(tmp_path / "page.html")]
    assert_refused(words, [said], capsys)
    assert not (tmp_path / "page.html").exists()


def test_settings_that_are_not_the_usual_ones_are_saved() -> None:
    """Read over the defaults, they give the page's vehicle, world and filter."""
    own = load("configs/vehicles/3u.toml", load("configs/plants/u1.toml", Config()))
    own = replace(own, rta=replace(own.rta, period=5.0))
    saved = from_toml(play.settings(own), "saved", Config())
    for table in play.SETTINGS:
        assert getattr(saved, table) == getattr(own, table) != getattr(Config(), table)


# in a browser


@pytest.fixture(scope="module")
def opened(chromium: Any) -> Browser:
    browser = Browser(chromium, PAGE, 1280, 800)
    browser.until("play.ready")
    return browser


def seconds(browser: Browser, count: int) -> dict[str, Any]:
    """Flies so many seconds with the page's clock standing still; returns outcome and violations."""
    script = """count => {
        pause(true);
        for (let i = 0; i < count; i++) { play.flight.second(); play.scene.renew(play.flight); }
        show();
        return { outcome: play.flight.outcome, broken: play.flight.broken };
    }"""
    return dict(browser.page.evaluate(script, count))


def test_a_browser_flies_it_with_the_keyboard_alone(opened: Browser) -> None:
    keyboard = opened.page.keyboard
    assert opened.page.locator("#welcome").is_visible()
    keyboard.press("Enter")
    assert opened.page.locator("#welcome").is_hidden()
    opened.until("play.flight.time > 0")  # the clock runs
    keyboard.press("1")
    keyboard.down("w")
    assert opened.page.evaluate("play.flight.keys.thrust") == [1, 0, 0]
    assert seconds(opened, 300)["broken"] == {}
    assert opened.page.locator(".bar.acts").count() > 0
    assert "Corrected" in opened.page.locator("#status").inner_text()
    keyboard.press("x")
    found = seconds(opened, 300)
    keyboard.up("w")
    assert opened.page.evaluate("play.flight.keys.thrust") == [0, 0, 0]
    assert found["outcome"] == "crash" and "Crash" in opened.page.locator("#end").inner_text()
    assert opened.page.locator("#broken li").count() == len(found["broken"]) > 0
    keyboard.press("n")
    assert opened.page.locator("#end").is_hidden() and opened.page.locator("#broken li").count() == 0
    keyboard.press("x")


def test_a_browser_flies_errors_at_their_worst(opened: Browser) -> None:
    """In another spacecraft at each start, with a period of the filter's own."""
    locator, evaluate = opened.page.locator, opened.page.evaluate
    locator("#errors").select_option("worst")
    assert locator("#about-errors").is_visible() and locator("#period").is_disabled()
    assert locator("#period").input_value() == "1"
    plants = []
    for key in "12":
        opened.page.keyboard.press(key)
        assert seconds(opened, 60)["broken"] == {}
        plants.append(evaluate("Array.from(play.flight.plant)"))
    assert plants[0] != plants[1] and evaluate("play.flight.corners.some(corner => corner[18])")
    locator("#errors").select_option("none")
    assert locator("#about-errors").is_hidden() and locator("#period").is_enabled()
    assert not evaluate("play.flight.missed")


def test_a_browser_draws_what_is_flown_and_asks_for_nothing(opened: Browser) -> None:
    """The deputy where it is, its camera's axis where it looks, the light from the Sun."""
    opened.page.locator("#pilot").select_option("guide")
    opened.page.keyboard.press("1")
    seconds(opened, 200)
    script = """() => {
        const { scene, flight } = play;
        scene.show(flight, 1);
        const axis = new THREE.Vector3(1, 0, 0).applyQuaternion(scene.craft.quaternion);
        return { place: scene.craft.position.toArray(), axis: axis.toArray(),
                 sun: scene.light.position.toArray(), state: Array.from(flight.state) };
    }"""
    found = opened.page.evaluate(script)
    x = np.array(found["state"])
    np.testing.assert_allclose(found["place"], x[:3], atol=1e-6)
    np.testing.assert_allclose(found["axis"], Rotation.from_quat(x[6:10]).as_matrix()[:, 0], atol=1e-6)
    sun = np.array(found["sun"]) / np.linalg.norm(found["sun"])
    np.testing.assert_allclose(sun, [np.cos(x[15]), np.sin(x[15]), 0.0], atol=1e-6)
    assert opened.errors == []
    assert len(opened.requests) == 1  # the page itself
