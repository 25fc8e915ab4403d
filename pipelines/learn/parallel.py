"""Independent tasks, computed side by side, with their results in order.

``with computing("dask:tcp://127.0.0.1:8786"):`` states where; :func:`parallel` asks for it, so that what
computes need not know.  On this machine there is one pool of processes (joblib), which is used again, and
whose processes end with the one that started them, however that ends.  On a cluster, ``dask.distributed``
computes a task again whose worker is lost.
"""

from __future__ import annotations

import gc
import logging
import os
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from importlib.util import find_spec
from itertools import islice, starmap
from socket import create_connection
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from pipelines.report.results import Progress, silent
from pipelines.report.settings import Settings, setting
from pipelines.report.versions import difference, software
from terrain.errors import ConfigError, TerrainError

LOCAL = "local"

PARENT_POLL_S = 0.5  #: From one look at the process that started a pool to the next
CONNECT_S = 10.0  #: To reach the scheduler, and to reach it again: a local network answers in milliseconds
FIRST_WORKER_S = 20.0  #: Until the first worker is there: one that was just started imports for some seconds

ANSWER_S = 15.0
"""From one look at a result that is not there to the next, and how long the scheduler may take to answer."""

NO_WORKER_S = 60.0  #: Without a worker: one whose nanny starts it again is back in 10 s

TASKS_A_THREAD = 3
"""In progress at once for each thread of a worker: one is computed, the next are there when it ends."""


def scheduler_address(compute: str) -> str | None:
    """Return the address of the scheduler that ``compute`` names; None for this machine's cores.

    Parameters
    ----------
    compute : ``local``, or ``dask:HOST:PORT`` with or without ``tcp://`` or ``tls://`` before the host

    Raises
    ------
    ConfigError
        if it is none of these.

    Examples
    --------
    >>> scheduler_address("dask:127.0.0.1:8786"), scheduler_address("local")
    ('tcp://127.0.0.1:8786', None)
    """
    if compute == LOCAL:
        return None
    kind, _, place = compute.partition(":")
    with suppress(ValueError):  # of a port that is no port
        where = urlsplit(place if "://" in place else f"tcp://{place}")
        is_scheduler = where.scheme in ("tcp", "tls") and where.hostname and where.port and not where.path
        if kind == "dask" and is_scheduler:
            return where.geturl()
    raise ConfigError(
        f"--compute is {compute!r}: 'local' or the address of a Dask scheduler is accepted, "
        "as dask:tcp://127.0.0.1:8786"
    )


class ComputeSettings(Settings):
    """Where a command computes what can be computed side by side."""

    compute: str = setting(LOCAL, "local, or dask:HOST:PORT: the workers of a Dask scheduler.")


def _in_cluster(
    client: Any, function: Callable[..., Any], shared: Sequence[Any], each: Iterable[Sequence[Any]]
) -> Iterator[Any]:
    """Yield the result of each task in order.

    ``shared`` travels as the result of a task of its own, so that it is sent to a worker once and, where
    all workers that have it are lost, made again from what the scheduler holds.  Arguments are bound to
    the functions: dask would look into tuples for tasks, and make lists of some.
    """
    waiting: deque[Any] = deque()
    with _failures(client):
        given = client.submit(partial(partial, function, *shared), pure=False)
        tasks = (client.submit(partial(_call, *one), given, pure=False) for one in each)
        try:
            waiting.extend(islice(tasks, TASKS_A_THREAD * max(_n_threads(client), 1)))
            while waiting:
                yield _result(client, waiting[0])
                waiting.popleft()
                waiting.extend(islice(tasks, 1))
        finally:
            for future in waiting:
                future.release()


def _result(client: Any, future: Any) -> Any:
    """Return a result; a scheduler that does not answer, or has no worker for long, ends the wait."""
    with_worker_s = monotonic()
    while True:
        try:
            return future.result(timeout=ANSWER_S)
        except TimeoutError:
            if future.status == "error":  # the task's own
                raise
            if _n_threads(client):
                with_worker_s = monotonic()
            elif monotonic() - with_worker_s > NO_WORKER_S:
                raise TerrainError(
                    f"no worker of {client.scheduler.address} has taken a task for {NO_WORKER_S:.0f} s: they "
                    "ended, or are out of memory"
                ) from None


def _n_threads(client: Any) -> int:
    """Return the threads of all workers, as the scheduler answers now."""
    found = client.sync(client.scheduler.identity, callback_timeout=ANSWER_S)
    return sum(int(worker["nthreads"]) for worker in found["workers"].values())


def _call(*one_and_function: Any) -> Any:
    *one, function = one_and_function
    return function(*one)


_client: ContextVar[Any] = ContextVar("client", default=None)


