"""Four robots of the plain simulator, what they drive, and what can be hidden in them.

An effect changes the physics or a sensor of a world; the package's parameters are not used.  What would be the right
answer, and what is nearest to it in a catalogue that lacks it, was decided by the physics before anything was run, and
stands beside each effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from studies.foreign import scenes, sensors
from studies.foreign.physics import EVERY, G_MPS2, SAMPLE_S, STEP_S, Body, integrate
from studies.foreign.scenes import Recorded, Scene
from studies.foreign.sensors import Motor, Sensing
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import Robot, load_robot

RUN_S = 15.0  #: length of a run; its wheels are at rest at both ends
SLOPE_STD, FRICTION_STD = 0.04, 0.03  #: from run to run
LAG_S = 0.06  #: of each of the two lags by which wheels and steering follow commands


class Linkage(NamedTuple):
    """What is between encoders and wheels."""

    backlash_rad: float = 0.0  #: half of the play between an encoder and its wheel
    steer_offset_rad: tuple[float, ...] = ()  #: of each wheel, over what is measured
    steer_gain: float = 1.0
    steer_late_s: float = 0.0
    steer_friction_rad: float = 0.0  #: hysteresis of the steering, by friction and a soft linkage


class World(NamedTuple):
    """A robot as it is."""

    name: str
    robot: str  #: name of the description that it nominally has
    body: Body
    motor: Motor
    sensing: Sensing
    linkage: Linkage = Linkage()
    scene: Scene | None = None  #: of MuJoCo; None for the plain simulator


def _skid() -> World:
    robot = load_robot("husky")
    half_m, side_m = robot.wheelbase_m / 2, robot.track_m / 2
    wheels = np.array([[half_m, side_m], [half_m, -side_m], [-half_m, side_m], [-half_m, -side_m]])
    body = Body(
        *("brush", wheels, np.full(4, robot.wheel_radius_m), robot.mass_kg, robot.body.yaw_inertia_kgm2),
        com_height_m=robot.body.com_height_m,
    )
    motor = Motor(robot.motors.nm_per_a, robot.motors.friction_nm / 2, robot.body.wheel_inertia_kgm2 / 2)
    return World("skid", "husky", body, motor, Sensing((robot.camera.lever_x_m, robot.camera.lever_y_m)))


def _car() -> World:
    robot: Any = load_robot("adap2e")
    length_m, side_m = robot.wheelbase_m, robot.track_m / 2
    wheels = np.array([[length_m, side_m], [length_m, -side_m], [0.0, side_m], [0.0, -side_m]])
    body = Body(
        *("magic", wheels, np.full(4, robot.wheel_radius_m), robot.mass_kg, robot.yaw_inertia_kgm2),
        com_m=(robot.com_ahead_m, 0.0),
        com_height_m=robot.com_height_m,
        friction_ratio=0.8,
        stiffness_ratio=12.0,
        cornering_ratio=0.6,
        drag_ratio=0.03,
        driven=(False, False, True, True),
    )
    return World("car", "adap2e", body, Motor(1.0, 0.0, 0.0), Sensing())


def _swerve() -> World:
    robot = load_robot("agrimaro")
    body = Body(
        "brush",
        np.array(robot.wheel_positions_m),
        *(np.full(3, robot.wheel_radius_m), robot.mass_kg, robot.body.yaw_inertia_kgm2),
        com_m=(robot.body.com_x_m, robot.body.com_y_m),
        com_height_m=robot.body.com_height_m,
    )
    motor = Motor(robot.motors.nm_per_a, robot.motors.friction_nm, robot.body.wheel_inertia_kgm2)
    lag_s = robot.sensors.encoder_time_constant_s
    seen = Sensing((robot.camera.lever_x_m, robot.camera.lever_y_m), encoder_lag_s=lag_s)
    return World("swerve", "agrimaro", body, motor, seen)


def _omni() -> World:
    robot = load_robot("robotino")
    body = Body(
        "rollers",
        np.array(robot.wheel_positions_m),
        *(np.full(3, robot.wheel_radius_m), robot.mass_kg, robot.body.yaw_inertia_kgm2),
        com_m=(robot.body.com_x_m, 0.0),
        com_height_m=robot.body.com_height_m,
        friction_ratio=0.6,
        drag_ratio=0.01,
    )
    motor = Motor(robot.motors.nm_per_a, robot.motors.friction_nm, robot.body.wheel_inertia_kgm2)
    return World("omni", "robotino", body, motor, Sensing())


def _scene(make: Callable[[], World]) -> Callable[[], World]:
    return lambda: make()._replace(scene=Scene())


WORLDS: dict[tuple[str, str], Callable[[], World]] = {
    ("plain", "skid"): _skid,
    ("plain", "car"): _car,
    ("plain", "swerve"): _swerve,
    ("plain", "omni"): _omni,
    ("mujoco", "skid"): _scene(_skid),
    ("mujoco", "car"): _scene(_car),
    ("mujoco", "omni"): _scene(_omni),
}
"""By engine and name."""


# -- What is driven: speeds and angles of the wheels of runs from rest -------------------------------------


class Driven(NamedTuple):
    """Rates and angles of wheels (2 n + 1, runs, wheels) every half step as encoders have them, and the ground."""

    rate: Array
    steer: Array
    slope: Array  #: (runs, 2)
    friction: Array  #: (runs,) over that of the world
    yaw_rad: Array  #: (runs,) at the start


def _profiles(
    rng: np.random.Generator, runs: int, run_s: float, draw: Callable[[], list[float]], pace: Array
) -> Array:
    """Return columns (n, runs, c) that go from target to target at bounded rates, and smoothly."""
    n = round(run_s / SAMPLE_S) + 1
    out = np.zeros((n, runs, len(pace)))
    for i in range(runs):
        goal, k = np.zeros((n, len(pace))), round(0.6 / SAMPLE_S)
        while k < n:
            length = round(rng.uniform(1.5, 3.5) / SAMPLE_S)
            goal[k : k + length] = draw()
            k += length
        goal[n - round(0.8 / SAMPLE_S) :, 0] = 0.0
        value = np.zeros(len(pace))
        for k in range(1, n):
            value = value + np.clip(goal[k] - value, -pace * SAMPLE_S, pace * SAMPLE_S)
            out[k, i] = value
    keep = math.exp(-SAMPLE_S / LAG_S)
    for _ in range(2):
        out = np.asarray(lfilter([1.0 - keep], [1.0, -keep], out, axis=0))
    return out


def _skid_wheels(world: World, rng: np.random.Generator, runs: int, run_s: float) -> tuple[Array, Array]:
    def draw() -> list[float]:
        kind = rng.choice(
            ["ahead", "arc", "spot", "back", "crawl", "stop"], p=[0.25, 0.3, 0.15, 0.15, 0.1, 0.05]
        )
        v, d = rng.uniform(0.3, 0.9), 0.0
        if kind == "arc":
            d = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.5)
        elif kind == "spot":
            v, d = 0.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.6)
        elif kind == "back":
            v, d = -rng.uniform(0.3, 0.7), rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.1, 0.4)
        elif kind == "crawl":
            v = rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.15)
        elif kind == "stop":
            v = 0.0
        return [v, d]

    v, d = np.moveaxis(_profiles(rng, runs, run_s, draw, np.array([1.0, 1.2])), -1, 0)
    circumferential_mps = np.stack([v - d, v + d, v - d, v + d], axis=-1)
    return circumferential_mps, np.zeros_like(circumferential_mps)


def _car_wheels(world: World, rng: np.random.Generator, runs: int, run_s: float) -> tuple[Array, Array]:
    wheelbase_m = world.body.wheels_m[0, 0]

    def draw() -> list[float]:
        kind = rng.choice(["ahead", "turn", "back"], p=[0.2, 0.65, 0.15])
        v = -rng.uniform(0.5, 1.2) if kind == "back" else rng.uniform(0.8, 4.0)
        tight = min(math.tan(0.3) / wheelbase_m, 2.5 / v**2)
        return [v, 0.0 if kind == "ahead" else rng.uniform(-tight, tight)]

    v, turn = np.moveaxis(_profiles(rng, runs, run_s, draw, np.array([1.5, 0.5])), -1, 0)
    # each front wheel along its own circle (Ackermann)
    side_m = world.body.wheels_m[0, 1]
    left = np.arctan2(wheelbase_m * turn, 1.0 - side_m * turn)
    right = np.arctan2(wheelbase_m * turn, 1.0 + side_m * turn)
    none = np.zeros_like(v)
    return np.stack([v] * 4, axis=-1), np.stack([left, right, none, none], axis=-1)


def _swerve_wheels(world: World, rng: np.random.Generator, runs: int, run_s: float) -> tuple[Array, Array]:
    def draw() -> list[float]:
        v = rng.choice([-0.7, 1.0, 1.0]) * rng.uniform(0.2, 1.0)
        return [
            v,
            rng.choice([0.0, 1.0]) * rng.uniform(-0.5, 0.5),
            rng.choice([0.0, 1.0]) * rng.uniform(-0.7, 0.7),
        ]

    v, crab, turn = np.moveaxis(_profiles(rng, runs, run_s, draw, np.array([0.8, 0.6, 0.8])), -1, 0)
    x, y = world.body.wheels_m.T
    ahead = np.cos(crab)[..., None] - turn[..., None] * y
    left = np.sin(crab)[..., None] + turn[..., None] * x
    return v[..., None] * np.hypot(ahead, left), np.arctan2(left, ahead)


def _omni_wheels(world: World, rng: np.random.Generator, runs: int, run_s: float) -> tuple[Array, Array]:
    def draw() -> list[float]:
        v, heading, w = (
            rng.uniform(0.1, 0.4),
            rng.uniform(-math.pi, math.pi),
            rng.choice([-1.0, 0.0, 0.0, 1.0]),
        )
        return [v * math.cos(heading), v * math.sin(heading), w * rng.uniform(0.3, 1.2)]

    v_x, v_y, w = np.moveaxis(_profiles(rng, runs, run_s, draw, np.array([0.6, 0.6, 2.0])), -1, 0)
    x, y = world.body.wheels_m.T
    plane = np.arctan2(y, x) + np.pi / 2
    speed_mps = (
        v_x[..., None] * np.cos(plane) + v_y[..., None] * np.sin(plane) + w[..., None] * np.hypot(x, y)
    )
    return speed_mps, np.broadcast_to(plane, speed_mps.shape)


STEERED = {"car": 2, "swerve": 3}  #: wheels that are steered, the first ones
_WHEELS = {"skid": _skid_wheels, "car": _car_wheels, "swerve": _swerve_wheels, "omni": _omni_wheels}


def driven_by(world: World, runs: int, rng: np.random.Generator, run_s: float = RUN_S) -> Driven:
    """Draw what runs of a world drive: what its wheels do by its nominal radius, and the ground under them."""
    speed_mps, steer = _WHEELS[world.name](world, rng, runs, run_s)
    coarse, fine = (
        np.arange(len(speed_mps)),
        np.arange(2 * EVERY * (len(speed_mps) - 1) + 1) / (2 * EVERY),
    )
    low = np.minimum(fine.astype(int), len(coarse) - 2)
    part = (fine - low)[:, None, None]

    def finer(values: Array) -> Array:
        return np.asarray(values[low] * (1.0 - part) + values[low + 1] * part)

    slope = np.zeros((runs, 2)) if world.name == "omni" else rng.normal(0.0, SLOPE_STD, (runs, 2))
    friction = 1.0 + FRICTION_STD * rng.standard_normal(runs)
    radius_m = load_robot(world.robot).wheel_radius_m
    return Driven(
        finer(speed_mps) / radius_m,
        finer(steer),
        slope,
        friction,
        rng.uniform(-math.pi, math.pi, runs),
    )


# -- From what is driven to logs ---------------------------------------------------------------------------


def _play(values: Array, half: float) -> Array:
    out = np.empty_like(values)
    out[0] = now = values[0]
    for k in range(1, len(values)):
        out[k] = now = np.clip(now, values[k] - half, values[k] + half)
    return out


def _held_by_friction(angle: Array, most: float) -> Array:
    """Return angles (n, ...) of a soft linkage that rubs (Dahl): they lag by up to ``most``."""
    lag, out, soft = np.zeros_like(angle[0]), np.empty_like(angle), 2.0 * most
    out[0] = angle[0]
    for k in range(1, len(angle)):
        step = angle[k] - angle[k - 1]
        lag = np.clip(lag + step * most / soft * (1.0 - lag / most * np.sign(step)), -most, most)
        out[k] = angle[k] - lag
    return out


def _plain_records(world: World, driven: Driven) -> Recorded:
    """Return the motion of a plain world, and what its motors and steering do as their encoders have it."""
    link, half_s = world.linkage, 0.5 * STEP_S
    rate, steer, every = driven.rate, np.array(driven.steer), 2 * EVERY
    turned = np.cumsum(rate, axis=0) * half_s
    if link.backlash_rad:
        rate = np.gradient(_play(turned, link.backlash_rad), half_s, axis=0)
    if world.name in STEERED:
        steered = slice(0, STEERED[world.name])
        moved = link.steer_gain * steer[..., steered]
        if link.steer_friction_rad:
            moved = _held_by_friction(moved, link.steer_friction_rad)
        if link.steer_late_s:
            late = round(link.steer_late_s / half_s)
            moved = np.concatenate([np.repeat(moved[:1], late, axis=0), moved[: len(moved) - late]])
        steer[..., steered] = moved + np.array(link.steer_offset_rad or 0.0)
    motion = integrate(world.body, rate, steer, driven.slope, driven.friction, driven.yaw_rad)
    torque = sensors.torque_of(motion.pull_n, driven.rate[::every], world.body.radius_m, world.motor)
    return Recorded(motion, turned[::every], torque, driven.steer[::every])


def runs_of(world: World, driven: Driven, seed: np.random.SeedSequence) -> tuple[RunLog, ...]:
    """Return the logs of a world: the seed draws the noise of its sensors alone."""
    robot = load_robot(world.robot)
    if world.scene is None:
        recorded = _plain_records(world, driven)
    else:
        mounts = {"lidar_m": world.sensing.lidar_m, "lidar_yaw_rad": world.sensing.lidar_yaw_rad}
        recorded = scenes.moved(world.name, world.body, world.scene._replace(**mounts), world.motor, driven)
    motion, rngs = recorded.motion, [np.random.default_rng(child) for child in seed.spawn(4)]
    kinds = (
        {"pose": sensors.pose_of}
        if world.name == "omni"
        else {"imu": sensors.imu_of, "lidar": sensors.lidar_of}
    )
    streams: list[dict[str, Stream]] = [{} for _ in range(driven.rate.shape[1])]
    for (name, kind), rng in zip(kinds.items(), rngs, strict=False):
        for own, stream in zip(streams, kind(motion, world.sensing, rng), strict=True):
            own[name] = stream
    rate = sensors.counted(recorded.turned_rad, world.sensing)
    time_s = motion.time_s[0] + np.arange(len(rate)) / sensors.WHEELS_HZ
    names, columns = list(robot.rate_channels), _logged(world, robot, rate)
    if world.name != "car":
        currents = sensors.currents_of(recorded.torque_nm, world.motor)[::2]
        if world.name == "skid":
            currents = currents[..., :2] + currents[..., 2:]
        noise = sensors.coloured(rngs[3], 0.35 if world.name != "omni" else 0.03, 0.1, currents.shape, 0.02)
        columns = np.concatenate([columns, currents + noise], axis=2)
        names += [f"current_{wheel}_a" for wheel in robot.wheels]
    shown = _shown_steer(world, recorded.steer_rad[::2])
    if shown is not None:
        shown = shown + world.sensing.steering_std_rad * rngs[2].standard_normal(shown.shape)
    runs = []
    for i, own in enumerate(streams):
        own["wheels"] = Stream(time_s, columns[:, i], tuple(names))
        if shown is not None:
            own["steering"] = Stream(time_s, shown[:, i], robot.steer_channels)
        label = Label(0.0, float(motion.time_s[-1]), "yard")
        runs.append(RunLog(f"run_{i + 1:02d}", robot.name, own, (label,)))
    return tuple(runs)


def _logged(world: World, robot: Robot, rate: Array) -> Array:
    """Return what loggers write of wheel rates (k, runs, wheels): speeds by the nominal radius, or motors' rates."""
    if world.name == "skid":
        return np.asarray(0.5 * (rate[..., :2] + rate[..., 2:]) * robot.wheel_radius_m)
    if world.name == "car":
        return np.asarray(rate[..., -1:] * robot.wheel_radius_m)  # of the rear axle
    return np.asarray(rate * robot.motors.reduction_ratio)


