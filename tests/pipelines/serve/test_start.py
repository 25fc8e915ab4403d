"""What is wrong at the start is one sentence, and no robot ever waits for a service that cannot serve."""

import json
import socket
import threading

import pytest

from pipelines.serve.serve import Settings, run
from pipelines.serve.service import Service
from terrain.errors import TerrainError
from terrain.files.names import data_folder

from .strangers import ask, hello, running

TOKEN = "t" * 20
FOR_HUSKY = (data_folder("target_slip") / "default.yaml").read_bytes() + b"\nschema: 2\nrobot: husky\n"


@pytest.fixture
def refusal(model_folder, monkeypatch):
    """The sentence with which a start is refused."""
    monkeypatch.delenv("TERRAIN_TOKEN", raising=False)

    def of(**options):
        with pytest.raises(TerrainError) as refused:
            Service(Settings(**{"model": str(model_folder), "port": 0, **options}))
        sentence = str(refused.value)
        assert "\n" not in sentence
        return sentence

    return of


def written(path, content):
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("token", "options", "sentence"),
    [
        ("", {"model": None}, "--model is missing"),
        ("", {"host": "0.0.0.0"}, "a token is required (--token-file)"),
        ("short", {}, "the token has 5 characters, 16 to 512 are accepted"),
        ("", {"token_file": "none"}, "none: cannot be read (No such file or directory)"),
        ("", {"token_file": "."}, "cannot be read (Is a directory)"),
        ("", {"token_file": b"\n"}, "holds no token"),
        ("", {"token_file": bytes(range(128, 200))}, "cannot be read (no text)"),
        *((TOKEN, {"host": host}, "--host") for host in ("no.such.host.invalid", "300.1.1.1", "", "x" * 300, "\x00")),
        (TOKEN, {"host": "192.0.2.1"}, "cannot be listened on (Cannot assign requested address)"),
        ("", {"model": "none"}, "is neither a folder nor a model URI"),
        ("", {"model": "x" * 5000}, "cannot be opened"),
        ("", {"robot": "agrimaro"}, "the model requires 'speed_left_mps'"),
        ("", {"robot": "husky"}, "the model was trained on runs of mower, not of husky"),
        ("", {"robot": "nowhere"}, "nowhere"),
        ("", {"table": "none.yaml"}, "none.yaml"),
        ("", {"table": b"[" * 100_000}, "nested deeper"),
        ("", {"robot": "agrimaro", "table": FOR_HUSKY}, "is for robot 'husky', not for 'agrimaro'"),
        ("", {"state": "file/below"}, "cannot be written"),
        ("", {"record": "file"}, "cannot be written"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(refusal, monkeypatch, tmp_path, token, options, sentence):
    monkeypatch.setenv("TERRAIN_TOKEN", token)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    given = {
        name: written(tmp_path / "given", value) if isinstance(value, bytes) else value
        for name, value in options.items()
    }
    assert sentence in refusal(**given)


def test_after_a_refused_start_the_port_is_free_and_no_thread_is_left(
    refusal, model_folder, monkeypatch, tmp_path
):
    def fails(*_):
        raise TerrainError("the code does not run")

    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
        assert refusal(port=port) == (
            f"port {port} of 127.0.0.1 cannot be listened on (Address already in use)"
        )
    before = threading.active_count()
    with monkeypatch.context() as patch:
        patch.setattr("pipelines.serve.hub.warm_up", fails)
        assert refusal(port=port, record=tmp_path / "runs") == "the code does not run"
    assert threading.active_count() == before
    found = run(Settings(model=str(model_folder), port=port, check=True))
    assert (found.classes, found.served) == (("a", "b"), None)
    assert found.report.answer.endswith("can be served: a and b.")


def test_without_a_model_a_robot_is_given_commands_and_an_observer_refused():
    found = run(Settings(robot="husky", port=0, check=True)).report
    assert found.answer == "husky can be given commands; without a model its terrain is unknown."
    assert found.next_step == "terrain serve --robot husky"
    channels = {"wheels": ["speed_left_mps", "speed_right_mps"], "imu": ["gyro_z_radps"]}
    with running(robot="husky") as service, service.socket() as robot:
        about = {"robot": "husky", "streams": channels}
        assert "only a robot that asks for commands" in ask(robot, hello("seen", **about))["message"]
        assert ask(robot, hello("driven", **about, control=True))["type"] == "welcome"
        streams = {"wheels": [[0.0], [[0.0, 0.0]]], "imu": [[0.0], [[0.0]]]}
        sent = {"type": "samples", "streams": streams, "twist": [0.5, 0.0, 0.0], "step": True, "time_s": 0.0}
        step = ask(robot, sent)
        assert (step["command"]["status"], step["observation"]["terrain"]) == ("ok", None)
        assert step["command"]["twist"][0] > 0.0


def test_damaged_states_of_robots_do_not_keep_the_service_from_starting(model_folder, tmp_path):
    damaged = {"bytes": b"\xff\x00", "half": b'{"version": 1', "deep": b"[" * 60_000}
    for name, content in damaged.items():
        (tmp_path / f"{name}.json").write_bytes(content)
    (tmp_path / "folder.json").mkdir()
    with running(model=str(model_folder), state=tmp_path) as service:
        for name in (*damaged, "folder", "new"):
            with service.socket() as robot:
                welcome = ask(robot, hello(name))
                assert (welcome["type"], welcome["restored"]) == ("welcome", None)
        trouble = json.loads(service.get("/ready")[1])["trouble"]
        assert {f"state of {name}" for name in (*damaged, "folder")} <= set(trouble)
