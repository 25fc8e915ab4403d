"""From streams to one clock, and behind one low-pass: what a run measures comes through, the rest stays unknown."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from terrain.discrepancy.evidence import evidence_at
from terrain.discrepancy.runs import (
    PARALLEL,
    SETTLE_S,
    Signals,
    Simulation,
    comparable,
    decimate,
    low_pass_of,
    measured_channels,
    prepare_inputs,
    rows_of,
    signals_of,
)
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    INDEX,
    ONE_SIDED,
    SPEED_X,
    SPEED_Y,
    STEPS,
    TURNING_CURRENT,
    vector_of,
)
from terrain.errors import DataError
from terrain.logs.schema import POSE_CHANNELS
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, replay, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
ROBOTS = {"husky": HUSKY, "agrimaro": AGRIMARO}
HIDDEN = {
    "husky": {"payload_ratio": 0.2, "effective_track_ratio": 0.3, "camera_latency_s": 0.06, "clock_offset_s": 0.1},
    "agrimaro": {"payload_ratio": 0.2, "steering_offset_2_rad": 0.05, "encoder_lag_s": 0.05, "lever_x_m": 0.1},
}  # fmt: skip
NOISE = np.array([0.01, 0.005, 0.005, 0.1, 1.0, 1.0, 0.02])
"""About what sensors of these robots show of nothing."""


# -- From streams to signals on one clock ------------------------------------------------------------------


def drive(robot, effects=None, heading=False):
    """Return a run without noise; one with steered wheels never stops, where they would turn in no time."""
    t = np.arange(1501) / 50
    start = np.minimum(t, 1.0)
    speed = 0.5 * np.sin(0.8 * t) + 0.2 * np.sin(1.9 * t) + 0.7 * start * (robot is AGRIMARO)
    twist = np.column_stack([speed, np.zeros_like(t), 0.3 * np.sin(1.1 * t)]) * start[:, None]
    hills = Conditions(grade_ratio=(0.05, 0.02), undulation_ratio=0.02)
    about = {"terrain": "grass", "heading": heading, "conditions": hills}
    return simulate(robot, twist, Ground(), 1, effects=effects, **about)


@pytest.fixture(scope="module")
def husky():
    return drive(HUSKY, heading=True)


@pytest.fixture(scope="module")
def agrimaro():
    return drive(AGRIMARO)


def channel(signals, name):
    return signals.measured[:, CHANNELS.index(name)]


def with_stream(run, name, stream):
    streams = {key: value for key, value in run.streams.items() if key != name}
    return replace(run, streams=streams if stream is None else {**streams, name: stream})


def kept(stream, rows):
    return Stream(stream.time_s[rows], stream.values[rows], stream.channels)


def test_streams_of_a_skid_steer_robot_are_resampled_to_one_clock(husky):
    signals = signals_of(husky, HUSKY)
    wheels, imu, seen = (husky.streams[name] for name in ("wheels", "imu", "odometry"))
    assert (signals.run_id, signals.terrain, signals.dt_s, len(signals)) == ("run", "grass", 0.02, 1501)
    assert_allclose(signals.time_s, wheels.time_s)
    assert_array_equal(signals.wheel_speed_mps, wheels.values[:, :2])
    assert not signals.steer_rad.any()
    left, right = wheels.values[:, 2:].T
    for shown, logged in (
        (signals.grade_rad, -imu.channel("pitch_rad")[::2]),
        (signals.roll_rad, imu.channel("roll_rad")[::2]),
        (channel(signals, GYRO), imu.channel("gyro_z_radps")[::2]),
        (channel(signals, ACCEL), imu.channel("accel_x_mps2")[::2]),
        (channel(signals, SPEED_X), seen.values[:, 0]),
        (channel(signals, SPEED_Y), seen.values[:, 1]),
        (channel(signals, HEADING), husky.streams["lidar"].values[:, 0]),
        (channel(signals, CURRENT), left + right),
        (channel(signals, TURNING_CURRENT), right - left),
    ):
        assert_allclose(shown, logged, atol=1e-12)


def test_a_tracking_camera_measures_the_speed_of_its_own_point_in_body_axes(agrimaro):
    signals, truth, camera = signals_of(agrimaro, AGRIMARO), agrimaro.streams["truth"], AGRIMARO.camera
    late_s = signals.time_s - camera.latency_s - camera.time_constant_s
    x, y, turn = (
        np.interp(late_s, truth.time_s, truth.channel(name))
        for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    )
    # straight lines between samples of the truth
    assert_allclose(channel(signals, SPEED_X), x - camera.lever_y_m * turn, atol=2e-3)
    assert_allclose(channel(signals, SPEED_Y), y + camera.lever_x_m * turn, atol=2e-3)
    assert np.isnan(channel(signals, HEADING)).all()


def test_steering_zeros_and_turns_are_subtracted_and_motor_rates_become_wheel_speeds(agrimaro):
    signals, truth = signals_of(agrimaro, AGRIMARO), agrimaro.streams["truth"]
    wheels, steering = agrimaro.streams["wheels"], agrimaro.streams["steering"]
    expected = np.column_stack([truth.channel(f"steer_{i}_rad")[::2] for i in (1, 2, 3)])
    per_motor = AGRIMARO.wheel_radius_m / AGRIMARO.motors.reduction_ratio
    turned = replace(steering, values=np.angle(np.exp(1j * (steering.values + 2 * np.pi))))
    for run in (agrimaro, with_stream(agrimaro, "steering", turned)):
        assert_allclose(signals_of(run, AGRIMARO).steer_rad, expected, atol=1e-9)
    assert_allclose(signals.wheel_speed_mps, wheels.values[:, :3] * per_motor)
    parallel = (
        np.abs(np.exp(1j * signals.steer_rad).mean(axis=1)) > PARALLEL
    )  # else no sum of currents counts
    assert 0.1 < parallel.mean() < 0.9
    assert_array_equal(np.isfinite(channel(signals, CURRENT)), parallel)
    assert np.isnan(channel(signals, TURNING_CURRENT)).all()


def test_current_magnitudes_get_the_sign_of_their_wheel_and_signed_ones_stay():
    # on the spot: the sides turn against each other, and both motors drive
    t = np.arange(1001) / 50
    twist = np.column_stack([np.zeros_like(t), np.zeros_like(t), 0.8 * np.minimum(t, 1.0)])
    run = simulate(HUSKY, twist, Ground(), 1, terrain="grass")
    wheels = run.streams["wheels"]
    values = np.array(wheels.values)
    at = [wheels.channels.index(f"current_{side}_a") for side in ("left", "right")]
    values[:, at] = np.abs(values[:, at])
    sizes = with_stream(run, "wheels", Stream(wheels.time_s, values, wheels.channels))
    signed, restored = signals_of(run, HUSKY), signals_of(sizes, HUSKY)
    steady = signed.time_s > 2.0
    assert_allclose(channel(restored, TURNING_CURRENT)[steady], channel(signed, TURNING_CURRENT)[steady])
    assert channel(restored, TURNING_CURRENT)[steady].mean() > 1.0
    braked = np.array(values)
    braked[500, at[0]] = -0.1  # one sample below zero: the motor driver logs signs
    logged = signals_of(with_stream(run, "wheels", Stream(wheels.time_s, braked, wheels.channels)), HUSKY)
    assert abs(channel(logged, TURNING_CURRENT)[steady].mean()) < 0.1


def test_long_holes_stay_holes_and_short_ones_are_bridged(husky):
    seen, wheels, imu = (husky.streams[name] for name in ("odometry", "wheels", "imu"))
    lost = (seen.time_s > 5.0) & (seen.time_s < 7.0)
    short = (seen.time_s > 9.995) & (seen.time_s < 10.025)
    blank = wheels.values.copy()
    blank[(wheels.time_s > 12.0) & (wheels.time_s < 13.0), 0] = np.nan
    run = with_stream(husky, "odometry", kept(seen, ~lost & ~short))
    run = with_stream(run, "wheels", replace(wheels, values=blank))
    signals = signals_of(
        with_stream(run, "imu", replace(imu, values=np.full_like(imu.values, np.nan))), HUSKY
    )
    time_s, known = signals.time_s, np.isfinite(channel(signals, SPEED_X))
    assert_array_equal(known, ~((time_s > 5.0 + 1e-9) & (time_s < 7.0 - 1e-9)))
    assert_allclose(channel(signals, SPEED_X)[known], seen.values[known, 0], atol=1e-3)
    silent = (time_s > 12.0) & (time_s < 13.0 - 1e-9)
    assert_array_equal(np.isfinite(signals.wheel_speed_mps), np.column_stack([~silent, silent | True]))
    assert np.isnan(channel(signals, GYRO)).all()


def test_what_is_slow_late_or_not_there_sets_the_clock_and_what_is_known(husky):
    slow, imu = kept(husky.streams["wheels"], slice(None, None, 5)), husky.streams["imu"]
    late = kept(imu, slice(300, 1500))
    signals = signals_of(with_stream(with_stream(husky, "wheels", slow), "imu", late), HUSKY)
    assert (signals.dt_s, signals.start_s, len(signals)) == pytest.approx((0.1, 3.0, 120))
    gyro = Stream(imu.time_s, imu.values[:, 2:4], imu.channels[2:4])
    labels = Label(0.0, 9.0, "grass"), Label(9.0, 20.0, "gravel")
    signals = signals_of(replace(with_stream(husky, "imu", gyro), labels=labels), HUSKY)
    assert signals.terrain == ""
    assert np.isnan(channel(signals, ACCEL)).all()
    assert np.isfinite(channel(signals, GYRO)).all()
    assert not signals.grade_rad.any()


def test_a_run_that_cannot_be_compared_is_refused_in_one_sentence(husky, agrimaro):
    wheels, imu = husky.streams["wheels"], husky.streams["imu"]
    short = replace(husky, streams={name: kept(s, s.time_s < 3.0) for name, s in husky.streams.items()})
    apart = with_stream(husky, "imu", replace(imu, time_s=imu.time_s + 30.0))
    side, speeds = (Stream(wheels.time_s, wheels.values[:, :n], wheels.channels[:n]) for n in (1, 2))
    for run, robot, message in (
        (husky, AGRIMARO, "is of the robot 'husky', the simulation is of 'agrimaro'"),
        (with_stream(husky, "wheels", None), HUSKY, "no stream 'wheels'"),
        (with_stream(agrimaro, "steering", None), AGRIMARO, "no stream 'steering'"),
        (with_stream(husky, "wheels", side), HUSKY, "a speed of each of left, right is required"),
        (short, HUSKY, "have 3.0 s in common, at least 4 s"),
        (apart, HUSKY, "have 0.0 s in common"),
        (replace(husky, streams={"wheels": speeds}), HUSKY, "none of its channels is simulated"),
    ):
        with pytest.raises(DataError) as error:
            signals_of(run, robot)
        assert message in str(error.value)
        assert "\n" not in str(error.value)


# -- From signals to rows behind one low-pass --------------------------------------------------------------


@pytest.fixture(scope="module", params=ROBOTS)
def looked_at(request):
    """Robot, its simulation, and the signals of a noise-free drive with effects hidden."""
    robot = ROBOTS[request.param]
    effects = HIDDEN[request.param]
    return Simulation(robot), effects, signals_of(drive(robot, effects, robot is HUSKY), robot)


def test_the_right_effects_leave_a_small_residual_and_none_a_large_one(looked_at):
    simulation, effects, signals = looked_at
    low_pass = low_pass_of([signals])
    right, wrong = (
        rows_of(signals, simulation.planar_on(""), vector_of(values), (), low_pass)
        for values in (effects, {})
    )
    there = np.isfinite(right.residual).any(axis=0)
    left, much = (np.sqrt(np.nanmean((r.residual / NOISE)[:, there] ** 2, axis=0)) for r in (right, wrong))
    assert left.max() < 0.15
    assert much.max() > 3.0
    assert measured_channels([right]) == tuple(np.array(CHANNELS)[there])


def test_sensitivities_are_differences_of_full_replays(looked_at):
    """Two routes: effects of sensors alone reuse the motion, and here all is replayed."""
    simulation, effects, signals = looked_at
    low_pass, point = low_pass_of([signals])._replace(instrument_cutoff_hz=np.inf), vector_of(effects)
    names = [p.name for effect in simulation.library for p in effect.parameters][::2]
    names += ["pitch_offset_rad", "roll_offset_rad"]
    rows = rows_of(signals, simulation.planar_on(""), point, names, low_pass)
    for name, change in zip(names, rows.sensitivity, strict=True):
        step = STEPS[name]
        ahead, back = point.copy(), point.copy()
        ahead[INDEX[name]] += step
        if name not in ONE_SIDED:
            back[INDEX[name]] -= step
        far, near = (
            rows_of(signals, simulation.planar_on(""), p, (), low_pass).predicted for p in (ahead, back)
        )
        expected = (far - near) / (ahead - back)[INDEX[name]] * np.isfinite(signals.measured).any(axis=0)
        assert_allclose(change, expected, atol=1e-9 * np.nanmax(np.abs(expected)) + 1e-12, err_msg=name)


def test_measured_and_predicted_pass_the_same_window(looked_at):
    """A prediction that is fed back as what was measured leaves nothing, holes or none."""
    simulation, effects, signals = looked_at
    low_pass = low_pass_of([signals])
    dt, wheel_speed, steer, grade, roll, _ = prepare_inputs(signals, low_pass)
    shown = replay(simulation.planar_on(""), vector_of(effects), dt, wheel_speed, steer, grade, roll)
    own = low_pass._replace(inputs_every=0)
    fed = {"wheel_speed_mps": wheel_speed, "steer_rad": steer, "grade_rad": grade, "roll_rad": roll}
    same = replace(signals, dt_s=dt, measured=shown, **fed)
    rows = rows_of(same, simulation.planar_on(""), vector_of(effects), (), own)
    assert_array_equal(rows.measured, rows.predicted)
    holes = shown.copy()
    holes[300:320] = holes[500:503] = np.nan
    rows = rows_of(replace(same, measured=holes), simulation.planar_on(""), vector_of(effects), (), own)
    known = np.isfinite(rows.residual)
    assert 0.8 < known.mean() < 1.0
    assert_allclose(rows.residual[known], 0.0, atol=1e-12)


def test_decimation_is_a_convolution_and_holes_are_left_out():
    rng = np.random.default_rng(0)
    values, taps = rng.standard_normal((200, 2)), np.hamming(21) / np.hamming(21).sum()
    expected = np.column_stack([np.convolve(column, taps, mode="valid")[::4] for column in values.T])
    assert_allclose(decimate(values, np.ones((200, 0), dtype=bool), taps, 4), expected)
    assert_allclose(decimate(values, np.ones((200, 2), dtype=bool), taps, 4), expected)
    known = np.ones((200, 2), dtype=bool)
    known[50:52, 0] = False
    known[100:140, 1] = False
    decimated = decimate(np.where(known, values, np.nan), known, taps, 4)
    for row in range(len(decimated)):
        window = slice(4 * row, 4 * row + 21)
        for c in range(2):
            weight = taps * known[window, c]
            if weight.sum() >= 0.75:
                mean = np.sum(weight * np.nan_to_num(values[window, c])) / weight.sum()
                assert decimated[row, c] == pytest.approx(mean)
            else:
                assert np.isnan(decimated[row, c])
    assert np.isnan(decimated).sum(axis=0).tolist() == [0, 12]


def test_a_hole_stays_unknown_and_nothing_else_is_lost(looked_at):
    simulation, effects, signals = looked_at
    measured, wheel_speed, time_s = signals.measured.copy(), signals.wheel_speed_mps.copy(), signals.time_s
    c, point, low_pass = CHANNELS.index(SPEED_X), vector_of(effects), low_pass_of([signals])
    measured[(time_s > 8.0) & (time_s < 11.0), c] = np.nan
    wheel_speed[(time_s > 15.0) & (time_s < 16.0)] = np.nan
    holes = replace(signals, measured=measured, wheel_speed_mps=wheel_speed)
    rows, before = (
        rows_of(run, simulation.planar_on(""), point, ["payload_ratio"], low_pass) for run in (holes, signals)
    )
    assert np.isnan(rows.measured[(rows.time_s > 8.3) & (rows.time_s < 10.7), c]).all()
    assert np.isnan(rows.measured[(rows.time_s > 15.3) & (rows.time_s < 15.7)]).all()
    assert np.isfinite(rows.predicted[:, c]).all()
    assert np.isfinite(rows.sensitivity).all()
    away = (np.abs(rows.time_s - 9.5) > 2.5) & (np.abs(rows.time_s - 15.5) > 1.5)
    assert_allclose(rows.residual[away, c], before.residual[away, c], atol=2e-3)


def test_runs_that_cannot_be_compared_are_excluded_each_with_its_reason(husky):
    slow = with_stream(husky, "wheels", kept(husky.streams["wheels"], slice(None, None, 5)))
    short = {name: kept(each, each.time_s < 3.0) for name, each in husky.streams.items()}
    runs = [
        replace(husky, run_id="a"),
        replace(husky, run_id="b", streams=short),
        replace(slow, run_id="c"),
        replace(husky, run_id="d"),
    ]
    signals, excluded = comparable(runs, HUSKY)
    assert [run.run_id for run in signals] == ["a", "d"]
    assert [run.run_id for run in excluded] == ["b", "c"]
    assert excluded[0].reason.startswith("its streams have")
    assert excluded[1].reason == "it is on a clock of 10 Hz, most runs are on one of 50 Hz"
    with pytest.raises(DataError, match="run b: its streams have"):
        comparable(runs[1:2], HUSKY)
    assert comparable([], HUSKY) == ((), ())


def test_currents_are_compared_only_where_motors_are_described(husky):
    robot = HUSKY.without("motors")
    for name in (CURRENT, TURNING_CURRENT):
        assert np.isfinite(channel(signals_of(husky, HUSKY), name)).all()
        assert np.isnan(channel(signals_of(husky, robot), name)).all()


def fake(dt_s, run_id="a", n=400):
    """Return signals of a robot that rolls."""
    still = np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros((n, len(CHANNELS)))
    return Signals(run_id, "", dt_s, 0.0, np.full((n, 2), 0.5), *still)


def test_the_slowest_clock_sets_the_low_pass_whichever_run_has_it():
    fast, slow = fake(0.02), fake(0.0208, "b")
    assert (
        low_pass_of([fast, slow]).rate_hz == low_pass_of([slow, fast]).rate_hz < low_pass_of([fast]).rate_hz
    )
    crawling = low_pass_of([fake(0.1)])  # 10 Hz
    assert (crawling.cutoff_hz, crawling.inputs_every) == (pytest.approx(2.0), 0)
    with pytest.raises(DataError, match="b is on a clock of 10 Hz, a on one of 50 Hz; clocks within 5% of"):
        low_pass_of([fast, fake(0.1, "b")])


def test_noise_of_the_wheels_is_not_attributed_to_a_mass_or_a_motor():
    """At one speed the wheels' acceleration is all noise, in the residual and in what a mass would change."""
    robot = AGRIMARO
    time_s = np.arange(2001) / 50
    twist = np.zeros((time_s.size, 3))
    twist[:, 0] = np.clip(0.5 * time_s, 0.0, 0.7)
    runs = [
        simulate(robot, twist, Ground(), seed, noise=spread_numbers("noise"), run_id=str(seed))
        for seed in range(6)
    ]
    signals, simulation = [signals_of(run, robot) for run in runs], Simulation(robot)
    low_pass = low_pass_of(signals)
    off = {}
    for instrument_cutoff_hz in (low_pass.instrument_cutoff_hz, np.inf):
        same = low_pass._replace(instrument_cutoff_hz=instrument_cutoff_hz)
        names = ["motor_constant_ratio", "rolling_resistance_ratio", "accel_bias_mps2"]
        info = evidence_at(signals, simulation, simulation.vector, names, same)
        change, cov = info.fit(names)
        off[instrument_cutoff_hz] = change[0], change[0] / np.sqrt(cov[0, 0])
    assert off[np.inf][1] < -4.0
    assert abs(off[low_pass.instrument_cutoff_hz][0]) < 0.5 * abs(off[np.inf][0])
    assert abs(off[low_pass.instrument_cutoff_hz][1]) < 3.0


