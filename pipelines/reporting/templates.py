"""Pages from templates: Jinja2 with autoescape, one template a section, one self-contained HTML file a page.

A page's template extends ``page.html.j2`` and includes its sections; each command has a folder of its own
below ``templates/``.  Macros that several pages use are in ``macros.html.j2``.  Templates format what they
are given and decide nothing: a page's module computes a frozen view and hands it over as ``view``.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipelines.reporting.numbers import NOT_KNOWN, format_known, format_number, percent, sentence


@cache
def _environment() -> Environment:
    loader = PackageLoader("pipelines.reporting", "templates")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "number": format_number,
        "percent": percent,
        "sentence": sentence,
        "known": format_known,
    }
    style, _, _ = loader.get_source(environment, "report.css")
    environment.globals |= {"STYLE": Markup(style), "NOT_KNOWN": NOT_KNOWN}
    return environment


def render(template: str, **context: Any) -> str:
    """Return the text that a template gives; all that is given is escaped unless it is markup already.

    Parameters
    ----------
    template : path below ``templates/``, as ``explain/page.html.j2``
    context : what the template names; a name that is missing is an error
    """
    return _environment().get_template(template).render(**context)
