"""Channels and features that need more than one channel: norms, totals, left against right, per speed.

Symbols: v the mean speed of the faster wheel over the window (not under ``MIN_SPEED_MPS``), I a motor
current, d = v_right - v_left, w the yaw rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from features.statistics import channel_correlations
from terrain.logs.schema import UNIT_SYMBOLS, signal_set_of, unit_of
from terrain.records import Array

MIN_SPEED_MPS = 0.05  #: Division by speed stops here: below it a wheel reading is mostly quantisation

MIN_WHEEL_DIFFERENCE_MPS = 0.03
"""A smaller wheel difference (rms) does not count as a turn; the yaw rate per wheel difference is NaN."""

N_PARTS = 8  #: Parts of a window over which wheel difference and yaw rate are averaged

_LOG_FLOOR = 1e-4


class Feature(NamedTuple):
    """Name and unit of a feature, and the signal sets it is computed from."""

    name: str
    unit: str
    sets: frozenset[str]

    @property
    def label(self) -> str:
        """Name with its unit, as in tables and plots."""
        return f"{self.name} [{self.unit}]"


def rows_of(channels: Sequence[str], quantity: str) -> list[int]:
    """Return the positions of the channels of one quantity.

    Examples
    --------
    >>> rows_of(("gyro_x_radps", "accel_x_mps2", "gyro_y_radps"), "gyro")
    [0, 2]
    """
    return [i for i, channel in enumerate(channels) if channel.partition("_")[0] == quantity]


def derived_channels(values: Array, channels: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """Return norms of vectors, and total and difference of currents, as further channels.

    ``gyro_norm`` and ``accel_norm`` do not change when the sensor is mounted turned; the difference of
    the currents is right minus left, or largest minus smallest where there are not just these two.

    Parameters
    ----------
    values : (n_windows, n_channels, n_samples)
    channels : their names

    Returns
    -------
    values : (n_windows, n_derived, n_samples)
    channels : their names
    """
    derived: list[Array] = []
    names: list[str] = []
    for quantity in ("gyro", "accel"):
        rows = rows_of(channels, quantity)
        if len(rows) > 1:
            derived.append(np.sqrt(np.sum(values[:, rows] ** 2, axis=1)))
            names.append(f"{quantity}_norm_{unit_of(channels[rows[0]])}")
    rows = rows_of(channels, "current")
    if len(rows) > 1:
        current = values[:, rows]
        sides = left_right(channels, "current")
        derived += [
            current.sum(axis=1),
            values[:, sides[1]] - values[:, sides[0]] if sides else np.ptp(current, axis=1),
        ]
        names += ["current_total_a", "current_difference_a"]
    if not derived:
        return np.empty((values.shape[0], 0, values.shape[2])), ()
    return np.stack(derived, axis=1), tuple(names)


def left_right(channels: Sequence[str], quantity: str) -> tuple[int, int] | None:
    """Return the positions of the left and the right channel of a quantity, None without such a pair."""
    side = {channel.split("_")[1]: i for i, channel in enumerate(channels) if channel.startswith(quantity)}
    return (side["left"], side["right"]) if {"left", "right"} <= set(side) else None


def correlation_features(values: Array, channels: Sequence[str], stream: str) -> tuple[list[Feature], Array]:
    """Return the correlation of each pair of IMU channels, and of each pair of currents.

    Returns
    -------
    features, and their values (n_windows, n_features)
    """
    parts: list[Array] = [np.empty((values.shape[0], 0))]
    for rows, _ in _correlated(channels):
        parts.append(channel_correlations(values[:, rows]))
    return list(_correlations_of(tuple(channels), stream)), np.concatenate(parts, axis=1)


@lru_cache(maxsize=256)
def _correlations_of(channels: tuple[str, ...], stream: str) -> tuple[Feature, ...]:
    """Return the features of :func:`correlation_features`, made once."""
    features: list[Feature] = []
    for rows, signal_set in _correlated(channels):
        short = [channels[i].rpartition("_")[0] for i in rows]
        features += [
            Feature(f"{stream}.{a}~{b}.correlation", "1", frozenset({signal_set}))
            for j, a in enumerate(short)
            for b in short[j + 1 :]
        ]
    return tuple(features)


def _correlated(channels: Sequence[str]) -> list[tuple[list[int], str]]:
    """Return the channels whose pairs are correlated, by signal set."""
    found = []
    for quantities, signal_set in ((("gyro", "accel"), "imu"), (("current",), "currents")):
        rows = [i for quantity in quantities for i in rows_of(channels, quantity)]
        if len(rows) >= 2:
            found.append((rows, signal_set))
    return found


def speed_features(
    values: Mapping[str, Array], channels: Mapping[str, Sequence[str]]
) -> tuple[list[Feature], Array]:
    """Return currents, vibration and yaw rate per wheel speed.

    ``current_per_speed = mean(I) / v``, ``log_drive_effort = log10 mean |sum I v_wheel|``,
    ``log_std_per_speed = log10(std / v)`` of each IMU channel, and the turning-slip measure
    ``yaw_per_wheel_difference = sum(w d) / sum(d d)``, which is one over the track width for wheels
    that do not slip and less the more they do; NaN where the robot does not turn.  The means of w and d
    are taken in eight equal parts of the window, since the two streams have different rates, or in as many
    as the slower stream has samples.

    Returns
    -------
    features, and their values (n_windows, n_features); none without wheel speeds
    """
    wheel_stream = next(
        (
            stream
            for stream, names in channels.items()
            if any(signal_set_of(stream, name) == "wheels" for name in names)
        ),
        None,
    )
    n = len(next(iter(values.values())))
    features: list[Feature] = []
    columns: list[Array] = []
    if wheel_stream is None:
        return features, np.empty((n, 0))
    wheels, wheel_channels = values[wheel_stream], channels[wheel_stream]
    speeds = wheels[:, rows_of(wheel_channels, "speed")]
    fastest_mps = np.maximum(np.abs(speeds).mean(axis=2).max(axis=1), MIN_SPEED_MPS)

    current_rows = rows_of(wheel_channels, "current")
    for i in current_rows:
        name = wheel_channels[i].rpartition("_")[0]
        features.append(
            Feature(f"{wheel_stream}.{name}.per_speed", "A s/m", frozenset({"currents", "wheels"}))
        )
        columns.append(wheels[:, i].mean(axis=1) / fastest_mps)
    if current_rows and len(current_rows) == speeds.shape[1]:
        effort = np.abs(np.sum(wheels[:, current_rows] * speeds, axis=1)).mean(axis=1)
        features.append(
            Feature(f"{wheel_stream}.log_drive_effort", "log10 A m/s", frozenset({"currents", "wheels"}))
        )
        columns.append(np.log10(effort + _LOG_FLOOR))

    for stream, names in channels.items():
        rows = [
            i
            for i in rows_of(names, "gyro") + rows_of(names, "accel")
            if signal_set_of(stream, names[i]) == "imu"
        ]
        if rows:
            std = values[stream][:, rows].std(axis=2) + _LOG_FLOOR
            columns += list(np.log10(std / fastest_mps[:, None]).T)
        for i in rows:
            unit = UNIT_SYMBOLS[unit_of(names[i])]
            features.append(
                Feature(
                    f"{stream}.{names[i].rpartition('_')[0]}.log_std_per_speed",
                    f"log10 ({unit})/(m/s)",
                    frozenset({"imu", "wheels"}),
                )
            )

    sides = left_right(wheel_channels, "speed")
    yaw_stream = next((stream for stream, names in channels.items() if "gyro_z_radps" in names), None)
    if sides and yaw_stream:
        turning_mps = wheels[:, sides[1]] - wheels[:, sides[0]]
        gyro = values[yaw_stream][:, channels[yaw_stream].index("gyro_z_radps")]
        n_parts = min(N_PARTS, turning_mps.shape[1], gyro.shape[1])
        difference, yaw_rate = _part_means(turning_mps, n_parts), _part_means(gyro, n_parts)
        power = np.sum(difference**2, axis=1)
        gain = np.full(n, np.nan)
        turning = np.sqrt(power / difference.shape[1]) >= MIN_WHEEL_DIFFERENCE_MPS
        np.divide(np.sum(yaw_rate * difference, axis=1), power, out=gain, where=turning)
        features.append(Feature("turning.yaw_per_wheel_difference", "rad/m", frozenset({"imu", "wheels"})))
        columns.append(gain)
    return features, np.stack(columns, axis=1) if columns else np.empty((n, 0))


def _part_means(signal: Array, n_parts: int) -> Array:
    edges = np.linspace(0, signal.shape[1], n_parts + 1).round().astype(int)
    sums: Array = np.add.reduceat(signal, edges[:-1], axis=1)
    return sums / np.diff(edges)