@contextmanager
def computing(compute: str) -> Iterator[str]:
    """State where the tasks of a block are computed: ``local`` or the address of a scheduler is given.

    What dask and tornado log and warn of stays off the screen: what matters becomes an error here.  The port is
    tried first, as a client without a scheduler leaves its thread behind.

    Parameters
    ----------
    compute : ``local`` or ``dask:ADDRESS``, as :func:`scheduler_address`

    Raises
    ------
    ConfigError
        if the address is not accepted, or dask is not installed.
    TerrainError
        if the scheduler cannot be reached, has no worker, or a worker has other software.
    """
    address = scheduler_address(compute)
    if address is None:
        yield LOCAL
        return
    if find_spec("distributed") is None:
        raise ConfigError("--compute dask:... needs the package distributed: install terrain-slip[cluster]")
    from distributed import Client

    where, logged = urlsplit(address), logging.root.manager.disable
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        try:
            create_connection((str(where.hostname), int(where.port or 0)), timeout=CONNECT_S).close()
            client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            logging.disable(logged)
            raise TerrainError(
                f"no Dask scheduler answers at {address}: start one there with 'dask scheduler', "
                "and workers with 'dask worker'"
            ) from error
        token = _client.set(client)
        try:
            _check_workers(client)
            yield address
        finally:
            _client.reset(token)
            client.close(timeout=PARENT_POLL_S)
            gc.collect()  # tasks of dask that ended with it are logged when they are collected
            logging.disable(logged)


def parallel(
    function: Callable[..., Any],
    shared: Sequence[Any],
    each: Collection[Sequence[Any]],
    n_jobs: int,
    task: str = "",
    progress: Progress = silent,
) -> Iterator[Any]:
    """Yield ``function(*shared, *one)`` for each ``one``, in their order, as soon as they are there.

    Few tasks are in progress at once, so that results do not pile up; what is local and what a cluster computes
    has the same bytes.

    Parameters
    ----------
    function : of an importable module
    shared : arguments that all tasks have; they are sent to a worker once
    each : the other arguments of each task
    n_jobs : processes at once on this machine; a cluster has as many as it has
    task, progress : name of the work, and what is called as results are there

    Raises
    ------
    TerrainError
        if the scheduler is lost, no worker is left, or a task ends the processes that compute it.

    Examples
    --------
    >>> list(parallel(pow, (2,), [(3,), (5,)], 1))
    [8, 32]
    """
    client, n_jobs = _client.get(), min(n_jobs, len(each))
    if client is not None:
        results = _in_cluster(client, function, shared, each)
    elif n_jobs > 1:
        results = _in_processes(function, shared, each, n_jobs)
    else:
        results = starmap(partial(function, *shared), each)
    progress(task, 0, len(each))
    for done, result in enumerate(results, start=1):
        yield result
        progress(task, done, len(each))


def _in_processes(
    function: Callable[..., Any], shared: Sequence[Any], each: Iterable[Sequence[Any]], n_jobs: int
) -> Iterator[Any]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    # a process whose memory has grown, as by the import of torch, is replaced; nothing is lost
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    tasks = (delayed(function)(*shared, *one) for one in each)
    pool = Parallel(n_jobs, return_as="generator", initializer=end_with_parent, initargs=(os.getpid(),))
    try:
        yield from pool(tasks)
    except TerminatedWorkerError as error:
        raise TerrainError(
            "a process ended in the middle of its task, killed or out of memory: "
            "use fewer at once with --jobs, or give them more memory"
        ) from error


def end_with_parent(parent: int) -> None:
    """End this process soon after the process ``parent`` has ended, were it killed: begun in a thread.

    A pool's processes otherwise finish their task and wait for minutes for another.
    """
    from threading import Thread
    from time import sleep

    def watch() -> None:
        while os.getppid() == parent:
            sleep(PARENT_POLL_S)
        os._exit(1)

    Thread(target=watch, name="end with parent", daemon=True).start()


def _check_workers(client: Any) -> None:
    """Raise ``TerrainError`` where no worker comes, or one computes with other software than this process."""
    address = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        raise TerrainError(
            f"the Dask scheduler at {address} has no worker: start one with 'dask worker {address}'"
        ) from error
    with _failures(client):
        answers = client.run(software, on_error="return")
    for worker, there in sorted(answers.items()):
        if not isinstance(there, Mapping):
            reason = " ".join(str(there).split())[:120]
            found = f"cannot import this package ({reason})"
        elif (different := difference(software(), dict(there))) is not None:
            found = f"has {different}"
        else:
            continue
        raise TerrainError(f"worker {worker} of {address} {found}: install the same version on it")


@contextmanager
def _failures(client: Any) -> Iterator[None]:
    """Turn what dask raises of its own into one sentence each; what a task raises stays as it is."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    address = client.scheduler.address
    try:
        yield
    except KilledWorker as error:
        raise TerrainError(
            f"a task ended {error.allowed_failures + 1} workers of {address} one after another: they "
            "were killed or ran out of memory; give each more of it, or fewer threads"
        ) from error
    except (CancelledError, CommClosedError, ConnectionError, TimeoutError) as error:
        raise TerrainError(
            f"the Dask scheduler at {address} does not answer any more: what was not written yet is lost; features in "
            "--cache and trials of --search are kept, and the same command goes on with them"
        ) from error
    except MemoryError as error:
        raise TerrainError(f"a worker of {address} has too little memory for its task") from error
