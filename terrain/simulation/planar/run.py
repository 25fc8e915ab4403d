"""One run of the planar simulation: desired twists in, an ordinary run log with its truth out.

Twists become the wheel speeds and steering angles that a controller would command with the described geometry
(:mod:`~terrain.simulation.planar.drives`); the motors follow them with a lag and bounded rates;
:func:`~terrain.simulation.planar.motion.move` gives the motion on hilly terrain,
:func:`~terrain.simulation.planar.ideal_sensors.sense` the measurements of sensors without noise; loggers add
noise, bias and quantisation (:mod:`~terrain.simulation.planar.streams`).  A hidden effect is a number in the
same vector that a replay has.

The hills are those along the path that the wheels would roll without slip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from terrain.effects import (
    INDEX,
    nuisances_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.kinematics.wheel_motion import WheelMotion, wheel_motion
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import Part, Robot, SwerveRobot
from terrain.simulation.planar.drives import COMMANDS_HZ, commands_stream, follow_commands
from terrain.simulation.planar.hills import Hills, path_of, tilt_along, undulations
from terrain.simulation.planar.ideal_sensors import sense
from terrain.simulation.planar.model import Ground, Planar, make_planar
from terrain.simulation.planar.motion import move
from terrain.simulation.planar.noise import (
    Noise,
    Scatter,
    activity,
    coloured,
)
from terrain.simulation.planar.streams import (
    Generators,
    PlanarMotion,
    PlanarRun,
    camera_stream,
    encoder_scales,
    imu_stream,
    lidar_stream,
    planar_truth,
    pose_stream,
    steering_stream,
    wheels_stream,
)

STEP_S = 0.01
"""From step to step: no sensor is sampled faster."""

OUTSIDE: tuple[str, ...] = ("wheel_eccentricity_ratio", "stick_slip_a")
"""Causes that no effect of the library describes: wheel speed x (1 + e sin(wheel angle)), each wheel with its
own phase, and spikes of the current at crawling speed."""

_PURPOSES = ("scatter", "hills", "ground", "wheels", "steering", "imu", "camera", "outside", "lidar")


def simulate_planar(
    robot: Robot,
    twist: Array,
    seed: int | np.random.SeedSequence,
    *,
    ground: Ground | None = None,
    effects: Mapping[str, float] | None = None,
    scatter: Scatter | None = None,
    hills: Hills | None = None,
    noise: Noise | None = None,
    outside: Mapping[str, float] | None = None,
    heading: bool = False,
    run_id: str = "run",
    terrain: str = "",
    step_s: float = STEP_S,
) -> RunLog:
    """Drive twists and return what the loggers wrote, with the truth beside it.

    Parameters
    ----------
    robot : a swerve robot with all its sections; of other robots those that are missing do not act
        (:func:`~terrain.simulation.planar.model.make_planar`); without motors there are no currents
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)`` at 50 Hz, from rest
    seed : of everything that is drawn; the same gives the same bytes, and a sequence is left as it is
    ground : a firm one by default
    effects : parameters of :mod:`terrain.effects.catalogue`, beside or in place of the description's own
    scatter : of this run's own parameters; by default they do not
    hills, noise : level and without noise by default; then encoders do not quantise
    outside : amplitudes of :data:`OUTSIDE`
    heading : add the stream lidar, with the rate of a heading that does not depend on the gyro
    run_id, terrain, step_s : of the run, from step to step; without a terrain it has no label

    Returns
    -------
    RunLog
        streams wheels, imu, odometry, commands, truth, and steering of a robot that has it.  The odometry of
        a swerve robot is a tracking camera's pose, that of others the speed of the camera's point in body
        axes.
        An omni robot has wheels, commands, truth (with the slip of its body, ``slip_body_ratio``), and pose
        of a camera above, as its measured runs.

    Raises
    ------
    ConfigError
        if a swerve robot lacks a section, or a parameter or an outside cause is unknown or not finite.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> twist = np.zeros((501, 3))
    >>> twist[50:, 0] = 0.5
    >>> run = simulate_planar(load_robot("husky"), twist, 0, effects={"wheel_radius_ratio": -0.1})
    >>> sorted(run.streams)
    ['commands', 'imu', 'odometry', 'truth', 'wheels']
    >>> run.streams["wheels"].values[-1, :2].round(3), run.streams["odometry"].values[-1].round(3)
    (array([0.5, 0.5]), array([0.443, 0.   ]))
    """
    outside = outside or {}
    _check(robot, twist, outside, step_s)
    currents = robot.describes("motors") and "motors" in robot.sections
    robot = with_silent_parts(robot)
    planar = make_planar(robot, ground or Ground())
    rngs = _generators(seed)
    p = vector_of({**robot.effects, **(effects or {})})
    if scatter is not None:
        for name in nuisances_of(robot.drive):
            p[INDEX[name]] += getattr(scatter, name) * rngs["scatter"].standard_normal()
    desired = wheel_motion(robot, twist, 1.0 / COMMANDS_HZ)
    setup = PlanarSetup(robot, planar, p, step_s, noise, outside)
    motion = _motion(setup, desired, hills or Hills(), rngs)
    run = PlanarRun(robot, planar, p, step_s, motion, sense(planar, p, step_s, motion.truth), noise)
    streams = _streams(run, commands_stream(robot, desired), rngs, outside, currents)
    if heading:
        streams["lidar"] = lidar_stream(run, rngs["lidar"])
    labels = (Label(0.0, (len(twist) - 1) / COMMANDS_HZ, terrain),) if terrain else ()
    return RunLog(run_id, robot.name, streams, labels, source="simulated, planar")


def _streams(
    run: PlanarRun, commands: Stream, rngs: Generators, outside: Mapping[str, float], currents: bool
) -> dict[str, Stream]:
    """Return what the loggers of a robot's drive wrote, and the truth."""
    streams = {"wheels": wheels_stream(run, outside.get("stick_slip_a", 0.0), rngs, currents)}
    if run.planar.omni:
        streams["pose"] = pose_stream(run, rngs["camera"])
    else:
        streams["imu"] = imu_stream(run, rngs["imu"])
        streams["odometry"] = camera_stream(run, rngs["camera"])
    streams |= {"commands": commands, "truth": planar_truth(run)}
    if run.robot.steered:
        streams["steering"] = steering_stream(run, rngs["steering"])
    return streams


