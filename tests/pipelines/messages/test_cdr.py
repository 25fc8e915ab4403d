"""Numbers that are decoded in columns are those that rosbags serialized, whatever the type."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.messages.cdr import MAX_LAYOUTS, Decoder, UndecodableError
from pipelines.messages.definitions import PRIMITIVES, check_path, parse_definition
from pipelines.messages.storage import batch_of
from terrain.errors import ConfigError, LogError

INTEGERS = [kind for kind in PRIMITIVES if "int" in kind]
kinds = st.sampled_from([*(kind for kind in PRIMITIVES if kind not in ("byte", "char")), "string"])
arrays = st.sampled_from(["", "", "[3]", "[]", "[<=5]"])
fields = st.lists(st.tuples(kinds, arrays), min_size=1, max_size=6)


def value_of(draw, kind, array):
    """Return a value of a field, as rosbags takes it."""
    if kind == "string":
        one = st.text(alphabet="abc", max_size=9)
    elif kind == "bool":
        one = st.booleans()
    elif kind in INTEGERS:
        info = np.iinfo(kind)
        one = st.integers(max(info.min, -(2**53)), min(info.max, 2**53))
    else:
        one = st.floats(width=int(kind[5:]))
    n = 3 if array == "[3]" else draw(st.integers(0, 5))
    if not array:
        return draw(one)
    many = draw(st.lists(one, min_size=n, max_size=n))
    return (
        many
        if kind == "string"
        else np.array(many, dtype=np.dtype(PRIMITIVES[kind] if kind != "bool" else "?"))
    )


def numbers_of(names, kind, value):
    """Yield path and value of each number in a field."""
    if kind == "string":
        return
    if np.ndim(value):
        for index, each in enumerate(value):
            yield f"{names}[{index}]", float(each)
    else:
        yield names, float(value)


@given(st.data(), fields, fields, st.sampled_from(["", "[2]", "[]"]))
@settings(max_examples=60, deadline=None)
def test_numbers_are_those_that_were_serialized(data, inner, outer, many):
    lines = [f"{kind}{array} f{i}" for i, (kind, array) in enumerate(outer)]
    lines.insert(len(lines) // 2, f"Inner{many} inner")
    inner_text = "\n".join(f"{kind}{array} g{i}" for i, (kind, array) in enumerate(inner))
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("\n".join(lines), "own_msgs/msg/Outer"))
    store.register(get_types_from_msg(inner_text, "own_msgs/msg/Inner"))
    definition = parse_definition(
        "own_msgs/msg/Outer", "\n".join([*lines, "=" * 80, "MSG: own_msgs/Inner", inner_text])
    )
    messages, truth = [], []
    for _ in range(data.draw(st.integers(1, 5))):
        rows, expected = [], {}
        for _ in range({"": 1, "[2]": 2}.get(many, data.draw(st.integers(0, 3)))):
            values = [value_of(data.draw, *field) for field in inner]
            at = f"inner[{len(rows)}]" if many else "inner"
            for i, ((kind, _), value) in enumerate(zip(inner, values, strict=True)):
                expected.update(numbers_of(f"{at}.g{i}", kind, value))
            rows.append(store.types["own_msgs/msg/Inner"](*values))
        values = {f"f{i}": value_of(data.draw, *field) for i, field in enumerate(outer)}
        for (kind, _), (name, value) in zip(outer, values.items(), strict=True):
            expected.update(numbers_of(name, kind, value))
        message = store.types["own_msgs/msg/Outer"](**values, inner=rows if many else rows[0])
        little = data.draw(st.booleans())
        messages.append(bytes(store.serialize_cdr(message, "own_msgs/msg/Outer", little_endian=little)))
        truth.append(expected)
    paths = sorted(set(itertools.chain(*truth)))
    decoder = Decoder(definition, [check_path("/a", definition, path) for path in paths])
    batch = batch_of("/a", range(len(messages)), messages)
    values, damaged = decoder.decode(batch.data, batch.start, batch.size)
    assert not damaged.any()
    sent = np.array([[row.get(path, np.nan) for path in paths] for row in truth]).reshape(values.shape)
    np.testing.assert_array_equal(values, sent)


RATES = parse_definition("a_msgs/msg/Rates", "string name\nfloat32[] rates\nfloat64 last")


def rates(name, numbers):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("string name\nfloat32[] rates\nfloat64 last", "a_msgs/msg/Rates"))
    message = store.types["a_msgs/msg/Rates"](name, np.array(numbers, dtype=np.float32), 7.0)
    return bytes(store.serialize_cdr(message, "a_msgs/msg/Rates"))


@pytest.mark.slow
def test_more_layouts_than_are_kept_are_read_too():
    messages = [rates("a" * (i % 7) + "b" * 40 * (i // 100), [float(i)] * (i % 5)) for i in range(300)]
    messages += [rates("x" * i, [0.5] * (99 - i // 4)) for i in range(100) for _ in range(2)]
    decoder = Decoder(RATES, [check_path("/a", RATES, path) for path in ("last", "rates[3]")])
    batch = batch_of("/a", range(len(messages)), messages)
    values, damaged = decoder.decode(batch.data, batch.start, batch.size)
    assert np.bincount(batch.size).max() > MAX_LAYOUTS // 16
    assert not damaged.any()
    assert values[:, 0].tolist() == [7.0] * len(messages)
    assert np.isfinite(values[:300, 1]).tolist() == [i % 5 == 4 for i in range(300)]


def test_more_layouts_of_one_size_than_are_kept_are_read_too():
    text = "\n".join(f"uint8[] a{i}" for i in range(8)) + "\nuint8 last"
    definition = parse_definition("a_msgs/msg/Bytes", text)
    rng = np.random.default_rng(0)
    messages = []
    for i in range(300):
        content = b""
        for n in rng.multinomial(24, np.ones(8) / 8) * 4:  # whole words, so that all have one size
            content += int(n).to_bytes(4, "little") + bytes(int(n))
        messages.append(b"\0\1\0\0" + content + bytes([i % 256]))
    assert len({len(message) for message in messages}) == 1
    decoder = Decoder(definition, [check_path("/a", definition, "last")])
    batch = batch_of("/a", range(300), messages)
    values, damaged = decoder.decode(batch.data, batch.start, batch.size)
    assert values[:, 0].tolist() == [i % 256 for i in range(300)]
    assert not damaged.any()


@given(st.binary(max_size=60))
def test_bytes_that_are_no_message_are_damaged_or_numbers(content):
    decoder = Decoder(RATES, [check_path("/a", RATES, "last")])
    batch = batch_of("/a", [0], [content])
    values, damaged = decoder.decode(batch.data, batch.start, batch.size)
    assert values.shape == (1, 1)
    assert damaged[0] == (len(content) < 24 or damaged[0])


def test_a_message_that_is_cut_off_is_damaged():
    message = rates("abc", [1.0, 2.0])
    decoder = Decoder(RATES, [check_path("/a", RATES, "last")])
    assert decoder.layout_of(message)
    for end in range(len(message)):
        with pytest.raises(UndecodableError):
            decoder.layout_of(message[:end])
    with pytest.raises(UndecodableError, match="plain CDR"):
        decoder.layout_of(b"\0\7" + message[2:])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("float64 x\nbanana", "'banana' is no field"),
        ("Other other", "lacks that of 'a_msgs/Other'"),
        ("Own own", "holds itself"),
        ("float64[0] x", "length that is not accepted"),
        ("float64[99999999] x", "length that is not accepted"),
        ("float64 x\n" + "=" * 80 + "\nfloat64 y", "is no line 'MSG: package/Type'"),
        ("\n".join(f"int8 x{i}" for i in range(10_001)), "more than 10000 fields"),
        (
            "A0 a\n"
            + "\n".join(f"{'=' * 80}\nMSG: a_msgs/A{i}\nA{i + 1} a" for i in range(40))
            + f"\n{'=' * 80}\nMSG: a_msgs/A40\nint8 a",
            "too deep",
        ),
    ],
)
def test_a_definition_that_is_not_accepted_is_one_sentence(text, fault):
    with pytest.raises(LogError, match=fault):
        parse_definition("a_msgs/msg/Own", text)


def test_constants_comments_defaults_and_bounds_are_no_obstacle():
    lines = ["uint8 A=1 # one", 'string B="x # y"', "", "# all", "int16 speed 5", "string<=4 name"]
    text = "\n".join([*lines, "float32[<=3] rates", "bool on"])
    fields = parse_definition("a_msgs/msg/Own", text).fields["a_msgs/Own"]
    assert [field.name for field in fields] == ["speed", "name", "rates", "on"]
    empty = parse_definition("std_msgs/msg/Empty", "# nothing\n")
    assert [field.kind for field in empty.fields["std_msgs/Empty"]] == ["uint8"]
    with pytest.raises(ConfigError, match="has no 'a'"):
        check_path("/a", empty, "a.")
