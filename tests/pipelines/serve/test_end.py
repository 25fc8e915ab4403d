"""What is swapped, saved and ended while robots stream or begin: what should be kept is."""

import asyncio
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pipelines.live.session import Served
from pipelines.serve.hub import Hub
from pipelines.serve.messages import read_hello
from terrain.control.slip_table import load_slip_table

from .strangers import until

SERVE = "from pipelines.cli.main import main; main()"
N_ROBOTS = 8


@contextmanager
def process(model_folder, states):
    """``terrain serve`` in a process of its own; gives it, and its address."""
    command = [sys.executable, "-c", SERVE, "serve", "--model", str(model_folder), "--port", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    environment.pop("TERRAIN_TOKEN", None)
    pipe = subprocess.PIPE
    serving = subprocess.Popen(
        [*command, "--state", str(states)], stdout=pipe, stderr=pipe, text=True, env=environment
    )
    try:
        line = serving.stdout.readline()
        yield serving, "ws" + line[line.index("http") + 4 :].split()[0]
    finally:
        if serving.poll() is None:
            serving.kill()
        serving.wait(10)
        serving.stdout.close()
        serving.stderr.close()


def stream(url, k, hello, messages, run, ended):
    """Drive until the connection ends; keep the terrain and the last message."""
    found = ended[k] = {}
    with connect(url + "/robots", compression=None, max_size=None) as robot, suppress(ConnectionClosed):
        try:
            robot.send(json.dumps(hello(f"robot-{k}")))
            found["welcome"] = found["last"] = json.loads(robot.recv(10))
            n = 0
            while True:
                for message in messages(run, 10.0):
                    streams = {
                        name: [[stamp + 12.0 * n for stamp in stamps], rows]
                        for name, (stamps, rows) in message["streams"].items()
                    }
                    time_s = message["time_s"] + 12.0 * n
                    robot.send(json.dumps({**message, "streams": streams, "time_s": time_s}))
                    found["last"] = json.loads(robot.recv(10))
                    if found["last"]["type"] == "step":
                        found["terrain"] = found["last"]["observation"]["terrain"]
                    time.sleep(0.002)
                n += 1
        except ConnectionClosed as closed:
            found["closed"] = str(closed)
            while True:  # what had come before it was closed
                found["last"] = json.loads(robot.recv(10))


@contextmanager
def robots(url, hello, messages, two_drives):
    """Robots on two terrains, which stream until their connections end."""
    ended = {}
    threads = [
        threading.Thread(target=stream, args=(url, k, hello, messages, two_drives[3 * (k % 2)], ended))
        for k in range(N_ROBOTS)
    ]
    for thread in threads:
        thread.start()
    yield ended
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()


def know_their_terrain(ended):
    return len(ended) == N_ROBOTS and all(
        found.get("terrain") == "ab"[k % 2] for k, found in list(ended.items())
    )


@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGINT, signal.SIGKILL))],
)
@pytest.mark.slow
def test_a_service_that_is_ended_under_load_goes_on_after_a_restart(
    model_folder, hello, messages, two_drives, tmp_path, number
):
    with process(model_folder, tmp_path) as (serving, url), robots(url, hello, messages, two_drives) as ended:
        until(lambda: know_their_terrain(ended), 20.0)
        if number == signal.SIGKILL:
            until(
                lambda: (
                    sum('"terrain": "' in file.read_text() for file in tmp_path.glob("*.json")) >= N_ROBOTS
                    and all('"terrain": ""' not in file.read_text() for file in tmp_path.glob("*.json"))
                ),
                15.0,
            )
        serving.send_signal(number)
        code = serving.wait(10.0)
        assert code == (-signal.SIGKILL if number == signal.SIGKILL else 0)
        assert "Traceback" not in serving.stderr.read()
    if number != signal.SIGKILL:
        for found in ended.values():  # the message, or where a robot was writing then, the reason of the end
            assert found["last"].get("code") == "closing" or "the service ends" in found["closed"]
    assert {file.name for file in tmp_path.iterdir()} == {f"robot-{k}.json" for k in range(N_ROBOTS)}
    saved = {file.name: json.loads(file.read_text())["state"] for file in Path(tmp_path).iterdir()}
    assert all(saved[f"robot-{k}.json"]["terrain"] == "ab"[k % 2] for k in range(N_ROBOTS))
    ended_s = time.monotonic()
    with process(model_folder, tmp_path) as (serving, url):
        if time.monotonic() - ended_s > 8.0:
            pytest.skip("this machine was too slow: a terrain outlives its robot by ten seconds")
        for k in range(N_ROBOTS):
            with connect(url + "/robots") as robot:
                robot.send(json.dumps(hello(f"robot-{k}")))
                assert json.loads(robot.recv(10))["restored"]["terrain"] == "ab"[k % 2]


def test_a_full_disk_is_named_until_there_is_room_again(running, model_folder, hello, tmp_path, monkeypatch):
    def full(self, *arguments, **named):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def trouble(service):
        return json.loads(service.get("/ready")[1])["trouble"]

    monkeypatch.setattr("pipelines.serve.service.SAVE_EVERY_S", 0.05)
    with running(model=str(model_folder), state=tmp_path) as service, service.socket() as robot:
        robot.send(json.dumps(hello("full")))
        robot.recv(10)
        with monkeypatch.context() as patch:
            patch.setattr("terrain.files.atomic.os.fsync", full)
            until(lambda: "No space left on device" in trouble(service).get("states", ""))
            robot.send(json.dumps({"type": "samples", "streams": {}, "step": True}))
            assert json.loads(robot.recv(10))["type"] == "step"
            seen = [trouble(service).get("states", "") for _ in range(30)]
            assert all(seen), "the trouble is not gone while it is tried again"
        until(lambda: trouble(service) == {})
        assert [file.name for file in tmp_path.iterdir()] == ["full.json"]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_session_that_is_beginning_leaves_nothing_behind_or_gets_the_model_that_replaces(
    mower_model, hello, monkeypatch, tmp_path, leaves
):
    hub = Hub(Served(1, mower_model, "one", load_slip_table()), recordings=tmp_path)
    begun, go_on, begin = threading.Event(), threading.Event(), hub._begin

    def slowly(hello):
        begun.set()
        assert go_on.wait(20.0)
        return begin(hello)

    monkeypatch.setattr(hub, "_begin", slowly)

    async def replace():
        async with hub.changing:
            hub.swap(mower_model, "two", load_slip_table())

    async def changes():
        opening = asyncio.create_task(hub.open(read_hello(hello("new", record=True)), lambda *_: None))
        await asyncio.to_thread(begun.wait, 20.0)
        replacing = asyncio.create_task(replace())
        await asyncio.sleep(0.01)
        if leaves:
            opening.cancel()
        go_on.set()
        await asyncio.wait([opening, replacing])

    asyncio.run(changes())
    names = [opened.chain.served.model_name for opened in hub.sessions.values()]
    hub.stop()
    assert names == ([] if leaves else ["two"])
    assert list(tmp_path.iterdir()) == []
