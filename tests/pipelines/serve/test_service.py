"""Robots talk to a real service over loopback: what comes back is what the live chain says of each."""

import json
import math
import time
from functools import partial

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed

from pipelines.data.bag_runs import recorded_windows
from pipelines.data.datasets import load_runs
from pipelines.live.observer import Observer
from pipelines.serve.client import ServiceError, TerrainClient
from terrain.control.slip_table import load_slip_table
from terrain.files.names import data_folder
from terrain.logs.replay import replay

from .strangers import CHANNELS, ask, hello, messages, running, until

TABLE = (data_folder("target_slip") / "default.yaml").read_text()


def test_a_robot_gets_the_terrain_and_target_slips_of_its_samples(service, two_drives, mower_model):
    """In MessagePack; JSON is what the other tests speak."""
    run, observer = two_drives[4], Observer(mower_model)
    found = [one for sample in replay(run) for one in observer.update(sample.readings)]
    seen = []
    with service.socket() as socket:
        say = partial(ask, socket, packed=True)
        welcome = say(hello("alone"))
        assert (welcome["type"], welcome["served"]["classes"]) == ("welcome", ["a", "b"])

        def is_classified(start_s):
            seen.append(say({"type": "samples", "streams": {}, "step": True})["observation"])
            return seen[-1]["window"] and seen[-1]["window"]["start_s"] == start_s

        due = iter(found)
        for message in messages(run):
            answer = say(message)
            assert (answer["type"], answer["time_s"]) == ("step", message["time_s"])
            seen.append(answer["observation"])
            if (
                message["time_s"] > 0.0 and round(message["time_s"], 6) % 2.0 == 0.0
            ):  # thread and log go on together
                until(partial(is_classified, next(due).start_s))
        until(partial(is_classified, found[-1].start_s))
    windows = {one["window"]["start_s"]: one["window"] for one in seen if one["window"]}
    assert list(windows) == [one.start_s for one in found]
    for one in found:
        assert windows[one.start_s]["terrain"] == one.terrain
        assert windows[one.start_s]["probabilities"] == pytest.approx(one.probabilities, abs=1e-12)
    target = load_slip_table().lookup("b")["traction"].slip_ratio
    assert (seen[-1]["terrain"], seen[-1]["slip_ratio"]) == ("b", [])
    assert seen[-1]["target_slip"]["traction"]["slip_ratio"] == target


def test_steps_come_at_the_rate_that_was_asked_for(service):
    with TerrainClient(service.ws, "ticking", "mower", CHANNELS, rate_hz=50.0) as client:
        begun_s, n_sent = time.monotonic(), 0
        while time.monotonic() - begun_s < 0.6:
            client.send({"imu": ([n_sent / 100], [[0.1]]), "wheels": ([n_sent / 100], [[0.5]])})
            n_sent += 1
            time.sleep(0.01)
        step = client.latest()
        assert step["message"] >= n_sent - 20
        assert 15 <= client.n_steps <= 31
        assert step["observation"]["sensors"] == {"imu": "fresh", "wheels": "fresh"}
        assert "command" not in step
        assert list(client.errors) == []
    assert client.latest(0.0) is None


def test_a_step_is_at_the_robots_time_or_where_it_has_none_at_its_clocks(service):
    with service.socket() as socket:
        assert ask(socket, hello("at"))["type"] == "welcome"
        content = {"type": "samples", "streams": {"imu": [[5.0], [[0.1]]]}, "step": True}
        assert [ask(socket, content | {"time_s": given})["time_s"] for given in (7, 7.5)] == [7.0, 7.5]
        before_s = 5.0
        for given in ("x", None, 10**400):  # its clock goes on where its stamps do not
            time.sleep(0.05)
            before_s, earlier_s = ask(socket, content | {"time_s": given})["time_s"], before_s
            assert earlier_s < before_s < 10.0


def test_the_client_waits_for_steps_and_says_what_went_wrong(service):
    with TerrainClient(service.ws, "waiting", "mower", CHANNELS, rate_hz=0.0) as client:
        with pytest.raises(ServiceError, match="no step in time"):
            client.step(0.1)
        client.send({"imu": ([0.0], [[0.1]])}, step=True, time_s=5.0)
        assert client.step()["time_s"] == 5.0
        client.send({"imu": ([10.0], [[0.1]])}, step=True, time_s=10.0)
        until(lambda: client.latest(60.0))
        client.send({"imu": ([70.5], [[0.1]])})
        assert client.latest(60.0) is None, "a step of old samples is no latest step"
        client.send({"imu": ([3.0, math.nan], [[0.1], [0.1]])})  # the clock was set back
        assert client.latest(60.0)["time_s"] == 10.0
        with pytest.raises(ServiceError, match="'waiting' is open already"):
            TerrainClient(service.ws, "waiting", "mower", CHANNELS)
    with pytest.raises(ServiceError, match="the connection has ended"):
        client.send({}, step=True)
    with pytest.raises(ServiceError, match="cannot be reached"):
        TerrainClient("ws://127.0.0.1:1", "x", "mower", CHANNELS)
    with pytest.raises(ServiceError, match="neither measured nor estimated"):
        TerrainClient(service.ws, "x", "mower", {"imu": ["gyro_z_radps"]})


