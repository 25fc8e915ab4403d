"""Drift correction: laws of the step, on an ideal robot that follows, is disturbed, or jumps."""

import math

import numpy as np
import pytest

from terrain.control.path_tracking import SETTINGS, TrackState, TrackStatus, check_tracking, track_step
from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
DT_S, NAN = 0.02, math.nan
ARM = np.array([1.0, 1.0, SETTINGS.arm_m])
TWISTS = {
    "forward": (1.0, 0.0, 0.0),
    "backward": (-0.6, 0.0, 0.0),
    "diagonal": (0.4, -0.4, 0.0),
    "arc": (0.8, 0.0, -0.3),
    "spot": (0.0, 0.0, 0.6),
    "any": (0.5, -0.2, 0.3),
}
TWIST = pytest.mark.parametrize("twist", [np.array(twist) for twist in TWISTS.values()], ids=TWISTS)


def moved(pose, twist):
    middle = pose[2] + 0.5 * DT_S * twist[2]
    velocity = complex(*twist[:2]) * complex(math.cos(middle), math.sin(middle))
    return pose + DT_S * np.array([velocity.real, velocity.imag, twist[2]])


def step(state, twist, pose, ground=None, std=0.001, stale_s=0.0, dt_s=DT_S):
    return track_step(SETTINGS, state, twist, pose, twist if ground is None else ground, std, stale_s, dt_s)


def drive(twist, pose, n, disturbance=(0.0, 0.0, 0.0), speed=1.0):
    """Drive an ideal robot, slower and disturbed; (rows of report and command, state, pose)."""
    state, pose, rows, ground = TrackState(), np.array(pose), [], np.zeros(3)
    for _ in range(n):
        command, state, report = step(state, twist, pose, ground)
        ground = speed * command + np.array(disturbance)
        pose = moved(pose, ground)
        rows.append([*report, *command])
    return np.array(rows), state, pose


@TWIST
def test_a_robot_that_follows_at_its_own_speed_is_not_corrected(twist):
    rows, _, _ = drive(twist, [3.0, -2.0, 9.0], 300, speed=0.4)
    # at a step from rest the reference waits a moment for what is seen late, on an arc micrometres beside it
    np.testing.assert_allclose(rows[:, 4:], np.tile(twist, (300, 1)), atol=5e-5)
    assert (rows[:, 3] == TrackStatus.OK).all()


