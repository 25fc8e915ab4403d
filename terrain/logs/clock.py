"""Whether two loggers of one run keep the same clock, and the wheel stream brought onto that of the IMU.

The gyro and the wheels both see the robot turn, each on its own clock::

    t_imu = t_ref + (1 + rate) (t_wheels - t_ref) + offset
    gyro_z(t_imu) = gain (v_right - v_left)(t_wheels) / track + bias + noise

with ``t_ref`` the first wheel sample.  Both signals pass the same Gaussian low-pass, as wide as a period of
the slower stream and 0.1 s at least, and :func:`terrain.signals.delay` finds offset and rate.
The search is bounded: the gain is positive (a skid-steer robot turns less than its wheels indicate, never
more), offset and rate lie within a range; so a periodic manoeuvre cannot lock it on to a mirror image.

Standard deviations are those of least squares under residuals as correlated as they are found to be; in
simulated runs of a minute they are right within a fifth, in runs of 15 s about a third too small.

A delay between wheel and gyro that the robot itself has (drive train, tyre, gyro filter) looks exactly like
an offset and is part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.records import RunLog, Stream
from terrain.signals import DelayStatus, Pair, delay, smooth_on_grid

MIN_SAMPLES = 30  #: Fewer samples of the slower stream tell no correlation from chance.
#: Width of the low-pass under fast streams: no robot turns faster, and a finer search only takes longer.
MIN_SIGMA_S = 0.1
#: A stream that lasts this many times as long as its samples do is mostly gap, and is not compared.
MAX_GAP_SHARE = 20.0
#: Grid of the smooth gyro, in steps a period of the slower stream: fine enough for straight lines between.
MIN_GYRO_STEPS = 8
#: The loggers of a run are started together; the published runs that tell it differ by up to 1.7 s.
MAX_OFFSET_S = 2.0
#: A sampling rate that is stated and not measured may be off by a few per cent (the published BorealTC files of one
#: run differ in length by up to 4 %); a quartz is 1000 times better.
MAX_RATE = 0.05

MIN_YAW_RATE_STD_RADPS = 0.02
"""Spread of the wheel difference over the track that counts as turning.

