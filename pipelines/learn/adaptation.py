"""Whether adapting by the start of a session helps: on sessions, or runs, of training that are held out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.stats import t as student
from sklearn.linear_model import LogisticRegression

from terrain.classify.adaptation import (
    MIN_REFERENCE_S,
    START_S,
    Adaptation,
    adapt,
    averaged,
    corrected,
    corrections,
    learn_adaptation,
    reference_s,
    start_of,
)
from terrain.classify.folds import has_sessions, inner_splits, single_run_classes, units_of
from terrain.classify.grouped import fit_preparation
from terrain.errors import DataError
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows

N_FOLDS, MIN_UNITS, LEVEL, LEAST_PROBABILITY = 5, 3, 0.95, 1e-3
MAX_WINDOWS = 100  #: Of a held-out unit that are judged, thinned evenly.


def channels_of(windows: Windows, signal_set: str) -> tuple[tuple[str, str], ...]:
    """Return stream and channel of what windows have of a signal set."""
    every = ((stream, name) for stream, names in windows.channels.items() for name in names)
    return tuple(each for each in every if signal_set_of(*each) == signal_set)


def judged_adaptation(
    windows: Windows, features: Array, extract: Callable[[Windows], Array], gap: int, seed: int
) -> Adaptation:
    """Return what windows of training say of sessions, used unasked only where that is shown to help.

    A logistic regression of the features judges in place of any recipe: the question is one of the data.  It helps
    where the log loss of held-out units falls, after their start of :data:`START_S` without a label, by more than the
    interval of its mean over units.

    Parameters
    ----------
    windows, features, extract : labelled, with samples; their features (n, f), and what gives those of others
    gap, seed : of the inner folds

    Raises
    ------
    DataError
        as :func:`learn_adaptation`.
    """
    currents, imu, wheels = (channels_of(windows, each) for each in ("currents", "imu", "wheels"))
    channels = currents + imu, wheels
    learned = learn_adaptation(windows, *channels)
    y, groups = windows.terrain.astype(str), windows.groups
    unit, kind = units_of(y, groups), "session" if has_sessions(y, groups) else "run"
    alone = single_run_classes(y, unit)  # what is held out of these was trained on the same session
    lasting = []
    for name in np.unique(unit[~np.isin(y, alone)]):
        own = windows[unit == name]
        starts = (
            reference_s(own[start_of(own)]) >= MIN_REFERENCE_S
        )  # not where a pause follows the first window
        if starts and reference_s(own) >= START_S + 2.0 * windows.length_s:
            lasting.append(name)
    if len(lasting) < MIN_UNITS:
        few = f"{len(lasting)} {kind}s outlast a start of {START_S:g} s, {MIN_UNITS} are needed"
        return learned._replace(status=f"not shown: {few}")
    losses = []
    try:
        for train, test in inner_splits(y, groups, N_FOLDS, seed, gap):
            law = learn_adaptation(windows[train], *channels)
            preparation = fit_preparation(features[train], y[train], 100.0)
            judge = LogisticRegression(max_iter=200).fit(preparation.of(features[train]), y[train])

            def probability(rows: Array, judge: LogisticRegression = judge, by: Any = preparation) -> Array:
                return np.asarray(judge.predict_proba(by.of(rows)))

            for name in np.intersect1d(unit[test], lasting):
                own = test[unit[test] == name]
                start = start_of(windows[own])
                rest = own[~start][:: max(-(-int((~start).sum()) // MAX_WINDOWS), 1)]
                if not len(rest):
                    continue
                shifted = adapt(law, windows[own[start]])
                values, weights = corrections(shifted)
                by_each = probability(extract(corrected(shifted, windows[rest], values)))
                truth = np.searchsorted(judge.classes_, y[rest])
                pair = probability(features[rest]), averaged(by_each, weights)
                losses.append(
                    [
                        -np.log(np.maximum(of[np.arange(len(rest)), truth], LEAST_PROBABILITY)).mean()
                        for of in pair
                    ]
                )
    except DataError as error:
        return learned._replace(status=f"not shown: {error}")
    if len(losses) < MIN_UNITS:
        return learned._replace(
            status=f"not shown: {len(losses)} {kind}s could be held out, {MIN_UNITS} are needed"
        )
    before, after = np.mean(losses, axis=0)
    gains = np.subtract(*np.transpose(losses))
    half = student.ppf(0.5 + LEVEL / 2, len(gains) - 1) * gains.std(ddof=1) / np.sqrt(len(gains))
    shown = bool(gains.mean() > half)
    losses_text = f"log loss {before:.2f} without and {after:.2f} with it on {len(gains)} {kind}s held out"
    return learned._replace(shown=shown, status=f"{'shown' if shown else 'not shown'}: {losses_text}")
