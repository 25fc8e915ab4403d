"""Run folders, and runs as topics: whatever is written is read back, whole or not at all, under one digest; labels."""

import json
import string
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from terrain.errors import DataError, LogError, TerrainError
from terrain.logs.mapping import Faults, Topic
from terrain.logs.run_folders import data_digest, find_runs, read_run, relabelled, write_run
from terrain.logs.run_topics import RUN_TOPIC, read_document, run_messages, run_of, string_of
from terrain.logs.samples import longest_rise
from terrain.records import Label, RunLog, Stream


def again(run, old="", new=""):
    """Return the run of the messages of one, in whose document a text is replaced."""
    messages = {each.topic: each for each in run_messages(run)}
    topics = {name: Topic(name, each.kind, "cdr", "", each.definition) for name, each in messages.items()}
    contents = {name: each.contents for name, each in messages.items()}
    text = string_of("a.mcap", contents[RUN_TOPIC][-1])
    assert old in text
    document = read_document("a.mcap", text.replace(old, new, 1), topics)
    return run_of("a.mcap", document, contents, Faults(None))


numbers = st.floats(allow_nan=True, allow_infinity=True)
words = st.one_of(
    st.text(string.ascii_letters + "_ üж.", min_size=1, max_size=12),
    st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), min_size=1, max_size=8),
).filter(lambda text: text.strip() and text[0] not in "._ " and text[-1] not in "_ ")


@st.composite
def runs(draw):
    """Return a run with streams and channels of any names, as far as run folders accept them."""
    streams = {}
    start_s = draw(st.sampled_from([0.0, -3.5, 1.7e9, 1e12]))
    for name in draw(st.lists(words, min_size=1, max_size=3, unique=True)):
        channels = draw(st.lists(words, min_size=1, max_size=4, unique=True))
        units = ("m", "radps", "ratio", "s")
        channels = [f"{channel}_{unit}" for channel, unit in zip(channels, units, strict=False)]
        n = draw(st.integers(2, 6))
        steps = draw(st.lists(st.floats(1e-3, 2.0), min_size=n - 1, max_size=n - 1))
        values = draw(st.lists(numbers, min_size=n * len(channels), max_size=n * len(channels)))
        values = np.array(values).reshape(n, len(channels))
        values[0] = 1.0
        time_s = start_s + np.concatenate([[0.0], np.cumsum(steps)])
        streams[name] = Stream(time_s, values, tuple(channels))
    labels = (Label(start_s - 1, start_s + 1, "мокрая трава"), Label(start_s + 1, start_s + 9, "A"))
    labels = draw(st.sampled_from([(), labels]))
    source = draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=8))
    dropped = draw(st.dictionaries(words, st.integers(0, 9), max_size=2))
    return RunLog(draw(words), draw(words), streams, labels, source, dropped, draw(words), draw(words))


@given(runs())
@settings(max_examples=25, deadline=None)
def test_a_run_that_is_written_as_a_folder_and_as_messages_is_read_back(tmp_path_factory, run):
    try:
        folder = write_run(run, tmp_path_factory.mktemp("drawn"))
    except LogError:
        assume(False)  # names that no run folder accepts
    finite = {
        name: Stream(s.time_s, np.where(np.isfinite(s.values), s.values, np.nan), s.channels)
        for name, s in run.streams.items()
    }
    by_folder = read_run(folder)
    by_bag = again(by_folder)
    assert data_digest([by_bag]) == data_digest([by_folder]) == data_digest([replace(run, streams=finite)])
    for each in (by_bag, by_folder):
        assert (each.filter, dict(each.dropped), each.source) == (run.filter, dict(run.dropped), run.source)


def test_the_same_run_gives_the_same_bytes(tmp_path, make_run):
    one, other = (write_run(make_run(), tmp_path / name) for name in ("one", "other"))
    files = sorted(path.name for path in one.iterdir())
    assert files == ["imu.parquet", "run.json", "wheels.parquet"]
    assert all((one / name).read_bytes() == (other / name).read_bytes() for name in files)


