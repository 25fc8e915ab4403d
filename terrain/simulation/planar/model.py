"""The planar simulation: from wheels, steering and tilt to motion, currents and what sensors show of them.

One body for all wheeled robots, fed either with what a simulated drive does to the wheels or with what a log
records of them; whatever is wrong about it is a parameter of :mod:`terrain.effects.catalogue`, 0 where
absent.

- **kinematics** without slip: of a swerve robot the least-squares twist of its wheels' velocities, of a
  skid-steer robot ``u = (v_r + v_l)/2``, ``w = (v_r - v_l)/B``;
- **force**: ``F = m (1 + p) (dv/dt + g sin th) + R``, with the resistance ``R`` of rolling, drag, slip and
  scrub against the motion, and ``f = F / (m g)``;
- **slip**: ``v = u - |u| s(f)``, ``s = c f`` and a shear curve.  Of a skid-steer robot it acts along x, and
  with the inertia in ``F`` that is a low-pass of time constant ``|u| c m (1 + p) / (m g)``; of a swerve robot
  it is a twist of three parts, along, across with what the roll asks for, and turning, of a contact that
  springs.  Both are stepped exactly for inputs that run straight from sample to sample, so that the answer
  hardly depends on the step;
- **omni robots**: each wheel pulls along its direction by its own load and slip, its rollers resist across
  it (:mod:`~terrain.simulation.planar.omni`), and each motor's current is that of its wheel;
- **currents**: their sum is ``F r`` along the wheels' mean heading and the motors' friction over the torque
  that an ampere gives at the wheel; of a skid-steer robot also the difference of the sides, from yaw inertia
  and scrub;
- **turning** of a skid-steer robot: its wheels' yaw rate and speed are reduced by turning slip and turn drag,
  lateral acceleration makes its track act narrower, and it slips sideways by ``T dv_y/dt + v_y = -c v w``;
- **car-like robots** turn by the linear single-track model
  (:mod:`~terrain.simulation.planar.bicycle`), and have no currents;
- **sensors**: gyro, accelerometer and camera with bias, scale, mounting, latency and their logger's clock.

Load transfer and roughness are left out: what they do to a log is noise here.  Sources stand with the
effects.

This module holds what all of it shares: the terrain, the robot's numbers on it, and the columns of a motion.
Motion is in :mod:`~terrain.simulation.planar.motion`, :mod:`~terrain.simulation.planar.skid_steer`,
:mod:`~terrain.simulation.planar.swerve`, :mod:`~terrain.simulation.planar.omni` and
:mod:`~terrain.simulation.planar.bicycle`, sensors without noise in
:mod:`~terrain.simulation.planar.ideal_sensors`, and both together over a log in
:mod:`~terrain.simulation.planar.replay`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from terrain.kinematics.omni import rolling_matrix
from terrain.kinematics.wheel_velocity import velocity_matrix
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot

TRUTH: tuple[str, ...] = (
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    "accel_x_mps2",
    "force_n",
    "current_a",
    "turning_current_a",
    "slip_ratio",
)
"""What the body does, before any sensor: speeds of the body's origin, specific force along x, traction,
currents of motors as described, and slip; traction and slip are those along x, of an omni robot the slip of
the body along what its wheels roll, and the sum of its currents' magnitudes."""

N_TRUTH = len(TRUTH)
VX, VY, W, AX, FORCE, AMPS, TURNING_AMPS, SLIP = range(N_TRUTH)
"""Their columns."""

SWERVE_WHEELS = 3

IMU_LAG_S = 0.003
"""Lag of a swerve robot's IMU behind its latency: bandwidths of 47 and 62.5 Hz (Bosch BNO055 data sheet)."""


class Ground(NamedTuple):
    """A terrain in the planar simulation.

    Parameters
    ----------
    slip_ratio : slip a traction of the robot's whole weight would take, were the thrust curve straight
    grip_ratio : largest traction over weight, of the shear curve
    rolling_ratio : resistance over weight
    scrub_ratio : resistance to turning of a skid-steer robot, over weight
    thrust_ratio : traction over weight at slips evenly spaced from 0 to 1, which takes the place of
        ``slip_ratio``; without any the thrust curve is straight
    load_ratio : by how much the traction at a slip grows with a load, as a share of the load's own share
    roller_ratio : friction of the rollers of omni wheels over the load, at a speed across of the wheels' own
    effective_ratio : share of the measured tilt that is a slope to drive up; the rest is a body that rides
        over bumps
    """

    slip_ratio: float = 0.3
    grip_ratio: float = 0.5
    rolling_ratio: float = 0.05
    scrub_ratio: float = 0.2
    thrust_ratio: tuple[float, ...] = ()
    load_ratio: float = 0.0
    effective_ratio: float = 1.0
    roller_ratio: float = 0.0