def _shown_steer(world: World, steer: Array) -> Array | None:
    """Return measured angles (k, runs, steered): of the car that of its bicycle's front wheel."""
    if world.name == "swerve":
        return steer
    if world.name == "car":
        mean = 0.5 * (1.0 / np.tan(_not_zero(steer[..., :1])) + 1.0 / np.tan(_not_zero(steer[..., 1:2])))
        return np.arctan2(1.0, mean) - np.pi * (mean < 0)
    return None


def _not_zero(angle: Array) -> Array:
    return np.where(np.abs(angle) < 1e-9, 1e-9, angle)


# -- What can be hidden ------------------------------------------------------------------------------------


class ForeignEffect(NamedTuple):
    """Something that is wrong about a world, the answers that are right, and those that are nearest."""

    name: str
    robots: tuple[str, ...]
    hide: Callable[[World, float], World]
    most: float  #: largest size that is plausible, in the unit that ``hide`` takes
    signed: bool  #: whether it may have either sign
    right: tuple[str, ...] = ()  #: names of the catalogue that are this effect
    nearest: tuple[str, ...] = ()  #: names that come nearest, no error
    engines: tuple[str, ...] = ("plain", "mujoco")
    #: values by parameter that a right name has, over those of the world before; empty where its law is another
    values: Callable[[World, float], Mapping[str, float]] = lambda world, size: {}


