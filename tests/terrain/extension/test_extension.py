"""Extended robots: a correction takes off a robot and a log just what its effects put on."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import terrain
from terrain.effects import Stage, in_plant, on_samples, parameters_of
from terrain.errors import ConfigError
from terrain.estimation.estimate import enriched, estimate_run, model_of, summarize
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.extension import (
    Correction,
    apply_homes,
    check_corrected,
    correct,
    correct_live,
    corrected,
    corrected_log,
)
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.replay import replay
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import planar_ground
from terrain.simulation.run import simulate
from terrain.simulation.scenario import make_scenario
from terrain.terramechanics.soil import load_soil

ROBOT, HUSKY, OMNI = load_robot("agrimaro"), load_robot("husky"), load_robot("robotino")
BARE = HUSKY.without("body", "motors", "camera", "sensors")
EVERY = {name: 0.6 * p.high * 0.1 for name, p in parameters_of("swerve").items()}


def extended(**effects):
    return replace(ROBOT, effects=effects)


@cache
def run_of(scenario="complex", length_s=30.0, effects=()):
    """Return a run of some effects, as pairs."""
    drive = make_scenario(scenario, ROBOT, "grass", length_s)
    return simulate(ROBOT, drive, {"grass": load_soil("grass")}, 4, effects=dict(effects))


def test_no_effects_change_nothing_and_corrections_are_applied_once():
    run = run_of(effects=tuple(EVERY.items()))
    assert corrected(ROBOT) is ROBOT
    assert corrected_log(run, ROBOT) is run
    once = corrected_log(run, extended(**EVERY))
    zero = corrected_log(run, replace(ROBOT, effects=dict.fromkeys(EVERY, 0.0)))
    twice = corrected_log(once, corrected(extended(**EVERY)))
    for back, before, atol in ((zero, run, 1e-12), (twice, once, 0.0)):
        for name, stream in back.streams.items():
            np.testing.assert_array_equal(stream.time_s, before.streams[name].time_s)
            np.testing.assert_allclose(stream.values, before.streams[name].values, rtol=0, atol=atol)


def test_corrections_change_the_parameter_of_each_effect():
    e, robot = EVERY, corrected(extended(**EVERY))
    numbers = {
        robot.wheel_radius_m: 0.2 * (1 + e["wheel_radius_ratio"]),
        robot.mass_kg: 90.0 * (1 + e["payload_ratio"]),
        robot.body.yaw_inertia_kgm2: 20.0 * (1 + e["payload_ratio"]),
        robot.motors.torque_constant_nmpa: 0.25 / (1 + e["motor_constant_ratio"]),
        robot.steering.zero_1_rad: -e["steering_offset_1_rad"],
        robot.steering.zero_3_rad: -e["steering_offset_3_rad"],
        robot.sensors.gyro_bias_z_radps: e["gyro_bias_radps"],
        robot.sensors.accel_bias_x_mps2: e["accel_bias_mps2"],
        robot.encoder_lag_s: 0.05 + e["encoder_lag_s"],
        robot.sensors.imu_latency_s: 0.005 + e["imu_latency_s"],
        robot.camera.latency_s: 0.006 + e["camera_latency_s"],
        robot.camera.lever_x_m: 0.6685 + e["lever_x_m"],
        robot.camera.lever_y_m: -0.26875 + e["lever_y_m"],
    }
    assert list(numbers) == pytest.approx(list(numbers.values()))
    left = "force_slip shear_slip slip_resistance rolling_resistance viscous_drag side_hill_slip"
    assert {name.rpartition("_")[0] for name in robot.effects} == set(left.split())
    assert corrected(robot) is robot
    skid = corrected(replace(HUSKY, effects={"effective_track_ratio": 0.8, "turning_slip_ratio": 0.1}))
    assert skid.track_m == pytest.approx(1.8 * HUSKY.track_m)
    assert dict(skid.effects) == {"turning_slip_ratio": 0.1}
    assert corrected(replace(BARE, effects={"encoder_lag_s": 0.1})).encoder_lag_s == 0.1
    root = np.array([[2e-3, 0.0, 0.0], [1e-3, 5e-4, 0.0], [0.01, -0.02, 0.03]])
    three = {"wheel_radius_ratio": 0.03, "camera_yaw_rad": -0.012, "force_slip_ratio": 0.3}
    robot = replace(ROBOT, effects=three, effects_cov=root @ root.T)  # the covariance is that of what stays
    np.testing.assert_array_equal(apply_homes(robot).effects_cov, robot.effects_cov[1:, 1:])
    np.testing.assert_array_equal(corrected(robot).effects_cov, robot.effects_cov[2:, 2:])


def every_stream():
    """Streams of all drives with all channels that a correction looks at, none of them constant."""
    time_s = np.linspace(1.0, 31.0, 301)
    wave = 0.4 * np.sin(time_s)
    wheels = ("1", "2", "3", "left", "right")
    channels = {
        "wheels": [f"{kind}_a" for kind in ("current_1", "current_left")]
        + [f"speed_{wheel}_mps" for wheel in wheels],
        "truth": [f"wheel_{wheel}_radps" for wheel in wheels],
        "steering": [f"angle_{i}_rad" for i in (1, 2, 3)],
        "imu": ["gyro_z_radps", "accel_x_mps2", "yaw_rad"],
        **{name: ["speed_x_mps", "speed_y_mps"] for name in ("odometry", "lidar", "gnss")},
        "pose": ["position_x_m", "position_y_m", "yaw_rad"],
        "commands": ["speed_x_mps", "wheel_1_radps"],
    }
    return {
        name: Stream(time_s, np.column_stack([(k + 1) * wave for k in range(len(of))]), tuple(of))
        for name, of in channels.items()
    }


def test_a_correction_changes_the_streams_that_the_catalogue_names_and_no_others():
    """What has a home is taken off samples only as far as the catalogue says."""
    streams = every_stream()
    for robot in (ROBOT, HUSKY, ROBOT.without("sensors", "motors"), BARE, OMNI):
        for name, p in parameters_of(robot.drive).items():
            run = RunLog("a", robot.name, streams)
            back = corrected_log(run, replace(robot, effects={name: 0.1 * p.high})).streams
            changed = {
                stream
                for stream, before in streams.items()
                if not np.array_equal(before.time_s, back[stream].time_s)
                or not np.array_equal(before.values, back[stream].values)
            }
            named = set(p.inverse.streams) if p.inverse else set()
            applied = all(not home.section or robot.describes(home.section) for home in p.homes)
            if p.inverse and p.inverse.without_home and applied:
                named = set()
            assert changed == named, (robot.name, name)


def test_what_an_effect_does_to_samples_of_a_sensor_its_correction_takes_off_them():
    """All entries at once, on pure numbers; stamps come back as well."""
    effects = {
        n: 0.4 * parameters_of("swerve")[n].high for n in in_plant(Stage.SENSORS) if not n.startswith("gyro")
    }
    correction = Correction(extended(**effects), 0.0)
    streams = every_stream() | {"odometry": Stream(np.arange(3.0), np.eye(3, 14), CAMERA_CHANNELS)}
    for name, stream in streams.items():
        time_s = stream.time_s - stream.time_s[0]
        stamps, values = on_samples(name, stream.channels, effects)(time_s, stream.values.copy())
        back_s, back = correction(name, stream.channels, stamps, values)
        np.testing.assert_allclose(back_s, time_s, atol=1e-12)
        if name not in ("pose", "wheels"):
            np.testing.assert_allclose(back, stream.values, atol=1e-12, err_msg=name)
    # no stream of the wheels' logger is stamped otherwise
    channels, values = ("motor_1_radps", "motor_2_radps", "current_1_a"), np.arange(9.0).reshape(3, 3)
    seen = on_samples("wheels", channels, effects)(np.arange(3.0), values.copy())[1]
    assert not np.isclose(seen[1:], values[1:]).any()
    np.testing.assert_allclose(correction("wheels", channels, np.arange(3.0), seen)[1], values, atol=1e-12)
    robot, turn = extended(gyro_scale_ratio=-0.1, gyro_bias_radps=0.02), np.linspace(-1.0, 1.0, 9)
    measured = (0.9 * turn + 0.02)[:, None]  # the scale of a gyro acts on the turn and not on its bias
    _, back = Correction(robot, 0.0)("imu", ("gyro_z_radps",), np.arange(9.0), measured)
    np.testing.assert_allclose(back[:, 0] - corrected(robot).sensors.gyro_bias_z_radps, turn, atol=1e-12)


def test_a_pose_of_a_camera_whose_scale_and_angle_are_off_comes_back():
    effects = {"camera_scale_ratio": -0.08, "camera_yaw_rad": 0.05}
    drive = make_scenario("crab", OMNI, "tiles", 20.0)
    ground = planar_ground(OMNI, load_soil("tiles"))
    clean, run = (simulate(OMNI, drive.twist, ground, 0, effects=e) for e in ({}, effects))
    back = corrected_log(run, replace(OMNI, effects=effects)).streams["pose"]
    assert np.abs(run.streams["pose"].values - clean.streams["pose"].values).max() > 0.04
    np.testing.assert_allclose(back.values, clean.streams["pose"].values, atol=1e-9)


def test_block_by_block_is_the_whole_run_and_what_is_no_number_stays_so():
    effects = EVERY | {"steering_backlash_rad": 0.05}
    run, robot = run_of(effects=tuple(EVERY.items())), extended(**effects)
    streams = {}
    for name, stream in run.streams.items():
        values = np.array(stream.values)
        values[100], values[200] = np.nan, np.inf
        streams[name] = Stream(stream.time_s, values, stream.channels)
    plain, whole = corrected_log(run, robot), corrected_log(replace(run, streams=streams), robot)
    correction = Correction(robot, float(run.streams["wheels"].time_s[0]))
    for name, stream in streams.items():
        size, channels = 7 if name == "imu" else 1, stream.channels
        blocks = [slice(at, at + size) for at in range(0, min(len(stream), 700), size)]
        parts = [correction(name, channels, stream.time_s[each], stream.values[each]) for each in blocks]
        times, values = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        np.testing.assert_array_equal(times, whole.streams[name].time_s[: len(times)])
        np.testing.assert_allclose(values, whole.streams[name].values[: len(times)], atol=1e-12)
        if name in ("wheels", "steering", "imu"):
            assert not np.isfinite(values[[100, 200]]).any()
            rest = np.setdiff1d(np.arange(len(values)), [100, 200])
            np.testing.assert_allclose(values[rest], plain.streams[name].values[rest], atol=0.02)


def test_a_skid_steer_robot_without_sections_is_corrected_in_its_samples():
    time_s = np.arange(0.0, 20.0, 0.02)
    left, right = 0.8 + 0.2 * np.sin(time_s), 0.8 - 0.2 * np.sin(0.7 * time_s)
    turn = (right - left) / BARE.track_m
    channels = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
    effects = {"wheel_radius_ratio": 0.1, "one_sided_radius_ratio": 0.06, "gyro_bias_radps": 0.02}
    effects |= {"gyro_scale_ratio": 0.05, "motor_constant_ratio": 0.2, "current_offset_a": 0.4}
    effects |= {"clock_offset_s": 0.1, "imu_latency_s": 0.2, "yaw_delay_s": 0.1}
    measured = [left / 1.1 / 0.97, right / 1.1 / 1.03, np.full(time_s.size, 1.6), np.full(time_s.size, 2.8)]
    gyro = 1.05 * turn + 0.02
    streams = {
        "wheels": Stream(time_s, np.column_stack(measured), channels),
        "imu": Stream(time_s + 0.3, gyro[:, None], ("gyro_z_radps",)),
    }
    robot = replace(BARE, effects=effects)
    back, live = corrected_log(RunLog("a", "husky", streams), robot), Correction(robot, 0.0)
    blocks = [slice(at, at + 3) for at in range(0, 600, 3)]
    values = streams["wheels"].values
    parts = [live("wheels", channels, time_s[each], values[each])[1] for each in blocks]
    np.testing.assert_allclose(np.concatenate(parts), back.streams["wheels"].values[:600], atol=1e-12)
    np.testing.assert_allclose(back.streams["imu"].time_s, time_s, atol=1e-12)
    np.testing.assert_allclose(back.streams["imu"].values[:, 0], turn, atol=1e-12)
    wheels = back.streams["wheels"].values
    np.testing.assert_allclose(wheels[:, 2:], np.broadcast_to([1.0, 2.0], (time_s.size, 2)))
    np.testing.assert_allclose(wheels[:, 0] + wheels[:, 1], left + right, atol=1e-12)
    late = np.interp(time_s - 0.1, time_s, right - left)
    np.testing.assert_allclose(wheels[:, 1] - wheels[:, 0], late, atol=1e-12)


#: Where a run as measured meets the robot as described.
EDGES = {
    *(f"terrain/estimation/{name}.py" for name in ("estimate", "tuning")),
    *(f"pipelines/live/{name}.py" for name in ("windows", "classifying", "observer", "pilot")),
    "terrain/slip_learning/learn.py",
}


def test_corrections_are_applied_at_the_edge_and_filters_refuse_what_is_not_corrected():
    root, found = Path(terrain.__file__).parent.parent, set()
    called = re.compile(r"(?<![\w.])(?<!def )(correct|correct_live|corrected|corrected_log)\(")
    for path in (
        path for room in ("terrain", "pipelines", "features") for path in (root / room).rglob("*.py")
    ):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines() if "terrain.extension import" in text else []
        if path.name != "extension.py" and any(called.search(line) for line in lines if ">>>" not in line):
            found.add(path.relative_to(root).as_posix())
    assert found == EDGES
    robot, run = extended(camera_yaw_rad=0.1), run_of("straight", 5.0)
    for refused in (
        lambda: model_of(run, robot, "vio15"),
        lambda: make_live_filter("vio15", robot, CHANNELS),
    ):
        with pytest.raises(ConfigError, match="camera_yaw_rad is not corrected"):
            refused()
    check_corrected(extended(force_slip_ratio=0.1))  # which filters do not model
    once = correct(run, robot)
    assert correct(*once) == once
    assert correct_live(once[1]) == (once[1], None)


def live_estimator(robot, channels):
    believed, correction = correct_live(robot)
    return make_live_filter("vio15", believed, channels, correction)


def test_live_is_live_on_the_corrected_log():
    effects = {name: EVERY[name] for name in EVERY if not name.startswith("clock")}
    run, robot = run_of("straight", 12.0, tuple(effects.items())), extended(**effects)
    channels = {name: run.streams[name].channels for name in ("wheels", "steering", "imu", "odometry")}
    raw, plain = live_estimator(robot, channels), make_live_filter("vio15", corrected(robot), channels)
    unshifted = replace(robot, effects={n: v for n, v in effects.items() if n != "steering_delay_s"})
    raw_now = live_estimator(unshifted, channels)
    now, desired = [], []
    log = corrected_log(run, unshifted)
    for one, other in zip(replay(run, 50.0), replay(log, 50.0), strict=True):
        now += raw_now.step(one.readings)
        desired += plain.step(other.readings)
        assert all(np.isfinite(estimate.mean).all() for estimate in raw.step(one.readings))
    for name in ("mean", "slip_ratio"):
        np.testing.assert_allclose(*[[getattr(e, name) for e in each] for each in (now, desired)], atol=1e-9)


# effects, and how much worse speed and slip are for them: the errors without them are 0.0028 m/s and 0.012
MOUNTED = {"wheel_radius_ratio": 0.04, "camera_yaw_rad": 0.05, "gyro_scale_ratio": 0.08, "lever_x_m": 0.1}
CLOCKS = {"clock_offset_s": 0.1, "clock_rate_ratio": 0.001, "steering_offset_1_rad": 0.05}
BIASES = {"one_sided_radius_ratio": 0.06, "gyro_bias_radps": 0.03, "accel_bias_mps2": 0.5}
WORTH = [(MOUNTED, 8.0, 2.5), (CLOCKS, 8.0, 1.3), (BIASES, 0.0, 2.0)]


def errors(found):
    """Root mean square errors of speed (m/s) and of steady slip, against the truth of wheels and ground."""
    truth, track = found.run.streams["truth"], found.track
    true = [np.interp(track.time_s, truth.time_s, truth.channel(f"slip_{i}_ratio")) for i in (1, 2, 3)]
    error = (found.slip.mean - np.column_stack(true))[found.figures.steady]
    return np.array([summarize(found).speed_rmse_mps, np.sqrt(np.nanmean(error**2))])


@pytest.mark.parametrize("case", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2))])
def test_the_filter_of_an_extended_robot_is_as_good_as_without_effects(case):
    effects, *gains = WORTH[case]
    run, clean = run_of(length_s=60.0, effects=tuple(effects.items())), run_of(length_s=60.0)
    before, found = (estimate_run(run, robot, "vio15") for robot in (ROBOT, extended(**effects)))
    assert (errors(found) < [1.5, 1.2] * errors(estimate_run(clean, ROBOT, "vio15"))).all()
    assert (errors(before) >= gains * errors(found)).all()
    assert summarize(found).nees < 2.0
    assert found.run is run
    if "wheel_radius_ratio" in effects:  # the written run holds the measurements and the true wheel speeds
        written = enriched(found)
        assert written.streams["imu"] is run.streams["imu"]
        rates = written.streams["wheels"].channel("motor_1_radps") / ROBOT.motors.reduction_ratio
        speeds = written.streams["wheels"].channel("speed_1_mps")
        np.testing.assert_allclose(speeds, rates * ROBOT.wheel_radius_m * 1.04)
