"""The service as a process of its own, started and watched from outside."""

from __future__ import annotations

import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep

from terrain.errors import TerrainError

START_S = 120.0
COMMAND = (sys.executable, "-c", "from pipelines.cli.main import main; main()", "serve")


class ServiceProcess:
    """A running service.

    Attributes
    ----------
    url : of its HTTP side
    process : that runs it
    """

    def __init__(self, options: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "--port", "0", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if " at http" not in line:
            _, text = self.process.communicate(timeout=30)
            lines = text.strip().splitlines()
            raise TerrainError(f"the service did not start: {lines[-1] if lines else 'it says nothing'}")
        self.url = line.rsplit(" at ", 1)[1].strip()

    @property
    def socket_url(self) -> str:
        """Address of its WebSockets."""
        return self.url.replace("http", "ws", 1)

    @property
    def rss_mb(self) -> float:
        """Resident memory of the process in MB; NaN where the system does not tell."""
        try:
            pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        except (OSError, ValueError, IndexError):
            return float("nan")
        return pages * 4096 / 1e6

    def figure(self, name: str) -> float:
        """Return one of its Prometheus figures; 0 where there is none yet."""
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=10) as answer:
            text: str = answer.read().decode()
        values = [line.rsplit(" ", 1)[1] for line in text.splitlines() if line.startswith(f"{name} ")]
        return float(values[0]) if values else 0.0

    def stop(self, timeout_s: float = 10.0) -> int:
        """End it in order; return its exit code."""
        self.process.terminate()
        end_s = monotonic() + timeout_s
        while self.process.poll() is None and monotonic() < end_s:
            sleep(0.02)
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()
        return int(self.process.returncode)


@contextmanager
def service_process(options: Sequence[str]) -> Iterator[ServiceProcess]:
    """Run a service while a block lasts."""
    running = ServiceProcess(options)
    try:
        yield running
    finally:
        running.stop()
