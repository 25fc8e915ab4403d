from dataclasses import replace

import numpy as np
import pytest
import yaml
from studies.intervals import HIDDEN, NOMINAL, RTK_TRUTH, drive_hidden, rtk_run

from pipelines.report.results import silent
from pipelines.slip.calibrate import Settings, run
from terrain.errors import DataError
from terrain.estimation.feed import measurement_table
from terrain.logs.run_folders import write_run
from terrain.records import Stream
from terrain.robots import description_file, load_robot
from terrain.simulation.run import six_positions_log

SOURCE = description_file("agrimaro").read_text(encoding="utf-8")


def calibrate(data, robot, out=None):
    return run(Settings(data=data, robot=robot, out=out), silent)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A data set of the hidden robot, its calibration, and the file that it wrote."""
    folder = tmp_path_factory.mktemp("calibrate")
    runs = [
        *(drive_hidden("stand", seed, duration_s=10.0) for seed in range(3)),
        *(drive_hidden("starts", seed) for seed in range(2)),
        *(drive_hidden("complex", seed) for seed in range(2)),
        six_positions_log(HIDDEN, 7),
    ]
    for each in runs:
        write_run(each, folder / "runs")
    out = folder / "robots" / "calibrated.yaml"
    return folder / "runs", out, calibrate(folder / "runs", "agrimaro", out)


def test_the_hidden_truth_lies_in_the_intervals(calibrated):
    _, _, result = calibrated
    inside = []
    for finding in result.findings:
        section, _, name = finding.parameter.partition(".")
        if finding.determined and name and section != "identified":
            inside.append(finding.low <= getattr(getattr(HIDDEN, section), name) <= finding.high)
            assert finding.low <= finding.value <= finding.high
            assert finding.n > 0
            assert finding.runs
    assert len(inside) == 24
    assert np.mean(inside) >= 0.9
    assert len(result.to_pandas()) == len(result.findings)
    assert result.report.answer.startswith("27 numbers of agrimaro are determined by 8 runs")


def test_the_file_is_a_description_that_people_can_read(calibrated):
    _, out, result = calibrated
    robot = load_robot(out)
    text = out.read_text(encoding="utf-8")
    described, before = yaml.safe_load(text), yaml.safe_load(SOURCE)
    assert robot.name == "agrimaro"
    assert text.startswith("# Calibrated from 8 runs;")
    found = {finding.parameter: finding for finding in result.findings if finding.determined}
    for name, finding in found.items():
        section, _, number = name.partition(".")
        if not number:
            continue
        assert f"  {number}: {{value: " in text  # one line a number
        entry, _ = described[section].pop(number), before.get(section, {}).pop(number, None)
        assert entry["source"].startswith(f"terrain calibrate, {len(finding.runs)} run")
        width = finding.high - finding.low
        assert entry["value"] == pytest.approx(finding.value, abs=0.01 * width)
        assert entry["interval"] == pytest.approx([finding.low, finding.high], abs=0.01 * width)
    assert described.pop("identified") == {}
    assert described == before


def test_what_filters_are_given_is_right_afterwards(calibrated):
    _, out, _ = calibrated
    turning = drive_hidden("complex", 50)
    truth = turning.streams["truth"]
    steer = [f"steer_{i}_rad" for i in (1, 2, 3)]
    errors = []
    for robot in (NOMINAL, load_robot(out)):
        table = measurement_table(turning, robot)
        # the truth behind the encoders' lag, which all rows have
        then_s = table.time_s - HIDDEN.sensors.encoder_time_constant_s
        true = np.column_stack([np.interp(then_s, truth.time_s, truth.channel(name)) for name in steer])
        errors.append(np.abs(np.nanmean(table.columns(steer) - true, axis=0)).max())
    assert errors[0] > 0.015
    assert errors[1] < 0.003
    cruise = measurement_table(drive_hidden("straight", 52), load_robot(out))
    rates = cruise.columns([f"wheel_{i}_radps" for i in (1, 2, 3)])
    camera = cruise.columns(["camera_speed_x_mps"])
    assert rates[500:].mean() * 0.2 == pytest.approx(camera[500:].mean(), rel=0.01)


def test_a_calibrated_file_can_be_calibrated_again(calibrated, tmp_path):
    runs, out, first = calibrated
    second = calibrate(runs, str(out), tmp_path / "again.yaml")
    for one, other in zip(first.findings, second.findings, strict=True):
        if one.determined:
            half = (one.high - one.low) / 2
            assert other.value == pytest.approx(one.value, abs=half)


@pytest.mark.parametrize("kept", ["stand alone", "no camera"])
def test_runs_tell_what_they_can_and_why_not_the_rest(tmp_path, kept):
    for scenario in ("stand",) if kept == "stand alone" else ("stand", "complex"):
        each = drive_hidden(scenario, 1)
        blind = {name: stream for name, stream in each.streams.items() if name != "odometry"}
        write_run(each if kept == "stand alone" else replace(each, streams=blind), tmp_path)
    result = calibrate(tmp_path, "agrimaro")
    found = {finding.parameter: finding for finding in result.findings}
    assert result.out is None
    assert found["sensors.gyro_bias_z_radps"].determined
    assert "like a tilt" in found["sensors.accel_bias_x_mps2"].note
    why = "never move" if kept == "stand alone" else "no run has a camera (stream 'odometry')"
    for parameter in ("steering.zero_2_rad", "motors.reduction_ratio", "camera.time_constant_s"):
        assert why in found[parameter].note


FOUR_NUMBERS = """name: husky
drive: skid_steer
wheel_radius_m: {value: 0.165, unit: m, source: maker}
track_m: {value: 0.5708, unit: m, source: maker}
wheelbase_m: {value: 0.512, unit: m, source: maker}
mass_kg: {value: 50.0, unit: kg, source: maker}
"""


@pytest.fixture
def four_numbers(tmp_path):
    file = tmp_path / "husky.yaml"
    file.write_text(FOUR_NUMBERS, encoding="utf-8")
    return file


def write_rtk(folder, n=5, missing=(), **options):
    for k in range(n):
        each, _ = rtk_run(k, **options)
        write_run(replace(each, streams={s: v for s, v in each.streams.items() if s not in missing}), folder)
    return folder


def test_a_robot_of_four_numbers_with_rtk_gets_a_whole_description(four_numbers, tmp_path):
    out = tmp_path / "calibrated.yaml"
    result = calibrate(write_rtk(tmp_path / "runs"), str(four_numbers), out)
    robot = load_robot(out)
    for name in ("rolling_radius_m", "effective_track_m", "wheels_delay_s", "gnss_delay_s"):
        assert robot.identified[name] == pytest.approx(RTK_TRUTH[name], rel=0.1), name
    assert robot.antenna.lever_x_m == pytest.approx(RTK_TRUTH["lever_x_m"], abs=0.02)
    assert robot.sensors.gyro_std_radps == pytest.approx(0.004, rel=0.1)
    assert robot.sensors.accel_std_mps2 == pytest.approx(0.05, rel=0.1)
    assert abs(robot.sensors.gyro_bias_z_radps) < 0.01
    assert "sensors.imu_rate_hz" in robot.assumed
    assert "sensors.gyro_std_radps" not in robot.assumed
    assert "numbers of husky are determined by 5 runs" in result.report.answer
    again = calibrate(tmp_path / "runs", str(out))
    assert len(again.findings) >= len(result.findings)


@pytest.mark.parametrize(
    ("missing", "number", "why"),
    [
        ("gnss", "identified.rolling_radius_m", "stream 'pose', 'lidar', 'gnss' or 'odometry'"),
        ("imu", "identified.wheels_delay_s", "no run has a gyro"),
        ("imu", "sensors.gyro_bias_z_radps", "no run has an IMU (stream 'imu')"),
        ("none", "identified.torque_per_current_nmpa", "no run has currents"),
    ],
)
def test_a_stream_that_is_missing_is_named_with_what_it_would_show(
    four_numbers, tmp_path, missing, number, why
):
    result = calibrate(write_rtk(tmp_path / "runs", missing=(missing,)), str(four_numbers))
    found = {finding.parameter: finding for finding in result.findings}
    assert not found[number].determined
    assert why in found[number].note
    assert any(finding.determined for finding in result.findings)


def test_runs_that_show_nothing_or_are_of_another_robot_are_one_sentence(four_numbers, tmp_path):
    silent_runs = write_rtk(tmp_path / "silent", n=1, missing=("gnss", "imu"), n_turns=2)
    with pytest.raises(DataError, match="nothing of robot husky can be calibrated from this: no run has"):
        calibrate(silent_runs, str(four_numbers))
    other = tmp_path / "other.yaml"
    other.write_text(FOUR_NUMBERS.replace("name: husky", "name: mine"), encoding="utf-8")
    with pytest.raises(DataError, match="is one of robot 'husky', and 'mine' is calibrated"):
        calibrate(write_rtk(tmp_path / "runs", n=1), str(other))


def test_standing_alone_shows_noise_and_bias_and_stops_nothing(four_numbers, tmp_path):
    for k in range(3):
        each, _ = rtk_run(k)
        streams = {
            name: Stream(s.time_s[s.time_s < 8.0], s.values[s.time_s < 8.0], s.channels)
            for name, s in each.streams.items()
        }
        write_run(replace(each, streams=streams, labels=()), tmp_path / "runs")
    result = calibrate(tmp_path / "runs", str(four_numbers))
    found = {finding.parameter: finding for finding in result.findings}
    for name in ("sensors.gyro_bias_z_radps", "sensors.gyro_std_radps", "identified.imu_pitch_rad"):
        assert found[name].determined, name
    assert not found["identified.rolling_radius_m"].determined
    assert found["identified.rolling_radius_m"].note
