"""The replay: what its page shows, against the run's file by other formulas, and as a browser shows it."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import main
from inspection.chief.points import fibonacci_sphere
from inspection.chief.surface import light, surface
from rta.names import CONSTRAINTS
from settings import load
from study.config import Config
from study.web import replay
from tests.study.web.browser import Browser, chromium

__all__ = ["chromium"]  # a fixture
Arrays = dict[str, np.ndarray]
Files = tuple[Path, Path]


def embedded(page: str) -> dict[str, Any]:
    """Returns a page's data."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    return json.loads(found[1])


def content(*paths: Path, rows: int = replay.MAX_ROWS) -> dict[str, Any]:
    """Returns the page's content for runs."""
    return embedded(replay.document([replay.read(str(path), rows) for path in paths]))


@pytest.fixture(scope="module")
def shown(flown_files: Files) -> dict[str, Any]:
    return content(flown_files[0])


def test_the_commands_make_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = tmp_path / "run.npz", tmp_path / "page.html"
    flags = ["--no-rta", "--step", "5", "--duration", "60", "--out", str(run)]
    assert main.main(["simulate", "--controller", "even", *flags]) == 0
    assert main.main(["replay", str(run), "--out", str(out)]) == 0
    assert f"{out}: " in capsys.readouterr().out
    times = {t for t in embedded(out.read_text(encoding="utf-8"))["runs"][0]["inspected"] if t is not None}
    assert len(times) > 1 and times <= set(range(0, 61, 10))  # as often as the agent looks


# what is shown


def test_points_and_interventions_are_when_the_file_says_so(flown: Arrays, shown: dict[str, Any]) -> None:
    """Also where a correction is kept in which the filter had nothing more to correct."""
    since = np.array([math.inf if t is None else t for t in shown["runs"][0]["inspected"]])
    assert np.isinf(since).any()
    np.testing.assert_array_equal(since <= flown["time"][:, None], flown["inspected"])
    interventions = shown["runs"][0]["interventions"]
    for program, control in enumerate(("thrust", "torque")):
        starts = np.array([start for start, _ in interventions[control]])[:, None]
        ends = np.array([end for _, end in interventions[control]])[:, None]
        marked = ((starts <= flown["time"]) & (flown["time"] < ends)).any(0)
        np.testing.assert_array_equal(marked, flown["intervened"][:, program])


def test_panels_hold_every_constraint_and_both_controls_within_their_range(
    flown: Arrays, shown: dict[str, Any]
) -> None:
    panels = [panel for section in shown["sections"].values() for panel in section]
    lines = [line for panel in panels for line in panel["runs"][0]["lines"]]
    for each in panels:
        values = np.array([line["values"] for line in each["runs"][0]["lines"]])
        assert each["range"][0] < values.min() <= values.max() < each["range"][1]
    degrees = {"attitude_exclusion": math.degrees(1.0)}
    degrees |= {f"angular_velocity_{axis}": math.degrees(1.0) ** 2 for axis in "xyz"}
    expected = [degrees.get(name, 1.0) * flown[f"h_{name}"] for name in CONSTRAINTS]
    expected += [flown["energy"], flown["temperature"], flown["inspected_score"]]
    expected += [np.linalg.norm(flown[name], axis=1) for name in ("position", "velocity")]
    # each row's control acts until the next, here for 10 s; the last one not at all
    spent = np.abs(flown["control_applied"][:-1, :3]).sum(1).cumsum() * 10.0 / 12.0
    expected.append(np.array([0.0, *spent]))
    for kind in ("desired", "applied"):
        expected += list((flown[f"control_{kind}"] * [1.0, 1.0, 1.0, 1e3, 1e3, 1e3]).T)
    assert len(lines) == len(expected)
    for values in expected:
        assert any(np.allclose(line["values"], values, rtol=1e-3) for line in lines)


