import json
import re
import warnings
from dataclasses import fields
from typing import get_args

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from pipelines.learn.crossval import EvaluationSettings, Settings, crossval, run
from pipelines.learn.parallel import computing
from pipelines.learn.protocols import PROTOCOLS
from pipelines.learn.settings import ProtocolName
from pipelines.report.json_file import as_json
from terrain.errors import ConfigError, DataError
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream


@pytest.fixture(scope="module")
def report(runs, settings):
    return crossval(runs, settings(repeats=2))


def test_the_screen_answers_first_and_fits(report):
    lines = str(report).splitlines()
    assert len(lines) <= 25
    assert re.match(r"\d+\.\d.% of windows classified correctly, whole runs held out \(", lines[0])
    assert lines[-1].startswith("next: terrain train --data DIR --recipe svm")
    assert report.to_pandas().shape == (3, 5)


def test_the_protocols_of_the_command_line_are_those_that_there_are():
    """They are written twice, so that help need not load what offers them."""
    assert get_args(ProtocolName) == tuple(PROTOCOLS)


def test_the_report_has_what_is_promised_and_is_json(report, runs):
    document = as_json(report)
    known = {each.name for each in fields(report) if getattr(report, each.name) is not None} - {"data"}
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


def test_one_seed_gives_one_report_and_another_seed_another(report, runs, settings):
    assert crossval(runs, settings(repeats=2)) == report
    other = crossval(runs, settings(seed=1))
    assert other.accuracy_per_repeat[0] not in report.accuracy_per_repeat
    assert other.per_run != report.per_run


@pytest.mark.slow
def test_where_labels_only_identify_runs_grouped_gives_chance_and_published_does_not(drive, settings):
    def mislabelled(seed):
        """Eight runs, each with a vibration of its own; their labels do not depend on it."""
        rng = np.random.default_rng(seed)
        names = rng.permutation(["ICE"] * 4 + ["MUD"] * 4)
        levels, colours = (
            rng.permutation(np.geomspace(0.3, 3.0, 8)),
            rng.permutation(np.linspace(0.05, 0.9, 8)),
        )
        return [
            drive(f"run_{i}", "GRASS", int(rng.integers(2**31)), 16.0, rng.uniform(0.3, 0.9), level=levels[i],
                  smoothness=colours[i], label=str(names[i]))
            for i in range(8)
        ]  # fmt: skip

    grouped = [crossval(mislabelled(seed), settings()).accuracy for seed in range(3)]
    published = crossval(mislabelled(0), settings(protocol="published"))
    # Eight tosses of a coin have a standard deviation of 0.18, the mean of three draws one of 0.10; that
    # a held-out run leaves more runs of the other name in training pulls below one half.
    assert np.mean(grouped) < 0.68
    assert published.accuracy > 0.9
    assert any("both sides of the split" in note for note in published.notes)


def test_gaps_and_missing_values_drop_the_windows_they_touch_and_are_counted(runs, settings):
    victim = runs[0]
    imu = victim.streams["imu"]
    values = imu.values.copy()
    values[250:253, 4] = np.nan  # from 5.00 s: within the window from 4 s
    values[401, 0] = np.inf  # 8.02 s
    kept = np.r_[0:700, 720:1200]  # 14.0 to 14.4 s
    streams = {**victim.streams, "imu": Stream(imu.time_s[kept], values[kept], imu.channels)}
    report = crossval([RunLog(victim.run_id, "husky", streams, victim.labels), *runs[1:]], settings())
    assert report.dropped == {"gap": 1, "not finite": 2}
    assert report.n_windows == 144 - 3
    assert "windows left out: 1 gap, 2 not finite" in report.notes


def test_signal_sets_are_switched_off_by_name(runs, settings, report):
    def n_features(*names):
        return crossval(runs, settings(signal_sets=names)).n_features

    imu, wheels = n_features("imu"), n_features("wheels", "currents")
    assert 0 < wheels < imu < imu + wheels < report.n_features  # together they give features of both
    with pytest.raises(ConfigError, match="unknown signal set 'sonar'; there are imu, wheels"):
        n_features("sonar")
    with pytest.raises(DataError, match="no channel of the signal sets slip"):
        n_features("slip")


def test_a_signal_set_carries_its_own_information_only(drive_all, settings):
    alike = {"level": 0.8, "smoothness": 0.4}  # only the currents differ from terrain to terrain
    runs = [
        run
        for terrain, current_a in (("ASPHALT", 1.0), ("GRASS", 2.0), ("GRAVEL", 4.0))
        for run in drive_all((terrain,), 4, seed=int(current_a), current_a=current_a, **alike)
    ]
    assert crossval(runs, settings(signal_sets=("currents",))).accuracy > 0.95
    assert crossval(runs, settings(signal_sets=("imu",))).accuracy < 0.6


