"""What the program keeps, goes on with, chooses and draws."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from study.files import ROOT
from study.optimum import __main__ as program
from study.optimum.__main__ import TIMES, append, best_starts, bounds, cheapest, lines
from study.optimum.figure import draw, solved


def row(allowed: float, times: list[float | None], fuel: list[float | None]) -> dict[str, Any]:
    """Flights of a time."""
    half = [each and each / 2 for each in fuel]
    return {"allowed_s": allowed, "time_s": times, "delta_v_m_s": fuel, "length_m_s": half}


def test_a_shorter_flight_counts_for_a_longer_time_and_not_the_other_way() -> None:
    found = [
        row(3600.0, [3500.0, 3550.0, None], [0.5, 0.3, None]),
        row(3000.0, [2900.0, None, None], [0.4, None, None]),
    ]
    best = cheapest(found)
    assert best[0] == row(3600.0, [2900.0, 3550.0, None], [0.4, 0.3, None])
    assert best[1] == found[1]
    assert solved({"times": best}) == [0]


def test_a_line_that_was_not_finished_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    assert lines(path) == []
    append(path, {"a": 1})
    with path.open("a") as file:
        file.write('{"a": 2')
    assert lines(path) == [{"a": 1}]
    append(path, {"a": 3})
    assert lines(path) == [{"a": 1}, {"a": 3}]


def test_bounds_go_on_where_they_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[float, float]] = []

    def climbed(task: object, time: float, known: float, seconds: float, most: float) -> float:
        asked.append((time, known))
        return min(most, known + 0.1)

    monkeypatch.setattr(program, "climbed", climbed)
    x = torch.zeros(16, 2, dtype=torch.float64)
    x[0] = 60.0
    priority = torch.tensor([[1.0] * 2, [0.0] * 2, [0.0] * 2], dtype=torch.float64)
    best = [row(time, [time, None], [1.0, None]) for time in TIMES]
    whole = list(bounds(tmp_path, x, priority, best, 2, 1.0))
    assert [each["bound_m_s"] for each in whole[:4]] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert asked[3] == (TIMES[3], pytest.approx(0.3)) and asked[4] == (TIMES[0], 0.0)
    kept = (tmp_path / "bounds.jsonl").read_text().splitlines()
    (tmp_path / "bounds.jsonl").write_text("\n".join(kept[:3]) + "\n")
    asked.clear()
    assert list(bounds(tmp_path, x, priority, best, 2, 1.0)) == whole
    assert len(asked) == 5 and asked[0] == (TIMES[3], pytest.approx(0.3))


def test_each_case_keeps_its_own_best_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "cost", lambda cases, thrust, c: thrust[0, 0])
    monkeypatch.setattr(program, "AT_ONCE", 4)
    x, priority = torch.zeros(16, 2, dtype=torch.float64), torch.ones(3, 2, dtype=torch.float64)
    # settings 0 to 2, cases 0 and 1 of each
    thrust = torch.tensor([5.0, 1.0, 3.0, 4.0, 4.0, 2.0]).expand(1, 3, 6)
    assert best_starts(thrust, x, priority, 2)[0, 0].tolist() == [3.0, 1.0, 4.0, 2.0]


def test_the_figure_is_drawn_from_the_file(tmp_path: Path) -> None:
    found = json.loads((ROOT / "runs/reference/optimum/optimum.json").read_text(encoding="utf-8"))
    draw(found, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").read_bytes().startswith(b"\x89PNG")
    assert [flights["allowed_s"] for flights in found["times"]] == list(TIMES)
    fuel = [flights["delta_v_m_s"] for flights in found["times"]]
    for longer, shorter in pairwise(fuel):
        assert all(b is None or (a is not None and a <= b) for a, b in zip(longer, shorter, strict=True))
