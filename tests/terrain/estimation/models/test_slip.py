"""The slip filter: its equations, headings by motion, delays, what is not observed, and simulated robots."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from terrain.angles import wrapped
from terrain.estimation.estimate import estimate_run, summarize
from terrain.estimation.live import live_estimator
from terrain.estimation.models import slip as module
from terrain.estimation.models.choice import suitable_filter
from terrain.estimation.models.observer import ObserverStatus, observe
from terrain.estimation.models.observer import rows_of as feed_rows
from terrain.estimation.models.slip import SlipFilter, rows_of_wheels
from terrain.kinematics.wheels import rolling_matrix
from terrain.logs.replay import replay as replayed
from terrain.records import RunLog, Stream
from terrain.robots import SkidSteerRobot, load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.sensors import Gnss
from terrain.terramechanics.soil import soil_names

HUSKY, CAR, OMNI, TRUCK, SWERVE = map(load_robot, ("husky", "adap2e", "robotino", "pallet_truck", "agrimaro"))
MINE = SkidSteerRobot("mine", 0.2, 0.7, 0.8, 120.0)
DRIVES = (HUSKY, load_robot("marmotte"), OMNI, load_robot("omnirobot"), CAR, TRUCK, SWERVE)
PERIOD_S = 0.02


def drive(robot, n=1500, slip=0.1, yaw_rad=0.0, backward=False, delay_s=0.0, lever_m=(0.0, 0.0), accel=True):
    """Return stamps, rows by name and the true motion of a robot whose wheels all slip by a ratio, without noise.

    It speeds up and slows down, and turns where its drive lets it; a receiver gives every fifth tick where the antenna
    was a delay before.
    """
    time_s = PERIOD_S * np.arange(n)
    fine_s = np.arange(0.0, time_s[-1] + 1e-9, 1e-3)
    speed = 0.8 + 0.3 * np.sin(0.7 * fine_s)
    turn = 0.2 * np.sin(0.45 * fine_s)
    across = 0.2 * np.sin(0.3 * fine_s) if robot.sideways else np.zeros(len(fine_s))
    if backward:
        speed = -speed
    heading = yaw_rad + 1e-3 * np.concatenate([[0.0], np.cumsum(0.5 * (turn[1:] + turn[:-1]))])
    velocity = (speed + 1j * across) * np.exp(1j * heading)
    place = 1e-3 * np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]))])
    antenna = place + complex(*lever_m) * np.exp(1j * heading)
    at = {
        name: np.interp(time_s, fine_s, value) for name, value in (("vx", speed), ("vy", across), ("w", turn))
    }
    rows = {}
    twist = np.column_stack([at["vx"], at["vy"], at["w"]])
    logged, across_wheels, _ = rows_of_wheels(robot)
    directions = np.tile(robot.wheel_directions_rad, (n, 1))
    for k in across_wheels.tolist():
        x_m, y_m = robot.wheel_positions_m[k]
        angle = np.arctan2(at["vy"] + at["w"] * x_m, at["vx"] - at["w"] * y_m)
        angle = wrapped(angle + np.pi * (np.abs(angle) > 0.5 * np.pi))
        directions[:, k] += angle
        rows[f"steer_{robot.wheels[k]}_rad"] = angle
    rolling = rolling_matrix(robot.wheel_positions_m, directions, robot.roller_angles_rad)
    ground = np.einsum("nij,nj->ni", rolling, twist)
    for k in logged.tolist():
        rows[f"speed_{robot.wheels[k]}_mps"] = ground[:, k] / (1.0 - slip)
    rows["yaw_rate_radps"] = at["w"]
    if accel:
        rows["accel_x_mps2"] = np.gradient(at["vx"], time_s) - at["w"] * at["vy"]
        rows["pitch_rad"] = np.zeros(n)
    then = np.arange(0, n, 5)
    seen_s = np.maximum(time_s[then] - delay_s, 0.0)
    rows |= {
        name: np.full(n, np.nan) for name in ("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
    }
    moved = np.gradient(antenna, 1e-3)
    for name, value in (
        ("gnss_x_m", antenna.real),
        ("gnss_y_m", antenna.imag),
        ("gnss_speed_x_mps", moved.real),
    ):
        rows[name][then] = np.interp(seen_s, fine_s, value)
    rows["gnss_speed_y_mps"][then] = np.interp(seen_s, fine_s, moved.imag)
    rows["gnss_age_s"], rows["gnss_std_m"] = np.zeros(n), np.full(n, 0.02)
    true = {"yaw": np.interp(time_s, fine_s, heading), "x": np.interp(time_s, fine_s, place.real), **at}
    return time_s, rows, true


def run_filter(robot, time_s, rows, start=0):
    """Return the filter, and its track over rows by name; what is not given is unknown."""
    filter_ = SlipFilter(robot)
    table = np.column_stack([rows.get(name, np.full(len(time_s), np.nan)) for name in filter_.rows])
    track = observe(filter_, time_s[start:], table[start:])
    assert not any("numerical" in kind for kind in filter_.filter.dropped)
    return filter_, track


# -- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", DRIVES, ids=lambda robot: robot.name)
@pytest.mark.parametrize("backward", [False, True])
def test_slip_of_any_drive_is_that_of_its_definition(robot, backward):
    time_s, rows, true = drive(robot, backward=backward, yaw_rad=2.5)
    _, track = run_filter(robot, time_s, rows)
    speeds = np.column_stack([rows[name] for name in rows if name.startswith("speed_")])
    late = (time_s > 15.0)[:, None] & (np.abs(speeds) > 0.3)
    expected = 0.1 * np.sign(speeds)
    assert np.abs(track.slip - expected)[late].max() < 0.03
    assert np.abs(wrapped(track.state("yaw_rad") - true["yaw"]))[time_s > 15.0].max() < 0.06
    assert (track.status[time_s > 15.0] == ObserverStatus.OK).all()


def test_a_wheel_that_stands_tells_the_ground_stands_and_nothing_of_its_slip():
    time_s, rows, true = drive(HUSKY)
    moves = np.clip(21.0 - time_s, 0.0, 1.0)  # brakes from 20 s on
    for name in ("speed_left_mps", "speed_right_mps", "yaw_rate_radps"):
        rows[name] = moves * rows[name]
    rows["accel_x_mps2"] = np.gradient(moves * true["vx"], time_s)
    for name in ("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps"):
        rows[name] = np.where(time_s > 20.0, np.nan, rows[name])
    _, track = run_filter(HUSKY, time_s, rows)
    before, after = np.searchsorted(time_s, [20.0, 29.0])
    assert abs(track.state("speed_x_mps")[after]) < 0.01
    assert track.status[after] == ObserverStatus.STANDING
    assert np.isnan(track.slip[after]).all()
    for side in ("left", "right"):
        name = f"ground_slip_{side}_ratio"
        std = track.std[before, track.states.index(name)]
        assert track.state(name)[after] == pytest.approx(track.state(name)[before], abs=1.5 * std)


@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.2])
def test_a_delay_of_the_receiver_is_learned_and_leaves_slip_as_it_is(delay_s):
    time_s, rows, _ = drive(MINE, n=3000, delay_s=delay_s)
    _, track = run_filter(MINE, time_s, rows)
    std_s = track.std[-1, track.states.index("gnss_delay_s")]
    assert track.state("gnss_delay_s")[-1] == pytest.approx(delay_s, abs=4.0 * std_s)
    assert std_s < 0.03
    assert np.abs(track.slip[-1000:] - 0.1).max() < 0.03


def test_an_antenna_ahead_and_to_the_left_moves_with_the_body():
    antenna = replace(MINE, parts=_with_antenna(0.5, 0.3))
    time_s, rows, true = drive(antenna, lever_m=(0.5, 0.3), yaw_rad=-2.0)
    _, track = run_filter(antenna, time_s, rows)
    assert track.state("position_x_m")[-1] == pytest.approx(true["x"][-1], abs=0.1)
    assert np.abs(track.slip[-500:] - 0.1).max() < 0.03


def _with_antenna(x_m, y_m):
    from terrain.robots import Antenna

    return {"antenna": Antenna(x_m, y_m)}


@pytest.mark.parametrize("missing", [("gnss_speed_x_mps", "gnss_speed_y_mps"), ("gnss_x_m", "gnss_y_m")])
def test_positions_or_speeds_alone_show_the_heading(missing):
    time_s, rows, true = drive(HUSKY, yaw_rad=3.0)
    _, track = run_filter(HUSKY, time_s, {name: row for name, row in rows.items() if name not in missing})
    assert np.abs(wrapped(track.state("yaw_rad") - true["yaw"]))[time_s > 10.0].max() < 0.08
    assert np.abs(track.slip[time_s > 15.0] - 0.1).max() < 0.04


def test_a_receiver_that_comes_after_a_camera_is_used_from_where_it_shows_the_heading():
    time_s, rows, true = drive(MINE, n=1000, delay_s=0.1)
    moves = rng_speeds(true["vx"])
    rows["camera_x_mps"], rows["camera_y_mps"], rows["camera_age_s"] = moves, 0.0 * moves, 0.0 * moves
    for name in ("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps"):
        rows[name] = np.where(time_s < 2.0, np.nan, rows[name])
    filter_, track = run_filter(MINE, time_s, rows)
    assert filter_.reference_age_s < 0.1
    assert np.abs(track.slip[-200:] - 0.1).max() < 0.05


def turning(n, left, right, loss, pushed_mps=0.0):
    """Return stamps and rows of a robot that turns evenly from heading 0, and loses a part of its turn."""
    time_s = PERIOD_S * np.arange(n)
    rate = (right - left) * (1.0 - loss) / MINE.track_m
    ahead = 0.5 * (left + right) + pushed_mps
    path = ahead / rate * (np.exp(1j * rate * time_s) - 1.0) / 1j
    seen = np.where(np.arange(n) % 5 == 0, 1.0, np.nan)
    rows = {"speed_left_mps": np.full(n, left), "speed_right_mps": np.full(n, right)}
    rows |= {"yaw_rate_radps": np.full(n, rate), "pose_x_m": path.real * seen, "pose_y_m": path.imag * seen}
    return time_s, rows | {"pose_yaw_rad": wrapped(rate * time_s) * seen, "pose_age_s": np.zeros(n)}


def test_what_is_lost_in_turning_is_learned_apart_from_slip_straight_ahead():
    time_s, rows = turning(1000, -0.4, 0.4, 0.6, pushed_mps=0.08)  # one side slips more
    _, track = run_filter(MINE, time_s, rows)
    assert track.state("turn_loss_ratio")[-1] == pytest.approx(0.6, abs=0.1)
    for side in ("left", "right"):
        assert abs(track.state(f"ground_slip_{side}_ratio")[-1]) < 0.05
    _, wide = run_filter(MINE, *turning(1000, 0.6, 0.8, 0.4))
    assert wide.state("turn_loss_ratio")[-1] == pytest.approx(0.4, abs=0.25)


def test_a_car_without_a_gyro_turns_as_its_wheel_is_steered():
    time_s, rows, true = drive(CAR)
    del rows["yaw_rate_radps"]
    for name in ("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps"):
        rows[name] = np.where(time_s > 20.0, np.nan, rows[name])
    _, track = run_filter(CAR, time_s, rows)
    assert np.abs(track.state("yaw_rate_radps") - true["w"])[time_s > 20.0].max() < 0.05


@pytest.mark.parametrize("bias_radps", [-0.004, 0.006])
@pytest.mark.parametrize("difference_mps", [0.0, 0.11, 0.3, -0.39])
def test_the_bias_of_a_gyro_is_that_at_rest_and_wheels_that_spin_leave_it_alone(bias_radps, difference_mps):
    """Two seconds of rest, then wheels that turn on the spot on a robot that stays where it is."""
    rng, time_s = np.random.default_rng(3), PERIOD_S * np.arange(1500)
    spin = np.where(time_s > 2.0, 0.5 * difference_mps, 0.0)
    noise = rng.normal(0.0, 0.01, (2, len(time_s))) * (spin != 0.0)
    rows = {"speed_left_mps": noise[0] - spin, "speed_right_mps": noise[1] + spin}
    rows["yaw_rate_radps"] = bias_radps + rng.normal(0.0, 0.005, len(time_s))
    _, track = run_filter(HUSKY, time_s, rows)
    j = track.states.index("gyro_bias_radps")
    late, error = time_s > 2.0, np.abs(track.mean[:, j] - bias_radps)
    assert (error < 3.0 * track.std[:, j]).all()
    assert error[late].max() < 0.002
    assert track.std[late, j].max() < 0.002
    yaw = track.states.index("yaw_rad")
    assert (np.abs(track.mean[:, yaw]) < 3.0 * track.std[:, yaw]).all()


def test_a_turn_that_begins_late_leaves_the_bias_alone():
    """By wheels and gyro alone: tyres and soil yield first, and the wheels turn for a while before the robot."""
    robot = load_robot("warthog")
    run = simulate_run(robot, "grass", "survey", 81001, duration_s=18.0)
    track = estimate_run(
        replace(run, streams={n: run.streams[n] for n in ("wheels", "imu")}), robot, "slip"
    ).track
    truth, late = run.streams["truth"], track.time_s > 1.0
    for name, true, most in (("gyro_bias_radps", "gyro_bias_z_radps", 2e-3), ("yaw_rad", "yaw_rad", 0.02)):
        error = track.state(name) - np.interp(track.time_s, truth.time_s, truth.channel(true))
        assert np.abs(error)[late].max() < most
        assert (np.abs(error) < 3.0 * track.std(name))[late].all()


def test_what_is_lost_in_turning_is_learned_where_the_robot_follows_its_wheels_late():
    """Turns of 2 s, 0.4 s late: a lag that counted as a loss or none would be some of it."""
    time_s = PERIOD_S * np.arange(3000)
    turn = np.where((time_s % 6.0 > 2.0) & (time_s % 6.0 < 4.0), 0.5, 0.0)
    half = 0.5 * HUSKY.track_m * turn / (1.0 - 0.4)
    rows = {"speed_left_mps": 0.8 - half, "speed_right_mps": 0.8 + half}
    rows["yaw_rate_radps"] = np.r_[np.zeros(20), turn[:-20]]
    rows["yaw_rate_radps"] += np.random.default_rng(0).normal(0.0, 0.002, len(time_s))
    _, track = run_filter(HUSKY, time_s, rows)
    assert track.state("turn_loss_ratio")[-1] == pytest.approx(0.4, abs=0.08)


def test_an_accelerometer_that_the_ground_shakes_is_believed_less():
    time_s, rows, _ = drive(HUSKY)
    rng = np.random.default_rng(1)
    rows["accel_x_mps2"] = rows["accel_x_mps2"] + rng.normal(0.0, 3.0, len(time_s))
    for name, std in (
        ("gnss_x_m", 0.02),
        ("gnss_y_m", 0.02),
        ("gnss_speed_x_mps", 0.03),
        ("gnss_speed_y_mps", 0.03),
    ):
        rows[name] = rows[name] + rng.normal(0.0, std, len(time_s))
    filter_, track = run_filter(HUSKY, time_s, rows)
    error, late = np.abs(track.slip - 0.1), time_s > 10.0
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.03
    assert np.mean(error[late] < 2.0 * track.slip_std[late]) > 0.9
    assert sum(filter_.filter.dropped.values()) < 5


@pytest.mark.parametrize(
    ("state", "turns_back"), [("passing_slip_0_ratio", False), ("ground_slip_left_ratio", True)]
)
def test_on_slippery_ground_slip_changes_by_more(state, turns_back):
    """Without a reference, by the slip of before: for the same acceleration, and where it turns back."""
    stds = []
    for slip in (0.05, 0.4):
        time_s, rows, _ = drive(HUSKY, slip=slip, accel=False)
        ahead = np.clip(1.0 - 2.0 * (time_s - 25.0), -1.0, 1.0) if turns_back else np.ones(len(time_s))
        ahead *= (1.0 - slip) / 0.95  # the wheels turn alike on both grounds
        for name in ("speed_left_mps", "speed_right_mps", "yaw_rate_radps"):
            rows[name] = rows[name] * ahead
        for name in ("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps"):
            rows[name] = np.where(time_s > 25.0, np.nan, rows[name] * (1.0 - slip) / 0.95)
        filter_, _ = run_filter(HUSKY, time_s, rows)
        stds.append(np.sqrt(filter_.filter.cov.diagonal()[filter_.filter.model.states.index(state)]))
    assert stds[1] > 1.25 * stds[0]


def test_gravity_of_a_slope_is_taken_off_by_the_measured_pitch():
    time_s, rows, _ = drive(HUSKY)
    rows["pitch_rad"] = np.full(len(time_s), -0.1)
    rows["accel_x_mps2"] = rows["accel_x_mps2"] + 9.80665 * np.sin(0.1)
    _, track = run_filter(HUSKY, time_s, rows)
    assert abs(track.state("accel_bias_x_mps2")[-1]) < 0.1


def test_slip_of_the_ground_is_never_less_known_than_before_the_first_motion_or_by_its_size():
    time_s = 0.1 * np.arange(1500)
    speed = np.where((time_s // 2.0) % 2 == 0, 0.8, -0.8)
    rows = {"speed_left_mps": speed, "speed_right_mps": speed, "yaw_rate_radps": 0.0 * time_s}
    _, track = run_filter(HUSKY, time_s, rows)
    most = np.maximum(module.FIRST_RATIO, np.abs(track.state("ground_slip_left_ratio")))
    assert (track.std[:, track.states.index("ground_slip_left_ratio")] < 1.3 * most).all()


def test_the_covariance_is_one_where_poses_come_after_a_camera():
    time_s, rows, true = drive(MINE, n=400)
    rows = {name: row for name, row in rows.items() if not name.startswith("gnss")}
    rows |= {
        "camera_x_mps": rng_speeds(true["vx"]),
        "camera_y_mps": 0.0 * time_s,
        "camera_age_s": 0.0 * time_s,
    }
    poses = {
        "pose_x_m": true["x"],
        "pose_y_m": 0.0 * time_s,
        "pose_yaw_rad": true["yaw"],
        "pose_age_s": 0.0 * time_s,
    }
    late = time_s >= 4.0 - 1e-9
    rows |= {name: np.where(late, row, np.nan) for name, row in poses.items()}
    first = int(np.argmax(late))
    filter_, _ = run_filter(MINE, time_s[: first + 1], {name: row[: first + 1] for name, row in rows.items()})
    assert np.linalg.eigvalsh(filter_.filter.cov)[0] > 0.0


def rng_speeds(speed_mps):
    return speed_mps + 0.03 * np.random.default_rng(8).standard_normal(len(speed_mps))


def test_spinning_wheels_show_no_heading_and_slip_that_is_seen_is_one():
    time_s, rows, _ = drive(HUSKY, n=500)
    for name in rows:
        if name.startswith(("gnss_x", "gnss_y", "gnss_speed", "accel", "yaw_rate")):
            rows[name] = 0.0 * rows[name]
    filter_, track = run_filter(HUSKY, time_s, rows)
    assert np.isnan(track.slip).all()
    assert "heading is not known" in filter_.reason
    rows["compass_rad"] = np.zeros(len(time_s))
    _, track = run_filter(HUSKY, time_s, rows)
    assert np.abs(track.slip[-100:] - 1.0).max() < 0.05


# -- what is not observed --------------------------------------------------------------------------------------------


def test_a_steered_wheel_slips_by_its_own_angle_and_not_without_one():
    time_s, rows, _ = drive(SWERVE, n=800)
    names = [f"steer_{wheel}_rad" for wheel in SWERVE.wheels]
    motors = [rows[f"speed_{wheel}_mps"] / SWERVE.wheel_radius_m for wheel in SWERVE.wheels]
    streams = {
        "wheels": Stream(time_s, SWERVE.motors.reduction_ratio * np.array(motors).T, SWERVE.rate_channels),
        "steering": Stream(time_s, np.array([rows[name] for name in names]).T, SWERVE.steer_channels),
    }
    _, fed, _ = feed_rows(RunLog("a", "agrimaro", streams), SWERVE, SlipFilter(SWERVE).rows)
    for name in (*names, "speed_3_mps"):
        assert fed[:, SlipFilter(SWERVE).rows.index(name)] == pytest.approx(rows[name])
    rows[names[0]] = np.where(time_s > 12.0, np.nan, rows[names[0]])
    _, track = run_filter(SWERVE, time_s, rows)
    assert np.isnan(track.slip[time_s > 12.0, 0]).all()
    assert np.isfinite(track.slip[time_s > 12.0, 1:]).all()


def test_wheels_that_spin_in_place_start_and_stop_without_a_speed_over_ground():
    time_s = PERIOD_S * np.arange(1500)
    rolled_mps = 0.4 * np.clip(5.0 * np.minimum(time_s % 5.0, 4.0 - time_s % 5.0), 0.0, 1.0)
    x_m = np.cumsum(0.05 * rolled_mps) * PERIOD_S
    rows = {"speed_left_mps": rolled_mps, "speed_right_mps": rolled_mps, "yaw_rate_radps": 0.0 * time_s}
    for name, value in (("pose_x_m", x_m), ("pose_y_m", 0.0 * x_m), ("pose_yaw_rad", 0.0 * x_m)):
        rows[name] = np.where(np.arange(1500) % 5 == 0, value, np.nan)
    rows["pose_age_s"] = 0.0 * time_s
    _, track = run_filter(HUSKY, time_s, rows)
    late = time_s > 10.0
    assert np.abs(track.state("speed_x_mps") - 0.05 * rolled_mps)[late].max() < 0.15
    assert np.nanmin(track.slip[late & (rolled_mps > 0.3)]) > 0.85


def test_without_a_reference_slip_is_unknown_and_the_reason_is_stated():
    time_s, rows, _ = drive(HUSKY, n=300)
    blind = {name: row for name, row in rows.items() if not name.startswith("gnss")}
    filter_, track = run_filter(HUSKY, time_s, blind)
    assert np.isnan(track.slip).all()
    assert (track.status == ObserverStatus.STARTING).all()
    assert filter_.reason == "no position, pose or speed over ground has come yet"


def test_over_ten_seconds_without_a_reference_slip_of_the_ground_is_remembered_with_a_deviation_that_grows():
    time_s, rows, _ = drive(HUSKY, n=1500)
    for name in rows:
        if name.startswith(("gnss_x", "gnss_y", "gnss_speed")):
            rows[name] = np.where(time_s > 18.0, np.nan, rows[name])
    filter_, track = run_filter(HUSKY, time_s, rows)
    before, after = np.searchsorted(time_s, [18.0, 28.0])
    assert np.abs(track.slip[before:after] - 0.1).max() < 0.05
    assert track.slip_std[after].min() > 1.5 * track.slip_std[before].max()
    assert track.status[after] == ObserverStatus.PREDICTED
    assert filter_.reference_age_s == pytest.approx(time_s[-1] - 18.0, abs=0.2)


def test_the_ripple_of_a_wheels_speed_is_no_slip_that_grows_without_a_reference():
    time_s, rows, _ = drive(MINE, n=2500)
    rng = np.random.default_rng(4)
    for name in rows:
        if name.startswith("speed_"):
            rows[name] = rows[name] + 0.01 * rng.standard_normal(len(time_s))
        if name.startswith(("gnss_x", "gnss_y", "gnss_speed")):
            rows[name] = np.where(time_s > 20.0, np.nan, rows[name])
    rows["accel_x_mps2"] = rows["accel_x_mps2"] + 0.3 * rng.standard_normal(len(time_s))
    _, track = run_filter(MINE, time_s, rows)
    before, after = np.searchsorted(time_s, [20.0, 49.0])
    for side in ("left", "right"):
        ground = track.state(f"ground_slip_{side}_ratio")
        assert (
            abs(ground[after] - ground[before])
            < track.std[after, track.states.index(f"ground_slip_{side}_ratio")]
        )


@pytest.mark.parametrize("sensor", ["gnss", "pose"])
def test_a_reference_that_jumps_is_elsewhere_and_shows_no_slip(sensor):
    time_s, rows, true = drive(MINE, n=2000)
    rows["gnss_x_m"] = rows["gnss_x_m"] + 1.5 * (time_s > 15.0) - 0.4 * (time_s > 19.0)
    rows["gnss_y_m"] = rows["gnss_y_m"] - 0.8 * (time_s > 15.0) + 0.5 * (time_s > 27.0)
    if sensor == "pose":
        rows["pose_x_m"], rows["pose_y_m"] = rows.pop("gnss_x_m"), rows.pop("gnss_y_m")
        rows["pose_yaw_rad"], rows["pose_age_s"] = (
            np.where(np.isnan(rows["pose_x_m"]), np.nan, true["yaw"]),
            0.0 * time_s,
        )
    rows = {name: row for name, row in rows.items() if not name.startswith("gnss_speed")}
    filter_, track = run_filter(MINE, time_s, rows)
    sensors = filter_.filter.dropped
    assert any("gated" in kind for kind in sensors)
    assert not any(kind.startswith("wheel") for kind in sensors)
    assert np.abs(track.slip[time_s > 12.0] - 0.1).max() < 0.04
    assert abs(track.state("position_x_m")[-1] - true["x"][-1] - 1.1) < 0.1


def test_a_delay_that_a_description_has_is_there_from_the_first_pose_on():
    late = replace(MINE, identified={"pose_delay_s": 0.4})
    time_s, rows, truth = drive(late, n=200)
    poses = {
        "pose_x_m": truth["x"],
        "pose_y_m": 0.0 * time_s,
        "pose_yaw_rad": truth["yaw"],
        "pose_age_s": 0.0 * time_s,
    }
    rows = {name: row for name, row in rows.items() if not name.startswith("gnss")} | poses
    rows |= {name: np.where(time_s < 1.0, np.nan, row) for name, row in poses.items()}
    _, track = run_filter(late, time_s, rows)
    first = np.searchsorted(time_s, 1.0 - 1e-9)
    moved_m = track.state("position_x_m")[first] - poses["pose_x_m"][first]
    assert track.state("pose_delay_s")[first] == pytest.approx(0.4, abs=0.02)
    assert moved_m == pytest.approx(0.4 * track.state("speed_x_mps")[first], abs=0.05)


def test_an_accelerometer_in_other_units_is_left_out():
    time_s, rows, _ = drive(HUSKY)
    rows["accel_x_mps2"] = rows["accel_x_mps2"] + 9.81
    filter_, track = run_filter(HUSKY, time_s, rows)
    assert np.isnan(filter_.accel_mps2)
    assert np.abs(track.slip[-300:] - 0.1).max() < 0.05


def test_the_scatter_of_poses_is_learned():
    rng, n = np.random.default_rng(3), 1500
    time_s, rows, truth = drive(OMNI, n=n)
    rows = {name: row for name, row in rows.items() if not name.startswith("gnss")}
    speed = (truth["vx"] + 1j * truth["vy"]) * np.exp(1j * truth["yaw"])
    place = PERIOD_S * np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    for name, value, std in (
        ("pose_x_m", place.real, 2e-3),
        ("pose_y_m", place.imag, 2e-3),
        ("pose_yaw_rad", truth["yaw"], 4e-3),
    ):
        rows[name] = value + std * rng.standard_normal(n)
    rows["pose_age_s"] = np.zeros(n)
    filter_, track = run_filter(OMNI, time_s, rows)
    assert filter_._pose_scatter.std == pytest.approx([2e-3, 2e-3, 4e-3], rel=0.3)
    known = np.isfinite(track.slip[-500:])
    speeds = np.column_stack([rows[name] for name in rows if name.startswith("speed_")])[-500:]
    assert np.abs(track.slip[-500:] - 0.1 * np.sign(speeds))[known & (np.abs(speeds) > 0.3)].max() < 0.05


def test_the_filter_that_suits_is_chosen_by_what_is_measured():
    assert suitable_filter(HUSKY, ("wheels", "imu")) == "slip"
    assert suitable_filter(SWERVE, ("wheels", "steering", "imu")) == "encoder12"
    assert suitable_filter(CAR, ("wheels", "steering", "gnss")) == "slip"
    assert suitable_filter(OMNI, ("wheels",)) == "slip"
    assert suitable_filter(SWERVE, ("wheels", "steering", "imu", "odometry")) == "vio15"
    only = replace(load_robot("orchard_ugv"), filters=("tracked",))
    assert suitable_filter(only, ("gnss",)) == "tracked"


# -- simulated robots ------------------------------------------------------------------------------------------------


def coverage(found, robot, least_mps=0.2):
    """Return mean error, root mean square error and coverage of 95 % intervals of slips, where the wheels turn."""
    slip, truth = found.slip, found.run.streams["truth"]
    errors, inside = [], []
    for k, (name, wheel) in enumerate(zip(slip.channels, slip.wheels, strict=True)):
        at_s = slip.time_s - robot.encoder_lag_s
        true = np.interp(at_s, truth.time_s, truth.channel(name))
        speed = robot.wheel_radius_m * np.interp(at_s, truth.time_s, truth.channel(f"wheel_{wheel}_radps"))
        error = slip.mean[:, k] - true
        known = np.isfinite(error) & (np.abs(speed) > least_mps)
        errors.append(error[known])
        inside.append(np.abs(error[known]) < 1.96 * slip.std[known, k])
    errors, inside = np.concatenate(errors), np.concatenate(inside)
    return errors.mean(), np.sqrt(np.mean(errors**2)), inside.mean()


def test_live_equals_log_and_a_robot_of_four_numbers_has_its_slip():
    run = simulate_run(MINE, "grass", "survey", 11, duration_s=20.0, gnss=Gnss())
    found = estimate_run(run, MINE, "slip")
    mean, _, inside = coverage(found, MINE)
    assert abs(mean) < 0.02
    assert inside > 0.85
    assert summarize(found).reason == ""
    channels = {name: stream.channels for name, stream in run.streams.items()}
    live = live_estimator(MINE, channels)
    assert live.name == "slip"
    estimates = [estimate for sample in replayed(run) for estimate in live.step(sample.readings)]
    estimates += live.settle(all_of_them=True)
    np.testing.assert_array_equal([estimate.slip_ratio for estimate in estimates], found.slip.mean)
    np.testing.assert_array_equal([estimate.slip_std for estimate in estimates], found.slip.std)


@pytest.mark.slow
@pytest.mark.parametrize("soil", soil_names()[:6])
def test_mean_slip_of_a_skid_steer_robot_with_a_receiver_is_within_a_hundredth(soil):
    means, inside = [], []
    for seed in range(91500, 91505):
        run = simulate_run(MINE, soil, "survey", seed, duration_s=60.0, vary=True, gnss=Gnss())
        mean, _, covered = coverage(estimate_run(run, MINE, "slip"), MINE)
        means.append(mean)
        inside.append(covered)
    assert np.abs(means).max() < 0.02
    assert abs(np.mean(means)) < 0.01
    assert 0.90 < np.mean(inside) <= 0.995


def test_the_guide_states_from_where_on_slip_is_unknown():
    guide = (Path(__file__).parents[4] / "docs" / "guide.md").read_text(encoding="utf-8")
    assert f"standard deviation is above {module.UNKNOWN_RATIO:g}" in guide


def test_white_ripple_of_the_wheels_is_no_slip():
    time_s, rows, _ = drive(MINE, n=2500)
    rng = np.random.default_rng(4)
    for name in ("speed_left_mps", "speed_right_mps"):
        rows[name] = rows[name] + 0.04 * rng.standard_normal(len(time_s))
    filter_, track = run_filter(MINE, time_s, rows)
    late = time_s > 10.0
    for name, true, most in (
        ("ground_slip_left_ratio", 0.1, 0.05),
        ("ground_slip_right_ratio", 0.1, 0.05),
        ("turn_loss_ratio", 0.0, 0.3),
    ):
        j = track.states.index(name)
        error = np.abs(track.mean[late, j] - true)
        assert error.max() < most
        assert np.mean(error < 2.0 * track.std[late, j]) > 0.9
    assert filter_._speed_scatter.std == pytest.approx(0.04, rel=0.2)


def test_slip_that_traction_takes_is_learned_and_holds_without_a_reference():
    time_s = PERIOD_S * np.arange(2500)
    rolled_mps, rate_mps2 = 1.0 + 0.6 * np.sin(1.5 * time_s), 0.9 * np.cos(1.5 * time_s)
    slip = 0.05 + 0.2 * rate_mps2
    ground_mps = rolled_mps * (1.0 - slip)
    rows = {"speed_left_mps": rolled_mps, "speed_right_mps": rolled_mps, "yaw_rate_radps": 0.0 * time_s}
    rows["accel_x_mps2"], rows["pitch_rad"] = np.gradient(ground_mps, time_s), 0.0 * time_s
    fixed = (np.arange(2500) % 5 == 0) & (time_s < 40.0)
    for name, value in (
        ("pose_x_m", np.cumsum(ground_mps) * PERIOD_S),
        ("pose_y_m", 0.0),
        ("pose_yaw_rad", 0.0),
    ):
        rows[name] = np.where(fixed, value, np.nan)
    rows["pose_age_s"] = 0.0 * time_s
    _, track = run_filter(MINE, time_s, rows)
    j, late = track.states.index("slip_per_mps2"), time_s > 41.0
    assert track.mean[-1, j] == pytest.approx(0.2, abs=0.05)
    assert np.abs(track.slip[late, 0] - slip[late]).max() < 0.08


@pytest.mark.parametrize("n_lost", [1, 20])
def test_a_wheel_whose_speed_is_not_known_for_a_while_leaves_slip_as_it_is(n_lost):
    time_s = PERIOD_S * np.arange(1500)  # straight ahead, so that the loss in turning is not known
    rows = {name: np.ones(1500) for name in ("speed_left_mps", "speed_right_mps")}
    rows["speed_left_mps"][1000 : 1000 + n_lost] = np.nan
    rows["yaw_rate_radps"] = rows["gnss_age_s"] = 0.0 * time_s
    fixed = np.arange(1500) % 5 == 0
    for name, value in (("gnss_x_m", 0.7 * time_s), ("gnss_y_m", 0.0 * time_s)):
        rows[name] = np.where(fixed, value, np.nan)
    rows["gnss_std_m"] = np.full(1500, 0.02)
    _, track = run_filter(HUSKY, time_s, rows)
    assert np.abs(track.slip[1000:1200, 1] - 0.3).max() < 0.05


def test_poses_and_satellites_of_two_frames_do_not_disturb_each_other():
    time_s, rows, true = drive(HUSKY, slip=0.1)
    posed = np.arange(len(time_s)) % 5 == 0
    for name, value in (
        ("pose_x_m", 50.0 - true["x"] * 0.0),
        ("pose_y_m", true["x"]),
        ("pose_yaw_rad", 1.57),
    ):
        rows[name] = np.where(posed & (time_s > 5.0) & (time_s < 20.0), value, np.nan)
    rows["pose_age_s"] = 0.0 * time_s
    _, track = run_filter(HUSKY, time_s, rows)
    assert np.abs(track.slip[500:] - 0.1).max() < 0.05
    begun = {
        name: np.where(time_s < 5.0, np.nan, row) if name.startswith("gnss_") else row
        for name, row in rows.items()
    }
    _, track = run_filter(HUSKY, time_s, begun)
    assert (np.isfinite(track.slip[time_s > 25.0])).all()
    assert np.abs(track.slip[time_s > 25.0] - 0.1).max() < 0.06


def test_half_a_position_is_no_reference():
    time_s, rows, _ = drive(HUSKY)
    for name in ("gnss_x_m", "gnss_speed_x_mps"):
        rows[name] = np.where(time_s > 10.0, np.nan, rows[name])
    filter_, _ = run_filter(HUSKY, time_s, rows)
    assert filter_.reference_age_s > 15.0


def test_a_described_delay_of_speeds_alone_counts_and_the_covariance_stays_one():
    described = replace(MINE, identified={"gnss_delay_s": 0.3})
    time_s, rows, _ = drive(described, delay_s=0.3)
    for name in ("gnss_x_m", "gnss_y_m"):
        rows[name] = np.full(len(time_s), np.nan)
    filter_, track = run_filter(described, time_s, rows)
    assert track.state("gnss_delay_s")[-1] == pytest.approx(0.3, abs=0.06)
    assert np.linalg.eigvalsh(filter_.filter.cov).min() > -1e-9


def test_no_speed_of_a_wheel_is_the_reason_where_none_comes():
    time_s, rows, _ = drive(HUSKY)
    for name in ("speed_left_mps", "speed_right_mps"):
        rows[name] = np.where(time_s > 20.0, np.nan, rows[name])
    filter_, _ = run_filter(HUSKY, time_s, rows)
    assert filter_.reason.startswith("no speed of a wheel comes")


def test_ticks_further_apart_than_the_filter_bridges_are_taken_up():
    time_s, rows, _ = drive(HUSKY)
    filter_ = SlipFilter(HUSKY)
    table = np.column_stack([rows.get(name, np.full(len(time_s), np.nan)) for name in filter_.rows])
    for row in table[:500]:
        filter_.step(row, PERIOD_S)
    speeds = [filter_.rows.index(name) for name in ("speed_left_mps", "speed_right_mps")]
    still = np.where(np.isin(np.arange(len(filter_.rows)), speeds), 0.0, np.nan)
    for _ in range(20):
        output = filter_.step(still, 1.2)
    assert output.status == ObserverStatus.STANDING
    assert abs(output.mean[filter_.states.index("speed_x_mps")]) < 0.01
    assert filter_.reference_age_s > 10.0
