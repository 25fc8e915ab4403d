"""Markdown from templates; all that a template is given is escaped, as names may hold any sign."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipelines.reporting.numbers import NOT_KNOWN, percent
from terrain.files.names import printable

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~&!])")
_ADDRESS = re.compile(r"(https?|ftp)(?=://)", re.IGNORECASE)


def escape_markdown(text: str) -> str:
    r"""Return a text that Markdown shows as it is, on one line.

    Examples
    --------
    >>> print(escape_markdown("DIRT_ROAD | <b>\n# one"))
    DIRT\_ROAD \| \<b\>\\n\# one
    """
    escaped = _SPECIAL.sub(r"\\\1", printable(text))
    return _ADDRESS.sub(r"\1\\", escaped)


@cache
def _environment() -> Environment:
    def finalize(value: Any) -> Any:
        return value if isinstance(value, Markup) else escape_markdown(str(value))

    environment = Environment(  # finalize escapes for Markdown, not for HTML
        loader=PackageLoader("pipelines.reporting", "templates"),
        undefined=StrictUndefined,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["percent"] = lambda ratio: NOT_KNOWN if ratio is None else percent(ratio)
    return environment


def render_markdown(template: str, **context: Any) -> str:
    """Return the Markdown that a template gives; all that is given is escaped.

    Parameters
    ----------
    template : path below ``templates/``, as ``classify/model_card.md.j2``
    context : what the template names; a name that is missing is an error
    """
    return _environment().get_template(template).render(**context)
