"""A service that listens, on a small model, and robots to talk to it."""

import json
import threading
from contextlib import contextmanager

import httpx
import pytest
from websockets.sync.client import connect

from pipelines.learn.model_file import write_model
from pipelines.serve.hub import LIMITS
from pipelines.serve.serve import Settings
from pipelines.serve.service import Service
from terrain.control.slip_table import load_slip_table
from terrain.logs.replay import replay

from .strangers import CHANNELS


@pytest.fixture(scope="session")
def model_folder(mower_model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    write_model(folder, mower_model)
    return folder


class Running:
    """A service in this process, its address, and its hub."""

    def __init__(self, service):
        self.hub, self.http = service.hub, service.url
        self.ws = service.url.replace("http", "ws")

    def socket(self, place="/robots", **options):
        return connect(self.ws + place, compression=None, max_size=None, open_timeout=30, **options)

    def get(self, place, method="GET", **options):
        """Status and text of an answer."""
        answer = httpx.request(method, self.http + place, timeout=30, **options)
        return answer.status_code, answer.text

    def put(self, place, content, kind="application/json"):
        body = content if isinstance(content, str) else json.dumps(content)
        return self.get(place, "PUT", content=body, headers={"Content-Type": kind})


@contextmanager
def _running(limits=None, **options):
    service, ready = Service(Settings(**{"port": 0, **options})), threading.Event()
    if limits is not None:
        service.hub.limits = limits
    thread = threading.Thread(target=service.run, args=(lambda url: ready.set(),))
    thread.start()
    try:
        assert ready.wait(60.0)
        yield Running(service)
    finally:
        service.stop()
        thread.join(30.0)
        assert not thread.is_alive()


@pytest.fixture(scope="session")
def running():
    """What runs a service with settings until a block ends."""
    return _running


@pytest.fixture(scope="module")
def service(running, model_folder):
    """A service that several tests of a file use; each has sessions of its own name."""
    with running(model=str(model_folder)) as found:
        yield found


@pytest.fixture(scope="module")
def driving(running, model_folder):
    """A service without a model, which gives commands to robots of any channels."""
    limits = LIMITS._replace(hello_s=1.0, too_slow_s=0.6)
    with running(limits, model=str(model_folder)) as found:
        found.hub.swap(None, "", load_slip_table())
        yield found


@pytest.fixture(scope="session")
def hello():
    def message(session, **changed):
        first = {"type": "hello", "session": session, "robot": "mower", "streams": CHANNELS, "rate_hz": 0}
        return {**first, **changed}

    return message


@pytest.fixture(scope="session")
def messages():
    """The messages of a run, each asking for a step."""

    def of(run, rate_hz=50.0):
        for sample in replay(run, rate_hz):
            streams = {
                name: [reading.time_s.tolist(), reading.values.tolist()]
                for name, reading in sample.readings.items()
            }
            yield {"type": "samples", "streams": streams, "step": True, "time_s": sample.time_s}

    return of
