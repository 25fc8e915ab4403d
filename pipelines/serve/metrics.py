"""Figures of the service for Prometheus."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest

STEP_BUCKETS_S = (25e-6, 50e-6, 100e-6, 200e-6, 300e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 50e-3)
LATENCY_BUCKETS_S = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 0.1, 0.2, 0.5, 1.0)

TOTALS = ("opened_sessions", "messages", "rows", "steps", "errors", "wrong_tokens")


class Metrics:
    """The figures of one service, apart from those of any other in the process, and of the process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        common: dict[str, Any] = {"namespace": "terrain", "registry": self._registry}
        counter: Callable[..., Counter] = partial(Counter, **common)
        gauge: Callable[..., Gauge] = partial(Gauge, **common)
        histogram: Callable[..., Histogram] = partial(Histogram, buckets=LATENCY_BUCKETS_S, **common)
        self.messages = counter("messages", "Messages of robots.")
        self.rows = counter("rows", "Rows of samples taken.")
        self.wrong_tokens = counter("wrong_tokens", "Tokens that were missing, or another.")
        self.errors = counter("errors", "Errors sent, by code.", ["code"])
        self.steps = counter("steps", "Steps of sessions.")
        self.late_ticks = counter("late_ticks", "Steps that were left out, as the one before came late.")
        self.stopped = counter("stopped_commands", "Commands to stand, by reason.", ["reason"])
        self.windows = counter("windows", "Windows classified, by terrain.", ["terrain"])
        self.unsent = counter("unsent_steps", "Steps that a newer one replaced before they were read.")
        self.opened = counter("opened_sessions", "Sessions that were opened.")
        self.alarms = counter(
            "watch_alarms", "Departures of robots from their models, by channel.", ["channel"]
        )
        self.departing = gauge("watch_departures", "Departures that are not over.", ["session"])
        self.sessions = gauge("sessions", "Robots connected.")
        self.served = gauge("served_number", "Number of model and table.")
        self.step_s = histogram("step_seconds", "One step.", buckets=STEP_BUCKETS_S)
        self.window_s = histogram("window_seconds", "Features and classifier of one window.")
        self.latency_s = histogram(
            "latency_seconds", "From the arrival of the newest sample to the end of the step."
        )

    def forget(self, session: str) -> None:
        """Leave out the figures of a session that has ended."""
        with suppress(KeyError):
            self.departing.remove(session)

    def totals(self) -> dict[str, int]:
        """Return what was counted so far of sessions, messages, rows, steps, errors and wrong tokens."""
        found = {
            family.name: sum(int(one.value) for one in family.samples if one.name.endswith("_total"))
            for family in self._registry.collect()
        }
        return {name.removeprefix("opened_"): found[f"terrain_{name}"] for name in TOTALS}

    def text(self) -> bytes:
        """Return all figures in Prometheus' text form."""
        written: bytes = generate_latest(self._registry)
        return written