class Planar(NamedTuple):
    """Numbers of a robot on a ground, as the kernels take them."""

    n_wheels: int
    to_twist: Array
    track_m: float
    radius_m: float
    mass_kg: float
    rotating_kg: float
    yaw_inertia_kgm2: float
    nm_per_a: float
    friction_nm: float
    lever_x_m: float
    lever_y_m: float
    latency_s: float
    imu_latency_s: float
    imu_lag_s: float
    encoder_lag_s: float
    slip_ratio: float
    soft_ratio: Array
    grip_ratio: float
    rolling_ratio: float
    scrub_ratio: float
    load_ratio: float
    effective_ratio: float
    com_x_m: float
    com_y_m: float
    arm_ratio: Array
    spread_m: float
    relaxation_m: float
    omni: bool
    along: Array
    across: Array
    to_rolled: Array
    wheel_load_ratio: Array
    wheel_distance_m: float
    roller_ratio: float
    tracked: bool
    bicycle: bool
    wheelbase_m: float
    com_ahead_m: float
    front_cornering_npr: float
    rear_cornering_npr: float


def make_planar(robot: Robot, ground: Ground) -> Planar:
    """Return the planar simulation of a robot on a ground.

    What a description leaves out does not act: without motors a traction of 1 N counts as 1 A, without a
    camera the speed is that of the body's origin, without delay.
    """
    complete = robot.completed
    motors, camera, body, sensors = complete.motors, complete.camera, complete.body, complete.sensors
    n_motors = len(robot.wheels)
    car = robot if isinstance(robot, BicycleRobot) else None
    com_m = np.array([body.com_x_m, body.com_y_m])
    arm_m = robot.wheel_positions_m - com_m
    spread_m = float(np.sqrt((arm_m**2).sum(axis=1).mean()))
    return Planar(
        n_wheels=len(robot.wheels),
        to_twist=np.ascontiguousarray(np.linalg.pinv(velocity_matrix(robot.wheel_positions_m))),
        track_m=robot.track_m,
        radius_m=robot.wheel_radius_m,
        mass_kg=robot.mass_kg,
        rotating_kg=n_motors * body.wheel_inertia_kgm2 / robot.wheel_radius_m**2,
        yaw_inertia_kgm2=car.yaw_inertia_kgm2 if car else body.yaw_inertia_kgm2,
        nm_per_a=motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio,
        friction_nm=n_motors * motors.friction_nm,
        lever_x_m=camera.lever_x_m,
        lever_y_m=camera.lever_y_m,
        latency_s=camera.latency_s + camera.time_constant_s,
        imu_latency_s=sensors.imu_latency_s,
        imu_lag_s=IMU_LAG_S if isinstance(robot, SwerveRobot) else 0.0,
        encoder_lag_s=sensors.encoder_time_constant_s,
        slip_ratio=ground.slip_ratio,
        soft_ratio=_slip_per_traction(ground),
        grip_ratio=ground.grip_ratio,
        rolling_ratio=ground.rolling_ratio,
        scrub_ratio=ground.scrub_ratio if robot.skids else 0.0,
        load_ratio=ground.load_ratio,
        effective_ratio=ground.effective_ratio,
        com_x_m=float(com_m[0]),
        com_y_m=float(com_m[1]),
        arm_ratio=np.ascontiguousarray(arm_m / spread_m),
        spread_m=spread_m,
        relaxation_m=body.relaxation_length_m,
        **_omni_wheels(robot, arm_m, ground),
        tracked=isinstance(robot, TrackedRobot),
        bicycle=car is not None,
        wheelbase_m=robot.wheelbase_m,
        com_ahead_m=car.com_ahead_m if car else 0.0,
        front_cornering_npr=car.front_cornering_npr if car else 0.0,
        rear_cornering_npr=car.rear_cornering_npr if car else 0.0,
    )


def _omni_wheels(robot: Robot, arm_m: Array, ground: Ground) -> dict[str, Any]:
    """Return what omni wheels at arms (wheels, 2) from the centre of mass do; zeros of other robots.

    ``along`` and ``across`` (wheels, 3) give the speed of each wheel's centre along and across its direction
    for a twist of the centre of mass, ``to_rolled`` (3, wheels) the twist of the body without slip.
    """
    if not robot.on_omni_wheels:
        n, none = len(robot.wheels), np.zeros((len(robot.wheels), 3))
        return {
            "omni": False,
            "along": none,
            "across": none,
            "to_rolled": np.zeros((3, n)),
            "wheel_load_ratio": np.zeros(n),
            "wheel_distance_m": 0.0,
            "roller_ratio": 0.0,
        }
    direction = robot.wheel_directions_rad
    moments = np.vstack([np.ones(len(arm_m)), arm_m.T])
    return {
        "omni": True,
        "along": np.ascontiguousarray(rolling_matrix(arm_m, direction)),
        "across": np.ascontiguousarray(rolling_matrix(arm_m, direction + np.pi / 2)),
        "to_rolled": np.ascontiguousarray(np.linalg.pinv(rolling_matrix(robot.wheel_positions_m, direction))),
        "wheel_load_ratio": np.linalg.pinv(moments) @ np.array([1.0, 0.0, 0.0]),
        "wheel_distance_m": float(np.hypot(*robot.wheel_positions_m[0])),
        "roller_ratio": ground.roller_ratio,
    }


def _slip_per_traction(ground: Ground) -> Array:
    """Return slip over traction at slips evenly spaced from 0 to 1."""
    thrust = np.array(ground.thrust_ratio)
    if thrust.size < 4:
        return np.full(2, ground.slip_ratio)
    slip = np.linspace(0.0, 1.0, thrust.size)
    ratio = np.empty(thrust.size)
    ratio[1:] = slip[1:] / thrust[1:]
    ratio[0] = 2.0 * ratio[1] - ratio[2]
    return ratio
