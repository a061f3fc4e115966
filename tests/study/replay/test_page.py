"""The replay's command, and its page as a browser shows it."""

import json
import math
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import main
from inspection.chief.points import fibonacci_sphere, point_weights
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


def test_no_plot_has_an_address_to_send_its_chart_to(flown_files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    replay.write([str(flown_files[0])], out)
    page = out.read_text(encoding="utf-8")
    for name in ("showSendToCloud", "plotlyServerURL"):  # what this version of plotly goes by
        assert f"{name}:{{valType:" in page
    own = page[page.rindex("<script>") :]
    (local,) = re.findall(r"const LOCAL = \{ (.*) \};", own)
    off = {"displaylogo: false", "showSendToCloud: false", 'plotlyServerURL: ""'}
    assert off <= set(local.split(", "))
    plots = re.findall(r"Plotly\.newPlot\((.*)\);", own)
    assert len(plots) == own.count("Plotly.newPlot") and all("LOCAL" in plot for plot in plots)


class Browser:
    """A page in headless Chromium, what it printed and what it asked for."""

    def __init__(self, chromium: Any, path: Path, width: int, height: int) -> None:
        self.page = chromium.new_page(viewport={"width": width, "height": height})
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
        """Corners (k, 3) of the traces of a scene by name."""
        traces = (
            self.page.locator(".scene")
            .nth(i)
            .evaluate(
                "scene => scene.data.map(({ name, x, y, z }) => [name, x.map((_, k) => [x[k], y[k], z[k]])])"
            )
        )
        return {name: np.array(corners, dtype=float) for name, corners in traces}


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


def test_the_toolbar_uploads_nothing(one: Browser) -> None:
    buttons = one.page.locator(".modebar-btn")
    titles = [buttons.nth(i).get_attribute("data-title") for i in range(buttons.count())]
    assert "Turntable rotation" in titles
    assert not any(word in title.lower() for title in titles for word in ("share", "cloud", "plotly", "edit"))


@pytest.mark.parametrize("row", [7, 21])
def test_scrubbing_moves_the_scene(row: int, one: Browser, flown: dict[str, np.ndarray]) -> None:
    one.scrub(flown["time"][row] + 3.0)
    scene = one.scene()
    p = flown["position"][row]
    x, y, z = Rotation.from_quat(flown["quaternion"][row]).as_matrix().T
    np.testing.assert_allclose(scene["deputy"], [p], rtol=1e-3)
    np.testing.assert_allclose(scene["flown"][-1], p, rtol=1e-3)
    assert len(scene["flown"]) == row + 1
    for name, axis in (("x", x), ("y", y), ("z", z)):
        drawn = scene[name][1] - scene[name][0]
        np.testing.assert_allclose(drawn / np.linalg.norm(drawn), axis, atol=1e-3)
    edges = scene["cone"][1:] - scene["cone"][0]
    cosines = edges @ x / np.linalg.norm(edges, axis=1)
    np.testing.assert_allclose(np.degrees(np.arccos(cosines)), 30.0, atol=0.1)
    theta = flown["sun_angle"][row]
    sun = scene["sun"][1] / np.linalg.norm(scene["sun"][1])
    np.testing.assert_allclose(sun, [math.cos(theta), math.sin(theta), 0.0], atol=1e-3)
    assert scene["earth"][1][0] < 0.0
    assert not scene["earth"][:, 1:].any()


def test_points_are_told_apart(one: Browser, flown: dict[str, np.ndarray]) -> None:
    row = 15
    one.scrub(flown["time"][row])
    scene = one.scene()
    theta, inspected = flown["sun_angle"][row], flown["inspected"][row]
    normals = fibonacci_sphere(100).numpy().T
    lit = normals @ [math.cos(theta), math.sin(theta), 0.0] > 0.0
    for name, chosen in (("inspected", inspected), ("lit", lit & ~inspected), ("dark", ~lit & ~inspected)):
        assert chosen.any()
        np.testing.assert_allclose(scene[name], 10.0 * normals[chosen], atol=0.01)


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
    one.page.wait_for_function("Number(document.getElementById('scrub').value) > 105")
    one.page.keyboard.press(" ")
    assert (one.scene()["deputy"] != before).any()
    stopped = one.clock()
    one.page.wait_for_timeout(200)
    assert one.clock() == stopped
    assert one.errors == []


def test_a_turned_scene_stays_turned(one: Browser) -> None:
    eye = "document.querySelector('.scene').layout.scene.camera.eye"
    before = one.page.evaluate(eye)
    box = one.page.locator(".scene").bounding_box()
    one.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.3 * box["height"])
    one.page.mouse.down()
    one.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"])
    one.scrub(one.clock() + 50.0)  # as while playing
    turned = one.page.evaluate(eye)
    one.page.mouse.up()
    one.scrub(0.0)
    assert turned != before
    assert one.page.evaluate(eye) == pytest.approx(turned, abs=1e-6)


def test_two_runs_share_a_clock_on_a_phone(chromium: Any, flown_files: tuple[Path, Path]) -> None:
    out = flown_files[0].with_name("both.html")
    replay.write([str(path) for path in flown_files], out)
    both = Browser(chromium, out, 390, 844)
    both.scrub(150.0)
    np.testing.assert_array_equal(both.scene(0)["deputy"], both.scene(1)["deputy"])
    both.scrub(250.0)
    assert "ends at 190 s" in both.page.locator(".status").nth(1).inner_text()
    assert (both.scene(0)["deputy"] != both.scene(1)["deputy"]).any()
    cameras = [
        both.page.locator(".scene").nth(i).evaluate("scene => scene.layout.scene.camera") for i in (0, 1)
    ]
    assert cameras[0] == cameras[1]
    assert both.page.evaluate("document.documentElement.scrollWidth") == 390
    assert both.errors == []