def _changed(part: str, **change: Callable[[Any, float], Any]) -> Callable[[World, float], World]:
    """Return what changes fields of a part of a world, each to what it makes of that part and a size."""

    def hide(world: World, size: float) -> World:
        old = getattr(world, part)
        return world._replace(
            **{part: old._replace(**{name: new(old, size) for name, new in change.items()})}
        )

    return hide


def _one_side(body: Body, size: float) -> Array:
    return body.radius_m * np.where(body.wheels_m[:, 1] > 0.0, 1.0 - size / 2, 1.0 + size / 2)


def _apart(body: Body, size: float) -> Array:
    return body.wheels_m * np.array([1.0, 1.0 + size] if len(body.wheels_m) == 4 else [1.0 + size] * 2)


def _offset(world: World, size: float) -> World:
    offsets = (size, size) if world.name == "car" else (0.0, size, 0.0)
    return world._replace(linkage=world.linkage._replace(steer_offset_rad=offsets))


def _lost(world: World, size: float) -> World:
    fast_radps = {"car": 6.0, "omni": 5.0}.get(world.name, 2.5)
    return world._replace(sensing=world.sensing._replace(lost_ratio=size, lost_from_radps=fast_radps))


_ALL, _IMU, _STEERED = ("skid", "car", "swerve", "omni"), ("skid", "car", "swerve"), ("car", "swerve")
_MOTORS, _PLAIN, _SCENE = ("skid", "swerve"), ("plain",), ("mujoco",)
_TURNING = ("effective_track", "turning_slip", "track_narrowing", "turn_drag", "turn_side_slip")


