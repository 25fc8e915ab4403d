import pytest

from terrain.calibration.lag import DIFFERENCE, starts_and_stops, time_constants
from terrain.records import RunLog, Stream

HARD = ("tiles",)


def lags(runs, robot):
    found = time_constants([event for run in runs for event in starts_and_stops(run, robot, HARD)])
    return {finding.parameter: finding for finding in found}


@pytest.fixture(scope="module")
def zeroed(nominal, hidden):
    """The description with steering and motors calibrated before."""
    return nominal.with_parts(steering=hidden.steering, motors=hidden.motors)


def test_starts_in_any_direction_count(drive, zeroed):
    found = lags([drive("complex", seed) for seed in (1, 2)], zeroed)
    assert found["sensors.encoder_time_constant_s"].value == pytest.approx(0.08, abs=0.004)
    assert found["camera.time_constant_s"].value == pytest.approx(0.02, abs=0.003)
    assert found[DIFFERENCE].n >= 8


def test_a_delay_passes_for_a_lag(drive, zeroed):
    run = drive("starts", 3)
    camera = run.streams["odometry"]
    late = Stream(camera.time_s + 0.03, camera.values, camera.channels)
    before, after = (
        lags([log], zeroed)
        for log in (run, RunLog("late", run.robot, {**run.streams, "odometry": late}, run.labels))
    )
    gained = after["camera.time_constant_s"].value - before["camera.time_constant_s"].value
    assert gained == pytest.approx(0.03, abs=0.003)
    assert after[DIFFERENCE].value == pytest.approx(0.03, abs=0.004)
    encoder = "sensors.encoder_time_constant_s"
    assert after[encoder].value == pytest.approx(before[encoder].value, abs=0.001)


def test_holes_and_curves_are_left_out(drive, zeroed):
    run = drive("starts", 4)
    whole = starts_and_stops(run, zeroed, HARD)
    camera = run.streams["odometry"]
    event = whole[2]
    kept = (camera.time_s < event.time_s[300]) | (camera.time_s > event.time_s[300] + 0.3)
    holed = {**run.streams, "odometry": Stream(camera.time_s[kept], camera.values[kept], camera.channels)}
    left = starts_and_stops(RunLog("r", run.robot, holed, run.labels), zeroed, HARD)
    assert len(left) == len(whole) - 1
    assert starts_and_stops(drive("arc", 4), zeroed, HARD) == []
    assert starts_and_stops(drive("starts", 4, terrain="grass"), zeroed, HARD) == []
    few = time_constants(whole[:4])
    assert not any(finding.determined for finding in few)
    assert few[0].note == "4 straight starts and stops on hard ground: 5 are needed"