def test_a_run_is_replaced_when_asked_and_what_is_no_run_never(tmp_path, make_run):
    def first_value():
        return read_run(tmp_path / "SNOW_01").streams["imu"].values[0, 0]

    write_run(make_run(seed=1), tmp_path)
    with pytest.raises(LogError, match="a run folder is there already, and is left as it is"):
        write_run(make_run(seed=2), tmp_path)
    assert first_value() == make_run(seed=1).streams["imu"].values[0, 0]
    write_run(make_run(seed=2), tmp_path, replace=True)
    assert first_value() == make_run(seed=2).streams["imu"].values[0, 0]
    (tmp_path / "SNOW_01").rename(tmp_path / ".SNOW_01.1234")  # as a write that is not finished
    assert find_runs(tmp_path) == []
    (tmp_path / "SNOW_01").mkdir()
    (tmp_path / "SNOW_01" / "thesis.tex").write_text("precious")
    with pytest.raises(LogError, match="something else is there already"):
        write_run(make_run(), tmp_path, replace=True)
    assert (tmp_path / "SNOW_01" / "thesis.tex").exists()


def test_a_write_that_fails_or_leaves_the_folder_leaves_nothing_behind(tmp_path, make_run, monkeypatch):
    def full(*args, **options):
        raise OSError(28, "No space left on device")

    for run_id in ("../escape", "", ".hidden", "a/b"):
        with pytest.raises(LogError, match="cannot name a folder"):
            write_run(make_run(run_id), tmp_path)
    with pytest.raises(LogError, match="robot 'a/b' is no plain name"):
        write_run(replace(make_run(), robot="a/b"), tmp_path)
    monkeypatch.setattr("pyarrow.parquet.write_table", full)
    with pytest.raises(TerrainError, match=r"SNOW_01: cannot be written \(No space left on device\)"):
        write_run(make_run(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema_version=99), "schema version 99 is unknown, this package reads 1"),
        (lambda d: d.pop("schema_version"), "key 'schema_version' is missing"),
        (lambda d: d.update(streams={}), "the run has no stream"),
        (lambda d: d.update(streams=dict.fromkeys(map(str, range(65)), d["streams"]["imu"])),
         "the run has 65 streams, at most 64 are read"),
        (lambda d: d["streams"]["imu"].update(file="../imu.parquet"), "is not the name of a file in the run"),
        (lambda d: d["streams"]["imu"].update(file=""), "it is empty"),
        (lambda d: d["streams"]["imu"].update(file="gps.parquet"), "SNOW_01/gps.parquet: is missing"),
        (lambda d: d["streams"]["imu"]["channels"].update(gyro_z_radps="deg"), "'gyro_z_radps' is declared in 'deg'"),
        (lambda d: d["streams"]["imu"]["channels"].update(gyro_z_dps="dps"), "does not end in a known unit"),
        (lambda d: d["streams"]["imu"]["channels"].update(w_radps="radps"), "column 'w_radps' is missing"),
        (lambda d: d["streams"].update({"../imu": d["streams"].pop("imu")}), "stream '../imu' is no plain"),
        (lambda d: d["labels"].append({"start_s": 1.0, "end_s": 2.0, "terrain": "ICE"}), "overlap at 1.0 s"),
        (lambda d: d["labels"][0].update(end_s=-1.0), "label 'SNOW' ends at -1.0 s and starts at 0.0 s"),
        (lambda d: d["labels"][0].update(terrain="a\nb"), "terrain 'a\\nb' is no plain name"),
        (lambda d: d["labels"][0].update(start_s=10**300), "a whole number of more than 64 bits"),
        (lambda d: d.update(labels={"x": "y" * 10**6}), "input should be a valid list"),
        (lambda d: d.update(dropped={"\x1b[2J": 1}), "of 'dropped' holds a control character"),
        (lambda d: d.update(robot="/tmp/evil.yaml"),
         "SNOW_01/run.json: robot '/tmp/evil.yaml' is no plain name: it holds a path separator"),
        (lambda d: d.update(robot="a\x1b[2J"), "it holds a control character"),
        (lambda d: d.update(robot="x" * 10**6), "it is longer than 128 characters"),
        (lambda d: d.update(run_id="../../etc"), "run_id '../../etc' is no plain name"),
        (lambda d: d.update(session="a/b"), "session 'a/b' is no plain name"),
    ],
)  # fmt: skip
def test_a_wrong_run_json_is_refused_in_one_sentence(tmp_path, make_run, change, message):
    path = write_run(make_run(), tmp_path) / "run.json"
    head = json.loads(path.read_text())
    change(head)
    path.write_text(json.dumps(head))
    with pytest.raises(LogError) as error:
        read_run(path.parent)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_the_digest_sees_content_and_nothing_else(make_run):
    run, other = make_run(), make_run("SNOW_02", seed=1)
    imu = run.streams["imu"]

    def digest(stream=imu, **changes):
        streams = {"wheels": run.streams["wheels"], "imu": stream}
        return data_digest([replace(run, streams=streams, **changes)])

    values = imu.values.copy()
    values[7, 2] = np.nextafter(values[7, 2], 9.0)
    swapped = Stream(imu.time_s, imu.values[:, ::-1], imu.channels[::-1])
    assert digest() == digest(source="elsewhere", dropped={"rows": 1}) == digest(swapped)
    changed = [
        digest(Stream(imu.time_s, values, imu.channels)),
        digest(Stream(imu.time_s + 1e-9, imu.values, imu.channels)),
        digest(Stream(imu.time_s, imu.values, imu.channels[::-1])),
        digest(run_id="SNOW_09"),
        digest(robot="jackal"),
        digest(labels=(Label(0.0, 4.0, "ICE"),)),
    ]
    assert len({digest(), *changed}) == 7
    assert data_digest([run, other]) == data_digest([other, run]) != digest()