def _check(robot: Robot, twist: Array, outside: Mapping[str, float], step_s: float) -> None:
    if isinstance(robot, SwerveRobot):
        robot.require(*robot.sections)
    if twist.ndim != 2 or twist.shape[1] != 3 or len(twist) < 2 or not np.isfinite(twist).all():
        raise ConfigError(f"twist has shape {twist.shape}, (n, 3) finite numbers with two rows are required")
    if not robot.sideways and twist[:, 1].any():
        raise ConfigError(
            f"twist drives robot {robot.name} sideways, which needs steered wheels or omni wheels"
        )
    if robot.on_omni_wheels and outside.get("stick_slip_a"):
        raise ConfigError(f"outside: stick_slip_a is not simulated of robot {robot.name} on omni wheels")
    for name, value in outside.items():
        if name not in OUTSIDE or not math.isfinite(value):
            raise ConfigError(
                f"outside: {name} is {value!r}; finite numbers of {', '.join(OUTSIDE)} are required"
            )
    parts = STEP_S / step_s if step_s > 0 else 0.0
    if parts < 0.5 or abs(parts - round(parts)) > 1e-9:
        raise ConfigError(f"step_s is {step_s:g}, {STEP_S:g} s or a whole part of it is required")


def with_silent_parts(robot: Robot) -> Robot:
    """Return the robot with parts that neither act nor are noisy for the sections that it lacks.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> with_silent_parts(load_robot("warthog")).sensors.gyro_std_radps
    0.0
    """
    silent: dict[str, Part] = {}
    for name, part in robot.completed.parts.items():
        if name not in robot.parts:
            unknown = [item.name for item in fields(part) if math.isnan(getattr(part, item.name))]
            silent[name] = replace(part, **dict.fromkeys(unknown, 0.0))  # type: ignore[arg-type]
    return robot.with_parts(**silent)


def _generators(seed: int | np.random.SeedSequence) -> dict[str, np.random.Generator]:
    """One generator a purpose: a sensor more or less changes nothing about the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return {
        purpose: np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i)))
        for i, purpose in enumerate(_PURPOSES)
    }


class PlanarSetup(NamedTuple):
    """A run before it is driven: robot, its numbers on the terrain, effects, step and disturbances."""

    robot: Robot
    planar: Planar
    p: Array
    dt: float
    noise: Noise | None
    outside: Mapping[str, float]


def _motion(setup: PlanarSetup, desired: WheelMotion, hills: Hills, rngs: Generators) -> PlanarMotion:
    """Return the motion of a robot that follows its commands over hills."""
    robot, planar, p, dt, noise, outside = setup
    parts = round(1.0 / (COMMANDS_HZ * dt))
    rate_max = robot.steering_rate_max_radps
    wheel_speed, steer = follow_commands(desired.wheel_speed_mps, desired.steer_rad, parts, dt, rate_max)
    n = len(wheel_speed)
    active = np.zeros(n) if noise is None else activity(np.abs(wheel_speed).mean(axis=1), noise)
    disturbance = _disturbance(noise, active, dt, rngs["ground"])
    rolled = wheel_speed
    if eccentric := outside.get("wheel_eccentricity_ratio", 0.0):
        phase = rngs["outside"].uniform(0.0, 2.0 * math.pi, wheel_speed.shape[1])
        angle = np.cumsum(wheel_speed, axis=0) * dt / robot.wheel_radius_m
        rolled = wheel_speed * (1.0 + eccentric * np.sin(angle + phase))
    level = np.zeros(n)
    truth = move(planar, p, dt, rolled, steer, level, level, disturbance)
    pose = path_of(truth, dt)
    grade, roll = tilt_along(pose, np.array(hills.grade_ratio), undulations(hills, rngs["hills"]))
    if grade.any() or roll.any():
        truth = move(planar, p, dt, rolled, steer, grade, roll, disturbance)
        pose = path_of(truth, dt)
    sides = np.full(wheel_speed.shape[1], 1.0 - 0.5 * p[INDEX["one_sided_radius_ratio"]])
    sides[-1] = 1.0 + 0.5 * p[INDEX["one_sided_radius_ratio"]]
    rolled = rolled * (1.0 + p[INDEX["wheel_radius_ratio"]]) * sides * encoder_scales(robot, p)
    return PlanarMotion(truth, pose, grade, roll, wheel_speed, rolled, steer, active)


def _disturbance(noise: Noise | None, active: Array, dt: float, rng: np.random.Generator) -> Array:
    """Return the disturbance (n, 3) of the terrain as :func:`move` takes it, (0, 3) without noise."""
    if noise is None:
        return np.zeros((0, 3))
    white = rng.standard_normal((3, len(active)))
    std = np.array([noise.along_ratio, noise.across_ratio, noise.yaw_radps])
    tau_s = np.array([noise.along_s, noise.across_s, noise.yaw_s])
    disturbance: Array = coloured(white, std, tau_s, dt).T.copy()
    disturbance[:, 2] *= active
    return disturbance
