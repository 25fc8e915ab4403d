"""What is wrong at the start is one sentence, and no robot ever waits for a service that cannot serve."""

import json
import os
import socket
import subprocess
import sys
import threading
from dataclasses import replace

import pytest

from pipelines.serve.serve import Settings, run
from pipelines.serve.service import prepare
from terrain.control.slip_table import load_slip_table, write_slip_table
from terrain.errors import TerrainError

CLI = "from pipelines.cli.main import main; main()"


@pytest.fixture
def refusal(model_folder, monkeypatch):
    """The sentence with which a start is refused."""
    monkeypatch.delenv("TERRAIN_TOKEN", raising=False)

    def of(**options):
        with pytest.raises(TerrainError) as refused:
            prepare(Settings(**{"model": str(model_folder), "port": 0, **options}))
        sentence = str(refused.value)
        assert "\n" not in sentence
        return sentence

    return of


@pytest.fixture
def copied(model_folder, tmp_path):
    """A copy of the model that may be damaged."""
    folder = tmp_path / "model"
    folder.mkdir()
    for file in model_folder.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def test_a_port_in_use_is_named(refusal):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert refusal(port=port) == (
            f"port {port} of 127.0.0.1 cannot be listened on (Address already in use)"
        )


@pytest.mark.parametrize(
    "host", ["no.such.host.invalid", "300.1.1.1", "1.2.3.4.5", "", "x" * 300, "a b", "\x00", "é" * 80]
)
def test_a_host_that_is_no_address_is_named(refusal, monkeypatch, host):
    monkeypatch.setenv("TERRAIN_TOKEN", "t" * 20)
    assert "--host" in refusal(host=host)


def test_an_address_of_another_machine_is_refused(refusal, monkeypatch):
    monkeypatch.setenv("TERRAIN_TOKEN", "t" * 20)
    assert "cannot be listened on" in refusal(host="192.0.2.1")


def test_other_machines_are_not_listened_to_without_a_token(refusal, monkeypatch, tmp_path):
    assert "a token is required (--token-file)" in refusal(host="0.0.0.0")
    monkeypatch.setenv("TERRAIN_TOKEN", "short")
    assert "the token has 5 characters, 16 to 512 are accepted" in refusal()
    empty = tmp_path / "empty"
    empty.write_text("\n")
    assert f"{empty}: holds no token" in refusal(token_file=empty)


def test_a_token_file_that_cannot_be_read_is_named(refusal, tmp_path):
    assert "No such file" in refusal(token_file=tmp_path / "none")
    assert "cannot be read" in refusal(token_file=tmp_path)
    binary = tmp_path / "binary"
    binary.write_bytes(bytes(range(128, 200)))
    assert "cannot be read (no text)" in refusal(token_file=binary)


def test_a_model_that_is_none_is_named(refusal, copied, tmp_path):
    assert "is neither a folder nor a model URI" in refusal(model=str(tmp_path / "none"))
    assert refusal(model="x" * 5000)
    assert refusal(model="\x00")
    card = next(file for file in copied.iterdir() if file.suffix == ".json")
    text = card.read_text()
    for damaged in ("", "{", "[]", "[" * 100_000, text[: len(text) // 2]):
        card.write_text(damaged)
        assert str(copied) in refusal(model=str(copied))
    card.unlink()
    assert str(copied) in refusal(model=str(copied))


def test_a_damaged_model_is_named(refusal, copied):
    (copied / "model.skops").write_bytes(b"PK\x03\x04 nothing else")
    assert "is damaged" in refusal(model=str(copied))
    (copied / "model.skops").unlink()
    assert str(copied) in refusal(model=str(copied))


def test_a_model_for_other_channels_or_another_robot_is_refused(refusal):
    assert "the model requires 'speed_left_mps'" in refusal(robot="agrimaro")
    assert "mower" in refusal(robot="husky")


def test_a_table_for_another_robot_is_refused(refusal, tmp_path):
    table = tmp_path / "table.yaml"
    write_slip_table(replace(load_slip_table(), robot="husky"), table)
    assert "is for robot 'husky', not for 'agrimaro'" in refusal(robot="agrimaro", table=table)
    assert str(tmp_path / "none.yaml") in refusal(table=tmp_path / "none.yaml")
    table.write_text("[" * 100_000)
    assert "nested deeper" in refusal(table=table)


def test_an_unknown_robot_is_named(refusal):
    assert "nowhere" in refusal(robot="nowhere")


def test_a_folder_that_cannot_be_written_is_named(refusal, tmp_path):
    (tmp_path / "file").write_text("")
    for option in ("state", "record"):
        assert "cannot be written" in refusal(**{option: tmp_path / "file" / "below"})
        assert "cannot be written" in refusal(**{option: tmp_path / "file"})


def test_after_a_refused_start_the_port_is_free(refusal, model_folder):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    refusal(port=port, robot="husky")
    found = run(Settings(model=str(model_folder), port=port, check=True))
    assert (found.classes, found.served) == (("a", "b"), None)
    assert found.report.answer.endswith("can be served: a and b.")


def test_after_a_start_that_fails_late_no_thread_is_left(refusal, monkeypatch, tmp_path):
    def fails(*_):
        raise TerrainError("the code does not run")

    monkeypatch.setattr("pipelines.serve.service.warm_up", fails)
    before = threading.active_count()
    assert refusal(record=tmp_path / "runs") == "the code does not run"
    assert threading.active_count() == before


def test_damaged_states_of_robots_do_not_keep_the_service_from_starting(
    running, model_folder, hello, tmp_path
):
    for name, content in {"bytes": b"\xff\x00", "half": b'{"version": 1', "deep": b"[" * 60_000}.items():
        (tmp_path / f"{name}.json").write_bytes(content)
    (tmp_path / "folder.json").mkdir()
    with running(model=str(model_folder), state=tmp_path) as service:
        for name in ("bytes", "half", "deep", "folder", "new"):
            with service.socket() as robot:
                robot.send(json.dumps(hello(name)))
                welcome = json.loads(robot.recv(10))
                assert (welcome["type"], welcome["restored"]) == ("welcome", None)
        trouble = json.loads(service.get("/ready")[1])["trouble"]
        assert {"state of bytes", "state of half", "state of deep", "state of folder"} <= set(trouble)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--port", "taken"], "cannot be listened on"),
        (["--port", "70000"], "65535"),
        (["--max-sessions", "nan"], "--max-sessions"),
    ],
)
def test_the_command_ends_with_one_sentence(model_folder, options, fault):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = [str(taken.getsockname()[1]) if one == "taken" else one for one in options]
        done = subprocess.run(
            [sys.executable, "-c", CLI, "serve", "--model", str(model_folder), *options],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={name: value for name, value in os.environ.items() if name != "TERRAIN_TOKEN"},
        )
    assert done.returncode == 2, done.stderr
    assert fault in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
