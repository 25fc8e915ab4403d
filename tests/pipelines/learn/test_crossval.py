"""Recipes and models on held-out runs: what is in the data is found, what is not is not, and bad data are named."""

import json
import re
from dataclasses import fields, replace

import numpy as np
import pytest
from sklearn.model_selection import cross_val_predict

from features.protocols import folds_of, samples_of
from features.recipes import feature_matrix, make_recipe
from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.inspect import run as inspect_runs
from pipelines.learn import evaluate as evaluation
from pipelines.learn.comparison import compare_models
from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.evaluate import evaluate
from pipelines.learn.model_file import read_files
from pipelines.report.numbers import format_counts
from pipelines.report.results import as_json
from terrain.classify.folds import Fold
from terrain.classify.held_out import Examples, FoldResult, HeldOut, Looks, refused_rows
from terrain.classify.limits import SupportLevel
from terrain.classify.metrics import Verdict
from terrain.errors import DataError
from terrain.logs.run_folders import write_run
from terrain.records import Label, RunLog, Stream, Windows

SPEEDS = (0.3, 0.4, 0.7, 0.8)


@pytest.fixture(scope="module")
def report(runs, settings):
    return crossval(runs, settings(repeats=2))


@pytest.fixture(scope="module")
def with_extras(drive, settings):
    """Runs of three terrains, two of them slow and two fast, and their evaluation with all checks."""
    runs = [
        drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), 32.0, speed_mps=speed)
        for terrain in ("ASPHALT", "GRASS", "GRAVEL")
        for i, speed in enumerate(SPEEDS)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("terrain.classify.held_out.CURVE_RUNS", (1,))
        return runs, crossval(runs, settings(extras=True))


def test_the_report_has_what_is_promised_and_is_json(report):
    document = as_json(report)
    known = {each.name for each in fields(report) if each.metadata and getattr(report, each.name) is not None}
    assert set(document) == known | {"stride_s"}
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (report.n_runs, report.n_windows, report.window_s) == (12, 144, 2.0)
    assert (len(report.folds), len(report.per_run), report.repeats) == (10, 12, 2)
    low, high = report.accuracy_ci
    assert 0.5 < low <= report.accuracy <= high <= 1.0  # terrains that differ are distinguished
    assert np.sum(report.confusion) == 2 * 144
    assert report.accuracy == pytest.approx(np.trace(report.confusion) / 288)
    assert set(document["support"][0]) == {"class", "regime", "windows", "n_runs", "accuracy"}
    levels = {row["support"]: row["windows_ratio"] for row in document["accuracy_by_support"]}
    assert list(levels) == [level.value for level in SupportLevel]
    assert sum(levels.values()) == pytest.approx(1)
    lines = str(report).splitlines()
    assert len(lines) <= 25
    assert re.match(r"\d+\.\d.% of windows classified correctly \(", lines[0])
    assert lines[0].endswith(
        "whole runs held out, within runs without a session: what another day does is not shown."
    )
    assert lines[-1].startswith("next: terrain train --data DIR --recipe svm")
    assert report.to_pandas().shape == (3, 5)


def test_one_seed_gives_one_report_and_another_seed_another(report, runs, tracked, settings):
    once = tracked[1].crossval  # of one repeat, evaluated while a model was trained
    assert once.folds == report.folds[:5]
    assert once.accuracy == report.accuracy_per_repeat[0]
    other = crossval(runs, settings(seed=1))
    assert other.accuracy not in report.accuracy_per_repeat
    assert other.per_run != once.per_run


def test_scikit_learn_cross_validates_whole_recipes_to_the_same_answers(drive, drive_all, settings):
    runs = drive_all(("ASPHALT", "GRASS"), n_runs=4, duration_s=16.0)
    runs.append(drive("GRAVEL_1", "GRAVEL", 5, duration_s=50.0))
    samples = samples_of(runs, settings().rule)
    windows, y, recipe = samples.windows, samples.terrain, make_recipe("svm", seed=3)
    examples = Examples(feature_matrix(recipe, windows), y, samples.group)
    held_out = evaluate(recipe[-1], examples, folds_of(samples, "grouped", 1, seed=3), on_all=True)
    folds = [(result.fold.train, result.fold.test) for result in held_out.results]
    expected = cross_val_predict(make_recipe("svm", seed=3), windows, y, cv=folds, method="predict_proba")
    np.testing.assert_allclose(held_out.probability[0], expected, atol=1e-9)
    fitted = make_recipe("svm", seed=3).fit(windows, y)
    on_all = held_out.fitted.predict_proba(examples.features)
    np.testing.assert_allclose(on_all, fitted.predict_proba(windows), atol=1e-9)
    assert fitted[-1].best_ == held_out.fitted.best_