@pytest.mark.parametrize(
    ("seconds", "moving", "lost_s"), [(6.0, False, 0.0), (6.0, True, SETTLE_S), (20.0, False, SETTLE_S)]
)
def test_the_start_of_a_short_run_is_kept_where_it_begins_in_steady_motion(seconds, moving, lost_s):
    """Its one change of command is there."""
    run = fake(0.02, n=round(seconds / 0.02))
    wheel_speed = run.wheel_speed_mps.copy()
    wheel_speed[:, 0] += 0.3 * np.clip(run.time_s / 0.3, 0.0, 1.0) * moving
    low_pass = low_pass_of([run])
    cut = replace(run, wheel_speed_mps=wheel_speed)
    rows = rows_of(cut, Simulation(HUSKY).planar_on(""), vector_of({}), (), low_pass)
    centre_s = low_pass.taps.size // 2 * cut.dt_s * max(low_pass.inputs_every, 1)
    assert rows.time_s[0] == pytest.approx(centre_s + lost_s, abs=1.0 / low_pass.rate_hz)


def arc(robot="husky", speed=0.6, rate=0.3, seconds=12.0):
    """Return a run on a circle, its wheel speeds and nothing else, and its poses (n, 3) at 50 Hz."""
    time_s = np.arange(0.0, seconds, 0.02)
    half = 0.5 * HUSKY.track_m * rate
    wheels = Stream(time_s, np.tile([speed - half, speed + half], (len(time_s), 1)), HUSKY.rate_channels)
    yaw = rate * time_s
    pose = np.column_stack([speed / rate * np.sin(yaw), speed / rate * (1 - np.cos(yaw)), yaw])
    return RunLog("a", robot, {"wheels": wheels}), pose


