"""Predictions of new runs: what is judged, named and refused, and what is written."""

import json
from dataclasses import replace

import numpy as np
import pytest

from features.windows import cut_windows
from pipelines.learn.model_file import read_model
from pipelines.learn.predict import NOT_LEARNED, Settings, filtered_terrains, predict, run
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import fitted_model
from pipelines.live.model import Assessed
from pipelines.report.json_file import as_json
from terrain.control.slip_table import DRIVE_STATES, SlipTable, load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream


@pytest.fixture
def model(tracked):
    return read_model(tracked[0] / "model")


def test_new_runs_of_known_terrain_are_predicted(model, drive_all):
    runs = drive_all(n_runs=2, seed=77)
    result = predict(runs, model, load_slip_table())
    document = as_json(result)
    json.dumps(document, allow_nan=False)
    assert document["training_runs"] == []
    assert result.n_windows == len(result.windows) == result.n_judged == 2 * 3 * 12
    assert result.accuracy > 0.6  # chance is one third
    right = [row.nearest == row.run_id.rpartition("_")[0] for row in result.windows]
    assert result.accuracy == pytest.approx(np.mean(right))
    starts = [row.start_s for row in result.windows if row.run_id == "GRASS_1"]
    assert starts == pytest.approx(np.arange(0, 24, 2))
    for row in result.windows:
        assert 1 / 3 <= row.probability <= 1
        assert set(row.target_slip) == set(DRIVE_STATES)


@pytest.fixture(scope="module")
def strange(drive_all):
    """A run that shakes as no run of the training did."""
    log = drive_all(n_runs=1, seed=5)[0]
    imu = log.streams["imu"]
    values = imu.values * 6.0 + np.random.default_rng(0).normal(0.0, 8.0, imu.values.shape)
    return RunLog("strange", log.robot, {**log.streams, "imu": Stream(imu.time_s, values, imu.channels)})


def test_windows_unlike_all_training_are_unknown_and_take_the_fallback(model, drive_all, strange):
    table = load_slip_table()
    found = predict([strange], model, table)
    assert found.n_unknown == found.n_windows > 5
    row = found.windows[0]
    assert (row.terrain, row.slip_entry) == (NOT_LEARNED, table.fallback)
    assert row.nearest in model.info.classes
    assert row.novelty > model.novelty.threshold
    assert row.target_slip == {s: t.slip_ratio for s, t in table.targets[table.fallback].items()}
    known = predict(drive_all(n_runs=2, seed=77), model, table)
    assert known.n_unknown < 0.3 * known.n_windows


def test_training_runs_among_new_ones_are_named(model, runs, drive):
    assert predict(runs, model, load_slip_table()).training_runs == tuple(run.run_id for run in runs)
    result = predict([runs[0], drive("new", "GRASS", 8)], model, load_slip_table())
    assert result.training_runs == (runs[0].run_id,)


def test_a_model_of_some_signals_needs_no_others(runs, drive):
    """Without the steady-motion rule, which needs wheel speeds, a log needs what the features are made of."""
    model = fitted_model(runs, RecipeSettings(signal_sets=("imu",), steady=False))
    new = drive("new", "GRASS", 8)
    bare = RunLog("new", "husky", {"imu": new.streams["imu"]}, new.labels)
    assert predict([bare], model, load_slip_table()).n_windows == 12


def test_labels_that_were_not_trained_are_predicted_counted_and_not_judged(model, drive, drive_all):
    known = drive_all(n_runs=1, seed=5)
    alone = predict(known, model, load_slip_table())
    strange = [
        drive("lava_1", "GRASS", 8, label="LAVA"),
        drive("tar_1", "GRAVEL", 9, label="TAR", duration_s=10.0),
    ]
    both = predict(known + strange, model, load_slip_table())
    assert both.unknown_labels == {"LAVA": 12, "TAR": 5}
    assert both.n_unknown_labels == 17
    assert (both.accuracy, both.n_judged) == (alone.accuracy, alone.n_judged)
    assert both.n_windows == alone.n_windows + 17
    assert {row.terrain for row in both.windows} <= set(both.classes)
    for runs in (strange, [drive("r", "GRASS", 3, label=None)]):
        only = predict(runs, model, load_slip_table())
        assert (only.accuracy, only.n_judged) == (None, 0)
    assert {row.label for row in only.windows} == {None}


def test_a_terrain_without_an_entry_gets_the_named_fallback(model, drive_all):
    table = load_slip_table()
    bare = SlipTable(
        "bare", "unknown", {"unknown": table.targets["unknown"], "ASPHALT": table.targets["ASPHALT"]}
    )
    result = predict(drive_all(n_runs=1, seed=5), model, bare)
    entries = {(row.terrain, row.slip_entry) for row in result.windows}
    assert entries == {("ASPHALT", "ASPHALT"), ("GRASS", "unknown"), ("GRAVEL", "unknown")}
    for row in result.windows:
        for state in DRIVE_STATES:
            target = bare.targets[row.slip_entry][state]
            assert (row.target_slip[state], row.status[state]) == (target.slip_ratio, target.status)


