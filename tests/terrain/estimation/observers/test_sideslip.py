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
from terrain.simulation.bicycle.plant import level_ground
from terrain.simulation.bicycle.simulate import (
    CAR_ROWS,
    CarCommand,
    CarDrive,
    SensorNoise,
    SpeedProfile,
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


def test_on_a_straight_path_the_observer_is_the_papers():
    """(5), (6) with deviations y, theta~ of the path y = 0, integrated at 1 ms; both without noise."""
    dt_s, speed, steer, gain, ratio = 0.001, 3.0, 0.02, 15.0, 4.0
    base, slips = ROBOT.wheelbase_m, np.array([-0.03, 0.04])
    time_s = np.arange(3000) * dt_s
    turning = speed * (np.tan(steer + slips[0]) - np.tan(slips[1])) / base
    yaw = turning * time_s
    along = speed / np.cos(slips[1])  # v of the paper: u = v cos b_R is measured
    x = np.cumsum(along * np.cos(yaw + slips[1])) * dt_s
    y = np.cumsum(along * np.sin(yaw + slips[1])) * dt_s
    nan = np.full(time_s.size, np.nan)
    rows = np.column_stack([nan + 1, nan + 1, x, y, yaw, nan, nan, nan])
    rows[:, :2] = speed, steer
    found = observe(sideslip_kinematic_observer(ROBOT), time_s, rows).slip
    dev, slip, paper = np.array([y[0], yaw[0]]), np.zeros(2), np.full((time_s.size, 2), np.nan)
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
        slip = slip + dt_s * ratio * jacobian.T @ error
        paper[k] = slip
    assert found[500:] == pytest.approx(paper[500:], abs=0.003)
    assert found[-1] == pytest.approx(slips, abs=0.003)


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


def plain_kinematic(rows, gain=15.0, ratio=4.0):
    """The kinematic observer in plain numpy: eigenvectors in place of closed forms, no gates."""
    base, dt_s = ROBOT.wheelbase_m, TICK_S
    at, slip, left, since, out = rows[0, 2:5].copy(), np.zeros(2), 0.0, 0.0, []
    for row in rows[1:]:
        u, steer = row[:2]
        moves = abs(u) >= pose.STANDING_MPS
        speed = u if moves else 0.0
        turning = speed * (np.tan(steer + slip[0]) - np.tan(slip[1])) / base
        middle, side = at[2] + left + 0.5 * dt_s * turning, speed * np.tan(slip[1])
        at[0] += dt_s * (speed * np.cos(middle) - side * np.sin(middle))
        at[1] += dt_s * (speed * np.sin(middle) + side * np.cos(middle))
        at[2] += dt_s * turning
        since += dt_s
        if np.isfinite(row[2]):
            rear = 1 / np.cos(slip[1]) ** 2
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
            at[:2] += g_e * turn.T @ [along, across]
            at[2], left, since = at[2] + g_e * error[1], (1 - g_e) * error[1], 0.0
        out.append(slip)
    return np.array(out)


def test_kinematic_step_agrees_with_its_plain_form():
    time_s, rows, _ = drive(4.0, seed=3, stops=((20.0, 2.0),))
    found = observe(sideslip_kinematic_observer(ROBOT), time_s, rows).slip
    assert found[1:] == pytest.approx(plain_kinematic(rows), abs=1e-7, nan_ok=True)


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
