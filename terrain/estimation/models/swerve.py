"""The filters of a swerve robot: three wheels, driven and steered each, an IMU, and a camera or GNSS.

========= ====== ==== ================================================================================
filter    states rows what it can know
========= ====== ==== ================================================================================
encoder12 12     10   the speed of the wheels, which it takes for the speed over ground: slip reads 0
vio12     12     14   the speed that the camera sees, drawn to that of the wheels: slip reads low
vio15     18     17   the speed that the camera sees, and how fast each wheel slips: **the one to use**;
                      15 states of the thesis' kind, and what else its sensors have: the offset of the IMU's
                      yaw and the biases of the accelerometer; and three rows that hold at rest
========= ====== ==== ================================================================================

They are one model of which slip and sensors are settings.  Each can have four rows of GNSS more, another
source of absolute speed and position.

Process, with T the step, psi the yaw and w its rate, v and a in the body frame.  All else is a random walk::

    p_x <- p_x + T (v_x cos psi - v_y sin psi)        v_x <- v_x + T (a_x + w v_y)
    p_y <- p_y + T (v_x sin psi + v_y cos psi)        v_y <- v_y + T (a_y - w v_x)        psi <- psi + T w

vio15 has more than that, with the slip speed l_i, the growth g_i of the wheel's speed (an input), the gyro's
bias b, the offset o of the IMU's yaw and the accelerometer's biases c::

    a <- a exp(-3 T)        l_i <- l_i exp(g_i T)        o <- o + T b
    b <- b exp(-T / 5000 s)        c <- c exp(-T / 1250 s)

An acceleration kept for ever, as in the thesis, would let a truth that is drawn from the model reach hundreds
of metres a second.  Slip speeds grow and shrink with the speed of their wheels, which keeps the slip ratio of
a wheel when the camera is lost.  Biases fade to a prior.  How far slip speeds and the yaw rate walk, and an
acceleration is believed, follows vibration and changes of the wheels' speeds: :func:`scheduled`.  Camera, IMU
and rest are held: what disagrees for less than two seconds is not believed, as these sensors fail rather than
show the ground's doing.

Measurements, of wheel i at (x_i, y_i) steered by d_i, and the camera at (r_x, r_y)::

    v_i = (v_x - w y_i) cos d_i + (v_y + w x_i) sin d_i     wheel_i = v_i / r               encoder12, vio12
                                                            wheel_i = (v_i + l_i) / r       vio15
    accel = a (+ c)      gyro = w + b      camera_yaw = psi      imu_yaw = psi (+ o)      steer_i = d_i
    rest = (v_x, v_y, w), zero where the robot stands                                       vio15
    camera_speed = (v_x - w r_y, v_y + w r_x)        camera_yaw_rate = w
    gnss_position = p        gnss_speed = R(psi) v        in the world frame

Source: Danzi, AgriMaRo thesis, 4.3-4.5 and 6.1.  Corrected:

- (2.3) against 7.2: one geometry, that of 7.2, from the robot's description;
- (4.28), (4.48) rows 4 and 5: -w v_y and w v_x leave the acceleration, a state, without a measurement, and
  the filter diverges on a straight run; they are a_x and a_y, as in (6.6);
- (4.36), (4.44): the yaw rate stands after the accelerations; here states go by name, in the order of (6.1);
- (4.42), (4.46): place and angle of wheel 1 stand for every wheel; each has its own;
- 4.5.1 names the nonlinearity of its filter with 14 states: it is observability, no row measures the speed over
  ground (``examples/papers``);
- (6.2): the signs of the Coriolis terms are flipped; those of (4.33), (4.34) are right;
- (6.5): v - w x r; it is v + w x r, as in (6.6);
- (4.38) has 13 entries for 14 states and (4.40) 11 for 10 measurements; here six 1e-6, two 1e-3, three 1e-6, three
  1e-1, and seven 1e-5, three 7.2e-5.  (6.8) is 1.47e-4, not 1.35e-4; the 1.5e-4 of (6.9) stands.  Q of (6.9)-(6.14) is
  given a step, and no rate: per second it is Q over the sample time.  There are no values for the gyro's bias of
  encoder12;
- 6.1: beside a camera, wheel rows without slip draw the speed to that of the wheels, wholly once the camera
  is lost.  A slip speed l_i = wheel_i r - v_i of each wheel, a random walk, frees them and stays linear
  (vio15).
"""

