"""The page of ``terrain track``: the verdict, figures, statuses and warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping

from matplotlib.figure import Figure

from pipelines.reporting.numbers import NOT_KNOWN, format_counts, format_number
from pipelines.reporting.pictures import svg_or_png
from pipelines.reporting.templates import render
from pipelines.track.results import TrackResult

CAPTIONS = {
    "map": "The path, and where the rear axle was.",
    "lateral": "Lateral error of the true position; positive to the left.",
    "sideslip": "Slip angles of the axles. At rest there is no true one.",
    "speed": "Speed of the rear axle and angle of the front wheel.",
    "stiffness": "Estimated cornering stiffness of the axles, and -F/b of the simulated tyres.",
}


def verdict(result: TrackResult) -> str:
    """Return whether the path was followed, in a sentence."""
    if not result.reached_end:
        return "The end of the path was not reached."
    beside = "within" if result.within_limit else "beyond"
    return (
        f"The path was followed to its end; the lateral error is at most {result.lateral_max_m:.2f} m (at "
        f"{result.lateral_max_at_m:.0f} m), {beside} a tenth of the speed, {result.limit_m:.2f} m."
    )


def rows(result: TrackResult) -> tuple[tuple[str, str], ...]:
    """Return names and values of the figures as texts."""
    listed = [
        ("length of the path", f"{result.length_m:.1f} m"),
        ("duration", f"{result.duration_s:.1f} s"),
        ("slowest speed away from start and stops", _known(result.slowest_mps, 1.0, "m/s")),
        ("lateral error, largest", f"{result.lateral_max_m:.3f} m"),
        ("lateral error, root mean square", f"{result.lateral_rms_m:.3f} m"),
        ("true slip angle, largest", _known(result.slip_max_rad, 180.0 / math.pi, "deg")),
        ("slip angle, error of the estimate", _known(result.slip_error_rad, 180.0 / math.pi, "deg")),
        ("cornering stiffness, median error", _known(result.stiffness_error_ratio, 100.0, "%")),
    ]
    if not math.isnan(result.grip_ratio):
        grip = f"{format_number(result.grip_ratio)} ± {format_number(result.grip_std)}"
        listed.append(("grip at the end", grip))
    return tuple(listed)


def track_page(result: TrackResult, figures: Mapping[str, Figure]) -> str:
    """Return the page."""
    return render(
        "track/page.html.j2",
        result=result,
        verdict=verdict(result),
        rows=rows(result),
        statuses=[(name, format_counts(counts)) for name, counts in result.statuses.items()],
        images=[svg_or_png(figure, CAPTIONS[name], CAPTIONS[name]) for name, figure in figures.items()],
    )


def _known(value: float, factor: float, unit: str) -> str:
    return NOT_KNOWN if math.isnan(value) else f"{format_number(factor * value)} {unit}".strip()
