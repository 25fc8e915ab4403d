"""Thrust, load and slip of each wheel over a run: motor current, attitude and slip on one clock.

Of wheel i, with its rate w, radius r, inertia J, the current I of its motor, the robot's mass m and its
specific force f = a + g up (the reading of an ideal accelerometer)::

    T = I kt n eta                                       torque at the wheel
    F = (T - T_friction tanh(w / w_0) - J dw/dt) / r     thrust of the terrain
    N = m (q_i f_z - h (G_i . (f_x, f_y)))               load: three contacts under a rigid body

The torque constant kt, the reduction n and the efficiency eta are those of the robot's description.  The
efficiency is taken as one factor between current and torque, driving and driven alike, as in
:mod:`terrain.simulation.sensors`; with a reduction that is driven by its wheel it is reversed, so that
braking forces of a real robot come out too small by about its square.

Slips have passed the encoders' low-pass filter, the current has not: everything goes through the same filter.
Thrust belongs to the slip of the contact (:mod:`terrain.slip_learning.contacts`).

Terrain is taken as isotropic (:mod:`terrain.terramechanics.traction`): the force of a wheel that also slips
sideways, as on a cross slope, is along the slip vector.  Its sample is the magnitude of that vector and of
the force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.measurements.resampling import on_clock
from terrain.estimation.measurements.table import MeasurementTable
from terrain.records import Array, Label, RunLog, SlipTrack, StateTrack, read_only
from terrain.robots import Robot
from terrain.slip_learning.contacts import (
    MIN_SPEED_MPS,
    SMALL_SLIP,
    Contacts,
    Travel,
    travel_of,
    wheel_contacts,
)

MAX_SLIP_STD = 0.05
"""A less certain slip carries no information on a curve that rises within 0.1 to 0.3."""

MAX_SLIP_ANGLE_RAD = 0.15
"""For the balance: the components of side forces along the direction of travel are then within a ninth."""

MAX_YAW_RATE_RADPS = 0.1
"""For the balance, which leaves side forces out."""

MIN_LOAD_RATIO = 0.35
"""Load relative to that of the standing robot below which a wheel is about to lift and its F / N is noise."""

MAX_TORQUE_RATIO = 0.985
"""A motor at its torque limit gives the same thrust on good and on bad spots, and slips more on the bad: such
samples would bend the curve down."""

MAX_SLIP_RATE_PS = 3.0
"""Slip that changes faster is smeared by the 50 ms of the low-pass filter over more than 0.15."""

MAX_THRUST_RATE_PS = 1.0
"""Thrust over load that changes faster belongs to a slip that is not known to 50 ms."""

LABEL_EDGE_S = 0.3
"""After this the low-pass filter holds e^-6 of the terrain before, which is negligible."""

FRICTION_RATE_RADPS = 0.1
"""Rate over which bearing friction takes its full value, as in the simulation."""

RATE_SMOOTHING_S = 0.06
"""Centred mean under the wheel's acceleration: Hall steps and noise of three samples."""


