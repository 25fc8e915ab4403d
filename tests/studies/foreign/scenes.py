"""Scenes of MuJoCo: robots on wheels that touch the ground by its contacts, not by equations of this project.

``pip install mujoco`` (the extra ``studies``).  A skid-steer robot, a car-like one with an open
differential and steered hinges, and one on three balls that are driven about one axis each and roll freely about the
others, as omni wheels do.  Motors are velocity servos; encoders, gyro, accelerometer and speeds at the lidar are
sensors of the scene, at mounts that may be elsewhere than the description says.  A slope is a gravity that leans.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from studies.foreign.physics import G_MPS2, SAMPLE_S, STEP_S, Body, Motion, slopes_of
from studies.foreign.sensors import Motor
from terrain.records import Array

SCENE_STEP_S = STEP_S / 2
PER_SAMPLE = round(SAMPLE_S / SCENE_STEP_S)
WHEEL_KG, BALL_KG = 2.0, 0.2
# Of each motor; that of the car turns both wheels of an axle.  A step's damping is a quarter of the inertia behind it
# at the most: beyond that a contact's friction lags behind the wheel.
SERVO_NMSPR = {"skid": 20.0, "car": 400.0, "omni": 0.3}
LEAST_INERTIA_KGM2 = {"skid": 0.05, "car": 0.5, "omni": 0.002}  #: of a motor, at the wheel
# Times in which contacts yield normal to the ground and along it.  Wheels that slide all the time are softer along it:
# a contact that slides and is stiff lifts itself off the ground, as a convex solver has it.
NORMAL_S, CREEP_S = 0.02, {"skid": 0.5, "car": 0.25, "omni": 0.04}
MOTORS = "actuatorvel", "actuatorfrc"  #: sensors of each motor


class Scene(NamedTuple):
    """What a scene has beside bodies and sensors."""

    gear_ratio: float = 1.0  #: wheel angle over that of the encoder
    play_rad: float = 0.0  #: half of the play between motor and wheel
    bearing_nm: float = 0.0  #: friction of each wheel's bearing
    roller_nms: float = 0.0  #: damping of a ball that rolls
    steer_backlash_rad: float = 0.0
    steer_offset_rad: float = 0.0
    imu_m: tuple[float, float] = (0.0, 0.0)
    imu_pitch_rad: float = 0.0  #: nose down
    lidar_m: tuple[float, float] = (0.0, 0.0)
    lidar_yaw_rad: float = 0.0


class Recorded(NamedTuple):
    """What a scene's own sensors recorded: the motion, and (n, runs, wheels) of the motors."""

    motion: Motion
    turned_rad: Array  #: angles of the motors' encoders, at the wheel
    torque_nm: Array  #: of the motors, at the wheel
    steer_rad: Array  #: angles of the steered joints; of none without


def _quat(yaw_rad: float) -> str:
    return f"{math.cos(yaw_rad / 2)} 0 0 {math.sin(yaw_rad / 2)}"


def _wheel(k: int, body: Body, scene: Scene, kind: str, inertia: float, friction_nm: float) -> str:
    """Return a wheel on the shaft of its motor, with play between them where there is some."""
    x, y = body.wheels_m[k]
    radius = body.radius_m[k]
    steered = kind == "car" and k < 2
    size = f"{radius} {0.5 * radius} {radius}"
    touch = f'<geom name="tyre{k}" type="ellipsoid" size="{size}" mass="{WHEEL_KG}"/>'
    play = f'<joint name="play{k}" axis="0 1 0" range="{-scene.play_rad} {scene.play_rad}" limited="true"/>'
    shaft = (
        f'<joint name="motor{k}" axis="0 1 0" armature="{inertia}" frictionloss="{friction_nm}"/>'
        '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/>'
        f"<body>{play if scene.play_rad else ''}{touch}</body>"
    )
    if steered:
        loose = (
            f'<joint name="loose{k}" axis="0 0 1" range="{-scene.steer_backlash_rad} {scene.steer_backlash_rad}" '
            'limited="true" damping="0.5"/>'
            if scene.steer_backlash_rad
            else ""
        )
        return (
            f'<body pos="{x} {y} 0"><joint name="steer{k}" axis="0 0 1" damping="5"/>'
            '<inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>'
            f'<body quat="{_quat(scene.steer_offset_rad)}">{loose}'
            f'<inertial pos="0 0 0" mass="0.5" diaginertia="0.02 0.02 0.02"/><body>{shaft}</body></body></body>'
        )
    return f'<body pos="{x} {y} 0">{shaft}</body>'


