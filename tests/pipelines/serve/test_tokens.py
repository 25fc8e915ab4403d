"""Where a token is required, nothing is done before it has fitted: of a WebSocket, a page, a request."""

import json
import time

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

TOKEN = "a token of sixteen letters and more"
WRONG = TOKEN[:-1] + "x"


@pytest.fixture(scope="module")
def guarded(running, model_folder, tmp_path_factory):
    file = tmp_path_factory.mktemp("token") / "token"
    file.write_text(TOKEN + "\n")
    file.chmod(0o600)
    with running(model=str(model_folder), token_file=file) as service:
        yield service


def answer_to(socket, *messages):
    for message in messages:
        socket.send(message)
    return json.loads(socket.recv(30.0))


def test_a_robot_with_the_token_is_welcome_by_its_first_frame_and_by_its_header(guarded, hello):
    with guarded.socket() as socket:
        assert answer_to(socket, TOKEN, json.dumps(hello("first")))["type"] == "welcome"
    with guarded.socket(additional_headers={"Authorization": f"Bearer {TOKEN}"}) as socket:
        assert answer_to(socket, json.dumps(hello("second")))["type"] == "welcome"


@pytest.mark.parametrize("place", ["/robots", "/watch"])
@pytest.mark.parametrize("first", [WRONG, "", "{" * 1000, TOKEN + TOKEN])
def test_a_wrong_first_frame_ends_the_connection_before_anything_is_decoded(guarded, place, first):
    begun_s = time.monotonic()
    with guarded.socket(place) as socket:
        answer = answer_to(socket, first)
        assert (answer["type"], answer["code"], answer["fatal"]) == ("error", "token", True)
        assert time.monotonic() - begun_s > 0.2  # whoever tries tokens waits
        with pytest.raises(ConnectionClosed):
            socket.recv(30.0)


def test_a_wrong_token_in_the_header_is_refused_at_the_handshake(guarded):
    headers = {"Authorization": f"Bearer {WRONG}"}
    with pytest.raises(InvalidStatus, match="401"), guarded.socket(additional_headers=headers):
        pass


@pytest.mark.parametrize(("method", "place"), [("GET", "/metrics"), ("GET", "/sessions"), ("PUT", "/model")])
def test_a_request_needs_the_token_and_wrong_ones_are_counted(guarded, method, place):
    for given in (WRONG, ""):
        headers = {"Authorization": f"Bearer {given}"} if given else {}
        status, text = guarded.get(place, method, b"{}" if method == "PUT" else None, headers)
        assert (status, "a token is required" in text) == (401, True)
    _, text = guarded.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"})
    (count,) = [
        line.split()[1] for line in text.splitlines() if line.startswith("terrain_wrong_tokens_total ")
    ]
    assert float(count) >= 2.0
