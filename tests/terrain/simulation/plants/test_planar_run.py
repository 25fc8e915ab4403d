"""Runs of the planar plant: a replay is the run, truth and tilt, and noise of the stated density."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch
from studies.blind_trials.limits import noise_psd

from terrain.discrepancy.runs import signals_of
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.signals import low_passed
from terrain.simulation.plants.planar import Ground, make_planar, planar_ground, replay, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, make_scenario
from terrain.terramechanics.soil import load_soil

HUSKY, AGRIMARO, CAR = (load_robot(name) for name in ("husky", "agrimaro", "adap2e"))
ROBOTS = [HUSKY, AGRIMARO]
NAMES = ["husky", "agrimaro"]
HILLS = Conditions(grade_ratio=(0.04, -0.03), undulation_ratio=0.04)
NOISE, SCATTER = spread_numbers("noise"), spread_numbers("scatter")


def drive(robot):
    if robot is CAR:
        t = 0.02 * np.arange(1501)
        speed = 1.5 * np.sin(0.5 * t) ** 2
        return np.column_stack([speed, np.zeros_like(t), 0.3 * speed * np.sin(0.9 * t)])
    return make_scenario("complex", robot, "grass", 60.0, 0.6, seed=1).twist


def steady(speed_mps, length_s, turn_radps=0.0):
    twist = np.zeros((round(50 * length_s) + 1, 3))
    ramp = np.minimum(np.arange(len(twist)) / 50.0, 1.0)
    twist[:, 0], twist[:, 2] = speed_mps * ramp, turn_radps * ramp
    return twist


def quick(robot):
    """Return the robot with encoders and an IMU that tell at once."""
    return robot.with_parts(sensors=replace(robot.sensors, encoder_time_constant_s=0.0, imu_latency_s=0.0))


def replayed(run, robot, values, ground):
    """Return the channels (n, len(CHANNELS)) of a run, and what follows from its wheels, steering and tilt."""
    signals = signals_of(run, robot)
    given = signals.wheel_speed_mps, signals.steer_rad, signals.grade_rad, signals.roll_rad
    given = [np.array(each, order="C") for each in given]  # as in use, or the kernels are compiled anew
    return signals.measured, replay(make_planar(robot, ground), vector_of(values), signals.dt_s, *given)


OWN = {
    "skid_steer": [
        {"turn_side_slip_s": 0.15, "side_slip_build_up_s": 0.2, "turn_drag_s2": 0.9},
        {"yaw_delay_s": 0.04},
    ],
    "swerve": [{"wheel_scale_2_ratio": 0.05}],
    "bicycle": [
        {"understeer_s2pm": 0.04, "cornering_stiffness_ratio": -0.3, "steering_offset_front_rad": 0.03},
        {"steering_delay_s": 0.12, "encoder_lag_s": 0.1, "clock_offset_s": 0.1},
    ],
}
"""Effects that robots of one drive alone have."""

EFFECTS = [
    {},
    {"wheel_radius_ratio": 0.05, "force_slip_ratio": 0.3, "payload_ratio": 0.2},
    {"clock_offset_s": 0.07, "camera_latency_s": 0.05},
    {"clock_rate_ratio": 0.002, "encoder_lag_s": 0.12, "imu_latency_s": 0.16, "current_offset_a": 0.7},
    {
        "clock_offset_s": -0.26,
        "pitch_offset_rad": 0.03,
        "roll_offset_rad": -0.02,
        "side_hill_slip_ratio": 1.0,
    },
    {"gyro_scale_ratio": 0.1, "gyro_bias_radps": 0.02, "lever_y_m": 0.2, "camera_yaw_rad": 0.1},
    {"accel_bias_mps2": 0.1, "lever_x_m": 0.3, "camera_latency_s": 0.1},
]


@pytest.mark.parametrize(
    ("robot", "values"),
    [(robot, values) for robot in (*ROBOTS, CAR) for values in (*EFFECTS, *OWN[robot.drive])],
    ids=lambda each: getattr(each, "name", None) or "+".join(each) or "none",
)
def test_a_replay_with_the_same_effects_reproduces_the_log(robot, values):
    ground = Ground()
    run = simulate(robot, drive(robot), ground, 3, effects=values, heading=robot is HUSKY, conditions=HILLS)
    measured, expected = (each[50:-50] for each in replayed(run, robot, values, ground))
    for c, channel in enumerate(CHANNELS):
        known = np.isfinite(measured[:, c])
        off = (measured - expected)[known, c]
        share = 0.004 if channel in (CURRENT, TURNING_CURRENT, ACCEL) else 0.002
        if known.any():
            assert np.std(off) <= share * np.std(measured[known, c]), channel
            assert abs(off.mean()) < 0.01, channel


@pytest.mark.parametrize("robot", ROBOTS, ids=NAMES)
def test_true_slip_is_that_of_the_radii_that_the_wheels_have(robot):
    radii = {"wheel_radius_ratio": 0.05, "one_sided_radius_ratio": 0.04}
    free = Ground(slip_ratio=0.0, rolling_ratio=0.0)
    truth = simulate(robot, steady(0.6, 10.0), free, 0, effects=radii).streams["truth"]
    slips = np.array([truth.channel(f"slip_{wheel}_ratio")[-1] for wheel in robot.wheels])
    # wheels of a swerve robot that disagree cannot all roll; the nominal radius would tell -0.05 of all
    assert np.abs(slips).max() < (0.02 if robot is AGRIMARO else 1e-6)
    assert slips.mean() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("robot", ROBOTS, ids=NAMES)
def test_tilt_follows_the_heading(robot):
    even, undulating = (
        simulate(robot, twist, Ground(slip_ratio=0.0), 4, conditions=conditions).streams["truth"]
        for twist, conditions in (
            (steady(0.5, 40.0, 0.3), Conditions(grade_ratio=(0.1, 0.0))),
            (steady(0.8, 120.0), Conditions(undulation_ratio=0.05)),
        )
    )
    yaw = even.channel("yaw_rad")
    np.testing.assert_allclose(np.tan(even.channel("roll_rad")), -0.1 * np.sin(yaw), atol=1e-9)
    np.testing.assert_allclose(even.channel("pitch_rad"), -0.1 * np.cos(yaw), atol=1e-3)
    for tilt in map(undulating.channel, ("roll_rad", "pitch_rad")):
        assert tilt.min() < 0.0 < tilt.max()
        assert 0.01 < np.std(tilt) < 0.1


def density(values, rate_hz):
    return welch(values, rate_hz, nperseg=2048, detrend="linear")


def noisy_signals(robot, run):
    wheels, imu, channels = run.streams["wheels"], run.streams["imu"], signals_of(run, robot).measured
    swerve = robot.drive == "swerve"
    to_wheel_speed = robot.wheel_radius_m / robot.motors.reduction_ratio if swerve else 1.0
    names = [SPEED_X, SPEED_Y, CURRENT, HEADING, *([] if swerve else [TURNING_CURRENT])]
    of_imu = {GYRO: "gyro_z_radps", ACCEL: "accel_x_mps2", "roll_rad": "roll_rad", "grade_rad": "pitch_rad"}
    signals = {name: (channels[500:, CHANNELS.index(name)], 50.0) for name in names}
    signals |= {name: (imu.channel(channel)[1000:], 100.0) for name, channel in of_imu.items()}
    return signals | {"wheel_speed_mps": (wheels.values[500:, 0] * to_wheel_speed, 50.0)}


@pytest.mark.parametrize("robot", ROBOTS, ids=NAMES)
def test_noise_of_every_channel_has_the_stated_density(robot):
    speed, ground = 0.6, Ground()
    # coarse steps of an encoder beat with its samples at a steady speed, and are no noise
    fine = replace(robot.sensors, hall_steps_ratio=20 * robot.sensors.hall_steps_ratio)
    robot, twist = robot.with_parts(sensors=fine), steady(speed, 400.0)
    noisy, quiet = (
        noisy_signals(robot, simulate(robot, twist, ground, 7, noise=noise, heading=True))
        for noise in (NOISE, None)
    )
    for name, (values, rate_hz) in noisy.items():
        f, measured = density(values - quiet[name][0], rate_hz)
        expected = noise_psd(NOISE, robot, make_planar(robot, ground), name, f, speed)
        for low, high in ((0.1, 1.0), (1.0, 5.0), (5.0, 20.0)):
            band = (f > low) & (f < high)
            assert measured[band].sum() == pytest.approx(expected[band].sum(), rel=0.15), (name, low)


def test_encoders_lag_as_described_and_read_zero_at_rest():
    lag_s = AGRIMARO.sensors.encoder_time_constant_s
    twist = drive(AGRIMARO)
    slow, at_once = (
        simulate(robot, twist, Ground(), 0).streams["wheels"] for robot in (AGRIMARO, quick(AGRIMARO))
    )
    expected = low_passed(at_once.time_s, at_once.values[:, 0], lag_s, 0.1)
    np.testing.assert_allclose(slow.values[:, 0], expected, atol=0.02 * np.abs(expected).max())
    still = simulate(AGRIMARO, np.zeros((101, 3)), Ground(), 0, noise=NOISE, scatter=SCATTER)
    assert (still.streams["wheels"].values[:, :3] == 0).all()


@pytest.mark.parametrize("robot", ROBOTS, ids=NAMES)
def test_causes_of_no_effect_ripple_once_a_turn_and_spike_the_current_while_wheels_crawl(robot):
    def streams(speed, **outside):
        return simulate(robot, steady(speed, 60.0), Ground(), 1, outside=outside).streams

    run, plain = streams(0.5, wheel_eccentricity_ratio=0.05), streams(0.5)
    np.testing.assert_array_equal(run["wheels"].values[:, :2], plain["wheels"].values[:, :2])
    ripple = (run["truth"].channel("speed_x_mps") - plain["truth"].channel("speed_x_mps"))[500:]
    f, power = density(ripple, 100.0)
    assert f[power.argmax()] == pytest.approx(0.5 / (2 * math.pi * robot.wheel_radius_m), abs=0.06)
    assert 0.003 < np.std(ripple) < 0.03
    for speed, low, high in ((0.15, 0.1, 0.4), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0)):
        change = streams(speed, stick_slip_a=4.0)["wheels"].values - streams(speed)["wheels"].values
        assert low <= (change[100:, len(robot.wheels) :].sum(axis=1) > 3.9).mean() <= high


def test_on_a_soil_the_robot_slips_as_the_soil_has_it():
    ground = planar_ground(AGRIMARO, load_soil("grass"))
    truth = simulate(AGRIMARO, steady(0.6, 20.0), ground, 0).streams["truth"]
    assert truth.channel("slip_1_ratio")[-1] == pytest.approx(0.1255, abs=0.001)  # Danzi, 7.2.3
    with pytest.raises(ConfigError, match="gets stuck on terrain 'clay'"):
        planar_ground(replace(HUSKY, mass_kg=2000.0), load_soil("clay"))


@pytest.mark.parametrize(
    ("robot", "options", "message"),
    [
        (AGRIMARO.without("camera"), {}, "no section 'camera'"),
        (AGRIMARO.without("steering"), {}, "no section 'steering'"),
        (HUSKY, {"drive": np.zeros((5, 2))}, r"twist has shape \(5, 2\)"),
        (HUSKY, {"drive": np.full((5, 3), np.nan)}, "finite numbers"),
        (HUSKY, {"drive": np.ones((5, 3))}, "sideways, which needs steered wheels"),
        (HUSKY, {"effects": {"magic_ratio": 1.0}}, "magic_ratio is 1.0"),
        (HUSKY, {"outside": {"stick_slip_a": math.inf}}, "stick_slip_a is inf"),
    ],
)
def test_impossible_inputs_are_refused_in_one_sentence(robot, options, message):
    with pytest.raises(ConfigError, match=message) as error:
        simulate(robot, **{"drive": np.zeros((5, 3)), "ground": Ground(), "seed": 0} | options)
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="noise of channel 'x'"):
        noise_psd(NOISE, HUSKY, make_planar(HUSKY, Ground()), "x", np.ones(1), 0.5)
