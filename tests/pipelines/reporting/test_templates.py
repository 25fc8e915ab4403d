"""Pages escape what they are given, name a missing value, and need nothing from outside."""

import jinja2
import pytest
from matplotlib.figure import Figure

from pipelines.reporting.pictures import svg_or_png
from pipelines.reporting.templates import _environment, render

EVIL = '<script>alert(1)</script> & "quoted"'


def test_what_is_given_is_escaped():
    text = _environment().from_string("{{ name }}").render(name=EVIL)
    assert "<script>" not in text
    assert "&lt;script&gt;" in text


def test_a_missing_value_is_an_error():
    with pytest.raises(jinja2.UndefinedError):
        render("reproduce/again.html.j2")


def test_every_template_compiles_and_extends_one_frame():
    environment = _environment()
    names = [name for name in environment.list_templates() if name.endswith(".j2")]
    assert len(names) > 30
    for name in names:
        environment.get_template(name)
        source = environment.loader.get_source(environment, name)[0]
        assert "| safe" not in source or name == "page.html.j2", name
        assert "http://" not in source, name
    pages = [name for name in names if name.endswith("/page.html.j2")]
    assert len(pages) >= 5
    assert all(
        'extends "page.html.j2"' in environment.loader.get_source(environment, name)[0] for name in pages
    )


def test_a_figure_is_svg_and_png_where_that_would_be_large():
    figure = Figure((2, 2))
    figure.add_subplot().plot([1, 2, 3])
    assert svg_or_png(figure, "a").source.startswith("data:image/svg+xml;base64,")
    assert svg_or_png(figure, "a", max_svg_bytes=10).source.startswith("data:image/png;base64,")
    assert svg_or_png(figure, "a", "b") == svg_or_png(figure, "a", "b")
