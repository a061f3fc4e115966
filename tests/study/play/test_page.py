"""The page of `play`: what is in it, what it asks a network for, and that the shipped one is of this code."""

import base64
import gzip
import json
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from settings import InputError, from_toml, load
from study.config import Config
from study.experiment import load_policy
from study.pages.scene import LICENCE, three
from study.pages.template import STUDY
from study.play import page, printed, wasm, worst
from study.play.starts import CASES, starts
from tests.study.play.test_flight import AGENT, PAGE, U1, fly
from tests.study.replay.test_page import Browser, asks_nothing, chromium
from tests.test_main import assert_refused, call

__all__ = ["chromium"]  # a fixture
TEXT = PAGE.read_text(encoding="utf-8")
SOURCES = (
    "play/flight.js",
    "pages/scene.js",
    "play/picture.js",
    "play/panel.js",
    "pages/scene.css",
    "play/play.css",
)


def data(text: str) -> dict[str, Any]:
    found = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return dict(json.loads(found[1]))


def drawn_with(text: str) -> str:
    """three.js, as a page unpacks it."""
    found = re.search(r'id="three">(.*?)</script>', text)
    assert found
    return gzip.decompress(base64.b64decode(found[1])).decode()


def test_the_shipped_page_is_of_this_code() -> None:
    """Its module is flown beside Python in `test_flight`."""
    for name in SOURCES:
        assert (STUDY / name).read_text(encoding="utf-8") in TEXT, name
    of_page = data(TEXT)
    begun, of_worst = of_page.pop("starts"), of_page.pop("worst")
    assert of_page.pop("settings") == ""
    assert of_page == json.loads(json.dumps(page.task(U1.inspection)))
    assert from_toml(of_worst.pop("settings"), "saved", Config()) == U1
    wanted = worst.described(U1, worst.told(U1))
    for given, found in (
        *zip(begun, starts(U1, printed.filters(U1)), strict=True),
        *zip(of_worst["starts"], wanted.pop("starts"), strict=True),
    ):
        assert given["name"] == found["name"]
        assert given["state"] == pytest.approx(found["state"], abs=1e-9)
        assert given["priority"] == pytest.approx(found["priority"], abs=1e-9)
    np.testing.assert_allclose(of_worst["plants"], wanted.pop("plants"), rtol=1e-12, atol=1e-20)
    assert wanted == {"period": of_worst["period"]}


def test_nothing_is_asked_of_a_network() -> None:
    asks_nothing(TEXT + f"<script>{drawn_with(TEXT)}</script>")


def test_the_page_is_small() -> None:
    assert len(TEXT.encode()) < 1_000_000


def test_every_limit_is_explained() -> None:
    limits = data(TEXT)["limits"]
    assert [each["name"] for each in limits] == list(CONSTRAINTS)
    assert all(each["scale"] > 0 and "{" not in each["why"] for each in limits)
    assert len({each["title"] for each in limits}) == len(limits)


def test_three_js_is_shipped_with_its_licence() -> None:
    assert drawn_with(TEXT) == three()
    assert LICENCE.read_text(encoding="utf-8") in TEXT


def test_without_its_packages_the_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    code, _, err = call(["play", "--out", str(tmp_path / "page.html")], capsys)
    assert code == 2 and "ziglang" in err and ".[play]" in err
    assert not (tmp_path / "page.html").exists()


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
    ],
)
def test_a_configuration_that_it_cannot_fly_is_refused(
    settings: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: object())
    (tmp_path / "own.toml").write_text(settings)
    words = ["play", "--config", str(tmp_path / "own.toml"), "--out", str(tmp_path / "page.html")]
    assert_refused(words, [said], capsys)


def test_a_filter_that_accepts_no_case_is_refused_before_it_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: object())
    together = CASES + 3  # with those that are made, after each was accepted alone
    monkeypatch.setattr(SafetyFilter, "is_safe", lambda self, x: x[0].isfinite() & (x.shape[1] != together))
    for module, name in ((printed, "texts"), (worst, "texts"), (wasm, "compiled")):
        monkeypatch.setattr(module, name, lambda *given: {})
    words = ["play", "--config", "configs/plants/u1.toml", "--out", str(tmp_path / "page.html")]
    code, _, err = call(words, capsys)
    assert code == 2 and "error: [uncertainty]: " in err and "accepts none" in err and "Traceback" not in err
    assert not (tmp_path / "page.html").exists()