def test_what_is_learned_slow_and_does_not_apply_fast_is_detected(drive, settings):
    """The vibration of a fast run is that of the next terrain driven slowly; in the control it is its own."""
    levels = {"ASPHALT": 0.3, "GRASS": 0.8, "GRAVEL": 2.0}
    following = {"ASPHALT": 0.8, "GRASS": 2.0, "GRAVEL": 0.3}
    for fast_levels, protocol, low, high in (
        (levels, "slow-fast", 0.9, 1.0),
        (following, "fast-slow", 0.0, 0.1),
    ):
        runs = [
            drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), 32.0, speed, smoothness=0.4, current_a=2.0,
                  level=(levels if i < 2 else fast_levels)[terrain])
            for terrain in levels
            for i, speed in enumerate(SPEEDS)
        ]  # fmt: skip
        found = crossval(runs, settings(protocol=protocol, signal_sets=("imu",)))
        assert low <= found.accuracy <= high


def test_a_protocol_and_the_extra_of_one_name_give_one_number_and_sequences_are_judged(with_extras, settings):
    runs, extras = with_extras
    assert extras.slow_fast.status == "applicable"
    found = crossval(runs, settings(protocol="slow-fast"))
    assert found.accuracy == pytest.approx(extras.slow_fast.slow_to_fast)
    assert found.notes[0].startswith("fast runs held out, slow ones trained on")
    assert {run.run_id[-1] for run in found.per_run} == {"2", "3"}
    document = as_json(extras)  # sequences are judged beside single windows
    assert document["courses"]["n_courses"] == 5
    assert document["recorded_courses"] is None
    low, high = document["filtered_accuracy_ci"]
    assert 0.0 <= low <= document["filtered_accuracy"] <= high <= 1.0
    assert document["filter_delay_s"]["n_changes"] >= 5
    assert document["courses"]["gain"] >= -0.05


def test_speed_alone_is_right_just_where_terrains_were_driven_at_speeds_of_their_own(
    drive, settings, monkeypatch, with_extras
):
    monkeypatch.setattr("terrain.classify.held_out.CURVE_RUNS", ())
    names = ("ASPHALT", "GRASS", "GRAVEL")
    runs = [
        drive(f"{name}_{i}", name, 7 * i + k, 8.0, 0.3 + 0.2 * k + 0.01 * i, level=0.8, current_a=2.0)
        for k, name in enumerate(names)
        for i in range(4)
    ]
    found = crossval(runs, settings(extras=True, signal_sets=("imu",)))
    assert found.speed_only_accuracy > 0.95
    assert with_extras[1].speed_only_accuracy < 0.55  # all terrains at the same speeds


def test_the_baseline_beside_a_recipe_is_what_it_is_alone_on_the_same_folds(with_extras, settings, tracked):
    runs, found = with_extras
    alone = crossval(runs, settings(recipe=("plain",), extras=False, repeats=1))
    assert found.plain_accuracy == alone.accuracy
    assert any("recipe plain" in str(name) for name, *_ in found.report.parts[1].rows)
    assert 0.0 < tracked[1].crossval.plain_accuracy < 1.0  # of a training, too


def test_refusals_are_by_what_each_fold_makes_of_windows_that_it_holds_out(with_extras, settings, tracked):
    runs, found = with_extras
    asked = settings(extras=True)
    samples = samples_of(runs, asked.rule, asked.signal_sets, **asked.reading)
    features, refused = feature_matrix(make_recipe("svm"), samples.windows), np.zeros(len(samples.terrain))
    looks = Looks(features, samples.observed, samples.windows.start_s + samples.windows.length_s)
    dealt = looks, samples.terrain, samples.group, samples.gap, asked.seed
    for fold in folds_of(samples, "grouped", 1, asked.seed):
        refused[fold.test] = refused_rows(*dealt, fold.train, fold.test)
    assert found.refusals.refused == refused.mean() > 0.0
    assert found.refusals.worst_unit == max(refused[samples.run_id == run.run_id].mean() for run in runs)
    of_training = tracked[1].crossval.refusals  # kept in its model
    assert read_files(tracked[0] / "model")[0].known_refused == (of_training.refused, *of_training.refused_ci)


def test_extras_do_without_what_the_data_lack(drive, settings):
    """No wheels, and one run a class: no speed to learn from, and no learning curve to draw."""
    runs = []
    for i, level in enumerate((0.3, 0.6, 1.2, 2.4, 4.8)):
        run = drive(f"T{i}_1", "GRASS", i, 30.0, level=level, label=f"T{i}")
        runs.append(RunLog(run.run_id, "husky", {"imu": run.streams["imu"]}, run.labels))
    found = crossval(runs, settings(extras=True, steady=False))
    assert "support" not in json.loads(json.dumps(as_json(found), allow_nan=False))
    assert any("no wheel speed" in note for note in found.notes)
    assert found.notes[0].startswith("T0, T1, T2, T3, T4: one run only, cut into 5 contiguous blocks")
    assert found.speed_only_accuracy is None
    assert found.slow_fast.status == "not applicable"
    assert set(found.slow_fast.left_out) == {f"T{i}" for i in range(5)}
    assert found.learning_curve.enough_runs is None
    assert found.learning_curve.accuracy == pytest.approx([found.accuracy])