def test_health_card_and_figures_in_the_form_of_prometheus(service, two_drives):
    def figures():
        families = text_string_to_metric_families(service.get("/metrics")[1])
        return {
            sample.name: sample.value for family in families for sample in family.samples if not sample.labels
        }

    before = figures()
    with service.socket() as socket:
        say = partial(ask, socket, packed=True)
        say(hello("counted"))
        for message in list(messages(two_drives[0]))[:100]:
            say(message)
        during = figures()
        assert "counted" in [one["session"] for one in json.loads(service.get("/sessions")[1])]
        assert json.loads(service.get("/state?session=counted")[1])["session"]["step"]["number"] == 100
    expected = {
        "opened_sessions_total": 1,
        "messages_total": 100,
        "rows_total": 200,
        "step_seconds_count": 100,
    }
    assert {name: during[f"terrain_{name}"] - before[f"terrain_{name}"] for name in expected} == expected
    assert 1e7 < during["process_resident_memory_bytes"] < 1e10
    assert json.loads(service.get("/health")[1])["status"] == "ok"
    status, text = service.get("/ready")
    assert (status, json.loads(text)["ready"]) == (200, True)
    card = json.loads(service.get("/model")[1])
    assert (card["card"]["classes"], card["served"]["number"]) == (["a", "b"], 1)
    assert service.get("/nothing")[0] == 404


def test_another_model_is_put_in_while_a_robot_is_served_and_no_window_is_lost(model_folder, two_drives):
    with running(model=str(model_folder)) as service, service.socket() as socket:
        ask(socket, hello("swapped"))
        starts, numbers = set(), []
        for k, message in enumerate(messages(two_drives[4])):
            if k == 150:
                put = service.put("/model", {"uri": str(model_folder)})
            if k == 320:
                put = service.put("/table", TABLE.replace("0.1", "0.11"))
            seen = ask(socket, message)["observation"]
            time.sleep(0.0005)
            numbers.append(seen["served"])
            starts |= {seen["window"]["start_s"]} if seen["window"] else set()
    assert (put[0], json.loads(put[1])["number"]) == (200, 3)
    assert numbers == [1] * 150 + [2] * 170 + [3] * (len(numbers) - 320)
    assert sorted(starts) == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0][: len(starts)]
    assert len(starts) >= 5


@pytest.mark.parametrize(
    ("place", "content", "status", "fault"),
    [
        ("/model", {"uri": "/nowhere"}, 409, "is neither a folder nor a model URI"),
        ("/model", "damaged", 409, "model"),
        ("/model", {"url": "x"}, 422, "uri"),
        ("/model", "[" * 100_000, 400, "error parsing"),
        ("/table", "name: [", 409, "the table: is no YAML"),
        ("/table", "name: x", 409, "the table"),
        *((place, "x" * 300_000, 413, "Too Large") for place in ("/table", "/model")),
    ],
)
def test_what_cannot_be_served_is_refused_and_the_old_goes_on(
    service, model_folder, tmp_path, place, content, status, fault
):
    if content == "damaged":
        for file in model_folder.iterdir():
            (tmp_path / file.name).write_bytes(file.read_bytes()[:-100])
        content = {"uri": str(tmp_path)}
    number = service.hub.served.number
    found, text = service.put(place, content)
    assert found == status, text
    assert fault in text
    assert "Traceback" not in text
    assert service.hub.served.number == number


def test_a_session_that_is_silent_is_taken_by_its_robot_that_comes_back(service, monkeypatch):
    monkeypatch.setattr("pipelines.serve.hub.SILENT_S", 0.3)
    with service.socket() as first, service.socket() as second:
        assert ask(first, hello("back"))["type"] == "welcome"
        assert ask(second, hello("back"))["code"] == "name-taken"
        time.sleep(0.4)
        assert ask(second, hello("back"))["type"] == "welcome"
        last = json.loads(first.recv(10))
        assert (last["code"], last["fatal"]) == ("name-taken", True)
        with pytest.raises(ConnectionClosed):
            first.recv(10)


def test_a_robot_that_comes_back_knows_its_terrain(service, two_drives):
    with service.socket() as socket:
        assert ask(socket, hello("returning"))["restored"] is None
        for message in messages(two_drives[4]):
            ask(socket, message)
            time.sleep(0.0005)
    until(lambda: "returning" not in service.hub.sessions)
    with service.socket() as socket:
        assert ask(socket, hello("returning"))["restored"]["terrain"] == "b"
        first = ask(socket, {"type": "samples", "streams": {}, "step": True})
        assert first["observation"]["terrain"] == "b"


def test_a_session_that_asks_for_it_becomes_a_run_with_its_windows(model_folder, two_drives, tmp_path):
    run = two_drives[4]
    with running(model=str(model_folder), record=tmp_path) as service:
        with service.socket() as socket:
            assert ask(socket, hello("kept", record=True))["recording"] == "recording"
            for message in messages(run):
                last = ask(socket, message)["observation"]["window"]
        with service.socket() as socket:
            assert ask(socket, hello("not kept"))["recording"] == "off"
    (recorded,) = load_runs(tmp_path)
    assert recorded.run_id.startswith("kept_")
    np.testing.assert_array_equal(recorded.streams["imu"].values, run.streams["imu"].values)
    _, windows = recorded_windows(tmp_path / f"{recorded.run_id}.mcap")
    (same,) = [window for window in windows if window.start_s == last["start_s"]]
    assert (same.terrain, same.probabilities) == (last["terrain"], last["probabilities"])
