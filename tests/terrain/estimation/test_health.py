"""Health of sensors: each fault is named as what it is and of its sensor, and sound sensors stay fresh."""

from functools import cache, partial

import numpy as np
import pytest

from pipelines.drive.comparison import DriveInputs, drive_once
from terrain.control.controllers import make_controller
from terrain.control.fault_drives import START, STOP, make_fault_situation
from terrain.control.slip_table import load_slip_table
from terrain.estimation.clocks import Clocks
from terrain.estimation.health import Health, sensors_of
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.faults import FaultyBus, fault_catalogue
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults

ROBOT = load_robot("agrimaro")
CATALOGUE = fault_catalogue(ROBOT)
START_S, END_S = 4.0, 7.0
SENSORS = [sensor.name for sensor in sensors_of(ROBOT, CHANNELS)]
WHEELS, STEERS = SENSORS[:3], SENSORS[3:6]
IMU, CAMERA = SENSORS[6:10], SENSORS[10:]


@cache
def samples(terrain="grass"):
    """A start on a terrain, and steady motion."""
    run = simulate_run(ROBOT, terrain, "straight", 3, duration_s=10.5, faults=Faults(by_chance=False))
    return list(replay(run))


@cache
def health(fault, given=samples):
    """Return times, and health (n, 13) at each, of a drive with a fault; without one where it is None."""
    estimator, clocks, times_s, found = make_live_filter("vio15", ROBOT, CHANNELS), Clocks(), [], []

    def estimate(sample):
        now_s, readings = clocks.step(sample.time_s, sample.readings)
        estimator.step(readings, now_s)
        if estimator.latest is not None:
            times_s.append(sample.time_s)
            found.append(estimator.latest.health)

    bus = FaultyBus(estimate, CATALOGUE[fault], START_S, END_S, seed=0) if fault else estimate
    for sample in given():
        bus(sample)
    return np.array(times_s), np.array(found)


NAMED = [
    ("loss_wheels", WHEELS, Health.LOST, 0.15),
    ("loss_steering", STEERS, Health.LOST, 0.3),
    ("loss_imu", IMU, Health.LOST, 0.3),
    ("loss_odometry", CAMERA, Health.LOST, 0.3),
    ("nan_odometry", CAMERA, Health.LOST, 0.3),
    ("freeze_wheels", WHEELS, Health.FROZEN, 0.2),
    ("freeze_motor_1", WHEELS[:1], Health.FROZEN, 0.2),
    ("freeze_motor_3", WHEELS[2:], Health.FROZEN, 0.2),
    ("freeze_gyro", ("gyro",), Health.FROZEN, 0.2),
    ("freeze_accel", ("accel",), Health.FROZEN, 0.2),
    ("freeze_pitch", ("tilt",), Health.FROZEN, 0.2),
    ("freeze_odometry", CAMERA, Health.FROZEN, 0.1),
    ("freeze_camera_speed", ("camera_speed",), Health.FROZEN, 0.1),
    ("step_camera_speed", ("camera_speed",), Health.STEPPED, 0.1),
    ("step_camera_speed_down", ("camera_speed",), Health.STEPPED, 0.1),
    ("step_camera_yaw", ("camera_yaw",), Health.STEPPED, 0.1),
    ("step_pitch", ("tilt",), Health.STEPPED, 0.1),
    ("step_accel", ("accel", "camera_speed"), Health.DISAGREES, 0.3),
    ("step_gyro", ("gyro",), Health.GATED, 0.2),
    ("behind_odometry", CAMERA, Health.LATE, 0.1),
    ("late_100ms_imu", IMU, Health.LATE, 0.1),
]
BESIDES = {
    "freeze_accel": {"tilt"},  # gravity is taken off by tilt, and tilt is judged by what remains
    "freeze_pitch": {"accel"},
    "step_pitch": {"accel"},
    "step_camera_yaw": {"camera_speed"},  # which the yaw turns into the body's axes
}


@pytest.mark.parametrize(("fault", "sensors", "status", "within_s"), NAMED)
def test_a_fault_is_named_as_what_it_is_and_of_its_sensor_as_long_as_it_lasts(
    fault, sensors, status, within_s
):
    time_s, found = health(fault)
    places = [SENSORS.index(sensor) for sensor in sensors]
    during = (time_s >= START_S + within_s) & (time_s < END_S - 0.02)
    if status is Health.GATED:  # later its bias is seen to be none
        assert (found[during][:, places] >= status).all()
        during &= time_s < START_S + 1.0
    assert (found[during][:, places] == status).all()
    assert (found[(time_s > 3.0) & (time_s < START_S)] == Health.FRESH).all()
    if fault != "step_gyro":
        others = [i for i, s in enumerate(SENSORS) if i not in places and s not in BESIDES.get(fault, ())]
        assert (found[time_s > 3.0][:, others] <= Health.REOPENED).all()
        after = found[time_s > END_S + 0.5]
        assert (np.delete(after, SENSORS.index("imu_yaw"), axis=1) == Health.FRESH).all()


def test_a_heading_that_is_set_is_reopened_and_a_gyro_with_a_large_bias_disagrees_for_good():
    time_s, found = health("step_yaw")
    yaw = found[:, SENSORS.index("imu_yaw")]
    assert set(yaw[(time_s >= START_S) & (time_s < START_S + 0.5)]) >= {Health.GATED, Health.REOPENED}
    assert (yaw[(time_s > START_S + 0.5) & (time_s < END_S)] == Health.FRESH).all()
    assert (np.delete(found[time_s > 3.0], SENSORS.index("imu_yaw"), axis=1) <= Health.REOPENED).all()
    time_s, found = health("step_gyro")
    gyro = found[:, SENSORS.index("gyro")]
    assert (gyro[(time_s > START_S + 2.2) & (time_s < END_S)] == Health.DISAGREES).all()
    assert (gyro[time_s > END_S + 2.5] == Health.FRESH).all()


@pytest.mark.parametrize("where", ["straight on tiles", START, STOP])
def test_sound_sensors_stay_fresh(where):
    """In steady motion on hard ground, and at a start and a brake with plain commands on soft one."""
    given = partial(samples, "tiles")
    if where != "straight on tiles":
        table = load_slip_table()
        situation = make_fault_situation(where, ROBOT, "grass" if where == START else "dry_sand", 7)[0]
        run = drive_once(DriveInputs(ROBOT, table), make_controller("plain", table, 0.05), situation)
        given = partial(replay, run)
    time_s, found = health(None, given)
    after = found[time_s > 0.5]
    assert len(after) > 200
    assert (after <= Health.LATE).all()
    assert (after == Health.FRESH).mean() > 0.999
