"""Sessions that begin while something else happens."""

import asyncio
import threading

import pytest

from pipelines.live.session import Served
from pipelines.serve.hub import Hub
from pipelines.serve.messages import read_hello
from pipelines.serve.wire import WireError
from terrain.control.slip_table import load_slip_table
from terrain.errors import DataError


@pytest.fixture
def slow_hub(mower_model, monkeypatch, tmp_path):
    """A hub whose sessions take until an event to begin, those that do, and the event."""
    hub = Hub(Served(1, mower_model, "one", load_slip_table()), recordings=tmp_path)
    begun, go_on = [], threading.Event()
    begin = hub._begin

    def slowly(hello):
        found = begin(hello)
        begun.append(found[0])
        assert go_on.wait(20.0)
        return found

    monkeypatch.setattr(hub, "_begin", slowly)
    yield hub, begun, go_on
    hub.stop()


async def until(holds):
    async with asyncio.timeout(20.0):
        while not holds():
            await asyncio.sleep(0.01)


def test_a_connection_that_is_gone_before_its_session_began_leaves_no_recording_behind(slow_hub, hello):
    hub, begun, go_on = slow_hub

    async def leaves_early():
        opening = asyncio.create_task(hub.open(read_hello(hello("gone", record=True)), lambda *_: None))
        await until(lambda: begun)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        go_on.set()
        await until(lambda: begun and begun[0].recording.startswith("finished"))

    asyncio.run(leaves_early())
    assert (hub.sessions, hub._opening) == ({}, set())


@pytest.mark.parametrize("suits", [True, False])
def test_a_session_that_begins_while_the_model_is_replaced_gets_the_new_one(
    slow_hub, hello, mower_model, monkeypatch, suits
):
    hub, begun, go_on = slow_hub

    def refuses(*_):
        raise DataError("the model does not suit")

    if not suits:
        monkeypatch.setattr("pipelines.live.session.RobotSession.swap", refuses)

    async def swapped():
        opening = asyncio.create_task(hub.open(read_hello(hello("late")), lambda *_: None))
        await until(lambda: begun)
        hub.swap(mower_model, "two", load_slip_table())
        go_on.set()
        return await opening

    if suits:
        assert asyncio.run(swapped()).chain.served.model_name == "two"
        assert list(hub.sessions) == ["late"]
    else:
        with pytest.raises(WireError, match="does not suit"):
            asyncio.run(swapped())
        assert hub.sessions == {}
