"""The replay of one or two runs: a self-contained page with 3-D scenes and plots on a common clock."""

import json
from collections.abc import Sequence
from pathlib import Path

from plotly.offline import get_plotlyjs

from study.errors import refusing
from study.files import write_text
from study.flight.figures import BLUE, GREEN, GREY, ORANGE, SAFE, UNSAFE
from study.replay import scene as replay_data
from study.replay.scene import Replayed
from study.report import page

HERE = Path(__file__).parent
# of what `replay.js` draws; those that `figures` lacks are of Okabe and Ito's palette as well
COLOURS = {
    "inspected": GREEN,
    "lit": ORANGE,
    "dark": GREY,
    "chief": "#E4E4E4",
    "deputy": "#1B1B1B",
    "flown": "#1B1B1B",
    "path": "#BBBBBB",
    "x": BLUE,
    "cone": BLUE,
    "y": "#CC79A7",
    "z": "#56B4E9",
    "sun": ORANGE,
    "earth": GREY,
    "intervention": "#D55E00",
    "safe": SAFE,
    "unsafe": UNSAFE,
    "text": "#1B1B1B",
}
LEGEND = {
    "inspected": "point inspected",
    "lit": "lit, not inspected",
    "dark": "dark, not inspected",
    "flown": "deputy and the path it flew",
    "path": "path ahead",
    "x": "camera (body x) and its field of view",
    "y": "body y",
    "z": "body z",
    "intervention": "at the foot of a plot: the filter corrects the control",
    "safe": "safe",
    "unsafe": "not safe",
}
SPEEDS = (1, 10, 30, 60, 120, 300)  # times as fast as it was flown
USUAL_SPEED = 30


def write(paths: Sequence[str], out: Path) -> int:
    """Writes the page of one run or of several side by side; returns its size in bytes.

    Raises:
        InputError: a file is not one of `simulate` or lacks something, or the page cannot be written.
    """
    text = document([replay_data.read(path) for path in paths])
    with refusing(f"--out {out}: cannot write it", OSError):
        write_text(out, text)
    return len(text.encode())


def document(runs: Sequence[Replayed]) -> str:
    """The whole page."""
    content = replay_data.content(runs) | {"colours": COLOURS}
    data = json.dumps(content, separators=(",", ":"), default=replay_data.rounded)
    data = data.replace("<", "\\u003c")  # a file's name may hold any tag
    body = "\n".join(
        (
            controls(),
            '<div id="scenes"></div>',
            legend(),
            '<div id="sections"></div>',
            *notes(runs),
            f"<script>{get_plotlyjs()}</script>",
            f'<script type="application/json" id="data">{data}</script>',
            f"<script>{(HERE / 'replay.js').read_text(encoding='utf-8')}</script>",
        )
    )
    title = f"Replay of {' and '.join(Path(run.path).name for run in runs)}"
    return page.page(title, body, page.STYLE + (HERE / "replay.css").read_text(encoding="utf-8"))


def controls() -> str:
    """The bar with the clock."""
    speeds = "".join(
        f"<option value={speed}{' selected' if speed == USUAL_SPEED else ''}>{speed}x</option>"
        for speed in SPEEDS
    )
    return (
        '<div id="controls"><button id="play" type="button">▶ Play</button><output id="clock"></output>'
        '<input id="scrub" type="range" min="0" step="any" value="0" aria-label="time in s">'
        f'<label>speed <select id="speed">{speeds}</select></label></div>'
    )


def legend() -> str:
    """What the colours mean."""
    items = (f'<li><i style="background:{COLOURS[name]}"></i>{text}</li>' for name, text in LEGEND.items())
    return f'<ul id="legend">{"".join(items)}</ul>'


def notes(runs: Sequence[Replayed]) -> list[str]:
    """What the pictures do not say."""
    c = runs[0].c
    lines = [
        "Hill's frame, the chief at its centre: x points away from the Earth, y along the orbit, z across it. "
        f"On the deputy the camera faces body +x, the solar panels {c.solar_panel_axis}, the surface whose "
        f"temperature is limited {c.thermal_axis}.",
        "Dragging turns a scene, the wheel zooms towards the chief. Space plays and pauses, the arrow keys step by "
        f"{c.action_period:g} s, a click into a plot goes there.",
    ]
    for run in runs:
        if run.stride > 1:
            lines.append(
                f"{run.path}: one row in {run.stride} is shown, of each constraint the smallest value between two."
            )
    return [page.paragraph(line) for line in lines]
