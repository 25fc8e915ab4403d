"""Faults written into logs: each is in the log, on the robots that show it, and is known by its sentence."""

import math

import numpy as np
import pytest

from terrain.discrepancy.trials.drives import rich_drives
from terrain.discrepancy.trials.hidden_effects import hidden_runs
from terrain.discrepancy.trials.written_faults import FAULTS, fault_named, faults_of, with_fault
from terrain.robots import load_robot

SENTENCES = {
    "gyro_sign": "the gyro has the opposite sign in all runs",
    "gyro_deg": "the gyro is 57 times too large: it is in deg/s",
    "wheels_kmh": "the wheel speeds are 3.6 times too large: they are in km/h",
    "camera_kmh": "the speed of the camera is 3.6 times too large: it is in km/h",
    "wheels_rpm": "the motor rates are 9.55 times too large: they are in rpm",
    "swapped_currents": "the currents of left and right wheel are swapped",
    "swapped_wheels": "the speeds of left and right wheel are swapped",
}


@pytest.fixture(scope="module", params=["husky", "agrimaro"])
def plain(request):
    robot = load_robot(request.param)
    drives = rich_drives(np.random.default_rng(1), 1, 20.0)
    return robot, hidden_runs(robot, drives, np.random.SeedSequence(2), {})


def test_a_fault_changes_its_channels_and_no_others(plain):
    robot, runs = plain
    (run,) = runs
    for fault in faults_of(robot.drive):
        (broken,) = with_fault(runs, fault, robot)
        changed = {
            (name, channel)
            for name, stream in run.streams.items()
            for channel in stream.channels
            if not np.array_equal(stream.channel(channel), broken.streams[name].channel(channel))
        }
        assert changed, fault.name
        assert {name for name, _ in changed} == {fault.stream}
        assert len(changed) < sum(len(s.channels) for s in run.streams.values()) / 2


def test_signs_and_units_are_those_that_the_name_states(plain):
    robot, runs = plain
    factors = {
        "gyro_sign": -1.0,
        "gyro_deg": 180 / math.pi,
        "wheels_kmh": 3.6,
        "camera_kmh": 3.6,
        "wheels_rpm": 9.549,
    }
    channels = {"imu": "gyro_z_radps", "odometry": "speed_x_mps", "wheels": robot.rate_channels[0]}
    for fault in faults_of(robot.drive):
        if fault.name in factors:
            (broken,) = with_fault(runs, fault, robot)
            before, after = (
                r.streams[fault.stream].channel(channels[fault.stream]) for r in (runs[0], broken)
            )
            assert after == pytest.approx(before * factors[fault.name], rel=1e-4)


def test_a_swap_twice_is_none(plain):
    robot, runs = plain
    for fault in faults_of(robot.drive):
        if fault.name.startswith("swapped"):
            twice = with_fault(with_fault(runs, fault, robot), fault, robot)
            assert np.array_equal(twice[0].streams["wheels"].values, runs[0].streams["wheels"].values)


def test_a_sentence_states_its_own_fault_and_no_other():
    assert set(SENTENCES) == {fault.name for fault in FAULTS}
    for name, sentence in SENTENCES.items():
        assert fault_named(name).stated_in([sentence]), name
        others = [other for other in FAULTS if other.name != name and other.stated_in([sentence])]
        assert {other.name for other in others} <= {"camera_kmh", "wheels_kmh"} - {name}
    assert not any(fault.stated_in([]) for fault in FAULTS)
