"""The replay's command, and its page as a browser shows it."""

import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import main
from inspection.chief.points import fibonacci_sphere, point_weights
from study.pages.scene import three
from study.replay import page as replay


def embedded(page: str) -> dict[str, Any]:
    """A page's data."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    return json.loads(found[1])


def test_simulate_writes_what_replay_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = tmp_path / "run.npz", tmp_path / "page.html"
    state = {
        # the Sun behind it, the camera turning towards the chief from 30 deg off
        "position": [-40.0, 0.0, 0.0],
        "velocity": [0.0, 0.0, 0.0],
        "quaternion": [0.0, 0.0, -math.sin(math.radians(15.0)), math.cos(math.radians(15.0))],
        "angular_velocity": [0.0, 0.0, 0.01],
        "temperature": 5.0,
        "energy": 6.0,
        "sun_angle": 3.0,
        "priority_vector": [0.0, 0.6, 0.8],
    }
    (tmp_path / "state.json").write_text(json.dumps(state))
    flags = ["--initial-state", str(tmp_path / "state.json"), "--no-rta", "--step", "5", "--duration", "60"]
    assert main.main(["simulate", "--controller", "zero", *flags, "--out", str(run)]) == 0
    assert main.main(["replay", str(run), "--out", str(out)]) == 0
    assert f"{out}: " in capsys.readouterr().out
    arrays = np.load(run)
    priority = torch.tensor(state["priority_vector"], dtype=torch.float64)[:, None]
    weights = point_weights(fibonacci_sphere(100), priority)[:, 0].numpy()
    assert 0 < arrays["inspected"][0].sum() < arrays["inspected"][-1].sum()
    np.testing.assert_allclose(arrays["inspected"] @ weights, arrays["inspected_score"], atol=1e-9)
    times = {t for t in embedded(out.read_text(encoding="utf-8"))["runs"][0]["inspected"] if t is not None}
    assert times <= {0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0}  # as often as the agent looks


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inspected": None}, ["inspected is missing", "older"]),
        ({"intervened": None}, ["intervened is missing", "older"]),
        ({"parameters": None}, ["parameters is missing", "older"]),
        ({"parameters": np.array("[inspection]\nmass = -1.0")}, ["parameters", "mass"]),
        ({"quaternion": np.zeros((30, 3))}, ["quaternion", "(30, 3)", "(30, 4)"]),
        ({"inspected": np.zeros((30, 100))}, ["inspected", "float64", "bool"]),
        ({"intervened": np.zeros((30, 6), dtype=bool)}, ["intervened", "(30, 6)", "(30, 2)"]),
        ({"energy": np.full(30, np.nan)}, ["energy", "finite"]),
        ({"position": np.full((30, 3), 1e300)}, ["position", "up to 1e+12"]),
        ({"time": np.zeros(30)}, ["time", "rise"]),
    ],
)
def test_other_files_are_refused(
    change: dict[str, np.ndarray | None],
    words: list[str],
    flown: dict[str, np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, **{name: array for name, array in (flown | change).items() if array is not None})
    refused([str(path)], [str(path), *words], tmp_path, capsys)


@pytest.mark.parametrize(
    ("runs", "words"),
    [(["nowhere.npz"], ["nowhere.npz", "no such file"]), (["a", "b", "c"], ["3 runs", "at most two"])],
)
def test_bad_arguments_are_refused(
    runs: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(runs, words, tmp_path, capsys)


def refused(runs: list[str], words: list[str], directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, exit code 2, no page."""
    out = directory / "page.html"
    assert main.main(["replay", *runs, "--out", str(out)]) == 2
    err = capsys.readouterr().err
    assert not out.exists()
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    for word in words:
        assert word in err


def test_a_tag_in_a_files_name_stays_text(flown_files: tuple[Path, Path], tmp_path: Path) -> None:
    run, out = tmp_path / "<!--<script>.npz", tmp_path / "page.html"
    shutil.copy(flown_files[0], run)
    replay.write([str(run)], out)
    page = out.read_text(encoding="utf-8")
    assert embedded(page)["runs"][0]["name"] == run.name
    data = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)
    assert data and "<" not in data[1]
    assert run.name not in page and "Replay of &lt;!--&lt;script&gt;.npz" in page