@pytest.mark.slow
def test_runs_with_several_labels_can_be_learned_from_few(drive, settings):
    """One group may hold all classes: the inner folds are then as many as the groups allow."""
    runs = []
    for number in range(6):
        a, b = (drive(f"r{number}", terrain, number, 12.0) for terrain in ("GRASS", "GRAVEL"))
        streams = {}
        for name, first in a.streams.items():
            values = np.r_[first.values, b.streams[name].values]
            streams[name] = Stream(np.r_[first.time_s, first.time_s + 12.0], values, first.channels)
        runs.append(RunLog(a.run_id, "husky", streams, ((0.0, 12.0, "GRASS"), (12.0, 24.0, "GRAVEL"))))
    found = crossval(runs, settings(extras=True))
    assert found.learning_curve.runs_per_class[0] == 1.0
    assert {row.run_id for row in found.per_run} >= {"r0 (GRASS)", "r0 (GRAVEL)"}


def test_a_terrain_left_out_has_areas_their_intervals_and_both_rates(drive_all, settings):
    asked = settings(protocol="leave-terrain-out", signal_sets=("imu",), steady=False)
    found = crossval(drive_all(n_runs=3), asked)
    assert set(found.unknown_by_terrain) == {"ASPHALT", "GRASS", "GRAVEL"}
    for name in ("auroc_unknown", "auroc_unknown_10s"):
        low, high = getattr(found, f"{name}_ci")
        assert 0.0 <= low <= getattr(found, name) <= high <= 1.0
    rows = found.unknown_by_terrain.values()
    assert np.mean([row.auroc for row in rows]) == pytest.approx(found.auroc_unknown)
    assert found.auroc_unknown > 0.6  # the middle one of three terrains lies between the others
    assert (
        0.7 < found.known_kept <= 1.0
    )  # of five or six runs a new one is the most unlike in a sixth of cases


@pytest.mark.slow
def test_terrains_of_vulpi_are_classified_on_held_out_runs(datasets_dir, settings):
    found = crossval(load_runs(datasets_dir / "vulpi"), settings())
    assert found.accuracy > 0.90
    assert found.ece < 0.08
    assert found.n_runs == 18
    assert any(note.startswith("DIRT_ROAD: one run only") for note in found.notes)
    assert f"windows left out: {format_counts(found.dropped)}" in found.notes
    assert EvaluationSettings(protocol="published").rule.length_s == 1.7  # a protocol has its window


@pytest.mark.slow
def test_signal_sets_that_hold_the_terrain_are_better_than_those_that_do_not(drive_all, settings):
    """Of runs whose currents do not depend on the terrain."""
    report = crossval(drive_all(n_runs=5, seed=4, current_a=3.0), settings(recipe="svm@currents,svm@imu"))
    (found,), n_all = report.differences, report.contenders[0].n_runs
    assert found.accuracy.verdict is Verdict.BETTER
    assert found.accuracy.a < 0.55 < found.accuracy.b
    assert (n_all, report.kind) == (15, "recipes")
    assert set(found.by_class) == {"ASPHALT", "GRASS", "GRAVEL"}
    assert set(found.by_support) <= {level.value for level in SupportLevel}
    n_runs = [row.n_units for row in found.by_support.values()]
    assert max(n_runs) <= n_all <= sum(n_runs)
    differences = [row.difference for row in found.by_support.values()]
    assert min(differences) <= found.accuracy.difference <= max(differences)
    document = as_json(report)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    text = str(report)
    assert text.startswith("svm@imu classifies ")
    assert "better" in text.splitlines()[0]
    assert len(text.splitlines()) <= 25
    assert report.to_pandas()["recipe"].tolist() == ["svm@currents", "svm@imu"]


def test_models_are_compared_on_runs_that_none_was_trained_on(model, giving, runs, drive_all, settings):
    new, asked = drive_all(n_runs=2, seed=91), settings(model=("old", "new"))
    constant = giving(lambda windows: np.tile([1.0, 0.0, 0.0], (len(windows), 1)))
    trained_on = [run for run in runs if run.run_id == "GRASS_4"]
    report = compare_models([*new, *trained_on], (constant, model), asked)
    assert report.excluded_runs == ("GRASS_4",)
    assert report.contenders[1].n_runs == 6
    (found,) = report.differences
    assert found.accuracy.verdict is Verdict.BETTER
    assert found.accuracy.a == report.contenders[0].accuracy == pytest.approx(1 / 3)
    alone = compare_models([*new, *trained_on], [model], settings(model=("new",)))
    assert alone.accuracy == found.accuracy.b
    assert "1 run left out" in alone.notes[-1]
    with pytest.raises(DataError, match="all 12 runs were used to train old or new: no run is left"):
        compare_models(runs, (model, model), asked)
    with pytest.raises(DataError, match="no window of these runs is labelled as a class of all models"):
        compare_models(drive_all(n_runs=1, seed=92, label="LAVA"), (model, model), asked)


