"""Section V of Tazzari et al.: a circle and a straight run, with raw fixes (figures 3 to 5)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from pipelines.reporting.drawing import BLUE, GREEN, GREY, INK, VERMILION
from pipelines.reporting.line_figure import Line
from pipelines.reproduce.results import Finding, Picture, Row, holds
from pipelines.reproduce.tazzari.figures import Panel, panels_figure
from pipelines.reproduce.tazzari.runs import (
    CIRCLE,
    MOTIONS,
    ObservedRun,
    TrackMotion,
    observed_motion,
    orchard_ugv,
    rms,
    seeds,
)
from terrain.angles import wrapped
from terrain.estimation.observers.track_efficiency import measured_efficiency
from terrain.records import Array

SETTLED_S = 30.0
"""From when on errors are averaged."""
TURN_S = 159.0
"""Time of a whole turn on the circle, and what it takes to start."""
FIX_M = 0.02
"""Standard deviation of a raw fix, one axis."""


def two_motions(seed: int, quick: bool) -> Finding:
    """Observe both motions with the gains of the paper."""
    duration_s = TURN_S / 3.0 if quick else TURN_S
    runs = {
        motion: [observed_motion(motion, each, duration_s) for each in seeds(seed, quick)]
        for motion in MOTIONS
    }
    rows = [row for motion, found in runs.items() for row in _rows(motion, found)]
    first = {motion: found[0] for motion, found in runs.items()}
    return Finding(rows, [_trajectories(first), _errors(first), _estimates(first)])


def _rows(motion: TrackMotion, runs: list[ObservedRun]) -> list[Row]:
    late = [run.time_s > SETTLED_S for run in runs]
    off_m = [rms(_position_error(run)[k]) for run, k in zip(runs, late, strict=True)]
    off_eta = [rms((run.estimate - run.eta)[k]) for run, k in zip(runs, late, strict=True)]
    stated = float(np.mean([run.track.std[-1, 5:7] for run in runs]))
    measured = [rms((by_15(run) - run.eta)[k]) for run, k in zip(runs, late, strict=True)]
    from_15 = [
        rms(np.mean((run.estimate - by_15(run))[k], axis=0)) for run, k in zip(runs, late, strict=True)
    ]
    n_fixes = float(np.sum(np.isfinite(runs[0].rows[late[0], 2])))
    agrees = max(from_15) < 3.0 * float(np.mean(measured)) / np.sqrt(n_fixes)
    return [
        Row(
            what=f"Position error of the observer, {motion.words}",
            where="figures 3 and 4",
            printed="the trajectories tend to overlap",
            simulated=float(np.mean(off_m)),
            spread=(min(off_m), max(off_m)),
            unit="m",
            verdict=holds(max(off_m) < FIX_M),
            why=f"Root mean square after {SETTLED_S:g} s, against the true position: less than the noise of "
            f"a raw fix, {FIX_M:g} m on each axis. The paper's axes carry no number in the text.",
        ),
        Row(
            what=f"Error of the efficiencies, {motion.words}",
            where="figure 5",
            printed="robust convergence to those of (15)",
            simulated=float(np.mean(off_eta)),
            spread=(min(off_eta), max(off_eta)),
            unit="ratio",
            verdict=holds(max(off_eta) < 0.005 and agrees),
            why=f"Root mean square after {SETTLED_S:g} s, against the true ones; (15), from the speed of "
            "satellites along the body and the gyro, scatters more and agrees on average, within three "
            "standard deviations of its mean.",
            beside={
                "standard deviation stated by the observer": stated,
                "scatter of (15)": float(np.mean(measured)),
                "mean difference to (15)": float(np.mean(from_15)),
            },
        ),
    ]


def by_15(run: ObservedRun) -> Array:
    """Return the efficiencies (n, 2) by (15), at the ticks, from the speeds of the last fix and the gyro."""
    gnss, time_s = run.run.streams["gnss"], run.time_s
    yaw = run.run.streams["compass"].channel("yaw_rad")
    speed = gnss.channel("velocity_x_mps") * np.cos(yaw) + gnss.channel("velocity_y_mps") * np.sin(yaw)
    last = np.maximum(np.searchsorted(gnss.time_s, time_s + 1e-6) - 1, 0)
    left, right = run.rows[:, 0], run.rows[:, 1]
    return measured_efficiency(speed[last], run.rows[:, 5], left, right, orchard_ugv().half_track_m)


def _position_error(run: ObservedRun) -> Array:
    return np.asarray(run.track.mean[:, :2] - run.pose[:, :2])


def _trajectories(runs: dict[TrackMotion, ObservedRun]) -> Picture:
    panels = []
    for motion, run in runs.items():
        fixes, pose = run.run.streams["gnss"].values, run.track.mean
        panels.append(
            Panel(
                "x [m]",
                "y [m]",
                [
                    Line(fixes[:, 0], fixes[:, 1], VERMILION, "raw fixes"),
                    Line(pose[:, 0], pose[:, 1], BLUE, "observer"),
                ],
                square=motion is CIRCLE,
            )
        )
    return Picture(
        "Measured and estimated positions on the circle (left) and in straight motion (right), as figure "
        "3 of the paper.",
        panels_figure("Positions", panels, 4.2),
    )


def _errors(runs: dict[TrackMotion, ObservedRun]) -> Picture:
    panels = []
    for run in runs.values():
        fixed = np.isfinite(run.rows[:, 2:5]).all(axis=1)
        error = run.rows[fixed, 2:5] - run.track.mean[fixed, :3]
        error[:, 2] = wrapped(error[:, 2])
        names = (("x [m]", BLUE), ("y [m]", GREEN), ("heading [rad]", VERMILION))
        panels.append(
            Panel(
                "time [s]",
                "observation error",
                [
                    Line(run.time_s[fixed], error[:, k], colour, name)
                    for k, (name, colour) in enumerate(names)
                ],
            )
        )
    return Picture(
        "Observation error (9), raw fix minus estimate, on the circle (left) and in straight motion (right), "
        "as figure 4 of the paper.",
        panels_figure("Observation errors", panels),
    )


def _estimates(runs: dict[TrackMotion, ObservedRun]) -> Picture:
    panels = []
    for run in runs.values():
        time_s, measured = run.time_s, by_15(run)

        def scatter(axes: Axes, time_s: Array = time_s, measured: Array = measured) -> None:
            moving = time_s > 2.0
            for k in range(2):
                label = "(15)" if k == 0 else None
                axes.plot(
                    time_s[moving],
                    measured[moving, k],
                    "o",
                    color=GREY,
                    ms=1.2,
                    alpha=0.4,
                    mew=0,
                    label=label,
                )
            axes.set_ylim(0.6, 1.3)

        panels.append(
            Panel(
                "time [s]",
                "efficiency",
                [
                    Line(time_s, run.eta[:, 0], INK, "true"),
                    Line(time_s, run.eta[:, 1], INK, "_true"),
                    Line(time_s, run.estimate[:, 0], BLUE, "left"),
                    Line(time_s, run.estimate[:, 1], VERMILION, "right"),
                ],
                draw_background=scatter,
            )
        )
    return Picture(
        "Estimated efficiencies of the tracks on the circle (left) and in straight motion (right), those "
        "by (15) and the true ones, as figure 5 of the paper.",
        panels_figure("Efficiencies of the tracks", panels),
    )