def test_a_run_that_is_too_long_for_stamps_and_a_changed_document_are_refused(make_run):
    stream = Stream([0.0, 3e9], [[1.0], [2.0]], ("gyro_z_radps",))
    with pytest.raises(DataError, match="stamps have"):
        again(RunLog("long", "husky", {"imu": stream}))
    for old, new in (
        ('"version": 1', '"version": 9'),
        ('"run_id"', '"run_ix"'),
        ('"robot": "', '"robot": "/'),
        ("terrain/imu", "terrain/imx"),
        ('gyro_x_radps"', 'gyro_x_furlo"'),
        ('"labels": [', '"labels": {'),
    ):
        with pytest.raises(LogError) as raised:
            again(make_run(), old, new)
        assert "\n" not in str(raised.value)


times = st.integers(0, 20).map(float)
intervals = st.tuples(times, times).filter(lambda each: each[0] < each[1])


@settings(max_examples=50)
@given(st.lists(st.tuples(intervals, st.sampled_from(["a", "b", ""])), max_size=6))
def test_the_last_label_of_an_instant_holds(changes):
    """Two routes to the label of an instant: the labels after all changes, and the last change over it."""
    labels = ()
    for (start_s, end_s), terrain in changes:
        labels = relabelled(labels, start_s, end_s, terrain)
    assert all(one.end_s <= other.start_s for one, other in pairwise(labels))
    for instant in np.arange(0.5, 20.0):
        last = [t for (start_s, end_s), t in changes if start_s <= instant < end_s]
        holds = [label.terrain for label in labels if label.start_s <= instant < label.end_s]
        assert holds == [t for t in last[-1:] if t]
    joined = [one for one, other in pairwise(labels) if one[1:] == (other[0], other[2])]
    assert joined == []


@given(st.lists(st.integers(-20, 20), max_size=12))
def test_the_longest_rise_rises_and_nothing_longer_does(numbers):
    rise = [numbers[i] for i in longest_rise(np.array(numbers, dtype=float))]
    assert all(a < b for a, b in pairwise(rise))
    best = [1] * len(numbers)  # by the plain quadratic recursion
    for i, number in enumerate(numbers):
        best[i] = 1 + max((best[j] for j in range(i) if numbers[j] < number), default=0)
    assert len(rise) == max(best, default=0)
