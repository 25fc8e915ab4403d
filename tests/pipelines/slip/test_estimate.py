"""``terrain estimate``: tracks, pictures and JSON of runs, and tuning on chosen ones."""

import json

import numpy as np
import pytest

from pipelines.data.datasets import load, load_runs
from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.figure import Figure
from pipelines.report.pages import figure_data
from pipelines.report.results import silent
from pipelines.slip.estimate import Settings, estimate_runs, run
from pipelines.slip.filtered import slip_figure
from terrain.errors import ConfigError, DataError, LogError
from terrain.estimation.estimate import estimate_run
from terrain.logs.run_folders import read_run, write_run
from terrain.logs.schema import signal_set_of
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults
from terrain.simulation.sensors import Gnss

ROBOT = load_robot("agrimaro")


def drive(scenario="straight", terrain="grass", seed=0, **options):
    return simulate_run(ROBOT, terrain, scenario, seed, **options)


def tuned_on(runs, *names):
    return estimate_runs(runs, filter="vio15", tuning="likelihood", tune_on=names).result


def test_a_skid_steer_robot_without_a_reference_has_no_slip_to_show(datasets_dir):
    first = load_runs(datasets_dir / "vulpi")[0]
    tracks = estimate_runs([first])
    (row,) = tracks.result.runs
    assert row.finite
    assert np.isnan(tracks.runs[0].streams["slip"].values).all()
    assert row.reason == "no position, pose or speed over ground has come yet"
    assert row.reason in repr(tracks)
    with pytest.raises(ConfigError, match=r"vio15.*husky.*use slip"):
        estimate_runs([first], filter="vio15")


def test_runs_are_written_with_their_tracks_and_pictures(tmp_path):
    straight = drive(duration_s=8.0)
    write_run(straight, tmp_path / "raw")
    seen, out = [], tmp_path / "runs"
    settings = Settings(data=tmp_path / "raw", filter="vio15", out=out, figures=tmp_path / "figures")
    result = run(settings, lambda *step: seen.append(step))
    assert seen == [("estimate vio15", 1, 1)]
    document = result.as_json()
    assert set(document) == {"filter", "tuning", "tuned", "slip_model", "out", "runs", "clocks", "skipped"}
    assert json.loads(json.dumps(document)) == document
    found = read_run(out / straight.run_id)
    assert found.streams["slip"].channels == ("slip_1_ratio", "slip_2_ratio", "slip_3_ratio")
    assert found.streams["estimator"].channels[0] == "speed_x_mps"
    state = found.streams["state"]
    seen = {"slip_speed_1_mps", "std_slip_1_ratio", "stale_ratio", "observer_code", "nis_camera_speed_ratio"}
    assert seen <= set(state.channels)
    assert (state.channel("std_speed_x_mps") > 0).all()
    assert all(signal_set_of("state", channel) is None for channel in state.channels)
    assert {"speed_1_mps", "current_1_a", "motor_1_radps"} <= set(found.streams["wheels"].channels)
    assert found.labels == straight.labels
    pictures = sorted(file.name for file in (tmp_path / "figures").iterdir())
    assert pictures == [f"{straight.run_id}_{kind}.png" for kind in ("motion", "path", "slip")]
    with pytest.raises(LogError, match="is there already"):
        run(settings, silent)
    page = result.report.save(tmp_path / "page.html").read_text()
    assert f"{straight.run_id}: slip, vio15" in page
    (same,) = estimate_runs([straight], ROBOT, "vio15").runs
    np.testing.assert_array_equal(same.streams["slip"].values, found.streams["slip"].values)


def test_a_picture_of_slip_names_why_it_does_not_follow_measurements():
    lost = drive(duration_s=12.0, faults=Faults(camera_lost_s=((6.0, 9.0),)))
    panel = slip_figure(estimate_run(lost, ROBOT, "vio15")).panels[0]
    (strip,) = (
        mark
        for mark in figure_data([Figure("", [panel])])[0]["panels"][0]["marks"]
        if mark["kind"] == "strip"
    )
    (predicted,) = [span for span in strip["x"] if span[2] == "predicted"]
    assert predicted[:2] == pytest.approx((6.1, 9.1), abs=0.3)