from __future__ import annotations

import math

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.feed import (
    CAMERA_ROWS,
    CHANGE,
    DERIVED_ROWS,
    GNSS_ROWS,
    GROUND_SLIP,
    GROWTH,
    REST_TWIST,
    ROWS,
    SEEN_AGE,
    UNSEEN_AFTER_S,
    VIBRATION,
)
from terrain.estimation.filter import FilterModel
from terrain.estimation.models.observer import ObserverStatus
from terrain.estimation.wheel_slip import STALE_AFTER_S
from terrain.kernels import inner, njit
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import GATED, REOPENED, Array
from terrain.robots import Robot, SwerveRobot, as_drive

FILTERS = ("encoder12", "vio12", "vio15")  #: Names of the filters.
UNKNOWN_MPS2 = 1.4  #: Vibration where it is not known: that of rough ground.
#: Q of the thesis is per step; the sample time, which it does not print, is that of the wheels stream.
THESIS_SAMPLE_TIME_S = 0.02

_FADING_PER_S = 3.0  # of the acceleration of vio15: a third of a second, shorter than a start and a stop
_GYRO_FADING_PER_S, _ACCEL_FADING_PER_S = 2e-4, 8e-4  # of biases: with their walks, as uncertain as at first
_WHEEL_ROWS, _STEER_ROWS, _REST_ROWS = ROWS[:3], ROWS[7:10], DERIVED_ROWS[-3:]
# What is known of each state of a robot that was just switched on, and how far it walks within a second, as standard
# deviations; the first twelve are those of all filters, in the order of (6.1).
_STATES: dict[str, tuple[float, float]] = {
    # without GNSS the origin is where that was, but for what low-passes displace
    **dict.fromkeys(("position_x_m", "position_y_m"), (4e-3, 3e-4)),
    "yaw_rad": (1.0, 3e-4),
    **dict.fromkeys(("speed_x_mps", "speed_y_mps"), (0.5, 0.01)),
    "yaw_rate_radps": (0.5, 0.02),
    **dict.fromkeys(("accel_x_mps2", "accel_y_mps2"), (1.0, 2.0)),
    **dict.fromkeys(_STEER_ROWS, (0.3, 0.1)),
    "gyro_bias_radps": (0.01, 2e-4),
    **dict.fromkeys(("slip_speed_1_mps", "slip_speed_2_mps", "slip_speed_3_mps"), (0.2, 0.005)),
    "imu_yaw_offset_rad": (0.01, 3.5e-4),
    **dict.fromkeys(("accel_bias_x_mps2", "accel_bias_y_mps2"), (0.05, 2e-3)),
}
_INTEGRALS = (
    *(("yaw_rad", "yaw_rate_radps"), ("speed_x_mps", "accel_x_mps2"), ("speed_y_mps", "accel_y_mps2")),
)
_N_SHARED, _POSITION, _SITE_STD_M = 12, ("position_x_m", "position_y_m"), 100.0
_X, _Y, _YAW, _VX, _VY, _W, _AX, _AY = range(8)  # places in the state
_STEER, _BIAS, _SLIP, _OFFSET, _ACCEL_BIAS = 8, 11, 12, 15, 16

# Rows of each sensor, in the order in which they are judged, each after those that it rests on: turning, speed, and
# last the wheels, which may slip.  What a sample scatters by on a robot that moves, with vibration and delays, is
# chosen on simulated runs so that the errors of vio15 are on average those that it states; likelihood is no guide where
# a low-pass colours the noise of every sensor.
_SENSORS: dict[str, tuple[tuple[str, ...], float | tuple[float, ...]]] = {
    "camera_yaw_rate": (CAMERA_ROWS[2:3], 0.0012),
    "camera_yaw": (CAMERA_ROWS[3:], 0.0005),
    "gyro": (("gyro_z_radps",), 0.0012),
    "imu_yaw": (("imu_yaw_rad",), 0.05),
    "camera_speed": (CAMERA_ROWS[:2], 0.0006),
    "gnss_position": (GNSS_ROWS[:2], 0.02),
    "gnss_speed": (GNSS_ROWS[2:], 0.03),
    "accel": (("accel_x_mps2", "accel_y_mps2"), 0.03),
    "steer_1": (_STEER_ROWS[:1], 0.0005),
    "steer_2": (_STEER_ROWS[1:2], 0.0005),
    "steer_3": (_STEER_ROWS[2:], 0.0005),
    # of the circumferential speed in m/s, mostly the ripple of the Hall steps
    "wheel_1": (_WHEEL_ROWS[:1], 0.007),
    "wheel_2": (_WHEEL_ROWS[1:2], 0.007),
    "wheel_3": (_WHEEL_ROWS[2:], 0.007),
    # On soft ground a robot whose wheels stand still turns by 2 mrad/s, evenly, for the second that a stop lasts: one
    # error a stop, which in each of its fifty ticks counts as sqrt(50) times as large.
    "rest": (_REST_ROWS, (0.005, 0.005, 0.015)),
}
_SLIP_STD_MPS = 0.15  # wheel speed minus ground speed, where both are measured and slip is no state (vio12)
_HELD = ("camera_yaw_rate", "camera_yaw", "gyro", "camera_speed", "accel", "rest")
# Behind the low-pass of the encoders' rates, 0.1 s, a sample scatters by a third of what it did; it counts as
# half, as then the scatter of one tick is much like that of the tick before.
_LOW_PASSED = 0.5

