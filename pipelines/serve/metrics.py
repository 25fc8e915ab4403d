"""Figures of the service for Prometheus."""

from __future__ import annotations

import resource
import sys
from collections import Counter as Counts

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

STEP_BUCKETS_S = (25e-6, 50e-6, 100e-6, 200e-6, 300e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 50e-3)
LATENCY_BUCKETS_S = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 0.1, 0.2, 0.5, 1.0)


class Metrics:
    """The figures of one service, apart from those of any other in the process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"terrain_{name}", text, labels, registry=self._registry)

        self.messages = counter("messages", "Messages of robots.")
        self.rows = counter("rows", "Rows of samples taken.")
        self.wrong_tokens = counter("wrong_tokens", "Tokens that were missing, or another.")
        self.errors = counter("errors", "Errors sent, by code.", "code")
        self.steps = counter("steps", "Steps of sessions.")
        self.late_ticks = counter("late_ticks", "Steps that were left out, as the one before came late.")
        self.stopped = counter("stopped_commands", "Commands to stand, by reason.", "reason")
        self.windows = counter("windows", "Windows classified, by terrain.", "terrain")
        self.unsent = counter("unsent_steps", "Steps that a newer one replaced before they were read.")
        self.opened = counter("opened_sessions", "Sessions that were opened.")
        self.sessions = Gauge("terrain_sessions", "Robots connected.", registry=self._registry)
        self.served = Gauge("terrain_served_number", "Number of model and table.", registry=self._registry)
        self.memory = Gauge("terrain_memory_bytes", "Resident memory.", registry=self._registry)
        self.step_s = Histogram(
            "terrain_step_seconds", "One step.", buckets=STEP_BUCKETS_S, registry=self._registry
        )
        self.window_s = Histogram(
            "terrain_window_seconds",
            "Features and classifier of one window.",
            buckets=LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        self.latency_s = Histogram(
            "terrain_latency_seconds",
            "From the arrival of the newest sample to the end of the step.",
            buckets=LATENCY_BUCKETS_S,
            registry=self._registry,
        )

    def totals(self) -> dict[str, int]:
        """Return what was counted so far of sessions, messages, rows, steps, errors and wrong tokens."""
        counted: Counts[str] = Counts()
        for family in self._registry.collect():
            for sample in family.samples:
                counted[sample.name] += int(sample.value)
        names = {"sessions": "opened_sessions", "messages": "messages", "rows": "rows", "steps": "steps"}
        names |= {"errors": "errors", "wrong_tokens": "wrong_tokens"}
        return {name: counted[f"terrain_{key}_total"] for name, key in names.items()}

    def text(self) -> bytes:
        """Return all figures in Prometheus' text form."""
        self.memory.set(resident_bytes())
        written: bytes = generate_latest(self._registry)
        return written


def resident_bytes() -> float:
    """Return the memory that the process holds; where the system does not tell, the most it ever held."""
    try:
        with open("/proc/self/statm") as file:  # noqa: PTH123 - no file of a disk
            return int(file.read().split()[1]) * float(resource.getpagesize())
    except (OSError, ValueError, IndexError):
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return float(most if sys.platform == "darwin" else most * 1024)