@TWIST
def test_a_constant_disturbance_is_removed_and_nothing_is_added_along_the_path(twist):
    size = np.linalg.norm(ARM * twist)
    along = ARM * twist / size
    disturbance = 0.03 * size * np.array([0.7, 0.5, -0.4])
    disturbance -= along * (along @ disturbance)
    n = round(32.0 / size / DT_S)
    rows, _, _ = drive(twist, [0.0, 0.0, 0.3], n, disturbance / ARM)
    added = (rows[:, 4:] - twist) * ARM
    assert np.abs(added @ along).max() < 1e-9
    last = rows[-n // 10 :]
    assert np.abs(last[:, 0]).max() < 0.004
    assert np.abs(last[:, 1]).max() < 0.012
    # on the spot a disturbance that turns with the body swings about it, ever less
    np.testing.assert_allclose(added[-1], -disturbance, atol=0.35 * np.linalg.norm(disturbance))


def wandering(rng, n):
    """Return pose and ground twist of a robot that follows a constant twist approximately."""
    ground = np.array([0.7, 0.1, 0.1]) + 0.05 * rng.standard_normal((n, 3))
    poses = [rng.standard_normal(3)]
    for twist in ground[:-1]:
        poses.append(moved(poses[-1], twist))
    return np.array(poses) + 0.002 * rng.standard_normal((n, 3)), ground


def tracked(poses, ground, desired):
    state, rows = TrackState(), []
    for pose, twist in zip(poses, ground, strict=True):
        command, state, report = step(state, desired, pose, twist)
        rows.append([*command, *report])
    return np.array(rows)


def test_corrections_do_not_depend_on_the_origin_and_are_mirror_symmetric():
    desired, turn = np.array([0.7, 0.1, 0.12]), 2.5
    poses, ground = wandering(np.random.default_rng(1), 200)
    rows = tracked(poses, ground, desired)
    assert set(rows[:, 6]) <= {TrackStatus.OK, TrackStatus.CLAMPED}
    assert np.abs(rows[:, :3] - desired).max() > 0.01
    cos, sin = math.cos(turn), math.sin(turn)
    place = poses[:, :2] @ [[cos, sin], [-sin, cos]] + [100.0, -40.0]
    turned = np.column_stack([place, poses[:, 2] + turn + 4 * math.pi])
    np.testing.assert_allclose(tracked(turned, ground, desired), rows, atol=1e-9)
    across = poses + np.array([0.0, 0.0, math.pi - 0.2 - poses[0, 2]])  # a heading that passes half a turn
    wrapped = across - np.array([0.0, 0.0, 2.0 * math.pi]) * (across[:, 2:] > math.pi)
    assert np.ptp(wrapped[:, 2]) > 6.0
    np.testing.assert_allclose(tracked(wrapped, ground, desired), tracked(across, ground, desired), atol=1e-9)
    mirror = np.array([1.0, -1.0, -1.0])
    flipped = tracked(poses * mirror, ground * mirror, desired * mirror)
    np.testing.assert_allclose(flipped[:, :3], rows[:, :3] * mirror, atol=1e-9)


def test_the_linear_check_refuses_gains_of_too_much_bandwidth():
    for accepted in ({}, {"heading_pm": 12.0, "heading_fastest_ps": 4.0}):  # the bandwidth is what counts
        check_tracking(ROBOT, SETTINGS._replace(**accepted))
    fast = {"heading_pm": 12.0, "heading_fastest_ps": 24.0}, {"cross_pm": 12.0, "cross_fastest_ps": 24.0}
    for refused in (*fast, {"heading_integral_pm2": 60.0}):
        with pytest.raises(ConfigError):
            check_tracking(ROBOT, SETTINGS._replace(**refused))


@pytest.mark.parametrize(
    ("status", "fault"),
    [
        *(
            (TrackStatus.NO_POSE, {"pose": np.array(pose)})
            for pose in ([NAN, 0.0, 0.0], [1.0, 0.0, math.inf])
        ),
        (TrackStatus.NO_POSE, {"ground": np.array([1.0, NAN, 0.0])}),
        *((TrackStatus.UNCERTAIN, {"std": std}) for std in (0.2, NAN)),
        *((TrackStatus.STALE, {"stale_s": stale_s}) for stale_s in (3.1, math.inf)),
        *((TrackStatus.BAD_TIME, {"dt_s": dt_s}) for dt_s in (0.0, -0.02, 0.6, NAN)),
    ],
)
def test_without_a_valid_pose_nothing_is_corrected_and_the_state_is_kept(status, fault):
    twist = np.array(TWISTS["forward"])
    rows, state, pose = drive(twist, np.zeros(3), 200, (0.0, 0.02, 0.02))
    assert rows[-1, 2] > 0.02
    given = {"pose": pose, **fault}
    command, after, report = step(state, twist, given.pop("pose"), **given)
    np.testing.assert_array_equal(command, twist)
    assert report.status == status
    assert math.isnan(report.heading_error_rad)
    for kept, before in zip(after[:5], state[:5], strict=True):
        np.testing.assert_array_equal(kept, before)
    again, _, report = step(after, twist, pose)
    assert report.status == TrackStatus.OK  # a step later the correction is as before
    np.testing.assert_allclose(again, rows[-1, 4:], atol=0.01)
    if status != TrackStatus.BAD_TIME:
        for _ in range(30):
            _, after, _ = step(after, twist, pose, std=1.0)
        _, after, report = step(after, twist, pose + 5.0)  # blind for long: the path starts here
        np.testing.assert_allclose(report[:3], 0.0, atol=1e-12)


def test_a_pose_that_jumps_is_relocalisation_and_gives_no_correction():
    twist = np.array(TWISTS["forward"])
    rows, state, pose = drive(twist, np.zeros(3), 200, (0.0, 0.01, 0.01))
    settled, *_ = step(state, twist, pose)
    for jump in ([0.05, -0.3, 0.0], [0.0, 0.0, 0.3], [0.4, 0.3, -2.5]):
        command, after, report = step(state, twist, pose + np.array(jump), rows[-1, 4:])
        np.testing.assert_allclose(command, settled, atol=2e-3)
        assert report.status == TrackStatus.OK
        back, _, _ = step(after, twist, moved(pose, settled))
        np.testing.assert_allclose(back, settled, atol=4e-3)


def test_a_stop_resets_the_reference_and_a_turn_of_the_path_keeps_the_heading():
    forward, left = np.array([0.8, 0.0, 0.0]), np.array([0.0, 0.8, 0.0])
    _, state, pose = drive(forward, np.zeros(3), 100, (0.0, 0.03, 0.03))
    command, stood, report = step(state, np.zeros(3), pose)
    np.testing.assert_array_equal(command, np.zeros(3))
    assert report.status == TrackStatus.STANDING
    assert stood.integral == (0.0, 0.0, 0.0)
    _, _, report = step(stood, forward, pose)
    np.testing.assert_allclose(report[:3], 0.0, atol=1e-12)
    heading = step(state, forward, pose)[2].heading_error_rad
    _, turned, report = step(state, left, pose)
    assert report.heading_error_rad == pytest.approx(heading, abs=1e-3)
    assert report.cross_track_m == pytest.approx(0.0, abs=1e-12)
    assert abs(heading) > 1e-3
    # still rolling ahead: no cross-track error, as the wheels are being turned
    _, _, report = step(turned, left, moved(pose, forward), forward)
    assert report.cross_track_m == pytest.approx(0.0, abs=1e-12)


def test_corrections_stay_small_and_the_integral_does_not_wind_up():
    twist = np.array([1.0, 0.0, 0.0])
    rows, state, _ = drive(twist, np.zeros(3), 500, (0.0, -0.6, -0.6))
    limit = math.hypot(SETTINGS.heading_max_rad, SETTINGS.cross_max_rad)
    assert rows[:, 2].max() <= limit + 1e-12
    assert (rows[-100:, 3] == TrackStatus.CLAMPED).all()
    assert np.abs(state.integral).max() <= limit