# R, Q a step and P0 of the thesis: (6.13), (6.14), (6.9) with a camera, (4.40), (4.41), (4.38) without, in the order of
# rows and states.
_THESIS = {
    True: (
        (*[0.05] * 3, *[0.001] * 2, 0.001, 0.01, *[1e-5] * 3, *[5e-5] * 2, 0.001, 0.0005),
        (*[0.5] * 2, 0.08, *[0.08] * 2, 0.15, *[0.12] * 2, *[0.002] * 3, 0.002),
        (*[1e-5] * 8, *[1.5e-4] * 3, 1e-4),
    ),
    False: (
        (*[1e-5] * 7, *[7.2e-5] * 3),
        (*[1e-8] * 3, *[1e-6] * 2, 1e-5, *[1e-3] * 2, *[7.2e-5] * 3),
        (*[1e-6] * 6, *[1e-3] * 2, *[1e-1] * 3),
    ),
}

# Places in `params`: radius, places of the wheels and of the camera, what there is, and as inputs the growth of each
# wheel's speed, in 1/s.
_RADIUS, _PLACES, _CAMERA_X, _CAMERA_Y, _HAS_SLIP, _HAS_CAMERA, _HAS_GNSS, _GROWTH = 0, 1, 7, 8, 9, 10, 11, 12


@njit
def propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    """(4.30)-(4.35): the motion; and what vio15 has beside random walks."""
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    east, north = x[_VX] * cos - x[_VY] * sin, x[_VX] * sin + x[_VY] * cos
    for i in range(x.size):
        x_next[i] = x[i]
        f[i, i] = 1.0
    x_next[_X] += dt * east
    f[_X, _YAW], f[_X, _VX], f[_X, _VY] = -dt * north, dt * cos, -dt * sin
    x_next[_Y] += dt * north
    f[_Y, _YAW], f[_Y, _VX], f[_Y, _VY] = dt * east, dt * sin, dt * cos
    x_next[_YAW] += dt * x[_W]
    f[_YAW, _W] = dt
    x_next[_VX] += dt * (x[_AX] + x[_W] * x[_VY])
    f[_VX, _AX], f[_VX, _W], f[_VX, _VY] = dt, dt * x[_VY], dt * x[_W]
    x_next[_VY] += dt * (x[_AY] - x[_W] * x[_VX])
    f[_VY, _AY], f[_VY, _W], f[_VY, _VX] = dt, -dt * x[_VX], -dt * x[_W]
    if params[_HAS_SLIP] > 0.0:
        for state, rate in (
            (_AX, -_FADING_PER_S),
            (_AY, -_FADING_PER_S),
            (_BIAS, -_GYRO_FADING_PER_S),
            (_ACCEL_BIAS, -_ACCEL_FADING_PER_S),
            (_ACCEL_BIAS + 1, -_ACCEL_FADING_PER_S),
            (_SLIP, params[_GROWTH]),
            (_SLIP + 1, params[_GROWTH + 1]),
            (_SLIP + 2, params[_GROWTH + 2]),
        ):
            f[state, state] = math.exp(dt * rate)
            x_next[state] = f[state, state] * x[state]
        x_next[_OFFSET] += dt * x[_BIAS]
        f[_OFFSET, _BIAS] = dt


