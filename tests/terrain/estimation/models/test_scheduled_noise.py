"""Noise by vibration and by what wheels do, held sensors, rest, and the offset of the IMU's yaw."""

from functools import cache

import numpy as np
import pytest

from terrain.estimation.feed import DERIVED_ROWS, REST_AFTER_S, measurement_table
from terrain.estimation.filter import GATE_PROBABILITY, HELD_S, REOPEN_AFTER_S, Filter, FilterSettings
from terrain.estimation.live import LiveFilter
from terrain.estimation.models.swerve import make_filter, scheduled
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.replay import replay
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import GATED, REOPENED, Reading
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults

ROBOT = load_robot("agrimaro")
SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)
PERIOD_S = 0.02


@cache
def log(terrain="grass"):
    return simulate_run(
        ROBOT, terrain, "straight", 3, duration_s=14.0, faults=Faults(camera_lost_s=((8.0, 9.0),))
    )


@cache
def parts():
    return make_filter("vio15", ROBOT), measurement_table(log(), ROBOT, causal=True)


def gated_until(name, amount, duration_s=4.0):
    """Return uses of a sensor, tick by tick, whose rows are off by an amount from 6 s on."""
    model, table = parts()
    session, uses, times_s = Filter(model, SETTINGS), [], []
    off = [model.rows.index(row) for row in dict(model.sensors)[name]]
    z = table.columns(model.rows).copy()
    z[np.ix_(table.time_s > 6.0, off)] += amount
    for n, time_s in enumerate(table.time_s):
        if time_s > 6.0 + duration_s:
            break
        now = scheduled(model, table.z[n : n + 1], table.gnss_variance[n : n + 1])
        session.step(float(time_s), z[n], *(part[0] for part in now))
        uses.append(int(session.use[model.sensor_names.index(name)]))
        times_s.append(time_s)
    return np.array(times_s), np.array(uses)


@pytest.mark.parametrize(
    ("name", "amount", "after_s"),
    [("gyro", 1.0, HELD_S), ("camera_speed", 1.5, HELD_S), ("wheel_1", 60.0, REOPEN_AFTER_S)],
)
def test_held_sensors_are_reopened_after_two_seconds_and_others_after_a_fifth(name, amount, after_s):
    model, _ = parts()
    assert (name in model.held) == (after_s == HELD_S)
    time_s, uses = gated_until(name, amount)
    first_s = time_s[np.flatnonzero(uses == GATED)[np.flatnonzero(time_s[uses == GATED] > 6.0)[0]]]
    reopened_s = time_s[(uses == REOPENED) & (time_s > 6.0)][0]
    assert reopened_s - first_s == pytest.approx(after_s, abs=1.5 * PERIOD_S)


def driven(motion_of, duration_s=60.0):
    """Return estimator and estimates of a robot whose wheels' rate and acceleration a function gives.

    The camera gives nothing but in the first two seconds, in which the robot stands; IMU at 100 Hz.
    """
    rng, estimator, found = np.random.default_rng(4), LiveFilter(ROBOT), []
    for k in range(round(duration_s / PERIOD_S)):
        time_s = k * PERIOD_S
        wheel_radps, accel_mps2 = motion_of(time_s)
        imu_s = time_s - PERIOD_S + 0.01 * np.arange(1, 3)
        imu = np.zeros((2, 9))
        imu[:, 2] = 0.004 + 0.002 * rng.standard_normal(2)
        imu[:, 3] = accel_mps2 + 0.05
        imu[:, 3:6] += 0.03 * rng.standard_normal((2, 3))
        imu[:, 5] += 9.81
        imu[:, 6:8] = 1e-4 * rng.standard_normal((2, 2))
        imu[:, 8] = 0.002 * rng.standard_normal(2)
        stamp_s = np.array([time_s])
        currents = 0.05 * rng.standard_normal(3)
        readings = {
            "wheels": Reading(stamp_s, np.concatenate([np.full(3, wheel_radps), currents])[None]),
            "steering": Reading(stamp_s, 1e-4 * rng.standard_normal((1, 3))),
            "imu": Reading(imu_s, imu),
        }
        if time_s < 2.0:
            seen = np.zeros((1, len(CAMERA_CHANNELS)))
            seen[0, CAMERA_CHANNELS.index("quaternion_w_ratio")] = 1.0
            seen[0, -1] = 1.0
            seen[0, : CAMERA_CHANNELS.index("quaternion_w_ratio")] += 1e-4 * rng.standard_normal(6)
            first = CAMERA_CHANNELS.index("velocity_x_mps")
            seen[0, first : first + 6] = 1e-3 * rng.standard_normal(6)
            readings["odometry"] = Reading(stamp_s, seen)
        found += estimator.step(readings)
    return estimator, found


