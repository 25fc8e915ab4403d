"""A scheduler and workers in processes of their own, on loopback."""

import os
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(module, *options, path=()):
    """Start a process of dask; what it writes is thrown away."""
    code = f"from distributed.cli.{module} import main; main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE), *path])}
    return subprocess.Popen(
        [sys.executable, "-c", code, *options],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


class Processes:
    """A scheduler with its workers."""

    def __init__(self):
        self.port = free_port()
        self.compute = f"dask:127.0.0.1:{self.port}"
        self.scheduler = start(
            "dask_scheduler", *f"--host 127.0.0.1 --port {self.port} --no-dashboard".split()
        )
        self.workers = []
        end_s = time.monotonic() + 60
        while time.monotonic() < end_s:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
                return
            except OSError:
                time.sleep(0.1)
        raise AssertionError("the scheduler did not start")

    def add_worker(self, *options):
        address = f"tcp://127.0.0.1:{self.port}"
        words = f"{address} --host 127.0.0.1 --nthreads 1 --no-dashboard".split()
        self.workers.append(start("dask_worker", *words, *options))
        return self.workers[-1]

    def stop(self):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@contextmanager
def processes():
    running = Processes()
    try:
        yield running
    finally:
        running.stop()
