"""A page from its template below `study`; what all pages share stands in `frame.html.j2` and `frame.css`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

STUDY = Path(__file__).parent.parent  # the package, below which all templates are
# The Content-Security-Policy of every page: no script of it, whatever it asks for, gets a request out to any network.
CLOSED = (
    "default-src 'none'; script-src 'unsafe-inline'{}; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def render(template: str, filters: Mapping[str, Callable[..., str]] | None = None, **values: Any) -> str:
    """The page of a template below `study`, in which every value that it is given is escaped.

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
    environment.globals["closed"] = lambda *scripts: Markup(
        CLOSED.format("".join(f" {each}" for each in scripts))
    )
    environment.globals["source"] = lambda name: Markup((STUDY / name).read_text(encoding="utf-8"))
    return environment.get_template(template).render(values)
