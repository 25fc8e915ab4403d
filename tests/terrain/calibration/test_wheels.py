from dataclasses import replace

import numpy as np

from terrain.calibration.wheels import (
    direction_of,
    reduction_ratio,
    steady_stretches,
    steering_zeros,
    why_none,
)
from terrain.records import RunLog
from terrain.simulation.scenario import Conditions

HARD = ("tiles", "asphalt")


def stretches_of(runs, robot, hard=HARD):
    return [stretch for run in runs for stretch in steady_stretches(run, robot, hard)]


def test_side_slip_is_no_noise_that_averages_out(drive, nominal, truth):
    """The plain mean of angle less direction is off, and alike in every run."""
    zeros, errors, plain = [truth(f"steering.zero_{i}_rad") for i in (1, 2, 3)], [], []
    for seed in range(3):
        stretches = stretches_of([drive("complex", seed)], nominal)
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
    stretches = stretches_of(runs, nominal)
    findings = [*steering_zeros(stretches, nominal), reduction_ratio(stretches, nominal)]
    for finding in findings:
        assert finding.low <= truth(finding.parameter) <= finding.high
    assert findings[3].runs == tuple(run.run_id for run in runs)


def test_zeros_may_lie_anywhere_on_the_turn(drive, nominal, hidden):
    zeros = (2.5, -1.2, 3.13)
    names = ("zero_1_rad", "zero_2_rad", "zero_3_rad")
    robot = hidden.with_parts(steering=replace(hidden.steering, **dict(zip(names, zeros, strict=True))))
    findings = steering_zeros(stretches_of([drive("complex", 4, robot=robot)], nominal), nominal)
    found = np.array([finding.value for finding in findings])
    np.testing.assert_allclose(np.angle(np.exp(1j * (found - zeros))), 0.0, atol=0.0015)
    assert (np.abs(found) <= np.pi).all()


def test_forward_driving_alone_determines_the_ratio_but_no_zero(drive, nominal):
    stretches = stretches_of([drive("starts", seed) for seed in range(4)], nominal)
    assert {direction_of(stretch) for stretch in stretches} == {"forward"}
    for finding in steering_zeros(stretches, nominal):
        assert not finding.determined
        assert (
            "driven forward, undetermined: drive straight forward, backward and to both sides" in finding.note
        )
    assert reduction_ratio(stretches, nominal).determined


def test_stretches_are_steady_straight_and_on_hard_ground(drive, nominal, hidden):
    run = drive("complex", 5)
    directions = [direction_of(stretch) for stretch in steady_stretches(run, nominal, HARD)]
    assert set(directions) == {"forward", "backward", "left", "right", "diagonally"}
    # all starts of a run stand with their plays alike: one stretch
    assert len(steady_stretches(drive("starts", 5), nominal, HARD)) == 1
    assert steady_stretches(drive("arc", 5), nominal, HARD) == []
    assert steady_stretches(drive("complex", 5, terrain="grass"), nominal, HARD) == []


def test_missing_steady_stretches_are_explained(drive, nominal):
    run = drive("straight", 1)
    blind = RunLog("r", run.robot, {k: v for k, v in run.streams.items() if k != "odometry"}, run.labels)
    assert why_none([blind], nominal, HARD) == "no run has a camera (stream 'odometry')"
    soft = drive("straight", 1, terrain="grass")
    assert why_none([soft], nominal, HARD) == "no run is labelled with hard ground (tiles, asphalt)"
    assert "never move" in why_none([drive("stand", 1)], nominal, HARD)
    assert "no straight driving" in why_none([drive("arc", 1)], nominal, HARD)
    assert not reduction_ratio([], nominal).determined
