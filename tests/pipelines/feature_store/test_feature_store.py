"""A store of features gives what the runs give, goes on after an interruption, and is refused when broken."""

import gc
import json
import shutil
import warnings
import weakref
from dataclasses import replace

import numpy as np
import pytest

from features.motion import NO_MOTION, Motion, window_motion
from features.windows import layout_of
from pipelines.crossval.crossval import crossval, samples_of
from pipelines.crossval.settings import CrossvalSettings
from pipelines.data.datasets import joint_digest, load_runs, run_loaders
from pipelines.data.settings import AlignedRunsSettings
from pipelines.feature_store import build, manifest
from pipelines.feature_store.build import build_store
from pipelines.feature_store.crossval import NO_EXTRAS, crossval_store
from pipelines.feature_store.heads import Head, _head, head_of
from pipelines.feature_store.run_file import read_run_windows
from pipelines.feature_store.settings import FeaturesSettings
from pipelines.feature_store.store import is_store, open_store, read_store, store_of
from pipelines.learn.parallel import computing
from pipelines.learn.recipes import feature_matrix
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.write import write_run
from terrain.records import Label, Stream

SETTINGS = CrossvalSettings(repeats=1, steady=False, n_jobs=1, extras=False)


@pytest.fixture
def runs_dir(tmp_path, make_run):
    """Eight runs of two terrains, in run folders."""
    for name in ("ICE", "SNOW"):
        for k in range(4):
            write_run(make_run(f"{name}_{k}", name, k + 10 * (name == "ICE"), 7.0 + k), tmp_path / "runs")
    return tmp_path / "runs"


def features_settings(out, **changed):
    return FeaturesSettings(**({"out": out, "steady": False, "n_jobs": 1} | changed))


def files_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def opened(folder, settings=SETTINGS):
    return open_store(folder, settings.rule, settings.signal_sets)


def test_a_store_holds_the_features_of_the_runs_bit_for_bit(runs_dir, tmp_path):
    report = build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    samples = samples_of(load_runs(runs_dir), SETTINGS)
    stored = read_store(opened(tmp_path / "store"))
    features = feature_matrix(SETTINGS.new_recipe(), samples.cut.windows)
    assert stored.features.tobytes() == features.tobytes()
    assert report.n_windows == len(features)
    assert report.n_features == features.shape[1]
    for name in ("start_s", "run_id", "terrain"):
        assert (
            getattr(stored.samples.cut.windows, name).tolist() == getattr(samples.cut.windows, name).tolist()
        )
    motion = window_motion(samples.cut.windows)
    for name in Motion._fields:
        assert getattr(stored.motion, name).tobytes() == getattr(motion, name).tobytes()


@pytest.mark.parametrize("protocol", ["grouped", pytest.param("leave-one-run-out", marks=pytest.mark.slow)])
def test_cross_validation_of_a_store_gives_the_report_of_its_runs(runs_dir, tmp_path, protocol):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    asked = SETTINGS.with_(protocol=protocol)
    from_runs = crossval(load_runs(runs_dir), asked)
    from_store = crossval_store(opened(tmp_path / "store"), asked)
    assert from_store.support.rows
    assert json.dumps(as_json(from_store)) == json.dumps(as_json(from_runs))


@pytest.mark.slow
def test_a_store_leaves_out_a_terrain_as_its_runs_do(runs_dir, tmp_path, make_run):
    for k in range(4):
        write_run(make_run(f"MUD_{k}", "MUD", 20 + k, 9.0), runs_dir)
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    asked = SETTINGS.with_(protocol="leave-terrain-out")
    found = crossval_store(opened(tmp_path / "store"), asked)
    assert set(found.unknown.unknown_by_terrain) == {"ICE", "MUD", "SNOW"}
    assert json.dumps(as_json(found)) == json.dumps(as_json(crossval(load_runs(runs_dir), asked)))


def test_a_store_without_wheels_has_no_support_and_says_why(runs_dir, tmp_path):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store", signal_sets=("imu",)))
    asked = SETTINGS.with_(signal_sets=("imu",))
    store = opened(tmp_path / "store", asked)
    assert read_store(store).motion is None
    found = crossval_store(store, asked)
    assert (found.support, found.notes[-1]) == (None, f"support: {NO_MOTION}")
    assert json.dumps(as_json(found)) == json.dumps(as_json(crossval(load_runs(runs_dir), asked)))


