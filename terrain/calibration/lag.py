"""Lags of wheel encoders and camera behind the accelerometer, from starts and stops on hard ground.

Either one tells the robot's speed behind a first-order low-pass; the speed is the integral of the
acceleration, and of all sensors the accelerometer is the fastest (Danzi, AgriMaRo thesis, 7.2.2, sets the
lags equal by trial).  In each start or stop, with known latencies taken off the stamps::

    y = L_tau [g v + c |v| a],    v = v_0 + int (a - b) dt

``v_0``, the offset b (bias, tilt) and the gain g (scales, and wheels that push against each other) belong
to the event, tau and c to all of them.  c is the slip of a wheel per acceleration, which would pass for a
lead of the encoders: 0.7 % at 1 m/s^2 are up to 7 ms at 1 m/s.  All but tau enter linearly and are solved
for at each tau (variable projection).  Residuals are coloured by what the accelerometer's noise integrates to, so
that the interval is that of the scatter over the events, each a cluster.  In the difference of both lags, what both
speeds owe to the one acceleration that they are held against drops out.

What is found is a total lag: over the frequencies of a start, a pure delay and a low-pass are one and the
same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from terrain.calibration.finding import Finding, undetermined
from terrain.calibration.sensors import MAX_GAP_S, Stretch, origin_twist
from terrain.identify import Parameter, half_width, identify
from terrain.kinematics.wheels import no_slip_twist
from terrain.records import Array
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

#: Stamps, and the reference's own lag, are trusted to within this.
STAMP_S = 0.001
GRID_S = 0.002  #: On which the acceleration is integrated and low-passed.
MIN_EVENTS = 5  #: From fewer starts and stops, their scatter is not known.
ENCODER, CAMERA = "sensors.encoder_time_constant_s", "camera.time_constant_s"

#: Name of a finding that is no number of the description: what slip needs of both.
DIFFERENCE = "encoder minus camera, s"


TOTAL = "a total lag: a pure delay is indistinguishable from a low-pass"
LAG = Parameter("lag_s", 0.05, 0.0, MAX_LAG_S, step=0.05)


class Event(NamedTuple):
    """One start or stop: acceleration on a grid, and two speeds along it with their stamps."""

    run_id: str
    time_s: Array
    accel_mps2: Array
    wheels: tuple[Array, Array]
    camera: tuple[Array, Array]


def starts_and_stops(stretch: Stretch, robot: Robot) -> list[Event]:
    """Return the straight starts and stops of a stretch on hard ground."""
    motors, sensors = robot.motors, robot.sensors
    wheels = stretch.of("wheels", [f"motor_{i}_radps" for i in robot.wheels])
    angles = stretch.of("steering", [f"angle_{i}_rad" for i in robot.wheels])
    imu = stretch.of("imu", ("accel_x_mps2", "accel_y_mps2"))
    seen = origin_twist(stretch, robot)
    if wheels is None or angles is None or imu is None or seen is None:
        return []
    time_s, angle = wheels.time_s, np.unwrap(angles.values, axis=0) - robot.steering_zeros_rad
    steer = at_times(angles.time_s, angle, time_s, MAX_GAP_S)
    wheel_speed, _ = no_slip_twist(
        robot.wheel_positions_m, steer, robot.wheel_radius_m * (wheels.values / motors.reduction_ratio)
    )
    n, cores = max(round(SLOPE_S / 2 / float(np.median(np.diff(time_s)))), 1), []
    if len(time_s) > 2 * n:
        slope = np.zeros(len(time_s))
        change = np.linalg.norm(wheel_speed[2 * n :, :2] - wheel_speed[: -2 * n, :2], axis=1)
        slope[n:-n] = np.nan_to_num(change / (time_s[2 * n :] - time_s[: -2 * n]))
        cores = [(time_s[first], time_s[end - 1]) for first, end in true_stretches(slope >= MIN_ACCEL_MPS2)]
    cores = [(first_s, last_s) for first_s, last_s in cores if last_s - first_s >= MIN_EVENT_S]
    found = []
    for i, (begin_s, end_s) in enumerate(cores):
        after_s = cores[i - 1][1] if i else time_s[0]
        before_s = cores[i + 1][0] if i + 1 < len(cores) else time_s[-1]
        if begin_s - after_s < LEVEL_S or before_s - end_s < LEVEL_S:
            continue
        # Half of the level between two ramps is each one's.
        start_s = max(begin_s - LEVEL_S, (after_s + begin_s) / 2 if i else time_s[0])
        stop_s = min(end_s + LEVEL_S, (before_s + end_s) / 2 if i + 1 < len(cores) else time_s[-1])
        rows = (time_s >= start_s) & (time_s <= stop_s)
        turned = np.ptp(steer[rows], axis=0).max()
        change = wheel_speed[rows][-1, :2] - wheel_speed[rows][0, :2]
        straight = np.abs(wheel_speed[rows, 2]).max() <= MAX_YAW_RATE_RADPS and turned <= MAX_STEER_CHANGE_RAD
        if not (straight and np.linalg.norm(change) >= MIN_CHANGE_MPS):
            continue
        along, grid_s = change / np.linalg.norm(change), np.arange(start_s, stop_s, GRID_S)
        accel = at_times(imu.time_s - sensors.imu_latency_s, imu.values, grid_s, MAX_GAP_S) @ along
        of_wheels, of_camera = (
            (at_s[inside], values[inside, :2] @ along)
            for at_s, values in ((time_s, wheel_speed), (seen.time_s, seen.values))
            for inside in [(at_s >= grid_s[0]) & (at_s <= grid_s[-1])]
        )
        gaps = np.diff(of_camera[0], prepend=grid_s[0], append=grid_s[-1])
        if np.isfinite(accel).all() and gaps.max() <= MAX_GAP_S:
            found.append(Event(stretch.run.run_id, grid_s, accel, of_wheels, of_camera))
    return found


def time_constants(events: Sequence[Event]) -> list[Finding]:
    """Return the time constants of encoders and camera, and the first less the second."""
    names = [ENCODER, CAMERA, DIFFERENCE]
    if len(events) < MIN_EVENTS:
        return undetermined(
            names, f"{len(events)} straight starts and stops on hard ground: {MIN_EVENTS} are needed"
        )
    fits = []
    for slips, speeds in (
        (True, [event.wheels for event in events]),
        (False, [event.camera for event in events]),
    ):
        signals = []  # of each event speeds behind the accelerometer's own lag, and on a grid what may explain them
        for event, (time_s, speed_mps) in zip(events, speeds, strict=True):
            gained = cumulative_trapezoid(event.accel_mps2, event.time_s, initial=0.0)
            edge = max(len(time_s) // 8, 1)
            first, last = speed_mps[:edge].mean(), speed_mps[-edge:].mean()
            ramp = np.linspace(0.0, 1.0, len(gained))
            slip = np.abs(first + gained + (last - first - gained[-1]) * ramp) * event.accel_mps2
            columns = np.array([event.time_s, gained, event.time_s - event.time_s[0], slip])
            signals.append((time_s, low_passed(time_s, speed_mps, REFERENCE_LAG_S, LEVEL_S), columns))
        number = np.repeat(np.arange(len(events)), [len(time_s) for time_s, _ in speeds])
        fits.append(identify(partial(_residual, signals, slips), [LAG], number))
    encoder, camera = ((float(fit.value[0]), fit.influence[:, 0]) for fit in fits)
    if max(encoder[0], camera[0]) > 0.95 * MAX_LAG_S:
        return undetermined(
            names, f"speeds lag by more than {MAX_LAG_S:g} s: bring the loggers' clocks together first"
        )
    runs, n, found = tuple(dict.fromkeys(event.run_id for event in events)), len(events), []
    difference = encoder[0] - camera[0], encoder[1] - camera[1]
    for name, (value, moved) in zip(names, (encoder, camera, difference), strict=True):
        std = math.sqrt((n - 1) / n * float(moved @ moved))
        half = float(half_width(std, n - 2, bounded=STAMP_S))
        low = value - half if name == DIFFERENCE else max(value - half, 0.0)
        found.append(Finding(name, value, low, value + half, n, "starts and stops", runs, TOTAL))
    return found


def _residual(signals: Sequence[tuple[Array, Array, Array]], slips: bool, lag_s: Array) -> Array:
    """Return the speeds less what level, gain and offset of each event explain at a lag, and one slip of all.

    Of each event ``signals`` are stamps and speed (n,) and, on a grid, time, what the acceleration gained, time of the
    event, and slip's part but for its factor (4, m).
    """
    slip, left = [], []
    for time_s, speed, (grid_s, *columns) in signals:
        gained, ramp, own = (
            np.interp(time_s, grid_s, low_passed(grid_s, column, lag_s[0], LEVEL_S)) for column in columns
        )
        linear, both = np.column_stack([np.ones(len(ramp)), gained, ramp]), np.column_stack([own, speed])
        both -= linear @ np.linalg.lstsq(linear, both, rcond=None)[0]
        slip.append(both[:, 0])
        left.append(both[:, 1])
    one, other = np.concatenate(slip), np.concatenate(left)
    return np.asarray(other - one * (one @ other) / (one @ one)) if slips else other
