"""Each effect, hidden in a simulated run, shows with its sign and size; corrected, it is gone."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from terrain.constants import GRAVITY_MPS2
from terrain.effects import bent_rate, library_of
from terrain.extension import corrected, corrected_log
from terrain.kinematics.camera import body_motion
from terrain.kinematics.wheels import no_slip_twist
from terrain.robots import load_robot
from terrain.signals import low_passed
from terrain.simulation.plants.dynamic import shear_slip
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, Faults, make_scenario
from terrain.simulation.sensors import Gnss
from terrain.terramechanics.soil import load_soil

ROBOT = load_robot("agrimaro")
WEIGHT_N = ROBOT.mass_kg * GRAVITY_MPS2
LENGTH_S = {"straight": 15.0, "spot_turn": 15.0, "starts": 20.0, "complex": 40.0}


@lru_cache
def driven(scenario, soil, grade, effects=()):
    drive = make_scenario(scenario, ROBOT, soil, LENGTH_S[scenario])
    given = {"conditions": Conditions(grade_ratio=grade), "faults": Faults(by_chance=False)}
    return simulate(ROBOT, drive, {soil: load_soil(soil)}, seed=5, effects=dict(effects), **given)


def truth(run, channel, time_s):
    stream = run.streams["truth"]
    return np.interp(time_s, stream.time_s, np.unwrap(np.nan_to_num(stream.channel(channel))))


def mean(run, name, channels, start_s=6.0, end_s=math.inf):
    """Return the means (c,) of channels, or of all three wheels by a pattern, over a time."""
    stream = run.streams[name]
    names = [channels.format(i) for i in (1, 2, 3)] if "{}" in channels else [channels]
    inside = (stream.time_s > start_s) & (stream.time_s < end_s)
    return np.array([stream.channel(name)[inside].mean() for name in names])


def slope(x, y):
    return float(np.polyfit(x, y, 1)[0])


def seen(run, robot, time_s=None):
    """Return time, speeds (n, 2) and yaw rate that the camera shows of the robot, at times or at its own."""
    camera = run.streams["odometry"]
    motion, at_s = body_motion(camera, robot.camera), camera.time_s if time_s is None else time_s
    return at_s, *(np.interp(at_s, camera.time_s, v) for v in (*motion.speed_mps.T, motion.yaw_rate_radps))


def rolling(run, robot):
    wheels = run.streams["wheels"]
    rates = np.column_stack([wheels.channel(f"motor_{i}_radps") for i in (1, 2, 3)])
    wheel_speed = rates.mean(axis=1) / robot.motors.reduction_ratio * robot.wheel_radius_m
    return slope(wheel_speed, seen(run, robot, wheels.time_s)[1])


def twist_error(component):
    """What camera and gyro say beyond the twist that wheels and steering ask for."""

    def feature(run, robot):
        rate = mean(run, "wheels", "motor_{}_radps") / robot.motors.reduction_ratio
        steer = mean(run, "steering", "angle_{}_rad") - robot.steering_zeros_rad
        twist, _ = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rate)
        (turn,) = mean(run, "imu", "gyro_z_radps")
        time_s, *speeds, _ = seen(run, robot)
        v_x, v_y = (speed[time_s > 6.0].mean() for speed in speeds)
        measured = (v_x + turn * robot.camera.lever_y_m, v_y - turn * robot.camera.lever_x_m, turn)
        return measured[component] - twist[component]

    return feature


def asked(radii=(1.0, 1.0, 1.0), steer=(0.0, 0.0, 0.0), component=2):
    """Change of the twist of wheels that are commanded straight ahead at 1 m/s."""
    twist, _ = no_slip_twist(ROBOT.wheel_positions_m, np.array(steer), np.array(radii))
    return float(twist[component])


def steering_error(feature):
    """Error of an encoder where it turns, beside its rate."""

    def of_run(run, robot):
        steering = run.streams["steering"]
        angle = np.unwrap(steering.channel("angle_2_rad"))
        rate = np.gradient(angle, steering.time_s)
        turning = np.abs(rate) > 0.3
        return float(feature((angle - truth(run, "steer_2_rad", steering.time_s))[turning], rate[turning]))

    return of_run


def standing(stream, channels, bias=""):
    def feature(run, robot):
        value = mean(run, stream, channels, -1.0, 0.9).sum()
        return float(value - (getattr(robot.sensors, bias) if bias else 0.0))

    return feature


def late(true, measured, latency_s):
    """By how much a signal is behind the truth, from its error over the truth's rate."""

    def feature(run, robot):
        time_s, values = measured(run, robot)
        time_s = time_s - latency_s(robot)
        there = truth(run, true, time_s)
        return -slope(np.gradient(there, time_s), values - there)

    return feature


def gyro(run, robot):
    return run.streams["imu"].time_s, run.streams["imu"].channel("gyro_z_radps")


def gyro_slope(run, robot):
    imu, camera = run.streams["imu"], run.streams["odometry"]
    return slope(np.interp(imu.time_s, camera.time_s, camera.channel("rate_y_radps")), gyro(run, robot)[1])


