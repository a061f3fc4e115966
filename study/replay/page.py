"""The replay of one or two runs: a self-contained page with scenes and plots on a common clock.

What it says stands in `page.html.j2`, what it does in `replay.js`; `study/pages/scene.js` draws, as in `play`.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from study.errors import refusing
from study.files import write_text
from study.pages.scene import three
from study.pages.template import render
from study.replay.scene import HULL, MAX_ROWS, Replayed, content, read, rounded


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
    data = json.dumps(content(runs), separators=(",", ":"), default=rounded)
    return render(
        "replay/page.html.j2",
        names=[run.name for run in runs],
        runs=runs,
        c=runs[0].c,
        has_hull=any(HULL in run.episode for run in runs),
        report=report,
        three=Markup(three()),
        data=Markup(data.replace("<", "\\u003c")),  # a file's name may hold any tag
    )
