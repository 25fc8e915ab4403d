"""The adaptive observer of tracked vehicles: how fast and how well it settles, and what it does at faults."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.angles import wrapped
from terrain.estimation.models.observer import ObserverStatus, observe
from terrain.estimation.models.tracked import (
    TrackedObserver,
    TrackedSettings,
    n_parts,
    normalised_gain,
    observe_interval,
)
from terrain.robots import load_robot
from terrain.slip import slip_ratio

ROBOT = load_robot("orchard_ugv")
D = ROBOT.half_track_m
HZ, EVERY = 20, 2
STRAIGHT = (0.6, 0.6), (0.87, 0.87)
CIRCLE = (0.4, 0.6), (1.10, 0.80)
PAPER = TrackedSettings()
NORMALISED = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True)
RAW = {"position_std_m": 0.02, "yaw_std_rad": math.radians(0.5)}


def drive(speeds, eta, duration_s=60.0, rng=None, position_std_m=0.0, yaw_std_rad=0.0, gyro=False):
    """Return times, rows of the observer, true poses (n, 3) and true efficiencies (n, 2) of a drive.

    Speeds and efficiencies are pairs (left, right), of numbers or of arrays (n,); between ticks the robot
    moves along an arc with their means.
    """
    n = round(duration_s * HZ) + 1
    speed, eta = (np.stack([np.broadcast_to(side, n) for side in pair], axis=-1) for pair in (speeds, eta))
    ground = (speed[1:] + speed[:-1]) / 2 * (eta[1:] + eta[:-1]) / 2
    turn = (ground[:, 1] - ground[:, 0]) / (2 * D * HZ)
    yaw = np.r_[0.0, np.cumsum(turn)]
    chord = ground.mean(axis=1) / HZ * np.sinc(turn / (2 * np.pi))
    place = np.r_[0.0, np.cumsum(chord * np.exp(1j * (yaw[:-1] + turn / 2)))]
    pose = np.stack([place.real, place.imag, yaw], axis=-1)
    rows = np.full((n, 6), np.nan)
    rows[:, :2] = speed
    rows[::EVERY, 2:5] = pose[::EVERY]
    if rng is not None:
        noise = rng.standard_normal((len(rows[::EVERY]), 3))
        rows[::EVERY, 2:5] += noise * [position_std_m, position_std_m, yaw_std_rad]
    rows[:, 4] = wrapped(rows[:, 4])  # as a compass shows it
    if gyro:
        rows[:, 5] = (eta[:, 1] * speed[:, 1] - eta[:, 0] * speed[:, 0]) / (2 * D)
    return np.arange(n) / HZ, rows, pose, eta


def efficiencies(track):
    return np.stack([track.state("eta_left_ratio"), track.state("eta_right_ratio")], axis=-1)


def track_of(time_s, rows, settings=PAPER):
    return observe(TrackedObserver(ROBOT, settings), time_s, rows)


@pytest.mark.parametrize(("drive_of", "bars_s"), [(STRAIGHT, (7, 11)), (CIRCLE, (4, 8))])
@pytest.mark.parametrize("gyro", [False, True])
def test_it_settles_with_the_gains_of_the_paper(drive_of, bars_s, gyro):
    time_s, rows, _, eta = drive(*drive_of, gyro=gyro)
    track = track_of(time_s, rows)
    found = efficiencies(track)
    for ratio, bar_s in zip((0.05, 0.02), bars_s, strict=True):
        settles = np.flatnonzero((abs(found - eta) > ratio * eta).any(axis=1))[-1] + 1
        assert time_s[settles] <= bar_s
    np.testing.assert_allclose(found[-1], eta[-1], atol=2e-4)
    # excitation is the smallest eigenvalue of M'M, forgotten with the time constant of (14)
    m = regressor(0.0, *drive_of[0])
    least, excitation = np.linalg.eigvalsh(m.T @ m)[0], track.state("excitation_mps")
    assert excitation[-1] ** 2 == pytest.approx(least, rel=1e-3)
    assert excitation[2 * HZ] ** 2 == pytest.approx(least * -math.expm1(-2 / 5), rel=2e-2)


@pytest.mark.parametrize(("settings", "drive_of"), [(PAPER, STRAIGHT), (NORMALISED, CIRCLE)])
def test_errors_are_as_large_as_stated(settings, drive_of):
    """Squared errors of pose and efficiencies, normalised by their covariance, average to 1."""
    squares, rng = [], np.random.default_rng(0)
    for _ in range(12):
        observer = TrackedObserver(ROBOT, settings._replace(eta_std_ratio=0.05))
        walk = settings.eta_walk_ratio / math.sqrt(HZ) * rng.standard_normal((2, 40 * HZ + 1))
        true = np.array(drive_of[1])[:, None] + 0.05 * rng.standard_normal((2, 1)) + np.cumsum(walk, axis=1)
        _, rows, pose, eta = drive(drive_of[0], tuple(true), 40.0, rng, **RAW)
        for k, row in enumerate(rows):
            estimate = observer.step(row, 1 / HZ).mean
            if k > 25 * HZ and k % (2 * HZ) == 0:
                off = np.r_[pose[k] - estimate[:3], eta[k] - estimate[5:7]]
                off[2] = wrapped(off[2])
                squares.append(off @ np.linalg.solve(observer.cov, off) / 5)
    # 12 runs, each at least two independent errors of 5 numbers: 3 * sqrt(2 / 120)
    assert abs(np.mean(squares) - 1) < 0.39


@pytest.mark.parametrize(("speeds", "eta"), [((-0.6, -0.5), (0.9, 0.8)), ((-0.4, 0.4), (0.7, 0.9))])
def test_reversed_motion_and_spin_in_place(speeds, eta):
    time_s, rows, pose, _ = drive(speeds, eta, 120.0)
    track = track_of(time_s, rows)
    np.testing.assert_allclose(efficiencies(track)[-1], eta, atol=2e-3)
    np.testing.assert_allclose(
        track.slip[-1], slip_ratio(np.array(speeds), np.array(eta) * speeds), atol=2e-3
    )
    assert abs(wrapped(track.state("yaw_rad")[-1] - pose[-1, 2])) < 0.01
    assert track.status[-1] == ObserverStatus.OK


@pytest.mark.parametrize("gyro", [False, True])
def test_missing_fixes_are_dead_reckoning_and_long_ones_begin_the_pose_anew(gyro):
    time_s, rows, pose, _ = drive(*CIRCLE, 80.0, gyro=gyro)
    for start_s, end_s in ((50, 51.5), (60, 70)):
        rows[(time_s > start_s) & (time_s < end_s), 2:5] = np.nan
    track = track_of(time_s, rows)
    found, gap = efficiencies(track), (time_s > 60.6) & (time_s < 70)
    assert (track.status[gap] == ObserverStatus.PREDICTED).all()
    assert (found[gap] == found[gap][0]).all()
    assert time_s[track.status == ObserverStatus.RESET].min() == 70
    off = np.hypot(*(track.mean[:, :2] - pose[:, :2]).T)
    assert off[gap].max() < 0.02
    assert (off[gap] < 3 * track.std[gap, :2].max(axis=1)).all()
    np.testing.assert_allclose(found[-1], CIRCLE[1], atol=1e-3)


def test_standing_for_minutes_nothing_drifts():
    rng = np.random.default_rng(0)
    driven, observer = drive(*STRAIGHT, 30.0, rng, **RAW), TrackedObserver(ROBOT, PAPER)
    for row in driven[1]:
        observer.step(row, 1 / HZ)
    place, rows = driven[2][-1], np.full((2000, 6), np.nan)
    rows[:, :2] = rng.normal(scale=0.004, size=(len(rows), 2))  # encoders that flicker
    rows[:, 2:5] = place + rng.normal(size=(len(rows), 3)) * [0.02, 0.02, 0.009]
    rows[:, 5] = 0.005 + rng.normal(scale=0.002, size=len(rows))  # a gyro with a bias
    outputs = [observer.step(row, 0.1) for row in rows]
    before, after = outputs[1], outputs[-1]  # the interval in which it stopped has passed
    assert {output.status for output in outputs} <= {ObserverStatus.STANDING, ObserverStatus.REJECTED}
    np.testing.assert_array_equal(after.slip, before.slip)
    assert (after.slip_std <= before.slip_std).all()
    assert (abs(after.mean[:3] - place) < 4 * after.std[:3]).all()


def test_a_track_that_stands_keeps_its_efficiency_and_a_robot_pushed_on_both_is_named():
    n = 60 * HZ + 1
    left = np.where(np.arange(n) < 40 * HZ, 0.5, 0.0)
    time_s, rows, *_ = drive((left, 0.5), (0.9, 0.8), 60.0)
    track = track_of(time_s, rows, NORMALISED)
    found = efficiencies(track)[41 * HZ :]
    assert (track.status[41 * HZ :] == ObserverStatus.UNEXCITED).all()
    assert (found[:, 0] == found[0, 0]).all()
    np.testing.assert_allclose(found[-1], [0.9, 0.8], atol=2e-3)
    assert (np.diff(track.slip_std[41 * HZ :, 0]) >= 0).all()
    assert track.state("excitation_mps")[-1] < 0.1 < track.state("excitation_mps")[39 * HZ]
    time_s, rows, *_ = drive(*STRAIGHT, 10.0, gyro=True)
    rows[5 * HZ :, :2], rows[5 * HZ :, 2:5], rows[5 * HZ :, 5] = 0.0, np.nan, 0.2
    assert (track_of(time_s, rows).status[5 * HZ + 1 :] == ObserverStatus.PUSHED).all()


def test_ticks_without_speeds_and_pauses_lose_no_travel_that_is_known():
    time_s, rows, *_ = drive(*CIRCLE, 60.0)
    rows[(np.arange(len(rows)) % 7) == 3, 0] = np.nan
    track = track_of(time_s, rows)
    np.testing.assert_array_equal(track.status == ObserverStatus.BAD_INPUT, np.isnan(rows[:, 0]))
    np.testing.assert_allclose(efficiencies(track)[-1], CIRCLE[1], atol=2e-3)
    kept = (time_s < 30) | (time_s >= 35)
    paused = track_of(time_s[kept], rows[kept])
    assert (paused.status == ObserverStatus.RESET).sum() == 1
    np.testing.assert_allclose(efficiencies(paused)[-1], CIRCLE[1], atol=2e-3)


# -- the interval between two fixes ---------------------------------------------------------------------------------


def regressor(yaw, left, right):
    """M (3, 2) of (8)."""
    cos, sin, half = 0.5 * math.cos(yaw), 0.5 * math.sin(yaw), 0.5 / D
    return np.array([[cos, cos], [sin, sin], [-half, half]]) * [left, right]


def lyapunov(error, eta_error, adaptation):
    """V, corrected: above (13) the paper prints e' L^-1 e."""
    return 0.5 * (error @ error + eta_error @ np.linalg.solve(adaptation, eta_error))