@dataclass(frozen=True, slots=True, eq=False)
class WheelForces:
    """Thrust, load and slip of each wheel over a run; positive in traction, forward or in reverse.

    Parameters
    ----------
    time_s : (n,) clock of the wheels
    slip_ratio, slip_std : (n, wheels) of the contact, its lateral part included; NaN where unknown
    thrust_n : (n, wheels) force of the terrain along that slip, before any resistance
    load_npkg : (n, wheels) load over the robot's mass
    reference_speed_mps : (n, wheels) denominator of the slip, the larger of wheel circumferential speed and
        speed over ground
    total_thrust_n : (n,) sum of the thrusts along the direction of travel
    speed_mps : (n,) of the body over ground
    grade_mps2 : (n,) component of gravity against the direction of travel: uphill positive
    normal_mps2 : (n,) specific force normal to the terrain
    thrust_std_n : of one thrust, by the noise of the current
    conditions : by name, whether (n, wheels) a sample meets a condition of its use
    balance_valid : (n,) whether an instant may be used in the balance of the body
    """

    time_s: Array
    slip_ratio: Array
    slip_std: Array
    thrust_n: Array
    load_npkg: Array
    reference_speed_mps: Array
    total_thrust_n: Array
    speed_mps: Array
    grade_mps2: Array
    normal_mps2: Array
    thrust_std_n: float
    conditions: Mapping[str, Array]
    balance_valid: Array

    def __post_init__(self) -> None:
        for name in ("time_s", "slip_ratio", "slip_std", "thrust_n", "load_npkg", "reference_speed_mps"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("total_thrust_n", "speed_mps", "grade_mps2", "normal_mps2"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "balance_valid", read_only(self.balance_valid, np.bool_))
        object.__setattr__(self, "conditions", MappingProxyType(dict(self.conditions)))

    @property
    def valid(self) -> Array:
        """Whether (n, wheels) every one of :attr:`conditions` holds."""
        return np.asarray(np.logical_and.reduce(list(self.conditions.values())))

    def on_terrain(self, labels: tuple[Label, ...], terrain: str) -> Array:
        """Return where (n,) a label names this terrain, without :data:`LABEL_EDGE_S` after a change."""
        inside = np.zeros(self.time_s.size, dtype=bool)
        for start_s, end_s, name in labels:
            if name == terrain:
                begin = start_s + (LABEL_EDGE_S if start_s > self.time_s[0] else 0.0)
                inside |= (self.time_s >= begin) & (self.time_s < end_s)
        return inside


class _Forces(NamedTuple):
    """Torque and thrust of each wheel, and its load over the robot's mass, (n, wheels) each."""

    torque_nm: Array
    thrust_n: Array
    load_npkg: Array


def wheel_torque(
    current_a: Array, torque_constant_nmpa: float, reduction_ratio: float, efficiency_ratio: float
) -> Array:
    """Return the torque at the wheel in Nm for the current of its motor; any shape.

    Examples
    --------
    >>> wheel_torque(np.array([10.0, -10.0]), 0.25, 10.0, 0.85)
    array([ 21.25, -21.25])
    """
    return np.asarray(current_a) * (torque_constant_nmpa * reduction_ratio * efficiency_ratio)


def ground_thrust(
    torque_nm: Array,
    wheel_radps: Array,
    accel_radps2: Array,
    friction_nm: float,
    inertia_kgm2: float,
    wheel_radius_m: float,
) -> Array:
    """Return the thrust of the terrain on a wheel in N, along the wheel's x axis; any shape.

    Examples
    --------
    >>> ground_thrust(np.array([20.0]), np.array([5.0]), np.array([10.0]), 0.5, 0.15, 0.2).round(1)
    array([90.])
    """
    friction = friction_nm * np.tanh(wheel_radps / FRICTION_RATE_RADPS)
    return np.asarray((torque_nm - friction - inertia_kgm2 * accel_radps2) / wheel_radius_m)


def wheel_loads(robot: Robot, force_mps2: Array) -> Array:
    """Return the load of each wheel over the robot's mass, (n, 3) N/kg, for the body's specific force (n, 3).

    Three contacts carry a rigid body: the loads follow from the balance of forces and of the two moments.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> standing = np.array([[0.0, 0.0, 9.0], [1.0, 0.0, 9.0]])  # the second speeds up or climbs
    >>> wheel_loads(load_robot("agrimaro"), standing).round(2)
    array([[3.  , 3.  , 3.  ],
           [3.49, 2.51, 3.  ]])
    """
    body = robot.body
    inverse = np.linalg.inv(np.vstack([np.ones(3), robot.wheel_positions_m.T]))
    load_ratio = inverse @ np.array([1.0, body.com_x_m, body.com_y_m])
    return np.asarray(
        force_mps2[:, 2:] * load_ratio - body.com_height_m * force_mps2[:, :2] @ inverse[:, 1:].T
    )


def wheel_forces(
    run: RunLog, robot: Robot, track: StateTrack, table: MeasurementTable, slip: SlipTrack
) -> WheelForces:
    """Return thrust, load and slip of each wheel of a run.

    Parameters
    ----------
    run : log of a swerve robot with motor currents and an IMU
    robot : its description, all sections
    track, table, slip : state, measurements and slip by a filter with slip speeds (``vio15``)

    Raises
    ------
    ConfigError
        if the description lacks a section.
    DataError
        if the log has no motor currents or no IMU with roll and pitch, or the track no slip speeds.
    """
    robot.require(*robot.sections)
    sensors = robot.sensors
    _check_channels(run, robot)
    if "slip_speed_1_mps" not in track.states:
        raise DataError(f"run {run.run_id}: the track has no slip speeds: estimate it with vio15")
    up = _up(run, track.time_s, sensors.imu_latency_s, sensors.encoder_time_constant_s)
    accel = [track.state("accel_x_mps2"), track.state("accel_y_mps2"), np.zeros(track.time_s.size)]
    force = GRAVITY_MPS2 * up + np.column_stack(accel)
    contacts = wheel_contacts(robot, track, table, robot.body.relaxation_length_m)
    travel = travel_of(track)
    forces = _forces(run, robot, track.time_s, contacts.rate_radps, force)
    fresh = ~slip.stale & np.isfinite(track.reference_age_s)
    conditions = _conditions(robot, track.time_s, slip, contacts, forces, fresh)
    factor = contacts.vector_factor
    cos_travel = (
        np.cos(contacts.steer_rad) * travel.direction[:, :1]
        + np.sin(contacts.steer_rad) * travel.direction[:, 1:]
    )
    return WheelForces(
        time_s=track.time_s,
        slip_ratio=np.where(conditions["slip known"], contacts.slip_ratio * factor, np.nan),
        slip_std=slip.slip_std,
        thrust_n=forces.thrust_n * factor,
        load_npkg=forces.load_npkg,
        reference_speed_mps=contacts.reference_speed_mps,
        total_thrust_n=(forces.thrust_n * cos_travel).sum(axis=1),
        speed_mps=travel.speed_mps,
        grade_mps2=GRAVITY_MPS2 * (up[:, :2] * travel.direction).sum(axis=1),
        normal_mps2=force[:, 2],
        thrust_std_n=_thrust_std_n(robot, track.time_s),
        conditions=conditions,
        balance_valid=_balance_valid(travel, contacts) & fresh & _all_known(conditions),
    )


def _check_channels(run: RunLog, robot: Robot) -> None:
    wheels = [f"current_{wheel}_a" for wheel in robot.wheels]
    wheels += [f"motor_{wheel}_radps" for wheel in robot.wheels]
    for stream, channels in (("wheels", wheels), ("imu", ["roll_rad", "pitch_rad"])):
        present = run.streams[stream].channels if stream in run.streams else ()
        missing = [channel for channel in channels if channel not in present]
        if missing:
            raise DataError(f"run {run.run_id}: stream {stream!r} has no channel {missing[0]!r}")


def _up(run: RunLog, clock: Array, imu_latency_s: float, time_constant_s: float) -> Array:
    """Return the direction of up (n, 3) in the body frame."""
    imu = run.streams["imu"]
    angles = {name: imu.channel(name) for name in ("roll_rad", "pitch_rad")}
    tilt = on_clock(clock, imu.time_s - imu_latency_s, angles, time_constant_s)
    roll, pitch = tilt["roll_rad"], tilt["pitch_rad"]
    return np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])


