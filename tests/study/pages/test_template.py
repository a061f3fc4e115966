"""A page from its template."""

import pytest
from jinja2 import UndefinedError

from study.pages.template import render


def test_a_template_without_one_of_its_values_fails() -> None:
    with pytest.raises(UndefinedError, match="'title' is undefined"):
        render("pages/frame.html.j2")
