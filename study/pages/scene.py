"""What a page needs that draws a flight with `scene.js`: three.js, and what the spacecraft are like.

three.js comes from the package trimesh, whose own viewer has it.
"""

import io
import re
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from inspection.model.parameters import InspectionParameters
from settings import InputError

VIEWER = Path("resources/templates/viewer.zip")  # in the package trimesh
LIBRARY = re.compile(r"/\*\*\n \* @license\n.*?\*/\n!function[^\n]*\n", re.DOTALL)  # within the viewer's page
LICENCE = Path(__file__).with_name("three.txt")


def three() -> str:
    """The source of three.js, with its licence before it.

    Raises:
        InputError: trimesh is not installed, or is of a version that does not have it there.
    """
    found = find_spec("trimesh")
    if found is None or not found.submodule_search_locations:
        raise InputError("the page needs the package trimesh (which has three.js): pip install '.[report]'")
    viewer = Path(found.submodule_search_locations[0]) / VIEWER
    library = None
    if viewer.is_file():
        with zipfile.ZipFile(io.BytesIO(viewer.read_bytes())) as pages:
            library = LIBRARY.search(pages.read(pages.namelist()[0]).decode())
    if library is None:
        raise InputError(
            "this version of trimesh has no three.js: pip install '.[report]' brings one that has"
        )
    return f"/*\n{LICENCE.read_text(encoding='utf-8')}*/\n{library[0]}".replace("</script", "<\\/script")


def task(c: InspectionParameters) -> dict[str, Any]:
    """What `scene.js` is told of the spacecraft and the limits around them: m, rad and N."""
    return {
        "chief_radius": c.chief_radius,
        "deputy_radius": c.deputy_radius,
        "collision_radius": c.collision_radius,
        "max_distance": c.max_distance,
        "field_of_view": c.field_of_view,
        "panel_axis": c.solar_panel_axis,
        "max_thrust": c.max_thrust,
    }
