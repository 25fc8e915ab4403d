r"""Kinematics of a robot of any drive by whatever measured its motion: poses, a lidar, a receiver or a camera.

Between two instants the wheels, through the drive's kinematics without slip
(:func:`~terrain.kinematics.wheels.rolled_twist`), move the sensor at l on the body by a change of place and of yaw;
the reference has the same change as measured.  With the yaw psi of the gyro, or of the wheels where there is none,
over legs of some seconds, which overlap,

.. math:: r = R(-\psi_a - \gamma)\Big[\int_a^b R(\psi)\, v\, dt + \big(R(\psi_b) - R(\psi_a)\big) l\Big]
    - R(-\psi_a)_\mathrm{ref}\,(p_b - p_a)_\mathrm{ref}

beside the changes of yaw by wheels, gyro and reference, are least squares (soft L1) in the parameters of the drive.
Neither accelerations nor rates are differentiated; a place is the mean over a fifth of a second of what is measured
and of what is computed alike.

**A receiver has no heading.**  That of the gyro is turned by one angle a block of :data:`BLOCK_S`, and its bias is one
number a run; both are solved for in closed form at each step of the fit (variable projection), the angle as the one
that turns the computed changes of place onto the measured ones, the bias as what is left of their directions along
time, beside a prior about what the gyro shows at rest.

**Delays** are behind the gyro, behind the wheels where there is none.

**Intervals.**  What legs near to each other have in common (slip, weather, a wave of the floor) makes their errors
alike: clusters are sessions, or runs, or blocks of time where there are too few of these, and the covariance is that of
leaving each out (:mod:`terrain.identify`).  Blocks hold other parts of the same drive; another outing is not in them.

**What is not separated.**  A rolling radius contains the mean slip of the ground; of robots that skid, whose tyres or
tracks always slip, the interval contains what is assumed of it.  The centre about which such a robot turns and the
place of a sensor ahead of it are one number.  Of a car the gain of the steering and the wheelbase are one, the
effective wheelbase; a wheel that drives and is steered shows both.  Slip by traction, which over a second looks like a
delay, is fitted beside it.  An effective track goes with the described radius (Mandow et al., Experimental kinematics
for wheeled skid-steer mobile robots, IROS 2007), and is one of the ground and of the turns driven.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d

from terrain.angles import unwrapped
from terrain.calibration.finding import Finding, around, undetermined
from terrain.calibration.sensors import MIN_POWER_ONS, Stretch, seen_motion, standing
from terrain.constants import GRAVITY_MPS2
from terrain.effects import PARAMETER
from terrain.errors import DataError
from terrain.estimation.feed import FIX_STD_M, FLOAT_STD_M
from terrain.identify import Fit, Parameter, half_width, identify
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import rolled_twist
from terrain.logs.schema import POSE_CHANNELS, TWIST
from terrain.records import Array, RunLog, Stream
from terrain.robots import BicycleRobot, Robot

#: What measures motion, what shows most first, and the length of a leg: a robot of 0.1 m/s moves by a hundred times the
#: noise of motion capture in a second, and one of 0.5 m/s by as much of a receiver's in three.
LEG_S: Mapping[str, float] = {"pose": 1.0, "lidar": 1.0, "gnss": 3.0, "odometry": 1.0}
#: Legs begin so often within the length of one, so that a fit hardly depends on where the first does.
STRIDES = 4
CLOCK_S = 0.04  #: Step of the integrals; no machine of a metre turns faster than that shows.
AVERAGED_S = 0.1  #: Places are averaged over that on either side of an end.
MAX_GAP_S = 0.6  #: Longest time without a sample of wheels, gyro or speeds within a leg.
#: A leg whose wheels move the sensor by less, and turn it by less, shows nothing.
STILL_M, STILL_RAD = 0.02, 0.02
BLOCK_S = 30.0  #: Over which a gyro without bias keeps a heading.
BIAS_STD_RADPS = 0.02  #: Of a gyro's bias before, without rest in the run.
BLOCKS, MIN_BLOCKS = (
    12,
    6,
)  #: Clusters of time: usual number, where a block is then longer than a leg, and the least.
LONGEST_BLOCK_S = 20.0  #: Of a cluster: slower than that, grounds and temperatures change.
MIN_GROUPS = 4  #: Of sessions or runs as clusters.
MIN_LEGS = 48
APART_S = 10.0  #: Runs are laid out on one axis of time, so far apart.
FIRST_ERROR = 0.02  #: Size of residuals that a fit begins with, in m and rad, and the least.
LEAST_ERROR = 1e-4
NEAR_BOUND = 0.02  #: Part of the range of a parameter within which it stands at its end.
TRIED_S = 0.1  #: Steps of delays that are tried before.
DIFFERENCE = 0.01  #: Step of a derivative, in units of the search.
SLIP_STEPS = 2  #: Of the slip by traction and the acceleration that it leaves.
HEADING_STEPS = 3  #: Of the heading of a receiver and the weights of its fixes.
PASSES = 3  #: Of a fit that finds the sizes of its residuals.
STAMP_S = 0.001  #: A delay is trusted to that at best.
#: Slip of tyres that drive straight on over hard ground: a rolling resistance of 0.02 to 0.04 of the load over a slip
#: stiffness of 2 to 10 loads; and of tyres or tracks elsewhere: assumed, since nothing in a log tells it from the
#: radius.
SLIP_RATIO, SOFT_SLIP_RATIO = (0.0, 0.02), (0.0, 0.05)
WIDE, TIGHT = (
    0.3,
    1.0,
)  #: Difference of the sides over the sum of their sizes: a wide turn, and turning in place.

RADIUS, TRACK = "identified.rolling_radius_m", "identified.effective_track_m"
BIAS = "sensors.gyro_bias_z_radps"


def _known(name: str, **changed: float) -> Parameter:
    """Return a parameter of :mod:`terrain.effects` as one of a fit."""
    p = PARAMETER[name]
    return Parameter(name, 0.0, changed.get("low", p.low), changed.get("high", p.high), step=4.0 * p.step)


#: Parameters of a fit; those of effects have their names.  A firm ground has no slip that others could have less
#: of, and clocks differ, so that delays have either sign.
PARAMETERS: Mapping[str, Parameter] = {
    p.name: p
    for p in (
        _known("wheel_radius_ratio"),
        _known("force_slip_ratio", low=0.0),
        _known("wheel_distance_ratio", low=-0.5, high=1.0),
        _known("wheelbase_ratio"),
        _known("steering_gain_ratio"),
        _known("steering_offset_front_rad"),
        _known("understeer_s2pm"),
        _known("cornering_stiffness_ratio"),
        _known("camera_yaw_rad"),
        Parameter("lever_x_m", 0.0, prior_std=1.0, step=0.1),
        Parameter("lever_y_m", 0.0, prior_std=1.0, step=0.1),
        Parameter("camera_latency_s", 0.0, -0.5, 1.0, step=0.02),
        Parameter("wheels_delay_s", 0.0, -0.5, 0.5, step=0.02),
        Parameter("steering_delay_s", 0.0, -0.5, 0.5, 0.1, step=0.02),
        Parameter("gyro_scale_ratio", 0.0, -0.2, 0.2, prior_std=0.02),
        Parameter("effective_track_ratio", 0.0, -0.5, 5.0, step=0.05),
        Parameter(
            "narrowing_ratio", 0.0, -3.0, 3.0, prior_std=0.5
        ),  # of the track from wide turns to tight ones
        Parameter("turn_slip_ratio", 0.0, -0.3, 0.9, prior_std=0.1),  # speed that a turn in place would take
    )
}


class Number(NamedTuple):
    """A number of a description that follows from a fitted parameter."""

    place: str  #: in the description; ``{}`` is the reference
    of: str  #: parameter
    value: Callable[..., float]  #: of the robot and the parameter
    widest: float  #: interval of the parameter from which on it is not stated


def _plain(robot: Robot, e: float) -> float:
    return e


def _of_camera(name: str) -> Callable[[Robot, float], float]:
    return lambda robot, e: float(getattr(robot.completed.camera, name)) + e


def _of_antenna(name: str) -> Callable[[Robot, float], float]:
    return lambda robot, e: float(getattr(robot.parts.get("antenna"), name, 0.0)) + e


GAIN = "steering_gain_ratio"
KINEMATIC = (
    Number(RADIUS, "wheel_radius_ratio", lambda robot, e: robot.wheel_radius_m * (1.0 + e), 0.1),
    Number(TRACK, "effective_track_ratio", lambda robot, e: robot.track_m * (1.0 + e), 0.5),
    Number(
        *("identified.wheel_distance_m", "wheel_distance_ratio"),
        lambda robot, e: robot.wheel_distance_m * (1.0 + e),
        0.06,
    ),
    Number("identified.wheelbase_m", "wheelbase_ratio", lambda robot, e: robot.wheelbase_m * (1.0 + e), 0.15),
    Number("identified.steering_gain_ratio", GAIN, lambda robot, e: 1.0 + e, 0.3),
    Number("identified.effective_wheelbase_m", GAIN, lambda robot, e: robot.wheelbase_m / (1.0 + e), 0.3),
    Number("identified.steering_offset_rad", "steering_offset_front_rad", _plain, 0.2),
    Number(
        "identified.understeer_s2pm", "understeer_s2pm", lambda robot, e: e + robot.understeer_s2pm, 0.035
    ),
    Number("identified.wheels_delay_s", "wheels_delay_s", _plain, 0.25),
    Number("identified.steering_delay_s", "steering_delay_s", _plain, 0.1),
    Number("identified.gyro_scale_ratio", "gyro_scale_ratio", lambda robot, e: 1.0 / (1.0 + e), 0.02),
)
#: Of the sensor that is the reference: its place, its yaw in the body, its delay.
SENSOR: Mapping[str, tuple[Number, ...]] = {
    "pose": (
        Number("identified.pose_x_m", "lever_x_m", _of_camera("lever_x_m"), 1.0),
        Number("identified.pose_y_m", "lever_y_m", _of_camera("lever_y_m"), 1.0),
        Number("identified.pose_yaw_rad", "camera_yaw_rad", lambda robot, e: -e, 0.2),
        Number("identified.pose_delay_s", "camera_latency_s", _of_camera("latency_s"), 0.5),
    ),
    "lidar": (Number("identified.lidar_delay_s", "camera_latency_s", _plain, 0.25),),
    "gnss": (
        Number("antenna.lever_x_m", "lever_x_m", _of_antenna("lever_x_m"), 0.5),
        Number("antenna.lever_y_m", "lever_y_m", _of_antenna("lever_y_m"), 0.5),
        Number("identified.gnss_delay_s", "camera_latency_s", _plain, 0.25),
    ),
    "odometry": (
        Number("camera.lever_x_m", "lever_x_m", _of_camera("lever_x_m"), 0.5),
        Number("camera.lever_y_m", "lever_y_m", _of_camera("lever_y_m"), 0.5),
        Number("identified.odometry_delay_s", "camera_latency_s", _plain, 0.25),
    ),
}
#: The gain of a steering and the wheelbase of a robot that does not drive by it are one number, the other's.
NOT_OF: Mapping[str, str] = {"steering_gain_ratio": "bicycle", "effective_wheelbase_m": "tricycle"}


def parameters_of(robot: Robot, source: str, has_gyro: bool) -> tuple[str, ...]:
    """Return the parameters that a reference shows of a drive.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> parameters_of(load_robot("omnirobot"), "pose", False)[1:3]
    ('force_slip_ratio', 'wheel_distance_ratio')
    >>> parameters_of(load_robot("husky"), "gnss", True)[-3:]
    ('camera_latency_s', 'wheels_delay_s', 'gyro_scale_ratio')
    """
    names = ["wheel_radius_ratio", "force_slip_ratio"]
    if robot.skids:
        names += ["effective_track_ratio", "narrowing_ratio", "turn_slip_ratio"]
    elif robot.on_omni_wheels:
        names += ["wheel_distance_ratio"]
    elif isinstance(robot, BicycleRobot):
        names += [GAIN, "steering_offset_front_rad"]
        own = ["wheelbase_ratio"], ["understeer_s2pm", "cornering_stiffness_ratio"]
        names += own[0] if robot.front_driven else own[1]
    names += ["steering_delay_s"] * robot.steered
    names += ["camera_yaw_rad"] * (source != "gnss") + ["lever_x_m", "lever_y_m"]
    names += ["camera_latency_s"]
    return (*names, *["wheels_delay_s", "gyro_scale_ratio"] * has_gyro)


class Reference(NamedTuple):
    """The path of a sensor, as a reference measured it."""

    time_s: Array  #: (n,) stamps
    place: Array  #: (n,) complex, in a fixed frame of its own
    yaw_rad: Array  #: (n,) of the sensor there; 0 of a receiver
    std_m: Array  #: (n,) of a place; 1 where none is stated
    broken: Array  #: (n,) gaps before a sample, through which no speed was measured
    has_yaw: (
        bool  #: whether it measures yaw, and not only a path; that of a camera without one is by the gyro
    )


def reference(run: RunLog, robot: Robot, source: str) -> Reference | None:
    """Return what a stream shows of the motion of a run; None where it shows nothing."""
    stream = run.streams.get(source)
    if stream is not None and source == "odometry" and not set(TWIST[:2]) <= set(stream.channels):
        seen = seen_motion(Stretch(run), robot)
        stream = None if seen is None else Stream(seen.time_s, seen.values[:, :3], TWIST)
    if stream is None or len(stream) < 2:
        return None
    has, time_s, std = set(stream.channels), stream.time_s, np.ones(len(stream))
    yaw, broken, has_yaw = np.zeros(len(stream)), np.zeros(len(stream)), source != "gnss"
    if has >= set(POSE_CHANNELS[: 2 + (source == "pose")]) and source in ("pose", "gnss"):
        x, y = stream.columns(POSE_CHANNELS[:2]).T
        place = x + 1j * y
        if source == "pose":
            yaw = unwrapped(stream.channel("yaw_rad"))
        else:
            fix = stream.channel("fix_ratio") if "fix_ratio" in has else np.ones(len(stream))
            std = np.where(fix >= 0.5, FIX_STD_M, FLOAT_STD_M)
            if "std_position_m" in has:
                std = np.where(stream.channel("std_position_m") > 0.0, stream.channel("std_position_m"), std)
            place = np.where(fix > 0.0, place, np.nan)
        known = np.isfinite(place) & np.isfinite(yaw)
    else:  # speeds, which are summed
        names = ("velocity_x_mps", "velocity_y_mps") if source == "gnss" else TWIST[:2]
        if source == "pose" or not has >= set(names):
            return None
        has_yaw = has_yaw and TWIST[2] in has
        rate = stream.channel(TWIST[2]) if has_yaw else np.zeros(len(stream))
        if not has_yaw and source != "gnss":
            imu = Stretch(run).of("imu", ("gyro_z_radps",))
            rate = rate + np.nan if imu is None else np.interp(time_s, imu.time_s, imu.values[:, 0])
        values = np.column_stack([stream.columns(names), rate])
        known = np.isfinite(values).all(axis=1)
        if known.sum() < 2:
            return None
        yaw[known] = cumulative_trapezoid(values[known, 2], time_s[known], initial=0.0)
        speed = (values[:, 0] + 1j * values[:, 1]) * np.exp(1j * yaw)
        place = np.full(len(stream), np.nan + 0j)
        place[known] = cumulative_trapezoid(speed[known], time_s[known], initial=0.0)
        broken[known] = np.cumsum(
            np.diff(time_s[known], prepend=time_s[0]) > 2.5 * np.median(np.diff(time_s))
        )
    if known.sum() < 2:
        return None
    return Reference(time_s[known], place[known], yaw[known], std[known], broken[known], has_yaw)


class Log(NamedTuple):
    """Runs on one axis of time, one after the other, and their legs."""

    runs: tuple[RunLog, ...]
    source: str  #: the reference
    clock_s: Array  #: (n,) of the integrals
    wheels_s: Array  #: (w,) stamps of wheel speeds (w, wheels)
    speed_mps: Array
    steer_s: Array  #: (k,) stamps of steering angles (k, wheels), zeros taken off
    steer_rad: Array
    gyro_s: Array  #: (g,) stamps of the gyro, and its integral; none without a gyro
    turned_rad: Array
    bias_radps: Array  #: (runs,) of the gyro at rest; 0 where the run has none
    stamps_s: Array  #: (m,) of the samples of the reference that ends average
    end_of: Array  #: (m,) number of the end of each, from 0 to e - 1
    pairs: Array  #: (legs, 2) numbers of the ends of each leg
    middle_s: Array  #: (legs,) instant of the middle
    moved: Array  #: (legs,) complex change of place as measured: in the frame of the sensor at first, or the receiver's
    turned: Array  #: (legs,) change of yaw
    weight: Array  #: (legs,) of its place: usual deviation over its own
    std_m: float  #: usual deviation of a change of place, as a receiver states it
    run: Array  #: (legs,) number of the run
    block: Array  #: (legs,) number of the heading of a receiver
    clock_run: Array  #: (n,) number of the run
    has_yaw: bool  #: whether the reference measures yaw
    sharp: float  #: usual :func:`sharpness` of turns


def _laid_out(run: RunLog, robot: Robot, source: str, leg_s: float) -> dict[str, Array] | str:
    """Return the parts of :class:`Log` that a run has; or why it has none, in words."""
    run = with_wheel_speeds(run, robot)
    wheels, steering, imu = (run.streams.get(name) for name in ("wheels", "steering", "imu"))
    names = [f"speed_{wheel}_mps" for wheel in robot.logged_wheels]
    if wheels is None or not set(names) <= set(wheels.channels):
        return f"it has no wheel speeds ({', '.join(names)})"
    if robot.steered and (steering is None or not set(robot.steer_channels) <= set(steering.channels)):
        return f"it has no steering angles ({', '.join(robot.steer_channels)})"
    seen = reference(run, robot, source)
    if seen is None:
        return f"it has no {WORDS[source]} (stream {source!r})"
    speeds = wheels.columns(names)
    known = np.isfinite(speeds).all(axis=1)
    wheels_s, speeds = wheels.time_s[known], speeds[known]
    if len(wheels_s) < 2:
        return f"it has no wheel speeds ({', '.join(names)})"
    steer_s, steer = wheels_s[:1], np.zeros((1, len(robot.wheels)))
    if robot.steered and steering is not None:
        angles = np.column_stack([unwrapped(steering.channel(name)) for name in robot.steer_channels])
        there = np.isfinite(angles).all(axis=1)
        steer_s, steer = steering.time_s[there], np.zeros((int(there.sum()), len(robot.wheels)))
        steer[:, : angles.shape[1]] = angles[there] - robot.steering_zeros_rad[: angles.shape[1]]
        if not len(steer_s):
            return f"it has no steering angles ({', '.join(robot.steer_channels)})"
    gyro_s, turned, gap_s = np.empty(0), np.empty(0), [wheels_s]
    if imu is not None and "gyro_z_radps" in imu.channels:
        rate = imu.channel("gyro_z_radps")
        there = np.isfinite(rate)
        if there.sum() > 1:
            gyro_s = imu.time_s[there]
            turned = cumulative_trapezoid(rate[there], gyro_s, initial=0.0)
            gap_s.append(gyro_s)
    # poses show what was a delay before
    margin_s = PARAMETERS["camera_latency_s"].high / 2.0
    first_s = max(max(each[0] for each in gap_s) + margin_s, seen.time_s[0] + AVERAGED_S)
    last_s = min(min(each[-1] for each in gap_s) - margin_s, seen.time_s[-1])
    at_s = np.arange(first_s, last_s, leg_s / STRIDES)
    if not len(at_s):
        return f"wheels and {WORDS[source]} overlap by less than a leg of {leg_s:g} s"
    nearest = np.clip(np.round((seen.time_s - at_s[0]) / (leg_s / STRIDES)).astype(int), 0, len(at_s) - 1)
    apart_s = np.abs(seen.time_s - at_s[nearest])  # of a slow reference the nearest sample is an end
    near = apart_s <= max(AVERAGED_S, min(leg_s / STRIDES, float(np.median(np.diff(seen.time_s)))) / 2)
    end_of, n = nearest[near], len(at_s)
    count = np.bincount(end_of, minlength=n)
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = seen.place.real, seen.place.imag, seen.yaw_rad, seen.std_m**2, seen.broken
        x, y, yaw, variance, broken = (np.bincount(end_of, each[near], minlength=n) / count for each in parts)
        end_s = np.bincount(end_of, seen.time_s[near], minlength=n) / count
    pairs = np.arange(max(n - STRIDES, 0))[:, None] + [0, STRIDES]
    whole = (count[pairs] > 0).all(axis=1) & (broken[pairs[:, 0]] == broken[pairs[:, 1]])
    for stamps_s in gap_s:  # of the gyro last, where there is one
        long_s = stamps_s[1:][np.diff(stamps_s) > MAX_GAP_S]
        gaps = np.searchsorted(long_s, at_s)
        whole &= gaps[pairs[:, 0]] == gaps[pairs[:, 1]]
    first, then = pairs[whole].T
    moved, turned_by = (x + 1j * y)[then] - (x + 1j * y)[first], yaw[then] - yaw[first]
    if source != "gnss":
        moved = moved * np.exp(-1j * yaw[first])
    rests = [each.of("imu", ("gyro_z_radps",)) for each in standing(run, robot)] if len(gyro_s) else []
    bias = [float(still.values.mean()) for still in rests if still is not None]
    return {
        "wheels_s": wheels_s,
        "speed_mps": speeds,
        "steer_s": steer_s,
        "steer_rad": steer,
        "gyro_s": gyro_s,
        "turned_rad": turned,
        "clock_s": np.arange(wheels_s[0], wheels_s[-1], CLOCK_S),
        "stamps_s": seen.time_s[near],
        "end_of": end_of,
        "n_ends": np.array([n]),
        "gaps": gaps[first],
        "pairs": pairs[whole],
        "middle_s": 0.5 * (end_s[first] + end_s[then]),
        "moved": moved,
        "turned": turned_by,
        "variance": (variance / count)[first] + (variance / count)[then],
        "bias_radps": np.array([np.mean(bias) if bias else 0.0]),
        "has_yaw": np.array([seen.has_yaw]),
    }


WORDS = {"pose": "poses", "lidar": "lidar speeds", "gnss": "fixes", "odometry": "camera"}


def lay_out(runs: Sequence[RunLog], robot: Robot, source: str, leg_s: float | None = None) -> Log:
    """Return runs on one axis of time with their legs.

    Raises
    ------
    DataError
        if none of the runs has wheels, steering and the reference.
    """
    period_s = [
        np.median(np.diff(run.streams[source].time_s)) for run in runs if len(run.streams.get(source, ())) > 1
    ]
    chosen_s = max(LEG_S[source] if leg_s is None else leg_s, 2.0 * float(np.median(period_s or [0.0])))
    parts, used, why = list[dict[str, Array]](), list[RunLog](), ""
    for run in runs:
        part = _laid_out(run, robot, source, chosen_s)
        if not isinstance(part, str) and len(part["pairs"]):
            parts.append(part)
            used.append(run)
        elif not why:
            nothing = f"it has no leg of {chosen_s:g} s with {WORDS[source]} at both ends"
            why = f"run {run.run_id}: {part if isinstance(part, str) else nothing}"
    if not parts:
        raise DataError(why or f"robot {robot.name}: no run has {WORDS[source]} (stream {source!r})")
    turned = [len(part["gyro_s"]) > 0 for part in parts]  # one kind of yaw for all: most runs decide
    if 2 * sum(turned) >= len(turned):
        parts = [part for part in parts if len(part["gyro_s"])]
        used = [run for run, has in zip(used, turned, strict=True) if has]
    else:
        parts = [part | {"gyro_s": np.empty(0), "turned_rad": np.empty(0)} for part in parts]
    from_s, n_ends, n_blocks = 0.0, 0, 0
    for number, part in enumerate(parts):
        stamps = [part[name] for name in ("wheels_s", "stamps_s", "gyro_s", "steer_s") if len(part[name])]
        shift_s = from_s - min(each[0] for each in stamps)
        from_s = max(each[-1] for each in stamps) + shift_s + APART_S
        for name in ("wheels_s", "steer_s", "gyro_s", "clock_s", "stamps_s", "middle_s"):
            part[name] = part[name] + shift_s
        part["end_of"], part["pairs"] = part["end_of"] + n_ends, part["pairs"] + n_ends
        n_ends += int(part.pop("n_ends")[0])
        part["run"] = np.full(len(part["pairs"]), number)
        part["clock_run"] = np.full(len(part["clock_s"]), number)
        time = np.floor((part["middle_s"] - part["clock_s"][0]) / BLOCK_S)
        block = np.unique([time, part.pop("gaps")], axis=1, return_inverse=True)[1].ravel()
        part["block"] = n_blocks + block
        n_blocks += int(block.max()) + 1
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    variance, has_yaw = joined.pop("variance"), bool(joined.pop("has_yaw").all())
    usual = float(np.median(variance))
    weight = np.minimum(np.sqrt(usual / variance), 1.0)
    log = Log(
        tuple(used), source, **joined, weight=weight, std_m=math.sqrt(usual), sharp=0.5, has_yaw=has_yaw
    )
    if robot.skids:
        turns = np.diff(log.speed_mps, axis=1)[:, 0] ** 2
        log = log._replace(sharp=float(turns @ sharpness(log.speed_mps) / max(turns.sum(), 1e-12)))
    legs = computed(log, robot, {}, log.bias_radps)
    moves = (np.abs(legs.moved) > STILL_M * chosen_s) | (np.abs(legs.by_wheels) > STILL_RAD * chosen_s)
    return of_legs(log, moves)


def of_legs(log: Log, chosen: Array) -> Log:
    """Return runs with some of their legs."""
    each = ("pairs", "middle_s", "moved", "turned", "weight", "run", "block")
    return log._replace(**{name: getattr(log, name)[chosen] for name in each})


def sharpness(sides_mps: Array) -> Array:
    """Return the difference of the sides over the sum of their sizes: 0 straight on, 1 of a turn in place.

    Examples
    --------
    >>> sharpness(np.array([[1.0, 1.0], [0.5, 1.0], [-1.0, 1.0], [0.0, 0.0]])).round(2).tolist()
    [0.0, 0.33, 1.0, 0.0]
    """
    left, right = sides_mps[:, 0], sides_mps[:, -1]
    return np.asarray(np.abs(right - left) / np.maximum(np.abs(left) + np.abs(right), 1e-9))


def mounted(robot: Robot, source: str) -> tuple[complex, float]:
    """Return the described place ahead and to the left of the sensor that is a reference, and its delay."""
    if source in ("pose", "odometry") and robot.describes("camera"):
        place = complex(robot.camera.lever_x_m, robot.camera.lever_y_m)
        return place, robot.camera.latency_s if source == "pose" else 0.0  # taken off in `seen_motion`
    if source == "gnss":
        return complex(*(_of_antenna(f"lever_{axis}_m")(robot, 0.0) for axis in "xy")), 0.0
    return 0j, 0.0


class Computed(NamedTuple):
    """Legs as the wheels, with the gyro where there is one, have them (legs,)."""

    moved: Array  #: complex change of place of the sensor, in the body's frame at first
    by_wheels: Array  #: change of yaw
    by_gyro: Array  #: the same of the gyro; of the wheels where there is none
    yaw_rad: Array  #: at first, of the gyro


def computed(log: Log, robot: Robot, p: Mapping[str, float], bias_radps: Array) -> Computed:
    """Return legs at parameters, 0 of those that are not given, and biases (runs,) of the gyro."""
    e = {name: p.get(name, 0.0) for name in PARAMETERS}
    at_s = log.clock_s + e["wheels_delay_s"]
    speeds = np.column_stack([np.interp(at_s, log.wheels_s, each) for each in log.speed_mps.T])
    steer = np.zeros((1, len(robot.wheels)))
    if robot.steered:
        at_s = at_s + e["steering_delay_s"]
        steer = np.column_stack([np.interp(at_s, log.steer_s, each) for each in log.steer_rad.T])
        steer = (1.0 + e[GAIN]) * steer + e["steering_offset_front_rad"]
    twist = rolled_twist(robot, speeds, steer)
    radius = 1.0 + e["wheel_radius_ratio"]
    v_x, v_y, rate = twist[:, 0] * radius, twist[:, 1] * radius, twist[:, 2]
    slipped = np.ones(len(v_x))
    for _ in range(
        SLIP_STEPS if e["force_slip_ratio"] != 0.0 else 0
    ):  # of the traction, by what the body speeds up
        accel = np.gradient(uniform_filter1d(v_x * slipped, round(0.2 / CLOCK_S)), CLOCK_S)
        slipped = 1.0 - e["force_slip_ratio"] * np.clip(np.sign(v_x) * accel / GRAVITY_MPS2, -1.0, 1.0)
    if robot.skids:
        sharp = sharpness(speeds)
        slipped -= e["turn_slip_ratio"] * sharp
        rate = rate / (1.0 + e["effective_track_ratio"] + e["narrowing_ratio"] * (sharp - log.sharp))
    elif robot.on_omni_wheels:
        rate = rate * radius / (1.0 + e["wheel_distance_ratio"])
    else:
        rate = rate * radius / (1.0 + e["wheelbase_ratio"])
        if isinstance(robot, BicycleRobot) and not robot.front_driven:
            rate = rate / (1.0 + (robot.understeer_s2pm + e["understeer_s2pm"]) / robot.wheelbase_m * v_x**2)
            # the rear axle slips outwards by the side force on its tyres
            yields = robot.mass_kg * robot.com_behind_front_m / robot.wheelbase_m / robot.rear_cornering_npr
            v_y = v_y - yields / (1.0 + e["cornering_stiffness_ratio"]) * v_x**2 * rate
    by_wheels = cumulative_trapezoid(rate, dx=CLOCK_S, initial=0.0)
    yaw = by_wheels
    if len(log.gyro_s):
        yaw = np.interp(log.clock_s, log.gyro_s, log.turned_rad)
        yaw = (1.0 + e["gyro_scale_ratio"]) * (yaw - CLOCK_S * np.cumsum(bias_radps[log.clock_run]))
    turning, (lever, delay_s) = np.exp(1j * yaw), mounted(robot, log.source)
    place = cumulative_trapezoid((v_x * slipped + 1j * v_y) * turning, dx=CLOCK_S, initial=0.0)
    place = place + turning * (lever + complex(e["lever_x_m"], e["lever_y_m"]))
    at_s = log.stamps_s - delay_s - e["camera_latency_s"]
    n = int(log.end_of.max()) + 1
    count = np.maximum(np.bincount(log.end_of, minlength=n), 1)
    x, y, yaw, by_wheels = (
        np.bincount(log.end_of, np.interp(at_s, log.clock_s, each), minlength=n) / count
        for each in (place.real, place.imag, yaw, by_wheels)
    )
    first, then = log.pairs.T
    moved = ((x + 1j * y)[then] - (x + 1j * y)[first]) * np.exp(-1j * yaw[first])
    return Computed(moved, by_wheels[then] - by_wheels[first], yaw[then] - yaw[first], yaw[first])


def errors_of(log: Log, robot: Robot, p: Mapping[str, float]) -> tuple[Array, Array]:
    """Return measured minus computed changes (legs, 3 or 4) at parameters, and the biases (runs,) of the gyro.

    They are the place ahead and to the left in the sensor's frame at first, the yaw of the wheels, and that of the gyro
    where the reference has one too.
    """
    has_gyro, n = len(log.gyro_s) > 0, len(log.runs)
    legs = computed(log, robot, p, log.bias_radps)
    if log.source != "gnss":
        moved = legs.moved * np.exp(1j * p.get("camera_yaw_rad", 0.0))
        turned = log.turned if log.has_yaw else legs.by_gyro
        columns = [
            (log.moved - moved).real,
            (log.moved - moved).imag,
            turned - legs.by_wheels,
            turned - legs.by_gyro,
        ]
        return np.column_stack(columns[: 4 if has_gyro and log.has_yaw else 3]), log.bias_radps
    bias = log.bias_radps
    turned_by = np.zeros(len(log.moved))
    for last in (False, True):
        headed = legs.moved * np.exp(1j * legs.yaw_rad)
        weight = log.weight**2
        for _ in range(HEADING_STEPS):
            seen = weight * log.moved * np.conj(headed)
            heading = np.angle(_sums(log.block, seen.real) + 1j * _sums(log.block, seen.imag))
            turned_by = heading[log.block]
            apart_m = log.weight * np.abs(
                log.moved * np.exp(-1j * turned_by) - headed
            )  # fixes that jump count less
            weight = log.weight**2 / (1.0 + (apart_m / (3.0 * np.median(apart_m) + 1e-9)) ** 2)
        if last or not has_gyro:
            break
        # what is left of directions along time, weighted by the paths behind them, beside what rest shows of the bias
        left = np.angle(seen * np.exp(-1j * turned_by))
        weight = np.where(np.abs(left) < 0.5, weight * np.abs(headed) ** 2, 0.0) / max(log.std_m, 1e-3) ** 2
        total = np.maximum(_sums(log.block, weight), 1e-12)
        time_s = log.middle_s - (_sums(log.block, weight * log.middle_s) / total)[log.block]
        slope = np.bincount(log.run, weight * time_s * left, minlength=n)
        known = np.bincount(log.run, weight * time_s**2, minlength=n) + 1.0 / BIAS_STD_RADPS**2
        bias = bias - slope / known
        legs = computed(log, robot, p, bias)
    error = log.moved * np.exp(-1j * (turned_by + legs.yaw_rad)) - legs.moved
    columns = [log.weight * error.real, log.weight * error.imag]
    return np.column_stack([*columns, legs.by_gyro - legs.by_wheels][: 3 if has_gyro else 2]), bias


def _sums(number: Array, values: Array) -> Array:
    """Return the sum of the values of each number."""
    return np.bincount(number, values)


class MotionFit(NamedTuple):
    """Kinematic parameters fitted to legs."""

    names: tuple[str, ...]  #: of the parameters
    fit: Fit
    error: Array  #: (3,) or (4,) usual residuals: ahead, to the left, yaw by the wheels, yaw by the gyro
    log: Log
    bias_radps: Array  #: (runs,) of the gyro
    clusters: str  #: of the intervals, in words

    @property
    def values(self) -> dict[str, float]:
        """The fitted values by name."""
        return dict(zip(self.names, self.fit.value.tolist(), strict=True))


def clusters_of(log: Log, leg_s: float) -> tuple[Array, str]:
    """Return the number (legs,) of the cluster of each leg, and what clusters are: sessions, runs or blocks."""
    sessions = [run.session for run in log.runs]
    for names, word in ((sessions, "sessions"), ([run.run_id for run in log.runs], "runs")):
        if all(names):
            of_leg, number = np.unique(np.array(names)[log.run], return_inverse=True)
            if len(of_leg) >= MIN_GROUPS:
                return number, f"{len(of_leg)} {word} are the clusters of its interval"
    length = max(min(len(log.run) // BLOCKS, round(LONGEST_BLOCK_S / leg_s) * STRIDES), 2 * STRIDES)
    block, last = [], 0
    for run in range(len(log.runs)):
        own = np.arange((log.run == run).sum()) // length
        own = np.minimum(own, max(round(len(own) / length), 1) - 1)  # no short one at the end
        block.append(last + own)
        last += int(own[-1]) + 1 if len(own) else 0
    n_runs = f"{len(log.runs)} runs" if len(log.runs) > 1 else "one run"
    return np.concatenate(
        block
    ), f"{last} blocks of time of {n_runs} are the clusters of its interval, which holds these"


def fit_motion(
    runs: Sequence[RunLog],
    robot: Robot,
    source: str = "pose",
    names: Sequence[str] | None = None,
    leg_s: float | None = None,
) -> MotionFit:
    """Return the kinematic parameters of a robot by its runs.

    Parameters
    ----------
    runs : with wheels, steering where it is steered, and the reference
    robot : that they are of
    source : stream that is the reference
    names : of the parameters; those of :func:`parameters_of` by default
    leg_s : length of a leg

    Raises
    ------
    DataError
        if no run has the streams, or there are too few legs that move.
    """
    leg_s = LEG_S[source] if leg_s is None else leg_s
    log = lay_out(runs, robot, source, leg_s)
    if len(log.run) < MIN_LEGS:
        raise DataError(
            f"robot {robot.name}: {len(log.run)} legs of {leg_s:g} s in which it moves have {WORDS[source]} at both "
            f"ends, at least {MIN_LEGS} are required"
        )
    cluster, words = clusters_of(log, leg_s)
    if cluster.max() + 1 < MIN_BLOCKS and "blocks" in words:
        raise DataError(f"robot {robot.name}: the runs are too short: {words}, {MIN_BLOCKS} are required")
    chosen = tuple(parameters_of(robot, source, len(log.gyro_s) > 0) if names is None else names)

    def residual(values: Array) -> Array:
        return errors_of(log, robot, dict(zip(chosen, values.tolist(), strict=True)))[0]

    start = np.zeros(len(chosen))
    for name in (
        "camera_latency_s",
        "wheels_delay_s",
    ):  # elsewhere than near the best delay a search may stay
        if name in chosen:
            tried_s, place = np.arange(*PARAMETERS[name][2:4], TRIED_S), chosen.index(name)
            at = [residual(start + np.eye(len(chosen))[place] * delay_s) for delay_s in tried_s]
            start[place] = tried_s[
                np.argmin([np.log(np.median(abs(error), axis=0) + LEAST_ERROR).sum() for error in at])
            ]
    error = np.full(residual(start).shape[1], FIRST_ERROR)
    for left in reversed(range(PASSES)):
        parameters = [PARAMETERS[name] for name in chosen]
        steps = np.diag(
            [DIFFERENCE * p.unit for p in parameters]
        )  # not in proportion to values that may be 0
        by_size = partial(lambda size, values: np.asarray(residual(values) / size), error)

        def derivative(
            values: Array, steps: Array = steps, by_size: Callable[[Array], Array] = by_size
        ) -> Array:
            here = by_size(values)
            return np.stack([np.ravel(by_size(values + h) - here) / h.sum() for h in steps], axis=1)

        # a search that begins at a bound hardly leaves it
        inside = np.maximum(start, [p.low + 0.5 * p.unit for p in parameters])
        enough = 1e-3 if left else 1e-6  # of a pass that finds sizes
        fit = identify(by_size, parameters, cluster, True, [inside], derivative, ftol=enough, xtol=enough)
        error = np.maximum(1.48 * np.median(np.abs(residual(fit.value)), axis=0), LEAST_ERROR)
        start = fit.value
        if left and "force_slip_ratio" in chosen and fit.at_bound[k := chosen.index("force_slip_ratio")]:
            # what stands at its bound moves no other number
            chosen, start = (*chosen[:k], *chosen[k + 1 :]), np.delete(start, k)
    bias = errors_of(log, robot, dict(zip(chosen, fit.value.tolist(), strict=True)))[1]
    return MotionFit(chosen, fit, error, log, bias, words)


def leg_errors(
    runs: Sequence[RunLog], robot: Robot, values: Mapping[str, float], source: str = "pose"
) -> Array:
    """Return measured minus computed changes (legs, 3 or 4) of runs at values of parameters, 0 of the others."""
    return errors_of(lay_out(runs, robot, source), robot, values)[0]


#: What none of a robot's logs is without, in the words of what it would show.
MISSING = "no run has what measures its motion (stream 'pose', 'lidar', 'gnss' or 'odometry'), which shows it"
NO_GYRO = (
    "no run has a gyro (stream 'imu', channel 'gyro_z_radps'), behind which delays are and which shows it"
)
UNSEEN = "these drives do not show it apart from the other numbers"
CONTRADICTED = (
    "wheels and {} differ by more than a wheel radius can: compare wheel_radius_m, units and signs of the log with the "
    "robot's"
)
NOTE = {
    "rolling_radius_m": "on one ground it contains the mean slip",
    "effective_track_m": "skidding included, by the described radius",
    "gyro_scale_ratio": "of readings over true rates",
}
SLIPS = (
    "it is not apart from the slip of this ground: wheels of the described radius move the robot {:.0f} % less than "
    "they roll; drive hard ground (asphalt, concrete), or label it so"
)
BEHIND = "behind the gyro", "behind the wheels: there is no gyro"
#: What motion that builds up behind the wheels looks like, where no yaw is measured from outside: by 0.16 s and 0.03
#: of a simulated robot on grass, as much as it usually is.
BUILT_UP = ("wheels_delay_s", "gnss_delay_s", "odometry_delay_s", "gyro_scale_ratio")
SOFT = (
    "on soft ground motion builds up behind the wheels, which looks like it: drive hard ground (asphalt, concrete), or "
    "label it so"
)
TURNING = "of the antenna ahead of where the robot turns about, which shows with it alone: 0 where that is the origin"


def findings_by(
    fitted: MotionFit, robot: Robot, hard: bool | None = None, where: str = "", stated: bool = True
) -> list[Finding]:
    """Return the findings of a fit; those that it does not determine have no value.

    Parameters
    ----------
    fitted, robot : which
    hard : whether a robot that skids was on hard ground; None where its radius is what it is, slip included
    where : the ground, in words
    stated : whether slip that is assumed is in the radius of a robot that skids
    """
    log, fit, found = fitted.log, fitted.fit, list[Finding]()
    ids, dof = [run.run_id for run in log.runs], len(fit.influence) - 1
    contradicted = contradicts(fitted)
    for number in (*KINEMATIC, *SENSOR[log.source]):
        name = number.place.partition(".")[2]
        if number.of not in fitted.names or NOT_OF.get(name) == robot.drive:
            continue
        k = fitted.names.index(number.of)
        value, std = float(fit.value[k]), float(fit.std[k])
        at, low, high = (number.value(robot, value + by * std) for by in (0.0, -1.0, 1.0))
        bounded = STAMP_S if name.endswith("delay_s") else 0.0
        if robot.skids and not hard and not log.has_yaw and name in BUILT_UP and not contradicted:
            found += undetermined([number.place], SOFT)
            continue
        behind = BEHIND[not len(log.gyro_s)] if name != "steering_delay_s" else "behind the wheel speeds"
        notes = [NOTE.get(name, ""), behind if name.endswith("delay_s") else ""]
        notes += [TURNING] * (robot.skids and number.place == "antenna.lever_x_m")
        if robot.skids and name == "rolling_radius_m" and stated:
            least, most = SLIP_RATIO if hard else SOFT_SLIP_RATIO
            at, bounded = at * (1.0 + (least + most) / 2), at * (most - least) / 2
            notes = [
                f"slip of {100 * least:g} to {100 * most:g} % assumed: only the radius less the slip is to be seen"
            ]
        # tyres roll by at most a few percent less than described: what is beyond is slip of this ground
        judged = name == "rolling_radius_m" and stated and not hard and fit.identified[k] and not contradicted
        if judged and value + float(half_width(std, dof)) < -SOFT_SLIP_RATIO[1]:
            found += undetermined([number.place], SLIPS.format(-100.0 * value))
            continue
        half = float(half_width(abs(high - low) / 2, dof, bounded=bounded))
        shown = fit.identified[k] and not contradicted
        if not shown or not float(half_width(std, dof)) < number.widest / 2 or not math.isfinite(half):
            why = CONTRADICTED.format(WORDS[log.source]) if contradicted else UNSEEN
            found += undetermined([number.place], why)
            continue
        note = "; ".join(filter(None, [*notes, where, fitted.clusters]))
        found.append(around(number.place, at, half, len(log.run), "legs", ids, note))
    if "narrowing_ratio" in fitted.names and not contradicted:
        found += _by_turning(fitted, robot, where)
    return found


def contradicts(fitted: MotionFit) -> bool:
    """Return whether the radius is as far off as a fit may go: then no number of it is one of the robot."""
    if "wheel_radius_ratio" not in fitted.names:
        return False
    p, value = PARAMETERS["wheel_radius_ratio"], fitted.values["wheel_radius_ratio"]
    return min(value - p.low, p.high - value) < NEAR_BOUND * (p.high - p.low)


def _by_turning(fitted: MotionFit, robot: Robot, where: str) -> list[Finding]:
    """Return the effective tracks of wide and of tight turns, where they differ."""
    fit, names = fitted.fit, [f"identified.effective_track_{turns}_m" for turns in ("wide", "tight")]
    k, other = (fitted.names.index(name) for name in ("narrowing_ratio", "effective_track_ratio"))
    if not fit.identified[k] or fit.interval[0, k] * fit.interval[1, k] <= 0.0:
        return undetermined(names, "wide and tight turns do not differ")
    sharp = np.array([WIDE, TIGHT]) - fitted.log.sharp
    value, (low, high) = fit.derived(lambda p: robot.track_m * (1.0 + p[other] + p[k] * sharp))
    ids = [run.run_id for run in fitted.log.runs]
    words = ("of wide turns: a difference of the sides of 0.3 of their sum", "of turns in place")
    notes = ["; ".join(filter(None, [word, where])) for word in words]
    rows = zip(names, value, (high - low) / 2, notes, strict=True)
    return [around(name, v, half, len(fitted.log.run), "legs", ids, note) for name, v, half, note in rows]


def motion_findings(runs: Sequence[RunLog], robot: Robot, hard: Sequence[str] = ()) -> list[Finding]:
    """Return what references show of a robot of any drive, or why they do not.

    Each reference gives the place and delay of its own sensor; of kinematic numbers that several show, the first of
    :data:`LEG_S` counts.  A robot that skids is calibrated on its hard ground where runs are labelled so, on all
    else, and its effective track on each ground beside it.
    """
    any_gyro = any("gyro_z_radps" in run.streams["imu"].channels for run in runs if "imu" in run.streams)
    sources = [source for source in LEG_S if not (source == "odometry" and robot.drive == "swerve")]
    sources = [source for source in sources if any(source in run.streams for run in runs)]
    on_hard = [run for run in runs if run.terrains and set(run.terrains) <= set(hard)]
    found, why = dict[str, Finding](), MISSING
    for source in sources:
        fitted, is_hard = None, False
        for chosen in (on_hard, list(runs)):
            try:
                fitted = fit_motion(chosen, robot, source) if chosen else None
            except DataError as error:
                why = str(error)
            if fitted is not None:
                is_hard = chosen is on_hard
                break
        if fitted is None:
            continue
        where = "on hard ground" if is_hard else "on any ground" if robot.skids else ""
        rows = findings_by(fitted, robot, is_hard, where)
        if robot.skids:
            for ground in sorted({run.terrains[0] for run in runs if len(run.terrains) == 1}):
                own = [run for run in runs if run.terrains == (ground,)]
                try:
                    of_it = (
                        rows
                        if own == chosen
                        else findings_by(fit_motion(own, robot, source), robot, None, f"on {ground}")
                    )
                except DataError:
                    continue
                rows += [
                    row._replace(parameter=f"identified.effective_track_{ground}_m")
                    for row in of_it
                    if row.parameter == TRACK and row.determined
                ]
        if source == "gnss" and len(fitted.log.gyro_s) and not fitted.log.bias_radps.any():
            rows += _bias_in_motion(fitted)
        for row in rows:
            if row.parameter not in found or not found[row.parameter].determined:
                found[row.parameter] = row
    shown = parameters_of(robot, sources[0] if sources else "pose", True)
    for number in KINEMATIC:
        name = number.place.partition(".")[2]
        if number.of in shown and number.place not in found and NOT_OF.get(name) != robot.drive:
            of_gyro = number.of in ("wheels_delay_s", "gyro_scale_ratio")
            found[number.place] = undetermined([number.place], NO_GYRO if of_gyro and not any_gyro else why)[
                0
            ]
    return list(found.values())


def _bias_in_motion(fitted: MotionFit) -> list[Finding]:
    """Return the bias of the gyro by a receiver, of runs without rest."""
    bias, ids = fitted.bias_radps, [run.run_id for run in fitted.log.runs]
    if len(bias) < MIN_POWER_ONS:
        return undetermined(
            [BIAS], f"{len(bias)} runs, and no rest: {MIN_POWER_ONS} show how much it differs"
        )
    half = float(half_width(bias.std(ddof=1) / math.sqrt(len(bias)), len(bias) - 1))
    return [
        around(
            BIAS, float(bias.mean()), half, len(bias), "runs", ids, "by the receiver: the robot never rests"
        )
    ]
