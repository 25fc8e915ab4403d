import csv

import numpy as np
import pytest

from terrain.errors import LogError
from terrain.files.names import data_folder
from terrain.logs.borealtc import find_runs
from terrain.logs.mapping import load_mapping


def read_run(folder, number, repair=False):
    (read,) = (
        each
        for each in find_runs(folder.parent)
        if (each.args[-1].words["terrain"], each.args[-1].words["run"]) == (folder.name, number)
    )
    return read(repair=repair)


def test_the_reader_agrees_with_the_plain_csv_module(datasets_dir):
    """Two routes; the column order of the two data sets differs."""
    mapping = load_mapping(data_folder("layouts") / "borealtc.yaml")
    for folder, number in (("borealtc/ICE", "04"), ("vulpi/DIRT_ROAD", "1")):
        run = read_run(datasets_dir / folder, number)
        for prefix, stream in (("imu", "imu"), ("pro", "wheels")):
            with (datasets_dir / folder / f"{prefix}_{number}.csv").open(newline="") as file:
                rows = list(csv.DictReader(file))
            assert run.streams[stream].time_s.tolist() == [float(row["time"]) for row in rows]
            for channel, entry in mapping.streams[stream].channels.items():
                listed = [float(row[entry.column]) for row in rows]
                assert run.streams[stream].channel(channel).tolist() == listed


def test_the_whole_run_is_labelled_with_its_class(borealtc_dir):
    run = read_run(borealtc_dir / "ICE", "01")
    assert (run.run_id, run.robot, run.terrains) == ("ICE_01", "husky", ("ICE",))
    label = run.labels[0]
    for stream in run.streams.values():
        assert np.all((stream.time_s >= label.start_s) & (stream.time_s < label.end_s))
    assert label.end_s == pytest.approx(3.98 + 0.02)


def spoil(cell):
    def change(lines):
        cells = lines[41].split(",")
        cells[3] = cell
        return [*lines[:41], ",".join(cells), *lines[42:]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [line.rpartition(",")[0] for line in lines],
         "SNOW/imu_01.csv: column 'az' is missing (the"),
        (lambda lines: [lines[0] + ",wx", *(line + ",0" for line in lines[1:])],
         "column 'wx' is there twice"),
        (lambda lines: lines[:1], "SNOW/imu_01.csv: has 0 usable rows of data, at least 2 are needed"),
        (lambda lines: lines[:2], "SNOW/imu_01.csv: has 1 usable rows of data, at least 2 are needed"),
        (lambda lines: [*lines[:30], lines[31], lines[30], *lines[32:]],
         "SNOW/imu_01.csv: time goes back at row 32 (0.58 s after 0.6 s)"),
        (lambda lines: [*lines[:30], "", lines[31], lines[30]], "goes back at row 33 (0.58 s after 0.6 s)"),
        (lambda lines: [*lines[:30], *lines[29:]], "SNOW/imu_01.csv: time repeats at row 31 (0.56 s twice)"),
        (spoil("1.2.3"), "SNOW/imu_01.csv: wz at row 42 is '1.2.3', which is no number"),
        (spoil("ERR"), "SNOW/imu_01.csv: wz at row 42 is 'ERR', which is no number"),
        (lambda lines: [*lines[:9], lines[9][:20], *lines[10:]],
         "SNOW/imu_01.csv: row 10 has 2 cells, the header has 7"),
        (lambda lines: [lines[0], *("," * 3 + line.split(",", 3)[3] for line in lines[1:])],
         "SNOW/imu_01.csv: time at row 2 is not finite (nan)"),
    ],
)  # fmt: skip
def test_a_broken_file_is_refused_with_file_row_and_value(borealtc_dir, edit, change, message):
    edit(borealtc_dir / "SNOW" / "imu_01.csv", change)
    with pytest.raises(LogError) as error:
        read_run(borealtc_dir / "SNOW", "01")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "SNOW/pro_01.csv: is empty"), (b"\n\n", "is empty"), (b"\xff\xfe\x00time", "is no CSV text")],
)
def test_an_empty_or_binary_file_is_refused(borealtc_dir, content, message):
    (borealtc_dir / "SNOW" / "pro_01.csv").write_bytes(content)
    with pytest.raises(LogError, match=message):
        read_run(borealtc_dir / "SNOW", "01")


def test_a_file_without_its_partner_is_refused_by_name(borealtc_dir):
    (borealtc_dir / "SNOW" / "pro_01.csv").unlink()
    readers = find_runs(borealtc_dir)
    assert len(readers) == 3
    with pytest.raises(LogError, match=r"^SNOW/pro_01\.csv: is missing$"):
        [read() for read in readers]


def test_streams_that_never_meet_are_refused(borealtc_dir, edit):
    def later(lines):
        cells = [line.split(",") for line in lines[1:]]
        return [lines[0], *(",".join([str(float(row[0]) + 100.0), *row[1:]]) for row in cells)]

    edit(borealtc_dir / "SNOW" / "pro_01.csv", later)
    with pytest.raises(LogError) as error:
        read_run(borealtc_dir / "SNOW", "01")
    assert str(error.value) == (
        "SNOW_01: the streams do not overlap in time (imu 0 to 3.98 s, wheels 100 to 103.9 s)"
    )


def test_repair_drops_what_strict_refuses_counts_it_and_touches_nothing_else(borealtc_dir, edit):
    whole = read_run(borealtc_dir / "SNOW", "01").streams["imu"]

    def spoil_all(lines):
        lines = spoil("ERR")(lines)
        lines[60] = lines[60][:15]  # torn row
        lines[70] = "0.1," + lines[70].split(",", 1)[1]  # time goes back
        lines[80] = "," + lines[80].split(",", 1)[1]  # time is missing
        return lines

    edit(borealtc_dir / "SNOW" / "imu_01.csv", spoil_all)
    run = read_run(borealtc_dir / "SNOW", "01", repair=True)
    assert run.dropped == {
        "cells that are no number": 1,
        "rows with missing or extra cells": 1,
        "rows with a bad time": 2,
    }
    expected = whole.values.copy()
    expected[40, 2] = np.nan
    kept = np.delete(np.arange(len(whole)), [59, 69, 79])
    np.testing.assert_array_equal(run.streams["imu"].time_s, whole.time_s[kept])
    np.testing.assert_array_equal(run.streams["imu"].values, expected[kept])
