from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from terrain.errors import DataError
from terrain.logs import clock
from terrain.logs.clock import MAX_OFFSET_S, align, estimate_clock
from terrain.records import RunLog, Stream

TRACK_M = 0.5708
ENCODER_STEP_MPS = 0.00787
DURATION_S = 60.0
WHEEL_TIME_S = np.arange(0.0, 58.0, 1 / 6.5)
IMU_TIME_S = np.arange(0.0, DURATION_S, 0.01)


def run_of(gyro_radps, wheel_yaw_radps, origin_s=0.0):
    half_mps = wheel_yaw_radps * TRACK_M / 2
    speeds = np.column_stack([0.8 - half_mps, 0.8 + half_mps])
    speeds = np.round(speeds / ENCODER_STEP_MPS) * ENCODER_STEP_MPS
    imu = Stream(IMU_TIME_S + origin_s, gyro_radps[:, None], ("gyro_z_radps",))
    wheels = Stream(WHEEL_TIME_S + origin_s, speeds, ("speed_left_mps", "speed_right_mps"))
    return RunLog("SNOW_01", "husky", {"imu": imu, "wheels": wheels})


def hidden_clock(seed, offset_s, rate, *, turning=lambda time_s: 1.0, origin_s=0.0):
    """Random turns seen by a gyro (gain 0.6, bias, noise, slip of its own) and by quantised, noisy wheels."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(-6.0, DURATION_S + 6.0, 0.01)
    yaw, slip = (gaussian_filter1d(rng.standard_normal(time_s.size), width) for width in (60, 40))
    yaw = 0.25 * yaw / yaw.std() * turning(time_s)
    gyro = 0.6 * yaw + 0.01 * slip / slip.std() + 0.01
    gyro_radps = np.interp(IMU_TIME_S, time_s, gyro) + 0.02 * rng.standard_normal(IMU_TIME_S.size)
    wheels = np.interp((1 + rate) * WHEEL_TIME_S + offset_s, time_s, yaw)
    return run_of(gyro_radps, wheels + 0.01 * rng.standard_normal(wheels.size), origin_s)


CLOCKS = [(0.4, 0.02), (1.2, -0.01), (0.0, 0.0), (0.15, -0.03), (0.8, 0.004), (1.6, -0.02)]
HIDDEN = [(seed, s * offset_s, rate) for seed, (offset_s, rate) in enumerate(CLOCKS) for s in (1, -1)]


def test_a_hidden_clock_comes_back_within_its_own_error():
    scores = []
    for seed, offset_s, rate in HIDDEN:
        found = estimate_clock(hidden_clock(seed, offset_s, rate), track_m=TRACK_M)
        assert found.status == "estimated"
        scores.append(
            [(found.offset_s - offset_s) / found.offset_std_s, (found.rate - rate) / found.rate_std]
        )
        assert found.gain == pytest.approx(0.6, abs=0.05)
        assert found.offset_std_s < 0.05
        assert found.rate_std < 0.002
    assert np.max(np.abs(scores)) < 3.0
    # The stated errors are neither boasts nor excuses.
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.5


def test_aligned_wheels_keep_the_clock_of_the_imu():
    """A clock that counts from long ago gives the same answer."""
    run, late = hidden_clock(1, 0.5, -0.015), hidden_clock(1, 0.5, -0.015, origin_s=1.7e9)
    found, far = (estimate_clock(each, track_m=TRACK_M) for each in (run, late))
    assert far.reference_s == 1.7e9
    np.testing.assert_allclose(far.offset_s, found.offset_s, atol=0.1 * found.offset_std_s)
    aligned = align(run, found)
    np.testing.assert_allclose(aligned.streams["wheels"].time_s, 0.985 * WHEEL_TIME_S + 0.5, atol=0.05)
    again = estimate_clock(aligned, track_m=TRACK_M)
    assert abs(again.offset_s) < 0.01
    assert abs(again.rate) < 5e-4
    assert aligned.streams["imu"] is run.streams["imu"]


@pytest.mark.parametrize(("period_s", "sign"), [(0.8, 1), (3.7, -1)])
def test_a_periodic_manoeuvre_never_locks_on_to_an_image(period_s, sign):
    noise = 0.01 * np.random.default_rng(5).standard_normal(IMU_TIME_S.size)
    gyro = sign * 0.2 * np.sin(2 * np.pi * IMU_TIME_S / period_s) + noise
    run = run_of(gyro, 0.35 * np.sin(2 * np.pi * (WHEEL_TIME_S + 0.3) / period_s))
    found = estimate_clock(run, track_m=TRACK_M)
    assert found.status == "ambiguous"
    assert np.isnan(found.offset_s)
    assert align(run, found) is run
    slow = run_of(0.2 * np.sin(IMU_TIME_S / 2), 0.35 * np.sin((WHEEL_TIME_S + 0.3) / 2))
    assert estimate_clock(slow, track_m=TRACK_M).offset_s == pytest.approx(0.3, abs=0.02)


def both(one, other):
    return RunLog("A", "husky", {"imu": one.streams["imu"], "wheels": other.streams["wheels"]})


def test_what_does_not_match_is_not_matched_and_without_a_gyro_refused(monkeypatch):
    """Sides exchanged, an offset beyond the search, other turns, or hardly any."""
    run, rng = hidden_clock(2, 0.2, 0.0), np.random.default_rng(6)
    wheels = run.streams["wheels"]
    swapped = replace(run, streams={**run.streams, "wheels": replace(wheels, values=wheels.values[:, ::-1])})
    assert estimate_clock(swapped, track_m=TRACK_M).status in ("not excited", "ambiguous")
    far = hidden_clock(4, MAX_OFFSET_S + 0.4, 0.0)
    with monkeypatch.context() as narrow:
        narrow.setattr(clock, "MAX_RATE", 1e-3)
        assert estimate_clock(far, track_m=TRACK_M).status != "estimated"
    unlike = [both(hidden_clock(seed, 0.0, 0.0), hidden_clock(seed + 100, 0.0, 0.0)) for seed in range(6)]
    for turn_radps in (0.0, 0.3):
        gyro = 0.6 * turn_radps + 0.02 * rng.standard_normal(IMU_TIME_S.size)
        unlike.append(run_of(gyro, np.full(WHEEL_TIME_S.size, turn_radps)))
    imu = run.streams["imu"]
    spiked = Stream(np.r_[imu.time_s[:-1], 1e12], imu.values, imu.channels)  # costs no memory either
    unlike.append(replace(run, streams={**run.streams, "imu": spiked}))
    for each in unlike:
        found = estimate_clock(each, track_m=TRACK_M)
        assert found.status == "not excited"
        assert np.isnan([found.offset_s, found.rate, found.gain]).all()
    with pytest.raises(DataError, match="SNOW_01: clocks cannot be compared without imu"):
        estimate_clock(replace(run, streams={"wheels": wheels}), track_m=TRACK_M)


def test_one_turn_determines_the_clock_offset_but_not_its_rate():
    rate = 0.01
    run = hidden_clock(7, 0.4, rate, turning=lambda time_s: np.exp(-(((time_s - 20.0) / 2.0) ** 2)))
    found = estimate_clock(run, track_m=TRACK_M)
    assert found.status == "offset only"
    assert np.isnan(found.rate)
    shift_there_s = 0.4 + rate * 20.0
    assert found.offset_s == pytest.approx(shift_there_s, abs=0.05)
    assert abs(found.offset_s - 0.4) < found.offset_std_s


def test_gaps_and_missing_samples_are_endured():
    run = hidden_clock(8, -0.3, 0.01)
    speeds = run.streams["wheels"].values.copy()
    speeds[100:130] = np.nan
    gyro = np.delete(np.arange(IMU_TIME_S.size), np.arange(3000, 3300))
    imu = run.streams["imu"]
    streams = {
        "imu": Stream(imu.time_s[gyro], imu.values[gyro], imu.channels),
        "wheels": Stream(WHEEL_TIME_S, speeds, run.streams["wheels"].channels),
    }
    found = estimate_clock(RunLog("A", "husky", streams), track_m=TRACK_M)
    assert found.status == "estimated"
    assert abs(found.offset_s + 0.3) < 3 * found.offset_std_s
    assert abs(found.rate - 0.01) < 3 * found.rate_std


def test_measured_runs_give_plausible_clocks(measured_runs):
    """Where the turns tell, the gain is that of a skid-steer robot; steady driving is left alone."""
    runs = {run.run_id: run for run in measured_runs("borealtc")}
    for run_id in ("ASPHALT_04", "FLOORING_02", "ICE_02"):
        found = estimate_clock(runs[run_id], track_m=TRACK_M)
        ends = runs[run_id].streams["imu"].time_s[-1] / runs[run_id].streams["wheels"].time_s[-1] - 1
        assert found.status == "estimated"
        assert 0.4 < found.gain < 1.0
        assert abs(found.offset_s) < 0.3
        assert np.sign(found.rate) == np.sign(ends)  # the longer file has the faster clock
    for run_id in ("SANDY_LOAM_02", "SNOW_25"):
        assert estimate_clock(runs[run_id], track_m=TRACK_M).status == "not excited"
