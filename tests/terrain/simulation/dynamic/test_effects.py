"""Each effect, hidden in a simulated run, shows with its sign and size; corrected, it is gone."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from terrain.constants import GRAVITY_MPS2
from terrain.effects import library_of
from terrain.errors import ConfigError
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
    return simulate(
        ROBOT,
        make_scenario(scenario, ROBOT, soil, LENGTH_S[scenario]),
        {soil: load_soil(soil)},
        seed=5,
        conditions=Conditions(grade_ratio=grade),
        faults=Faults(by_chance=False),
        effects=dict(effects),
    )


def truth(run, channel, time_s):
    stream = run.streams["truth"]
    return np.interp(time_s, stream.time_s, np.nan_to_num(stream.channel(channel)))


def steady(run, name, start_s=6.0):
    stream = run.streams[name]
    return stream, stream.time_s > start_s


def summed(run, pattern, start_s=6.0):
    stream, late = steady(run, "wheels" if pattern.startswith("current") else "truth", start_s)
    return float(sum(stream.channel(pattern.format(i))[late].mean() for i in (1, 2, 3)))


def slope(x, y):
    return float(np.polyfit(x, y, 1)[0])


def rolling(run, robot):
    wheels = run.streams["wheels"]
    rates = np.column_stack([wheels.channel(f"motor_{i}_radps") for i in (1, 2, 3)])
    wheel_speed = rates.mean(axis=1) / robot.motors.reduction_ratio * robot.wheel_radius_m
    camera = run.streams["odometry"]
    seen = body_motion(camera, robot.camera).speed_mps[:, 0]
    return slope(wheel_speed, np.interp(wheels.time_s, camera.time_s, seen))


def twist_error(component):
    """What camera and gyro say beyond the twist that wheels and steering ask for."""

    def feature(run, robot):
        wheels, late = steady(run, "wheels")
        rates = np.column_stack([wheels.channel(f"motor_{i}_radps")[late] for i in (1, 2, 3)])
        angles = run.streams["steering"]
        zeros = [getattr(robot.steering, f"zero_{i}_rad") for i in (1, 2, 3)]
        late = angles.time_s > 6.0
        steer = np.column_stack([angles.channel(f"angle_{i}_rad")[late] for i in (1, 2, 3)]) - zeros
        rate = rates.mean(axis=0) / robot.motors.reduction_ratio
        twist, _ = no_slip_twist(robot.wheel_positions_m, steer.mean(axis=0), robot.wheel_radius_m * rate)
        imu, late = steady(run, "imu")
        turn = imu.channel("gyro_z_radps")[late].mean()
        camera, late = steady(run, "odometry")
        v_x, v_y = body_motion(camera, robot.camera).speed_mps[late].mean(axis=0)
        measured = (v_x + turn * robot.camera.lever_y_m, v_y - turn * robot.camera.lever_x_m, turn)
        return measured[component] - twist[component]

    return feature


def asked(radii=(1.0, 1.0, 1.0), steer=(0.0, 0.0, 0.0), component=2):
    """Change of the twist of wheels that are commanded straight ahead at 1 m/s."""
    rate = np.array(radii) / ROBOT.wheel_radius_m
    return float(
        no_slip_twist(ROBOT.wheel_positions_m, np.array(steer), ROBOT.wheel_radius_m * rate)[0][component]
    )


def encoder_error(run, robot):
    steering = run.streams["steering"]
    seen = np.unwrap(steering.channel("angle_2_rad"))
    rate = np.gradient(seen, steering.time_s)
    error = seen - truth_angle(run, steering.time_s)
    turning = np.abs(rate) > 0.3
    return error[turning], rate[turning]


def truth_angle(run, time_s):
    stream = run.streams["truth"]
    return np.interp(time_s, stream.time_s, np.unwrap(stream.channel("steer_2_rad")))


def play(run, robot):
    error, rate = encoder_error(run, robot)
    return float(np.median(error * np.sign(rate)))


def steering_late(run, robot):
    error, rate = encoder_error(run, robot)
    return slope(rate, error)


def standing(channel):
    def feature(run, robot):
        imu = run.streams["imu"]
        value = float(imu.channel(channel)[imu.time_s < 0.9].mean())
        bias = {"gyro_z_radps": "gyro_bias_z_radps", "accel_x_mps2": "accel_bias_x_mps2"}[channel]
        return value - getattr(robot.sensors, bias)

    return feature


def gyro_slope(run, robot):
    imu, camera = run.streams["imu"], run.streams["odometry"]
    seen = np.interp(imu.time_s, camera.time_s, camera.channel("rate_y_radps"))
    return slope(seen, imu.channel("gyro_z_radps"))


def fused_yaw(run, robot):
    imu = run.streams["imu"]
    return slope(truth(run, "yaw_rad", imu.time_s), np.unwrap(imu.channel("yaw_rad")))


def camera_late(run, robot):
    camera = run.streams["odometry"]
    time_s = camera.time_s - robot.camera.latency_s
    speed = body_motion(camera, robot.camera).speed_mps[:, 0]
    true = truth(run, "speed_x_mps", time_s)
    return -slope(np.gradient(true, time_s), speed - true)


def gyro_late(run, robot):
    imu = run.streams["imu"]
    true = truth(run, "yaw_rate_radps", imu.time_s)
    return -slope(np.gradient(true, imu.time_s), imu.channel("gyro_z_radps") - true)


def imu_late(run, robot):
    imu = run.streams["imu"]
    true = truth(run, "yaw_rate_radps", imu.time_s - robot.sensors.imu_latency_s)
    return -slope(np.gradient(true, imu.time_s), imu.channel("gyro_z_radps") - true)


def standing_current(run, robot):
    wheels = run.streams["wheels"]
    stands = wheels.time_s < 0.9
    return float(sum(wheels.channel(f"current_{i}_a")[stands].mean() for i in (1, 2, 3)))


def counted(i):
    """Measured over true rate of a wheel."""

    def feature(run, robot):
        wheels, late = steady(run, "wheels")
        true = truth(run, f"wheel_{i}_radps", wheels.time_s[late])
        measured = wheels.channel(f"motor_{i}_radps")[late] / robot.motors.reduction_ratio
        return slope(true, measured) if np.ptp(true) > 1.0 else float(measured.mean() / true.mean())

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
    camera, late = steady(run, "odometry")
    v_x, v_y = body_motion(camera, robot.camera).speed_mps[late].T
    return float(np.mean(v_y) / np.mean(v_x))


def lever(component):
    def feature(run, robot):
        camera = run.streams["odometry"]
        seen = body_motion(camera, robot.camera)
        arm = (robot.camera.lever_x_m, -robot.camera.lever_y_m)[component]
        speed = seen.speed_mps[:, 1 - component] - arm * seen.yaw_rate_radps
        return slope(seen.yaw_rate_radps, speed)

    return feature


def imu_length(run, robot):
    return run.streams["imu"].duration_s


def slips(run, robot):
    return summed(run, "slip_{}_ratio") / 3


def traction(run, robot):
    return summed(run, "traction_{}_n") / WEIGHT_N


def current(run, robot):
    """Current over what moves the robot as described."""
    per_n = robot.wheel_radius_m / (
        robot.motors.torque_constant_nmpa * robot.motors.reduction_ratio * robot.motors.efficiency_ratio
    )
    return summed(run, "current_{}_a") / (summed(run, "traction_{}_n") * per_n)


def warming(run, robot):
    return summed(run, "current_{}_a", 14.0) / summed(run, "current_{}_a", 6.0)


LEVEL, UPHILL, STEEP, ACROSS = (0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 0.15)
_FORCE = 0.1 / math.hypot(1.0, 0.1)
E = 0.06
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
    "steering_backlash": ((0.04,), "complex", "grass", LEVEL, play, 0.04, True),
    "steering_delay": ((0.08,), "complex", "grass", LEVEL, steering_late, 0.08, True),
    "gyro_bias": ((0.03,), "straight", "grass", LEVEL, standing("gyro_z_radps"), 0.03, True),
    "gyro_scale": ((-0.05,), "spot_turn", "tiles", LEVEL, gyro_slope, -0.05, True),
    "accel_bias": ((0.3,), "straight", "grass", LEVEL, standing("accel_x_mps2"), 0.3, True),
    "imu_latency": ((0.06,), "complex", "grass", LEVEL, imu_late, 0.06, True),
    "camera_latency": ((0.06,), "starts", "grass", LEVEL, camera_late, 0.06, True),
    "camera_yaw": ((0.05,), "straight", "tiles", LEVEL, sideways, 0.05, True),
    "lever_arm": ((0.1, -0.07), "spot_turn", "tiles", LEVEL, lever(0), 0.1, True),
    "clock_offset": ((0.05,), "complex", "grass", LEVEL, gyro_late, 0.05, True),
    "clock_rate": ((0.002,), "complex", "grass", LEVEL, imu_length, 0.002 * 39.99, True),
    "encoder_lag": ((0.04,), "starts", "grass", LEVEL, encoder_late, 0.04, True),
    "force_slip": ((0.4,), "straight", "grass", UPHILL, slips, None, False),
    "shear_slip": ((0.4,), "straight", "tiles", STEEP, slips, None, False),
    "slip_resistance": ((0.2,), "straight", "grass", LEVEL, traction, None, False),
    "rolling_resistance": ((0.04,), "straight", "tiles", LEVEL, traction, 0.04, False),
    "viscous_drag": ((40.0,), "straight", "tiles", LEVEL, traction, 40.0 / WEIGHT_N, False),
    "payload": ((0.3,), "straight", "tiles", UPHILL, traction, None, False),
    "motor_constant": ((0.2,), "straight", "tiles", UPHILL, current, None, True),
    "current_offset": ((0.4,), "straight", "tiles", LEVEL, standing_current, 3 * 0.4, True),
    "motor_drift": ((0.5,), "straight", "tiles", UPHILL, warming, None, True),
    "side_hill_slip": ((0.3,), "straight", "tiles", ACROSS, sideways, -0.3 * math.atan(0.15), False),
}


def change_of(name, clean, run, values):
    """Return what the catalogue's formula makes of the runs, where no constant says it."""
    f = traction(clean, ROBOT)
    return {
        "force_slip": lambda: values[0] * f,
        "shear_slip": lambda: values[0] * shear_slip(f, load_soil("tiles").peak_friction_ratio),
        "slip_resistance": lambda: values[0] * slips(run, ROBOT),
        "payload": lambda: values[0] * f,
        "motor_constant": lambda: values[0] * current(clean, ROBOT),
        # means over 14 s to 15 s and 6 s to 15 s
        "motor_drift": lambda: (1 + values[0] * 14.5 / 60) / (1 + values[0] * 10.5 / 60) - 1,
    }[name]()


