"""A copy under another name neither raises a figure nor counts twice."""

from dataclasses import replace

import numpy as np
import pytest

from features.protocols import samples_of
from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.inspect import run as inspect_runs
from pipelines.learn.crossval import crossval
from terrain.errors import DataError
from terrain.logs.run_folders import write_run
from terrain.records import Label, Stream


def copy_of(run, run_id, offset_s=0.0, decimals=4):
    streams = {
        name: Stream(each.time_s + offset_s, each.values.round(decimals), each.channels)
        for name, each in run.streams.items()
    }
    labels = tuple(Label(a + offset_s, b + offset_s, name) for a, b, name in run.labels)
    return replace(run, run_id=run_id, streams=streams, labels=labels)


@pytest.mark.parametrize("protocol", ["grouped", "published"])
def test_copies_are_refused_by_name_with_what_to_do(runs, settings, protocol):
    copies = [copy_of(run, f"again_{i}", 50.0) for i, run in enumerate(runs[:5])]
    with pytest.raises(DataError) as refusal:
        crossval([*runs, *copies], settings(protocol=protocol))
    sentence = str(refusal.value)
    assert "runs ASPHALT_1 and again_0 hold the same measurements for 24.0 s" in sentence
    assert "and so do 2 more pairs of runs" in sentence
    assert "--merge-duplicates" in sentence
    assert "\n" not in sentence


@pytest.mark.slow
def test_merged_copies_leave_every_window_as_it_was(runs, settings):
    copies = [copy_of(run, f"{run.run_id}_again", 50.0) for run in runs]
    merged = samples_of([*runs, *copies], settings().rule, merge_duplicates=True)
    alone = samples_of(runs, settings().rule)
    assert merged.windows.run_id.tolist() == alone.windows.run_id.tolist()
    np.testing.assert_array_equal(merged.windows.values["imu"], alone.windows.values["imu"])
    report = crossval([*runs, *copies], settings(merge_duplicates=True))
    assert report.accuracy == crossval(runs, settings()).accuracy
    assert report.n_runs == len(runs)
    notes = [note for note in report.notes if "they are one run" in note]
    assert len(notes) == len(runs)


def test_import_and_inspect_report_copies(runs, tmp_path):
    for run in (*runs[:2], copy_of(runs[0], "again", 9.0)):
        write_run(run, tmp_path / "data")
    inspected = inspect_runs(InspectSettings(data=tmp_path / "data"))
    imported = convert(ConvertSettings(data=tmp_path / "data", out=tmp_path / "out"))
    for result in (inspected, imported):
        assert [(each.first, each.second) for each in result.duplicates] == [("ASPHALT_1", "again")]