def test_json_and_report_have_one_shape_whichever_filter_made_them():
    tracked = simulate_run(load_robot("orchard_ugv"), "tilled_loam", "straight", 0, duration_s=10.0)
    results = [
        estimate_runs(runs, filter=name).result
        for runs, name in (
            ([drive(duration_s=8.0)], "vio15"),
            ([tracked], "tracked"),
            ([tracked], "gyrodometry"),
        )
    ]
    first, *others = (each.as_json() for each in results)
    for other in others:
        assert set(other) == set(first)
        assert set(other["runs"][0]) == set(first["runs"][0])
    assert [bool(each["runs"][0]["slip"]) for each in (first, *others)] == [True, True, False]
    assert [each["tuning"] for each in (first, *others)] == ["physical", None, None]
    assert "slip is not known" in results[2].report.answer


def test_process_noise_is_tuned_on_chosen_runs():
    """With a receiver or without: it serves the other as well."""
    runs = [drive(duration_s=8.0, number=1, gnss=Gnss()), drive(duration_s=8.0, number=2)]
    for run_id in (each.run_id for each in runs):
        result = tuned_on(runs, run_id)
        assert result.tuned.runs == (run_id,)
        assert result.tuned.log_likelihood_after > result.tuned.log_likelihood_before
        assert all(row.finite and row.slip_observable for row in result.runs)
        assert ["gnss_position" in row.nis for row in result.runs] == [True, False]
    with pytest.raises(DataError, match="no run 'grass_7' to tune on"):
        tuned_on(runs, "grass_7")
    with pytest.raises(ConfigError, match="go with the tuning 'likelihood', not 'physical'"):
        estimate_runs(runs, filter="vio15", tune_on=(runs[0].run_id,))


def test_loggers_that_are_apart_are_named_and_aligned_on_request(tmp_path):
    """The wheels are logged 0.4 s late: without a word the effective track would be a fiction."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 40.0, 0.02)
    turn = np.convolve(rng.normal(size=time_s.size), np.ones(50) / 50, "same") * 4.0
    gyro = Stream(time_s, np.column_stack([turn + 0.01 * rng.normal(size=time_s.size)]), ("gyro_z_radps",))
    half = 0.5 * 1.5 * turn * 0.5708
    wheels = Stream(
        time_s + 0.4, np.column_stack([0.5 - half, 0.5 + half]), ("speed_left_mps", "speed_right_mps")
    )
    late = RunLog("late", "husky", {"imu": gyro, "wheels": wheels}, (Label(0.0, 40.0, "ICE"),))
    (sentence,) = estimate_runs([late], filter="slip").result.clocks
    assert (
        "look apart in 1 of 1 runs, by -0.4" in sentence
    )  # slip that varies from turn to turn looks like it
    write_run(late, tmp_path)
    assert run(Settings(data=tmp_path, filter="slip", align=True), silent).clocks == ()
    loaded = load(AlignedRunsSettings(data=tmp_path, align=True))[0][0]
    assert loaded.streams["wheels"].time_s[0] == pytest.approx(0.0, abs=0.05)


def test_an_observer_gives_slip_of_tracks_and_a_path():
    tracked = simulate_run(load_robot("orchard_ugv"), "tilled_loam", "complex", 0, duration_s=24.0)
    tracks = estimate_runs([tracked], filter="tracked")
    (row,) = tracks.result.runs
    assert set(row.slip) == {"slip_left_ratio", "slip_right_ratio"}
    assert {"slip", "estimator", "state"} <= set(tracks.runs[0].streams)
    assert [name.rpartition("_")[2] for name in tracks.result.pictures] == ["motion", "slip", "path"]