def copied(run, run_id, offset_s=0.0):
    streams = {
        name: Stream(each.time_s + offset_s, each.values.round(2), each.channels)
        for name, each in run.streams.items()
    }
    labels = tuple(Label(a + offset_s, b + offset_s, name) for a, b, name in run.labels)
    return replace(run, run_id=run_id, streams=streams, labels=labels)


def test_runs_with_the_same_measurements_are_named_and_refused_until_one_is_left_out(runs_dir, tmp_path):
    store = tmp_path / "store"
    write_run(copied(load_runs(runs_dir)[2], "again", 50.0), runs_dir)
    report = build_store(run_loaders(runs_dir), features_settings(store))
    assert [(each.first, each.second) for each in report.duplicates] == [("ICE_2", "again")]
    with pytest.raises(DataError) as refusal:
        crossval_store(opened(store), SETTINGS)
    assert "ICE_2 and again hold the same measurements for 9.0 s" in str(refusal.value)
    assert len(str(refusal.value).splitlines()) == 1
    chosen = store_of(
        AlignedRunsSettings(data=store, without=("again",)), SETTINGS.rule, SETTINGS.signal_sets
    )
    report = crossval_store(chosen, SETTINGS)
    assert report.n_runs == 8
    assert chosen.digest == joint_digest([run.digest for run in opened(store).runs if run.run_id != "again"])
    again = build_store(run_loaders(runs_dir), features_settings(store))  # nothing is computed, all compared
    assert (again.n_computed, len(again.duplicates)) == (0, 1)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"repair": True}, "^--repair: .* is a store of features, whose runs were read"),
        ({"robot": "husky"}, "^--robot: "),
        ({"layout": "runs"}, "^--format: "),
        ({"only": ("LAVA",)}, "--only: there is no run 'LAVA'"),
        ({"without": tuple(f"{n}_{k}" for n in ("ICE", "SNOW") for k in range(4))}, "leave no run"),
    ],
)
def test_options_that_a_store_cannot_follow_are_refused(runs_dir, tmp_path, options, named):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    source = AlignedRunsSettings(data=tmp_path / "store", **options)
    with pytest.raises(ConfigError, match=named):
        store_of(source, SETTINGS.rule, SETTINGS.signal_sets)


def test_a_store_has_no_speeds_for_a_speed_protocol(runs_dir, tmp_path):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    asked = CrossvalSettings(protocol="slow-fast", steady=False)
    with pytest.raises(ConfigError, match=r"^'slow-fast' needs the wheel speeds of runs"):
        crossval_store(opened(tmp_path / "store"), asked)


def test_extras_of_a_store_are_noted_as_missing(runs_dir, tmp_path):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    report = crossval_store(opened(tmp_path / "store"), SETTINGS.with_(extras=True))
    assert report.extras is None
    assert report.notes[-1] == NO_EXTRAS


def test_processes_and_a_cluster_write_the_same_bytes(runs_dir, tmp_path):
    distributed = pytest.importorskip("distributed")
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "one"))
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "two", n_jobs=2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            distributed.LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
            ) as running,
            computing("dask:" + running.scheduler_address),
        ):
            build_store(run_loaders(runs_dir), features_settings(tmp_path / "there"))
    one = files_of(tmp_path / "one")
    assert len(one) == 10
    assert files_of(tmp_path / "two") == one
    assert files_of(tmp_path / "there") == one


def test_the_head_of_a_run_folder_is_that_of_the_run(runs_dir, make_run):
    for load in run_loaders(runs_dir):
        assert load.plain_folder is not None
        assert head_of(load) == _head(load())
    runs = load_runs(runs_dir)
    sketches = [head_of(load).sketch() for load in run_loaders(runs_dir)]
    whole, sketched = layout_of(runs), layout_of(sketches)
    assert (sketched.channels, sketched.rate_hz) == (whole.channels, whole.rate_hz)


def test_an_interrupted_store_goes_on_and_ends_the_same(runs_dir, tmp_path, monkeypatch):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "whole"))

    def interrupt(task, done, total):
        if (task, done) == ("features", 3):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"), interrupt)
    assert is_store(tmp_path / "store")
    with pytest.raises(LogError, match="unfinished store of features: run terrain features again"):
        opened(tmp_path / "store")
    report = build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    assert 0 < report.n_computed <= 5
    assert files_of(tmp_path / "store") == files_of(tmp_path / "whole")


