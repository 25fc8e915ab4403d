"""Slip-compensated odometry, and those it is compared with: integration, uncertainty, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.errors import ConfigError
from terrain.estimation.observers.family import ObserverStatus, observe
from terrain.estimation.observers.plain_odometry import (
    encoder_odometry_observer,
    endo_odometry_observer,
    gyrodometry_observer,
)
from terrain.estimation.observers.slip_learning import slip_learning_observer
from terrain.estimation.observers.slip_model import N_MODEL, N_PARAMETERS, SlipModel, body_velocity, model_of
from terrain.estimation.observers.slip_odometry import ROWS, OdometrySettings, slip_odometry_observer
from terrain.robots import load_robot
from terrain.simulation.tracked import QUIET, PrescribedSlip, Slope, simulate_tracked

ROBOT = load_robot("patako")
D = ROBOT.half_track_m
MODEL = SlipModel(
    *(0.8, 0.05, 0.4, 0.3, 0.5),
    angle=np.array([0.05, 0.3, 0.2, -0.1, -1.2, -0.4, 0.05, 0.1]),
    track_ratio=1.5,
    turn_side_m=0.2,
    turn_shift_m=0.15,
)
OBSERVERS = {
    "slip": slip_odometry_observer(ROBOT, MODEL),
    "encoder": encoder_odometry_observer(ROBOT),
    "gyro": gyrodometry_observer(ROBOT),
    "endo": endo_odometry_observer(ROBOT, 0.85),
    "learning": slip_learning_observer(ROBOT),
}
NOISELESS = OdometrySettings(gyro_noise_radps=0.0, gyro_bias_std_radps=0.0, encoder_noise_mps=0.0)


def drive(time_s):
    """Rows of a drive from straight into a spin and back, on a slope that tilts."""
    turn = 0.09 * np.sin(0.5 * time_s) ** 3
    left, right = 0.05 - turn, 0.05 + turn
    w = 0.6 * (right - left) / (2 * D)
    return np.stack([left, right, w, 0.1 * np.cos(0.3 * time_s), -0.1 * np.sin(0.3 * time_s)], axis=-1)


def final(observer, time_s, rows):
    return observe(observer, time_s, rows).mean[-1]


def test_the_pose_is_the_integral_of_5_to_7():
    model = replace(MODEL, angle=np.where(np.arange(8) == 6, 0.0, MODEL.angle))  # without memory of the turn
    theta = np.concatenate([model.vector, np.zeros(N_PARAMETERS - N_MODEL)])
    slopes = np.empty((2, N_PARAMETERS))

    def rate(t, pose):
        left, right, w, roll, pitch = drive(t)
        v_x, v_y, _, _ = body_velocity(theta, D, (left, right), w, (roll, pitch), 0.0, slopes)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return [v_x * cos - v_y * sin, v_x * sin + v_y * cos, w]

    expected = solve_ivp(rate, (0, 10), [0, 0, 0], rtol=1e-9, atol=1e-12).y[:, -1]
    errors = []
    for n in (500, 1000):
        time_s = np.linspace(0, 10, n + 1)
        middle = np.concatenate([time_s[:1], 0.5 * (time_s[1:] + time_s[:-1])])
        errors.append(
            np.abs(final(slip_odometry_observer(ROBOT, model), time_s, drive(middle))[:3] - expected)
        )
    assert errors[1].max() < 2e-5
    assert errors[1].max() < 0.3 * errors[0].max()  # of second order


def test_a_steady_turn_is_exact_in_one_step():
    row = np.array([-0.02, 0.12, 0.4, 0.0, 0.0])
    once = final(OBSERVERS["slip"], np.array([0.0, 1.0]), np.stack([row, row]))
    angle_only = replace(MODEL, angle=np.zeros(8))
    observer = slip_odometry_observer(ROBOT, angle_only)
    many = final(observer, np.linspace(0, 1, 1001), np.tile(row, (1001, 1)))
    assert final(observer, np.array([0.0, 1.0]), np.stack([row, row]))[:3] == pytest.approx(
        many[:3], abs=1e-12
    )
    assert once[2] == pytest.approx(0.4)


@pytest.mark.parametrize("slope", [Slope(), Slope(0.15, np.pi / 2), Slope(0.15, 0.3)])
def test_given_slip_is_followed_to_the_millimetre(slope):
    given = PrescribedSlip(1.0, 1.0, 0.1, 0.3, 0.4, 0.35, 0.8)
    belts = np.tile([0.08, 0.1], (700, 1))
    belts[300:] = (0.1, 0.1)
    run = simulate_tracked(ROBOT, given, belts, 0, slope=slope, sensors=QUIET)
    truth = run.streams["truth"]
    rows = np.stack(
        [*belts[:-1].T, *(truth.channel(c)[::2][:-1] for c in ("yaw_rate_radps", "roll_rad", "pitch_rad"))],
        axis=1,
    )
    model = SlipModel(0.8, 0.1, 0.3, 0.0, 0.4, angle=np.array([0, 0, 0, 0, -0.4, 0, 0, 0]))
    found = observe(slip_odometry_observer(ROBOT, model), np.arange(699) / 50, rows)
    pose = run.streams["pose"].values[::2][:699]
    assert np.hypot(*(found.mean[:, :2] - pose[:, :2]).T).max() < 0.002
    for name in ("slip_left_ratio", "slip_right_ratio"):
        slip = found.slip[:, found.slips.index(name)]
        assert slip[50:] == pytest.approx(truth.channel(name)[::2][50:699], abs=0.01)


def test_the_covariance_is_that_of_many_models():
    rng = np.random.default_rng(1)
    std = np.array([0.02, 0.01, 0.03, 0.02, 0.04, 0.02, 0.02, *np.full(8, 0.02), 0.05])
    model = replace(MODEL, covariance=np.diag(std**2))
    time_s = np.arange(0, 8, 0.05)
    rows = drive(time_s)
    stated = observe(slip_odometry_observer(ROBOT, model, NOISELESS), time_s, rows).std[-1, :3]
    ends = [
        final(slip_odometry_observer(ROBOT, model_of(rng.normal(MODEL.vector, std)), NOISELESS), time_s, rows)
        for _ in range(300)
    ]
    scatter = np.std(ends, axis=0)[:2]
    assert stated[:2] == pytest.approx(scatter, rel=4 / np.sqrt(2 * 300))
    assert stated[2] == pytest.approx(0.0, abs=1e-9)


def test_the_covariance_holds_the_noise_of_gyro_and_encoders():
    rng = np.random.default_rng(2)
    settings = OdometrySettings(gyro_noise_radps=0.01, gyro_bias_std_radps=0.002, encoder_noise_mps=0.01)
    observer = slip_odometry_observer(ROBOT, SlipModel(), settings)
    time_s = np.arange(0, 10, 0.02)
    rows = np.tile([0.2, 0.2, 0.0, 0.0, 0.0], (len(time_s), 1))
    stated = observe(observer, time_s, rows).std[-1, :3]
    ends = []
    for _ in range(300):
        noisy = rows.copy()
        noisy[:, :2] += 0.01 * rng.standard_normal((len(rows), 2))
        noisy[:, 2] += 0.01 * rng.standard_normal(len(rows)) + 0.002 * rng.standard_normal()
        ends.append(final(observer, time_s, noisy)[:3])
    assert stated == pytest.approx(np.std(ends, axis=0), rel=4 / np.sqrt(2 * 300))


def test_without_a_gyro_the_tracks_turn_over_their_effective_distance():
    time_s = np.arange(0, 5, 0.02)
    row = np.array([0.02, 0.08, np.nan, 0.0, 0.0])
    rows = np.tile(row, (len(time_s), 1))
    yaw = final(OBSERVERS["slip"], time_s, rows)[2]
    assert yaw == pytest.approx(0.06 / (2 * D * 1.5) * time_s[-1])
    assert final(encoder_odometry_observer(ROBOT, track_ratio=1.5), time_s, rows)[2] == pytest.approx(yaw)


def test_gyrodometry_takes_the_gyro_where_the_two_disagree():
    time_s = np.arange(0, 5, 0.02)
    by_track = 0.06 / (2 * D)
    for gyro, expected in ((by_track + 0.005, by_track), (0.6 * by_track, 0.6 * by_track)):
        rows = np.tile([0.02, 0.08, gyro, 0.0, 0.0], (len(time_s), 1))
        found = final(OBSERVERS["gyro"], time_s, rows)
        assert found[2] == pytest.approx(expected * time_s[-1])
        assert found[3:5] == pytest.approx([0.05, 0.0])
        assert final(OBSERVERS["encoder"], time_s, rows)[2] == pytest.approx(by_track * time_s[-1])


def test_statuses():
    observer = OBSERVERS["slip"]
    moving = np.array([0.05, 0.1, 0.1, 0.02, 0.01])
    memory = observer.step(observer.params, observer.start, moving, 0.02)
    for changes, dt_s, status in [
        ({}, 0.02, "OK"),
        ({0: 0.0, 1: 0.0, 2: 0.001}, 0.02, "STANDING"),
        ({0: 0.0, 1: 0.0, 2: 0.5}, 0.02, "PUSHED"),
        ({2: 1e6}, 0.02, "REJECTED"),
        ({3: np.nan}, 0.02, "PREDICTED"),
        ({4: 7.0}, 0.02, "PREDICTED"),
        ({0: np.nan}, 0.02, "BAD_INPUT"),
        ({1: np.inf}, 0.02, "BAD_INPUT"),
        ({}, -0.1, "BAD_INPUT"),
        ({}, np.nan, "BAD_INPUT"),
        ({}, 60.0, "BAD_INPUT"),
    ]:
        row = moving.copy()
        for place, value in changes.items():
            row[place] = value
        after = observer.step(observer.params, memory, row, dt_s)
        found = observer.read(observer.params, after)
        assert ObserverStatus(found.status).name == status
        if status in ("STANDING", "PUSHED"):
            assert (found.mean[:2] == memory[:2]).all()
            assert np.isnan(found.slip).all()
            assert (found.mean[2] > memory[2]) == (status == "PUSHED")
        if status == "BAD_INPUT":
            assert (found.mean == observer.read(observer.params, memory).mean).all()


@pytest.mark.parametrize("name", ["slip", "learning"])
def test_where_tracks_are_not_measured_the_pose_is_less_certain_by_what_was_driven(name):
    observer, moving = OBSERVERS[name], np.zeros(len(OBSERVERS[name].rows))
    moving[:3] = 0.5, 0.7, 0.3
    if name == "learning":
        moving[5:] = np.nan
        moving = np.where(np.isnan(moving), 0.0, moving)
    memory = observer.step(observer.params, observer.start, moving, 0.0)
    before = observer.read(observer.params, memory)
    blind = np.where(np.arange(len(moving)) < 2, np.nan, moving)
    for missing, steps in ((moving, 1), (blind, 100)):
        after = memory
        for _ in range(steps):
            after = observer.step(observer.params, after, missing, 3.0 / steps)
        found = observer.read(observer.params, after)
        assert found.std[:2] - before.std[:2] == pytest.approx(3.0 * 0.7)
        assert found.std[2] == pytest.approx(np.pi)
        assert (found.mean == before.mean).all() or name == "learning"


@pytest.mark.parametrize("name", OBSERVERS)
def test_any_input_leaves_a_finite_memory(name):
    observer, rng = OBSERVERS[name], np.random.default_rng(4)
    strange = np.array([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e300, 5.0, -0.03, 1e-300])
    memory = observer.start
    for k in range(3000):
        row = 0.1 * rng.standard_normal(len(observer.rows))
        hit = rng.random(len(row)) < 0.2
        row[hit] = rng.choice(strange, hit.sum())
        before = np.array(memory)
        memory = observer.step(observer.params, memory, row, float(rng.choice([0.02, 0.02, 0.0, *strange])))
        assert np.isfinite(memory).all(), (k, row)
        assert not np.shares_memory(before, memory)
        found = observer.read(observer.params, memory)
        assert np.isfinite(found.std[:6]).all()
        assert len(found.mean) == len(found.std) == len(observer.states)
        assert len(found.slip) == len(found.slip_std) == len(observer.slips)
        ObserverStatus(found.status)


def test_settings_are_checked():
    with pytest.raises(ConfigError, match="stand_mps is 0"):
        slip_odometry_observer(ROBOT, MODEL, OdometrySettings(stand_mps=0.0))
    with pytest.raises(ConfigError, match="gyro_noise_radps is nan"):
        slip_odometry_observer(ROBOT, MODEL, OdometrySettings(gyro_noise_radps=np.nan))
    assert OBSERVERS["slip"].rows == ROWS
