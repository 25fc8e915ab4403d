"""Steering zeros, reduction ratio and lags of a swerve robot that are hidden in simulated runs on tiles."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.calibration.lag import DIFFERENCE, starts_and_stops, time_constants
from terrain.calibration.wheels import (
    hard_stretches,
    reduction_ratio,
    steady_stretches,
    steering_zeros,
    why_none,
)
from terrain.records import RunLog, Stream
from terrain.simulation.scenario import Conditions

HARD = ("tiles", "asphalt")
ENCODER, CAMERA = "sensors.encoder_time_constant_s", "camera.time_constant_s"


def found_in(find, runs, robot):
    return [each for run in runs for stretch in hard_stretches(run, HARD) for each in find(stretch, robot)]


def lags(runs, robot):
    return {each.parameter: each for each in time_constants(found_in(starts_and_stops, runs, robot))}


def changed(run, name, rows=slice(None), late_s=0.0):
    stream = run.streams[name]
    other = Stream(stream.time_s[rows] + late_s, stream.values[rows], stream.channels)
    return RunLog("changed", run.robot, {**run.streams, name: other}, run.labels)


@pytest.fixture(scope="module")
def zeroed(nominal, hidden):
    """The description with steering and motors calibrated before."""
    return nominal.with_parts(steering=hidden.steering, motors=hidden.motors)


def test_side_slip_is_no_noise_that_averages_out(drive, nominal, truth):
    """The plain mean of angle less direction is off, and alike in every run."""
    zeros, errors, plain = [truth(f"steering.zero_{i}_rad") for i in (1, 2, 3)], [], []
    for seed in range(3):
        stretches = found_in(steady_stretches, [drive("complex", seed)], nominal)
        found = steering_zeros(stretches, nominal)
        assert all(finding.high - finding.low < 0.006 for finding in found)
        errors.append([finding.value for finding in found] - np.array(zeros))
        plain.append(np.mean([stretch.off_rad for stretch in stretches], axis=0) - zeros)
    assert np.abs(errors).max() < 0.0015
    assert np.abs(np.mean(plain, axis=0)).max() > max(5 * np.abs(np.mean(errors, axis=0)).max(), 0.003)


def test_steering_zeros_do_not_depend_on_load_and_tyres(drive, nominal, truth):
    runs = [
        drive("complex", 1, conditions=Conditions(radius_factors=(1.006, 0.996, 1.0))),
        drive("complex", 2, conditions=Conditions(payload_kg=25.0, payload_m=(0.1, 0.1))),
        drive("complex", 3, conditions=Conditions(radius_factors=(1.0, 1.004, 0.994), payload_kg=10.0)),
    ]
    stretches = found_in(steady_stretches, runs, nominal)
    findings = [*steering_zeros(stretches, nominal), reduction_ratio(stretches, nominal)]
    for finding in findings:
        assert finding.low <= truth(finding.parameter) <= finding.high
    assert findings[3].runs == tuple(run.run_id for run in runs)


def test_zeros_may_lie_anywhere_on_the_turn(drive, nominal, hidden):
    zeros = {"zero_1_rad": 2.5, "zero_2_rad": -1.2, "zero_3_rad": 3.13}
    run = drive("complex", 4, robot=hidden.with_parts(steering=replace(hidden.steering, **zeros)))
    findings = steering_zeros(found_in(steady_stretches, [run], nominal), nominal)
    found = np.array([finding.value for finding in findings])
    np.testing.assert_allclose(np.angle(np.exp(1j * (found - list(zeros.values())))), 0.0, atol=0.0015)
    assert (np.abs(found) <= np.pi).all()


def test_forward_driving_alone_determines_the_ratio_but_no_zero(drive, nominal):
    runs = [drive("starts", seed) for seed in range(4)]
    stretches = found_in(steady_stretches, runs, nominal)
    assert {stretch.direction for stretch in stretches} == {"forward"}
    # all starts of a run stand with their plays alike: one stretch
    assert [stretch.run_id for stretch in stretches] == [run.run_id for run in runs]
    for finding in steering_zeros(stretches, nominal):
        assert not finding.determined
        note = "driven forward, undetermined: drive straight forward, backward and to both sides"
        assert note in finding.note
    assert reduction_ratio(stretches, nominal).determined


def test_stretches_are_straight_and_on_hard_ground_and_their_lack_is_explained(drive, nominal):
    steady = found_in(steady_stretches, [drive("complex", 5)], nominal)
    assert {each.direction for each in steady} == {"forward", "backward", "left", "right", "diagonally"}
    arc, soft, run = drive("arc", 5), drive("complex", 5, terrain="grass"), drive("straight", 1)
    for find in (steady_stretches, starts_and_stops):
        assert found_in(find, [arc, soft], nominal) == []
    blind = RunLog("r", run.robot, {k: v for k, v in run.streams.items() if k != "odometry"}, run.labels)
    assert why_none([blind], nominal, HARD) == "no run has a camera (stream 'odometry')"
    assert why_none([soft], nominal, HARD) == "no run is labelled with hard ground (tiles, asphalt)"
    assert "never move" in why_none([drive("stand", 1)], nominal, HARD)
    assert "no straight driving" in why_none([arc], nominal, HARD)
    assert not reduction_ratio([], nominal).determined


def test_lags_come_back_from_starts_in_any_direction(drive, zeroed):
    found = lags([drive("complex", seed) for seed in (1, 2)], zeroed)
    assert found[ENCODER].value == pytest.approx(0.08, abs=0.004)
    assert found[CAMERA].value == pytest.approx(0.02, abs=0.003)
    assert found[DIFFERENCE].n >= 8


def test_a_delay_passes_for_a_lag_and_holes_are_left_out(drive, zeroed):
    run = drive("starts", 3)
    before, after = (lags([log], zeroed) for log in (run, changed(run, "odometry", late_s=0.03)))
    assert after[CAMERA].value - before[CAMERA].value == pytest.approx(0.03, abs=0.003)
    assert after[DIFFERENCE].value == pytest.approx(0.03, abs=0.004)
    assert after[ENCODER].value == pytest.approx(before[ENCODER].value, abs=0.001)
    whole = found_in(starts_and_stops, [run], zeroed)
    hole_s, time_s = whole[2].time_s[300], run.streams["odometry"].time_s
    holed = changed(run, "odometry", (time_s < hole_s) | (time_s > hole_s + 0.3))
    assert len(found_in(starts_and_stops, [holed], zeroed)) == len(whole) - 1
    few = time_constants(whole[:4])
    assert not any(finding.determined for finding in few)
    assert few[0].note == "4 straight starts and stops on hard ground: 5 are needed"
