"""What judging a filter over time on courses finds."""

from __future__ import annotations

from typing import NamedTuple

Interval = tuple[float, float]


class DelayFigures(NamedTuple):
    """Time from a change of ground to where the new ground is reported.

    Parameters
    ----------
    p50, p90, p50_ci, p90_ci : quantiles over the changes that were found before the next one, in s
    n_changes, n_missed : changes, and those among them that were never found
    p90_of_all : quantile with missed changes as infinite; None where it is
    """

    p50: float
    p50_ci: Interval
    p90: float
    p90_ci: Interval
    n_changes: int
    n_missed: int
    p90_of_all: float | None


class CourseFigures(NamedTuple):
    """How well single windows and the filter follow courses; every ``_ci`` is 95 % by bootstrap over runs.

    Parameters
    ----------
    filtered_accuracy : fraction of the time at which the right terrain was reported, where the window that
        ends then lies wholly on one ground; "unknown" counts as wrong
    single_accuracy : the same of the last window's own class
    gain : filtered minus single, paired
    filtered_accuracy_at_end, single_accuracy_at_end : the same over all time, where windows across a change
        are judged by the ground at their end
    filter_delay_s : from a change to its report
    flips_per_minute, single_flips_per_minute : changes of the reported terrain, less the true ones
    unknown_ratio : fraction of the time at which "unknown" was reported
    n_courses, n_grounds, duration_s : what was judged
    """

    filtered_accuracy: float
    filtered_accuracy_ci: Interval
    single_accuracy: float
    single_accuracy_ci: Interval
    gain: float
    gain_ci: Interval
    filtered_accuracy_at_end: float
    filtered_accuracy_at_end_ci: Interval
    single_accuracy_at_end: float
    single_accuracy_at_end_ci: Interval
    filter_delay_s: DelayFigures
    flips_per_minute: float
    flips_per_minute_ci: Interval
    single_flips_per_minute: float
    single_flips_per_minute_ci: Interval
    unknown_ratio: float
    n_courses: int
    n_grounds: int
    duration_s: float


class Breakaway(NamedTuple):
    """A stretch of a run that looks like another terrain than its label, unlike the rest of the run."""

    run_id: str
    start_s: float
    end_s: float
    label: str
    looks_like: str
    probability: float
    label_probability: float
    rest_probability: float


class OverTime(NamedTuple):
    """What held-out runs show over time.

    ``spliced`` is None where no fold holds two grounds, ``recorded`` where no run does.
    """

    spliced: CourseFigures | None
    recorded: CourseFigures | None
    breakaways: tuple[Breakaway, ...]
