"""Lags of wheel encoders and camera behind the accelerometer, from starts and stops on hard ground.

Either one tells the robot's speed behind a first-order low-pass; the speed is the integral of the
acceleration, and of all sensors the accelerometer is the fastest (Danzi, AgriMaRo thesis, 7.2.2, sets the
lags equal by trial).  In each start or stop, with known latencies taken off the stamps::

    y = L_tau [g v + c |v| a],    v = v_0 + int (a - b) dt

``v_0``, the offset b (bias, tilt) and the gain g (scales, and wheels that push against each other) belong
to the event, tau and c to all of them.  c is the slip of a wheel per acceleration, which would pass for a
lead of the encoders: 0.7 % at 1 m/s^2 are up to 7 ms at 1 m/s.  All but tau enter linearly and are solved
for at each tau (variable projection).

What is found is a total lag: over the frequencies of a start, a pure delay and a low-pass are one and the
same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import minimize_scalar

from terrain.calibration.finding import Finding, undetermined
from terrain.calibration.sensors import MAX_GAP_S, Stretch, origin_twist
from terrain.identify import half_width
from terrain.kinematics.wheels import no_slip_twist
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.signals import at_times, low_passed, true_stretches

#: Of the accelerometer itself: 62.5 Hz of bandwidth in the fusion modes (Bosch, BNO055 data sheet).
REFERENCE_LAG_S = 1 / (2 * math.pi * 62.5)
MIN_ACCEL_MPS2 = 0.3  #: Of a start or stop, over :data:`SLOPE_S`.
SLOPE_S = 0.2
MIN_CHANGE_MPS = 0.2
MIN_EVENT_S = 0.3
LEVEL_S = 0.5  #: What is taken before and after the speed changes: the level that a lag is seen against.
MAX_YAW_RATE_RADPS = 0.1
MAX_STEER_CHANGE_RAD = 0.03  #: Beyond, it is no straight start, or the wheels are still being steered.
MAX_LAG_S = 0.5

#: Stamps, and the reference's own lag, are trusted to that much; no number of events makes the interval narrower.
STAMP_S = 0.001
GRID_S = 0.002  #: On which the acceleration is integrated and low-passed.
MIN_EVENTS = 5  #: From fewer starts and stops, their scatter is not known.
ENCODER, CAMERA = "sensors.encoder_time_constant_s", "camera.time_constant_s"

#: Name of a finding that is no number of the description: what slip needs of both.
DIFFERENCE = "encoder minus camera, s"


class Event(NamedTuple):
    """One start or stop: acceleration on a grid, and two speeds along it with their stamps."""

    run_id: str
    time_s: Array
    accel_mps2: Array
    wheels: tuple[Array, Array]
    camera: tuple[Array, Array]


def starts_and_stops(run: RunLog, robot: Robot, hard: Sequence[str]) -> list[Event]:
    """Return the straight starts and stops of a run where it is labelled as hard ground."""
    found = []
    for label in run.labels:
        if label.terrain in hard:
            found += _within(Stretch(run, label.start_s, label.end_s), robot)
    return found


def time_constants(events: Sequence[Event]) -> list[Finding]:
    """Return the time constants of encoders and camera, and the first less the second.

    Notes
    -----
    Residuals are coloured by what the accelerometer's noise integrates to, so that the interval is that of
    the scatter over the events (a sandwich with one cluster an event).  In the difference, what both speeds
    owe to the one acceleration that they are held against drops out.
    """
    names = [ENCODER, CAMERA, DIFFERENCE]
    if len(events) < MIN_EVENTS:
        return undetermined(
            names, f"{len(events)} straight starts and stops on hard ground: {MIN_EVENTS} are needed"
        )
    encoder_s, encoder_parts = _lag([_signal(event, event.wheels) for event in events], slips=True)
    camera_s, camera_parts = _lag([_signal(event, event.camera) for event in events], slips=False)
    if max(encoder_s, camera_s) > 0.95 * MAX_LAG_S:
        return undetermined(
            names, f"speeds lag by more than {MAX_LAG_S:g} s: bring the loggers' clocks together first"
        )
    runs = tuple(dict.fromkeys(event.run_id for event in events))
    dof = len(events) - 2
    found = []
    for name, value, parts in (
        (ENCODER, encoder_s, encoder_parts),
        (CAMERA, camera_s, camera_parts),
        (DIFFERENCE, encoder_s - camera_s, encoder_parts - camera_parts),
    ):
        std = math.sqrt(len(events) / dof * float(parts @ parts))
        half = math.hypot(float(half_width(std, dof)), STAMP_S)
        low = value - half if name == DIFFERENCE else max(value - half, 0.0)
        found.append(Finding(name, value, low, value + half, len(events), "starts and stops", runs, TOTAL))
    return found


TOTAL = "a total lag: a pure delay is indistinguishable from a low-pass"


class _Signal(NamedTuple):
    """A speed at its stamps; on a grid, what the acceleration gained, and slip's part but for its factor."""

    time_s: Array
    speed_mps: Array
    grid_s: Array
    gained_mps: Array
    slip_mps: Array