def test_only_what_changed_is_computed_again(runs_dir, tmp_path, make_run):
    store = tmp_path / "store"
    assert build_store(run_loaders(runs_dir), features_settings(store)).n_computed == 8
    assert build_store(run_loaders(runs_dir), features_settings(store)).n_computed == 0
    write_run(make_run("ICE_0", "ICE", 99, 7.0), runs_dir, replace=True)
    assert build_store(run_loaders(runs_dir), features_settings(store)).n_computed == 1
    assert build_store(run_loaders(runs_dir), features_settings(store, window_s=1.0)).n_computed == 8
    assert build_store(run_loaders(runs_dir / "ICE_0"), features_settings(store, window_s=1.0)).n_runs == 1
    assert [path.name for path in (store / "windows").iterdir()] == ["ICE_0.parquet"]


@pytest.mark.parametrize("at", [0.3, 0.5, -6])
def test_a_damaged_file_is_one_sentence_and_made_again(runs_dir, tmp_path, at):
    store = tmp_path / "store"
    build_store(run_loaders(runs_dir), features_settings(store))
    path = store / "windows" / "ICE_1.parquet"
    content = bytearray(path.read_bytes())
    content[int(at * len(content)) if isinstance(at, float) else at] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"ICE_1\.parquet: is no whole file of a store of features"):
        read_store(opened(store))
    assert build_store(run_loaders(runs_dir), features_settings(store)).n_computed == 1
    read_store(opened(store))


def test_no_damaged_byte_changes_what_is_read(runs_dir, tmp_path):
    store = tmp_path / "store"
    build_store(run_loaders(runs_dir), features_settings(store))
    found = opened(store)
    path = store / "windows" / "ICE_1.parquet"
    content = path.read_bytes()
    arguments = store, "ICE_1", found.manifest.identity, len(found.manifest.features)
    entry, rows = read_run_windows(*arguments)
    refused = 0
    for at in range(0, len(content), len(content) // 150):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
        try:
            again, read = read_run_windows(*arguments)
        except LogError:
            refused += 1
            continue
        assert again == entry
        assert read.features.tobytes() == rows.features.tobytes()
        assert read.start_s.tobytes() == rows.start_s.tobytes()
        assert read.terrain.tolist() == rows.terrain.tolist()
        assert np.stack(read.motion).tobytes() == np.stack(rows.motion).tobytes()
    assert refused > 100


def test_a_missing_file_is_one_sentence(runs_dir, tmp_path):
    store = tmp_path / "store"
    build_store(run_loaders(runs_dir), features_settings(store))
    (store / "windows" / "ICE_1.parquet").unlink()
    with pytest.raises(LogError, match=r"ICE_1\.parquet: is no whole file"):
        read_store(opened(store))


def test_a_file_of_another_store_is_refused(runs_dir, tmp_path):
    for name, window_s in (("a", 2.0), ("b", 1.0)):
        build_store(run_loaders(runs_dir), features_settings(tmp_path / name, window_s=window_s))
    (tmp_path / "b/windows/ICE_1.parquet").replace(tmp_path / "a/windows/ICE_1.parquet")
    with pytest.raises(LogError, match=r"ICE_1\.parquet: is (of another store|no whole file)"):
        read_store(opened(tmp_path / "a"))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"window_s": 1.0}, r"--window 2\.0, 1\.0 is asked for"),
        ({"stride_s": 0.5}, r"--stride 2\.0, 0\.5 is asked for"),
        ({"steady": True}, "steady motion False, True is asked for"),
        ({"signal_sets": ("imu",)}, "--signals .*, imu is asked for"),
    ],
)
def test_a_store_of_other_windows_is_refused(runs_dir, tmp_path, changed, named):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    with pytest.raises(ConfigError, match=named):
        opened(tmp_path / "store", SETTINGS.with_(**changed))


def test_a_store_of_another_version_is_refused(runs_dir, tmp_path, monkeypatch):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    monkeypatch.setattr(manifest, "__version__", "9.9")
    with pytest.raises(ConfigError, match=r"version '0\.1\.0' made this store of features, this is 9\.9"):
        opened(tmp_path / "store")


def test_a_store_of_an_earlier_format_is_refused_and_built_again(runs_dir, tmp_path):
    store = tmp_path / "store"
    build_store(run_loaders(runs_dir), features_settings(store))
    whole = files_of(store)
    document = json.loads((store / "store.json").read_text())
    (store / "store.json").write_text(json.dumps(document | {"format_version": 1}))
    with pytest.raises(ConfigError) as refusal:
        opened(store)
    assert str(refusal.value).endswith(
        "is a store of features of format 1, format 2 is read here: build it again with terrain features"
    )
    build_store(run_loaders(runs_dir), features_settings(store))
    assert files_of(store) == whole


