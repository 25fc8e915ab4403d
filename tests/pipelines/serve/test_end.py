"""What is swapped, saved and ended while robots stream or begin: what should be kept is."""

import asyncio
import errno
import itertools
import json
import os
import signal
import threading
import time

import pytest
from studies.service import ServiceProcess

from pipelines.live.session import Hello
from pipelines.serve.client import ServiceError, TerrainClient
from pipelines.serve.hub import Hub
from pipelines.serve.serve import Settings
from terrain.control.slip_table import load_slip_table

from .strangers import CHANNELS, ask, hello, messages, running, until

N_ROBOTS = 4


def stream(url, k, run, terrains, reasons):
    """Drive until the connection ends; keep the terrain, and why it ended."""
    try:
        with TerrainClient(url, f"robot-{k}", "mower", CHANNELS, rate_hz=0) as robot:
            for begin_s in itertools.count(0.0, 12.0):
                for message in messages(run, 10.0):
                    streams = message["streams"].items()
                    later = {name: ([s + begin_s for s in stamps], rows) for name, (stamps, rows) in streams}
                    robot.send(later, step=True, time_s=message["time_s"] + begin_s)
                    terrains[k] = robot.step()["observation"]["terrain"]
                    time.sleep(0.002)
    except ServiceError as error:
        reasons[k] = str(error)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_service_that_is_ended_under_load_goes_on_after_a_restart(
    model_folder, two_drives, tmp_path, number
):
    terrains, reasons, expected = {}, {}, {k: "ab"[k % 2] for k in range(N_ROBOTS)}

    def saved():
        states = {path.stem: json.loads(path.read_text())["state"] for path in tmp_path.glob("*.json")}
        return {int(name.removeprefix("robot-")): state["terrain"] for name, state in states.items()}

    options = ["--model", str(model_folder), "--state", str(tmp_path)]
    with ServiceProcess(options) as serving, ServiceProcess(options) as again:
        threads = [
            threading.Thread(
                target=stream, args=(serving.socket_url, k, two_drives[3 * (k % 2)], terrains, reasons)
            )
            for k in range(N_ROBOTS)
        ]
        for thread in threads:
            thread.start()
        until(lambda: terrains == expected, 20.0)
        if number == signal.SIGKILL:
            until(lambda: saved() == expected, 15.0)
        serving.process.send_signal(number)
        code = serving.process.wait(10.0)
        assert code == (-signal.SIGKILL if number == signal.SIGKILL else 0)
        assert "Traceback" not in serving.process.stderr.read()
        for thread in threads:
            thread.join(20)
            assert not thread.is_alive()
        for k in range(N_ROBOTS):  # of another process, so that a slow start does not make the terrain old
            with TerrainClient(again.socket_url, f"robot-{k}", "mower", CHANNELS, rate_hz=0) as robot:
                assert robot.welcome["restored"]["terrain"] == expected[k]
    if number != signal.SIGKILL:
        assert all("the service ends" in reason for reason in reasons.values())
    assert saved() == expected


def test_a_full_disk_is_named_until_there_is_room_again(model_folder, tmp_path, monkeypatch):
    def full(self, *arguments, **named):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def trouble(service):
        return json.loads(service.get("/ready")[1])["trouble"]

    monkeypatch.setattr("pipelines.serve.service.SAVE_EVERY_S", 0.05)
    with running(model=str(model_folder), state=tmp_path) as service, service.socket() as robot:
        ask(robot, hello("full"))
        with monkeypatch.context() as patch:
            patch.setattr("terrain.files.atomic.os.fsync", full)
            until(lambda: "No space left on device" in trouble(service).get("states", ""))
            assert ask(robot, {"type": "samples", "streams": {}, "step": True})["type"] == "step"
            seen = [trouble(service).get("states", "") for _ in range(15)]
            assert all(seen), "the trouble is not gone while it is tried again"
        until(lambda: trouble(service) == {})
        # saved each 50 ms: a file that is being written is there at times, one that was given up never stays
        until(lambda: [file.name for file in tmp_path.iterdir()] == ["full.json"])


@pytest.mark.parametrize("leaves", [True, False])
def test_a_session_that_is_beginning_leaves_nothing_behind_or_gets_the_model_that_replaces(
    model_folder, mower_model, monkeypatch, tmp_path, leaves
):
    hub = Hub(Settings(model=str(model_folder), record=tmp_path))
    begun, go_on, begin = threading.Event(), threading.Event(), hub._begin

    def slowly(*request):
        begun.set()
        assert go_on.wait(20.0)
        return begin(*request)

    monkeypatch.setattr(hub, "_begin", slowly)

    async def replace():
        async with hub.changing:
            hub.swap(mower_model, "two", load_slip_table())

    async def changes():
        opening = asyncio.create_task(
            hub.open(Hello.model_validate(hello("new", record=True)), lambda *_: None)
        )
        await asyncio.to_thread(begun.wait, 20.0)
        replacing = asyncio.create_task(replace())
        await asyncio.sleep(0.01)
        if leaves:
            opening.cancel()
        go_on.set()
        await asyncio.wait([opening, replacing])

    asyncio.run(changes())
    names = [opened.served.model_name for opened in hub.sessions.values()]
    hub.stop()
    assert names == ([] if leaves else ["two"])
    assert list(tmp_path.iterdir()) == []