@inner
def _add(row: int, state: int, x: Array, z_hat: Array, h: Array) -> None:
    z_hat[row] += x[state]
    h[row, state] = 1.0


@njit
def observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    """(4.20), (4.28) and (6.6): what all sensors measure."""
    z_hat[:] = 0.0
    has_slip, radius = params[_HAS_SLIP] > 0.0, params[_RADIUS]
    for i in range(3):
        place_x, place_y = params[_PLACES + 2 * i], params[_PLACES + 2 * i + 1]
        cos, sin, scale = math.cos(x[_STEER + i]), math.sin(x[_STEER + i]), 1.0 / radius
        forward, left = point_velocity(x[_VX], x[_VY], x[_W], place_x, place_y)
        along, across = in_wheel_frame(forward, left, cos, sin)
        z_hat[i] = scale * along
        h[i, _VX], h[i, _VY] = scale * cos, scale * sin
        h[i, _W] = scale * (place_x * sin - place_y * cos)
        h[i, _STEER + i] = scale * across
        if has_slip:
            z_hat[i] += x[_SLIP + i] / radius
            h[i, _SLIP + i] = 1.0 / radius
    for row, state in (
        (3, _AX),
        (4, _AY),
        (5, _W),
        (5, _BIAS),
        (6, _YAW),
        (7, _STEER),
        (8, _STEER + 1),
        (9, _STEER + 2),
    ):
        _add(row, state, x, z_hat, h)
    if has_slip:
        for row, state in ((3, _ACCEL_BIAS), (4, _ACCEL_BIAS + 1), (6, _OFFSET)):
            _add(row, state, x, z_hat, h)
    row = 10
    if params[_HAS_CAMERA] > 0.0:
        camera_x, camera_y = params[_CAMERA_X], params[_CAMERA_Y]
        z_hat[row], z_hat[row + 1] = point_velocity(x[_VX], x[_VY], x[_W], camera_x, camera_y)
        h[row, _VX], h[row, _W] = 1.0, -camera_y
        h[row + 1, _VY], h[row + 1, _W] = 1.0, camera_x
        _add(row + 2, _W, x, z_hat, h)
        _add(row + 3, _YAW, x, z_hat, h)
        row += 4
    if has_slip:  # at rest
        for i in range(3):
            _add(row + i, _VX + i, x, z_hat, h)
        row += 3
    if params[_HAS_GNSS] > 0.0:
        cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
        _add(row, _X, x, z_hat, h)
        _add(row + 1, _Y, x, z_hat, h)
        east, north = x[_VX] * cos - x[_VY] * sin, x[_VX] * sin + x[_VY] * cos
        z_hat[row + 2], z_hat[row + 3] = east, north
        h[row + 2, _VX], h[row + 2, _VY], h[row + 2, _YAW] = cos, -sin, -north
        h[row + 3, _VX], h[row + 3, _VY], h[row + 3, _YAW] = sin, cos, east


