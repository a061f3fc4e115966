"""A page from its template below `study`: what all pages share, and what those share that draw a flight."""

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
# The Content-Security-Policy of every page: no script of it, whatever it asks for, gets a request out to any network.
CLOSED = (
    "default-src 'none'; script-src 'unsafe-inline'{}; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def render(template: str, filters: Mapping[str, Callable[..., str]] | None = None, **values: Any) -> str:
    """Returns the page of a template below `study`, in which every value that it is given is escaped.

    Args:
        filters: functions that the template calls by these names.

    Raises:
        UndefinedError: the template uses a value that is not given.
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
    """Returns what `unpacked` of `flight.js` unpacks."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def embedded(data: Any, default: Callable[[Any], Any] | None = None) -> Markup:
    """Returns data as JSON within a page, whose names may hold any tag; `default` is as of `json.dumps`."""
    return Markup(json.dumps(data, separators=(",", ":"), default=default).replace("<", "\\u003c"))


def drawn(c: InspectionParameters) -> dict[str, Any]:
    """Returns what `scene.js` is told of the spacecraft and the limits around them: m, rad and N."""
    names = (
        "chief_radius",
        "deputy_radius",
        "collision_radius",
        "max_distance",
        "field_of_view",
        "max_thrust",
    )
    return {name: getattr(c, name) for name in names} | {"panel_axis": c.solar_panel_axis}
