"""What a replay shows, against the run's file by other formulas."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import main
from inspection.chief.surface import light, surface
from rta.constraints.names import CONSTRAINTS
from settings import load
from study.config import Config
from study.replay import page, scene
from study.replay.scene import Replayed


@pytest.fixture(scope="module")
def shown(flown_files: tuple[Path, Path]) -> dict[str, Any]:
    """What the page holds of the run."""
    return as_written(scene.read(str(flown_files[0])))


def as_written(run: Replayed) -> dict[str, Any]:
    """The content after a journey through JSON."""
    return json.loads(json.dumps(scene.content([run]), default=scene.rounded))


def test_the_attitude_is_the_files(flown: dict[str, np.ndarray], shown: dict[str, Any]) -> None:
    found = Rotation.from_quat(shown["runs"][0]["quaternion"]).as_matrix()
    np.testing.assert_allclose(found, Rotation.from_quat(flown["quaternion"]).as_matrix(), atol=1e-5)


def test_free_flight_is_that_of_an_integrator(flown: dict[str, np.ndarray], shown: dict[str, Any]) -> None:
    c = Config().inspection
    n, times = c.mean_motion, np.linspace(0.0, c.passive_safety_horizon, scene.AHEAD)

    def coasting(_: float, y: np.ndarray) -> np.ndarray:
        (x, _, z), (dx, dy, _) = y[:3], y[3:]
        return np.array([*y[3:], 3 * n**2 * x + 2 * n * dy, -2 * n * dx, -(n**2) * z])

    for row, places in enumerate(shown["runs"][0]["ahead"]):
        begun = np.concatenate((flown["position"][row], flown["velocity"][row]))
        found = solve_ivp(coasting, (0.0, times[-1]), begun, t_eval=times, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(places, found.y[:3].T, rtol=1e-3, atol=0.02)


def test_delta_v_is_the_applied_thrusts(flown: dict[str, np.ndarray], shown: dict[str, Any]) -> None:
    """Each row's control acts until the next, here for 10 s; the last one not at all."""
    (found,) = [
        panel["runs"][0]["lines"][0]["values"]
        for panel in shown["sections"]["Flight"]
        if panel["runs"][0]["title"] == "Delta v"
    ]
    each = np.abs(flown["control_applied"][:-1, :3]).sum(1) * 10.0 / 12.0
    np.testing.assert_allclose(found, [0.0, *np.cumsum(each)], rtol=1e-3)


def test_interventions_are_where_the_filter_corrected_not_where_a_correction_is_kept(
    flown: dict[str, np.ndarray], shown: dict[str, Any]
) -> None:
    interventions = shown["runs"][0]["interventions"]
    for program, control in enumerate(("thrust", "torque")):
        starts = np.array([start for start, _ in interventions[control]])[:, None]
        ends = np.array([end for _, end in interventions[control]])[:, None]
        marked = ((starts <= flown["time"]) & (flown["time"] < ends)).any(0)
        np.testing.assert_array_equal(marked, flown["intervened"][:, program])


def test_points_become_inspected_when_the_file_says_so(
    flown: dict[str, np.ndarray], shown: dict[str, Any]
) -> None:
    since = np.array([math.inf if t is None else t for t in shown["runs"][0]["inspected"]])
    assert np.isinf(since).any()
    np.testing.assert_array_equal(since <= flown["time"][:, None], flown["inspected"])


def test_points_in_the_meshs_own_shade_are_not_shown_as_lit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Against the simulator's light, which needs a point to face the Sun and to be out of the shade."""
    out = tmp_path / "flown.npz"
    own = "configs/chiefs/satellite.toml"
    flags = ["--controller", "zero", "--duration", "200", "--step", "50", "--out", str(out)]
    assert main.main(["simulate", "--no-rta", "--config", own, *flags]) == 0
    capsys.readouterr()
    run = scene.read(str(out))
    content = as_written(run)["runs"][0]
    assert content["hull"] is None  # it is a sphere that is to stay clear
    config = load(own, Config())
    whole = surface(config.chief, config.inspection)
    for row, shaded in enumerate(content["shaded"]):
        angle, to_hill = content["sun_angle"][row], Rotation.from_quat(run.episode["chief_attitude"][row])
        sun = to_hill.inv().apply([math.cos(angle), math.sin(angle), 0.0])
        facing = run.episode["chief_normals"] @ sun > 1e-6
        lit = light(whole, torch.tensor(sun)[:, None].float())[:, 0].numpy() > 0.0
        shown = facing & ~np.isin(np.arange(len(facing)), shaded)
        assert (shown != lit).mean() < 0.01 and (shown != facing).any()