def test_a_long_run_is_thinned_but_no_violation_or_intervention_is_lost(
    flown_files: Files, flown: Arrays, shown: dict[str, Any]
) -> None:
    thin = content(flown_files[0], rows=8)
    assert thin["runs"][0]["time"] == flown["time"][::4].tolist()
    assert thin["runs"][0]["interventions"] == shown["runs"][0]["interventions"]
    assert thin["runs"][0]["inspected"] == shown["runs"][0]["inspected"]
    blocks = np.array_split(flown["h_collision"], range(4, 30, 4))
    separation = thin["sections"]["Constraints, safe where h ≥ 0"][0]["runs"][0]["lines"][0]["values"]
    np.testing.assert_allclose(separation, [block.min() for block in blocks], rtol=1e-3)


# a chief of one's own


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs beside a tumbling mesh, and beside a hull."""
    found = {}
    for chief in (("satellite",), ("box", "hull")):
        out = tmp_path_factory.mktemp("chiefs") / f"{chief[-1]}.npz"
        own = [word for name in chief for word in ("--config", f"configs/chiefs/{name}.toml")]
        flags = ["--no-rta", "--controller", "zero", "--duration", "200", "--step", "50", "--out", str(out)]
        assert main.main(["simulate", *own, *flags]) == 0
        found[chief[-1]] = out
    return found


def test_points_in_the_meshs_own_shade_are_not_shown_as_lit(beside: dict[str, Path]) -> None:
    """Against the simulator's light, which needs a point to face the Sun and to be out of the shade."""
    (run,), flown = content(beside["satellite"])["runs"], np.load(beside["satellite"])
    assert run["hull"] is None  # it is a sphere that is to stay clear
    config = load("configs/chiefs/satellite.toml", Config())
    whole = surface(config.chief, config.inspection)
    for row, shaded in enumerate(run["shaded"]):
        angle, to_hill = run["sun_angle"][row], Rotation.from_quat(flown["chief_attitude"][row])
        sun = to_hill.inv().apply([math.cos(angle), math.sin(angle), 0.0])
        facing = flown["chief_normals"] @ sun > 1e-6
        lit = light(whole, torch.tensor(sun)[:, None].float())[:, 0].numpy() > 0.0
        as_lit = facing & ~np.isin(np.arange(len(facing)), shaded)
        assert (as_lit != lit).mean() < 0.01 and (as_lit != facing).any()


# in a browser


