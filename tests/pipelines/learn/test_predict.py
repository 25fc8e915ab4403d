"""Predictions of new runs: what is judged, named and refused, and what is written."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipelines.learn.predict import NOT_LEARNED, Settings, predict, report, run
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import fitted_model
from pipelines.report.results import as_json
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.logs.run_folders import write_run
from terrain.records import RunLog, Stream

pandas = pytest.importorskip("pandas")

TABLE = load_slip_table()


def with_stream(run, name, time_s, values, channels):
    return replace(run, streams={**run.streams, name: Stream(time_s, values, channels)})


def test_new_runs_of_known_terrain_are_predicted(model, drive_all):
    result = predict(drive_all(n_runs=2, seed=77), model, TABLE)
    json.dumps(as_json(result), allow_nan=False)
    assert result.n_windows == len(result.windows) == result.n_judged == 2 * 3 * 12
    assert result.n_unknown < 0.3 * result.n_windows
    assert result.accuracy > 0.6  # chance is one third
    right = [row.nearest == row.run_id.rpartition("_")[0] for row in result.windows]
    assert result.accuracy == pytest.approx(np.mean(right))
    assert result.filtered_accuracy >= result.accuracy - 0.1
    starts = [row.start_s for row in result.windows if row.run_id == "GRASS_1"]
    assert starts == pytest.approx(np.arange(0, 24, 2))
    assert all(1 / 3 <= row.probability <= 1 for row in result.windows)


def test_windows_unlike_all_training_are_unknown_and_take_the_fallback(model, drive):
    log = drive("strange", "GRASS", 5)
    imu = log.streams["imu"]
    shaken = imu.values * 6.0 + np.random.default_rng(0).normal(0.0, 8.0, imu.values.shape)
    found = predict([with_stream(log, "imu", imu.time_s, shaken, imu.channels)], model, TABLE)
    assert found.n_unknown == found.n_windows > 5
    row = found.windows[0]
    assert (row.terrain, row.slip_entry) == (NOT_LEARNED, TABLE.fallback)
    assert row.nearest in model.info.classes
    assert row.novelty > model.novelty.threshold
    assert row.target_slip == {s: t.slip_ratio for s, t in TABLE.targets[TABLE.fallback].items()}


def test_a_model_of_some_signals_needs_no_others_and_names_its_training_runs(runs, drive):
    """Without the steady-motion rule, which needs wheel speeds, a log needs what the features are made of."""
    runs = [run for run in runs if run.run_id[-1] in "12"]
    model = fitted_model(runs, RecipeSettings(signal_sets=("imu",), steady=False))
    new = drive("new", "GRASS", 8)
    bare = RunLog("new", "husky", {"imu": new.streams["imu"]}, new.labels)
    assert predict([bare], model, TABLE).n_windows == 12
    assert predict([runs[0], new], model, TABLE).training_runs == (runs[0].run_id,)


def test_runs_that_were_in_training_are_judged_apart_whatever_was_added_to_them(runs, drive):
    """A name, a label or estimates make no other run of the same measurements."""
    trained = [run for run in runs if run.run_id[-1] in "12"]
    model = fitted_model(trained, RecipeSettings(signal_sets=("imu",)))
    new, old = drive("new", "GRASS", 8), next(run for run in trained if run.run_id == "GRASS_1")
    wheels = old.streams["wheels"]
    estimated = with_stream(old, "slip", wheels.time_s, wheels.values[:, :1], ("slip_left_ratio",))
    again = replace(estimated, run_id="again", session="second")
    alone, found = predict([new], model, TABLE), predict([new, again], model, TABLE)
    assert (alone.training_runs, found.training_runs) == ((), ("again",))
    for name in ("accuracy", "filtered_accuracy", "accuracy_refusing", "accuracy_accepted", "n_judged"):
        assert getattr(found, name) == getattr(alone, name)
    assert (found.n_judged_training, found.n_windows) == (12, 24)
    right = [row.nearest == "GRASS" for row in found.windows if row.run_id == "again"]
    assert found.training_accuracy == pytest.approx(np.mean(right))
    answer = report(found).answer
    assert "of 12 labelled ones of runs that were not in training are right" in answer
    assert answer.endswith("of 12 labelled windows are right, which says nothing of others.")
    only = predict([again], model, TABLE)
    assert (only.accuracy, only.n_judged) == (None, 0)
    assert "; of 1 run that trained the model " in report(only).answer


def test_labels_that_were_not_trained_are_predicted_counted_and_not_judged(model, drive, drive_all):
    known = drive_all(n_runs=1, seed=5)
    targets = {name: TABLE.targets[name] for name in ("unknown", "ASPHALT")}
    alone = predict(known, model, SlipTable("bare", "unknown", targets))
    entries = {(row.terrain, row.slip_entry) for row in alone.windows if not row.reason}
    assert entries == {
        ("ASPHALT", "ASPHALT"),
        ("GRASS", "unknown"),
        ("GRAVEL", "unknown"),
    }  # without one of its own, the fallback
    for row in alone.windows:
        target = targets[row.slip_entry]["braking"]
        assert (row.target_slip["braking"], row.status["braking"]) == (target.slip_ratio, target.status)
    strange = [
        drive("lava_1", "GRASS", 8, label="LAVA"),
        drive("tar_1", "GRAVEL", 9, label="TAR", duration_s=10.0),
    ]
    both = predict(known + strange, model, TABLE)
    assert both.unknown_labels == {"LAVA": 12, "TAR": 5}
    assert both.n_unknown_labels == 17
    assert (both.accuracy, both.n_judged) == (alone.accuracy, alone.n_judged)
    assert both.n_windows == alone.n_windows + 17
    for runs, labels in ((strange, {"LAVA", "TAR"}), ([drive("r", "GRASS", 3, label=None)], {None})):
        only = predict(runs, model, TABLE)
        assert (only.accuracy, only.n_judged) == (None, 0)
        assert {row.label for row in only.windows} == labels


def test_windows_that_are_dropped_are_counted_and_the_others_do_not_change(model, drive):
    run = drive("r", "GRASS", 4)
    whole = predict([run], model, TABLE)
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[310:320] = np.nan  # from 6.2 s
    values[410:413, 2] = np.nan
    kept = np.r_[0:800, 830:1200]  # 16.0 to 16.6 s
    holed = predict([with_stream(run, "imu", imu.time_s[kept], values[kept], imu.channels)], model, TABLE)
    assert holed.dropped == {"gap": 1, "not finite": 1}
    expected = [row for row in whole.windows if row.start_s not in (6.0, 16.0)]
    for row, same in zip(holed.windows, expected, strict=True):
        assert (row.start_s, row.terrain) == (same.start_s, same.terrain)
        assert row.probability == pytest.approx(same.probability, abs=0.1 if row.start_s == 8.0 else 1e-12)
    assert holed.repaired == {"missing values interpolated": 3}
    assert "changed or left out: 3 missing values interpolated" in str(report(holed))
    nothing = predict([drive("still", "GRASS", 4, speed_mps=0.0)], model, TABLE)
    assert (nothing.windows, nothing.accuracy, nothing.dropped) == ((), None, {"not moving": 12})


def test_runs_that_do_not_fit_model_or_table_are_named(model, drive):
    run, short = drive("r", "GRASS", 4), drive("s", "GRASS", 4, duration_s=1.0)
    wheels = run.streams["wheels"]
    slower = with_stream(run, "wheels", wheels.time_s[::2], wheels.values[::2], wheels.channels)
    fewer = with_stream(run, "wheels", wheels.time_s, wheels.values[:, :3], wheels.channels[:3])
    for other, table, error, fault in (
        (slower, TABLE, DataError, "run r, stream 'wheels' runs at 5 Hz; the model, of windows at 10 Hz, "),
        (fewer, TABLE, DataError, "run r, stream 'wheels': channel 'current_right_a' is missing"),
        (short, TABLE, DataError, r"run s lasts 1\.00 s, shorter than a window of 2 s"),
        (run, replace(TABLE, robot="agrimaro"), ConfigError, "for robot 'agrimaro', run r is of 'husky'"),
    ):
        with pytest.raises(error, match=fault):
            predict([run, other], model, table)
    skipped = predict([run, short], model, replace(TABLE, robot="husky"), skip_short=True)
    assert (skipped.n_windows, skipped.dropped) == (12, {"run too short": 1})


def test_a_log_of_another_rate_is_resampled_down_to_the_least_that_the_model_has(model, drive):
    run = drive("r", "GRASS", 4)
    wheels, imu = run.streams["wheels"], run.streams["imu"]
    twice_s = np.linspace(wheels.time_s[0], wheels.time_s[-1], 2 * wheels.time_s.size - 1)
    twice = np.stack([np.interp(twice_s, wheels.time_s, column) for column in wheels.values.T], axis=1)
    faster = with_stream(run, "wheels", twice_s, twice, wheels.channels)
    slower = with_stream(faster, "imu", imu.time_s[::2], imu.values[::2], imu.channels)
    to_hz = f"{model.info.rate_hz['imu']:.4g}"
    for log, least_hz, resampled in (
        (faster, {}, {"wheels resampled from 20 to 10 Hz": 1}),
        (
            slower,
            {"imu": 25.0},
            {"wheels resampled from 20 to 10 Hz": 1, f"imu resampled from 25 to {to_hz} Hz": 1},
        ),
    ):
        taking = model._replace(info=replace(model.info, least_rate_hz=least_hz))
        found = predict([run, log], taking, TABLE)
        assert (found.n_windows, found.resampled) == (
            23,
            resampled,
        )  # the faster one ends a half sample earlier
        assert "resampled from 20 to 10 Hz" in str(found.report)
    with pytest.raises(DataError, match="run r, stream 'imu' runs at 25 Hz"):
        predict([slower], model, TABLE)


def test_the_filtered_terrain_is_that_of_the_run_so_far(model, giving, drive):
    """One window alone changes nothing, outputs that bring no evidence name no terrain, runs are apart."""
    info, log = model.info, drive("a", "GRASS", 21)
    certain = np.tile([0.05, 0.9, 0.05], (12, 1))
    certain[6] = [0.6, 0.2, 0.2]
    flat = np.tile([info.class_ratio[name] for name in info.classes], (12, 1))
    for outputs, expected in ((certain, info.classes[1]), (flat, None)):
        planned = giving(lambda windows, outputs=outputs: outputs[: len(windows)])
        planned = planned._replace(info=replace(info, share_power=1.0))
        found = predict([log, replace(log, run_id="b")], planned, TABLE).windows
        assert [row.filtered_terrain for row in found] == [expected] * 24


def test_belief_goes_on_through_a_session_and_without_a_filter_single_windows_are_reported(
    model, giving, drive
):
    log = drive("a", "GRASS", 21, duration_s=4.0)

    def outputs(windows):
        return np.array([[0.6, 0.2, 0.2] if windows.run_id[0] == "b" else [0.05, 0.9, 0.05]] * len(windows))

    planned, (first, second, _) = giving(outputs), model.info.classes
    for session, power, expected in (
        ("monday", 0.5, second),
        ("", 0.5, first),
        ("monday", None, first),
    ):
        info = replace(model.info, share_power=power)
        runs = [replace(log, run_id=name, session=session) for name in ("a", "b")]
        found = predict(runs, planned._replace(info=info), TABLE).windows
        assert [row.filtered_terrain for row in found][:3] == [second, second, expected]


@pytest.mark.parametrize(("ending", "read"), [(".csv", pandas.read_csv), (".parquet", pandas.read_parquet)])
def test_predictions_are_written_by_the_ending_of_the_file(tracked, drive, tmp_path, ending, read):
    write_run(drive("r", "GRASS", 3), tmp_path / "runs")
    out = tmp_path / f"predicted{ending}"
    result = run(Settings(data=tmp_path / "runs", model=str(tracked[0] / "model"), out=out))
    table = read(out)
    assert table["terrain"].tolist() == [row.terrain for row in result.windows]
    slips = [row.target_slip["traction"] for row in result.windows]
    assert table["target_slip_traction"].tolist() == pytest.approx(slips)
    assert table["terrain_set"].tolist() == [" ".join(row.terrain_set) for row in result.windows]
    assert {"run_id", "start_s", "probability", "status_traction"} <= set(table.columns)
    assert "of 12 labelled ones are right" in result.report.answer


def test_a_model_of_windows_at_a_lower_rate_takes_logs_from_there_on(runs, drive):
    """For a slower robot: trained on windows that were resampled to its rate, as they are live."""
    few = [run for run in runs if run.run_id[-1] in "12"]
    model = fitted_model(few, RecipeSettings(rate=("imu=25",)))
    assert model.info.rate_hz["imu"] == 25.0
    log = drive("r", "GRASS", 4)
    imu = log.streams["imu"]
    slower = with_stream(log, "imu", imu.time_s[::2], imu.values[::2], imu.channels)
    (sentence,) = predict([log, slower], model, TABLE).resampled.items()
    assert sentence == ("imu resampled from 50 to 25 Hz", 1)
    for text, fault in (
        ("imu", "STREAM=HZ is required, as in imu=50"),
        ("imu=-1", "STREAM=HZ"),
        ("=9", "STREAM=HZ"),
    ):
        with pytest.raises(ConfigError, match=fault):
            RecipeSettings(rate=(text,))
    with pytest.raises(
        DataError, match="runs at 50 Hz; the model, of windows at 80 Hz, needs at least 80 Hz"
    ):
        fitted_model(few, RecipeSettings(rate=("imu=80",)))


def test_a_model_of_slip_that_was_measured_from_outside_refuses_logs_without_it(runs, drive):
    def measured(run):
        time_s = run.streams["wheels"].time_s
        found = with_stream(
            run, "slip", time_s, np.full((time_s.size, 2), 0.1), ("slip_left_ratio", "slip_right_ratio")
        )
        return replace(found, filter="pose")

    model = fitted_model([measured(run) for run in runs if run.run_id[-1] in "12"])
    log = drive("r", "GRASS", 4)
    assert predict([measured(log)], model, TABLE).n_windows == 12
    with pytest.raises(
        DataError, match="trained on estimates of the filter 'pose', which robot husky does not run"
    ):
        predict([log], model, TABLE)
