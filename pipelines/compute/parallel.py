"""Independent tasks, computed side by side, with their results in order.

``with computing("dask:tcp://127.0.0.1:8786"):`` states where; :func:`parallel` asks for it, so that what
computes need not know.  A process that is started by a task computes its own tasks on its own cores.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from pipelines.compute.settings import LOCAL, scheduler_address
from terrain.errors import TerrainError

if TYPE_CHECKING:
    from pipelines.compute.cluster import Cluster

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


@contextmanager
def computing(compute: str) -> Iterator[None]:
    """State where the tasks of a block are computed.

    Parameters
    ----------
    compute : ``local`` or ``dask:ADDRESS``, as :func:`pipelines.compute.settings.scheduler_address`

    Raises
    ------
    ConfigError
        if the address is not accepted, or dask is not installed.
    TerrainError
        if the scheduler cannot be reached, has no worker, or a worker has other software.
    """
    address = scheduler_address(compute)
    if address is None:
        token = _cluster.set(None)
        try:
            yield
        finally:
            _cluster.reset(token)
        return
    from pipelines.compute.cluster import connected

    with connected(address) as cluster:
        token = _cluster.set(cluster)
        try:
            yield
        finally:
            _cluster.reset(token)


def place() -> str:
    """Return where tasks are computed now: ``local`` or the address of the scheduler."""
    cluster = _cluster.get()
    return LOCAL if cluster is None else cluster.address


def end_processes() -> None:
    """End the processes that local tasks left behind to be used again, with the memory they hold."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=True)


def parallel(
    function: Callable[..., Any], shared: Sequence[Any], each: Iterable[Sequence[Any]], n_jobs: int
) -> Iterator[Any]:
    """Yield ``function(*shared, *one)`` for each ``one``, in their order, as soon as they are there.

    Few tasks are in progress at once, so that neither arguments nor results pile up; what is local and what a
    cluster computes has the same bytes.

    Parameters
    ----------
    function : of an importable module
    shared : arguments that all tasks have; they are sent to a worker once
    each : the other arguments of each task
    n_jobs : processes at once on this machine; a cluster has as many as it has

    Raises
    ------
    TerrainError
        if the scheduler is lost, no worker is left, or a task ends the processes that compute it.

    Examples
    --------
    >>> list(parallel(pow, (2,), [(3,), (5,)], 1))
    [8, 32]
    """
    cluster = _cluster.get()
    if cluster is not None:
        yield from cluster.results(function, shared, each)
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    # a process whose memory has grown, as by the import of torch, is replaced; nothing is lost
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    tasks = (delayed(function)(*shared, *one) for one in each)
    try:
        yield from Parallel(n_jobs=max(n_jobs, 1), return_as="generator")(tasks)
    except TerminatedWorkerError as error:
        raise TerrainError(
            "a process ended in the middle of its task, killed or out of memory: "
            "use fewer at once with --jobs, or give them more memory"
        ) from error
