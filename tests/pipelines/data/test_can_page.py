"""The table of the page is that of the DBC."""

import re
from pathlib import Path

import cantools

from terrain.files.resources import data_folder

ROOT = Path(__file__).resolve().parents[3]
ROW = re.compile(
    r"^\| (\w+)(?:, sent)? \| (0x\w+) \| ([^|]*) \| ([\d.]+)[^|]*\|"
    r"(?: 0 to)? ([\d.]*) ?\|[^|]*\| (\d+) ms \|$"
)


def test_identifiers_resolutions_ranges_and_cycles_of_the_page():
    database = cantools.database.load_file(data_folder("can") / "agrimaro.dbc")
    page = (ROOT / "docs" / "can.md").read_text(encoding="utf-8")
    rows = [found.groups() for line in page.splitlines() if (found := ROW.match(line))]
    assert {name for name, *_ in rows} == {message.name for message in database.messages}
    shown = set()
    for name, identifier, text, resolution, end, cycle in rows:
        message = database.get_message_by_name(name)
        assert message.frame_id == int(identifier, 16)
        assert message.cycle_time == int(cycle)
        named = [s for s in message.signals if re.search(rf"\b{s.name.rstrip('123')}", text)]
        if "X to Z" in text:
            named = [s for s in message.signals if s.name[:-1] + "X" in text]
        assert named, text
        for signal in named:
            assert signal.scale == float(resolution), signal.name
            if end:
                assert abs(signal.maximum - float(end)) <= 0.006 * float(end), signal.name
            shown.add((name, signal.name))
    every = {
        (m.name, s.name) for m in database.messages for s in m.signals if s.name not in ("Counter", "Crc8")
    }
    assert shown == every


def test_every_message_of_the_dbc_states_its_source_or_that_it_is_assumed():
    database = cantools.database.load_file(data_folder("can") / "agrimaro.dbc")
    for message in database.messages:
        assert "assumed: " in message.comment
        assert "thesis" in message.comment or message.comment.startswith("assumed: ")
