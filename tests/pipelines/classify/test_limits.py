"""A model knows its limits: unknown windows, unsupported predictions, sets of terrains; live as in a log."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from features.motion import window_motion
from features.windows import cut_windows
from pipelines.classify.limits import LimitData, limits_of
from pipelines.classify.predict import NOT_LEARNED, predict
from pipelines.live.classifying import classify_window
from pipelines.live.model import assess, class_sets
from pipelines.live.observer import Observer
from pipelines.live.over_time import filtered, novelty_evidence
from pipelines.models.model_files import INFO_FILE, read_lean_model, read_model, write_info
from pipelines.models.novelty_file import NOVELTY_FILE
from pipelines.reporting.json_file import as_json
from terrain.classify.conformal import held_out_scores
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, ModelError
from terrain.logs.replay import replay
from terrain.records import RunLog, Stream


@pytest.fixture(scope="module")
def model(tracked):
    return read_model(tracked[0] / "model")


@pytest.fixture(scope="module")
def strange(drive_all):
    """A run that shakes as no run of the training did."""
    run = drive_all(n_runs=1, seed=5)[0]
    imu = run.streams["imu"]
    values = imu.values * 6.0 + np.random.default_rng(0).normal(0.0, 8.0, imu.values.shape)
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    return RunLog("strange", run.robot, streams)


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
    json.dumps(as_json(found), allow_nan=False)


def test_the_answer_of_each_window_live_is_that_of_a_log(model, strange, drive_all):
    for run in (strange, drive_all(n_runs=1, seed=78)[1]):
        rows = predict([run], model, load_slip_table()).windows
        observer = Observer(model, load_slip_table())
        live = [one for sample in replay(run, 50.0) for one in observer.update(sample.readings)]
        assert [one.start_s for one in live] == [row.start_s for row in rows]
        for one, row in zip(live, rows, strict=True):
            assert (one.terrain or NOT_LEARNED) == row.terrain
            assert one.output.nearest == row.nearest
            assert one.output.novelty == pytest.approx(row.novelty)
            assert one.output.supported == row.supported
            assert {s: t.slip_ratio for s, t in one.target.items()} == row.target_slip
        if run is strange:
            assert observer.belief.terrain == ""


def spliced(runs, each_s):
    """Return one log of the first seconds of several runs, one after the other, labelled each."""
    streams, labels = {}, []
    for name, first in runs[0].streams.items():
        parts = [run.streams[name] for run in runs]
        kept = [part.time_s - part.time_s[0] < each_s for part in parts]
        time_s = [
            p.time_s[k] - p.time_s[0] + i * each_s for i, (p, k) in enumerate(zip(parts, kept, strict=True))
        ]
        values = np.concatenate([part.values[k] for part, k in zip(parts, kept, strict=True)])
        streams[name] = Stream(np.concatenate(time_s), values, first.channels)
    labels = [(i * each_s, (i + 1) * each_s, run.labels[0].terrain) for i, run in enumerate(runs)]
    return RunLog("spliced", runs[0].robot, streams, tuple(labels))


def test_the_filter_follows_a_change_of_ground_live_as_in_a_log(model, drive_all):
    grounds = [run for run in drive_all(n_runs=1, seed=90) if run.run_id.startswith(("ASPHALT", "GRAVEL"))]
    run = spliced(grounds, 16.0)
    over_time = filtered(model)
    rows = predict([run], over_time, load_slip_table()).windows
    observer = Observer(over_time, load_slip_table())
    believed = []
    for sample in replay(run, 50.0):
        for _ in observer.update(sample.readings):
            believed.append(observer.belief.terrain)
    assert len(rows) > 100
    assert np.diff([row.start_s for row in rows])[:5] == pytest.approx(0.25)
    assert believed == [row.filtered_terrain or "" for row in rows]
    end_s = np.array([row.start_s + 2.0 for row in rows])
    first, second = (label.terrain for label in run.labels)
    named = np.array(believed)
    assert np.mean(named[(end_s > 6) & (end_s < 16)] == first) > 0.9
    changed_s = end_s[(end_s > 16) & (named == second)].min()
    assert 16.0 < changed_s < 20.0
    assert np.mean(named[end_s > 21] == second) > 0.9


def test_a_gap_and_an_unknown_ground_widen_the_belief(model, strange):
    over_time = filtered(model)
    run = strange
    observer = Observer(over_time, load_slip_table())
    for sample in replay(run, 50.0):
        observer.update(sample.readings)
    assert observer.belief.terrain == ""


@pytest.mark.parametrize("stride_s", [0.0, -1.0, 2.5, float("nan")])
def test_strides_that_are_none_are_refused(model, stride_s):
    with pytest.raises(ConfigError, match="filter stride"):
        filtered(model, stride_s)
    assert filtered(model, None) is model


def test_evidence_of_novelty_is_of_the_unknown():
    flagged, passed, none = novelty_evidence(np.array([9.0, 1.0, np.nan]), np.array([True, False, False]))
    assert flagged > 0 > passed
    assert none == 0


def test_sets_of_terrains_hold_the_true_one_in_most_windows(model, drive_all):
    rows = predict(drive_all(n_runs=3, seed=79), model, load_slip_table()).windows
    covered = np.mean([row.label in row.terrain_set for row in rows])
    assert covered > 0.8  # 0.9 on average over runs like those of the training
    assert all(row.nearest in row.terrain_set for row in rows)
    assert class_sets(model._replace(info=replace(model.info, conformal=None)), np.eye(3)) is None


def test_a_model_without_limits_names_every_window(model, strange):
    bare = model._replace(novelty=None, support=None, info=replace(model.info, conformal=None))
    found = predict([strange], bare, load_slip_table())
    assert (found.n_unknown, found.n_unsupported) == (0, None)
    row = found.windows[0]
    assert (row.novelty, row.supported, row.terrain_set) == (None, None, None)
    assert row.terrain == row.nearest


def test_a_model_read_whole_and_lean_assesses_alike(tracked, runs):
    whole, lean = (read(tracked[0] / "model") for read in (read_model, read_lean_model))
    windows = cut_windows(runs[:2], whole.rule, layout=whole.layout).windows
    one, two = assess(whole, windows), assess(lean, windows)
    np.testing.assert_allclose(one.probability, two.probability, atol=1e-12)
    np.testing.assert_allclose(one.novelty, two.novelty, atol=1e-9)
    assert np.array_equal(one.supported, two.supported)
    assert classify_window(lean, windows[0]).nearest == whole.recipe.classes_[one.probability[0].argmax()]


def test_limits_that_the_data_do_not_give_are_none_with_a_reason(model, runs):
    windows = cut_windows(runs[:1], model.rule, layout=model.layout).windows
    classifier = SimpleNamespace(
        classes_=np.unique(windows.terrain), inner_probability_=np.full((12, 1), np.nan)
    )
    terrain, run_id = windows.terrain.astype(str), windows.run_id.astype(str)
    data = LimitData(model.recipe.matrix.of(windows), terrain, run_id, window_motion(windows))
    found = limits_of(classifier, data, 1, 0)
    assert (found.novelty, found.conformal) == (None, None)
    assert [note.partition(":")[0] for note in found.notes] == [
        "no window is ever called unknown",
        "no sets of terrains",
    ]
    scores = held_out_scores(model.recipe[-1], cut_windows(runs, model.rule).windows.terrain.astype(str))
    assert 0 <= np.nanmin(scores) < np.nanmax(scores) <= 1


@pytest.mark.parametrize("damage", ["cut", "other features", "other classes", "support"])
def test_damaged_limits_are_refused_in_one_sentence(model_dir, model, damage):
    info, file = model.info, model_dir / NOVELTY_FILE
    if damage == "support":
        info = replace(info, support={"n_runs": {"GRASS": "many"}})
    else:
        with np.load(file) as arrays:
            whole = {name: arrays[name] for name in arrays.files}
        if damage == "cut":
            file.write_bytes(file.read_bytes()[:100])
        elif damage == "other features":
            settings = whole["settings"].copy()
            settings[1] += 1
            np.savez(file, **{**whole, "settings": settings})
        else:
            np.savez(file, **{**whole, "means": whole["means"][:-1]})
    write_info(model_dir, info)
    for read in (read_model, read_lean_model):
        with pytest.raises(ModelError) as refusal:
            read(model_dir)
        assert len(str(refusal.value).splitlines()) == 1
    assert (model_dir / INFO_FILE).is_file()
