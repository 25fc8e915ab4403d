"""What the experiments share: simulated runs of the orchard vehicle, and what the observer makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.estimation.observers.family import ObserverTrack, observe
from terrain.estimation.observers.rows import feed_of, rows_of
from terrain.estimation.observers.track_efficiency import measured_efficiency
from terrain.estimation.observers.tracked import tracked_observer
from terrain.estimation.observers.tracked_settings import TrackedSettings
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot, as_drive, load_robot
from terrain.simulation.tracked.given_slip import GivenSlip
from terrain.simulation.tracked.run import COMMANDS_HZ, NOISY, TrackedSensors, simulate_tracked
from terrain.terramechanics.soil import Soil

PAPER = TrackedSettings()
"""L and Lambda the identity, section V."""
NORMALISED = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True)
"""The gain of this project: adaptation that does not depend on the speed."""
CONVERGED_RATIO = (0.05, 0.02)
"""Error over the true efficiency within which an estimate has converged."""
RUNS, FEW_RUNS = 5, 2
"""Number of runs that a figure is averaged over, and the number with ``quick``."""


class TrackMotion(NamedTuple):
    """A motion at constant speeds: what it is called, speeds of the tracks in m/s, and efficiencies.

    Pairs are (left, right); the paper prints none of these numbers, they are assumed.
    """

    words: str
    speed_mps: tuple[float, float]
    eta_ratio: tuple[float, float]


CIRCLE = TrackMotion("circle", (0.4, 0.6), (1.10, 0.80))
STRAIGHT = TrackMotion("straight", (0.6, 0.6), (0.87, 0.87))
MOTIONS = (CIRCLE, STRAIGHT)


class ObservedRun(NamedTuple):
    """A run, the observer's track over it, its rows, and the truth at its ticks.

    Parameters
    ----------
    run : without the cameras around the field, which the paper does not have
    track : of the observer
    rows : (n, 6)
    pose : (n, 3) true position and heading
    eta : (n, 2) true efficiencies; NaN of a track that stands
    """

    run: RunLog
    track: ObserverTrack
    rows: Array
    pose: Array
    eta: Array

    @property
    def time_s(self) -> Array:
        """Times (n,) of the ticks."""
        return self.track.time_s

    @property
    def estimate(self) -> Array:
        """Estimated efficiencies (n, 2) of the left and the right track."""
        return eta_of(self.track)


def orchard_ugv() -> TrackedRobot:
    """Return the vehicle of the paper."""
    return as_drive(
        TrackedRobot, load_robot("orchard_ugv"), "robot {name!r} is {drive}, a tracked one is required"
    )


def eta_of(track: ObserverTrack) -> Array:
    """Return the estimated efficiencies (n, 2) of the left and the right track."""
    return np.column_stack([track.state("eta_left_ratio"), track.state("eta_right_ratio")])


def observed(
    ground: Soil | GivenSlip,
    speeds_mps: Array,
    seed: int | np.random.SeedSequence,
    settings: TrackedSettings = PAPER,
    sensors: TrackedSensors = NOISY,
    lost_s: Sequence[tuple[float, float]] = (),
) -> ObservedRun:
    """Simulate a run and observe it.

    Parameters
    ----------
    ground : a soil, or slip that is given
    speeds_mps : (n, 2) commanded speeds of the tracks at 50 Hz
    seed : of the noise
    settings : of the observer
    sensors : of the vehicle
    lost_s : between which times there is no fix
    """
    robot = orchard_ugv()
    run = simulate_tracked(robot, ground, speeds_mps, seed, sensors=sensors)
    streams = {name: stream for name, stream in run.streams.items() if name != "pose"}
    run = replace(run, streams=streams)
    observer = tracked_observer(robot, settings)
    time_s, rows = rows_of(run, feed_of(run, robot, observer.rows))
    for start_s, end_s in lost_s:
        rows[(time_s >= start_s) & (time_s < end_s), 2:5] = np.nan
    truth = streams["truth"]
    at = np.minimum(np.searchsorted(truth.time_s, time_s - 1e-6), len(truth.time_s) - 1)
    pose = np.column_stack([truth.channel(name)[at] for name in ("position_x_m", "position_y_m", "yaw_rad")])
    forward, turn = (truth.channel(name)[at] for name in ("speed_x_mps", "yaw_rate_radps"))
    eta = measured_efficiency(forward, turn, rows[:, 0], rows[:, 1], robot.half_track_m)
    if isinstance(ground, GivenSlip):
        eta = np.tile([ground.eta_left_ratio, ground.eta_right_ratio], (len(time_s), 1))
    return ObservedRun(run, observe(observer, time_s, rows), rows, pose, eta)


def constant_speeds(motion: TrackMotion, duration_s: float) -> Array:
    """Return commands (n, 2) of a motion."""
    return np.tile(motion.speed_mps, (round(duration_s * COMMANDS_HZ) + 1, 1))


def observed_motion(
    motion: TrackMotion,
    seed: int | np.random.SeedSequence,
    duration_s: float = 60.0,
    settings: TrackedSettings = PAPER,
    sensors: TrackedSensors = NOISY,
) -> ObservedRun:
    """Observe a motion with its constant efficiencies."""
    speeds = constant_speeds(motion, duration_s)
    return observed(GivenSlip(*motion.eta_ratio), speeds, seed, settings, sensors)


def seeds(seed: int, quick: bool) -> list[np.random.SeedSequence]:
    """Return the seeds of several runs."""
    return np.random.SeedSequence(seed).spawn(FEW_RUNS if quick else RUNS)


def converged_s(run: ObservedRun, ratio: float) -> float:
    """Return from when on both efficiencies are within a ratio of the true ones; NaN if not at the end."""
    far = np.flatnonzero((np.abs(run.estimate - run.eta) > ratio * np.abs(run.eta)).any(axis=1))
    if not len(far):
        return 0.0
    return float(run.time_s[far[-1] + 1]) if far[-1] + 1 < len(run.time_s) else float("nan")


def rms(values: Array) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))