class Shown(Browser):
    """Drives a replay in the browser."""

    def scrub(self, t: float) -> None:
        """Moves the slider as a hand would."""
        self.page.locator("#scrub").evaluate(
            "(scrub, t) => { scrub.value = t; scrub.dispatchEvent(new Event('input')); }", t
        )

    def clock(self) -> float:
        return float(self.page.locator("#scrub").input_value())

    def scene(self) -> Arrays:
        """Returns the positions in m and directions of the first scene's objects in Hill's frame."""
        script = """() => {
            const film = films[0], { craft } = film, line = film.trail.geometry;
            film.scene.updateMatrixWorld(true);
            const centre = new THREE.Vector3(), edges = [], corners = film.cone.geometry.attributes.position;
            for (let k = 0; k < corners.count; k++) {
                edges.push(centre.fromBufferAttribute(corners, k).applyMatrix4(film.cone.matrixWorld).toArray());
            }
            return {
                deputy: craft.position.toArray(), attitude: craft.quaternion.toArray(), cone: edges,
                light: film.light.position.toArray(),
                flown: Array.from(line.attributes.position.array.slice(0, 3 * line.drawRange.count)),
            };
        }"""
        return {name: np.array(value) for name, value in self.page.evaluate(script).items()}

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Places in Hill's frame and colours of the chief's points."""
        script = """() => {
            const { points, whole_chief } = films[0], colour = new THREE.Color(), matrix = new THREE.Matrix4();
            return Array.from({ length: points.count }, (_, k) => {
                points.getColorAt(k, colour);
                points.getMatrixAt(k, matrix);
                const place = new THREE.Vector3().setFromMatrixPosition(matrix).applyQuaternion(whole_chief.quaternion);
                return [place.toArray(), colour.convertLinearToSRGB().getHexString()];
            });
        }"""
        places, colours = zip(*self.page.evaluate(script), strict=True)
        return np.array(places), np.array(colours)


@pytest.fixture(scope="module")
def one(chromium: Any, flown_files: Files) -> Shown:
    """Returns one run at desktop width."""
    out = flown_files[0].with_suffix(".html")
    replay.write([str(flown_files[0])], out)
    return Shown(chromium, out, 1280, 900)


def test_scrubbing_moves_the_scene(one: Shown, flown: Arrays) -> None:
    """Between two rows, 10 s apart, evenly from one to the other."""
    row = 21
    one.scrub(flown["time"][row] + 3.0)
    scene = one.scene()
    p = 0.7 * flown["position"][row] + 0.3 * flown["position"][row + 1]
    turned = Slerp([0.0, 10.0], Rotation.from_quat(flown["quaternion"][row : row + 2]))(3.0).as_matrix()
    np.testing.assert_allclose(scene["deputy"], p, rtol=1e-3)
    np.testing.assert_allclose(scene["flown"].reshape(-1, 3)[:-1], flown["position"][: row + 1], rtol=1e-3)
    np.testing.assert_allclose(scene["flown"][-3:], p, rtol=1e-3)
    np.testing.assert_allclose(Rotation.from_quat(scene["attitude"]).as_matrix(), turned, atol=1e-3)
    edges = scene["cone"] - scene["deputy"]
    edges = edges[np.linalg.norm(edges, axis=1) > 1.0]
    cosines = edges @ turned[:, 0] / np.linalg.norm(edges, axis=1)
    np.testing.assert_allclose(np.degrees(np.arccos(cosines)), 30.0, atol=0.1)
    theta, light = flown["sun_angle"][row], scene["light"]
    sun = [math.cos(theta), math.sin(theta), 0.0]
    np.testing.assert_allclose(light / np.linalg.norm(light), sun, atol=1e-3)


def test_points_are_told_apart(one: Shown, flown: Arrays) -> None:
    row = 15
    one.scrub(flown["time"][row])
    places, colours = one.points()
    theta, inspected = flown["sun_angle"][row], flown["inspected"][row]
    normals = fibonacci_sphere(100).numpy().T
    lit = normals @ [math.cos(theta), math.sin(theta), 0.0] > 0.0
    np.testing.assert_allclose(places, 10.0 * normals, atol=0.01)
    expected = np.where(inspected, "009e73", np.where(lit, "e69f00", "4a4f58"))
    assert len(set(expected)) == 3 and (colours == expected).all()


@pytest.mark.parametrize("name", ["satellite", "hull"])
def test_a_tumbling_mesh_and_a_hull_are_drawn(name: str, chromium: Any, beside: dict[str, Path]) -> None:
    out, flown = beside[name].with_suffix(".html"), np.load(beside[name])
    replay.write([str(beside[name])], out)
    drawn = Shown(chromium, out, 800, 700)
    drawn.scrub(50.0)
    turned = Rotation.from_quat(flown["chief_attitude"][1])
    raised = flown["chief_points"] + 0.1 * flown["chief_normals"]
    np.testing.assert_allclose(drawn.points()[0], turned.apply(raised), atol=0.01)
    assert drawn.page.evaluate("() => Boolean(films[0].hull)") == (name == "hull")
    legend = drawn.page.locator(".legend").first.inner_text()
    assert ("the hull to stay clear of" in legend) == (name == "hull")
    assert drawn.errors == []
    drawn.page.close()


def test_the_keyboard_plays_pauses_steps_and_changes_the_view(one: Shown) -> None:
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
    views = []
    for _ in range(3):
        one.page.keyboard.press("c")
        views.append(one.page.evaluate("() => films[0].view"))
    assert sorted(views) == ["follow", "onboard", "orbit"] and views[-1] == "orbit"
    assert one.errors == []