def _effects() -> Iterator[ForeignEffect]:
    each = ForeignEffect
    body, sensing, linkage = (partial(_changed, part) for part in ("body", "sensing", "linkage"))
    motor, scene = (partial(_changed, part) for part in ("motor", "scene"))

    # that the catalogue has had from the start
    change = body(radius_m=lambda b, e: b.radius_m * (1.0 + e))
    yield each("tyre_radius", _ALL, change, 0.12, True, ("wheel_radius",), ("camera_scale",))
    yield each("side_radius", ("skid",), body(radius_m=_one_side), 0.08, True, ("one_sided_radius",))
    change = body(radius_m=lambda b, e: b.radius_m * np.array([1.0 + e, 1.0, 1.0]))
    yield each("wheel_worn", ("swerve",), change, 0.15, True, ("wheel_scale_1",))
    change = body(wheels_m=_apart)
    yield each(
        "wheels_apart", ("skid", "omni"), change, 0.15, True, ("effective_track", "wheel_distance"), _TURNING
    )
    change = body(
        mass_kg=lambda b, e: b.mass_kg * (1.0 + e), inertia_kgm2=lambda b, e: b.inertia_kgm2 * (1.0 + e)
    )
    heavier = ("motor_constant", "roller_friction", "scrub")
    yield each("payload", ("skid", "swerve", "omni"), change, 1.0, False, ("payload",), heavier)
    change = body(drag_ratio=lambda b, e: b.drag_ratio + e)
    yield each("soft_ground", _MOTORS, change, 0.2, False, ("rolling_resistance",))
    change = body(roller_ratio=lambda b, e: b.roller_ratio + e)
    yield each("sticky_rollers", ("omni",), change, 0.2, False, ("roller_friction",), (), _PLAIN)
    change = motor(weak_ratio=lambda m, e: e)
    yield each("weak_magnets", _MOTORS, change, 0.4, False, ("motor_constant",), ("payload",))
    yield each("gyro_scale", _IMU, sensing(gyro_ratio=lambda s, e: 1.0 + e), 0.1, True, ("gyro_scale",))
    yield each("imu_late", _IMU, sensing(imu_late_s=lambda s, e: e), 0.3, False, ("imu_latency",))
    change = sensing(lidar_late_s=lambda s, e: s.lidar_late_s + e)
    yield each("lidar_late", _ALL, change, 0.4, False, ("camera_latency",))
    change = sensing(lidar_m=lambda s, e: (s.lidar_m[0] + 0.8 * e, s.lidar_m[1] - 0.6 * e))
    yield each("lidar_moved", _ALL, change, 0.5, True, ("lever_arm",))
    yield each("lidar_turned", _ALL, sensing(lidar_yaw_rad=lambda s, e: e), 0.2, True, ("camera_yaw",))
    right = ("steering_offset_front", "steering_offset_2")
    yield each("steering_offset", _STEERED, _offset, 0.1, True, right, (), _PLAIN)
    change = linkage(steer_late_s=lambda k, e: e)
    yield each("steering_late", _STEERED, change, 0.4, False, ("steering_delay",), ("steering_lag",), _PLAIN)

    # of scenes
    change = scene(gear_ratio=lambda c, e: 1.0 + e)
    yield each("gear", _ALL, change, 0.12, True, ("wheel_radius",), (), _SCENE)
    change = scene(bearing_nm=lambda c, e: e)
    yield each("bearings", ("skid",), change, 6.0, False, ("rolling_resistance",), (), _SCENE)
    change = scene(roller_nms=lambda c, e: e)
    # a ball's joint resists about its driven axis too
    nearest = ("viscous_drag", "wheel_radius")
    yield each("balls_rub", ("omni",), change, 0.05, False, ("roller_friction",), nearest, _SCENE)
    change = scene(steer_offset_rad=lambda c, e: e)
    yield each("wheels_askew", ("car",), change, 0.1, True, ("steering_offset_front",), (), _SCENE)
    change = scene(steer_backlash_rad=lambda c, e: e)
    yield each("steering_slack", ("car",), change, 0.1, False, ("steering_backlash",), (), _SCENE)
    change = scene(imu_pitch_rad=lambda c, e: e)
    yield each("imu_pitched", ("skid", "car"), change, 0.1, True, ("accel_bias",), (), _SCENE)
    # the moment that resists turning, and its currents
    change = body(friction_ratio=lambda b, e: b.friction_ratio * (1.0 - e))
    nearest = ("scrub", "turning_resistance", *_TURNING)
    yield each("slippery", ("skid",), change, 0.7, False, (), nearest, _SCENE)
    change = scene(play_rad=lambda c, e: e)
    yield each("gear_play", ("skid",), change, 0.3, False, ("drive_backlash",), (), _SCENE)

    # that the catalogue lacked when this was written
    change = linkage(backlash_rad=lambda k, e: e)
    yield each(
        "gear_backlash", ("skid", "swerve", "omni"), change, 0.3, False, ("drive_backlash",), (), _PLAIN
    )
    change = body(eccentricity_ratio=lambda b, e: e)
    yield each("wheel_eccentricity", _ALL, change, 0.12, False, (), (), _PLAIN)
    # friction that falls with speed is Coulomb friction at low speed
    change = motor(crawl_ratio=lambda m, e: e)
    yield each("stick_slip", _MOTORS, change, 8.0, False, (), ("rolling_resistance",), _PLAIN)
    yield each("uneven_tread", ("skid", "car"), body(tread_ratio=lambda b, e: e), 0.8, True, (), (), _PLAIN)
    change = sensing(gyro_warming_radps=lambda s, e: e)
    yield each("gyro_warming", _IMU, change, 0.06, True, (), ("gyro_bias",), _PLAIN)
    change = sensing(lidar_late_s2pm=lambda s, e: e)
    yield each("lidar_busy", _ALL, change, 0.4, False, (), ("camera_latency",), _PLAIN)
    # the driven axle's radius by its load: by acceleration and slope
    change = body(squash_ratio=lambda b, e: e)
    yield each("soft_tyres", ("car",), change, 0.5, False, (), ("force_slip",), _PLAIN)
    change = linkage(steer_friction_rad=lambda k, e: e)
    nearest = ("steering_backlash", "steering_delay", "steering_lag")
    yield each("steering_friction", _STEERED, change, 0.15, False, (), nearest, _PLAIN)
    yield each("lost_counts", _ALL, _lost, 0.5, False, (), ("wheel_radius",), _PLAIN)
    yield each("squat", _IMU, sensing(squat_radpmps2=lambda s, e: e), 0.06, False, (), (), _PLAIN)
    change = body(wind_n=lambda b, e: (0.8 * e * b.mass_kg, 0.6 * e * b.mass_kg))
    yield each("wind", _IMU, change, 1.5, True, (), (), _PLAIN)
    change = linkage(steer_gain=lambda k, e: 1.0 + e)
    yield each("steering_gain", _STEERED, change, 0.2, True, ("steering_gain",), ("wheelbase",), _PLAIN)
    change = sensing(gyro_cubic_s2=lambda s, e: e)
    yield each("gyro_cubic", _IMU, change, 0.15, True, ("gyro_nonlinearity",), ("gyro_scale",), _PLAIN)


