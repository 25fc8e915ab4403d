"""Trials that the experiments share: straight and turning runs of Patako on a slope of Toyoura sand.

Each trial draws its own sand (:func:`terrain.terramechanics.soil.scattered`) and its own noise.  Trials for
training and trials that are judged have different seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.calibration.slip_model import SlipIdentification, identify_slip_model
from terrain.calibration.track_motion import odometry_rows, slip_samples
from terrain.calibration.turning_exponent import TurningFit, fit_turning
from terrain.estimation.observers.family import Observer, ObserverTrack, observe
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot, as_drive, load_robot
from terrain.simulation.tracked.run import simulate_tracked
from terrain.simulation.tracked.slope import Slope
from terrain.terramechanics.soil import Soil, load_soil, scattered

ROBOT, SAND = "patako", "toyoura_sand"
SPEED_MPS = 0.05
"""5 cm/s, of the middle of the robot, in all experiments."""

SLOPES_DEG, RATES_DPS = (0.0, 5.0, 10.0, 15.0), (10.0, 20.0, 30.0)
"""Of experiment II, on which models are trained."""

JUDGED = ((8.0, 20.0), (8.0, 30.0), (15.0, 20.0), (15.0, 30.0))
"""Slope in deg and input yaw rate in deg/s of experiment III."""

UPHILL, DOWNHILL = math.pi / 2, -math.pi / 2
"""Heading of uphill of a robot that starts along the contour and turns to the left: uphill, as in the
paper."""

REPEATS, FEW_REPEATS = 3, 1
TRIALS, FEW_TRIALS = 20, 3
"""Judged trials of each condition, and with ``quick``."""

N_DRAWS = 2000
TURNED_RAD = math.pi / 2
SETTLE_S = 1.0
LOST_RATIO = 0.38
"""Of the input yaw rate in a turn on sand: only how long a turn is commanded, so that it ends near 90
degrees."""


class Trial(NamedTuple):
    """What a trial is: a turn, or a straight run where the rate is 0."""

    slope_deg: float
    rate_dps: float
    uphill_rad: float
    seed: int


def patako() -> TrackedRobot:
    """Return the robot."""
    return as_drive(TrackedRobot, load_robot(ROBOT), "{name} is no tracked robot")


def run_trial(
    trial: Trial, soil: Soil | None = None, duration_s: float = 10.0, robot: TrackedRobot | None = None
) -> RunLog:
    """Return the log of a trial; a turn ends near 90 degrees, a straight run after ``duration_s``."""
    robot = robot or patako()
    turn = math.radians(trial.rate_dps)
    if turn > 0.0:
        duration_s = SETTLE_S + TURNED_RAD / turn / (1.0 - LOST_RATIO)
    half = robot.half_track_m * turn
    belts = np.tile([SPEED_MPS - half, SPEED_MPS + half], (int(50 * duration_s) + 1, 1))
    ground = scattered(soil or load_soil(SAND), np.random.default_rng([trial.seed, 7]))
    slope = Slope(math.radians(trial.slope_deg), trial.uphill_rad)
    name = f"{trial.slope_deg:g}deg_{trial.rate_dps:g}dps_{trial.seed}"
    return simulate_tracked(robot, ground, belts, trial.seed, slope=slope, run_id=name)


def turning_trials(seed: int, repeats: int, uphill_rad: Sequence[float]) -> list[Trial]:
    """Return trials of experiment II: every slope and rate, turning uphill or downhill."""
    cases = [(s, r, u) for _ in range(repeats) for u in uphill_rad for s in SLOPES_DEG for r in RATES_DPS]
    return [Trial(*case, seed=1_000_000 * (seed + 1) + k) for k, case in enumerate(cases)]


def straight_trials(seed: int, repeats: int, slopes_deg: Sequence[float] = SLOPES_DEG) -> list[Trial]:
    """Return straight trials of experiment I: every slope, climbing and traversing."""
    cases = [(s, 0.0, u) for _ in range(repeats) for u in (0.0, UPHILL) for s in slopes_deg]
    return [Trial(*case, seed=1_000_000 * (seed + 1) + 500_000 + k) for k, case in enumerate(cases)]


def judged_trials(seed: int, quick: bool, uphill_rad: float) -> dict[tuple[float, float], list[Trial]]:
    """Return the judged trials of each condition of experiment III."""
    first = 1_000_000 * (seed + 1) + (800_000 if uphill_rad == UPHILL else 900_000)
    n = FEW_TRIALS if quick else TRIALS
    return {
        case: [Trial(*case, uphill_rad, first + n * number + k) for k in range(n)]
        for number, case in enumerate(JUDGED)
    }


class Trained(NamedTuple):
    """A slip model and what it was found from, with the exponent that suits Endo's law alone best."""

    found: SlipIdentification
    endo: TurningFit


def train(seed: int, quick: bool, uphill_rad: Sequence[float], *, drift: bool) -> Trained:
    """Identify the slip model on trials of experiments I and II."""
    repeats, robot = FEW_REPEATS if quick else REPEATS, patako()
    trials = turning_trials(seed, repeats, uphill_rad) + straight_trials(seed, max(repeats, 2))
    runs = [run_trial(trial) for trial in trials]
    found = identify_slip_model(runs, robot, drift=drift)
    turning = slip_samples(runs, robot).turning
    return Trained(found, fit_turning(turning, robot.half_track_m, grade=False))


class Drive(NamedTuple):
    """A trial as an odometry has it: its log, and the ticks and rows of an observer."""

    run: RunLog
    time_s: Array
    rows: Array


def driven(trial: Trial) -> Drive:
    """Return a trial with the rows of an odometry."""
    run = run_trial(trial)
    return Drive(run, *odometry_rows(run, patako()))


def follow(observer: Observer, drive: Drive) -> ObserverTrack:
    """Return the estimates of an odometry over a trial."""
    return observe(observer, drive.time_s, drive.rows)


def position_error(track: ObserverTrack, run: RunLog) -> Array:
    """Return the distance (n,) in m of an odometry from the truth."""
    truth = run.streams["truth"]
    true = [np.interp(track.time_s, truth.time_s, truth.channel(f"position_{axis}_m")) for axis in "xy"]
    return np.hypot(track.state("position_x_m") - true[0], track.state("position_y_m") - true[1])


def position_rmse(track: ObserverTrack, run: RunLog) -> float:
    """Return the root mean square of the distance from the truth, in m."""
    return float(np.sqrt(np.mean(position_error(track, run) ** 2)))


def mean_interval(values: Array, seed: int) -> tuple[float, float]:
    """Return the bootstrap interval of the mean of trials (n,).

    Examples
    --------
    >>> low, high = mean_interval(np.array([0.6, 0.7, 0.8]), 0)
    >>> low < 0.7 < high
    True
    """
    rows = bootstrap_rows(len(values), N_DRAWS, np.random.default_rng(seed))
    return percentile_interval(values[rows].mean(axis=1))