def steering_gain(run, robot):
    steering = run.streams["steering"]
    angle = np.unwrap(steering.channel("angle_2_rad")) - robot.steering_zeros_rad[1]
    return slope(angle, truth(run, "steer_2_rad", steering.time_s))


def counted(i):
    """Measured over true rate of a wheel."""

    def feature(run, robot):
        (measured,), (true,) = mean(run, "wheels", f"motor_{i}_radps"), mean(run, "truth", f"wheel_{i}_radps")
        return float(measured / robot.motors.reduction_ratio / true)

    return feature


def encoder_late(run, robot):
    wheels = run.streams["wheels"]
    true = truth(run, "wheel_1_radps", wheels.time_s)
    reported = wheels.channel("motor_1_radps") / robot.motors.reduction_ratio
    best = minimize_scalar(
        lambda lag_s: np.sum((low_passed(wheels.time_s, true, lag_s, 1.0) - reported) ** 2), (0.01, 0.1)
    )
    return float(best.x) - robot.sensors.encoder_time_constant_s


def sideways(run, robot):
    time_s, v_x, v_y, _ = seen(run, robot)
    return float(v_y[time_s > 6.0].mean() / v_x[time_s > 6.0].mean())


def lever(run, robot):
    _, _, v_y, turn = seen(run, robot)
    return slope(turn, v_y - robot.camera.lever_x_m * turn)


def slips(run, robot):
    return mean(run, "truth", "slip_{}_ratio").mean()


def traction(run, robot):
    return mean(run, "truth", "traction_{}_n").sum() / WEIGHT_N


def current(run, robot):
    """Current over what moves the robot as described."""
    moved_nm = traction(run, robot) * WEIGHT_N * robot.wheel_radius_m
    return mean(run, "wheels", "current_{}_a").sum() * robot.motors.nm_per_a / moved_nm


def warming(run, robot):
    return mean(run, "wheels", "current_{}_a", 14.0).sum() / mean(run, "wheels", "current_{}_a").sum()


LEVEL, UPHILL, STEEP, ACROSS = (0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 0.15)
E = 0.06
PLAY = steering_error(lambda error, rate: np.median(error * np.sign(rate)))
STEERING_LATE = steering_error(lambda error, rate: slope(rate, error))
GYRO_STANDING = standing("imu", "gyro_z_radps", "gyro_bias_z_radps")
ACCEL_STANDING = standing("imu", "accel_x_mps2", "accel_bias_x_mps2")
CURRENT_STANDING = standing("wheels", "current_{}_a")
GYRO_LATE = late("yaw_rate_radps", gyro, lambda robot: 0.0)
IMU_LATE = late("yaw_rate_radps", gyro, lambda robot: robot.sensors.imu_latency_s)
CAMERA_LATE = late("speed_x_mps", lambda *run: seen(*run)[:2], lambda robot: robot.camera.latency_s)


def imu_length(run, robot):
    return run.streams["imu"].duration_s


CASES = {
    # effect: values, scenario, soil, slope, feature, its change by the values, whether it can be corrected
    "wheel_radius": ((E,), "starts", "tiles", LEVEL, rolling, E, True),
    "one_sided_radius": (
        *((E,), "straight", "tiles", LEVEL, twist_error(2)),
        *(asked(radii=(1 - E / 2, 1 - E / 2, 1 + E / 2)), True),
    ),
    **{
        f"wheel_scale_{i}": ((0.05,), "straight", "tiles", LEVEL, counted(i), -0.05 / 1.05, True)
        for i in (1, 2, 3)
    },
    **{
        f"steering_offset_{i}": (
            *((0.04,), "straight", "tiles", LEVEL, twist_error(component)),
            *(asked(steer=0.04 * (np.arange(3) == i - 1), component=component), True),
        )
        for i, component in ((1, 2), (2, 2), (3, 1))
    },
    "steering_backlash": ((0.04,), "complex", "grass", LEVEL, PLAY, 0.04, True),
    "steering_gain": ((0.08,), "complex", "grass", LEVEL, steering_gain, 0.08, True),
    "steering_lag": ((0.08,), "complex", "grass", LEVEL, STEERING_LATE, 0.08, True),
    "steering_delay": ((0.08,), "complex", "grass", LEVEL, STEERING_LATE, 0.08, True),
    "gyro_bias": ((0.03,), "straight", "grass", LEVEL, GYRO_STANDING, 0.03, True),
    "gyro_scale": ((-0.05,), "spot_turn", "tiles", LEVEL, gyro_slope, -0.05, True),
    "gyro_nonlinearity": ((0.3,), "spot_turn", "tiles", LEVEL, gyro_slope, None, True),
    "accel_bias": ((0.3,), "straight", "grass", LEVEL, ACCEL_STANDING, 0.3, True),
    "imu_latency": ((0.06,), "complex", "grass", LEVEL, IMU_LATE, 0.06, True),
    "camera_latency": ((0.06,), "starts", "grass", LEVEL, CAMERA_LATE, 0.06, True),
    "camera_yaw": ((0.05,), "straight", "tiles", LEVEL, sideways, 0.05, True),
    "lever_arm": ((0.1, -0.07), "spot_turn", "tiles", LEVEL, lever, 0.1, True),
    "clock_offset": ((0.05,), "complex", "grass", LEVEL, GYRO_LATE, 0.05, True),
    "clock_rate": ((0.002,), "complex", "grass", LEVEL, imu_length, 0.002 * 39.99, True),
    "encoder_lag": ((0.04,), "starts", "grass", LEVEL, encoder_late, 0.04, True),
    "force_slip": ((0.4,), "straight", "grass", UPHILL, slips, None, False),
    "shear_slip": ((0.4,), "straight", "tiles", STEEP, slips, None, False),
    "slip_resistance": ((0.2,), "straight", "grass", LEVEL, traction, None, False),
    "rolling_resistance": ((0.04,), "straight", "tiles", LEVEL, traction, 0.04, False),
    "viscous_drag": ((40.0,), "straight", "tiles", LEVEL, traction, 40.0 / WEIGHT_N, False),
    "payload": ((0.3,), "straight", "tiles", UPHILL, traction, None, False),
    "motor_constant": ((0.2,), "straight", "tiles", UPHILL, current, None, True),
    "current_offset": ((0.4,), "straight", "tiles", LEVEL, CURRENT_STANDING, 3 * 0.4, True),
    "motor_drift": ((0.5,), "straight", "tiles", UPHILL, warming, None, True),
    "side_hill_slip": ((0.3,), "straight", "tiles", ACROSS, sideways, -0.3 * math.atan(0.15), False),
}


