import os

import pytest

from terrain.errors import ConfigError, LogError, TerrainError
from terrain.files.documents import MAX_DEPTH, MAX_NODES, parse_json, parse_yaml, read_json, read_yaml
from terrain.files.names import MAX_NAME, check_inside, check_name, listed, name_fault, read_regular, shown

DEEP = 100_000


def json_of(content):
    return lambda path: (path.write_bytes(content), read_json(path, path.name, LogError, 10_000_000))[1]


def yaml_of(content):
    return lambda path: (path.write_bytes(content), read_yaml(path))[1]


LAUGHS = b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n".encode()
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGED = b"a: &a {k: 1}\n" + b"".join(
    f"{name}: &{name} {{<<: [{', '.join([f'*{before}'] * 99)}]}}\n".encode()
    for before, name in zip("abcd", "bcde", strict=True)
)


@pytest.mark.parametrize(
    ("read", "sentence"),
    [
        (json_of(b"[" * DEEP), "is nested deeper than 32 levels"),
        (json_of(b'{"a":' * DEEP), "is nested deeper than 32 levels"),
        (json_of(b"[" * 200 + b"]" * 200), "is nested deeper than 32 levels"),
        (json_of(b'{"a": NaN}'), "holds NaN, finite numbers are required"),
        (json_of(b"[-Infinity]"), "holds -Infinity, finite"),
        (json_of(b"[1e999]"), "holds 1e999, finite"),
        (json_of(b"[" + b"9" * 5000 + b"]"), "holds a whole number of more than 64 bits"),
        (json_of(b"[9223372036854775808]"), "holds a whole number of more than 64 bits"),
        (json_of(b'{"a": 1, "a": 2}'), "key 'a' is given twice"),
        (json_of(b'["\\ud800"]'), "holds half of a UTF-16 pair"),
        (json_of(b'{"a": "\xff"}'), "is no JSON ('utf-8' codec"),
        (json_of('{"a": 1}'.encode("utf-16")), "is no JSON ('utf-8' codec"),
        (json_of(b'{"a": \x00}'), "is no JSON"),
        (json_of(b""), "is no JSON"),
        (json_of(b" " * 10_000_001), "is larger than 9.53674 MiB"),
        (yaml_of(b"[" * DEEP), "is nested deeper than 32 levels"),
        (yaml_of(b"{a: " * DEEP), "is nested deeper than 32 levels"),
        (yaml_of(b"- " * DEEP), "is nested deeper than 32 levels"),
        (yaml_of(LAUGHS), "those of aliases counted each time"),
        (yaml_of(MERGED), "those of aliases counted each time"),
        (yaml_of(b"a: &a [*a]"), "holds an alias of itself (*a)"),
        (yaml_of(b"a: 0x" + b"f" * 5000), "holds a whole number of more than 64 bits"),
        (yaml_of(b"a: 9223372036854775808"), "holds a whole number of more than 64 bits"),
        (yaml_of(b"a: 1\na: 2"), "key 'a' is given twice"),
        (yaml_of(b"a: 2026-13-45"), "is no YAML (month must be in 1..12)"),
        (yaml_of(b"a: !!bool perhaps"), "is no YAML"),
        (yaml_of(b"a: !!timestamp soon"), "is no YAML"),
        (yaml_of(b"? [a]\n: 1"), "is no YAML"),
        (yaml_of(b"a: \x00"), "is no YAML"),
        (yaml_of(b"a: \xff"), "is no YAML ('utf-8' codec"),
        (yaml_of("a: 1".encode("utf-16")), "is no YAML ('utf-8' codec"),
        (yaml_of(b"#" * 1_048_577), "is larger than 1 MiB"),
    ],
)
def test_what_a_stranger_wrote_is_refused_in_one_sentence(tmp_path, read, sentence):
    with pytest.raises(TerrainError) as error:
        read(tmp_path / "file")
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_the_limits_are_reached_and_not_passed():
    at_the_limit = "[" * MAX_DEPTH + "1" + "]" * MAX_DEPTH
    assert parse_json(at_the_limit) == parse_yaml(at_the_limit)
    for parse in (parse_json, parse_yaml):
        with pytest.raises(ValueError, match="nested deeper"):
            parse(f"[{at_the_limit}]")
    assert parse_json("[9223372036854775807, -9223372036854775807]") == [2**63 - 1, 1 - 2**63]
    assert parse_yaml("- 9223372036854775807") == [2**63 - 1]
    assert len(parse_yaml("[" + "1," * 5000 + "]")) == 5000 < MAX_NODES


