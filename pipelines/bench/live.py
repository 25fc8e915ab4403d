"""``terrain bench live``: latency by stage, and the service with one robot and with many."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from features.windows import cut_windows
from pipelines.bench.chain import paced_step_times_us, step_times_us, window_times_ms
from pipelines.bench.drive import ROBOT, bench_drive, messages_of, model_folder, sent_channels
from pipelines.bench.process import service_process
from pipelines.bench.results import LiveBench, SessionsLatency, spread
from pipelines.bench.robots import Packed, drive, drive_all, hello, packed
from pipelines.bench.settings import BenchSettings
from pipelines.models.tracking import load_model
from pipelines.reporting.progress import Progress, silent
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.robots import load_robot

SHARES = (1, 0.4, 1.6)
"""Of the robots that were asked for, in this order."""


def bench_live(settings: BenchSettings, progress: Progress = silent) -> LiveBench:
    """Measure the live chain and the service on this machine.

    Parameters
    ----------
    settings : of the measurements
    progress : of their stages

    Raises
    ------
    TerrainError
        if the model cannot be loaded, or the service does not start.
    """
    robot, run = load_robot(ROBOT), bench_drive(settings.seed)
    n_stages = 5 + len(SHARES)
    with TemporaryDirectory() as folder:
        uri = model_folder(settings.model, settings.seed, Path(folder) / "model")
        model = load_model(uri)
        progress("bench", 1, n_stages)
        steps, beside = step_times_us(robot, model, run)
        progress("bench", 2, n_stages)
        paced = paced_step_times_us(robot, model, run, settings.seconds)
        progress("bench", 3, n_stages)
        windows = cut_windows([enriched(estimate_run(run, robot, "vio15"))], model.rule, layout=model.layout)
        window_ms = window_times_ms(windows.windows, model)
        progress("bench", 4, n_stages)
        channels = sent_channels(run)
        begun_s = perf_counter()
        with service_process(["--model", uri, "--robot", ROBOT]) as service:
            each = _for(packed(list(messages_of(run, 100.0, 100.0))), settings.seconds)
            asyncio.run(drive(service.socket_url, hello("first", ROBOT, channels), each[:3]))
            start_s, rss_mb = perf_counter() - begun_s, service.rss_mb
            one = asyncio.run(drive(service.socket_url, hello("one", ROBOT, channels), each))
            progress("bench", 5, n_stages)
            messages = _for(packed(list(messages_of(run))), settings.seconds)
            by_sessions = []
            for stage, share in enumerate(SHARES):
                n = max(math.ceil(share * settings.robots), 1)
                before = service.figure("terrain_rows_total")
                driven = asyncio.run(drive_all(service.socket_url, ROBOT, channels, messages, n))
                taken = service.figure("terrain_rows_total") - before
                times = spread([ms for found in driven for ms in found.times_ms])
                lost = sum(found.rows for found in driven) - int(taken)
                by_sessions.append(SessionsLatency(n, times.p99, times.median, lost))
                progress("bench", 6 + stage, n_stages)
            asked = by_sessions[0]
            result = LiveBench(
                step_us=steps,
                step_beside_window_us=beside,
                step_paced_us=paced,
                window_ms=window_ms,
                websocket_ms=spread(one.times_ms[20:]),
                sessions=asked.sessions,
                sessions_p99_ms=asked.p99_ms,
                lost_samples=asked.lost_samples,
                by_sessions=tuple(sorted(by_sessions)),
                start_s=start_s,
                rss_mb=rss_mb,
                rss_loaded_mb=service.rss_mb,
            )
    return result


def _for(messages: list[Packed], seconds: float) -> list[Packed]:
    return [one for one in messages if one.time_s <= seconds]