def test_settings_that_are_not_the_usual_ones_are_saved_whole() -> None:
    """Read over the defaults, they give the page's vehicle, limits and filter."""
    agent = load_policy(str(AGENT))[1]
    assert (
        page.settings(Config()) == page.settings(agent.with_solver("auto")) == ""
    )  # rewards and observations fly nothing
    own = load("configs/vehicles/3u.toml", load("configs/single_slack.toml", Config()))
    own = replace(own, uncertainty=replace(own.uncertainty, mass=0.05), rta=replace(own.rta, period=5.0))
    saved = from_toml(page.settings(own), "saved", Config())
    assert saved.inspection == own.inspection and saved.uncertainty == own.uncertainty
    assert saved.rta == replace(own.rta, period=saved.rta.period)
    assert own.inspection != Config().inspection and own.rta != Config().rta


def test_a_flight_of_another_vehicle_is_flown_again_by_the_command_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Built for a 3U, which the same controls would carry elsewhere than a 6U."""
    if find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed (requirements-optional.txt)")
    out = tmp_path / "page.html"
    assert call(["play", "--config", "configs/vehicles/3u.toml", "--out", str(out)], capsys)[0] == 0
    (flight,) = fly({"start": "case 0", "pilot": "guide", "seconds": 300, "period": 1}, page=out)
    (tmp_path / "flight.toml").write_text(data(out.read_text(encoding="utf-8"))["settings"])
    (tmp_path / "flight.json").write_text(flight["saved_state"])
    (tmp_path / "flight.npy").write_bytes(base64.b64decode(flight["saved_controls"]))
    monkeypatch.chdir(tmp_path)
    for command in flight["command"].split(" && "):
        words = command.removeprefix("python main.py ").split()
        assert call(words, capsys)[0] == 0, command
    flown = np.load("flight.npz")
    np.testing.assert_allclose(flown["position"][-1], flight["end"][:3], atol=1e-9)
    np.testing.assert_allclose(flown["quaternion"][-1], flight["end"][6:10], atol=1e-9)
    assert flown["energy"][-1] == pytest.approx(flight["end"][14], abs=1e-9)
    assert Path("flight.html").stat().st_size > 0


def test_a_page_is_built(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed (requirements-optional.txt)")
    out = tmp_path / "page.html"
    words = ["play", "--config", "configs/plants/u1.toml", "--checkpoint", str(AGENT), "--out", str(out)]
    code, said, err = call(words, capsys)
    assert code == 0, err
    assert "page.html: 0.8 MB" in said
    made = out.read_text(encoding="utf-8")
    # where processors may round otherwise, or pack otherwise
    rest = re.compile(r'id="(?:data|module|three)">.*?</script>', re.DOTALL)
    assert rest.sub("", made) == rest.sub("", TEXT) and drawn_with(made) == drawn_with(TEXT)
    assert len(made) == pytest.approx(len(TEXT), rel=0.02) and data(made).keys() == data(TEXT).keys()


def test_a_failure_of_the_compiler_is_one_line() -> None:
    if find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed (requirements-optional.txt)")
    with pytest.raises(InputError, match=r"^the compiler of ziglang failed \(1\): .*error: .*nothing"):
        wasm.compiled({"wrong.c": "int main(void) { return nothing; }"})


# in a browser


@pytest.fixture(scope="module")
def opened(chromium: Any) -> Browser:
    browser = Browser(chromium, PAGE, 1280, 800)
    browser.until("play.ready")
    return browser


def seconds(browser: Browser, count: int) -> dict[str, Any]:
    """What has become of the flight so many seconds later, the clock of the page standing still."""
    script = """count => {
        pause(true);
        for (let i = 0; i < count; i++) { play.flight.second(); play.scene.renew(play.flight); }
        show();
        return { outcome: play.flight.outcome, broken: play.flight.broken, control: Array.from(play.flight.control) };
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
    assert found["outcome"] == "crash" and "Crash" in opened.page.locator("#end").inner_text()
    assert opened.page.locator("#broken li").count() == len(found["broken"]) > 0
    keyboard.press("n")
    assert opened.page.locator("#end").is_hidden() and opened.page.locator("#broken li").count() == 0
    keyboard.press("x")


def test_a_browser_flies_it_with_a_gamepad(opened: Browser) -> None:
    script = """([axes, button]) => {
        const buttons = Array.from({ length: 8 }, (_, i) => ({ pressed: i === button, value: i === button ? 1 : 0 }));
        Object.defineProperty(navigator, "getGamepads", { configurable: true, value: () => [null, { axes, buttons }] });
        read_gamepad();
        return [play.flight.keys, play.flight.filtered];
    }"""
    keys, filtered = opened.page.evaluate(script, [[0.1, -0.5, 1.0, 0.0], 7])
    assert (
        keys == {"thrust": [0.5, 0, 1], "torque": [0, 0, -1]} and filtered
    )  # forward, up, turning to the right
    keys, filtered = opened.page.evaluate(script, [[0.0, 0.0, 0.0, 0.0], 0])
    assert keys == {"thrust": [0, 0, 0], "torque": [0, 0, 0]} and not filtered
    assert not opened.page.evaluate(script, [[0.0, 0.0, 0.0, 0.0], 0])[1]  # held is not pressed again
    opened.page.evaluate(script, [[0.0, 0.0, 0.0, 0.0], -1])
    assert opened.page.evaluate(script, [[0.0, 0.0, 0.0, 0.0], 0])[1]


def test_what_a_pointer_has_chosen_does_not_keep_the_keys(opened: Browser) -> None:
    opened.page.locator("#filter").click()
    assert not opened.page.evaluate("() => play.flight.filtered")
    paused = opened.page.evaluate("() => play.paused")
    opened.page.keyboard.press("Space")  # would press a button that has the focus
    assert opened.page.evaluate("() => play.paused") is not paused
    assert not opened.page.evaluate("() => play.flight.filtered")
    opened.page.keyboard.press("x")


def test_a_browser_keeps_the_promises_under_the_adversary(opened: Browser) -> None:
    opened.page.locator("#pilot").select_option("adversary")
    for key in "123":
        opened.page.keyboard.press(key)
        found = seconds(opened, 600)
        assert found["broken"] == {} and found["outcome"] is None


def test_a_browser_flies_errors_at_their_worst(opened: Browser) -> None:
    """In another spacecraft at each start, with a period of the filter's own."""
    about = opened.page.locator("#about-errors")
    assert about.is_hidden()
    opened.page.locator("#errors").select_option("worst")
    assert about.is_visible() and opened.page.locator("#period").is_disabled()
    assert opened.page.locator("#period").input_value() == "1"
    plants = []
    for key in "123":
        opened.page.keyboard.press(key)
        assert seconds(opened, 60)["broken"] == {}
        plants.append(opened.page.evaluate("Array.from(play.flight.plant)"))
        assert "--config flight.toml" in opened.page.evaluate("play.flight.command_again()")
    assert plants[0] != plants[1] != plants[2] and opened.page.locator("#save-settings").count() == 1
    assert opened.page.evaluate("play.flight.corners.some(corner => corner[18])")
    opened.page.locator("#errors").select_option("none")
    assert about.is_hidden() and opened.page.locator("#period").is_enabled()
    assert not opened.page.evaluate("play.flight.missed")


def test_a_browser_draws_what_is_flown(opened: Browser) -> None:
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


def test_a_browser_asks_for_nothing_and_has_no_error(opened: Browser) -> None:
    assert opened.errors == []
    assert len(opened.requests) == 1  # the page itself


@pytest.mark.parametrize("width", [320, 800])
def test_the_page_fits(width: int, chromium: Any) -> None:
    narrow = Browser(chromium, PAGE, width, 800)
    narrow.until("play.ready")
    assert narrow.page.evaluate("document.documentElement.scrollWidth") <= width
    assert narrow.errors == []
