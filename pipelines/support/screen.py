"""What a screen shows of the support of held-out windows."""

from __future__ import annotations

from collections.abc import Iterator

from pipelines.reporting.numbers import format_known, percent
from pipelines.support.results import SupportReport
from terrain.classify.confidence import Interval
from terrain.classify.support_figures import PartFigures

SHOWN_DRIVES = 5


def support_lines(found: SupportReport) -> Iterator[str]:
    """Yield accuracy by support, and the drives to record next."""
    levels = "; ".join(
        f"{level} {_right(part)} in {percent(part.windows_ratio)} of the windows, {_errors(part)}"
        for level, part in found.accuracy.by_true_terrain.items()
        if part.windows_ratio > 0
    )
    yield f"by training runs of the true terrain near the motion of a window: {levels}"
    mark = found.accuracy.unsupported
    if mark.windows_ratio > 0:
        low, high = mark.windows_ratio_ci
        yield (
            f"unsupported predictions (no label needed): {percent(mark.windows_ratio)} of the windows "
            f"(95 % over runs: {low:.1%} to {high:.1%}), right in {_right(mark)}, "
            f"{_errors(mark)}{_interval(mark.errors_ratio_ci)}; "
            f"the others right in {_right(found.accuracy.supported)}"
        )
    for number, drive in enumerate(found.next_drives[:SHOWN_DRIVES], 1):
        yield (
            f"record next {number}: {drive.request} (so far "
            f"{drive.support_runs:.1f} runs near it, {drive.windows} windows, accuracy "
            f"{format_known(drive.accuracy, '{:.1%}')})"
        )


def _errors(part: PartFigures) -> str:
    return "no errors" if part.errors_ratio is None else f"{part.errors_ratio:.1%} of the errors"


def _right(part: PartFigures) -> str:
    return format_known(part.accuracy, "{:.1%}") + _interval(part.accuracy_ci)


def _interval(interval: Interval | None) -> str:
    return "" if interval is None else f" ({interval[0]:.1%} to {interval[1]:.1%})"
