"""The common episode of a report's arms, playing side by side."""

from study.replay import page
from study.report.inputs import Inputs

ROWS = 400  # of an episode: about one per action, so that the page hardly exceeds the library that plays it


def write(inputs: Inputs) -> None:
    """Writes `replay.html`, to which the report's page links, if there are episodes.

    Raises:
        InputError: it cannot be written.
    """
    if not inputs.arms:
        return
    episodes = [str(inputs.directory / f"episode_{arm}.npz") for arm in inputs.arms]
    page.write(episodes, inputs.directory / "replay.html", ROWS, report="../report.html")