def test_a_store_of_one_class_is_refused(runs_dir, tmp_path):
    for name in ("ICE_0", "ICE_1", "ICE_2", "ICE_3"):
        shutil.rmtree(runs_dir / name)
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    with pytest.raises(DataError, match="two classes"):
        crossval_store(opened(tmp_path / "store"), SETTINGS.with_(protocol="leave-one-run-out"))


def test_features_that_never_vary_are_refused(tmp_path, make_run):
    for k in range(3):
        run = make_run(f"ICE_{k}", "ICE", k)
        streams = {
            name: Stream(each.time_s, np.ones_like(each.values), each.channels)
            for name, each in run.streams.items()
        }
        write_run(replace(run, streams=streams), tmp_path / "runs")
    build_store(run_loaders(tmp_path / "runs"), features_settings(tmp_path / "store"))
    with pytest.raises(DataError, match="no feature ever varies"):
        read_store(opened(tmp_path / "store"))


@pytest.mark.parametrize("name", ["store.json", "runs.json"])
@pytest.mark.parametrize("content", ["", "{}", "[]", '{"runs": [{"x": 1}]}'])
def test_a_damaged_list_is_one_sentence(runs_dir, tmp_path, name, content):
    build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    (tmp_path / "store" / name).write_text(content)
    with pytest.raises(LogError, match=name):
        opened(tmp_path / "store")


def test_a_folder_with_something_else_is_left_alone(runs_dir):
    before = files_of(runs_dir)
    with pytest.raises(ConfigError, match="holds something else"):
        build_store(run_loaders(runs_dir), features_settings(runs_dir))
    assert files_of(runs_dir) == before


def test_runs_that_differ_are_refused_before_anything_is_written(runs_dir, tmp_path, make_run):
    run = make_run("ODD", "ICE")
    write_run(replace(run, streams={"imu": run.streams["imu"]}), runs_dir)
    with pytest.raises(DataError, match="run ODD has no stream 'wheels'"):
        build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    assert not (tmp_path / "store").exists()


def test_a_repairing_reader_skips_and_counts(runs_dir, tmp_path, make_run):
    (runs_dir / "ICE_0" / "imu.parquet").write_bytes(b"damaged")
    write_run(make_run("SHORT", "ICE", 0, 1.0), runs_dir)
    with pytest.raises(LogError, match="ICE_0"):
        build_store(run_loaders(runs_dir), features_settings(tmp_path / "store"))
    report = build_store(run_loaders(runs_dir, repair=True), features_settings(tmp_path / "store"))
    assert (report.n_runs, report.dropped) == (8, {"run too short": 1})
    assert report.skipped[0].startswith("run skipped: ")
    samples = samples_of(load_runs(runs_dir, repair=True), SETTINGS.with_(skip_short=True))
    assert read_store(opened(tmp_path / "store")).samples.cut.dropped == samples.cut.dropped


def test_one_run_is_held_at_a_time(runs_dir, tmp_path, monkeypatch):
    """Runs are dropped as soon as their file is written."""
    stamps, most = [], []
    original = build.cut_windows

    def watched(runs, *args, **options):
        stamps.extend(weakref.ref(run.streams["imu"].time_s) for run in runs)
        gc.collect()
        most.append(sum(each() is not None for each in stamps))
        return original(runs, *args, **options)

    monkeypatch.setattr(build, "cut_windows", watched)
    build_store(run_loaders(runs_dir)[:3], features_settings(tmp_path / "store"))
    assert len(most) == 4  # once for the names of the features
    assert max(most) == 1


def test_heads_of_one_kind_share_their_streams():
    heads = [Head(f"run {k}", "husky", (("imu", ("gyro_z_radps",), 0.01),)) for k in range(2)]
    assert heads[0].sketch().streams["imu"] is heads[1].sketch().streams["imu"]
    assert heads[0].sketch().streams["imu"].rate_hz == 1 / np.float64(0.01)


def test_the_measured_data_give_the_same_features(datasets_dir, tmp_path):
    folder = datasets_dir / "vulpi"
    settings = CrossvalSettings()
    build_store(run_loaders(folder), FeaturesSettings(out=tmp_path / "store", n_jobs=1))
    samples = samples_of(load_runs(folder), settings)
    features = feature_matrix(settings.new_recipe(), samples.cut.windows)
    stored = read_store(opened(tmp_path / "store", settings))
    assert stored.features.tobytes() == features.tobytes()
    assert stored.samples.cut.dropped == samples.cut.dropped