def _within(stretch: Stretch, robot: Robot) -> list[Event]:
    _, motors, steering, _, sensors = robot.equipment
    wheels = stretch.of("wheels", [f"motor_{i}_radps" for i in robot.wheels])
    angles = stretch.of("steering", [f"angle_{i}_rad" for i in robot.wheels])
    imu = stretch.of("imu", ("accel_x_mps2", "accel_y_mps2"))
    seen = origin_twist(stretch, robot)
    if wheels is None or angles is None or imu is None or seen is None:
        return []
    time_s = wheels.time_s
    zeros = (steering.zero_1_rad, steering.zero_2_rad, steering.zero_3_rad)
    steer = at_times(angles.time_s, np.unwrap(angles.values, axis=0) - zeros, time_s, MAX_GAP_S)
    wheel_speed, _ = no_slip_twist(
        robot.wheel_positions_m, steer, robot.wheel_radius_m * (wheels.values / motors.reduction_ratio)
    )
    imu = Stream(imu.time_s - sensors.imu_latency_s, imu.values, imu.channels)
    found = []
    for start_s, end_s in _ramps(time_s, wheel_speed[:, :2]):
        rows = (time_s >= start_s) & (time_s <= end_s)
        turned = np.ptp(steer[rows], axis=0).max()
        change = wheel_speed[rows][-1, :2] - wheel_speed[rows][0, :2]
        straight = np.abs(wheel_speed[rows, 2]).max() <= MAX_YAW_RATE_RADPS and turned <= MAX_STEER_CHANGE_RAD
        if not (straight and np.linalg.norm(change) >= MIN_CHANGE_MPS):
            continue
        along = change / np.linalg.norm(change)
        grid_s = np.arange(start_s, end_s, GRID_S)
        accel = at_times(imu.time_s, imu.values, grid_s, MAX_GAP_S) @ along
        viewed = (seen.time_s >= grid_s[0]) & (seen.time_s <= grid_s[-1])
        covered = (time_s >= grid_s[0]) & (time_s <= grid_s[-1])
        gaps = np.diff(seen.time_s[viewed], prepend=grid_s[0], append=grid_s[-1])
        if np.isfinite(accel).all() and gaps.max() <= MAX_GAP_S:
            of_wheels = (time_s[covered], wheel_speed[covered, :2] @ along)
            of_camera = (seen.time_s[viewed], seen.values[viewed, :2] @ along)
            found.append(Event(stretch.run.run_id, grid_s, accel, of_wheels, of_camera))
    return found


def _ramps(time_s: Array, speed_mps: Array) -> list[tuple[float, float]]:
    """Return begin and end of each change of speed, with the level before and after it."""
    n = max(round(SLOPE_S / 2 / float(np.median(np.diff(time_s)))), 1)
    if len(time_s) <= 2 * n:
        return []
    slope = np.zeros(len(time_s))
    change = np.linalg.norm(speed_mps[2 * n :] - speed_mps[: -2 * n], axis=1)
    slope[n:-n] = np.nan_to_num(change / (time_s[2 * n :] - time_s[: -2 * n]))
    steep = slope >= MIN_ACCEL_MPS2
    cores = [
        (float(time_s[first]), float(time_s[end - 1]))
        for first, end in true_stretches(steep)
        if time_s[end - 1] - time_s[first] >= MIN_EVENT_S
    ]
    found = []
    for i, (begin_s, end_s) in enumerate(cores):
        after_s = cores[i - 1][1] if i else time_s[0]
        before_s = cores[i + 1][0] if i + 1 < len(cores) else time_s[-1]
        # Half of the level between two ramps is each one's.
        if begin_s - after_s >= LEVEL_S and before_s - end_s >= LEVEL_S:
            found.append(
                (
                    max(begin_s - LEVEL_S, (after_s + begin_s) / 2 if i else time_s[0]),
                    min(end_s + LEVEL_S, (before_s + end_s) / 2 if i + 1 < len(cores) else time_s[-1]),
                )
            )
    return found


def _signal(event: Event, speed: tuple[Array, Array]) -> _Signal:
    time_s, speed_mps = speed
    behind_mps = low_passed(time_s, speed_mps, REFERENCE_LAG_S, LEVEL_S)
    gained = cumulative_trapezoid(event.accel_mps2, event.time_s, initial=0.0)
    n = max(len(time_s) // 8, 1)
    first, last = speed_mps[:n].mean(), speed_mps[-n:].mean()
    absolute = np.abs(first + gained + (last - first - gained[-1]) * np.linspace(0.0, 1.0, len(gained)))
    return _Signal(time_s, behind_mps, event.time_s, gained, absolute * event.accel_mps2)


def _lag(signals: Sequence[_Signal], slips: bool) -> tuple[float, Array]:
    """Return tau, and what the residuals of each event add to its error."""

    def residual(lag_s: float) -> Array:
        slip, left = (np.concatenate(part) for part in zip(*(_left(s, lag_s) for s in signals), strict=True))
        return np.asarray(left - slip * (slip @ left) / (slip @ slip)) if slips else left

    found = minimize_scalar(
        lambda lag_s: float((residual(lag_s) ** 2).sum()),
        bounds=(0.0, MAX_LAG_S),
        method="bounded",
        options={"xatol": 1e-6},
    ).x
    near_s, step_s = max(found, 2e-4), 1e-4
    by_lag = (residual(near_s + step_s) - residual(near_s - step_s)) / (2 * step_s)
    ends = np.cumsum([len(signal.time_s) for signal in signals])[:-1]
    parts = [part.sum() for part in np.split(by_lag * residual(found), ends)]
    return float(found), np.array(parts) / (by_lag @ by_lag)


def _left(signal: _Signal, lag_s: float) -> tuple[Array, Array]:
    """Return slip's part and the speed without what level, gain and offset of the event explain of either."""
    gained, slip, ramp = (
        np.interp(signal.time_s, signal.grid_s, low_passed(signal.grid_s, column, lag_s, LEVEL_S))
        for column in (signal.gained_mps, signal.slip_mps, signal.grid_s - signal.grid_s[0])
    )
    own = np.column_stack([np.ones(len(ramp)), gained, ramp])
    both = np.column_stack([slip, signal.speed_mps])
    left = both - own @ np.linalg.lstsq(own, both, rcond=None)[0]
    return left[:, 0], left[:, 1]