def copy_of(run, run_id):
    """Return a run under another name, 50 s later and rounded."""
    streams = {
        name: Stream(each.time_s + 50.0, each.values.round(4), each.channels)
        for name, each in run.streams.items()
    }
    labels = tuple(Label(a + 50.0, b + 50.0, name) for a, b, name in run.labels)
    return replace(run, run_id=run_id, streams=streams, labels=labels)


def test_copies_are_refused_by_name_with_what_to_do(runs, settings, tmp_path):
    copies = [copy_of(run, f"again_{i}") for i, run in enumerate(runs[:5])]
    with pytest.raises(DataError) as refusal:
        crossval([*runs, *copies], settings())
    sentence = str(refusal.value)
    assert "runs ASPHALT_1 and again_0 hold the same measurements for 24.0 s" in sentence
    assert "and so do 2 more pairs of runs" in sentence
    assert "--merge-duplicates" in sentence
    assert "\n" not in sentence
    asked = settings(merge_duplicates=True)  # leaves every window as it was
    merged = samples_of([*runs, *copies], asked.rule, **asked.reading)
    alone = samples_of(runs, asked.rule)
    assert merged.windows.run_id.tolist() == alone.windows.run_id.tolist()
    np.testing.assert_array_equal(merged.windows.values["imu"], alone.windows.values["imu"])
    assert len(merged.merged) == 5
    for run in (*runs[:2], copies[0]):
        write_run(run, tmp_path / "data")
    inspected = inspect_runs(InspectSettings(data=tmp_path / "data"))
    imported = convert(ConvertSettings(data=tmp_path / "data", out=tmp_path / "out"))
    for result in (inspected, imported):
        assert [(each.first, each.second) for each in result.duplicates] == [("ASPHALT_1", "again_0")]


def test_values_that_no_sensor_measures_and_signals_that_are_none_are_named(runs, settings):
    def changed(run, change):
        streams = {
            name: Stream(each.time_s, change(each.values), each.channels)
            for name, each in run.streams.items()
        }
        return replace(run, streams=streams)

    scaled = [changed(runs[0], lambda x: x * 1e200), *runs[1:]]
    bare = [replace(runs[0], streams={"imu": runs[0].streams["imu"]}), *runs[1:]]
    dead, flat = ([changed(run, lambda x, at=at: 0.0 * x + at) for run in runs] for at in (np.nan, 0.5))
    for data, sentence in (
        (scaled, r"run ASPHALT_1, stream 'imu': channel '\w+' is -?\d\.\d+e\+\d+ at .* s.*beyond 1e\+12"),
        (bare, "run ASPHALT_1 has no stream 'wheels', which other runs have"),
        (dead, "not one window is left: 144 not finite"),
        (flat, "no channel of the streams 'imu' and 'wheels' ever varies"),
    ):
        with pytest.raises(DataError, match=sentence) as refusal:
            crossval(data, settings())
        assert "\n" not in str(refusal.value)


def test_the_filter_of_a_fold_is_chosen_on_the_inner_probabilities_of_its_own_terrains(monkeypatch):
    run = np.repeat(np.arange(12), 6).astype(str).astype(object)
    terrain = np.repeat(np.tile(["ice", "mud", "sand"], 4), 6)
    right = 0.1 + 0.7 * (terrain[:, None] == np.unique(terrain))
    train, test = np.arange(36), np.arange(36, 72)
    results = [
        FoldResult(Fold(0, i, *rows), right[rows[1]], {}, inner=right[rows[0]])
        for i, rows in enumerate([(train, test), (test, train)])
    ]
    chosen, choose = [], evaluation.choose_settings

    def taken(inner, of_rows, *rest):
        chosen.append((np.array([*rest[-1]])[inner.argmax(axis=1)] == of_rows).all())
        return choose(inner, of_rows, *rest)

    monkeypatch.setattr(evaluation, "choose_settings", taken)
    windows = Windows({}, {}, {}, 2.0, np.tile(2.0 * np.arange(6), 12), run, terrain.astype(object))
    found = evaluation._over_time(HeldOut.of_folds(results, terrain), windows, run, 0)
    assert chosen == [True, True]
    assert (found.a, found.b > 0.5) == (1.0, True)
