"""The mapping of the page is accepted, and the topics that it lists are those of an export."""

import re
from pathlib import Path

from pipelines.data.run_writers import messages_of_run
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.logs.topic_mapping import TYPES, load_mapping, short_type
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

PAGE = Path(__file__).resolve().parents[3] / "docs" / "bags.md"


def test_the_mapping_of_the_page_is_accepted_and_begins_with_the_packaged_one(tmp_path):
    (yaml,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "mapping.yaml").write_text(yaml)
    shown, packaged = load_mapping(tmp_path / "mapping.yaml"), load_mapping("husky_topics")
    assert {name: shown.streams[name] for name in packaged.streams} == packaged.streams
    assert shown.labels == "/terrain_name"


def test_topics_of_the_page_are_those_of_an_export():
    page = PAGE.read_text(encoding="utf-8")
    robot = load_robot("agrimaro")
    run = enriched(estimate_run(simulate_run(robot, "grass", "starts", 1, duration_s=8.0), robot, "vio15"))
    topics = {each.topic: each.kind for each in messages_of_run(run)}
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
    assert "slip_1_ratio" in run.streams["slip"].channels
    assert {"speed_x_mps"} <= set(run.streams["estimator"].channels)


def test_kinds_of_the_page_are_those_there_are():
    kinds = re.findall(r"^\| `(\w+)` \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert set(kinds) == set(TYPES)
