"""Labels are set where a person says so, and nothing else of a run changes."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.learn.label import Settings, time_text
from pipelines.learn.label import run as label
from pipelines.live.classifying import WindowOutput
from pipelines.live.recording import recorded
from terrain.errors import ConfigError, LogError
from terrain.files import atomic
from terrain.logs.labels import relabelled
from terrain.logs.read import read_run
from terrain.logs.recorded_windows import WINDOWS_FILE, windows_text
from terrain.logs.write import write_run

WINDOWS = ((0.0, "SNOW", 0.9), (1.0, "SNOW", 0.4), (2.0, "ICE", 0.49), (3.0, "", np.nan))


@pytest.fixture
def folder(tmp_path, make_run):
    """Two runs of 4 s labelled SNOW; windows were recorded with the first."""
    outputs = [
        WindowOutput(
            start_s,
            start_s + 1.0,
            terrain,
            p,
            np.array([p, 1 - p]),
            ("SNOW", "ICE"),
            "" if terrain else "NaN",
        )
        for start_s, terrain, p in WINDOWS
    ]
    windows = {WINDOWS_FILE: windows_text(recorded(output) for output in outputs)}
    write_run(make_run("SNOW_01"), tmp_path / "runs", beside=windows)
    write_run(make_run("SNOW_02"), tmp_path / "runs")
    return tmp_path / "runs"


def found(folder, **options):
    return label(Settings(data=folder, **options))


def labelled(folder, **options):
    return label(Settings(data=folder, **({"run": "SNOW_01"} | options)))


def labels_of(folder, run_id="SNOW_01"):
    return [tuple(label) for label in read_run(folder / run_id).labels]


def test_windows_of_low_confidence_of_all_runs_are_listed(folder):
    result = found(folder)
    assert [row[:4] for row in result.windows] == [
        ("SNOW_01", 1.0, 2.0, "SNOW"),
        ("SNOW_01", 2.0, 3.0, "ICE"),
        ("SNOW_01", 3.0, 4.0, ""),
    ]
    assert {row.label for row in result.windows} == {"SNOW"}
    assert result.runs == (("SNOW_01", 4, 3, 0), ("SNOW_02", None, 0, 0))
    assert found(folder / "SNOW_01").windows == found(folder, run="SNOW_01").windows == result.windows


def test_a_label_replaces_what_was_there_and_keeps_all_else(folder):
    before = json.loads((folder / "SNOW_01" / "run.json").read_text())
    before["note"] = {"kept": [1.5, None, "ä"]}
    (folder / "SNOW_01" / "run.json").write_text(json.dumps(before))
    parquet = (folder / "SNOW_01" / "imu.parquet").read_bytes()
    result = labelled(folder, from_s=1.0, to_s=3.0, terrain="ICE")
    assert labels_of(folder) == [(0.0, 1.0, "SNOW"), (1.0, 3.0, "ICE"), (3.0, 4.0, "SNOW")]
    assert [tuple(label) for label in result.labels] == labels_of(folder)
    after = json.loads((folder / "SNOW_01" / "run.json").read_text())
    assert {**after, "labels": None} == {**before, "labels": None}
    assert (folder / "SNOW_01" / "imu.parquet").read_bytes() == parquet
    assert [row.label for row in found(folder).windows] == ["ICE", "ICE", "SNOW"]
    assert labels_of(folder, "SNOW_02") == [(0.0, 4.0, "SNOW")]


def test_labels_are_removed_in_an_interval_or_of_a_run(folder):
    labelled(folder, from_s=1.0, to_s=2.0, remove=True)
    assert labels_of(folder) == [(0.0, 1.0, "SNOW"), (2.0, 4.0, "SNOW")]
    assert [row.label for row in found(folder).windows] == [None, "SNOW", "SNOW"]
    assert found(folder).runs[0].n_without_label == 1
    labelled(folder, whole=True, terrain="")
    assert labels_of(folder) == []


def test_a_whole_run_is_labelled_to_the_end_of_its_last_sample(folder):
    labelled(folder, whole=True, remove=True)
    labelled(folder, whole=True, terrain="ICE")
    ((start_s, end_s, terrain),) = labels_of(folder)
    assert (start_s, terrain) == (0.0, "ICE")
    assert end_s == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"run": "SNOW_03", "whole": True, "terrain": "ICE"}, "there is no run 'SNOW_03'"),
        (
            {"from_s": 3.0, "to_s": 4.5, "terrain": "ICE"},
            "SNOW_01 is from 0 to 4 s: 3 to 4.5 s is not within",
        ),
        ({"from_s": -1.0, "to_s": 2.0, "terrain": "ICE"}, "is not within"),
        ({"from_s": 2.0, "to_s": 2.0, "terrain": "ICE"}, "ends before it starts"),
        ({"from_s": 2.0, "to_s": float("nan"), "terrain": "ICE"}, "--to is nan"),
        ({"from_s": 2.0, "terrain": "ICE"}, "needs --from and --to"),
        ({"from_s": 2.0, "whole": True, "terrain": "ICE"}, "leave out --from"),
        (
            {"from_s": 2.0, "to_s": 3.0, "whole": True, "terrain": "ICE"},
            "needs --from and --to in s, or --all",
        ),
        ({"terrain": "ICE"}, "needs --from and --to"),
        ({"whole": True}, "needs --terrain NAME, or --remove"),
        ({"whole": True, "terrain": "../ICE"}, "use letters"),
        ({"whole": True, "terrain": "ICE", "remove": True}, "give one of the two"),
        ({"run": None, "whole": True, "terrain": "ICE"}, "needs --run"),
        ({"model": "a", "answers": "b", "out": "c"}, "--model proposes labels"),
        ({"model": "a", "terrain": "ICE", "whole": True}, "--model proposes labels"),
        ({"answers": "b"}, "--answers FILE sets labels in the new folder --out DIR"),
        ({"out": "c"}, "--answers FILE sets labels in the new folder --out DIR"),
    ],
)
def test_what_is_not_accepted_changes_nothing(folder, options, message):
    before = (folder / "SNOW_01" / "run.json").read_bytes()
    with pytest.raises(ConfigError, match=message):
        labelled(folder, **options)
    assert (folder / "SNOW_01" / "run.json").read_bytes() == before


def test_places_without_runs_and_two_runs_of_one_id_are_refused(folder, tmp_path):
    with pytest.raises(LogError, match="does not exist"):
        found(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="holds no run folder"):
        found(tmp_path / "empty")
    (folder / "SNOW_01").rename(folder / "other")
    head = (folder / "SNOW_02" / "run.json").read_text()
    (folder / "SNOW_02" / "run.json").write_text(head.replace("SNOW_02", "SNOW_01"))
    with pytest.raises(LogError, match="2 runs have the id 'SNOW_01'"):
        labelled(folder, whole=True, terrain="ICE")


def test_a_write_that_fails_leaves_the_run_as_it_was(folder, monkeypatch):
    before = (folder / "SNOW_01" / "run.json").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(Exception, match="No space left on device"):
        labelled(folder, whole=True, terrain="ICE")
    assert (folder / "SNOW_01" / "run.json").read_bytes() == before
    assert sorted(path.name for path in (folder / "SNOW_01").iterdir()) == [
        *("imu.parquet", "run.json", "wheels.parquet", "windows.json"),
    ]


times = st.integers(0, 20).map(float)
intervals = st.tuples(times, times).filter(lambda each: each[0] < each[1])


@given(st.lists(st.tuples(intervals, st.sampled_from(["a", "b", ""])), max_size=6))
def test_the_last_label_of_an_instant_holds(settings):
    """Two routes to the label of an instant: the labels after all changes, and the last change over it."""
    labels = ()
    for (start_s, end_s), terrain in settings:
        labels = relabelled(labels, start_s, end_s, terrain)
    assert all(one.end_s <= other.start_s for one, other in pairwise(labels))
    for instant in np.arange(0.5, 20.0):
        last = [t for (start_s, end_s), t in settings if start_s <= instant < end_s]
        holds = [label.terrain for label in labels if label.start_s <= instant < label.end_s]
        assert holds == [t for t in last[-1:] if t]
    joined = [one for one, other in pairwise(labels) if one[1:] == (other[0], other[2])]
    assert joined == []


def test_times_are_printed_as_they_can_be_given_back():
    for time_s in (0.0, 4.73, 1732345678.123456, 0.000001):
        assert float(time_text(time_s)) == pytest.approx(time_s, abs=1e-6)