def _forces(run: RunLog, robot: Robot, clock: Array, rate_radps: Array, force_mps2: Array) -> _Forces:
    """Return torque, thrust and load of each wheel by its current, its rate and the body's specific force."""
    motors, wheels = robot.motors, run.streams["wheels"]
    measured = {name: wheels.channel(name) for name in (f"current_{wheel}_a" for wheel in robot.wheels)}
    filtered = on_clock(clock, wheels.time_s, measured, robot.sensors.encoder_time_constant_s)
    torque = wheel_torque(
        np.column_stack(list(filtered.values())),
        motors.torque_constant_nmpa,
        motors.reduction_ratio,
        motors.efficiency_ratio,
    )
    accel = _smooth(np.gradient(rate_radps, clock, axis=0), clock)
    inertia_kgm2 = robot.body.wheel_inertia_kgm2
    thrust = ground_thrust(torque, rate_radps, accel, motors.friction_nm, inertia_kgm2, robot.wheel_radius_m)
    return _Forces(torque, thrust, wheel_loads(robot, force_mps2))


def _conditions(
    robot: Robot, clock: Array, slip: SlipTrack, contacts: Contacts, forces: _Forces, fresh: Array
) -> dict[str, Array]:
    """Return by name whether (n, wheels) a sample meets each condition of its use."""
    with np.errstate(invalid="ignore"):
        thrust_rate = np.abs(_smooth(np.gradient(forces.thrust_n, clock, axis=0), clock)) / np.maximum(
            robot.mass_kg * forces.load_npkg, 1.0
        )
    standing = wheel_loads(robot, np.array([[0.0, 0.0, GRAVITY_MPS2]]))
    attitude = np.asarray(np.isfinite(forces.load_npkg).all(axis=1))
    slip_rate = np.abs(np.gradient(contacts.slip_ratio, clock, axis=0))
    torque_limit_nm = MAX_TORQUE_RATIO * robot.motors.torque_max_nm
    return {
        "slip known": np.isfinite(slip.slip_ratio) & (slip.slip_std < MAX_SLIP_STD),
        "speed fresh": np.repeat(fresh[:, None], 3, axis=1),
        "moving": np.abs(contacts.forward_mps) > MIN_SPEED_MPS,
        "rolling straight": contacts.oblique | (contacts.side_ratio < SMALL_SLIP),
        "slip followed": slip_rate < MAX_SLIP_RATE_PS,
        "thrust followed": thrust_rate < MAX_THRUST_RATE_PS,
        "loaded": forces.load_npkg > MIN_LOAD_RATIO * standing,
        "torque free": np.abs(forces.torque_nm) < torque_limit_nm,
        "current known": np.isfinite(forces.thrust_n),
        "attitude known": np.repeat(attitude[:, None], 3, axis=1),
    }


