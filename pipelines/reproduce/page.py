"""The page of a reproduced paper: comparisons first, then figures, assumptions, and how to make it again."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from pipelines.reporting.pictures import svg_or_png
from pipelines.reporting.templates import render
from pipelines.reporting.versions import versions
from pipelines.reproduce.results import MEANINGS, Picture, Reproduction


def html_page(result: Reproduction, pictures: Sequence[Picture]) -> str:
    """Return the page.

    Parameters
    ----------
    result : of the paper
    pictures : figures in their order
    """
    groups = groupby(result.rows, key=lambda each: each.experiment)
    return render(
        "reproduce/page.html.j2",
        result=result,
        groups=[(title, [each.row for each in rows]) for title, rows in groups],
        meanings=MEANINGS,
        images=[svg_or_png(picture.figure, picture.caption, picture.caption) for picture in pictures],
        versions=", ".join(f"{name} {number}" for name, number in versions().items()),
    )