def test_a_table_of_another_robot_is_refused(model, drive):
    run = drive("r", "GRASS", 3)
    table = load_slip_table()
    assert predict([run], model, replace(table, robot=run.robot)).n_runs == 1
    with pytest.raises(ConfigError, match="is for robot 'agrimaro', run r is of 'husky'"):
        predict([run], model, replace(table, robot="agrimaro"))


def test_windows_that_are_dropped_are_counted_and_the_others_do_not_change(model, drive):
    run = drive("r", "GRASS", 4)
    whole = predict([run], model, load_slip_table())
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[310] = np.nan  # 6.2 s
    kept = np.r_[0:800, 830:1200]  # 16.0 to 16.6 s
    streams = {**run.streams, "imu": Stream(imu.time_s[kept], values[kept], imu.channels)}
    holed = predict([RunLog("r", "husky", streams, run.labels)], model, load_slip_table())
    assert holed.dropped == {"gap": 1, "not finite": 1}
    expected = [row for row in whole.windows if row.start_s not in (6.0, 16.0)]
    assert len(holed.windows) == 10
    for row, same in zip(holed.windows, expected, strict=True):
        assert (row.start_s, row.terrain) == (same.start_s, same.terrain)
        assert row.probability == pytest.approx(same.probability, abs=1e-12)
    still = drive("still", "GRASS", 4, speed_mps=0.0)
    nothing = predict([still], model, load_slip_table())
    assert (nothing.windows, nothing.accuracy, nothing.dropped) == ((), None, {"not moving": 12})


def test_runs_that_do_not_fit_the_model_are_named(model, drive):
    run = drive("r", "GRASS", 4)
    wheels = run.streams["wheels"]
    slower = Stream(wheels.time_s[::2], wheels.values[::2], wheels.channels)
    fewer = Stream(wheels.time_s, wheels.values[:, :3], wheels.channels[:3])
    for stream, fault in (
        (slower, "run r, stream 'wheels' runs at 5 Hz where 10 Hz is expected"),
        (fewer, "run r, stream 'wheels': channel 'current_right_a' is missing"),
    ):
        with pytest.raises(DataError, match=fault):
            predict([RunLog("r", "husky", {**run.streams, "wheels": stream})], model, load_slip_table())
    short = drive("s", "GRASS", 4, duration_s=1.0)
    with pytest.raises(DataError, match=r"run s lasts 1\.00 s, shorter than a window of 2 s"):
        predict([run, short], model, load_slip_table())
    skipped = predict([run, short], model, load_slip_table(), skip_short=True)
    assert (skipped.n_windows, skipped.dropped) == (12, {"run too short": 1})


def outputs(probability):
    """Return outputs without a score of novelty."""
    nothing = np.full(len(probability), np.nan)
    return Assessed(probability, nothing, np.zeros(len(probability), dtype=bool), nothing, nothing)


def test_the_filtered_terrain_is_that_of_the_windows_so_far(model, drive):
    """Windows of one terrain that follow each other are a run; the run before it does not matter."""
    runs = [drive("a", "GRASS", 21), drive("b", "GRAVEL", 22)]
    both = predict(runs, model, load_slip_table())
    alone = predict(runs[1:], model, load_slip_table())
    of_b = [row.filtered_terrain for row in both.windows if row.run_id == "b"]
    assert of_b == [row.filtered_terrain for row in alone.windows]
    assert both.filtered_accuracy >= both.accuracy - 0.1
    classes = np.array(both.classes)
    probability = np.full((24, len(classes)), 0.05)
    probability[:, 1] = 0.9
    probability[10] = [0.6, 0.2, 0.2]  # one window alone
    windows = cut_windows(runs, model.rule).windows
    first = windows[windows.run_id == "a"]
    found = filtered_terrains(first, outputs(probability[: len(first)]), model)
    assert set(found.tolist()) == {classes[1]}
    flat = np.tile([model.info.class_ratio[name] for name in classes], (len(first), 1))
    assert set(filtered_terrains(first, outputs(flat), model)) == {""}


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_predictions_are_written_by_the_ending_of_the_file(tracked, drive, tmp_path, ending):
    write_run(drive("r", "GRASS", 3), tmp_path / "runs")
    out = tmp_path / f"predicted{ending}"
    result = run(Settings(data=tmp_path / "runs", model=str(tracked[0] / "model"), out=out))
    pd = pytest.importorskip("pandas")
    table = pd.read_csv(out) if ending == ".csv" else pd.read_parquet(out)
    assert len(table) == result.n_windows == 12
    assert table["terrain"].tolist() == [row.terrain for row in result.windows]
    assert {"run_id", "start_s", "probability", "target_slip_traction", "status_traction"} <= set(
        table.columns
    )
    assert result.to_pandas().columns.tolist() == table.columns.tolist()
    assert "of 12 labelled ones are right" in result.report.answer


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "--model is missing"),
        ({"model": "m", "changes": "x"}, "--model and --changes do not go together"),
        (
            {"model": "m", "out": "p.xlsx"},
            r"--out is p\.xlsx: a name that ends in \.parquet or \.csv is accepted",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused(options, sentence):
    with pytest.raises(ConfigError, match=sentence):
        Settings(data="runs", **options)
