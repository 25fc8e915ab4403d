"""Figures inside a page: SVG, or PNG where that would be large, as data URIs."""

from __future__ import annotations

import base64
from typing import NamedTuple

from matplotlib.figure import Figure

from pipelines.reporting.drawing import png_bytes, svg_text

MAX_SVG_BYTES = 500_000
"""A figure that needs more as lines goes on the page as points."""


class Image(NamedTuple):
    """A picture as templates take it.

    Parameters
    ----------
    source : data URI
    alt : text in its place where it cannot be seen
    caption : below it, or empty
    """

    source: str
    alt: str
    caption: str = ""


def svg_or_png(figure: Figure, alt: str, caption: str = "", max_svg_bytes: int = MAX_SVG_BYTES) -> Image:
    """Return a figure as SVG, or as PNG where that is larger than ``max_svg_bytes``."""
    svg = svg_text(figure)
    if len(svg.encode()) > max_svg_bytes:
        return png_image(png_bytes(figure), alt, caption)
    return svg_image(svg, alt, caption)


def svg_image(svg: str, alt: str, caption: str = "") -> Image:
    """Return a picture that is drawn as SVG already."""
    return Image(_data_uri(svg.encode(), "svg+xml"), alt, caption)


def png_image(content: bytes, alt: str, caption: str = "") -> Image:
    """Return a picture that is drawn as PNG already."""
    return Image(_data_uri(content, "png"), alt, caption)


def png(figure: Figure, alt: str, caption: str = "") -> Image:
    """Return a figure as PNG."""
    return png_image(png_bytes(figure), alt, caption)


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
