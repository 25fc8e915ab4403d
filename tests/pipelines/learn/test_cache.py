"""Cached features are those of the runs, an interrupted cache goes on, and what is damaged is made again."""

import gc
import os
import weakref
from dataclasses import replace

import numpy as np
import pytest

from features.motion import Motion, window_motion
from features.protocols import samples_of
from features.recipes import feature_matrix
from pipelines.data.datasets import load_runs, run_loaders
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn import cache
from pipelines.learn.cache import cached_features
from pipelines.learn.crossval import EvaluationSettings
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_cache, data_of_runs, same_features
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.digest import joint_digest
from terrain.logs.write import write_run
from terrain.records import Label, Stream

SETTINGS = EvaluationSettings(repeats=1, steady=False, n_jobs=1, extras=False)


@pytest.fixture
def runs_dir(tmp_path, make_run):
    """Eight runs of two terrains, in run folders."""
    for name in ("ICE", "SNOW"):
        for k in range(4):
            write_run(make_run(f"{name}_{k}", name, k + 10 * (name == "ICE"), 7.0 + k), tmp_path / "runs")
    return tmp_path / "runs"


def cached(runs_dir, folder, settings=SETTINGS, source=None, **options):
    loaders = run_loaders(runs_dir, **options)
    return cached_features(loaders, settings.rule, settings.signal_sets, folder, settings.jobs, source=source)


def files_of(folder):
    return {path.name: path.read_bytes() for path in (folder / "features").iterdir()}


def test_cached_features_are_those_of_the_runs_bit_for_bit(runs_dir, tmp_path):
    samples = samples_of(load_runs(runs_dir), SETTINGS.rule)
    features = feature_matrix(recipe_of(SETTINGS), samples.windows)
    for n_computed in (8, 0):
        found = cached(runs_dir, tmp_path / "cache")
        assert found.n_computed == n_computed
        assert found.features.tobytes() == features.tobytes()
        for name in ("start_s", "run_id", "terrain"):
            there, here = getattr(found.samples.windows, name), getattr(samples.windows, name)
            assert there.tolist() == here.tolist()
        motion = window_motion(samples.windows)
        for name in Motion._fields:
            assert getattr(found.motion, name).tobytes() == getattr(motion, name).tobytes()
    other = cached(runs_dir, tmp_path / "cache", SETTINGS.with_(window_s=1.0))  # beside the first
    assert (other.n_computed, cached(runs_dir, tmp_path / "cache").n_computed) == (8, 0)


def test_what_is_trained_is_the_same_from_two_processes(runs_dir, tmp_path):
    settings = SETTINGS.with_(n_jobs=2)
    asked = RecipeSettings(**settings.shared())
    there = data_of_cache(cached(runs_dir, tmp_path / "cache", settings), asked)
    here = data_of_runs(load_runs(runs_dir), asked)
    assert there.runs == here.runs
    rows, groups = np.arange(5), here.samples.windows.run_id
    fitted = [each.recipe[-1].fit(each.rows, each.samples.terrain, groups) for each in (there, here)]
    assert np.array_equal(fitted[0].predict_proba(there.rows[rows]), fitted[1].predict_proba(here.rows[rows]))
    assert same_features(there.recipe.matrix, here.recipe.matrix)


def test_an_interrupted_cache_goes_on_and_ends_the_same(runs_dir, tmp_path, monkeypatch):
    whole = cached(runs_dir, tmp_path / "whole")
    usual, n = cache._store_run, 0

    def interrupted(*given):
        nonlocal n
        n += 1
        if n > 3:
            raise KeyboardInterrupt
        usual(*given)

    monkeypatch.setattr(cache, "_store_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cached(runs_dir, tmp_path / "cache")
    monkeypatch.setattr(cache, "_store_run", usual)
    found = cached(runs_dir, tmp_path / "cache")
    assert found.n_computed == 5
    assert found.features.tobytes() == whole.features.tobytes()
    assert files_of(tmp_path / "cache") == files_of(tmp_path / "whole")


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "gone"])
def test_a_damaged_file_is_made_again(runs_dir, tmp_path, damage):
    whole = cached(runs_dir, tmp_path / "cache")
    before = files_of(tmp_path / "cache")
    for kind in ("features", "runs"):
        file = sorted((tmp_path / "cache" / kind).iterdir())[3]
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        cut = {"cut": bytes(content[:-9]), "flip": bytes(content), "empty": b"", "gone": None}[damage]
        file.unlink() if cut is None else file.write_bytes(cut)
    found = cached(runs_dir, tmp_path / "cache")
    assert found.n_computed == 1
    assert found.features.tobytes() == whole.features.tobytes()
    assert files_of(tmp_path / "cache") == before


def test_runs_whose_files_did_not_change_are_not_read_again(runs_dir, tmp_path, monkeypatch):
    cached(runs_dir, tmp_path / "cache")
    read = []
    monkeypatch.setattr(cache, "data_digest", lambda runs: read.append(runs) or "0")
    cached(runs_dir, tmp_path / "cache")
    assert not read
    os.utime(next((runs_dir / "ICE_1").glob("*.parquet")))
    cached(runs_dir, tmp_path / "cache")
    assert [run.run_id for (run,) in read] == ["ICE_1"]


def test_only_one_run_is_held_at_a_time(runs_dir, tmp_path, monkeypatch):
    usual, alive = cache.run_print, []

    def watched(run):
        gc.collect()
        assert not [each for each in alive if each() is not None]
        alive.append(weakref.ref(run.streams["imu"].values))
        return usual(run)

    monkeypatch.setattr(cache, "run_print", watched)
    cached(runs_dir, tmp_path / "cache")
    assert len(alive) == 8


def test_runs_with_the_same_measurements_are_named_until_one_is_left_out(runs_dir, tmp_path):
    first = load_runs(runs_dir)[2]
    streams = {
        name: Stream(each.time_s + 50.0, each.values.round(2), each.channels)
        for name, each in first.streams.items()
    }
    labels = tuple(Label(a + 50.0, b + 50.0, name) for a, b, name in first.labels)
    write_run(replace(first, run_id="again", streams=streams, labels=labels), runs_dir)
    for _ in range(2):  # also where all is cached
        with pytest.raises(
            DataError, match=r"ICE_2 and again hold the same measurements for 9\.0 s"
        ) as refusal:
            cached(runs_dir, tmp_path / "cache")
        assert len(str(refusal.value).splitlines()) == 1
    source = AlignedRunsSettings(data=runs_dir, without=("again",))
    found = cached(runs_dir, tmp_path / "cache", source=source)
    assert len(found.runs) == 8
    assert found.digest == joint_digest([run.digest for run in found.runs])
    with pytest.raises(ConfigError, match="--only: there is no run 'LAVA'"):
        cached(runs_dir, tmp_path / "cache", source=AlignedRunsSettings(data=runs_dir, only=("LAVA",)))


def test_a_run_that_cannot_be_read_is_refused_or_skipped(runs_dir, tmp_path):
    (runs_dir / "ICE_1" / "run.json").write_text("{")
    with pytest.raises(LogError, match=r"ICE_1"):
        cached(runs_dir, tmp_path / "cache")
    found = cached(runs_dir, tmp_path / "cache", repair=True)
    assert len(found.runs) == 7
    assert found.skipped[0].startswith("run skipped: ")


def test_a_cache_that_is_a_file_is_refused(runs_dir, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match=r"--cache .*file: is no folder"):
        cached(runs_dir, tmp_path / "file")
