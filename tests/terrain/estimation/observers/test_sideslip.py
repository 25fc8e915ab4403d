"""Observers of sideslip: their equations, their gains, recovery of hidden truth, and sensor faults."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.linalg import expm

from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.observers import sideslip_pose as pose
from terrain.estimation.observers.family import ObserverStatus, observe
from terrain.estimation.observers.sideslip_dynamic import DynamicSettings, sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_forces import rates, rates_by_force
from terrain.estimation.observers.sideslip_kinematic import sideslip_kinematic_observer
from terrain.estimation.observers.sideslip_multi import (
    SECTION_VI,
    MultiModelSettings,
    sideslip_multi_observer,
)
from terrain.robots import load_robot
from terrain.simulation.car import (
    CAR_ROWS,
    CarCommand,
    CarDrive,
    SensorNoise,
    SpeedProfile,
    level_ground,
    simulate_car,
)

ROBOT = load_robot("adap2e")
FACTORIES = {
    "kinematic": sideslip_kinematic_observer,
    "dynamic": sideslip_dynamic_observer,
    "multi": sideslip_multi_observer,
}
ANY = pytest.mark.parametrize("factory", FACTORIES.values(), ids=FACTORIES)
TICK_S = 0.02


@functools.cache
def drive(speed_mps=5.0, seed=0, roll_rad=0.0, stops=(), noise=SensorNoise(), seconds=30.0):  # noqa: B008
    """Return times (n,), rows (n, 8) and a function that gives a channel of the truth at the ticks."""
    time_s = np.arange(0.0, 60.0, 4.0)
    angles = np.array([0, 0.1, 0.14, 0.05, -0.1, -0.15, -0.15, 0.0, 0.12, 0.12, -0.1, 0, 0.15, 0.05, 0])
    rows = []

    def controller(sample):
        rows.append(sample.measured)
        return CarCommand(float(np.interp(sample.time_s, time_s, angles)), sample.speed_desired_mps)

    car = CarDrive(level_ground(0.7, roll_rad), SpeedProfile(speed_mps, stops), seconds)
    truth = simulate_car(ROBOT, car, controller, np.random.default_rng(seed), noise).streams["truth"]
    return np.arange(len(rows)) * TICK_S, np.array(rows), lambda name: truth.channel(name)[::2]


def true_slips(truth):
    return np.column_stack([truth("slip_front_rad"), truth("slip_rear_rad")])


def true_stiffness(truth):
    forces = np.column_stack([truth("side_front_n"), truth("side_rear_n")])
    with np.errstate(divide="ignore", invalid="ignore"):
        return -forces / true_slips(truth)


def test_rows_are_those_of_the_simulated_car():
    assert pose.SIDESLIP_ROWS == CAR_ROWS


@pytest.mark.parametrize("speed", [0.0, 1e-4, 0.5, 3.0, 8.0])
@pytest.mark.parametrize("ratio", [0.5, 4.0, 400.0])
def test_gains_of_a_fix_give_the_sampled_error_the_continuous_poles(speed, ratio):
    gain, time_s = 15.0, 0.1
    jacobian = speed * np.array([[0.0, 1.0], [0.9, -0.85]])
    g_e, g_b = pose.fix_gains(jacobian, gain, ratio, time_s)
    moved = np.eye(4)
    moved[:2, 2:] = time_s * jacobian
    kept = np.eye(4)
    kept[:2, :2] -= g_e * np.eye(2)
    kept[2:, :2] = -g_b
    continuous = np.block([[-gain * np.eye(2), jacobian], [-ratio * jacobian.T, np.zeros((2, 2))]])
    expected = np.linalg.eigvals(expm(continuous * time_s))
    found = np.linalg.eigvals(kept @ moved)
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), abs=1e-5)
    assert np.abs(found).max() <= 1.0 + 1e-9


@pytest.mark.parametrize("multi", [False, True], ids=["(5)", "(8)"])
def test_on_a_straight_path_the_observer_is_the_papers(multi):
    """(5), (6) and (8), (9) with deviations y, theta~ of the path y = 0, integrated at 1 ms without noise."""
    dt_s, speed, steer, gain, ratio, dyn_ratio, k_c = 0.001, 3.0, 0.02, 15.0, 4.0, 1e-2, 5e9
    base, arm, slips = ROBOT.wheelbase_m, ROBOT.com_ahead_m, np.array([-0.03, 0.04])
    time_s = np.arange(3000) * dt_s
    turning = speed * (np.tan(steer + slips[0]) - np.tan(slips[1])) / base
    yaw = turning * time_s
    along = speed / np.cos(slips[1])  # v of the paper: u = v cos b_R is measured
    x = np.cumsum(along * np.cos(yaw + slips[1])) * dt_s
    y = np.cumsum(along * np.sin(yaw + slips[1])) * dt_s
    nan = np.full(time_s.size, np.nan)
    rows = np.column_stack([nan, nan, x, y, yaw, nan, nan, nan])
    rows[:, :2], rows[:, 5:7] = (speed, steer), (turning, 0.0)
    fixes = pose.PoseSettings(slip_gain=ratio)
    observer = sideslip_kinematic_observer(ROBOT, fixes)
    if multi:
        settings = MultiModelSettings(fixes, 20.0, k_c, dyn_ratio, excited_mps2=0.0, instrument=False)
        observer = sideslip_multi_observer(ROBOT, settings)
    track = observe(observer, time_s, rows)
    dev, slip, paper = np.array([y[0], yaw[0]]), np.zeros(2), np.full((time_s.size, 4), np.nan)
    dyn, stiffness, cos = np.zeros(2), np.full(2, 15000.0), np.cos(steer)
    axles = np.array([[-arm * cos / ROBOT.yaw_inertia_kgm2, arm / ROBOT.yaw_inertia_kgm2], [0.0, 0.0]])
    axles[1] = -cos / ROBOT.mass_kg, -1.0 / ROBOT.mass_kg
    for k in range(1, time_s.size):
        v = speed / np.cos(slip[1])
        error = np.array([y[k], yaw[k]]) - dev
        f = [
            v * np.sin(yaw[k] + slip[1]),
            v * np.cos(slip[1]) * (np.tan(steer + slip[0]) - np.tan(slip[1])) / base,
        ]
        jacobian = np.array(
            [
                [0.0, v * np.cos(yaw[k] + slip[1])],
                [speed / base / np.cos(steer + slip[0]) ** 2, -speed / base / np.cos(slip[1]) ** 2],
            ]
        )
        dev = dev + dt_s * (np.array(f) + gain * error)
        change = ratio * jacobian.T @ error
        if multi:
            beta = np.arctan((arm * np.tan(slip[0] + steer) + arm * np.tan(slip[1])) / base)  # (4)
            virtual = v * np.cos(slip[1]) / np.cos(beta) * np.sin(beta)
            g = axles @ (stiffness * slip) - np.array([0.0, speed * turning])
            error = np.array([turning, virtual]) - dyn
            dyn = dyn + dt_s * (g + 20.0 * error)
            change = change + dyn_ratio * (axles * stiffness).T @ error
            stiffness = np.clip(stiffness + dt_s * k_c * (axles * slip).T @ error, 1000.0, 30000.0)
        slip = slip + dt_s * change
        paper[k] = *slip, *stiffness
    assert track.slip[500:] == pytest.approx(paper[500:, :2], abs=0.003)
    if multi:
        assert track.mean[500:, 5:7] == pytest.approx(paper[500:, 2:], rel=0.03)
        assert np.ptp(paper[1:, 2:], axis=0).min() > 1000.0
    else:
        assert track.slip[-1] == pytest.approx(slips, abs=0.003)


def test_jacobians_are_the_derivatives():
    observer = sideslip_multi_observer(ROBOT)
    slips, stiffness, step = np.array([0.05, -0.04]), np.array([9000.0, 12000.0]), 1e-6
    params, by_force = observer.params, rates_by_force(observer.params, 0.1)
    for j in range(2):
        more = slips + step * np.eye(2)[j]
        change = np.subtract(
            rates(params, 4.0, 0.1, 0.2, 0.3, more, stiffness),
            rates(params, 4.0, 0.1, 0.2, 0.3, slips, stiffness),
        )
        assert change / step == pytest.approx(by_force[:, j] * stiffness[j], rel=1e-6)
    for speed in (3.0, -2.0):
        at = pose.slip_jacobian(params, speed, 0.1, *slips)
        for j in range(2):
            low, high = (slips + s * step * np.eye(2)[j] for s in (-1, 1))
            change = [pose.yaw_rate_of(params, speed, 0.1, *each) for each in (low, high)]
            assert np.diff(change)[0] / (2 * step) == pytest.approx(at[1, j], rel=1e-6)


def plain_fix(row, at, slip, left, since, speed, ratio, gain=15.0):
    """One fix in plain numpy: eigenvectors in place of closed forms, no gates."""
    base, (steer, rear) = ROBOT.wheelbase_m, (row[1], 1 / np.cos(slip[1]) ** 2)
    jacobian = speed * np.array([[0, rear], [1 / base / np.cos(steer + slip[0]) ** 2, -rear / base]])
    heading = at[2] + left
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    along, across = turn @ (row[2:4] - at[:2])
    error = np.array([across, wrapped(row[4] - at[2])])
    squares, vectors = np.linalg.eigh(jacobian @ jacobian.T)
    h = []
    for square in squares:
        poles = np.exp(np.roots([1, gain, ratio * square]).astype(complex) * since)
        exact = ((1 - poles[0]) * (1 - poles[1])).real / max(square * since, 1e-300)
        h.append(exact if square > 1e-8 else ratio * (1 - np.exp(-gain * since)) / gain)
    g_e = 1 - np.exp(-gain * since)
    slip = slip + jacobian.T @ vectors @ np.diag(h) @ vectors.T @ error
    moved = np.array([*(at[:2] + g_e * turn.T @ [along, across]), at[2] + g_e * error[1]])
    return moved, slip, (1 - g_e) * error[1]


def plain_dynamics(row, dyn, slip, stiffness, settings):
    """One tick of e_dyn in plain numpy, for forward motion: (8), (9) with the implicit gains."""
    u, steer, rate, roll, dt_s = row[0], row[1], row[5], row[6], TICK_S
    ahead, behind, base = ROBOT.com_ahead_m, ROBOT.com_behind_front_m, ROBOT.wheelbase_m
    mass, inertia = ROBOT.mass_kg, ROBOT.yaw_inertia_kgm2
    axles = np.array([[-behind * np.cos(steer), ahead], [-np.cos(steer), -1.0]])
    by_force = axles / np.array([[inertia], [mass]])
    force = u * rate + 9.80665 * np.sin(roll)
    held = -mass / base * force * np.array([ahead / np.cos(steer), behind]) / stiffness
    by_slip = by_force * stiffness
    by_stiffness = by_force * held * float(abs(force) > settings.excited_mps2)
    dyn = dyn + dt_s * (by_force @ (stiffness * slip) - np.array([0.0, force]))
    side = u * (ahead * np.tan(steer + slip[0]) + behind * np.tan(slip[1])) / base
    ratio, k_c, k = settings.dynamic_slip_ratio, settings.stiffness_gain, settings.dynamic_gain_ps
    spread = ratio * by_slip @ by_slip.T + k_c * by_stiffness @ by_stiffness.T
    error = np.linalg.solve((1 + dt_s * k) * np.eye(2) + dt_s**2 * spread, np.array([rate, side]) - dyn)
    dyn, slip = dyn + dt_s * k * error, slip + dt_s * ratio * by_slip.T @ error
    return dyn, slip, np.clip(stiffness + dt_s * k_c * by_stiffness.T @ error, 1000.0, 30000.0)


def plain(rows, settings=None):
    """The kinematic observer, and with settings the multi-model one, in plain numpy."""
    base, dt_s = ROBOT.wheelbase_m, TICK_S
    at, slip, left, since, out = rows[0, 2:5].copy(), np.zeros(2), 0.0, 0.0, []
    dyn, stiffness, ratio = np.zeros(2), np.full(2, 15000.0), pose.PoseSettings().slip_gain
    for row in rows[1:]:
        u, steer = row[:2]
        speed = u if abs(u) >= pose.STANDING_MPS else 0.0
        turning = speed * (np.tan(steer + slip[0]) - np.tan(slip[1])) / base
        middle, side = at[2] + left + 0.5 * dt_s * turning, speed * np.tan(slip[1])
        at[0] += dt_s * (speed * np.cos(middle) - side * np.sin(middle))
        at[1] += dt_s * (speed * np.sin(middle) + side * np.cos(middle))
        at[2] += dt_s * turning
        since += dt_s
        if settings is not None and u >= 0.3:
            dyn, slip, stiffness = plain_dynamics(row, dyn, slip, stiffness, settings)
        elif settings is not None:
            v = u * (ROBOT.com_ahead_m * np.tan(steer + slip[0]) + ROBOT.com_behind_front_m * np.tan(slip[1]))
            dyn = np.array([row[5], v / base if abs(u) >= pose.STANDING_MPS else 0.0])
        if np.isfinite(row[2]):
            at, slip, left = plain_fix(row, at, slip, left, since, speed, ratio)
            since = 0.0
        out.append([*slip, *stiffness])
    return np.array(out)


def test_kinematic_and_multi_model_steps_agree_with_their_plain_form():
    time_s, rows, _ = drive(4.0, seed=3, roll_rad=0.1, stops=((20.0, 2.0),))
    found = observe(sideslip_kinematic_observer(ROBOT), time_s, rows).slip
    assert found[1:] == pytest.approx(plain(rows)[:, :2], abs=1e-7, nan_ok=True)
    settings = MultiModelSettings()
    track = observe(sideslip_multi_observer(ROBOT, settings), time_s, rows)
    expected = plain(rows, settings)
    assert track.slip[1:] == pytest.approx(expected[:, :2], abs=1e-7, nan_ok=True)
    assert track.state("cornering_rear_npr")[1:] == pytest.approx(expected[:, 3], rel=1e-6)


def derivative(function, x, step=1e-6):
    """Return the derivative of a function of a vector by central differences."""
    scale = step * np.maximum(1.0, np.abs(x))
    columns = [(function(x + d) - function(x - d)) / (2 * d.sum()) for d in np.diag(scale)]
    return np.column_stack(columns)


def plain_dynamic(rows):
    """The dynamic observer in plain numpy: derivatives by differences, joint Kalman updates row by row."""
    s, dt_s = DynamicSettings(), TICK_S
    ahead, behind = ROBOT.com_ahead_m, ROBOT.com_behind_front_m
    x = np.array([0.0, 0.0, 15000.0, 15000.0])
    cov = np.diag([0.01, 0.01, *np.full(2, (s.stiffness_std_ratio * 15000.0) ** 2)])
    cov[2, 3] = cov[3, 2] = s.stiffness_correlation * cov[2, 2]
    out = []
    for k, (u, steer, _, _, _, rate, roll, accel) in enumerate(rows):

        def slips(x, u=u, steer=steer):
            front, rear = (x[1] + behind * x[0]) / u, (x[1] - ahead * x[0]) / u
            return np.array([np.arctan(front) - steer, np.arctan(rear)])

        def model(x, u=u, steer=steer, roll=roll):
            front, rear = x[2:] * slips(x) * np.array([np.cos(steer), 1.0])
            turning = (ahead * rear - behind * front) / ROBOT.yaw_inertia_kgm2
            return np.array([turning, -(front + rear) / ROBOT.mass_kg - 9.80665 * np.sin(roll) - u * x[0]])

        def force(x, u=u, roll=roll):
            turning, pushed = model(x)
            return np.array([pushed + u * x[0] + 9.80665 * np.sin(roll) - ahead * turning])

        excited = abs(u * rate + 9.80665 * np.sin(roll)) > s.excited_mps2
        if u >= s.slowest_mps:
            if k:
                by = derivative(model, x)
                inverse = np.linalg.inv(np.eye(2) - dt_s * by[:, :2])
                moved = np.block([[inverse, dt_s * inverse @ by[:, 2:]], [np.zeros((2, 2)), np.eye(2)]])
                x = x + np.concatenate([dt_s * inverse @ model(x), np.zeros(2)])
                walk = np.zeros((4, 4))
                walk[0, 0], walk[1, 1] = s.turn_walk_radps2**2, s.side_walk_mps2**2
                if excited:
                    walk[2:, 2:] = s.stiffness_walk_npr**2 * np.array(
                        [[1, s.stiffness_correlation], [s.stiffness_correlation, 1]]
                    )
                cov = moved @ cov @ moved.T + dt_s * walk
            for measured, function, std in (
                (rate, lambda x: x[:1], s.gyro_std_radps),
                (accel, force, s.accel_std_mps2),
            ):
                h = derivative(function, x)
                gain = (cov @ h.T / (h @ cov @ h.T + std**2))[:, 0]
                gain[2:] *= float(excited)
                x = x + gain * (measured - function(x)[0])
                kept = np.eye(4) - np.outer(gain, h)
                cov = kept @ cov @ kept.T + np.outer(gain, gain) * std**2
        out.append([*slips(x), x[2], np.sqrt(cov[3, 3])] if u > 0 else np.full(4, np.nan))
    return np.array(out)


def test_dynamic_step_agrees_with_its_plain_form():
    time_s, rows, _ = drive(4.0, seed=3, roll_rad=0.1, seconds=15.0)
    track, expected = observe(sideslip_dynamic_observer(ROBOT), time_s, rows), plain_dynamic(rows)
    moves = slice(50, None)
    assert track.slip[moves] == pytest.approx(expected[moves, :2], abs=1e-6)
    assert track.state("cornering_front_npr")[moves] == pytest.approx(expected[moves, 2], rel=1e-4)
    assert track.std[moves, 6] == pytest.approx(expected[moves, 3], rel=1e-3)


@ANY
@pytest.mark.parametrize("roll_rad", [0.0, 0.2])
def test_slip_comes_back_within_its_own_error(factory, roll_rad):
    time_s, rows, truth = drive(4.0, seed=1, roll_rad=roll_rad)
    track = observe(factory(ROBOT), time_s, rows)
    error = (track.slip - true_slips(truth))[time_s > 5.0]
    stated = track.slip_std[time_s > 5.0]
    assert np.isfinite(error).all()
    assert np.sqrt((error**2).mean()) < np.radians(1.2)
    assert 0.3 < np.sqrt(((error / stated) ** 2).mean()) < 1.6


@pytest.mark.parametrize(("speed_mps", "seed"), [(4.0, 4), (5.0, 5)])
def test_stiffness_is_the_secant_of_the_force(speed_mps, seed):
    time_s, rows, truth = drive(speed_mps, seed=seed)
    track = observe(sideslip_multi_observer(ROBOT), time_s, rows)
    found = np.column_stack([track.state("cornering_front_npr"), track.state("cornering_rear_npr")])
    slips = true_slips(truth)
    excited = (np.abs(truth("accel_y_mps2")) > 1.0) & (np.abs(slips) > 0.02).all(axis=1) & (time_s > 6.0)
    error = found[excited] / true_stiffness(truth)[excited] - 1.0
    assert np.abs(np.median(error, axis=0)).max() < 0.15
    assert (np.abs(error) < 0.2).mean() > 0.85


def test_printed_signs_send_the_stiffness_to_its_limit():
    """On a slope: on level ground both signs of line 2 turn, and its steady state is the same."""
    time_s, rows, truth = drive(5.0, seed=5, roll_rad=0.2)
    printed = MultiModelSettings(as_printed=True)
    track = observe(sideslip_multi_observer(ROBOT, printed), time_s, rows)
    assert min(track.state("cornering_front_npr").min(), track.state("cornering_rear_npr").min()) == 1000.0
    right = observe(sideslip_multi_observer(ROBOT), time_s, rows)
    errors = [np.sqrt(np.nanmean((each.slip - true_slips(truth)) ** 2)) for each in (track, right)]
    assert errors[0] < 2.0 * errors[1]  # the fault hides in the slip


def test_printed_regressors_bias_the_stiffness():
    time_s, rows, truth = drive(4.0, seed=6)
    excited = (np.abs(truth("accel_y_mps2")) > 1.0) & (time_s > 10.0)
    medians = []
    for instrument in (True, False):
        settings = SECTION_VI._replace(stiffness_gain=5e8, instrument=instrument)
        rear = observe(sideslip_multi_observer(ROBOT, settings), time_s, rows).state("cornering_rear_npr")
        medians.append(np.nanmedian(rear[excited] / true_stiffness(truth)[excited, 1]) - 1.0)
    assert abs(medians[0]) < 0.1
    assert medians[1] < -0.15


def test_dynamic_observer_needs_neither_positions_nor_headings():
    time_s, rows, truth = drive(4.0, seed=2)
    blind = rows.copy()
    blind[:, 2:5] = np.nan
    track = observe(sideslip_dynamic_observer(ROBOT), time_s, blind)
    error = (track.slip - true_slips(truth))[time_s > 3.0]
    assert np.sqrt((error**2).mean()) < np.radians(0.6)
    assert np.isnan(track.state("position_x_m")).all()
    without_force = blind.copy()
    without_force[:, 7] = np.nan
    track = observe(sideslip_dynamic_observer(ROBOT), time_s, without_force)
    assert np.sqrt((track.slip - true_slips(truth))[time_s > 3.0] ** 2).mean() < np.radians(1.0)


def test_kinematic_slip_is_unknown_without_fixes():
    time_s, rows, _ = drive(4.0, seed=2)
    blind = rows.copy()
    blind[:, 2:5] = np.nan
    for factory in (sideslip_kinematic_observer, sideslip_multi_observer):
        track = observe(factory(ROBOT), time_s, blind)
        assert np.isnan(track.slip).all()
        assert set(track.status) == {ObserverStatus.STARTING}


@ANY
def test_at_rest_slip_and_stiffness_are_frozen(factory):
    time_s, rows, truth = drive(3.0, seed=7, stops=((20.0, 4.0),))
    track = observe(factory(ROBOT), time_s, rows)
    stands = (truth("speed_x_mps") == 0.0) & (time_s > 2.0)
    assert stands.sum() > 150
    assert np.ptp(track.slip[stands], axis=0).max() == 0.0
    names = [name for name in track.states if name.startswith("cornering")]
    for name in names:
        assert np.ptp(track.state(name)[stands]) == 0.0
    assert (track.status[stands][1:] == ObserverStatus.STANDING).all()
    assert np.nanmax(np.abs(track.slip)) < np.radians(3.0)


@ANY
def test_jumps_flips_and_lost_fixes_have_their_statuses(factory):
    time_s, rows, _ = drive(4.0, seed=8)
    fixes = np.flatnonzero(np.isfinite(rows[:, 2]))
    faulty = rows.copy()
    jump, flip, lost, moved = fixes[100], fixes[120], fixes[140:160], fixes[200:]
    faulty[jump, 2] += 5.0
    faulty[flip, 4] = wrapped(faulty[flip, 4] + np.pi)
    faulty[lost, 2:5] = np.nan
    faulty[moved, 2] += 7.0
    track = observe(factory(ROBOT), time_s, faulty)
    clean = observe(factory(ROBOT), time_s, rows)
    assert track.status[jump] == ObserverStatus.REJECTED
    assert track.status[flip] == ObserverStatus.REJECTED
    rejected, reset = ObserverStatus.REJECTED, ObserverStatus.RESET
    assert (track.status[moved[:10]] == rejected).all()
    assert (track.status[moved] == reset).sum() == 1
    after = track.mean[fixes[-1], 0] - clean.mean[fixes[-1], 0]
    assert after == pytest.approx(7.0, abs=0.05)
    assert np.nanmax(np.abs(track.slip - clean.slip)) < np.radians(6.0)
    late = slice(fixes[230], None)
    assert np.abs(track.slip - clean.slip)[late].max() < np.radians(1.0)
    if factory is not sideslip_dynamic_observer:
        assert (track.status[lost[-3] : lost[-1]] == ObserverStatus.PREDICTED).any()


def test_without_a_gyro_slip_is_that_of_the_pose_and_stiffness_as_it_was():
    time_s, rows, truth = drive(4.0, seed=3)
    silent = np.where(np.arange(8) == pose.IN_RATE, np.nan, rows)
    track = observe(sideslip_multi_observer(ROBOT), time_s, silent)
    kinematic = observe(sideslip_kinematic_observer(ROBOT), time_s, silent)
    late = time_s > 5.0
    error = np.sqrt(np.mean((track.slip - true_slips(truth))[late] ** 2, axis=0))
    assert (error < np.radians(1.5)).all()
    assert np.abs(track.slip - kinematic.slip)[late].max() < np.radians(0.5)
    assert np.ptp(track.mean[:, 5:7], axis=0).max() == 0.0
    rate_error = track.mean[late, 3] - truth("yaw_rate_radps")[late]
    assert np.sqrt(np.mean(rate_error**2)) < 0.05
    assert 0.25 < np.mean((rate_error / track.std[late, 3]) ** 2) ** 0.5 < 2.0
    assert not (track.status[late] == ObserverStatus.OK).any()


def test_a_gyro_that_fails_and_returns_leaves_the_slip_where_it_is():
    time_s, rows, truth = drive(4.0, seed=4)
    faulty = rows.copy()
    faulty[(time_s > 8.0) & (time_s < 16.0), pose.IN_RATE] = np.nan
    track = observe(sideslip_multi_observer(ROBOT), time_s, faulty)
    error = np.abs(track.slip - true_slips(truth))[time_s > 4.0]
    assert error.max() < np.radians(5.0)
    assert np.abs(track.mean[:, 3] - truth("yaw_rate_radps"))[time_s > 16.5].max() < 0.1


@ANY
def test_memory_is_finite_for_any_input(factory):
    rng, observer = np.random.default_rng(9), factory(ROBOT)
    strange = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, 1e-300, np.pi, -5.0, 5.0])
    memory = np.array(observer.start)
    for _ in range(3000):
        row = rng.normal(0.0, 3.0, 8)
        odd = rng.random(8) < 0.3
        row[odd] = rng.choice(strange, odd.sum())
        dt_s = float(rng.choice([0.02, 0.1, 0.0, -1.0, np.nan, np.inf, 1e9, 0.5]))
        before = memory.copy()
        memory = observer.step(observer.params, memory, row, dt_s)
        assert np.isfinite(memory).all()
        output = observer.read(observer.params, memory)
        assert output.status in set(ObserverStatus)
        known = output.slip[np.isfinite(output.slip)]
        assert (np.abs(known) <= 0.6).all()
        if output.status == ObserverStatus.BAD_INPUT:
            before[pose.STATUS] = memory[pose.STATUS]
            assert (before == memory).all()


@ANY
def test_reversing_has_the_slip_of_its_own_direction(factory):
    """Backward along a slope: a side force opposes the same lateral speed as forward."""
    time_s, roll_rad = np.arange(400) * TICK_S, -0.1
    expected = -ROBOT.mass_kg * 9.80665 * np.sin(roll_rad) / 30000.0
    rows = np.full((400, 8), np.nan)
    rows[:, :2], rows[:, 4:7] = (-2.0, 0.0), (0.0, 0.0, roll_rad)
    rows[:, 2], rows[:, 3] = -2.0 * time_s, 2.0 * expected * time_s
    rows[:, 7] = 9.80665 * np.sin(roll_rad)
    slip = observe(factory(ROBOT), time_s, rows).slip[-1]
    assert slip == pytest.approx(expected, rel=0.2)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="gain_ps"):
        sideslip_kinematic_observer(ROBOT, pose.PoseSettings(gain_ps=-1.0))
    with pytest.raises(ConfigError, match="stiffness_gain"):
        sideslip_multi_observer(ROBOT, MultiModelSettings(stiffness_gain=float("nan")))
    with pytest.raises(ConfigError, match="gyro_std"):
        sideslip_dynamic_observer(ROBOT, DynamicSettings(gyro_std_radps=0.0))