def random_case(rng, normalised=False):
    span = 10 ** rng.uniform(-2, 1)
    travel, gain = span * regressor(rng.uniform(-4, 4), *rng.uniform(-3, 3, 2)), 10 ** rng.uniform(-1, 1.5, 3)
    if normalised:
        return travel, span, gain, normalised_gain(travel, span, gain, 1e-3)
    return travel, span, gain, np.diag(10 ** rng.uniform(-2, 2, 2))


@pytest.mark.parametrize("normalised", [False, True])
def test_the_lyapunov_function_never_grows(normalised):
    rng, n_whole = np.random.default_rng(0), 0
    for _ in range(300):
        travel, span, gain, adaptation = random_case(rng, normalised)
        error, eta, true = rng.normal(size=3), rng.uniform(0, 2, 2), rng.uniform(0, 2, 2)
        after, eta_after, *_ = observe_interval(travel, span, gain, adaptation, error, eta, travel @ true)
        before_v = lyapunov(error, eta - true, adaptation)
        after_v = lyapunov(after, eta_after - true, adaptation)
        assert after_v <= before_v * (1 + 1e-9)
        if n_parts(travel, span, gain, adaptation) == 1 and not normalised:
            n_whole, middle = n_whole + 1, (error + after) / 2
            fall = -span * middle @ (gain * middle)
            assert abs(after_v - before_v - fall) < 1e-12 * before_v + 1e-14
    assert normalised or n_whole > 10


