"""Tasks give the same wherever they are computed, and what is lost is one sentence."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from features.windows import WindowRule
from pipelines.learn import parallel as cluster
from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.parallel import computing, parallel, scheduler_address
from pipelines.report.results import as_json
from pipelines.report.versions import difference, software
from terrain.errors import ConfigError, TerrainError

ROOT = Path(__file__).resolve().parents[3]


def test_an_address_is_read_and_another_text_refused_in_one_sentence():
    for compute, address in (
        ("dask:127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("dask:tcp://node-3.lab:1", "tcp://node-3.lab:1"),
        ("dask:tls://[::1]:8786", "tls://[::1]:8786"),
        ("local", None),
    ):
        assert scheduler_address(compute) == address
    for text in ("", "dask", "dask:host", "dask:host:0", "dask:host:65536", "dask:http://h:1", "ray:h:1"):
        with pytest.raises(ConfigError, match="'local' or the address of a Dask scheduler"):
            computing(text).__enter__()
    with pytest.raises(TerrainError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9:"):
        computing("dask:127.0.0.1:9").__enter__()


def test_results_of_two_processes_come_in_the_order_of_their_tasks():
    assert list(parallel(pow, (2,), [(number,) for number in range(40)], 2)) == [2**k for k in range(40)]
    with pytest.raises(TerrainError, match="ended in the middle of its task"):
        list(parallel(os._exit, (), [(3,), (3,)], 2))


def until(condition, timeout_s=60):
    """Wait until a condition holds, and return whether it does."""
    end_s = time.monotonic() + timeout_s
    while not (holds := condition()) and time.monotonic() < end_s:
        time.sleep(0.1)
    return holds


def is_over(process):
    with suppress(psutil.NoSuchProcess):
        return process.status() == psutil.STATUS_ZOMBIE
    return True


def test_no_process_is_left_where_the_command_is_killed(tmp_path):
    code = (
        "from pipelines.learn.parallel import parallel\n"
        "task = 'import time, pathlib; pathlib.Path({!r}).touch(); time.sleep(300.0)'\n"
        "list(parallel(exec, (), [(task.format(name),) for name in ('first', 'second')], 2))"
    )
    words, environment = [sys.executable, "-c", code], os.environ | {"PYTHONPATH": str(ROOT)}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = subprocess.Popen(words, cwd=tmp_path, env=environment, **silent)
    try:
        assert until(lambda: len(list(tmp_path.iterdir())) == 2)  # both compute
        processes = psutil.Process(command.pid).children(recursive=True)
        assert len(processes) >= 2
    finally:
        command.kill()
        command.wait()
    assert until(lambda: all(map(is_over, processes)), 20)


@contextmanager
def quiet_cluster(n_workers):
    """A cluster in this process."""
    import distributed

    here = {"processes": False, "protocol": "tcp", "dashboard_address": None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(n_workers=n_workers, threads_per_worker=1, **here) as running:
            yield "dask:" + running.scheduler_address


@pytest.fixture(scope="module")
def threads_cluster():
    with quiet_cluster(2) as compute:
        yield compute


@pytest.mark.slow
def test_a_cluster_gives_the_report_of_this_machine(threads_cluster, drive_all):
    runs = drive_all(("ASPHALT", "GRASS"), 4, duration_s=12.0)
    settings = EvaluationSettings(repeats=1, steady=False, n_jobs=2)
    here = crossval(runs, settings)
    with computing(threads_cluster) as place:
        assert place == threads_cluster.removeprefix("dask:")
        assert json.dumps(as_json(crossval(runs, settings))) == json.dumps(as_json(here))


def test_errors_of_a_task_keep_their_sentence_and_other_software_on_a_worker_is_refused(
    threads_cluster, monkeypatch
):
    results = parallel(WindowRule, (), [(2.0,), (-1.0,)], 1)
    with computing(threads_cluster), pytest.raises(ConfigError, match="it must be positive"):
        list(results)
    other = software() | {"numpy": "1.0"}
    monkeypatch.setattr(cluster, "difference", lambda _, there: difference(other, there))
    with pytest.raises(TerrainError, match=r"worker tcp://.* has numpy .* where 1\.0 is needed"):
        computing(threads_cluster).__enter__()


@pytest.mark.slow
def test_a_cluster_without_workers_is_one_sentence(monkeypatch):
    monkeypatch.setattr(cluster, "FIRST_WORKER_S", 0.2)
    no_worker = "has no worker: start one with 'dask worker tcp://"
    with quiet_cluster(0) as empty, pytest.raises(TerrainError, match=no_worker):
        computing(empty).__enter__()


def answers(port):
    with suppress(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
        return True
    return False


@pytest.fixture
def processes(tmp_path, monkeypatch):
    """A scheduler in a process of its own, on loopback, and what starts workers of it."""
    from distributed.utils import open_port

    monkeypatch.chdir(tmp_path)
    started, port = [], open_port(host="127.0.0.1")

    def start(module, *options):
        words = [sys.executable, "-m", f"distributed.cli.{module}", "--host", "127.0.0.1", "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        started.append(subprocess.Popen([*words, *options], env=environment, **quiet))
        return started[-1]

    def add_worker(nanny="--no-nanny"):
        return start("dask_worker", f"tcp://127.0.0.1:{port}", "--nthreads", "1", nanny)

    scheduler = start("dask_scheduler", "--port", str(port))
    assert until(lambda: answers(port))
    yield SimpleNamespace(compute=f"dask:127.0.0.1:{port}", scheduler=scheduler, add_worker=add_worker)
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_killed_worker_costs_its_task_only(processes):
    first, _ = processes.add_worker(), processes.add_worker()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(300, 300)))[0]
    powers = [2**12 + number for number in range(40)]
    found = []
    with computing(processes.compute):
        for result in parallel(np.linalg.matrix_power, (turn,), [(power,) for power in powers], 1):
            found.append(result)
            if len(found) == 3:
                first.kill()
    for power, result in zip(powers, found, strict=True):
        np.testing.assert_allclose(result, np.linalg.matrix_power(turn, power), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lost", "request_to_end", "sentence"),
    [
        ("scheduler", signal.SIGKILL, "what was not written yet is lost; features in --cache and trials"),
        ("scheduler", signal.SIGSTOP, "does not answer any more"),
        ("worker", signal.SIGKILL, "no worker of .* has taken a task"),
    ],
)
def test_what_is_lost_is_one_sentence_in_a_bounded_time(
    processes, monkeypatch, lost, request_to_end, sentence
):
    monkeypatch.setattr(cluster, "ANSWER_S", 2.0)
    monkeypatch.setattr(cluster, "NO_WORKER_S", 2.0)
    running = {"scheduler": processes.scheduler, "worker": processes.add_worker()}
    with computing(processes.compute):
        results = parallel(time.sleep, (), [(0.2,)] * 200, 1)
        next(results)
        running[lost].send_signal(request_to_end)
        with pytest.raises(TerrainError, match=sentence):
            list(results)


@pytest.mark.slow
def test_tasks_that_end_their_worker_are_one_sentence(processes):
    processes.add_worker("--nanny")
    with computing(processes.compute), pytest.raises(TerrainError, match="were killed or ran out of memory"):
        list(parallel(os._exit, (), [(3,)], 1))
