"""The truth of a simulated run, in the states of a filter.

A filter's inputs come behind one low-pass (``terrain.estimation.table``), so what it estimates is the
motion behind that low-pass.  It is judged against the truth behind the same one: else every ramp of 1 m/s^2
would count 5 cm/s of known delay as an error.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import cumulative_trapezoid

from terrain.errors import DataError
from terrain.estimation.resampling import low_pass
from terrain.kinematics.logged_wheels import true_slip, wheel_and_ground_speed
from terrain.records import Array, RunLog, StateTrack, Stream
from terrain.robots import Robot
from terrain.slip import slip_ratio

LONGEST_STEP_S = 0.1
"""A longer step in the truth is a gap."""


def true_states(
    run: RunLog, track: StateTrack, robot: Robot, time_constant_s: float, initial_yaw_rad: float = 0.0
) -> Array | None:
    """Return the truth (n, d) at each instant of a track, or None where the log has none.

    States that the truth does not know (an effective track) are NaN, and so is what lies outside its time.

    Parameters
    ----------
    run : log with the stream ``truth`` as ``terrain.simulation`` writes it
    track : of a filter on that log
    robot : as the filter was given it: slip speeds are those against its nominal radius
    time_constant_s : of the low-pass on the filter's inputs
    initial_yaw_rad : what the filter calls the heading of the start
    """
    truth = run.streams.get("truth")
    if truth is None:
        return None
    out = np.full(track.mean.shape, np.nan)
    for j, state in enumerate(track.states):
        values = _true_state(truth, state, robot, initial_yaw_rad)
        if values is not None and (known := np.isfinite(values)).any():
            time_s = truth.time_s[known]
            smooth = low_pass(time_s, values[known], time_constant_s, LONGEST_STEP_S)
            out[:, j] = np.interp(track.time_s, time_s, smooth, left=np.nan, right=np.nan)
    return out


def lagged_slip(truth: Stream, robot: Robot, time_constant_s: float) -> tuple[Array, Array]:
    """Return the true slip ratio and speed over ground of each wheel, both (n, wheels), behind a low-pass.

    Of slip between speeds that come behind it, this is the best that can be estimated.

    Parameters
    ----------
    truth : stream as ``terrain.simulation`` writes it
    robot : gives the nominal radius and the wheels' places
    time_constant_s : of the low-pass on the filter's inputs
    """
    wheel_speed, ground = (
        np.column_stack(
            [low_pass(truth.time_s, wheel, time_constant_s, LONGEST_STEP_S) for wheel in speeds.T]
        )
        for speeds in wheel_and_ground_speed(truth, robot)
    )
    return slip_ratio(wheel_speed, ground), ground


def lagged_slip_at(run: RunLog, robot: Robot, time_s: Array) -> Array:
    """Return :func:`lagged_slip` (n, wheels) of a run behind its encoders' low-pass, at some instants."""
    truth = run.streams["truth"]
    slip, _ = lagged_slip(truth, robot, robot.encoder_lag_s)
    return np.column_stack([np.interp(time_s, truth.time_s, wheel) for wheel in slip.T])


def true_slip_at(run: RunLog, robot: Robot, time_s: Array) -> Array:
    """Return the true slip (n, wheels), positive in traction, from some instants on; NaN without a truth."""
    truth = run.streams.get("truth")
    if truth is None:
        return np.full((len(time_s), len(robot.wheels)), np.nan)
    at = np.clip(np.searchsorted(truth.time_s, time_s), 0, len(truth) - 1)
    return true_slip(truth, robot.wheels)[at]


def _true_state(truth: Stream, state: str, robot: Robot, initial_yaw_rad: float) -> Array | None:
    if state == "yaw_rad":
        yaw = np.unwrap(truth.channel("yaw_rad"))
        return np.asarray(yaw - yaw[0] + initial_yaw_rad)
    if state in truth.channels:
        return truth.channel(state)
    if state == "gyro_bias_radps" and "gyro_bias_z_radps" in truth.channels:
        offset = robot.completed.sensors.gyro_bias_z_radps
        return np.asarray(truth.channel("gyro_bias_z_radps") - offset)
    if state == "imu_yaw_offset_rad" and "gyro_bias_z_radps" in truth.channels:
        bias = truth.channel("gyro_bias_z_radps") - robot.completed.sensors.gyro_bias_z_radps
        return np.asarray(cumulative_trapezoid(bias, truth.time_s, initial=0.0))
    if state.startswith("slip_speed_"):
        wheel_speed, along = wheel_and_ground_speed(truth, robot)
        wheel = state.split("_")[2]
        if wheel not in robot.wheels:
            raise DataError(f"state {state!r} is of a wheel that robot {robot.name} does not have")
        return np.asarray((wheel_speed - along)[:, robot.wheels.index(wheel)])
    return None
