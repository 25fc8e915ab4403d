"""Damaged files are one sentence, or give what can be read; none takes forever or all memory."""

import sqlite3
import struct
import tracemalloc

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from pipelines.data.bag_files import MCAP_MAGIC
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError

from .foreign_bags import husky_rows, refused, write_bag, write_mcap, write_ros1

SUFFIXES = {"sqlite": "db3", "ros1": "bag", "ros1 packed": "bag"}

KNOWN = {
    "files that end early",
    "damaged blocks of messages",
    "damaged messages",
    "rows with a bad time",
    "values beyond any quantity",
    "channels with nothing finite",
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the bytes of a whole file of each kind, and a folder to work in."""
    folder = tmp_path_factory.mktemp("whole")
    rows = husky_rows(30)
    files = {
        "zstd": write_mcap(folder / "zstd.mcap", rows, chunk_size=4000),
        "lz4": write_mcap(folder / "lz4.mcap", rows, CompressionType.LZ4, chunk_size=4000),
        "none": write_mcap(folder / "none.mcap", rows, CompressionType.NONE, chunk_size=4000),
        "loose": write_mcap(folder / "loose.mcap", rows, use_chunking=False),
        "sqlite": write_bag(folder / "sqlite", rows) / "sqlite.db3",
        "ros1": write_ros1(folder / "ros1.bag", rows),
        "ros1 packed": write_ros1(folder / "packed.bag", rows, "BZ2"),
    }
    return folder, {name: path.read_bytes() for name, path in files.items()}


def read(folder, kind, content, repair):
    """Return the run of a file's bytes; None where it is refused in one sentence."""
    path = folder / f"damaged.{SUFFIXES.get(kind, 'mcap')}"
    path.write_bytes(content)
    try:
        (run,) = load_runs(path, mapping="husky_topics", repair=repair)
    except (LogError, ConfigError) as error:
        sentence = str(error)
    else:
        return run
    assert "\n" not in sentence
    assert len(sentence) < 1500
    return None


@given(
    st.sampled_from(["zstd", "lz4", "none", "loose", *SUFFIXES]),
    st.floats(0.0, 1.0) | st.just(1.0),
    st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)), max_size=8),
    st.booleans(),
)
@settings(max_examples=100)
def test_a_file_that_is_cut_off_or_changed_is_refused_or_counted_or_has_other_numbers(
    whole, kind, part, changes, repair
):
    folder, files = whole
    content = bytearray(files[kind][: int(part * len(files[kind]))])
    for place, value in changes if content else ():
        content[min(int(place * len(content)), len(content) - 1)] ^= value
    run = read(folder, kind, bytes(content), repair)
    if run is None:
        return
    assert set(run.dropped) <= KNOWN
    assert all(np.all(np.diff(stream.time_s) > 0) for stream in run.streams.values())
    if kind not in SUFFIXES and not changes:
        ends = files[kind].find(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00") + 9  # the end of the messages
        assert repair or len(content) >= ends
        assert run.dropped.get("files that end early", 0) == (len(content) < ends)


def test_a_chunk_that_is_changed_is_refused_and_left_out_when_repairing(whole):
    folder, files = whole
    content = bytearray(files["none"])
    content[len(content) // 2] ^= 1
    assert read(folder, "none", bytes(content), repair=False) is None
    run = read(folder, "none", bytes(content), repair=True)
    assert run.dropped["damaged blocks of messages"] == 1
    assert 12 < len(run.streams["imu"]) < 30


def record(op, content):
    return bytes([op]) + struct.pack("<Q", len(content)) + content


def chunk(size, compression, packed, crc=0):
    name = compression.encode()
    head = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


@pytest.mark.parametrize("pack", [zstandard.compress, lz4.frame.compress])
def test_a_chunk_that_grows_beyond_bounds_is_refused_without_being_unpacked(tmp_path, pack):
    packed = pack(bytes(100_000_000))
    compression = "zstd" if pack is zstandard.compress else "lz4"
    tracemalloc.start()
    try:
        for stated in (100, 200_000_000, 2**40):
            content = MCAP_MAGIC + chunk(stated, compression, packed)
            assert [read(tmp_path, "zstd", content, repair) for repair in (False, True)] == [None, None]
        assert tracemalloc.get_traced_memory()[1] < 60_000_000
    finally:
        tracemalloc.stop()


def test_a_bag_of_ros_1_does_not_unpack_to_more_than_is_accepted(whole, monkeypatch):
    folder, files = whole
    (folder / "bound.bag").write_bytes(files["ros1 packed"])
    monkeypatch.setattr("pipelines.data.bag_files.MAX_RECORD_BYTES", 1000)
    refused("would have more than 1000 bytes", folder / "bound.bag", mapping="husky_topics")


def test_records_and_chunks_that_are_nonsense_are_one_sentence(tmp_path):
    for content in (
        b"",
        record(6, b""),
        chunk(5, "", b"\x05\xff\xff\xff\xff"),
        chunk(9, "rar", b"123456789"),
        b"\x05" + b"\xff" * 8,
        record(3, b"\x01\x00\xff\xff\xff\xff"),
        record(5, bytes(22)) + record(15, bytes(4)),
        MCAP_MAGIC,
    ):
        for repair in (False, True):
            assert read(tmp_path, "zstd", MCAP_MAGIC + content, repair) is None


def test_a_view_in_the_place_of_a_table_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as store:
        store.execute("create table topics (id integer, name text, type text, serialization_format text)")
        store.execute(
            "create view messages as with recursive r(x) as (select 1 union all select x from r) "
            "select x as topic_id, x as timestamp, x as data from r"
        )
    store.close()
    refused("lacks the tables", tmp_path / "a.db3", robot="husky")
