"""Windows to what the ground answers to the wheels: turning, shaking, currents and slip, and what they depend on.

Each quantity is one number a window, and comes with the numbers of the driving that its law is linear in.  With the
mean circumferential speeds l and r of the two sides, ``m = (l + r) / 2`` and ``d = r - l``:

- *turn*: mean yaw rate, of ``1, d, m, d |d|, d |m|``; without two sides of the speed of each wheel.  On a skid-steered
  robot ``d`` over the yaw rate is the effective track, which slip widens (Mandow et al. 2007, Experimental kinematics
  for wheeled skid-steer mobile robots);
- *shake*: logarithm of the rms of horizontal and vertical acceleration and of roll and pitch rate between 1 and 10 and
  between 10 and 24 Hz, where the rate allows, of speed (logarithm), of how much is turned, and of their product: in
  bands of fixed frequencies, so that loggers of several rates compare;
- *current*: magnitude of all motors together, of its ripple, and of the right side over the left, of speeds and
  acceleration;
- *slip*: each channel's mean, of speed, of how much is turned, and of which side is the outer one.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from features.statistics import MIN_DEFINED_FRACTION
from features.windows import rows_of_sets, wheel_stream
from terrain.classify.answers import Observed
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows

BANDS_HZ = ((1.0, 10.0), (10.0, 24.0))
MAX_BAND = 0.52  #: Of the rate: up to there a band may reach. A logger of 20 Hz has the first.
AXES = {"horizontal": ("accel_x", "accel_y"), "vertical": ("accel_z",), "rocking": ("gyro_x", "gyro_y")}
#: Speed, current and squared acceleration or rate under a logarithm: what a sensor resolves.
MIN_SPEED_MPS, MIN_CURRENT_A, MIN_POWER = 0.05, 0.1, 1e-8


def answers_of(windows: Windows) -> Observed | None:
    """Return what the ground answers in each window; None where no wheel speed is measured, or nothing beside.

    Examples
    --------
    >>> wheels, imu = np.array([[[0.5] * 4, [0.7] * 4]]), np.array([[[0.3] * 4]])
    >>> channels = {"wheels": ("speed_left_mps", "speed_right_mps"), "imu": ("gyro_z_radps",)}
    >>> rates = {"wheels": 2.0, "imu": 2.0}
    >>> windows = Windows({"wheels": wheels, "imu": imu}, channels, rates, 2.0, np.zeros(1), *[np.zeros(1)] * 2)
    >>> observed = answers_of(windows)
    >>> observed.quantities, observed.response.round(2).tolist(), observed.driving.round(2).tolist()
    (('turn',), [[0.3]], [[[1.0, 0.2, 0.6, 0.04, 0.12]]])
    """
    stream = wheel_stream(windows.channels)
    if stream is None:
        return None
    names = windows.channels[stream]
    places = rows_of_sets(stream, tuple(names), frozenset({"wheels"}))
    speeds = np.ascontiguousarray(windows.values[stream][:, list(places)])  # a window adds up as among many
    mean, ones = speeds.mean(axis=2), np.ones(len(windows))
    sides = _sides([names[i] for i in places])
    time_s = (np.arange(speeds.shape[2]) - 0.5 * (speeds.shape[2] - 1)) / windows.rate_hz[stream]
    if all(sides):
        left, right = (mean[:, side].mean(axis=1) for side in sides)
        m, d = 0.5 * (left + right), right - left
        turning = [ones, d, m, d * np.abs(d), d * np.abs(m)]
        forward = np.where(m < 0.0, -1.0, 1.0)
        gain_mps2 = forward * (speeds.mean(axis=1) * time_s).sum(axis=1) / (time_s @ time_s)
        both = np.abs(left) + np.abs(right) + MIN_SPEED_MPS
        turn_ratio, outer = np.abs(d) / both, (np.abs(right) - np.abs(left)) / both
    else:
        m, d = np.abs(mean).mean(axis=1), np.ptp(np.abs(mean), axis=1)
        turning = [ones, *mean.T]
        gain_mps2 = (np.abs(speeds).mean(axis=1) * time_s).sum(axis=1) / (time_s @ time_s)
        outer = turn_ratio = d / (np.abs(mean).sum(axis=1) + MIN_SPEED_MPS)
    fastest = np.log10(np.abs(mean).max(axis=1) + MIN_SPEED_MPS)
    shaking = [ones, fastest, turn_ratio, fastest * turn_ratio]
    answers: dict[str, tuple[Array, list[Array]]] = {}
    for each, channels in windows.channels.items():
        sets = [signal_set_of(each, name) for name in channels]
        values, rate_hz = windows.values[each], windows.rate_hz[each]
        if "gyro_z_radps" in channels and "imu" in sets:
            answers["turn"] = values[:, channels.index("gyro_z_radps")].mean(axis=1), turning
        bands = [band for band in BANDS_HZ if band[1] <= MAX_BAND * rate_hz]
        axes = {
            kind: rows
            for kind, prefixes in AXES.items()
            if (rows := [i for i, name in enumerate(channels) if name.startswith(prefixes)])
        }
        if "imu" in sets and bands and axes:
            taper, of_bands = _spectrum(values.shape[2], rate_hz)
            lines = np.fft.rfft((values - values.mean(axis=2, keepdims=True)) * taper, axis=2)
            power = lines.real**2 + lines.imag**2
            for (low, high), band in zip(bands, of_bands, strict=False):
                within = power[:, :, band].sum(axis=2)
                for kind, rows in axes.items():
                    name = f"shake, {kind}, {low:g} to {high:g} Hz"
                    answers[name] = 0.5 * np.log10(within[:, rows].sum(axis=1) + MIN_POWER), shaking
        currents = [i for i, of in enumerate(sets) if of == "currents"]
        if currents:
            magnitude = np.ascontiguousarray(np.abs(values[:, currents]))
            load = magnitude.mean(axis=2)
            answers["current"] = load.sum(axis=1), [ones, np.abs(m), np.abs(d), gain_mps2, turn_ratio]
            ripple = np.log10(np.sqrt(magnitude.var(axis=2).sum(axis=1)) + MIN_CURRENT_A)
            answers["current, ripple"] = ripple, shaking
            motors = _sides([channels[i] for i in currents])
            if all(sides) and all(motors):
                left, right = (load[:, side].sum(axis=1) for side in motors)
                answers["current, sides"] = right - left, [ones, d, d * forward, m]
        for i in [i for i, of in enumerate(sets) if of == "slip"]:
            known = np.isfinite(values[:, i])
            share, total = known.mean(axis=1), np.where(known, values[:, i], 0.0).mean(axis=1)
            undefined, enough = np.full(len(windows), np.nan), share >= MIN_DEFINED_FRACTION
            slip = np.divide(total, share, out=undefined, where=enough)
            answers[f"slip, {channels[i].split('_')[1]}"] = slip, [ones, fastest, turn_ratio, outer]
    if not answers:
        return None
    driving = np.zeros((len(windows), len(answers), max(len(of) for _, of in answers.values())))
    for number, (_, of) in enumerate(answers.values()):
        driving[:, number, : len(of)] = np.column_stack(of)
    return Observed(tuple(answers), np.column_stack([response for response, _ in answers.values()]), driving)


def _sides(names: list[str]) -> list[list[int]]:
    """Return the places of the channels of the left, and of the right side."""
    return [[i for i, name in enumerate(names) if side in name.split("_")] for side in ("left", "right")]


@lru_cache(maxsize=64)
def _spectrum(n: int, rate_hz: float) -> tuple[Array, list[slice]]:
    """Return the taper (n,), scaled so that squared lines add up to a variance, and the lines of each band."""
    taper, hz = np.hanning(n), np.fft.rfftfreq(n, 1.0 / rate_hz)
    bands = [slice(*np.searchsorted(hz, band).tolist()) for band in BANDS_HZ]
    return taper * np.sqrt(2.0 / (n * (taper @ taper))), bands
