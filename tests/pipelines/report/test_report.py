"""One tree, three writers: the same numbers in each, all escaped, nothing fetched, figures as described."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.report.drawing import figure_png, figure_svg
from pipelines.report.figure import Band, Bars, Figure, Line, Panel, Points, Strip
from pipelines.report.numbers import format_value
from pipelines.report.pages import figure_data, html_page, markdown_text
from pipelines.report.results import Result, as_json, described
from pipelines.report.terminal import terminal_text
from pipelines.report.tree import Column, Pairs, Report, Section, Table, Text, figures_of
from terrain.errors import ConfigError

EVIL = '<script>alert(1)</script> & "quoted" | \x1b[31mred'

YAW = Figure(
    "Yaw rate of a <run>",
    [
        Panel(
            [
                Strip([(0.0, 1.0, "grass"), (1.0, 2.0, "ice"), (2.0, 3.0, "grass")]),
                Band("95 %", [0, 1, 2, 3], [0, 0, math.nan, 1], [1, 1, 2, 2]),
                Line("measured", np.arange(4.0), [0.1, math.nan, 0.3, 0.123456789]),
                Line("simulated", [0, 1, 2, 3], [0, 0.5, 0.3, 0.1], dashed=True),
                Points("poses", [0, 2], [0.5, 1.0], [0.4, 0.8], [0.6, 1.2]),
            ],
            "yaw rate [rad/s]",
        ),
        Panel([Line("path", [0, 1, 0], [0, 1, 2])], equal=True, x_label="x [m]"),
    ],
    "Measured beside simulated.",
    x_label="time [s]",
)
RECALL = Figure("Recall", [Panel([Bars("svm", ["a$b", EVIL], [0.9, math.nan], [0.8, 0.1], [1.0, 0.2])])])
REPORT = Report(
    "Runs of <vulpi>",
    "95.8 % of windows are right.",
    YAW,
    parts=[
        Pairs([("accuracy over <b>runs</b>", 0.9584, ".1%")], "Accuracy"),
        Section(
            "By terrain",
            [
                Table(
                    (
                        "terrain",
                        *(Column(name, ".1%") for name in ("recall", "interval")),
                        Column("speed", ".2f", "m/s"),
                    ),
                    [(EVIL, 0.5, (0.25, 0.75), -1.234), ("ice", None, (math.nan, 1.0), math.nan)],
                    note="note of a table",
                )
            ],
        ),
        Text("look <here>", "warning"),
    ],
    details=[Section("Provenance", [Pairs([("seed", 3), ("length", 2.0, ".1f", "s")]), RECALL])],
    next_step="terrain train --data vulpi",
    lead="18 runs",
)
NUMBERS = ("95.8\xa0%", "50.0\xa0%", "25.0 to 75.0\xa0%", "−1.23", "2.0\xa0s")


def test_every_writer_shows_the_same_numbers():
    texts = terminal_text(REPORT, details=True, width=200), html_page(REPORT), markdown_text(REPORT)
    for number in NUMBERS:
        assert [number in text for text in texts] == [True] * 3, number
    assert [text.count("–") >= 3 for text in texts] == [True] * 3  # what is not known is marked


def test_a_screen_leads_with_the_answer_and_keeps_details_back():
    lines = terminal_text(REPORT).splitlines()
    assert lines[0] == "95.8 % of windows are right."
    assert lines[-2:] == ["--details adds: Provenance", "next: terrain train --data vulpi"]
    assert "seed" not in "\n".join(lines)
    assert "seed" in terminal_text(REPORT, details=True)


def test_a_page_escapes_all_and_fetches_nothing():
    page = html_page(REPORT)
    assert "<h1>Runs of &lt;vulpi&gt;</h1>" in page
    assert "alert(1)</script>" not in page
    assert not re.findall(r"(?:src|href)=[\"']?https?:", page)
    assert page.count("<details>") == len(REPORT.details)
    data = json.loads(re.search(r'id="figures">(.*?)</script>', page, re.DOTALL)[1])
    assert data == figure_data([YAW, RECALL])
    assert "<script" not in html_page(Report("a", "b"))


def test_markdown_escapes_all():
    text = markdown_text(REPORT)
    assert "<script>" not in text
    assert "\x1b" not in text
    (row,) = (line for line in text.splitlines() if "alert" in line and line.startswith("|"))
    assert len(re.findall(r"(?<!\\)\|", row)) == 5
    assert text.endswith("Next: `terrain train --data vulpi`\n")


def test_figures_are_in_the_order_in_which_they_are_read():
    assert figures_of(REPORT) == [YAW, RECALL]


def test_what_a_figure_draws_is_finite_and_short():
    marks = figure_data([YAW])[0]["panels"][0]["marks"]
    assert [mark["kind"] for mark in marks] == ["strip", "band", "line", "line", "points"]
    assert marks[2]["y"] == [0.1, None, 0.3, 0.123457]
    assert marks[1]["low"] == [0.0, 0.0, None, 1.0]


def test_a_figure_gives_the_same_bytes_and_a_fragment_has_pictures_and_runs_nothing():
    fragment = REPORT._repr_html_()
    assert "<script" not in fragment
    sources = re.findall(r"data:image/svg\+xml;base64,([\w+/=]+)", fragment)
    assert [base64.b64decode(source).decode() for source in sources] == [figure_svg(YAW), figure_svg(RECALL)]
    assert figure_png(RECALL) == figure_png(RECALL)
    assert figure_png(RECALL).startswith(b"\x89PNG")


def test_a_legend_names_what_has_a_name_and_ends_with_no_colon(tmp_path, browser):
    marks = [
        Line("", [1, 2, 3], [0.1, 0.2, 0.3]),
        Points("held out", [1, 2], [1.0, 1.1], [0.9, 1.0], [1.1, 1.2]),
    ]
    panel = Panel([Strip([(0.0, 1.0, "no correction")]), *marks], "yaw rate (gyro) [rad/s]")
    file = Report("Title", "Answer.", parts=[Figure("Curve", [panel], x_label="runs")]).save(
        tmp_path / "a.html"
    )
    page = browser.new_page()
    page.goto(file.as_uri())
    rows = [row.inner_text().strip() for row in page.query_selector_all(".u-series") if row.is_visible()]
    assert sorted(rows) == ["held out", "no correction"]
    colon = "(row) => getComputedStyle(row, '::after').content"
    assert {row.evaluate(colon) for row in page.query_selector_all(".u-series th")} == {"none"}
    page.hover(".u-over")
    assert page.query_selector(".u-series").is_visible()
    page.close()


@pytest.mark.parametrize("marks", [YAW.panels[0].marks, RECALL.panels[0].marks])
def test_every_mark_is_drawn(marks):
    """Without its last mark a panel looks different."""
    drawings = [figure_svg(Figure("", [Panel(of, y_label="y")])) for of in (marks, marks[:-1])]
    assert drawings[0] != drawings[1]


def test_a_report_is_written_by_its_ending(tmp_path):
    for ending, begin in ((".html", "<!DOCTYPE html>"), (".md", "# Runs of")):
        assert REPORT.save(tmp_path / f"new{ending}").read_text().lstrip().startswith(begin)
    for name in ("a.pdf", "a", ""):
        with pytest.raises(ConfigError):
            REPORT.save(tmp_path / name)


@given(st.floats(-1e300, 1e300))
def test_three_digits_are_the_number(value):
    text = format_value(value).replace("−", "-")
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    mantissa, _, power = text.partition("·10")
    read = float(mantissa) * (10.0 ** int(power.translate(digits)) if power else 1.0)
    assert read == pytest.approx(value, rel=5.1e-3)


class Point(NamedTuple):
    x: float
    y: float | None


class Found(Result):
    name: str = described("of the robot")
    kind: Literal["a", "b"] = described("which")
    ratio: float = described("of slip", "1", form=".1%")
    points: tuple[Point, ...] = described("each", default=())
    rise: float = described("of the speed; null where not driven", "m/s^2", default=0.5)


def report(result):
    return Report("Found", f"{format_value(result.ratio, '.1%')} of {result.name}.")


def test_all_that_derives_from_a_result():
    found = Found("husky", "a", 0.25, (Point(0.0, None),))
    assert repr(found) == "<Found: 25.0\xa0% of husky.>"
    assert str(found) == "25.0\xa0% of husky."
    assert "25.0" in found._repr_html_()
    assert found.as_json()["points"] == [{"x": 0.0, "y": None}]
    assert found.to_pandas().to_dict("records") == [
        {"name": "husky", "kind": "a", "ratio": 0.25, "rise": 0.5}
    ]
    assert found.pairs("ratio", "rise") == [("of slip", 0.25, ".1%", ""), ("of the speed", 0.5, "", "m/s²")]
    schema = Found.schema()["properties"]
    assert schema["ratio"] == {"description": "of slip", "unit": "1"}
    assert list(schema) == ["doubtful", *found.as_json()]
    assert list(schema) == list(found.with_doubts(["a clock jumps"]).as_json())


class Colour(Enum):
    red = "red"


@dataclass(frozen=True, slots=True)
class Drawn:
    colour: Colour
    points: tuple[Point, ...]
    file: Path


class Shown(NamedTuple):
    value: float

    def as_json(self):
        return {"shown": self.value}


def test_every_kind_of_value_becomes_what_json_holds():
    drawn = Drawn(Colour.red, (Point(1.0, None), Point(math.nan, math.inf)), Path("a/b"))
    found = as_json(
        {"drawn": drawn, 3: np.array([1, 2]), "n": np.float64(0.5), "own": Shown(2.0), "on": True}
    )
    assert found == {
        "drawn": {"colour": "red", "points": [{"x": 1.0, "y": None}, {"x": None, "y": None}], "file": "a/b"},
        "3": [1, 2],
        "n": 0.5,
        "own": {"shown": 2.0},
        "on": True,
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    with pytest.raises(TypeError):
        as_json(object())