# -- The values that right names have, beside those of the world before ------------------------------------


def track_m(world: World) -> float:
    """Return the effective track of a skid-steer world: the speed difference of its sides over its yaw rate."""
    driven = driven_by(world, 4, np.random.default_rng(0))
    square, product = 0.0, 0.0
    for run in runs_of(world, driven, np.random.SeedSequence(0)):
        wheels, imu = run.streams["wheels"], run.streams["imu"]
        left, right = (wheels.channel(name) for name in load_robot(world.robot).rate_channels)
        rate = np.interp(wheels.time_s, imu.time_s, imu.channel("gyro_z_radps"))
        square, product = (
            square + float((right - left) @ (right - left)),
            product + float((right - left) @ rate),
        )
    return square / product


def _track(world: World, size: float) -> dict[str, float]:
    if world.name == "omni":
        return {"wheel_distance_ratio": size}
    apart = world._replace(body=world.body._replace(wheels_m=_apart(world.body, size)))
    return {"effective_track_ratio": track_m(apart) / track_m(world) - 1.0}


def _value(name: str, of: Callable[[World, float], float] = lambda world, size: size) -> Any:
    return lambda world, size: {name: of(world, size)}


_VALUES: dict[str, Callable[[World, float], Mapping[str, float]]] = {
    "tyre_radius": _value("wheel_radius_ratio"),
    "side_radius": _value("one_sided_radius_ratio"),
    "wheel_worn": _value("wheel_scale_1_ratio"),
    "wheels_apart": _track,
    "payload": _value("payload_ratio"),
    "soft_ground": _value("rolling_resistance_ratio"),
    "weak_magnets": _value("motor_constant_ratio", lambda world, size: size / (1.0 - size)),
    "gyro_scale": _value("gyro_scale_ratio"),
    "imu_late": _value("imu_latency_s"),
    "lidar_late": _value("camera_latency_s"),
    "lidar_moved": lambda world, size: {"lever_x_m": 0.8 * size, "lever_y_m": -0.6 * size},
    "lidar_turned": _value("camera_yaw_rad", lambda world, size: -size),
    "steering_offset": lambda world, size: {
        "steering_offset_front_rad" if world.name == "car" else "steering_offset_2_rad": size
    },
    "steering_late": _value("steering_delay_s"),
    "steering_gain": _value("steering_gain_ratio"),
    "gear": _value("wheel_radius_ratio"),
    "bearings": _value(
        "rolling_resistance_ratio",
        lambda world, size: float((size / world.body.radius_m).sum()) / (world.body.mass_kg * G_MPS2),
    ),
    "wheels_askew": _value("steering_offset_front_rad"),
    "steering_slack": _value("steering_backlash_rad"),
    "imu_pitched": _value("accel_bias_mps2", lambda world, size: -G_MPS2 * math.sin(size)),
    "gear_play": _value("drive_backlash_rad"),
    "gear_backlash": _value("drive_backlash_rad"),
    "gyro_cubic": _value("gyro_nonlinearity_s2"),
}

EFFECTS = tuple(effect._replace(values=_VALUES.get(effect.name, effect.values)) for effect in _effects())
"""One is of the catalogue where that of a robot's drive has a right name."""


def effects_of(engine: str, world: str) -> tuple[ForeignEffect, ...]:
    """Return the effects of a world."""
    return tuple(effect for effect in EFFECTS if engine in effect.engines and world in effect.robots)


def effect_of(engine: str, world: str, name: str) -> ForeignEffect:
    """Return an effect of a world by its name."""
    return next(effect for effect in effects_of(engine, world) if effect.name == name)
