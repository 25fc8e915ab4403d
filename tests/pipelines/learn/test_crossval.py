"""Recipes on held-out runs: what is in the data is found, what is not is not, and what a reader must know is stated."""

import json
import re
from dataclasses import fields

import numpy as np
import pytest
from sklearn.model_selection import cross_val_predict, cross_validate

from features.protocols import folds_of, samples_of
from features.recipes import feature_matrix, make_recipe
from pipelines.data.datasets import load_runs
from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.evaluate import evaluate
from pipelines.report.numbers import format_counts
from pipelines.report.results import as_json
from terrain.classify.held_out import Examples
from terrain.classify.limits import SupportLevel
from terrain.errors import ConfigError
from terrain.records import RunLog, Stream

SPEEDS = (0.3, 0.4, 0.7, 0.8)
ALIKE = {"level": 0.8, "smoothness": 0.4, "current_a": 2.0}
"""What leaves nothing but the speed to tell terrains by."""


@pytest.fixture(scope="module")
def report(runs, settings):
    return crossval(runs, settings(repeats=2))


@pytest.fixture(scope="module")
def runs_at_speeds(drive):
    """Runs of three terrains, two of them slow and two fast."""
    return [
        drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), 32.0, speed_mps=speed)
        for terrain in ("ASPHALT", "GRASS", "GRAVEL")
        for i, speed in enumerate(SPEEDS)
    ]


@pytest.fixture(scope="module")
def with_extras(runs_at_speeds, settings):
    return crossval(runs_at_speeds, settings(extras=True))


def test_the_report_has_what_is_promised_and_is_json(report):
    document = as_json(report)
    known = {each.name for each in fields(report) if each.metadata and getattr(report, each.name) is not None}
    assert set(document) == known | {"stride_s"}
    assert len(known) > 40
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (report.n_runs, report.n_windows, report.window_s) == (12, 144, 2.0)
    assert (len(report.folds), len(report.per_run), report.repeats) == (10, 12, 2)
    assert np.sum(report.confusion) == 2 * 144
    low, high = report.accuracy_ci
    assert 0.5 < low <= report.accuracy <= high <= 1.0  # terrains that differ are distinguished
    assert report.accuracy == pytest.approx(np.trace(report.confusion) / 288)
    assert report.dropped == {}
    assert set(document["support"][0]) == {"class", "regime", "windows", "n_runs", "accuracy"}
    levels = {row["support"]: row["windows_ratio"] for row in document["accuracy_by_support"]}
    assert list(levels) == [level.value for level in SupportLevel]
    assert sum(levels.values()) == pytest.approx(1)
    lines = str(report).splitlines()
    assert len(lines) <= 25
    assert re.match(r"\d+\.\d.% of windows classified correctly, whole runs held out \(", lines[0])
    assert lines[-1].startswith("next: terrain train --data DIR --recipe svm")
    assert report.to_pandas().shape == (3, 5)


def test_one_seed_gives_one_report_and_another_seed_another(report, runs, settings):
    assert crossval(runs, settings(repeats=2)) == report
    other = crossval(runs, settings(seed=1))
    assert other.accuracy_per_repeat[0] not in report.accuracy_per_repeat
    assert other.per_run != report.per_run


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
    on_all = make_recipe("svm", seed=3).fit(windows, y).predict_proba(windows)
    np.testing.assert_allclose(held_out.fitted.predict_proba(examples.features), on_all, atol=1e-9)
    found = cross_validate(
        make_recipe("svm", seed=3), windows, y, groups=windows.run_id, cv=folds[:2], return_estimator=True
    )
    for estimator, score, result in zip(
        found["estimator"], found["test_score"], held_out.results, strict=False
    ):
        right = held_out.classes[result.probability.argmax(axis=1)] == y[result.fold.test]
        assert score == pytest.approx(right.mean())
        assert 0 < estimator[-1].n_inner_fits_ <= 20
        assert estimator[-1].best_._asdict() == result.chosen


def test_what_is_learned_slow_and_does_not_apply_fast_is_detected(drive, settings):
    """The vibration of a fast run is that of the next terrain driven slowly; in the control it is its own."""
    levels = {"ASPHALT": 0.3, "GRASS": 0.8, "GRAVEL": 2.0}
    following = dict(zip(levels, [*list(levels.values())[1:], levels["ASPHALT"]], strict=True))
    for fast_levels, accuracy in ((levels, (0.9, 1.0)), (following, (0.0, 0.1))):
        runs = [
            drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), 32.0, speed, smoothness=0.4, current_a=2.0,
                  level=(levels if i < 2 else fast_levels)[terrain])
            for terrain in levels
            for i, speed in enumerate(SPEEDS)
        ]  # fmt: skip
        for protocol in ("slow-fast", "fast-slow"):
            found = crossval(runs, settings(protocol=protocol, signal_sets=("imu",)))
            assert accuracy[0] <= found.accuracy <= accuracy[1]