def test_ordinary_documents_are_read_as_ever():
    assert parse_json('\ufeff{"a": [1, 2.5, "é", null, true, "\\ud83d\\ude00"]}'.encode()) == {
        "a": [1, 2.5, "é", None, True, "😀"]
    }
    assert parse_yaml(b"\xef\xbb\xbfa: &t {column: t, unit: s}\nb: *t\nc: {<<: *t, unit: ms}\n") == {
        "a": {"column": "t", "unit": "s"},
        "b": {"column": "t", "unit": "s"},
        "c": {"column": "t", "unit": "ms"},
    }


def test_what_is_no_regular_file_is_never_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, sentence in (
        (tmp_path / "pipe", "is a pipe, a socket or a device, a regular file is required"),
        ("/dev/zero", "is a pipe, a socket or a device"),
        (tmp_path, "is a folder, a regular file is required"),
        (tmp_path / "none", "cannot be opened (No such file or directory)"),
        (tmp_path / "a\0b", "cannot be opened (embedded null byte)"),
        (tmp_path / ("x" * 300), "cannot be opened (File name too long)"),
    ):
        with pytest.raises(ConfigError) as error:
            read_regular(type(tmp_path)(path), "it", ConfigError, 10)
        assert sentence in str(error.value)


def test_links_stay_inside(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "secret").write_text("x")
    (tmp_path / "run" / "file").write_text("x")
    (tmp_path / "folder").symlink_to(tmp_path / "run")
    (tmp_path / "run" / "within").symlink_to("file")
    (tmp_path / "run" / "out").symlink_to("../secret")
    (tmp_path / "run" / "loop").symlink_to("loop")
    for name in ("file", "within"):
        check_inside(tmp_path / "folder" / name, tmp_path / "folder", name, LogError)
    with pytest.raises(LogError, match="out: is a link that leads out of"):
        check_inside(tmp_path / "run" / "out", tmp_path / "run", "out", LogError)
    with pytest.raises(LogError, match="loop: cannot be opened"):
        check_inside(tmp_path / "run" / "loop", tmp_path / "run", "loop", LogError)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("", "is empty"),
        ("  ", "is empty"),
        ("a/b", "holds a path separator"),
        ("a\\b", "holds a path separator"),
        ("..", "begins with a dot"),
        (".hidden", "begins with a dot"),
        ("a\nb", "holds a control character"),
        ("a\0", "holds a control character"),
        ("a\x1b[2J", "holds a control character"),
        ("a\u202eb", "holds a control character"),
        ("\ud800", "holds a control character"),
        ("x" * 129, "is longer than 128 characters"),
        ("雪" * 100, "is longer than 240 bytes"),
    ],
)
def test_a_name_that_leads_elsewhere_is_refused(name, fault):
    with pytest.raises(LogError) as error:
        check_name("run.json: robot", name, LogError)
    assert str(error.value).startswith("run.json: robot '")
    assert str(error.value).endswith(f"is no plain name: it {fault}")
    assert str(error.value).isprintable()


def test_a_name_may_be_of_any_language_and_messages_stay_short_and_printable():
    for name in ("SNOW_07", "мокрая трава", "雪", "می‌خواهم", "a b.c+d-1", "x" * MAX_NAME):
        assert name_fault(name) is None
    assert len(shown(["x"] * 10**5)) < 130
    assert listed(["a\nb", *"cd"]) == "a\\nb, c, d"
    assert listed(["x"] * 1000).endswith(" and 980 more")