def make_filter(name: str, robot: Robot, with_gnss: bool = False, thesis: bool = False) -> FilterModel:
    """Return one of the filters for a robot, with physical noise, or that of the thesis.

    Physical noise is how fast a robot changes and what its sensors scatter by.  A sensor scatters by what vibration
    and delays do to it on any robot, or by what the description says of it, whichever is more; of n samples a tick, by
    1 / sqrt(n) of that.

    Parameters
    ----------
    name : one of :data:`FILTERS`
    robot : a swerve robot, with a camera for vio12 and vio15
    with_gnss : whether it has the four rows of GNSS; yaw is that of the world then, and ``imu_yaw_rad`` and
        ``camera_yaw_rad`` have to be turned to it, or left NaN
    thesis : whether the noise is that printed in the thesis, to compare with, where there is any: (6.13), (6.14) and
        (6.9) with a camera, else (4.38) to (4.41), Q over :data:`THESIS_SAMPLE_TIME_S`

    Raises
    ------
    ConfigError
        where there is no such filter, or it is none for the robot.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> model = make_filter("vio15", load_robot("agrimaro"))
    >>> len(model.states), len(model.rows), model.references
    (18, 17, ('camera_speed',))
    """
    if name not in FILTERS:
        raise ConfigError(f"filter {name!r} is unknown: use one of {', '.join(FILTERS)}")
    as_drive(SwerveRobot, robot, f"robot {{name}} has the drive {{drive!r}}: filter {name} is for 'swerve'")
    has_slip, has_camera = name == "vio15", name != "encoder12"
    lever_m = (0.0, 0.0)
    if has_camera:
        robot.require("camera")
        lever_m = robot.camera.lever_x_m, robot.camera.lever_y_m
    states = tuple(_STATES)[: None if has_slip else _N_SHARED]
    rows = (*ROWS[:10], *CAMERA_ROWS * has_camera, *_REST_ROWS * has_slip, *GNSS_ROWS * with_gnss)
    initial_std, walk_std = np.array(list(_STATES.values()))[: len(states)].T
    if with_gnss:
        initial_std[:2] = _SITE_STD_M
    process, initial, least = walk_std**2, initial_std**2, dict[str, float]()
    if robot.describes("sensors"):
        described = robot.sensors
        wheels_hz = described.wheels_rate_hz
        imu = math.sqrt(wheels_hz / max(described.imu_rate_hz, wheels_hz))
        least["accel"], least["gyro"] = described.accel_std_mps2 * imu, described.gyro_std_radps * imu
        least["imu_yaw"] = described.yaw_std_rad * imu
        least |= dict.fromkeys(("steer_1", "steer_2", "steer_3"), described.steering_std_rad * _LOW_PASSED)
        if robot.describes("camera"):
            camera = robot.camera
            seen = _LOW_PASSED * math.sqrt(wheels_hz / max(camera.rate_hz, wheels_hz))
            least["camera_speed"], least["camera_yaw"] = (
                camera.speed_std_mps * seen,
                camera.yaw_std_rad * seen,
            )
            least["camera_yaw_rate"] = camera.yaw_rate_std_radps * seen
    sensors, variance = dict[str, tuple[str, ...]](), np.empty(len(rows))
    for sensor, (group, scatter) in _SENSORS.items():
        if group[0] in rows:
            sensors[sensor], std = group, np.array(scatter)
            if group[0] in _WHEEL_ROWS:
                std = np.array(_SLIP_STD_MPS if name == "vio12" else scatter) / robot.wheel_radius_m
            variance[list(map(rows.index, group))] = np.maximum(std, least.get(sensor, 0.0)) ** 2
    if thesis:
        r, q, p0 = _THESIS[has_camera]
        process[: len(q)] = np.array(q) / THESIS_SAMPLE_TIME_S
        process[_SLIP:_OFFSET] = SLIP_MPS**2
        variance[: len(r)], initial[: len(p0)] = r, p0
    return FilterModel(
        name=f"{name} with GNSS" if with_gnss else name,
        states=states,
        rows=rows,
        sensors=tuple(sensors.items()),
        propagate=propagate,
        observe=observe,
        params=np.array(
            [
                robot.wheel_radius_m,
                *robot.wheel_positions_m.ravel(),
                *lever_m,
                has_slip,
                has_camera,
                with_gnss,
            ]
        ),
        process_variance=process,
        measurement_variance=variance,
        initial_variance=initial,
        inputs=DERIVED_ROWS[1:4] if has_slip else (),
        references=(*("camera_speed",) * has_camera, *("gnss_speed",) * with_gnss),
        held=_HELD if has_slip else (),
        positions=_POSITION,
        integrals=() if thesis else _INTEGRALS,
        angle_states=("yaw_rad", *_STEER_ROWS),
        angle_rows=("imu_yaw_rad", *_STEER_ROWS, *CAMERA_ROWS[3:] * has_camera),
    )


# Places of the derived rows among those of the feed, which all tables of a swerve robot begin with.
_GROWTHS, _CHANGES = slice(GROWTH, GROWTH + 3), slice(CHANGE, CHANGE + 3)
SHAKEN_S, CHANGED_RATIO, SHAKEN_TURN_S, SHAKEN_ACCEL_RATIO = 0.09, 0.4, 0.02, 0.5
SLIP_MPS, STARTED_RATIO, STARTED_SLIPS, VARIED_SLIPS = 0.03, 0.15, 2.5, 0.5


