"""The replay of one or two runs: a self-contained page with 3-D scenes and plots on a common clock.

What it says stands in `page.html.j2`, what it does in `replay.js`.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from study.errors import refusing
from study.files import write_text
from study.flight.figures import BLUE, GREEN, GREY, ORANGE, SAFE, UNSAFE
from study.pages.template import render
from study.replay.scene import MAX_ROWS, Replayed, content, read, rounded

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


def write(paths: Sequence[str], out: Path, rows: int = MAX_ROWS, report: str | None = None) -> int:
    """Writes the page of one run or of several side by side; returns its size in bytes.

    Args:
        rows: of each run that are shown at most; report: the address of a study's report, to link to.

    Raises:
        InputError: a file is not one of `simulate` or lacks something, or the page cannot be written.
    """
    text = document([read(path, rows) for path in paths], report)
    with refusing(f"--out {out}: cannot write it", OSError):
        write_text(out, text)
    return len(text.encode())


def document(runs: Sequence[Replayed], report: str | None = None) -> str:
    """The whole page."""
    data = json.dumps(content(runs) | {"colours": COLOURS}, separators=(",", ":"), default=rounded)
    return render(
        "replay/page.html.j2",
        names=[run.name for run in runs],
        runs=runs,
        c=runs[0].c,
        report=report,
        colours=COLOURS,
        plotly=Markup(get_plotlyjs()),
        data=Markup(data.replace("<", "\\u003c")),  # a file's name may hold any tag
    )