def test_a_robot_at_rest_keeps_its_position_for_a_minute_without_a_camera():
    estimator, found = driven(lambda time_s: (0.0, 0.0))
    places = [estimator.states.index(state) for state in ("position_x_m", "position_y_m")]
    moved_m = np.array([estimate.mean[places] for estimate in found])
    assert np.abs(moved_m).max() < 0.05
    assert np.abs([found[-1].speed_x_mps, found[-1].speed_y_mps, found[-1].yaw_rate_radps]).max() < 0.01
    assert not np.isnan(found[-1].rows[[*estimator_rest_places()]]).any()


def estimator_rest_places():
    return [parts()[1].rows.index(row) for row in DERIVED_ROWS[-3:]]


def test_locked_wheels_that_slide_are_no_rest():
    """Decelerated by 0.5 m/s^2, as on ice: the wheels stand from 3 s on, the robot from 5 s on."""

    def sliding(time_s):
        accel = 0.5 if 2.0 <= time_s < 4.0 else (-0.5 if 4.0 <= time_s < 6.0 else 0.0)
        return (50.0 * min(max(0.5 * (time_s - 2.0), 0.0), 1.0) if time_s < 4.0 else 0.0), accel

    _, found = driven(sliding, 9.0)
    time_s = np.array([estimate.time_s for estimate in found])
    rest = ~np.isnan(np.array([estimate.rows[estimator_rest_places()[0]] for estimate in found]))
    assert rest[(time_s > 1.5) & (time_s < 2.0)].all()
    assert not rest[(time_s > 2.2) & (time_s < 6.0 + 0.8 * REST_AFTER_S)].any()
    assert rest[time_s > 7.5].all()


def test_the_offset_of_the_imus_yaw_follows_its_drift_and_the_yaw_stays():
    """Its fused yaw drifts by 2e-3 rad/s more than it does; the offset has a memory of some 15 s."""
    drive = simulate_run(ROBOT, "grass", "straight", 3, duration_s=80.0, faults=Faults(by_chance=False))

    def estimated(drift_radps):
        estimator = LiveFilter(ROBOT)
        places = [estimator.states.index(state) for state in ("imu_yaw_offset_rad", "yaw_rad")]
        times_s, found = [], []
        for sample in replay(drive):
            readings = dict(sample.readings)
            if "imu" in readings:
                time_s, values = readings["imu"]
                values = values.copy()
                values[:, IMU_CHANNELS.index("yaw_rad")] += drift_radps * time_s
                readings["imu"] = Reading(time_s, values)
            for estimate in estimator.step(readings):
                times_s.append(estimate.time_s)
                found.append(estimate.mean[places])
        return np.array(times_s), np.array(found)

    time_s, drifted = estimated(2e-3)
    offset, yaw = (drifted - estimated(0.0)[1]).T
    at_s, later_s = np.searchsorted(time_s, [50.0, 79.0])
    assert offset[later_s] - offset[at_s] == pytest.approx(2e-3 * 29.0, rel=0.1)
    assert np.abs(yaw).max() < 0.003
