"""The rows that a filter measures at each tick of the wheels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from terrain.errors import DataError
from terrain.records import Array, read_only

MAX_RATE_FACTOR = 2.0
"""Wheel rates above this multiple of the motor's maximum are discarded."""

LATE_S = 0.5
"""A camera whose first sample comes later than this after the clock's may have missed a turn."""

STANDING_S = 1.0
"""Longest stretch, before the wheels turn, over which the heading at the start is averaged."""

STANDING_SPEED_MPS = 0.05
"""Wheel circumferential speed below which a wheel counts as standing (thesis 7.2.1)."""

GNSS_LATENCY_S = 0.1
"""Age of a position when it arrives; assumed, as in the simulated receiver."""

GNSS_STD_M = {True: 0.02, False: 0.5}
"""Position's standard deviation with a fix (RTK, thesis 5.1.1) and with a float solution (assumed)."""

GNSS_SPEED_STD_MPS = 0.03
"""Of the Doppler speed; assumed, as in the simulated receiver."""

CAMERA_ROWS = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")
GNSS_ROWS = ("gnss_position_x_m", "gnss_position_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
DERIVED_ROWS = (
    "vibration_mps2",
    *(f"wheel_{i}_growth_per_s" for i in (1, 2, 3)),
    *(f"wheel_{i}_change_m2ps3" for i in (1, 2, 3)),
    "camera_age_s",
    *("rest_speed_x_mps", "rest_speed_y_mps", "rest_yaw_rate_radps"),
)
_SIDES = ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps", *GNSS_ROWS)
ROWS_OF_DRIVE: dict[str, tuple[str, ...]] = {
    "swerve": (
        *(f"wheel_{i}_radps" for i in (1, 2, 3)),
        "accel_x_mps2",
        "accel_y_mps2",
        "gyro_z_radps",
        "imu_yaw_rad",
        *(f"steer_{i}_rad" for i in (1, 2, 3)),
        *CAMERA_ROWS,
        *GNSS_ROWS,
        *DERIVED_ROWS,
    ),
    "skid_steer": _SIDES,
    "tracked": _SIDES,
}
"""Rows of a table, of a swerve robot in the order of (6.3).

Positions and GNSS speeds are in the world frame, east and north from where the antenna first was; yaw counts
from east once the heading at the start is given; all else is in body axes.  The last rows of a swerve robot
are those of :mod:`~terrain.estimation.measurements.derived`."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementTable:
    """What a filter measures at each tick of its clock; NaN where a sensor gave nothing.

    Parameters
    ----------
    time_s : (n,) stamps of the wheels stream
    rows : name of each of the m measurements
    z : (n, m)
    gnss_variance : (n, 4) of :data:`GNSS_ROWS`, in their units squared; NaN where they are
    dropped : samples left out, as counts by stream and kind (``"imu: frozen"``)
    """

    time_s: Array
    rows: tuple[str, ...]
    z: Array
    gnss_variance: Array
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("time_s", "z", "gnss_variance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))
        n = self.time_s.size
        for name, shape in {"z": (n, len(self.rows)), "gnss_variance": (n, len(GNSS_ROWS))}.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, {shape} is needed")

    def at(self, time_s: Array) -> MeasurementTable:
        """Return the table of some of its own instants, as a filter's track has them that left rows out."""
        if np.array_equal(time_s, self.time_s):
            return self
        rows = np.searchsorted(self.time_s, time_s)
        return MeasurementTable(
            self.time_s[rows], self.rows, self.z[rows], self.gnss_variance[rows], self.dropped
        )

    def columns(self, names: Iterable[str]) -> Array:
        """Return the measurements (n, len(names)) in the order of a model's rows.

        Raises
        ------
        DataError
            if the table has no such row.
        """
        try:
            return self.z[:, [self.rows.index(name) for name in names]]
        except ValueError:
            lacking = next(name for name in names if name not in self.rows)
            raise DataError(
                f"there is no measurement {lacking!r}; this robot gives {', '.join(self.rows)}"
            ) from None