def _balance_valid(travel: Travel, contacts: Contacts) -> Array:
    """Return whether (n,) the robot drives straight enough for a balance without side forces."""
    straight = np.abs(contacts.left_mps) < math.tan(MAX_SLIP_ANGLE_RAD) * np.abs(contacts.forward_mps)
    turns_little = np.abs(travel.yaw_rate_radps) < MAX_YAW_RATE_RADPS
    return np.asarray(travel.moving & turns_little & straight.all(axis=1))


def _all_known(conditions: Mapping[str, Array]) -> Array:
    known = conditions["current known"] & conditions["attitude known"]
    return np.asarray(known.all(axis=1))


def _thrust_std_n(robot: Robot, clock: Array) -> float:
    """Return the standard deviation of a thrust by the noise of the current behind the low-pass filter."""
    motors, sensors = robot.motors, robot.sensors
    noise_a = sensors.current_std_a * math.sqrt(_noise_gain(clock, sensors.encoder_time_constant_s))
    per_ampere_nm = wheel_torque(
        np.ones(1), motors.torque_constant_nmpa, motors.reduction_ratio, motors.efficiency_ratio
    )
    return float(noise_a * per_ampere_nm[0] / robot.wheel_radius_m)


def _smooth(values: Array, time_s: Array) -> Array:
    """Return a centred mean over :data:`RATE_SMOOTHING_S`."""
    half = round(0.5 * RATE_SMOOTHING_S / float(np.median(np.diff(time_s)))) if time_s.size > 1 else 0
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.asarray(np.mean([padded[i : i + len(values)] for i in range(2 * half + 1)], axis=0))


def _noise_gain(time_s: Array, time_constant_s: float) -> float:
    """Return the variance of white noise behind a low-pass filter at this rate, relative to that before."""
    if time_constant_s <= 0 or time_s.size < 2:
        return 1.0
    keep = math.exp(-float(np.median(np.diff(time_s))) / time_constant_s)
    return (1.0 - keep) / (1.0 + keep)
