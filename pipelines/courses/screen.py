"""What is printed of courses and of stretches that break away."""

from __future__ import annotations

from collections.abc import Iterator

from pipelines.courses.results import CourseFigures, OverTime
from pipelines.reporting.numbers import percent

MAX_ROWS = 10


def over_time_lines(found: OverTime) -> Iterator[str]:
    """Return what held-out runs show over time, in sentences."""
    for title, figures in (
        ("spliced courses", found.spliced),
        ("recorded courses", found.recorded),
    ):
        if figures is not None:
            yield _course_line(title, figures)
    for each in found.breakaways[:MAX_ROWS]:
        yield (
            f"breaks away: {each.run_id} from {each.start_s:.1f} to {each.end_s:.1f} s looks like "
            f"{each.looks_like} ({each.probability:.2f}), not {each.label} ({each.label_probability:.2f}; "
            f"rest of the run {each.rest_probability:.2f})"
        )
    if len(found.breakaways) > MAX_ROWS:
        yield f"... and {len(found.breakaways) - MAX_ROWS} stretches more break away; --json has all"


def _course_line(title: str, figures: CourseFigures) -> str:
    low, high = figures.filtered_accuracy_ci
    delay = figures.filter_delay_s
    return (
        f"{title}, filter over time: {percent(figures.filtered_accuracy)} ({low:.1%} to {high:.1%}), "
        f"single windows {percent(figures.single_accuracy)}; with the windows across a change "
        f"{percent(figures.filtered_accuracy_at_end)} and {percent(figures.single_accuracy_at_end)}; delay "
        f"{delay.p50:.1f} s, p90 {delay.p90:.1f} s, {delay.n_missed} of {delay.n_changes} changes missed; "
        f"false changes a minute {figures.flips_per_minute:.1f} (single windows "
        f"{figures.single_flips_per_minute:.1f})"
    )
