"""What experiments of papers share: seeded runs, the truth beside a filter, means over runs, line figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import finished, new_figure, styled
from terrain.estimation.estimate import Estimate
from terrain.estimation.reference import lagged_slip, lagged_slip_at
from terrain.estimation.slip_figures import slip_figures
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario.legs import STAND_S

RUNS, FEW_RUNS = 5, 2
"""How many runs a figure is the mean of, and how many when it is only tried out."""

START_S = (STAND_S, STAND_S + 2.0)
"""The 1 m/s^2 start of the scenario ``straight``, and a second to settle."""

Curve = tuple[Array, Array, Array]
"""Times (n,), slip (n, wheels) and the speed ahead (n,) in m/s."""


def seeded_runs(
    robot: Robot,
    terrain: str,
    scenario: str,
    seed: int,
    quick: bool,
    duration_s: float | None = None,
    faults: Faults | None = None,
) -> list[RunLog]:
    """Return runs that differ in what is drawn; arguments as for ``simulate_run``."""
    numbers = range(1, 1 + (FEW_RUNS if quick else RUNS))
    return [
        simulate_run(robot, terrain, scenario, seed, number, duration_s=duration_s, faults=faults)
        for number in numbers
    ]


def curve_of(found: Estimate) -> Curve:
    """Return the slip that a filter found."""
    return found.track.time_s, found.slip.slip_ratio, found.track.state("speed_x_mps")


def lagged_truth(run: RunLog, robot: Robot) -> Curve:
    """Return the true slip behind the encoders' low-pass: the best that can be estimated."""
    truth = run.streams["truth"]
    lag_s = robot.equipment.sensors.encoder_time_constant_s
    slip, ground = lagged_slip(truth, robot, lag_s)
    return truth.time_s, slip, ground.mean(axis=1)


def true_slip(found: Estimate) -> Array:
    """Return :func:`lagged_truth` (n, wheels) at the instants of a filter."""
    return lagged_slip_at(found.run, found.robot, found.track.time_s)


def steady_mean(slip: Array, found: Estimate) -> float:
    """Return the mean over wheels of a slip (n, wheels) while the robot, in truth, drove steadily."""
    truth = found.run.streams["truth"]
    steady = slip_figures(found.blind, truth.channel("speed_x_mps"), truth.time_s).steady
    return float(np.nanmean(slip[steady]))


def mean_between(slip: Array, found: Estimate, start_s: float, end_s: float) -> float:
    """Return the mean over wheels of a slip (n, wheels) from one time to another."""
    return float(np.nanmean(slip[(found.track.time_s >= start_s) & (found.track.time_s < end_s)]))


def over_runs(values: Sequence[float]) -> tuple[float, tuple[float, float]]:
    """Return the mean over runs and their range.

    Examples
    --------
    >>> over_runs([1.0, 2.0, 6.0])
    (3.0, (1.0, 6.0))
    """
    return float(np.mean(values)), (float(np.min(values)), float(np.max(values)))


def lines_figure(
    title: str,
    y_label: str,
    lines: Sequence[tuple[Array, Array, str, str]],
    below: Callable[[Axes], object] | None = None,
) -> Figure:
    """Draw lines over time, each (times, values, colour, label), on what ``below`` draws first."""
    with styled():
        figure = new_figure(8.4, 3.8)
        axes = figure.add_subplot()
        if below is not None:
            below(axes)
        for time_s, values, colour, label in lines:
            axes.plot(time_s, values, color=colour, lw=1.2, label=label)
        axes.set(xlabel="time [s]", ylabel=y_label)
        add_legend(axes)
        return finished(figure, title)


def add_legend(axes: Axes) -> None:
    """Add a grid, and a legend above the axes."""
    axes.grid()
    axes.legend(ncols=4, fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderpad=0)
