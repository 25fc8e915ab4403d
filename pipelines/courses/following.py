"""A fitted classifier on the windows of courses, and what is reported of them at each time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from features.windows import Layout, WindowRule, cut_windows, regular_starts, span_of
from pipelines.courses.stretches import (
    Course,
    ground_at,
    held_out_parts,
    recorded_courses,
    spliced_course,
)
from pipelines.learn.recipes import WindowPipeline, feature_matrix
from terrain.classify.terrain_filter import TerrainFilter, check_filter, filter_run, reported
from terrain.records import Array, RunLog, Windows

STRIDE_S = 0.25
"""A window comes so often: four times as often as terrain has to be known at 1 Hz, an eighth of a window."""


class Track(NamedTuple):
    """What was reported along a course, at the end of each window of a regular grid.

    Parameters
    ----------
    time_s : (n,) since the start of the log
    ground : (n,) which of the labels holds; -1 where none does
    whole : (n,) whether the window lies on that ground only
    filtered, single : (n,) column of the class that the filter and the last window give; -1 for unknown
    terrain, run : column of the class, and the run, of each label
    begin_s : (labels,) start of each
    spliced : whether the course was spliced
    """

    time_s: Array
    ground: Array
    whole: Array
    filtered: Array
    single: Array
    terrain: Array
    run: tuple[str, ...]
    begin_s: Array
    spliced: bool


class Following(NamedTuple):
    """Follows courses with a classifier once it is fitted; a process of its own may do so.

    Parameters
    ----------
    recipe : whose features are computed
    courses : to be followed
    rule, layout : of the classifier's windows
    classes : (k,) names in the order of the columns
    prior : (k,) share of each class among the training windows
    """

    recipe: WindowPipeline
    courses: tuple[Course, ...]
    rule: WindowRule
    layout: Layout
    classes: Array
    prior: tuple[float, ...]

    def follow(self, classifier: Any) -> list[Track]:
        """Return what is reported along each course."""
        return [self._follow(classifier, course) for course in self.courses]

    def _follow(self, classifier: Any, course: Course) -> Track:
        rule = replace(self.rule, stride_s=STRIDE_S)
        begin_s, end_s = span_of(course.log, self.layout)
        starts_s = regular_starts(begin_s, end_s, rule.length_s, STRIDE_S)
        time_s = starts_s + rule.length_s
        probability = np.full((len(starts_s), len(self.classes)), np.nan)
        windows = cut_windows([course.log], rule, layout=self.layout, skip_short=True).windows
        if len(windows):
            rows = np.rint((windows.start_s - begin_s) / STRIDE_S).astype(int)
            probability[rows] = 0.0
            columns = np.searchsorted(self.classes, classifier.classes_)
            features = feature_matrix(self.recipe, windows)
            probability[np.ix_(rows, columns)] = classifier.predict_proba(features)
        settings = check_filter(TerrainFilter(self.prior))
        labels = course.log.labels
        ground = ground_at(course.log, time_s)
        starts = np.array([label.start_s for label in labels])
        return Track(
            time_s,
            ground,
            (ground >= 0) & (starts_s >= starts[ground] - 1e-6),
            reported(filter_run(probability, time_s, settings), settings.threshold),
            last_class(probability),
            np.searchsorted(self.classes, [label.terrain for label in labels]),
            course.runs,
            starts,
            course.spliced,
        )


def last_class(probability: Array) -> Array:
    """Return the class (n,) of the last window that had an output; -1 before the first.

    Examples
    --------
    >>> last_class(np.array([[np.nan, np.nan], [0.2, 0.8], [np.nan, np.nan], [0.7, 0.3]])).tolist()
    [-1, 1, 1, 0]
    """
    there = np.asarray(np.isfinite(probability).all(axis=1))
    best = np.where(there, np.where(there[:, None], probability, 0.0).argmax(axis=1), -1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(there)), -1))
    return np.where(latest >= 0, best[latest], -1)


def following(
    recipe: WindowPipeline,
    runs: Sequence[RunLog],
    windows: Windows,
    rule: WindowRule,
    folds: Sequence[tuple[int, int, Array, Array]],
    seed: int,
) -> list[Following]:
    """Return what follows, for each fold, the courses through its held-out runs.

    Parameters
    ----------
    recipe : whose features are computed
    runs, windows : labelled runs, and their windows as the folds number them
    rule : of the windows
    folds : (repeat, number, training rows, test rows)
    seed : of what is drawn
    """
    by_id: Mapping[str, RunLog] = {run.run_id: run for run in runs}
    layout = Layout(windows.channels, windows.rate_hz)
    terrain = windows.terrain.astype(str)
    classes = np.unique(terrain)
    found = []
    for repeat, number, train, test in folds:
        parts = held_out_parts(by_id, windows[test])
        rng = np.random.default_rng((seed, repeat, number))
        course = spliced_course(parts, layout.channels, f"course {repeat} {number}", rng)
        courses = (*(() if course is None else (course,)), *recorded_courses(parts))
        counts = np.array([np.sum(terrain[train] == name) for name in classes], dtype=float) + 1.0
        prior = tuple((counts / counts.sum()).tolist())
        found.append(Following(recipe, courses, rule, layout, classes, prior))
    return found