def test_a_protocol_and_the_extra_of_one_name_give_one_number(runs_at_speeds, settings, with_extras):
    extra = with_extras.slow_fast
    assert extra.status == "applicable"
    for protocol, expected in (("slow-fast", extra.slow_to_fast), ("fast-slow", extra.fast_to_slow)):
        found = crossval(runs_at_speeds, settings(protocol=protocol))
        assert found.accuracy == pytest.approx(expected)
        trained, tested = protocol.split("-")
        assert found.notes[0].startswith(f"{tested} runs held out, {trained} ones trained on")
        assert {run.run_id[-1] for run in found.per_run} == ({"2", "3"} if tested == "fast" else {"0", "1"})


def test_sequences_are_judged_beside_single_windows(with_extras, runs_at_speeds, settings):
    document = as_json(with_extras)
    assert document["courses"]["n_courses"] == 5
    assert document["recorded_courses"] is None
    low, high = document["filtered_accuracy_ci"]
    assert 0.0 <= low <= document["filtered_accuracy"] <= high <= 1.0
    assert document["filter_delay_s"]["n_changes"] >= 5
    assert document["courses"]["gain"] >= -0.05
    plain = as_json(crossval(runs_at_speeds, settings()))
    assert "filtered_accuracy" not in plain
    assert plain["accuracy"] == document["accuracy"]


def test_speed_alone_is_right_just_where_terrains_were_driven_at_speeds_of_their_own(
    drive, settings, monkeypatch
):
    monkeypatch.setattr("terrain.classify.held_out.CURVE_RUNS", ())
    accuracy = []
    for own_speeds in (True, False):
        runs = [
            drive(
                f"{t}_{i}", t, 7 * i + k, 12.0, 0.3 + 0.2 * (k if own_speeds else i % 4) + 0.01 * i, **ALIKE
            )
            for k, t in enumerate(("ASPHALT", "GRASS", "GRAVEL"))
            for i in range(5)
        ]
        accuracy.append(crossval(runs, settings(extras=True)).speed_only_accuracy)
    assert accuracy[0] > 0.95
    assert accuracy[1] < 0.55


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
        streams = {
            name: Stream(
                np.r_[s.time_s, s.time_s + 12.0], np.r_[s.values, b.streams[name].values], s.channels
            )
            for name, s in a.streams.items()
        }
        runs.append(RunLog(a.run_id, "husky", streams, ((0.0, 12.0, "GRASS"), (12.0, 24.0, "GRAVEL"))))
    found = crossval(runs, settings(repeats=1, extras=True))
    assert found.learning_curve.runs_per_class[0] == 1.0
    assert {row.run_id for row in found.per_run} >= {"r0 (GRASS)", "r0 (GRAVEL)"}


def test_a_terrain_left_out_has_areas_their_intervals_and_both_rates(runs, settings):
    found = crossval(runs, settings(protocol="leave-terrain-out"))
    assert set(found.unknown_by_terrain) == {"ASPHALT", "GRASS", "GRAVEL"}
    for name in ("auroc_unknown", "auroc_unknown_10s"):
        low, high = getattr(found, f"{name}_ci")
        assert 0.0 <= low <= getattr(found, name) <= high <= 1.0
    rows = found.unknown_by_terrain.values()
    assert np.mean([row.auroc for row in rows]) == pytest.approx(found.auroc_unknown)
    assert found.auroc_unknown > 0.6  # the middle one of three terrains lies between the others
    assert 0.8 < found.known_kept <= 1.0


def test_a_protocol_has_its_window():
    with pytest.raises(ConfigError, match="window length_s is -1"):
        _ = EvaluationSettings(window_s=-1).rule
    assert EvaluationSettings(protocol="published").rule.length_s == 1.7
    assert EvaluationSettings().rule.length_s == 2.0


def test_terrains_of_vulpi_are_classified_on_held_out_runs(datasets_dir, settings):
    found = crossval(load_runs(datasets_dir / "vulpi"), settings())
    assert found.accuracy > 0.90
    assert found.ece < 0.08
    assert found.n_runs == 18
    assert any(note.startswith("DIRT_ROAD: one run only") for note in found.notes)
    assert f"windows left out: {format_counts(found.dropped)}" in found.notes