Two steps of an encoder that resolves 0.008 m/s, on a track of 0.57 m, come to 0.03 rad/s."""

#: The gain must stand this far above its own error; the best of many shifts of mere noise reaches 4.
MIN_GAIN_SIGMAS = 6.0
#: Below this most of what the gyro sees is not in the wheels, and the model of one gain does not hold.
MIN_CORRELATION = 0.5
#: With a larger standard deviation the rate is indistinguishable from that of any stated sampling rate.
RATE_KNOWN = 0.01
#: Share of the variance by which a rival must be worse even when the best peak explains nearly everything.
RIVAL_FLOOR = 0.05

#: Two peaks of the grid that lie closer than this many widths of the low-pass are one.
SAME_PEAK_SIGMAS = 4.0
#: Between the clocks of wheels and IMU: in more, a robot that begins to turn is seen to turn without wheels, and the
#: effective track is wrong by as much as its turns are short.
MAX_APART_S = 0.1


class ClockEstimate(NamedTuple):
    """How the clock of the wheels maps to the clock of the IMU.

    ``t_imu = reference_s + (1 + rate) (t_wheels - reference_s) + offset_s``.  ``status`` is

    - ``estimated``: all numbers stand;
    - ``offset only``: the turns are too few or too close together to tell the rate, which is NaN; the offset
      is the mean shift, and its standard deviation covers the rates within the bounds;
    - ``not excited``: the robot hardly turns, or gyro and wheels do not see the same turns;
    - ``ambiguous``: another shift, or a mirrored gain, fits about as well;
    - ``at bound``: the best fit lies on the edge of the search.

    Numbers are NaN in the last three cases, except for the correlation of the best fit where there is one.
    """

    offset_s: float
    offset_std_s: float
    rate: float
    rate_std: float
    gain: float
    correlation: float
    status: str
    reference_s: float

    @property
    def is_known(self) -> bool:
        """Whether the offset was found."""
        return self.status in ("estimated", "offset only")


def yaw_rate_pair(run: RunLog, track_m: float) -> tuple[Pair, float, float] | None:
    """Return the yaw rates of wheels and gyro, low-passed alike, or None where too few samples support them.

    Further returned are the time of the first point of the gyro's grid and the width of the low-pass.
    """
    try:
        wheels, imu = run.streams["wheels"], run.streams["imu"]
        left_mps, right_mps = wheels.channel("speed_left_mps"), wheels.channel("speed_right_mps")
        gyro_radps = imu.channel("gyro_z_radps")
    except KeyError as error:
        raise DataError(f"{run.run_id}: clocks cannot be compared without {error.args[0]}") from error
    if any(len(stream) * MAX_GAP_SHARE / stream.rate_hz < stream.duration_s for stream in (wheels, imu)):
        return None
    sigma_s = max(1.0 / wheels.rate_hz, 1.0 / imu.rate_hz, MIN_SIGMA_S)
    n_steps = int(np.ceil(sigma_s * wheels.rate_hz))
    wheels_s, wheels_radps = smooth_on_grid(wheels.time_s, (right_mps - left_mps) / track_m, sigma_s, n_steps)
    supported = np.flatnonzero(np.isfinite(wheels_radps))[::n_steps]
    n_steps = max(int(np.ceil(sigma_s * imu.rate_hz)), MIN_GYRO_STEPS)
    gyro_s, gyro = smooth_on_grid(imu.time_s, gyro_radps, sigma_s, n_steps)
    if supported.size < MIN_SAMPLES or np.isfinite(gyro).sum() < MIN_SAMPLES:
        return None
    step_s, start_s = sigma_s / n_steps, float(gyro_s[0])
    time_s = wheels_s[supported] - start_s
    return (
        Pair(time_s, wheels_radps[supported], step_s, gyro, np.gradient(gyro, step_s), 0.0),
        start_s,
        sigma_s,
    )


def estimate_clock(run: RunLog, *, track_m: float) -> ClockEstimate:
    """Estimate offset and rate between the clocks of the streams ``wheels`` and ``imu`` of a run.

    Parameters
    ----------
    run : run log with ``imu`` (``gyro_z_radps``) and ``wheels`` (``speed_left_mps``, ``speed_right_mps``)
    track_m : distance of the wheels of the two sides; it scales the gain and what counts as turning

    Raises
    ------
    DataError
        if the run lacks one of these channels.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> time_s = np.arange(0.0, 60.0, 0.02)
    >>> yaw_rate = 0.4 * np.sin(time_s + 0.02 * time_s**2)
    >>> gyro = Stream(time_s + 0.3, yaw_rate[:, None], ("gyro_z_radps",))
    >>> speeds = np.column_stack([1 - yaw_rate / 3, 1 + yaw_rate / 3])
    >>> wheels = Stream(time_s[::5], speeds[::5], ("speed_left_mps", "speed_right_mps"))
    >>> found = estimate_clock(RunLog("SNOW_01", "husky", {"imu": gyro, "wheels": wheels}), track_m=0.57)
    >>> found.status.value, round(found.offset_s, 2), abs(found.rate) < 1e-3
    ('estimated', 0.3, True)
    """
    smooth = yaw_rate_pair(run, track_m)
    reference_s = float(run.streams["wheels"].time_s[0])

    def none(status: DelayStatus, correlation: float = np.nan) -> ClockEstimate:
        return ClockEstimate(*5 * (np.nan,), correlation, status, reference_s)

    if smooth is None:
        return none(DelayStatus.NOT_EXCITED)
    pair, start_s, sigma_s = smooth
    turning = (pair.measured - np.mean(pair.measured)) ** 2
    if np.sqrt(np.mean(turning)) < MIN_YAW_RATE_STD_RADPS:
        return none(DelayStatus.NOT_EXCITED)
    turning[turning < MIN_YAW_RATE_STD_RADPS**2] = 0.0
    # Lag and rate hardly trade against each other when the lag refers to the centre of the turning.
    centre_s = float(np.average(pair.time_s, weights=turning))
    pair, lever_s = pair._replace(middle_s=centre_s), centre_s + start_s - reference_s
    # Where all rates within the bounds move the turns by less than the low-pass smears them, none is tried.
    spread_s = float(np.sqrt(np.average((pair.time_s - centre_s) ** 2, weights=turning)))
    reach_s = float(np.max(np.abs(pair.time_s - centre_s)))
    for rate_bound in (MAX_RATE, 0.0) if MAX_RATE * spread_s > sigma_s else (0.0,):
        n_rates = int(np.ceil(rate_bound * reach_s / sigma_s))
        furthest_s = MAX_OFFSET_S + rate_bound * lever_s
        n_lags = int(np.ceil(furthest_s / sigma_s))
        best = delay(
            pair,
            np.linspace(-furthest_s, furthest_s, 2 * n_lags + 1),
            np.linspace(-rate_bound, rate_bound, 2 * n_rates + 1).tolist(),
            same_peak_s=SAME_PEAK_SIGMAS * sigma_s,
            floor=RIVAL_FLOOR,
            within=lambda lag_s, rate: np.abs(lag_s - rate * lever_s) <= MAX_OFFSET_S * (1.0 + 1e-9),
            mirrored=True,
            rate_max=MAX_RATE,
            rate_stays=rate_bound == 0.0,
            at_bounds=True,
            memory_s=None,
            min_rows=MIN_SAMPLES // 2,
        )
        if (fit := best.fit) is not None and np.sqrt(fit.cov[1, 1]) <= RATE_KNOWN:
            break
    if fit is None:
        return none(DelayStatus.NOT_EXCITED)
    if fit.correlation < MIN_CORRELATION or fit.gain < MIN_GAIN_SIGMAS * fit.gain_std:
        return none(DelayStatus.NOT_EXCITED, fit.correlation)
    offset_s = -fit.lag_s + fit.rate * lever_s
    if abs(offset_s) > 0.98 * MAX_OFFSET_S or abs(fit.rate) > 0.98 * MAX_RATE:
        return none(DelayStatus.AT_BOUND, fit.correlation)
    if best.status is DelayStatus.AMBIGUOUS:
        return none(DelayStatus.AMBIGUOUS, fit.correlation)
    # of the gyro over the wheels, as the model has it, where the fit is that of the wheels over the gyro
    gain = fit.correlation**2 / fit.gain
    if rate_bound == 0.0:
        std_s = float(np.hypot(np.sqrt(fit.cov[0, 0]), lever_s * MAX_RATE / np.sqrt(3.0)))
        rates, status = (np.nan, np.nan), DelayStatus.OFFSET_ONLY
    else:
        to_start = np.array([1.0, -lever_s])
        std_s, status = float(np.sqrt(to_start @ fit.cov @ to_start)), DelayStatus.ESTIMATED
        rates = -fit.rate, float(np.sqrt(fit.cov[1, 1]))
    return ClockEstimate(offset_s, std_s, *rates, gain, fit.correlation, status, reference_s)


def align(run: RunLog, estimate: ClockEstimate) -> RunLog:
    """Return the run with its wheel stream on the clock of the IMU, which is the clock of the run.

    With the status ``offset only`` the times are shifted and not stretched; where the clocks could not be
    compared the run comes back as it is.

    Examples
    --------
    >>> wheels = Stream([10.0, 11.0, 12.0], [[1.0]] * 3, ("speed_left_mps",))
    >>> estimate = ClockEstimate(0.5, 0.01, 0.02, 0.001, 0.6, 0.9, "estimated", 10.0)
    >>> align(RunLog("SNOW_01", "husky", {"wheels": wheels}), estimate).streams["wheels"].time_s
    array([10.5 , 11.52, 12.54])
    """
    if not estimate.is_known:
        return run
    wheels = run.streams["wheels"]
    rate = 0.0 if np.isnan(estimate.rate) else estimate.rate
    since_s = wheels.time_s - estimate.reference_s
    time_s = estimate.reference_s + estimate.offset_s + (1.0 + rate) * since_s
    return replace(run, streams={**run.streams, "wheels": Stream(time_s, wheels.values, wheels.channels)})


def offsets_apart_s(runs: Sequence[RunLog], track_m: Callable[[RunLog], float]) -> dict[str, float]:
    """Return by run the offset of the clocks of wheels and IMU, of those runs where they clearly differ."""
    offsets_s = {}
    for run in runs:
        try:
            clock = estimate_clock(run, track_m=track_m(run))
        except DataError:  # no gyro, or no speeds of two sides
            continue
        if clock.is_known and abs(clock.offset_s) > max(MAX_APART_S, 3.0 * clock.offset_std_s):
            offsets_s[run.run_id] = clock.offset_s
    return offsets_s