def test_a_page_names_its_runs_without_their_folders(flown_files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    replay.write([str(path) for path in flown_files], out, rows=5, report="../report.html")
    page = out.read_text(encoding="utf-8")
    assert str(flown_files[0].parent) not in page
    assert "one.npz: one row in 6 is shown" in page
    assert '<a href="../report.html">' in page


def test_a_files_name_that_is_not_utf_8_is_shown_with_replacements(
    flown_files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = (Path(os.fsdecode(os.fsencode(tmp_path) + name)) for name in (b"/\xff.npz", b"/\xff.html"))
    try:
        shutil.copy(flown_files[0], run)
    except OSError:
        pytest.skip("file names are UTF-8 here")
    assert main.main(["replay", str(run), "--out", str(out)]) == 0
    assert f"{tmp_path}/\ufffd.html: " in capsys.readouterr().out
    page = out.read_text(encoding="utf-8")
    assert "Replay of \ufffd.npz" in page
    assert embedded(page)["runs"][0]["name"] == "\ufffd.npz"


def test_nothing_is_asked_of_a_network(flown_files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    replay.write([str(flown_files[0])], out)
    asks_nothing(out.read_text(encoding="utf-8"))


NAMES = {  # of vocabularies and in comments, which nothing is asked for
    "http://www.w3.org/1999/xhtml",
    "http://www.w3.org/2000/svg",
    "https://threejs.org",
    "https://github.com/mrdoob/three.js/pull/23228",
}


def asks_nothing(text: str) -> None:
    """A page's policy lets no request out, it names no other place, and its own scripts call nothing that asks."""
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    first = min(text.find(each) % len(text) for each in ("<script", "<style", "<img"))
    assert policy and policy.start() < first
    rules = dict(rule.strip().split(" ", 1) for rule in policy[1].split(";"))
    assert {rules[name] for name in ("default-src", "form-action", "base-uri")} == {"'none'"}
    assert not any("http" in each or "*" in each or "connect" in each for each in policy[1].split())
    assert not re.search(r'(?:src|href|action)\s*=\s*["\']?\s*(?:https?:)?//', text)
    assert set(re.findall(r"https?://[\w./-]+", text)) <= NAMES
    own = "".join(
        script for script in re.findall(r"(?s)<script>(.*?)</script>", text) if "@license" not in script
    )
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|EventSource|sendBeacon|import)\b\s*\(", own)


def test_three_js_is_shipped_with_its_licence() -> None:
    library = three()
    head, _, code = library.partition("*/")
    assert "Permission is hereby granted" in head and "three.js authors" in head
    assert '="140"' in code and "TrackballControls" not in code and "</script" not in code


class Browser:
    """A page in headless Chromium, what it printed and what it asked for."""

    def __init__(self, chromium: Any, path: Path, width: int, height: int, first: str = "") -> None:
        self.page = chromium.new_page(viewport={"width": width, "height": height})
        if first:  # a script that runs before the page's own
            self.page.add_init_script(first)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.set_default_timeout(120_000)  # ms; a busy machine draws slowly
        self.page.goto(path.as_uri())

    def scrub(self, t: float) -> None:
        """Moves the slider as a hand would."""
        self.page.locator("#scrub").evaluate(
            "(scrub, t) => { scrub.value = t; scrub.dispatchEvent(new Event('input')); }", t
        )

    def clock(self) -> float:
        return float(self.page.locator("#scrub").input_value())

    def scene(self, i: int = 0) -> dict[str, np.ndarray]:
        """Where things of a scene are in Hill's frame: places in m and directions."""
        script = """i => {
            const film = films[i], { craft, camera } = film, line = film.trail.geometry;
            const along = axis => new THREE.Vector3(...axis).applyQuaternion(craft.quaternion).toArray();
            film.scene.updateMatrixWorld(true);
            const centre = new THREE.Vector3(), edges = [], corners = film.cone.geometry.attributes.position;
            for (let k = 0; k < corners.count; k++) {
                edges.push(centre.fromBufferAttribute(corners, k).applyMatrix4(film.cone.matrixWorld).toArray());
            }
            return {
                deputy: craft.position.toArray(), cone: edges,
                x: along([1, 0, 0]), y: along([0, 1, 0]), z: along([0, 0, 1]),
                light: film.light.position.toArray(), camera: camera.position.toArray(),
                sun: film.toSun.localToWorld(new THREE.Vector3(1, 0, 0)).toArray(),
                flown: Array.from(line.attributes.position.array.slice(0, 3 * line.drawRange.count)),
            };
        }"""
        return {name: np.array(value) for name, value in self.page.evaluate(script, i).items()}

    def points(self, i: int = 0) -> list[tuple[np.ndarray, str]]:
        """Place in Hill's frame and colour of each of the chief's points."""
        script = """i => {
            const { points, whole_chief } = films[i], colour = new THREE.Color(), matrix = new THREE.Matrix4();
            return Array.from({ length: points.count }, (_, k) => {
                points.getColorAt(k, colour);
                points.getMatrixAt(k, matrix);
                const place = new THREE.Vector3().setFromMatrixPosition(matrix).applyQuaternion(whole_chief.quaternion);
                return [place.toArray(), colour.convertLinearToSRGB().getHexString()];
            });
        }"""
        return [(np.array(place), colour) for place, colour in self.page.evaluate(script, i)]

    def until(self, holds: str) -> None:
        """Waits for what a script says; Playwright's own waiting evaluates text, which the pages do not allow."""
        end = time.monotonic() + 60.0
        while not self.page.evaluate(f"() => {holds}"):
            assert time.monotonic() < end, holds
            time.sleep(0.05)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser, where there is one."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (requirements-optional.txt)"
    )
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium here")
    with playwright.sync_playwright() as started:
        # drawn in software: a machine without a display has no other WebGL
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = started.chromium.launch(executable_path=path, args=flags)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def one(chromium: Any, flown_files: tuple[Path, Path]) -> Browser:
    """One run at desktop width."""
    out = flown_files[0].with_suffix(".html")
    replay.write([str(flown_files[0])], out)
    return Browser(chromium, out, 1280, 900)


def test_the_page_asks_for_nothing_and_has_no_error(one: Browser) -> None:
    assert one.errors == []
    assert len(one.requests) == 1  # the page itself
    assert one.page.title().endswith("Replay of one.npz")


def test_a_request_is_refused(chromium: Any, flown_files: tuple[Path, Path]) -> None:
    """Whatever asks: the page's own policy, not only that nothing asks."""
    out = flown_files[0].with_name("asks.html")
    replay.write([str(flown_files[0])], out)
    asking = Browser(chromium, out, 800, 600)
    script = "() => fetch('https://127.0.0.1:1/').then(() => 'answered', error => error.name)"
    assert asking.page.evaluate(script) == "TypeError"
    assert any("Content Security Policy" in each for each in asking.errors)


@pytest.mark.parametrize("row", [7, 21])
def test_scrubbing_moves_the_scene(row: int, one: Browser, flown: dict[str, np.ndarray]) -> None:
    """Between two rows, 10 s apart, evenly from one to the other."""
    one.scrub(flown["time"][row] + 3.0)
    scene = one.scene()
    p = 0.7 * flown["position"][row] + 0.3 * flown["position"][row + 1]
    turns = Slerp([0.0, 10.0], Rotation.from_quat(flown["quaternion"][row : row + 2]))
    x, y, z = turns(3.0).as_matrix().T
    np.testing.assert_allclose(scene["deputy"], p, rtol=1e-3)
    np.testing.assert_allclose(scene["flown"].reshape(-1, 3)[:-1], flown["position"][: row + 1], rtol=1e-3)
    np.testing.assert_allclose(scene["flown"][-3:], p, rtol=1e-3)
    for name, axis in (("x", x), ("y", y), ("z", z)):
        np.testing.assert_allclose(scene[name], axis, atol=1e-3)
    edges = scene["cone"] - scene["deputy"]
    edges = edges[np.linalg.norm(edges, axis=1) > 1.0]
    cosines = edges @ x / np.linalg.norm(edges, axis=1)
    np.testing.assert_allclose(np.degrees(np.arccos(cosines)), 30.0, atol=0.1)
    theta = flown["sun_angle"][row]
    for name in ("sun", "light"):
        towards = scene[name] / np.linalg.norm(scene[name])
        np.testing.assert_allclose(towards, [math.cos(theta), math.sin(theta), 0.0], atol=1e-3)


def test_points_are_told_apart(one: Browser, flown: dict[str, np.ndarray]) -> None:
    row = 15
    one.scrub(flown["time"][row])
    points = one.points()
    theta, inspected = flown["sun_angle"][row], flown["inspected"][row]
    normals = fibonacci_sphere(100).numpy().T
    lit = normals @ [math.cos(theta), math.sin(theta), 0.0] > 0.0
    np.testing.assert_allclose([place for place, _ in points], 10.0 * normals, atol=0.01)
    found = np.array([colour for _, colour in points])
    kinds = {"009e73": inspected, "e69f00": lit & ~inspected, "4a4f58": ~lit & ~inspected}
    for colour, chosen in kinds.items():
        assert chosen.any()
        np.testing.assert_array_equal(found == colour, chosen)


def test_a_tumbling_mesh_and_a_hull_are_drawn(
    chromium: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for chief, has_hull in ((["satellite"], False), (["box", "hull"], True)):
        run, out = tmp_path / "run.npz", tmp_path / "run.html"
        given = [word for name in chief for word in ("--config", f"configs/chiefs/{name}.toml")]
        flags = ["--no-rta", "--controller", "zero", "--duration", "100", "--step", "50", "--out", str(run)]
        assert main.main(["simulate", *given, *flags]) == 0
        replay.write([str(run)], out)
        shown = Browser(chromium, out, 800, 700)
        shown.scrub(50.0)
        flown = np.load(run)
        turned = Rotation.from_quat(flown["chief_attitude"][1])
        places = np.array([place for place, _ in shown.points()])
        raised = flown["chief_points"] + 0.1 * flown["chief_normals"]
        np.testing.assert_allclose(places, turned.apply(raised), atol=0.01)
        assert shown.page.evaluate("() => Boolean(films[0].hull)") == has_hull
        assert ("the hull to stay clear of" in shown.page.locator(".legend").first.inner_text()) == has_hull
        assert shown.errors == []
        shown.page.close()


def test_without_webgl_the_plots_still_play(chromium: Any, flown_files: tuple[Path, Path]) -> None:
    out = flown_files[0].with_name("flat.html")
    replay.write([str(flown_files[0])], out)
    lost = "HTMLCanvasElement.prototype.getContext = () => null;"
    flat = Browser(chromium, out, 800, 600, lost)
    assert "draws no WebGL" in flat.page.locator(".missing").inner_text()
    flat.scrub(50.0)
    assert flat.clock() == 50.0 and "distance" in flat.page.locator(".status").inner_text()


def test_values_and_filter_at_the_cursor(one: Browser, flown: dict[str, np.ndarray]) -> None:
    one.scrub(75.0)
    assert "filter corrects thrust and torque" in one.page.locator(".status").inner_text()
    caption = one.page.locator(".panel figcaption", has_text="Energy").inner_text()
    assert f"{flown['energy'][7]:.1f}" in caption
    one.scrub(85.0)
    assert "no correction" in one.page.locator(".status").inner_text()


def test_space_plays_and_pauses_and_arrows_step(one: Browser) -> None:
    one.page.locator("#speed").select_option("60")
    one.page.locator("h1").click()  # the keyboard's focus leaves the list
    one.scrub(100.0)
    one.page.keyboard.press("ArrowRight")
    assert one.clock() == 110.0
    one.page.keyboard.press("ArrowLeft")
    one.page.keyboard.press("ArrowLeft")
    assert one.clock() == 90.0
    before = one.scene()["deputy"]
    one.page.keyboard.press(" ")
    one.until("Number(document.getElementById('scrub').value) > 105")
    one.page.keyboard.press(" ")
    assert (one.scene()["deputy"] != before).any()
    stopped = one.clock()
    one.page.wait_for_timeout(200)
    assert one.clock() == stopped
    assert one.errors == []


def test_a_turned_scene_stays_turned(one: Browser) -> None:
    one.scrub(60.0)
    before, look = one.scene()["camera"], "() => ({ ...looks.orbit })"
    first = one.page.evaluate(look)
    box = one.page.locator(".scene").bounding_box()
    one.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.3 * box["height"])
    one.page.mouse.down()
    one.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"])
    one.page.mouse.up()
    assert (one.scene()["camera"] != before).any()  # without the clock
    turned = one.page.evaluate(look)
    assert turned["yaw"] < first["yaw"] and turned["pitch"] > first["pitch"]
    one.scrub(0.0)
    assert one.page.evaluate(look) == turned


def test_the_keyboard_alone_turns_zooms_and_changes_the_view(one: Browser) -> None:
    one.scrub(50.0)
    one.page.locator(".scene").focus()
    before = one.page.evaluate("() => [looks.orbit.yaw, looks.orbit.pitch, time]")
    for key in ("ArrowLeft", "ArrowUp", "-"):
        one.page.keyboard.press(key)
    yaw, pitch, distance, now = one.page.evaluate(
        "() => [looks.orbit.yaw, looks.orbit.pitch, looks.orbit.distance, time]"
    )
    assert yaw > before[0] and pitch > before[1] and distance > 0 and now == before[2]
    assert np.linalg.norm(one.scene()["camera"]) == pytest.approx(distance)
    views = []
    for _ in range(3):
        one.page.keyboard.press("c")
        views.append(one.page.evaluate("() => films[0].view"))
    assert sorted(views) == ["follow", "onboard", "orbit"] and views[-1] == "orbit"


def test_a_click_into_a_plot_goes_there(one: Browser, flown: dict[str, np.ndarray]) -> None:
    one.scrub(0.0)
    plot = one.page.locator(".plot").nth(2)
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    one.page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    assert one.clock() == pytest.approx(145.0, abs=2.0)
    cursor = one.page.locator(".cursor").nth(2).bounding_box()
    assert cursor["x"] == pytest.approx(box["x"] + 0.5 * box["width"], abs=2.0)


def test_a_curve_is_where_its_axis_says(one: Browser, flown: dict[str, np.ndarray]) -> None:
    """The Energy's, by the places of its ticks."""
    panel = one.page.locator(".panel", has_text="Energy")
    ticks = panel.locator(".tick.y")
    values = [
        (float(ticks.nth(i).inner_text()), float(ticks.nth(i).evaluate("tick => parseFloat(tick.style.top)")))
        for i in range(ticks.count())
    ]
    (a, at_a), (b, at_b) = values[0], values[-1]
    lines = panel.locator("svg path").evaluate_all("paths => paths.map(path => path.getAttribute('d'))")
    curve = max(lines, key=len)
    found = np.array([[float(number) for number in pair.split()] for pair in curve[1:].split("L")])
    energy = a + (found[:, 1] - at_a) * (b - a) / (at_b - at_a)
    np.testing.assert_allclose(energy, flown["energy"], rtol=1e-2)
    np.testing.assert_allclose(found[:, 0] * flown["time"][-1] / 1000.0, flown["time"], atol=0.01)


def test_two_runs_share_a_clock_on_a_phone(chromium: Any, flown_files: tuple[Path, Path]) -> None:
    out = flown_files[0].with_name("both.html")
    replay.write([str(path) for path in flown_files], out)
    both = Browser(chromium, out, 390, 844)
    both.scrub(150.0)
    first, second = both.scene(0), both.scene(1)
    np.testing.assert_array_equal(first["deputy"], second["deputy"])
    np.testing.assert_array_equal(first["camera"], second["camera"])
    both.scrub(250.0)
    assert "ends at 190 s" in both.page.locator(".status").nth(1).inner_text()
    first, second = both.scene(0), both.scene(1)
    assert (first["deputy"] != second["deputy"]).any()
    np.testing.assert_array_equal(first["camera"], second["camera"])  # to the same scale
    assert both.page.evaluate("document.documentElement.scrollWidth") == 390
    assert both.errors == []
