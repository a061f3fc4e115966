"""What a page needs that draws a flight with `scene.js`: three.js, and what the spacecraft are like."""

from pathlib import Path
from typing import Any

from inspection.model.parameters import InspectionParameters

WEB = Path(__file__).parent.parent / "web"
LICENCE = WEB / "three.LICENSE"


def three() -> str:
    """The source of three.js, with its licence before it."""
    library = (WEB / "three.min.js").read_text(encoding="utf-8")
    return f"/*\n{LICENCE.read_text(encoding='utf-8')}*/\n{library}"


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