def scheduled(
    model: FilterModel, z: Array, gnss_variance: Array, physical: bool = True
) -> tuple[Array | None, Array | None, Array | None]:
    """Return what changes from tick to tick: variances (n, m), walks (n, d) and inputs (n, k); None where nothing does.

    Each position has the variance of its own fix.  Beside that, of a filter with slip speeds and physical noise:

    The slip of a wheel changes with the ground under it, which shows as vibration a_z, and with its thrust,
    which shows as a change of the wheel's speed w.  The latter is written so that a start from rest leaves a
    slip ratio of 0 +- 0.4, fast or slow: slip speeds walk by, in a second::

        q = (0.03 m/s)^2 + (0.09 s a_z)^2 + 0.4^2 |d(w^2)/dt|

    What vibration does to slip goes back and forth: it leads nowhere over seconds without a camera.  There slip
    is what it was on this ground, s (the row ``ground_slip_ratio``), and varies in proportion to it, on tiles by
    thousandths, on loam by tenths, as the ground, its slope and the thrust do::

        q = (0.5 s w)^2 + (0.15^2 + (2.5 s)^2) |d(w^2)/dt|

    Rough ground, and wheels that change their speed while they are still being steered, turn the robot, too:
    the yaw rate walks by the mean of ``(0.02 s a_z)^2 + 0.4^2 |d(w^2)/dt|`` over the squared distance of a
    wheel from the origin.

    An accelerometer has ``R = R_quiet + (0.5 a_z)^2``; as on rough ground where the vibration is unknown.

    Parameters
    ----------
    z : (n, rows) of :data:`terrain.estimation.feed.ROWS`; derived rows that are NaN count as nothing
    gnss_variance : (n, 4) of the rows of GNSS
    """
    variance, is_scheduled = None, physical and bool(model.inputs)
    if is_scheduled or GNSS_ROWS[0] in model.rows:
        variance = np.tile(model.measurement_variance, (len(z), 1))
    if variance is not None and GNSS_ROWS[0] in model.rows:
        variance[:, -len(GNSS_ROWS) :] = gnss_variance
    if variance is None or not is_scheduled:
        return variance, None, None
    known = np.where(np.isnan(z), 0.0, z)
    shaken, changed, growth = known[:, [VIBRATION]], known[:, _CHANGES], known[:, _GROWTHS]
    vibration = np.where(np.isnan(z[:, [VIBRATION]]), UNKNOWN_MPS2, shaken)
    variance[:, 3:5] += (SHAKEN_ACCEL_RATIO * vibration) ** 2
    unseen = ~(z[:, [SEEN_AGE]] <= UNSEEN_AFTER_S)
    slip = known[:, [GROUND_SLIP]]
    by_ground = (VARIED_SLIPS * slip * model.params[_RADIUS] * known[:, :3]) ** 2
    varied = np.where(unseen, by_ground, SLIP_MPS**2 + (SHAKEN_S * shaken) ** 2)
    ratio = np.where(unseen, np.hypot(STARTED_RATIO, STARTED_SLIPS * slip), CHANGED_RATIO)
    walk = np.zeros((len(z), len(model.states)))
    walk[:, _SLIP:_OFFSET] = varied + 2.0 * ratio**2 * changed
    changes = changed[:, 0] + changed[:, 1] + changed[:, 2]
    turned = 3.0 * (SHAKEN_TURN_S * shaken[:, 0]) ** 2 + 2.0 * CHANGED_RATIO**2 * changes
    walk[:, _W] = turned / float((model.params[_PLACES:_CAMERA_X] ** 2).sum())
    return variance, walk, growth


def statuses(model: FilterModel, use: Array, z: Array, age_s: Array) -> Array:
    """Return what the estimates are worth at ticks (n,), in the order in which the other observers say it.

    Parameters
    ----------
    use : (n, sensors) of a track
    z : (n, rows) of :data:`terrain.estimation.feed.ROWS`
    age_s : (n,) time since the speed over ground was measured
    """
    has_reference = bool(model.references)
    cases = (
        (ObserverStatus.STARTING, has_reference & (age_s == np.inf)),
        (ObserverStatus.BAD_INPUT, ~np.isfinite(z[:, :3]).any(axis=1)),
        (ObserverStatus.RESET, (use == REOPENED).any(axis=1)),
        (ObserverStatus.REJECTED, (use == GATED).any(axis=1)),
        (ObserverStatus.STANDING, np.isfinite(z[:, REST_TWIST])),
        (ObserverStatus.PREDICTED, has_reference & (age_s > STALE_AFTER_S)),
    )
    codes = np.full(len(age_s), int(ObserverStatus.OK))
    for code, where in reversed(cases):
        codes[where] = code
    return codes
