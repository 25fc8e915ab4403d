"""The pages of bags and of CAN: their mapping is accepted, their tables are those of an export and of the DBC."""

import re
from pathlib import Path

import cantools

from pipelines.data.run_writers import messages_of_run
from terrain.files.names import data_folder
from terrain.logs.mapping import TYPES, load_topics, short_type

DOCS = Path(__file__).resolve().parents[3] / "docs"
ROW = re.compile(
    r"^\| (\w+)(?:, sent)? \| (0x\w+) \| ([^|]*) \| ([\d.]+)[^|]*\|"
    r"(?: 0 to)? ([\d.]*) ?\|[^|]*\| (\d+) ms \|$"
)


def test_identifiers_resolutions_ranges_and_cycles_of_the_page():
    database = cantools.database.load_file(data_folder("can") / "agrimaro.dbc")
    page = (DOCS / "can.md").read_text(encoding="utf-8")
    rows = [found.groups() for line in page.splitlines() if (found := ROW.match(line))]
    assert {name for name, *_ in rows} == {message.name for message in database.messages}
    shown = set()
    for name, identifier, text, resolution, end, cycle in rows:
        message = database.get_message_by_name(name)
        assert (message.frame_id, message.cycle_time) == (int(identifier, 16), int(cycle))
        named = [s for s in message.signals if re.search(rf"\b{s.name.rstrip('123')}", text)]
        if "X to Z" in text:
            named = [s for s in message.signals if s.name[:-1] + "X" in text]
        assert named, text
        for signal in named:
            assert signal.scale == float(resolution), signal.name
            if end:
                assert abs(signal.maximum - float(end)) <= 0.006 * float(end), signal.name
            shown.add((name, signal.name))
    every = {(message.name, signal.name) for message in database.messages for signal in message.signals}
    assert shown == {(name, signal) for name, signal in every if signal not in ("Counter", "Crc8")}


def test_the_mapping_of_the_page_is_accepted_and_begins_with_the_packaged_one(tmp_path):
    page = (DOCS / "bags.md").read_text(encoding="utf-8")
    (yaml,) = re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "mapping.yaml").write_text(yaml)
    shown, packaged = load_topics(tmp_path / "mapping.yaml"), load_topics("husky_topics")
    assert {name: shown.streams[name] for name in packaged.streams} == packaged.streams
    assert set(re.findall(r"^\| `(\w+)` \|", page, flags=re.MULTILINE)) == set(TYPES)


def test_topics_of_the_page_are_those_of_an_export(estimated_run):
    page = (DOCS / "bags.md").read_text(encoding="utf-8")
    topics = {each.topic: each.kind for each in messages_of_run(estimated_run)}
    rows = [line for line in page.splitlines() if re.match(r"\| `/", line)]
    named = {topic for row in rows for topic in re.findall(r"`(/[\w/]+)`", row)} - {"/terrain/window"}
    assert named == {topic for topic in topics if not topic.startswith("/terrain/")} | {
        "/terrain/run",
        "/terrain/label",
    }
    for row in rows:
        for kind in re.findall(r"`(\w+_msgs/\w+)`", row):
            first = re.search(r"`(/[\w/]+)`", row)
            if first:
                assert short_type(topics.get(first[1], "std_msgs/msg/String")) == kind
