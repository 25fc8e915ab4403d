"""An RTK receiver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrain.logs.schema import GNSS_CHANNELS
from terrain.records import Array
from terrain.simulation.conditions import Faults
from terrain.simulation.sensors.motion import (
    SPEED_X,
    YAW,
    Motion,
)
from terrain.simulation.sensors.sensor import Sensor, is_lost


@dataclass(frozen=True, slots=True)
class Gnss:
    """An RTK receiver with its antenna above the body's origin.

    Fix to 2 cm and 10 Hz: thesis 5.1.1.  A float solution of half a metre, the latency of the radio link, the
    accuracy of the Doppler speed and how long a fix lasts are assumed.
    """

    rate_hz: float = 10.0
    latency_s: float = 0.1
    fix_std_m: float = 0.02
    float_std_m: float = 0.5
    speed_std_mps: float = 0.03
    fix_length_s: float = 60.0
    float_length_s: float = 5.0


class GnssSensor(Sensor):
    """RTK positions and speeds in the world frame, with stretches of float."""

    def __init__(self, motion: Motion, receiver: Gnss, rng: np.random.Generator, faults: Faults) -> None:
        time_s, rows = motion.at(receiver.rate_hz, receiver.latency_s)
        n = len(rows)
        fixed = np.empty(n, dtype=bool)
        state = True
        leave = rng.random(n) * receiver.rate_hz
        for i in range(n):
            length_s = receiver.fix_length_s if state else receiver.float_length_s
            state = state != bool(leave[i] < 1 / length_s)
            fixed[i] = state
        std = np.where(fixed, receiver.fix_std_m, receiver.float_std_m)
        position_noise = std[:, None] * rng.standard_normal((n, 2))
        noise = np.column_stack([position_noise, receiver.speed_std_mps * rng.standard_normal((n, 2))])
        kept = ~is_lost(time_s, faults.gnss_lost_s)
        super().__init__(motion, GNSS_CHANNELS, time_s[kept], rows[kept])
        self._noise, self._quality = noise[kept], np.column_stack([std, fixed])[kept]

    def _write(self, new: slice, rows: Array) -> None:
        record, noise = self.motion.record, self._noise[new]
        yaw, along, across = (record[rows, place] for place in (YAW, SPEED_X, SPEED_X + 1))
        self.values[new, :2] = record[rows, :2] + noise[:, :2]
        self.values[new, 2] = along * np.cos(yaw) - across * np.sin(yaw) + noise[:, 2]
        self.values[new, 3] = along * np.sin(yaw) + across * np.cos(yaw) + noise[:, 3]
        self.values[new, 4:] = self._quality[new]
