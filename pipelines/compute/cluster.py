"""The one module that imports dask: tasks on the workers of a scheduler.

The client is used itself, not joblib's backend for Dask: that one gives no result before all are there, loses
arrays with the worker that they were sent to, and waits forever where the scheduler is lost.
"""

from __future__ import annotations

import logging
import pickle
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from socket import create_connection
from threading import Event
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from pipelines.compute.software import difference, software
from terrain.errors import ConfigError, TerrainError

CONNECT_S = 10.0
"""To reach the scheduler: a local network answers in milliseconds."""

FIRST_WORKER_S = 20.0
"""Until the first worker is there: one that was just started imports for some seconds."""

POLL_S = 0.5
"""From one look at a result that is not there to the next; a loss is noticed after it."""

PING_EVERY_S, ANSWER_S = 5.0, 15.0
"""From question to question to the scheduler, and how long it may take to answer, as one at work does."""

NO_WORKER_S = 60.0
"""Without a worker that takes tasks: a worker whose nanny starts it again is back in 10 s."""

TASKS_A_THREAD = 3
"""In progress at once for each thread of a worker: one is computed, the next are there when it ends."""

LOGGERS = ("distributed", "tornado", "asyncio")


class Cluster:
    """The workers of a scheduler, as :func:`pipelines.compute.parallel.parallel` uses them.

    Parameters
    ----------
    client : connected
    address : of the scheduler
    """

    def __init__(self, client: Any, address: str) -> None:
        self._client = client
        self.address = address
        self._answered_s = self._able_s = monotonic()

    def results(
        self, function: Callable[..., Any], shared: Sequence[Any], each: Iterable[Sequence[Any]]
    ) -> Iterator[Any]:
        """Yield the result of each task in order; a task whose worker is lost is computed by another one.

        ``shared`` travels as the result of a task of its own, so that it is sent to a worker once and, where
        all workers that have it are lost, made again from what the scheduler holds.
        """
        client, tasks = self._client, iter(each)
        waiting: deque[Any] = deque()
        with _failures(self.address):
            given = client.submit(pickle.loads, _pickled(tuple(shared)), pure=False)

            def add(number: int) -> None:
                for one in islice(tasks, number):
                    packed = _pickled((function, tuple(one)))
                    waiting.append(client.submit(_compute, given, packed, pure=False))

            try:
                n_threads = max(sum(self._workers().values()), 1)
                add(TASKS_A_THREAD * n_threads)
                while waiting:
                    result = self._result(waiting[0])
                    waiting.popleft()
                    add(1)
                    yield result
            finally:
                for future in waiting:
                    future.release()

    def check_software(self) -> None:
        """Raise ``TerrainError`` where a worker computes with other software than this process."""
        here = software()
        answers = self._client.run(software, on_error="return")
        for worker, there in sorted(answers.items()):
            if not isinstance(there, Mapping):
                raise TerrainError(
                    f"worker {worker} of {self.address} cannot import this package "
                    f"({' '.join(str(there).split())[:120]}): install the same version on it"
                )
            if (found := difference(here, dict(there))) is not None:
                raise TerrainError(
                    f"worker {worker} of {self.address} has {found}: install the same version on it"
                )

    def _result(self, future: Any) -> Any:
        """Return what a task gave; where it was lost with its worker, what another worker makes of it.

        A worker that is killed is asked for its results until its connection is given up, which takes longer
        than the scheduler needs for an answer: only a scheduler without an answer ends the wait.
        """
        end_s = monotonic() + NO_WORKER_S
        while True:
            self._await(future)
            try:
                return future.result(timeout=ANSWER_S)
            except TimeoutError:
                if future.status == "error" or monotonic() > end_s:  # the task's own, or never fetched
                    raise
                self._workers()

    def _await(self, future: Any) -> None:
        """Wait for a task while its scheduler answers and a worker takes tasks."""
        ended = Event()
        future.add_done_callback(lambda _: ended.set())
        self._able_s = monotonic()
        while not (future.done() or ended.wait(POLL_S)):
            if self._client.status != "running":
                raise ConnectionError("the connection was lost")
            if monotonic() - self._answered_s > PING_EVERY_S:
                if self._workers():
                    self._able_s = monotonic()
                elif monotonic() - self._able_s > NO_WORKER_S:
                    raise TerrainError(
                        f"no worker of {self.address} has taken a task for {NO_WORKER_S:.0f} s: they ended, "
                        "or are out of memory"
                    )

    def _workers(self) -> dict[str, int]:
        """Return the threads of each worker that takes tasks, as the scheduler answers now."""
        identity = self._client.sync(self._client.scheduler.identity, callback_timeout=ANSWER_S)
        self._answered_s = monotonic()
        return {
            name: int(worker["nthreads"])
            for name, worker in identity["workers"].items()
            if worker.get("status", "running") == "running"
        }


def _pickled(value: Any) -> bytes:
    """Return the bytes of a value; dask would look into its tuples for tasks, and make lists of some.

    As on this machine's cores, read-only mappings and local functions are packed as well.
    """
    import cloudpickle

    packed: bytes = cloudpickle.dumps(value)
    return packed


def _compute(shared: tuple[Any, ...], packed: bytes) -> Any:
    function, one = pickle.loads(packed)
    return function(*shared, *one)


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Give the workers of a scheduler, all of which have the software of this process.

    Parameters
    ----------
    address : as ``tcp://127.0.0.1:8786``

    Raises
    ------
    ConfigError
        if dask is not installed.
    TerrainError
        if the scheduler is not reached, has no worker, or a worker has other software.
    """
    if find_spec("distributed") is None:
        raise ConfigError("--compute dask:... needs the package distributed: install terrain-slip[cluster]")
    with _quiet():
        client = _client(address)
        try:
            try:
                client.wait_for_workers(1, timeout=FIRST_WORKER_S)
            except TimeoutError as error:
                raise TerrainError(
                    f"the Dask scheduler at {address} has no worker: start one with 'dask worker {address}'"
                ) from error
            cluster = Cluster(client, address)
            with _failures(address):
                cluster.check_software()
            yield cluster
        finally:
            client.close(timeout=POLL_S)


def _client(address: str) -> Any:
    """Return a client; a port is tried first, as a client without a scheduler leaves its thread behind."""
    from distributed import Client

    place = urlsplit(address)
    try:
        create_connection((str(place.hostname), int(place.port or 0)), timeout=CONNECT_S).close()
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise TerrainError(
            f"no Dask scheduler answers at {address}: start one there with 'dask scheduler', "
            "and workers with 'dask worker'"
        ) from error


@contextmanager
def _failures(address: str) -> Iterator[None]:
    """Turn what dask raises of its own into one sentence each; what a task raises stays as it is."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    try:
        yield
    except KilledWorker as error:
        raise TerrainError(
            f"a task ended {error.allowed_failures + 1} workers of {address} one after another: they "
            "were killed or ran out of memory; give each more of it, or fewer threads"
        ) from error
    except (CancelledError, CommClosedError, ConnectionError, TimeoutError) as error:
        raise TerrainError(
            f"the Dask scheduler at {address} does not answer any more; what was computed is lost"
        ) from error
    except MemoryError as error:
        raise TerrainError(f"a worker of {address} has too little memory for its task") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what dask and tornado log and warn of off the screen: what matters becomes an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import distributed.client  # noqa: F401 - its loggers get levels of their own when they are made

        names = [name for name in logging.root.manager.loggerDict if name.startswith(LOGGERS)]
        loggers = [logging.getLogger(name) for name in names]
        levels = [logger.level for logger in loggers]
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