def test_maps_of_the_errors_are_derivatives_of_the_step():
    rng = np.random.default_rng(3)
    for _ in range(50):
        travel, span, gain, adaptation = random_case(rng)
        true = rng.uniform(0, 2, 2)

        def errors(x, start, end, travel=travel, span=span, gain=gain, adaptation=adaptation, true=true):
            """Errors after an interval from those before it and the noise of its two fixes."""
            moved = travel @ true + end - start
            after = observe_interval(travel, span, gain, adaptation, x[:3] + start, true - x[3:], moved)
            return np.r_[after[0] - end, true - after[1]]

        x, start, end = rng.normal(size=5), rng.normal(size=3), rng.normal(size=3)
        *_, whole, from_start, from_end = observe_interval(
            travel, span, gain, adaptation, np.zeros(3), true, travel @ true
        )
        expected = whole @ x + from_start @ start + from_end @ end
        np.testing.assert_allclose(errors(x, start, end), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("gains", [(np.ones(3), np.eye(2)), (np.array([2.0, 2.0, 5.0]), np.diag([4.0, 1.0]))])
@pytest.mark.parametrize("span", [0.1, 1.0])
def test_it_is_the_continuous_observer(gains, span):
    left, right, true = 0.4, 0.6, np.array([1.1, 0.8])
    gain, adaptation = gains
    turn = regressor(0.0, left, right)[2] @ true

    def rate(time, x):
        m = regressor(turn * time, left, right)
        return np.r_[m @ (true - x[3:]) - gain * x[:3], adaptation @ m.T @ x[:3]]

    times = np.arange(0.0, 10.0 + span / 2, span)
    right_one = solve_ivp(rate, (0, times[-1]), [0, 0, 0, 1, 1], t_eval=times, rtol=1e-9, atol=1e-11).y[3:].T
    error, eta, found = np.zeros(3), np.ones(2), [np.ones(2)]
    for start in times[:-1]:
        nodes, weights = np.polynomial.legendre.leggauss(5)
        at = start + 0.5 * span * (1 + nodes)
        travel = (
            0.5 * span * sum(w * regressor(turn * t, left, right) for t, w in zip(at, weights, strict=True))
        )
        error, eta, *_ = observe_interval(travel, span, gain, adaptation, error, eta, travel @ true)
        found.append(eta)
    np.testing.assert_allclose(found, right_one, atol=4e-4 if span == 0.1 else 4e-3)


def test_the_normalised_gain_damps_critically_at_every_speed():
    gain = np.array([2.0, 2.0, 3.0])
    for speeds in ((0.3, 0.3), (1.0, 1.0), (0.4, 0.6), (-0.5, 0.5)):
        m = regressor(0.0, *speeds)
        adaptation = normalised_gain(0.1 * m, 0.1, gain, 0.0)
        rates = np.linalg.eigvals(np.block([[-np.diag(gain), -m], [adaptation @ m.T, np.zeros((2, 2))]]))
        np.testing.assert_allclose(np.sort(rates.real), [-2.0, -1.5, -1.5, -1.0, -1.0], atol=1e-6)
