"""Whether a filter's covariance fits its errors: squared innovations, and errors where the truth is known.

NIS nu' S^-1 nu and NEES e' P^-1 e follow a chi-square law with as many degrees of freedom as nu and e have
entries (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4):
on average one a degree.  Over that, the filter is overconfident; under it, conservative.

A filter's inputs come behind one low-pass (:mod:`terrain.estimation.feed`), so what it estimates is the motion behind
that low-pass, and it is judged against the truth behind the same one: else every ramp of 1 m/s^2 would count 5 cm/s
of known delay as an error.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.special import chdtri

from terrain.angles import wrapped
from terrain.errors import DataError
from terrain.estimation.filter import DEFAULT_SETTINGS, FilterModel, process_noise
from terrain.kinematics.logged_wheels import true_slip, wheel_and_ground_speed
from terrain.records import GATED, USED, Array, RunLog, StateTrack
from terrain.robots import Robot
from terrain.signals import low_passed
from terrain.slip import slip_ratio

OUTSIDE = 0.05  #: Probability outside the bounds, half on each side.
#: A sensor of which a larger fraction is gated does not have the noise of the model: 0.01 % is expected.
MOST_GATED = 0.01
LONGEST_STEP_S = 0.1  #: A longer step in the truth is a gap.


class ConsistencyVerdict(StrEnum):
    """How squared errors compare with their chi-square bounds; unknown where there are none."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    UNKNOWN = "unknown"


class Consistency(NamedTuple):
    """How the errors of one sensor, or of one group of states, agree with the covariance of the filter."""

    name: str
    n: int
    n_independent: float  #: the effective number of independent values among the n
    mean_per_dof: float
    gated_fraction: float
    verdict: ConsistencyVerdict


def consistency_report(track: StateTrack, truth: Array | None = None) -> dict[str, tuple[Consistency, ...]]:
    """Judge a track by its innovations, and by the truth (n, d) of its states where there is one, NaN where unknown.

    Returns the NIS of each of the ``sensors``, and the NEES of each group of ``states`` of which the truth is known.
    The mean per degree of freedom is judged by the two-sided 95 % bounds for as many independent values as there are.
    States are grouped as their names are (``speed`` has x and y), and all that are known together are ``all``.
    ``DataError`` where the shape of the truth does not fit.
    """
    sensors, states = [], []
    for k, name in enumerate(track.sensors):
        used, gated = track.use[:, k] == USED, int((track.use[:, k] == GATED).sum())
        gated_fraction = gated / max(int(used.sum()) + gated, 1)
        sensors.append(_judge(name, track.nis[used, k], track.nis_dof[used, k], gated_fraction))
    if truth is not None:
        groups: dict[str, list[str]] = {}
        known = np.array(track.states)[np.isfinite(_fitting(truth, track)).any(axis=0)].tolist()
        for state in known:  # without axis, number and unit
            groups.setdefault(re.sub(r"(_[xyz\d])?_[a-z0-9]+$", "", state), []).append(state)
        if len(groups) > 1:
            groups["all"] = known
        for name, members in groups.items():
            squares = nees(track, truth, members)
            squares = squares[np.isfinite(squares)]
            states.append(_judge(name, squares, np.full(squares.size, len(members)), 0.0))
    return {"sensors": tuple(sensors), "states": tuple(states)}


def nees(track: StateTrack, truth: Array, states: Sequence[str] | None = None) -> Array:
    """Return the squared error over its covariance (n,) of all states, or some; NaN where their truth is.

    Errors of angles (states in ``rad``) are wrapped.  The truth (n, d) is of all states; ``DataError`` where its shape
    does not fit, or there is no such state.
    """
    states = track.states if states is None else tuple(states)
    for state in states:
        if state not in track.states:
            raise DataError(f"the track has no state {state!r}: it has {', '.join(track.states)}")
    index = list(map(track.states.index, states))
    error = (track.mean - _fitting(truth, track))[:, index]
    is_angle = np.char.endswith(states, "_rad")
    error[:, is_angle] = wrapped(error[:, is_angle])
    solved = np.linalg.solve(track.cov[:, index][:, :, index], error[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error, solved))


def _fitting(truth: Array, track: StateTrack) -> Array:
    values = np.asarray(truth, dtype=np.float64)
    if values.shape != track.mean.shape:
        raise DataError(f"truth has shape {values.shape}, {track.mean.shape} is needed")
    return values


def _judge(name: str, squares: Array, dof: Array, gated_fraction: float) -> Consistency:
    """Compare squares (n,), each of so many degrees of freedom, with chi-square.

    As many independent values say as much on the mean as n over the autocorrelation time.
    """
    n = squares.size
    if not n:
        verdict = ConsistencyVerdict.OVERCONFIDENT if gated_fraction else ConsistencyVerdict.UNKNOWN
        return Consistency(name, 0, 0.0, np.nan, gated_fraction, verdict)
    values, n_independent = squares / dof, float(n)
    spectrum = np.fft.rfft(values - values.mean(), 2 * n)
    correlation = np.fft.irfft(spectrum * spectrum.conj())[:n]
    if correlation[0] > 0:
        rho = correlation / correlation[0]
        negative = np.flatnonzero(rho <= 0)
        end = int(negative[0]) if negative.size else n
        n_independent = float(n / max(1.0, 1 + 2 * rho[1:end].sum()))
    total, mean = n_independent * dof.mean(), float(squares.sum() / dof.sum())
    low, high = chdtri(total, [1 - OUTSIDE / 2, OUTSIDE / 2]) / total
    verdict = ConsistencyVerdict.CONSERVATIVE if mean < low else ConsistencyVerdict.CONSISTENT
    if mean > high or gated_fraction > MOST_GATED:
        verdict = ConsistencyVerdict.OVERCONFIDENT
    return Consistency(name, n, n_independent, mean, gated_fraction, verdict)