def change_of(name, clean, run, values):
    """Return what the catalogue's formula makes of the runs, where no constant says it."""
    f = traction(clean, ROBOT)
    turn = seen(clean, ROBOT)[3]
    return {
        "gyro_nonlinearity": lambda: slope(turn, bent_rate(turn, *values)) - 1.0,
        "force_slip": lambda: values[0] * f,
        "shear_slip": lambda: values[0] * shear_slip(f, load_soil("tiles").peak_friction_ratio),
        "slip_resistance": lambda: values[0] * slips(run, ROBOT),
        "payload": lambda: values[0] * f,
        "motor_constant": lambda: values[0] * current(clean, ROBOT),
        # means over 14 s to 15 s and 6 s to 15 s
        "motor_drift": lambda: (1 + values[0] * 14.5 / 60) / (1 + values[0] * 10.5 / 60) - 1,
    }[name]()


@pytest.mark.parametrize("effect", library_of("swerve"), ids=lambda effect: effect.name)
def test_a_hidden_effect_shows_with_its_sign_and_size(effect):
    values, scenario, soil, grade, feature, desired, can_be_corrected = CASES[effect.name]
    effects = {p.name: value for p, value in zip(effect.parameters, values, strict=True)}
    clean, run = driven(scenario, soil, grade), driven(scenario, soil, grade, tuple(effects.items()))
    desired = change_of(effect.name, clean, run, values) if desired is None else desired
    change = feature(run, ROBOT) - feature(clean, ROBOT)
    assert change == pytest.approx(desired, rel=0.15)
    if can_be_corrected:
        robot = replace(ROBOT, effects=effects)
        left = feature(corrected_log(run, robot), corrected(robot)) - feature(clean, ROBOT)
        assert abs(left) < 0.1 * abs(desired)
        assert not corrected(robot).effects


def test_absent_effects_leave_every_byte():
    none = dict.fromkeys((p.name for e in library_of("swerve") for p in e.parameters), 0.0)
    drive = make_scenario("complex", ROBOT, "grass", 30.0)
    options = {"conditions": Conditions(leg_backlash_rad=0.02, grade_ratio=(0.03, 0.05)), "gnss": Gnss()}
    one, other = (
        simulate(ROBOT, drive, {"grass": load_soil("grass")}, 0, effects=effects, **options).streams
        for effects in (None, none)
    )
    assert {name: (s.time_s.tobytes(), s.values.tobytes()) for name, s in one.items()} == {
        name: (s.time_s.tobytes(), s.values.tobytes()) for name, s in other.items()
    }


def test_only_the_other_logger_has_its_own_clock():
    effects = {"clock_offset_s": 0.2, "clock_rate_ratio": 0.01}
    drive, soils = make_scenario("straight", ROBOT, "tiles", 10.0), {"tiles": load_soil("tiles")}
    clean, run = (simulate(ROBOT, drive, soils, 0, gnss=Gnss(), effects=e) for e in ({}, effects))
    for name, stream in run.streams.items():
        plain = clean.streams[name].time_s
        late = 1.01 * plain + 0.2 if name in ("imu", "odometry", "gnss") else plain
        np.testing.assert_allclose(stream.time_s, late, atol=1e-12)
        np.testing.assert_array_equal(stream.values, clean.streams[name].values)