def seen_by(run, name, stream):
    signals = signals_of(replace(run, streams={**run.streams, name: stream}), HUSKY)
    means = (
        np.nanmean(channel(signals, c))
        for c in (SPEED_X, SPEED_Y, HEADING)
        if np.isfinite(channel(signals, c)).any()
    )
    return [round(float(mean), 3) for mean in means]


@pytest.mark.parametrize("speed", [0.6, -0.6])
def test_poses_alone_give_speeds_and_heading_rate_of_any_drive(speed):
    """Stamps of poses that come in pairs, some microseconds apart, are sums over the clock's periods."""
    run, pose = arc(speed=speed)
    time_s = run.streams["wheels"].time_s
    at = np.sort(np.concatenate([time_s, time_s[1:] - 1e-5]))
    columns = [np.interp(at, time_s, column) for column in pose.T]
    jitter = np.random.default_rng(0).normal(size=(len(at), 3)) * 1e-4
    found = seen_by(run, "pose", Stream(at, np.column_stack(columns) + jitter, POSE_CHANNELS))
    assert found == [speed, 0.0, 0.3]


@pytest.mark.parametrize("speed", [0.6, -0.6])
@pytest.mark.parametrize("with_velocity", [True, False])
def test_gnss_alone_gives_speed_and_the_rate_of_the_course(speed, with_velocity):
    run, pose = arc(speed=speed)
    rows = slice(None, None, 10)
    time_s, place = run.streams["wheels"].time_s[rows], pose[rows, :2]
    values, channels = place, ("position_x_m", "position_y_m")
    if with_velocity:
        values = np.column_stack([values, speed * np.cos(pose[rows, 2]), speed * np.sin(pose[rows, 2])])
        channels = (*channels, "velocity_x_mps", "velocity_y_mps")
    found = seen_by(run, "gnss", Stream(time_s, values, channels))
    assert np.allclose(found, [speed, 0.3], atol=2e-3)


def test_the_course_of_a_robot_at_rest_is_no_heading():
    run, pose = arc(speed=0.1)
    rows = slice(None, None, 10)
    stream = Stream(run.streams["wheels"].time_s[rows], pose[rows, :2], ("position_x_m", "position_y_m"))
    signals = signals_of(replace(run, streams={**run.streams, "gnss": stream}), HUSKY)
    assert not np.isfinite(channel(signals, HEADING)).any()
    assert np.isfinite(channel(signals, SPEED_X)).any()
