"""Cached features are those of the runs, an interrupted cache goes on, and what is damaged is made again."""

import os
import weakref
from dataclasses import replace
from functools import partial

import pytest

from features.motion import window_motion
from features.protocols import samples_of
from features.recipes import feature_matrix
from pipelines.data.datasets import load_runs, run_loaders
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn import cache
from pipelines.learn.cache import cached_data
from pipelines.learn.crossval import EvaluationSettings, Settings
from pipelines.learn.recipes import recipe_of
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.run_folders import joint_digest, write_run
from terrain.records import Label, Stream

OPTIONS = {"repeats": 1, "steady": False, "n_jobs": 1, "extras": False}
SETTINGS = EvaluationSettings(**OPTIONS)


@pytest.fixture
def runs_dir(tmp_path, make_run):
    """Eight runs of two terrains, in run folders."""
    for name in ("ICE", "SNOW"):
        for k in range(4):
            run = make_run(f"{name}_{k}", name, k + 10 * (name == "ICE"), duration_s=7.0 + k)
            write_run(replace(run, session=f"session {k % 2}"), tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture
def cached(runs_dir, tmp_path):
    """Return a function that reads the runs through a cache: data, skipped runs, and how many were computed."""

    def cached(settings=SETTINGS, folder="cache", **options):
        left, loaders = [], run_loaders(AlignedRunsSettings(data=runs_dir, **options))

        def progress(task, done, total):
            left.extend([total - done] if task == "features" else [])

        return *cached_data(loaders, settings, tmp_path / folder, progress)[:2], left[0]

    return cached


def files_of(folder):
    return {path.name: path.read_bytes() for path in (folder / "features").iterdir()}


def test_cached_features_are_those_of_the_runs_bit_for_bit(runs_dir, cached):
    samples = samples_of(load_runs(runs_dir), SETTINGS.rule)
    features, motion = feature_matrix(recipe_of(SETTINGS), samples.windows), window_motion(samples.windows)
    for n_computed in (8, 0):
        found, _, n = cached()
        assert n == n_computed
        assert found.features.tobytes() == features.tobytes()
        for name in ("start_s", "run_id", "terrain", "session"):
            assert getattr(found.samples.windows, name).tolist() == getattr(samples.windows, name).tolist()
        for there, here in zip(found.motion, motion, strict=True):
            assert there.tobytes() == here.tobytes()
        assert found.samples.observed.quantities == samples.observed.quantities
        for there, here in zip(found.samples.observed[1:], samples.observed[1:], strict=True):
            assert there.tobytes() == here.tobytes()
    assert cached(SETTINGS.with_(window_s=1.0))[2] == 8  # beside the first
    assert cached()[2] == 0


def test_an_interrupted_cache_goes_on_and_ends_the_same(cached, tmp_path, monkeypatch):
    whole, usual, done = cached(folder="whole")[0], cache._store_run, []

    def interrupted(*given):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(usual(*given))

    monkeypatch.setattr(cache, "_store_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cached()
    monkeypatch.setattr(cache, "_store_run", usual)
    found, _, n_computed = cached()
    assert n_computed == 5
    assert found.features.tobytes() == whole.features.tobytes()
    assert files_of(tmp_path / "cache") == files_of(tmp_path / "whole")


def test_a_damaged_file_is_made_again(cached, tmp_path):
    whole, before = cached()[0], files_of(tmp_path / "cache")
    for damage in ("cut", "flip", "gone"):
        for kind in ("features", "runs"):
            file = sorted((tmp_path / "cache" / kind).iterdir())[3]
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 1
            cut = {"cut": bytes(content[:-9]), "flip": bytes(content), "gone": None}[damage]
            file.unlink() if cut is None else file.write_bytes(cut)
        found, _, n_computed = cached()
        assert n_computed == 1
        assert found.features.tobytes() == whole.features.tobytes()
        assert files_of(tmp_path / "cache") == before


def test_only_runs_whose_files_changed_are_read_again_and_one_is_held_at_a_time(
    runs_dir, cached, monkeypatch
):
    usual, read = cache.run_print, []

    def watched(run):
        assert not [values for _, values in read if values() is not None]
        read.append((run.run_id, weakref.ref(run.streams["imu"].values)))
        return usual(run)

    monkeypatch.setattr(cache, "run_print", watched)
    cached()
    assert len(read) == 8
    os.utime(next((runs_dir / "ICE_1").glob("*.parquet")))
    cached()
    assert [run_id for run_id, _ in read[8:]] == ["ICE_1"]


def test_runs_with_the_same_measurements_are_named_until_one_is_left_out(runs_dir, cached):
    first = load_runs(runs_dir)[2]
    streams = {
        name: Stream(each.time_s + 50.0, each.values.round(2), each.channels)
        for name, each in first.streams.items()
    }
    labels = tuple(Label(a + 50.0, b + 50.0, name) for a, b, name in first.labels)
    write_run(replace(first, run_id="again", streams=streams, labels=labels), runs_dir)
    for _ in range(2):  # also where all is cached
        with pytest.raises(DataError, match=r"ICE_2 and again hold the same measurements for 9\.0 s"):
            cached()
    asked = partial(Settings, data=runs_dir, **OPTIONS)
    found = cached(asked(without=("again",)))[0]
    assert found.digest == joint_digest([run.digest for run in found.runs])
    assert len(found.runs) == 8
    with pytest.raises(ConfigError, match="--only: there is no run 'LAVA'"):
        cached(asked(only=("LAVA",)))


def test_what_cannot_be_read_is_refused_or_skipped(runs_dir, cached, tmp_path):
    (runs_dir / "ICE_1" / "run.json").write_text("{")
    with pytest.raises(LogError, match=r"ICE_1"):
        cached()
    found, skipped, _ = cached(repair=True)
    assert len(found.runs) == 7
    assert skipped[0].startswith("run skipped: ")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match=r"--cache .*file: is no folder"):
        cached(folder="file")
