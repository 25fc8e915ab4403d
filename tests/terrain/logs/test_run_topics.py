"""A run as topics is the run again: whatever a run folder keeps, messages keep."""

import string

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from terrain.errors import DataError, LogError
from terrain.logs.digest import data_digest
from terrain.logs.read import read_run
from terrain.logs.run_topics import RUN_TOPIC, read_document, run_messages, run_of, string_of
from terrain.logs.topics import Faults, Topic
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream


def again(run, old="", new=""):
    """Return the run of the messages of one, in whose document a text is replaced."""
    messages = {each.topic: each for each in run_messages(run)}
    topics = {name: Topic(name, each.kind, "cdr", "", each.definition) for name, each in messages.items()}
    contents = {name: each.contents for name, each in messages.items()}
    text = string_of("a.mcap", contents[RUN_TOPIC][-1])
    assert old in text
    return run_of(
        "a.mcap", read_document("a.mcap", text.replace(old, new, 1), topics), contents, Faults(None)
    )


numbers = st.floats(allow_nan=True, allow_infinity=True)
words = st.text(string.ascii_letters + "_ üж.", min_size=1, max_size=12).filter(
    lambda text: text.strip() and text[0] not in "._ " and text[-1] not in "_ "
)


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
        time_s = start_s + np.concatenate([[0.0], np.cumsum(steps)])
        values = draw(st.lists(numbers, min_size=n * len(channels), max_size=n * len(channels)))
        values = np.array(values).reshape(n, len(channels))
        values[0] = 1.0
        streams[name] = Stream(time_s, values, tuple(channels))
    labels = (Label(start_s - 1, start_s + 1, "мокрая трава"), Label(start_s + 1, start_s + 9, "A"))
    labels = draw(st.sampled_from([(), labels]))
    dropped = draw(st.dictionaries(words, st.integers(0, 9), max_size=2))
    return RunLog(draw(words), draw(words), streams, labels, "drawn", dropped, draw(words), draw(words))


@given(runs())
@settings(max_examples=100, deadline=None)
def test_whatever_a_run_folder_keeps_messages_keep(tmp_path_factory, run):
    try:
        by_folder = read_run(write_run(run, tmp_path_factory.mktemp("drawn")))
    except LogError:
        assume(False)  # names that no run folder accepts
    by_bag = again(by_folder)
    assert data_digest([by_bag]) == data_digest([by_folder])
    assert (by_bag.filter, dict(by_bag.dropped)) == (by_folder.filter, dict(by_folder.dropped))


def test_a_run_that_is_too_long_for_stamps_is_refused():
    stream = Stream([0.0, 3e9], [[1.0], [2.0]], ("gyro_z_radps",))
    with pytest.raises(DataError, match="stamps have"):
        again(RunLog("long", "husky", {"imu": stream}))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"version": 1', '"version": 9'),
        ('"run_id"', '"run_ix"'),
        ('"robot": "', '"robot": "/'),
        ("terrain/imu", "terrain/imx"),
        ('gyro_x_radps"', 'gyro_x_furlo"'),
        ('"labels": [', '"labels": {'),
    ],
)
def test_a_document_that_is_changed_is_refused(make_run, old, new):
    with pytest.raises(LogError) as raised:
        again(make_run(), old, new)
    assert "\n" not in str(raised.value)