def innovations(
    model: FilterModel,
    track: StateTrack,
    z: Array,
    variance: Array | None = None,
    walk: Array | None = None,
    inputs: Array | None = None,
) -> dict[str, tuple[Array, Array]]:
    """Return by row the innovation (n,) at each instant, and the standard deviation that was expected of it.

    That is ``z - h(x)`` and ``sqrt(diag(H P H' + R))`` with what is predicted from the instant before; NaN where
    nothing was measured, at the first instant and after a gap.  Measurements (n, m), and what changes from sample to
    sample as of :func:`~terrain.estimation.filter.run_filter`, are those at the instants of the track.
    """
    n, d, m = len(track.time_s), len(model.states), len(model.rows)
    value, std = np.full((2, n, m), np.nan)
    variance = np.broadcast_to(model.measurement_variance if variance is None else variance, (n, m))
    x_next, z_hat, nothing = np.zeros(d), np.zeros(m), np.zeros(len(model.inputs))
    for k in range(1, n):
        dt_s = track.time_s[k] - track.time_s[k - 1]
        if dt_s > DEFAULT_SETTINGS.max_gap_s:
            continue
        f, h = np.zeros((d, d)), np.zeros((m, d))
        params = np.append(model.params, nothing if inputs is None else inputs[k])
        model.propagate(np.array(track.mean[k - 1]), dt_s, params, x_next, f)
        model.observe(x_next, params, z_hat, h)
        noise = process_noise(model, dt_s, 0.0 if walk is None else walk[k])
        predicted = f @ track.cov[k - 1] @ f.T + noise
        value[k] = z[k] - z_hat
        std[k] = np.sqrt(np.einsum("ij,jk,ik->i", h, predicted, h) + variance[k])
    is_angle = np.isin(model.rows, model.angle_rows)
    value[:, is_angle] = wrapped(value[:, is_angle])
    std[np.isnan(value)] = np.nan
    return dict(zip(model.rows, zip(value.T, std.T, strict=True), strict=True))


def true_states(
    run: RunLog, track: StateTrack, robot: Robot, time_constant_s: float, initial_yaw_rad: float = 0.0
) -> Array | None:
    """Return the truth (n, d) at each instant of a track, or None where the log has no stream ``truth``.

    States that the truth does not know (an effective track) are NaN, and so is what lies outside its time.

    Parameters
    ----------
    robot : as the filter was given it: slip speeds are those against its nominal radius
    time_constant_s : of the low-pass on the filter's inputs
    initial_yaw_rad : what the filter calls the heading of the start
    """
    truth = run.streams.get("truth")
    if truth is None:
        return None
    true = np.full(track.mean.shape, np.nan)
    for j, state in enumerate(track.states):
        if state == "yaw_rad":
            yaw = np.unwrap(truth.channel("yaw_rad"))
            values = yaw - yaw[0] + initial_yaw_rad
        elif state in truth.channels:
            values = truth.channel(state)
        elif state in ("gyro_bias_radps", "imu_yaw_offset_rad") and "gyro_bias_z_radps" in truth.channels:
            values = truth.channel("gyro_bias_z_radps") - robot.completed.sensors.gyro_bias_z_radps
            if state == "imu_yaw_offset_rad":
                values = cumulative_trapezoid(values, truth.time_s, initial=0.0)
        elif state.startswith("slip_speed_"):
            wheel = state.split("_")[2]
            if wheel not in robot.wheels:
                raise DataError(f"state {state!r} is of a wheel that robot {robot.name} does not have")
            wheel_speed, along = wheel_and_ground_speed(truth, robot)
            values = (wheel_speed - along)[:, robot.wheels.index(wheel)]
        else:
            continue
        if (known := np.isfinite(values)).any():
            time_s = truth.time_s[known]
            smooth = low_passed(time_s, values[known], time_constant_s, LONGEST_STEP_S)
            true[:, j] = np.interp(track.time_s, time_s, smooth, left=np.nan, right=np.nan)
    return true


def lagged_slip(run: RunLog, robot: Robot) -> tuple[Array, Array]:
    """Return the true slip ratio and speed over ground of each wheel, both (n, wheels), on the truth's clock.

    Behind the low-pass of the encoders: of slip between speeds that come behind it, this is the best that can be
    estimated.
    """
    truth = run.streams["truth"]
    wheel_speed, ground = wheel_and_ground_speed(truth, robot)
    for speeds in (wheel_speed, ground):
        for wheel in speeds.T:
            wheel[:] = low_passed(truth.time_s, wheel.copy(), robot.encoder_lag_s, LONGEST_STEP_S)
    return slip_ratio(wheel_speed, ground), ground


def lagged_slip_at(run: RunLog, robot: Robot, time_s: Array) -> Array:
    """Return the true slip ratio of :func:`lagged_slip` (n, wheels) at some instants."""
    slip, _ = lagged_slip(run, robot)
    return np.column_stack([np.interp(time_s, run.streams["truth"].time_s, wheel) for wheel in slip.T])


def true_slip_at(run: RunLog, wheels: Sequence[str], time_s: Array) -> Array:
    """Return the true slip (n, wheels), positive in traction, from some instants on; NaN without a truth."""
    truth = run.streams.get("truth")
    names = {f"wheel_{wheel}_radps" for wheel in wheels}
    if truth is None or not names or not names <= set(truth.channels):
        return np.full((len(time_s), len(wheels)), np.nan)
    at = np.clip(np.searchsorted(truth.time_s, time_s), 0, len(truth) - 1)
    return true_slip(truth, wheels)[at]
