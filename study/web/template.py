"""Pages from templates below `study`: the parts that all pages share, and the data that all scenes share."""

import base64
import gzip
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from inspection.model.parameters import InspectionParameters

STUDY = Path(__file__).parent.parent  # the package, below which all templates are
# The Content-Security-Policy of every page: its scripts cannot send any request to a network.
CLOSED = (
    "default-src 'none'; script-src 'unsafe-inline'{}; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def render(template: str, filters: Mapping[str, Callable[..., str]] | None = None, **values: Any) -> str:
    """Returns the page of a template below `study`; all given values are escaped.

    Args:
        filters: functions that the template can call by these names.

    Raises:
        UndefinedError: the template uses a missing value.
    """
    environment = Environment(
        loader=FileSystemLoader(STUDY),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters or {}
    environment.globals |= {
        "closed": lambda more: Markup(CLOSED.format(more)),
        "source": lambda name: Markup((STUDY / name).read_text(encoding="utf-8")),
        "packed": lambda name: packed((STUDY / name).read_bytes()),
    }
    return environment.get_template(template).render(values)


def packed(content: bytes) -> str:
    """Returns content as compressed text, which `unpacked` of `flight.js` unpacks."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def embedded(data: Any, default: Callable[[Any], Any] | None = None) -> Markup:
    """Returns data as JSON that is safe inside a page, whatever tags its texts hold; `default` as in `json.dumps`."""
    return Markup(json.dumps(data, separators=(",", ":"), default=default).replace("<", "\\u003c"))


def drawn(c: InspectionParameters) -> dict[str, Any]:
    """Returns the data of `scene.js` about the spacecraft and the limits around them, in m, rad and N."""
    radii = ("chief_radius", "deputy_radius", "collision_radius")
    names = (*radii, "max_distance", "field_of_view", "max_thrust", "solar_panel_axis")
    return {name: getattr(c, name) for name in names}
