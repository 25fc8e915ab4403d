"""Future work of Yamauchi et al.: the slip model identified while driving, without a motion-capture system.

Patako drives the trials of experiments I and II one after the other, with satellite fixes of 2 cm at 10 Hz
and a compass in place of cameras.  It starts from what is assumed of unknown ground, and takes what a trial
shows into the next one.  Odometry without fixes is then judged in the held-out turns of experiment III.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, VERMILION
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.reproduce.yamauchi.figures import Mark, Panel, panels_figure
from pipelines.reproduce.yamauchi.trials import (
    DOWNHILL,
    FEW_REPEATS,
    REPEATS,
    UPHILL,
    judged_trials,
    mean_interval,
    patako,
    run_trial,
    straight_trials,
    train,
    turning_trials,
)
from pipelines.reproduce.yamauchi.turning_odometry import ENDO, GYRO, SLIP, errors_of, gains, odometries
from terrain.estimation.observers.rows import feed_of, ticks
from terrain.estimation.observers.slip_learning import (
    OBSERVED_RATIO,
    PRIOR_STD,
    learned_model,
    slip_learning_observer,
    unknown_ground,
)
from terrain.estimation.observers.slip_model import PARAMETERS, SlipModel
from terrain.estimation.observers.slip_odometry import slip_odometry_observer
from terrain.records import Array, RunLog

RESIDUALS = (0.1, 0.15)
"""Of slip ratio and slip angle in turns on sand, assumed before: that of the printed regression is 8 "
"degrees."""

SHOWN = ("turning_exponent", "turn_grade_m", "turn_side_m", "turn_shift_m")
"""Parameters of the figure."""


class Progress(NamedTuple):
    """Means and standard deviations (trials + 1, 16) of the parameters, and the last model."""

    mean: Array
    std: Array
    model: SlipModel


def online(seed: int, quick: bool) -> Finding:
    """Identify the slip model by fixes, trial by trial, and judge odometry with it."""
    repeats, robot = FEW_REPEATS if quick else REPEATS, patako()
    trials = turning_trials(seed, repeats, (UPHILL, DOWNHILL)) + straight_trials(seed, max(repeats, 2))
    order = np.random.default_rng(seed).permutation(len(trials))
    progress = learn([run_trial(trials[k]) for k in order])
    offline = train(seed, quick, (UPHILL, DOWNHILL), drift=True)
    methods = odometries(offline) | {"online": slip_odometry_observer(robot, progress.model)}
    errors = {case: errors_of(methods, judged_trials(seed, quick, case)) for case in (UPHILL, DOWNHILL)}
    rows = [
        _parameter_row(progress, offline.found.model),
        _observed_row(progress),
        *(_gain_row(errors[UPHILL], against, seed, "uphill") for against in (GYRO, ENDO)),
        *(_gain_row(errors[DOWNHILL], against, seed, "downhill") for against in (GYRO, ENDO)),
    ]
    return Finding(rows, [Picture(_CAPTION, _figure(progress, offline.found.model))])


_CAPTION = (
    "Parameters of the slip model after each trial, by fixes of 2 cm at 10 Hz from unknown ground on, "
    "with two standard deviations; and their values from all trials with cameras."
)


def without_cameras(run: RunLog) -> RunLog:
    """Return a run that has satellites and a compass, and no poses."""
    streams = {name: stream for name, stream in run.streams.items() if name not in ("pose", "truth")}
    return RunLog(run.run_id, run.robot, streams)


def learn(runs: Sequence[RunLog]) -> Progress:
    """Take the runs one after the other through the filter, each from where the one before ended."""
    slip_std, angle_std = RESIDUALS
    model = replace(unknown_ground(), slip_std_ratio=slip_std, angle_std_rad=angle_std)
    means, stds = [model.vector], [PRIOR_STD]
    for run in runs:
        observer = slip_learning_observer(patako(), model)
        memory, last_s = observer.start, None
        for time_s, row in ticks(without_cameras(run), feed_of(run, patako(), observer.rows)):
            memory = observer.step(observer.params, memory, row, 0.0 if last_s is None else time_s - last_s)
            last_s = time_s
        model = learned_model(observer.params, memory)
        means.append(model.vector)
        stds.append(np.sqrt(np.diag(model.covariance)))
    return Progress(np.array(means), np.array(stds), model)


def _parameter_row(progress: Progress, offline: SlipModel) -> Row:
    place = PARAMETERS.index("turning_exponent")
    own_std = float(np.sqrt(offline.covariance[place, place]))
    both = float(np.hypot(progress.std[-1, place], own_std))
    apart = float(progress.mean[-1, place] - offline.vector[place])
    return Row(
        what="Exponent n by fixes while driving",
        where="future work",
        printed="online identification should be considered",
        simulated=float(progress.mean[-1, place]),
        unit="ratio",
        verdict=Verdict.NOT_PRINTED,
        why=f"From unknown ground on, after {len(progress.mean) - 1} trials; by cameras it is "
        f"{offline.vector[place]:.3f}. They are {abs(apart) / both:.1f} standard deviations apart.",
        beside={"std": float(progress.std[-1, place]), "by cameras": float(offline.vector[place])},
    )


def _observed_row(progress: Progress) -> Row:
    observed = progress.std[-1] <= OBSERVED_RATIO * PRIOR_STD
    missing = [name for name, seen in zip(PARAMETERS, observed.tolist(), strict=True) if not seen]
    return Row(
        what=f"Parameters of {len(PARAMETERS)} that the fixes show",
        where="future work",
        printed="not evaluated",
        simulated=float(observed.sum()),
        unit="parameters",
        verdict=Verdict.NOT_PRINTED,
        why="Observed is what has less than half of the standard deviation assumed at the start. "
        + (f"Not observed apart from others: {', '.join(missing)}." if missing else ""),
    )


def _gain_row(errors: dict[tuple[float, float], dict[str, Array]], against: str, seed: int, what: str) -> Row:
    found, offline = gains(errors, "online", against), gains(errors, SLIP, against)
    low, high = mean_interval(found, seed)
    return Row(
        what=f"Fall of the position RMSE against {against.replace('endo', 'Endo')} without fixes, "
        f"turning {what}, model by fixes",
        where="future work",
        printed="not evaluated",
        simulated=float(found.mean()),
        spread=(float(found.min()), float(found.max())),
        unit="ratio",
        verdict=Verdict.NOT_PRINTED,
        why=f"In the judged turns of experiment III. Interval of the mean: {low:.3f} to {high:.3f}.",
        beside={"model by cameras": float(offline.mean())},
    )


def _figure(progress: Progress, offline: SlipModel) -> Figure:
    panels, trials = [], np.arange(len(progress.mean), dtype=float)
    for name in SHOWN:
        place = PARAMETERS.index(name)
        mean, std = progress.mean[:, place], progress.std[:, place]
        marks = [
            Mark(trials, mean, BLUE, "by fixes"),
            Mark(trials, mean - 2 * std, BLUE, "two standard deviations", dashed=True),
            Mark(trials, mean + 2 * std, BLUE, "", dashed=True),
            Mark(trials[[0, -1]], np.full(2, offline.vector[place]), VERMILION, "by cameras"),
        ]
        panels.append(Panel(name.replace("_", " "), "trials", name.rpartition("_")[2], marks))
    return panels_figure("The slip model identified while driving", panels)
