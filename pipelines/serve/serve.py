"""Serve terrain, target slips and commands to robots, live.

Robots connect to a WebSocket service and send samples as they come; with ``--can`` the live chain runs on a CAN
bus instead, with ``--replay`` over a log.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from pipelines.report import Pairs, Progress, Report, Result, Section, described, enumerated, plural, silent
from pipelines.serve.settings import Settings

EXAMPLE = "terrain serve --model models:/field@champion --robot agrimaro --state states/"


@dataclass(frozen=True, repr=False)
class ServiceResult(Result):
    """What a service serves, and what it did until its end."""

    model: str = described("as it was named")
    classes: tuple[str, ...] = described("terrains that the model knows")
    channels: Mapping[str, tuple[str, ...]] = described("channels that the model needs, by stream")
    rate_hz: Mapping[str, float] = described("rate of each stream in its windows", "Hz")
    filter: str = described("filter whose estimates it uses; empty for none")
    robots: tuple[str, ...] = described("robots whose runs it was trained on")
    table: str = described("table of target slips")
    robot: str | None = described("robot that model and table were checked against")
    served: Mapping[str, int] | None = described(
        "sessions, messages, rows, steps, errors and wrong tokens until its end; null with --check",
        default=None,
    )


def run(settings: Settings, progress: Progress = silent) -> Result:
    """Serve until it is ended; with ``--check`` only find out whether it could.

    Raises
    ------
    TerrainError
        in one sentence, if anything does not fit: model, table, robot, token, folder, port, bus.
    """
    if settings.can is not None:
        from pipelines.serve.can_bus import run as run_on_bus

        return run_on_bus(settings)
    if settings.replay is not None:
        from pipelines.serve.replay import run as run_over_log

        return run_over_log(settings, settings.replay, progress)
    from pipelines.serve.service import Service

    service = Service(settings)
    served = service.hub.served
    assert served.model is not None  # a service begins with one
    about = {
        name: getattr(served.model.info, name)
        for name in ("classes", "channels", "rate_hz", "filter", "robots")
    }
    result = ServiceResult(model=served.model_name, table=served.table.name, robot=settings.robot, **about)
    if settings.check:
        service.close()
        return result
    service.run(lambda url: print(f"serving {settings.model} at {url}", flush=True))
    return replace(result, served=service.hub.metrics.totals())


def report(result: ServiceResult) -> Report:
    """Return what a service serves, and what it did until its end."""
    model = (
        ("classes", enumerated(result.classes)),
        ("table of target slips", result.table),
        ("trained on", enumerated(result.robots)),
        ("checked against", result.robot),
        ("filter", result.filter or None),
    )
    needs = tuple(
        (f"{stream}, {result.rate_hz[stream]:g} Hz", enumerated(names))
        for stream, names in result.channels.items()
    )
    details = (Section("Channels that the model needs", (Pairs(needs),)),)
    if result.served is None:
        answer = f"{result.model} can be served: {enumerated(result.classes)}."
        next_step = f"terrain serve --model {result.model}"
        return Report("Service", answer, parts=(Pairs(model),), details=details, next_step=next_step)
    done = result.served
    answer = f"{plural(done['sessions'], 'session')} of robots served with {result.model}."
    counts = Pairs(tuple((name.replace("_", " "), n) for name, n in done.items()))
    next_step = "terrain convert RECORDINGS --out RUNS makes runs of what was recorded"
    return Report("Service", answer, parts=(counts, Pairs(model)), details=details, next_step=next_step)