def parameters(name, values):
    effect = next(effect for effect in library_of("swerve") if effect.name == name)
    return {p.name: value for p, value in zip(effect.parameters, values, strict=True)}


def test_every_effect_is_tried():
    assert set(CASES) == {effect.name for effect in library_of("swerve")}


@pytest.mark.parametrize("name", CASES)
def test_a_hidden_effect_shows_with_its_sign_and_size(name):
    values, scenario, soil, grade, feature, desired, can_be_corrected = CASES[name]
    effects = parameters(name, values)
    clean, run = driven(scenario, soil, grade), driven(scenario, soil, grade, tuple(effects.items()))
    desired = change_of(name, clean, run, values) if desired is None else desired
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
        simulate(ROBOT, drive, {"grass": load_soil("grass")}, 0, effects=effects, **options)
        for effects in (None, none)
    )
    assert one.streams.keys() == other.streams.keys()
    for name, stream in one.streams.items():
        assert stream.time_s.tobytes() == other.streams[name].time_s.tobytes()
        assert stream.values.tobytes() == other.streams[name].values.tobytes()


def test_only_the_other_logger_has_its_own_clock():
    effects = {"clock_offset_s": 0.2, "clock_rate_ratio": 0.01}
    drive, soils = make_scenario("straight", ROBOT, "tiles", 10.0), {"tiles": load_soil("tiles")}
    clean, run = (simulate(ROBOT, drive, soils, 0, gnss=Gnss(), effects=e) for e in ({}, effects))
    for name, stream in run.streams.items():
        plain = clean.streams[name].time_s
        late = 1.01 * plain + 0.2 if name in ("imu", "odometry", "gnss") else plain
        np.testing.assert_allclose(stream.time_s, late, atol=1e-12)
        np.testing.assert_array_equal(stream.values, clean.streams[name].values)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"effective_track_ratio": 0.5}, "does not apply to a robot with the drive 'swerve'"),
        ({"warp_ratio": 0.1}, "warp_ratio is no parameter"),
        ({"gyro_scale_ratio": math.nan}, "gyro_scale_ratio is nan"),
        ({"gyro_scale_ratio": 0.5}, "a number from -0.15 to 0.15"),
    ],
)
def test_an_effect_that_cannot_be_is_refused(effects, message):
    drive = make_scenario("straight", ROBOT, "tiles", 10.0)
    with pytest.raises(ConfigError, match=message):
        simulate(ROBOT, drive, {"tiles": load_soil("tiles")}, 0, effects=effects)