def test_a_flight_beside_a_hull_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "flown.npz", tmp_path / "flown.png"
    chief = ["--config", "configs/chiefs/box.toml", "--config", "configs/chiefs/hull.toml"]
    flags = ["--controller", "zero", "--duration", "20", "--out", str(out), "--figure", str(figure)]
    assert main.main(["simulate", "--no-rta", *chief, *flags]) == 0
    capsys.readouterr()
    run = scene.read(str(out))
    shown = as_written(run)["runs"][0]
    assert figure.is_file() and len(shown["triangles"]) == 3 * len(run.episode["chief_triangles"])
    faces, corners = (np.array(shown[name]).reshape(-1, 3, 3) for name in ("hull", "triangles"))
    for a, b, c in faces:  # all of the chief is on one side of each
        above = (corners - a) @ np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        assert above.min() > -1e-2 or above.max() < 1e-2
    (clear,) = [
        panel for panel in as_written(run)["sections"]["Flight"] if panel["runs"][0]["title"] == "Clearance"
    ]
    assert clear["runs"][0]["lines"][0]["values"] == pytest.approx(run.episode["clearance"], rel=1e-3)
    # points are drawn in front of their faces
    above = np.array(shown["points"]) - run.episode["chief_points"]
    assert ((above * run.episode["chief_normals"]).sum(1) > 0.05).all()


def test_beside_a_run_with_a_hull_the_other_has_a_clearance_too(
    flown: dict[str, np.ndarray], flown_files: tuple[Path, Path], tmp_path: Path
) -> None:
    """Of the sphere that it stays clear of, 15 m."""
    still = {"chief_attitude": np.tile([0.0, 0.0, 0.0, 1.0], (30, 1)), "clearance": np.linspace(9.0, 1.0, 30)}
    corners = 5.0 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    body = {"points": corners, "normals": corners / np.linalg.norm(corners, axis=1)[:, None]}
    faces = corners[[[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]]
    own = {f"chief_{name}": each for name, each in (body | {"triangles": faces}).items()}
    inspected = {"inspected": flown["inspected"][:, :4]}
    np.savez(tmp_path / "hull.npz", **(flown | still | own | inspected))
    runs = [scene.read(str(path)) for path in (flown_files[0], tmp_path / "hull.npz")]
    content = json.loads(json.dumps(scene.content(runs), default=scene.rounded))
    (panel,) = [each for each in content["sections"]["Flight"] if each["runs"][0]["title"] == "Clearance"]
    sphere, hull = (each["lines"][0]["values"] for each in panel["runs"])
    np.testing.assert_allclose(sphere, np.linalg.norm(flown["position"], axis=1) - 15.0, rtol=1e-3)
    np.testing.assert_allclose(hull, still["clearance"], rtol=1e-3)
    assert content["runs"][0]["hull"] is None and len(content["runs"][1]["hull"]) == 12


def test_panels_hold_every_constraint_and_both_controls_within_their_range(
    flown: dict[str, np.ndarray], shown: dict[str, Any]
) -> None:
    panels = [panel for section in shown["sections"].values() for panel in section]
    lines = [line for panel in panels for line in panel["runs"][0]["lines"]]
    for panel in panels:
        values = np.array([line["values"] for line in panel["runs"][0]["lines"]])
        assert panel["range"][0] < values.min() <= values.max() < panel["range"][1]
    degrees = {"attitude_exclusion": math.degrees(1.0)}
    degrees |= {f"angular_velocity_{axis}": math.degrees(1.0) ** 2 for axis in "xyz"}
    expected = [degrees.get(name, 1.0) * flown[f"h_{name}"] for name in CONSTRAINTS]
    expected += [flown["energy"], flown["temperature"], flown["inspected_score"]]
    expected += [np.linalg.norm(flown[name], axis=1) for name in ("position", "velocity")]
    spent = np.abs(flown["control_applied"][:-1, :3]).sum(1).cumsum() * 10.0 / 12.0
    expected.append(np.array([0.0, *spent]))
    for kind in ("desired", "applied"):
        expected += list((flown[f"control_{kind}"] * [1.0, 1.0, 1.0, 1e3, 1e3, 1e3]).T)
    assert len(lines) == len(expected)
    for values in expected:
        assert any(np.allclose(line["values"], values, rtol=1e-3) for line in lines)


def test_a_long_run_is_thinned_but_no_violation_or_intervention_is_lost(
    flown_files: tuple[Path, Path],
    flown: dict[str, np.ndarray],
    shown: dict[str, Any],
) -> None:
    run = scene.read(str(flown_files[0]), 8)
    thin = as_written(run)
    assert "one row in 4" in page.document([run])
    assert thin["runs"][0]["time"] == flown["time"][::4].tolist()
    assert thin["runs"][0]["interventions"] == shown["runs"][0]["interventions"]
    assert thin["runs"][0]["inspected"] == shown["runs"][0]["inspected"]
    separation = thin["sections"]["Constraints, safe where h ≥ 0"][0]["runs"][0]["lines"][0]["values"]
    blocks = np.array_split(flown["h_collision"], range(4, 30, 4))
    np.testing.assert_allclose(separation, [block.min() for block in blocks], rtol=1e-3)


def test_single_precision_shows_the_same(
    flown: dict[str, np.ndarray], shown: dict[str, Any], tmp_path: Path
) -> None:
    single = {name: a.astype(np.float32) if a.dtype == np.float64 else a for name, a in flown.items()}
    np.savez(tmp_path / "single.npz", **single)
    (run,), (expected,) = as_written(scene.read(str(tmp_path / "single.npz")))["runs"], shown["runs"]
    for name in ("time", "position", "quaternion"):
        np.testing.assert_allclose(run[name], expected[name], rtol=1e-4, atol=1e-4)