def test_leave_one_run_out_and_single_runs(drive, drive_all, settings):
    runs = [*drive_all(("ASPHALT", "GRASS"), 3, duration_s=16.0), drive("GRAVEL_1", "GRAVEL", 3, 40.0)]
    report = crossval(runs, settings(protocol="leave-one-run-out"))
    assert (len(report.folds), report.repeats, report.accuracy_spread) == (6 + 5, 1, None)
    assert any(note.startswith("GRAVEL: one run only, cut into 5 contiguous blocks") for note in report.notes)


def test_extras_do_without_what_the_data_lack(drive, settings):
    """No wheels, and one run a class: no speed to learn from, and no learning curve to draw."""
    runs = []
    for i, level in enumerate((0.3, 0.6, 1.2, 2.4, 4.8)):
        run = drive(f"T{i}_1", "GRASS", i, 30.0, level=level, label=f"T{i}")
        runs.append(RunLog(run.run_id, "husky", {"imu": run.streams["imu"]}, run.labels))
    report = crossval(runs, settings(extras=True, steady=False))
    json.dumps(as_json(report), allow_nan=False)
    assert report.speed_only_accuracy is None
    assert report.slow_fast.status == "not applicable"
    assert set(report.slow_fast.left_out) == {f"T{i}" for i in range(5)}
    assert report.learning_curve.enough_runs is None
    assert report.learning_curve.accuracy == pytest.approx([report.accuracy])


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(
        ConfigError,
        match="--protocol is 'lucky': input should be 'grouped', 'leave-one-run-out', 'leave-sessions-out', ",
    ):
        EvaluationSettings(protocol="lucky")
    with pytest.raises(ConfigError, match="--repeats is 0: input should be greater than or equal to 1"):
        EvaluationSettings(repeats=0)
    with pytest.raises(ConfigError, match="window length_s is -1"):
        _ = EvaluationSettings(window_s=-1).rule
    assert EvaluationSettings(protocol="published").rule.length_s == 1.7
    assert EvaluationSettings().rule.length_s == 2.0


def test_terrains_of_vulpi_are_classified_on_held_out_runs(datasets_dir, settings):
    report = crossval(load_runs(datasets_dir / "vulpi"), settings())
    assert report.accuracy > 0.90
    assert report.ece < 0.08
    assert report.n_runs == 18
    assert any(note.startswith("DIRT_ROAD: one run only") for note in report.notes)


@pytest.mark.parametrize("window_s", [0.4, 1.0])
def test_a_window_with_few_samples_of_a_slow_stream_is_classified(drive_all, settings, window_s):
    runs = drive_all(("ASPHALT", "GRAVEL"), 3, duration_s=8.0)
    report = crossval(runs, settings(window_s=window_s))
    assert report.n_windows > 40
    assert np.isfinite(report.accuracy)


def test_a_window_too_short_for_a_slow_stream_is_one_sentence(runs, settings):
    with pytest.raises(DataError, match=r"^a window of 0\.3 s holds 3 samples of stream 'wheels' at 10 Hz; "):
        crossval(runs, settings(window_s=0.3))


@pytest.mark.slow
def test_a_cluster_gives_the_report_of_this_machine(make_run):
    distributed = pytest.importorskip("distributed")
    runs = [
        make_run(f"{name}_{k}", name, k + 10 * (name == "ICE"), 12.0)
        for name in ("ICE", "SNOW")
        for k in range(4)
    ]
    settings = EvaluationSettings(repeats=1, steady=False, n_jobs=2)
    here = crossval(runs, settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            distributed.LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
            ) as running,
            computing("dask:" + running.scheduler_address),
        ):
            there = crossval(runs, settings)
    assert json.dumps(as_json(there)) == json.dumps(as_json(here))


def test_cached_features_give_the_figures_of_the_runs(drive_all, tmp_path):
    for each in drive_all(("ASPHALT", "GRASS"), 3, duration_s=12.0):
        write_run(each, tmp_path / "data")
    asked = {"data": tmp_path / "data", "repeats": 1, "extras": False, "n_jobs": 1}
    plain = run(Settings(**asked)).as_json() | {"data_digest": None}
    for _ in ("written", "read"):
        assert run(Settings(**asked, cache=tmp_path / "cache")).as_json() | {"data_digest": None} == plain
    for options in ({"recipe": ("cnn",)}, {"protocol": "published"}, {"merge_duplicates": True}):
        with pytest.raises(ConfigError, match="--cache"):
            Settings(**asked, cache=tmp_path / "cache", **options)
