"""Motion of the wheels' contacts: velocity over ground in each wheel's frame, and the slip of the contact.

Thrust follows the slip only over the relaxation length sigma of the contact (Pacejka, Tyre and Vehicle
Dynamics, 7.2.1), so that in a start it belongs to a slip of a moment ago.  The slip given here is that of the
contact, u / sigma with ``du/dt = (w r - v) - max(|w r|, |v|) u / sigma``; in steady motion it is the slip
ratio.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.estimation.measurements.table import MeasurementTable
from terrain.kinematics.wheel_velocity import TWIST, wheel_frame_velocities
from terrain.records import Array, StateTrack
from terrain.robots import Robot

MIN_SPEED_MPS = 0.2
"""At lower speeds, an error of 1 cm/s in the speed is over 5 % of slip."""

MAX_SIDE_RATIO = 0.5
"""Lateral over longitudinal slip above which a wheel's longitudinal thrust is not used."""

SMALL_SLIP = 0.02
"""Lateral slip up to which the reduction of the longitudinal thrust is negligible."""


class Contacts(NamedTuple):
    """Motion of the wheels, (n, wheels) each.

    Parameters
    ----------
    steer_rad, rate_radps : of the wheels
    wheel_speed_mps : wheel circumferential speed w r
    forward_mps, left_mps : velocity over ground in the wheel's frame
    reference_speed_mps : denominator of the slip, the larger magnitude of w r and ``forward_mps``
    slip_ratio : longitudinal slip of the contact
    """

    steer_rad: Array
    rate_radps: Array
    wheel_speed_mps: Array
    forward_mps: Array
    left_mps: Array
    reference_speed_mps: Array
    slip_ratio: Array

    @property
    def side_ratio(self) -> Array:
        """Magnitude of the lateral slip."""
        return np.asarray(np.abs(self.left_mps) / np.maximum(self.reference_speed_mps, MIN_SPEED_MPS))

    @property
    def oblique(self) -> Array:
        """Whether the lateral slip is neither negligible nor too large for its share in the slip vector."""
        side = self.side_ratio
        return np.asarray((side >= SMALL_SLIP) & (side <= MAX_SIDE_RATIO * np.abs(self.slip_ratio)))

    @property
    def vector_factor(self) -> Array:
        """Length of the slip vector over its longitudinal component, negative where a wheel rolls back."""
        oblique = self.oblique
        side = self.side_ratio / np.where(oblique, self.slip_ratio, 1.0)
        rolling = np.where(self.wheel_speed_mps + self.forward_mps < 0.0, -1.0, 1.0)
        return np.asarray(rolling * np.where(oblique, np.hypot(1.0, side), 1.0))


class Travel(NamedTuple):
    """Speed (n,) of the body, its direction of travel (n, 2) in the body frame, and its yaw rate (n,)."""

    speed_mps: Array
    direction: Array
    yaw_rate_radps: Array

    @property
    def moving(self) -> Array:
        """Whether (n,) the speed is above :data:`MIN_SPEED_MPS`; the direction is zero elsewhere."""
        return np.asarray(self.speed_mps > MIN_SPEED_MPS)


def wheel_contacts(
    robot: Robot, track: StateTrack, table: MeasurementTable, relaxation_length_m: float
) -> Contacts:
    """Return the motion of each wheel by a state track and the wheel rates measured beside it."""
    steer = np.column_stack([track.state(f"steer_{wheel}_rad") for wheel in robot.wheels])
    rate = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    twist = np.column_stack([track.state(name) for name in TWIST])
    forward, left = wheel_frame_velocities(twist, robot.wheel_positions_m, steer)
    wheel_speed = rate * robot.wheel_radius_m
    slip_speed = wheel_speed - forward
    reference = np.maximum(np.abs(wheel_speed), np.abs(forward))
    slips = [
        contact_slip(track.time_s, slip_speed[:, i], reference[:, i], relaxation_length_m)
        for i in range(len(robot.wheels))
    ]
    return Contacts(steer, rate, wheel_speed, forward, left, reference, np.column_stack(slips))


def travel_of(track: StateTrack) -> Travel:
    """Return the motion of the body."""
    speed = np.hypot(track.state("speed_x_mps"), track.state("speed_y_mps"))
    direction = np.divide(
        np.column_stack([track.state("speed_x_mps"), track.state("speed_y_mps")]),
        speed[:, None],
        out=np.zeros((speed.size, 2)),
        where=(speed > MIN_SPEED_MPS)[:, None],
    )
    return Travel(speed, direction, track.state("yaw_rate_radps"))


@njit(cache=True)
def contact_slip(
    time_s: Array, slip_speed_mps: Array, reference_speed_mps: Array, relaxation_m: float
) -> Array:
    """Return the slip (n,) of a contact that follows the slip velocity over its relaxation length.

    Parameters
    ----------
    time_s : (n,) strictly increasing
    slip_speed_mps : (n,) w r - v
    reference_speed_mps : (n,) the larger magnitude of wheel circumferential speed and speed over ground
    relaxation_m : above 0

    Examples
    --------
    >>> time_s = np.arange(0.0, 1.0, 0.02)
    >>> slip = contact_slip(time_s, np.full(50, 0.1), np.full(50, 1.0), 0.05)  # from rest in the contact
    >>> slip[[0, 2, -1]].round(3)
    array([0.   , 0.055, 0.1  ])
    """
    out = np.zeros_like(slip_speed_mps)
    for k in range(1, time_s.size):
        step_s = time_s[k] - time_s[k - 1]
        rate = 0.5 * (reference_speed_mps[k] + reference_speed_mps[k - 1]) / relaxation_m
        speed = 0.5 * (slip_speed_mps[k] + slip_speed_mps[k - 1]) / relaxation_m
        left = math.exp(-rate * step_s)
        gained = (1.0 - left) / rate if rate > 1e-6 else step_s
        out[k] = min(max(out[k - 1] * left + speed * gained, -1.0), 1.0)
    return out
