"""A scenario: twists desired over time, and terrains by distance travelled."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from terrain.records import Array, read_only

RATE_HZ = 50.0
"""Rate of the twists: that of a run log's commands."""


class Patch(NamedTuple):
    """A terrain from ``start_m`` of distance travelled on, to where the next one starts."""

    start_m: float
    terrain: str


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """What is driven, and on what.

    Parameters
    ----------
    name : of the drive
    rate_hz : of the twists
    time_s : (n,) from 0 to the duration, both included, at that rate
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``, no wheel beyond the robot's limit
    patches : terrains in order; the first starts at 0, the last has no end
    """

    name: str
    rate_hz: float
    time_s: Array
    twist: Array
    patches: tuple[Patch, ...]

    def __post_init__(self) -> None:
        for name in ("time_s", "twist"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "patches", tuple(Patch(*patch) for patch in self.patches))
        if self.twist.shape != (self.time_s.size, 3):
            raise ValueError(f"twist has shape {self.twist.shape}, {(self.time_s.size, 3)} is needed")
        if not np.allclose(self.time_s * self.rate_hz, np.arange(self.time_s.size), rtol=0, atol=1e-6):
            raise ValueError(f"time_s is not evenly spaced from 0 at {self.rate_hz:g} Hz")
        starts_m = [patch.start_m for patch in self.patches]
        if starts_m[:1] != [0.0] or any(b <= a for a, b in pairwise(starts_m)):
            raise ValueError(f"patches start at {starts_m} m, a rising row from 0 on is needed")

    @property
    def distance_m(self) -> Array:
        """Distance (n,) that the body's origin would have travelled, were the twists followed."""
        return distance_travelled_m(self.time_s, self.twist)


def distance_travelled_m(time_s: Array, twist: Array) -> Array:
    """Return the distance (n,) travelled by the body's origin with twists (n, 3) at times (n,)."""
    speed_mps = np.hypot(twist[:, 0], twist[:, 1])
    steps_m = np.diff(time_s) * (speed_mps[1:] + speed_mps[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps_m)])