def _ball(k: int, body: Body, scene: Scene, inertia: float) -> str:
    x, y = body.wheels_m[k]
    return (
        f'<body pos="{x} {y} 0"><joint name="ball{k}" type="ball" damping="{scene.roller_nms}"/>'
        f'<inertial pos="0 0 0" mass="{BALL_KG}" diaginertia="{inertia} {inertia} {inertia}"/>'
        f'<geom type="sphere" size="{body.radius_m[k]}" name="tyre{k}"/><site name="ball{k}"/></body>'
    )


def model_of(kind: str, body: Body, scene: Scene, motor: Motor) -> Any:
    """Return the model of a scene."""
    import mujoco

    wheels, w = range(len(body.wheels_m)), float(body.radius_m.mean())
    x, y = body.com_m
    motor_inertia = max(motor.inertia_kgm2, LEAST_INERTIA_KGM2[kind])
    friction_nm = motor.friction_nm + scene.bearing_nm
    mounted = "".join(
        f'<site name="mount{k}" pos="{body.wheels_m[k][0]} {body.wheels_m[k][1]} 0" '
        f'quat="{_quat(math.atan2(*body.wheels_m[k][::-1]) + math.pi / 2)}"/>'
        for k in wheels
        if kind == "omni"
    )
    parts = "".join(
        _ball(k, body, scene, motor_inertia)
        if kind == "omni"
        else _wheel(k, body, scene, kind, motor_inertia, friction_nm)
        for k in wheels
    )
    own = body.mass_kg - len(wheels) * (BALL_KG if kind == "omni" else WHEEL_KG)
    height = body.com_height_m - w
    inertia = body.inertia_kgm2
    pitch = scene.imu_pitch_rad / 2
    kv = SERVO_NMSPR[kind]
    driven = [k for k in wheels if not body.driven or body.driven[k]]
    gear, tendon, angles = 1.0 / scene.gear_ratio, "", ""
    if kind == "omni":
        turn = f'gear="0 0 0 0 {gear} 0" kv="{kv}"'
        servos = [f'<velocity name="a{k}" site="ball{k}" refsite="mount{k}" {turn}/>' for k in wheels]
    elif kind == "car":
        joints = "".join(f'<joint joint="motor{k}" coef="{0.5 * gear}"/>' for k in driven)
        tendon = f'<tendon><fixed name="axle">{joints}</fixed></tendon>'
        servos = [f'<velocity name="a0" tendon="axle" kv="{kv}"/>']
        angles = '<jointpos joint="steer0"/><jointpos joint="steer1"/>'
    else:
        servos = [f'<velocity name="a{k}" joint="motor{k}" gear="{gear}" kv="{kv}"/>' for k in driven]
    sensed = "".join(f'<{what} actuator="a{k}"/>' for what in MOTORS for k in range(len(servos))) + angles
    if kind == "car":
        servos += [f'<position joint="steer{k}" kp="400"/>' for k in (0, 1)]
    mu, drag_m = body.friction_ratio, body.drag_ratio * w
    pairs = "".join(
        f'<pair geom1="ground" geom2="tyre{k}" condim="6" friction="{mu} {mu} 0.001 {drag_m} {drag_m}" '
        f'solref="{NORMAL_S} 1" solreffriction="{CREEP_S[kind]} 1"/>'
        for k in wheels
    )
    xml = f"""
<mujoco><option timestep="{SCENE_STEP_S}" integrator="Euler" cone="elliptic"/>
<default><geom contype="0" conaffinity="0"/></default><contact>{pairs}</contact>
<worldbody><geom name="ground" type="plane" size="0 0 1"/>
<body name="chassis" pos="0 0 {w}"><freejoint/>
<inertial pos="{x} {y} {height}" mass="{own}" diaginertia="{0.5 * inertia} {0.6 * inertia} {0.8 * inertia}"/>
<site name="imu" pos="{scene.imu_m[0]} {scene.imu_m[1]} 0" quat="{math.cos(pitch)} 0 {math.sin(pitch)} 0"/>
<site name="lidar" pos="{scene.lidar_m[0]} {scene.lidar_m[1]} 0" quat="{_quat(scene.lidar_yaw_rad)}"/>
<site name="middle"/>{mounted}{parts}</body></worldbody>{tendon}
<actuator>{"".join(servos)}</actuator>
<sensor><gyro site="imu"/><accelerometer site="imu"/><velocimeter site="lidar"/><velocimeter site="middle"/>
<framexaxis objtype="site" objname="middle"/><framepos objtype="site" objname="lidar"/>{sensed}</sensor></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def moved(kind: str, body: Body, scene: Scene, motor: Motor, driven: Any) -> Recorded:
    """Return what a scene records where its motors are asked for the rates and angles of :class:`worlds.Driven`."""
    import mujoco
    from mujoco import rollout

    runs, rate, steer = driven.rate.shape[1], driven.rate[1:], driven.steer[1:]
    control = {
        "skid": lambda: rate,
        "omni": lambda: rate,
        "car": lambda: np.concatenate([rate[..., 2:3], steer[..., :2]], axis=2),
    }[kind]()
    models, starts = [], []
    for i in range(runs):
        own = body._replace(friction_ratio=body.friction_ratio * driven.friction[i])
        model = model_of(kind, own, scene, motor)
        s_x, s_y = driven.slope[i]
        model.opt.gravity[:] = -G_MPS2 * np.array([s_x, s_y, 1.0]) / math.sqrt(1.0 + s_x**2 + s_y**2)
        data = mujoco.MjData(model)
        data.qpos[3:7] = math.cos(driven.yaw_rad[i] / 2), 0.0, 0.0, math.sin(driven.yaw_rad[i] / 2)
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        models.append(model)
        starts.append(state)
    _, sensed = rollout.rollout(
        models, mujoco.MjData(models[0]), np.array(starts), control.transpose(1, 0, 2)
    )
    # a sample is the mean of its steps, as of sensors with a low-pass against contacts that ring
    n = sensed.shape[1] // PER_SAMPLE
    mean = sensed[:, : n * PER_SAMPLE].reshape(runs, n, PER_SAMPLE, -1).mean(axis=2).transpose(1, 0, 2)
    motors = {"skid": 4, "car": 1, "omni": 3}[kind]
    turned = np.cumsum(sensed[..., 18 : 18 + motors], axis=1) * SCENE_STEP_S
    turned = turned[:, PER_SAMPLE - 1 : n * PER_SAMPLE : PER_SAMPLE].transpose(1, 0, 2)
    yaw = np.unwrap(np.arctan2(mean[..., 13], mean[..., 12]), axis=0)
    tilt = slopes_of(driven.slope, yaw)
    zero = np.zeros((n, runs, 1))
    motion = Motion(
        time_s=(np.arange(n) + 0.5) * SAMPLE_S,
        speed_x_mps=mean[..., 9],
        speed_y_mps=mean[..., 10],
        yaw_rate_radps=mean[..., 2],
        yaw_rad=yaw,
        accel_x_mps2=mean[..., 3],
        accel_y_mps2=mean[..., 4],
        slope_x=tilt[0],
        slope_y=tilt[1],
        pull_n=zero,
        load_n=zero,
        seen_x_mps=mean[..., 6],
        seen_y_mps=mean[..., 7],
        seen_m=mean[..., 15:17],
    )
    turning, rest = mean[..., 18 : 18 + motors], mean[..., 18 + motors :]
    torque = rest[..., :motors]
    if kind == "omni":  # friction of a ball's joint would act about all of its axes
        torque = torque + motor.friction_nm * np.tanh(turning / 0.15)
    return Recorded(motion, turned, torque, rest[..., motors:])
