"""Features of ever more runs, with ever more processes: time and peak memory.

Runs are generated: cheap noise with the spectrum of its terrain, no simulated robot.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from time import perf_counter
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import field_validator
from scipy.signal import lfilter

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import ByCommas, setting
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.tree import Column, Pairs, Report, Table
from terrain.logs.run_folders import read_run, write_run
from terrain.records import Label, RunLog, Stream

EXAMPLE = "python tests/studies scale --runs 10000 --workers 1,2"
FRACTIONS = (0.1, 0.3, 1.0)
"""Of the runs that were asked for: three sizes show whether time and memory follow their number."""
WARM_RUNS = 24  #: Before a measurement: processes are started, kernels are compiled and loaded
RUN_S = 20.0
IMU_RATE_HZ, WHEEL_RATE_HZ = 50.0, 10.0
IMU = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
TERRAINS = {"ASPHALT": (0.5, 0.2), "GRASS": (0.8, 0.5), "GRAVEL": (1.2, 0.0), "SAND": (0.7, 0.8)}
"""Vibration in m/s^2, and how much of it is left after one sample: level and colour of the noise."""
EVERY_S = 0.1
"""From sample to sample of memory: a run takes some ten times less, its memory is seen in some of them."""


class Settings(BaseSettings):
    """How many runs are generated, and how many processes compute their features."""

    runs: int = setting(10_000, "Runs of the largest size; 10 % and 30 % of them are measured too.", ge=10)
    workers: Annotated[tuple[int, ...], ByCommas] = setting((1, 2), "Processes at once, by commas.")
    seed: int = setting(0, "Of the runs.", ge=0)
    scratch: Path | None = setting(
        None, "Existing folder for the generated runs, 70 kB each; that of temporary files by default."
    )

    @field_validator("workers")
    @classmethod
    def _check_workers(cls, workers: tuple[int, ...]) -> tuple[int, ...]:
        if not workers or min(workers) < 1 or len(set(workers)) < len(workers):
            raise ValueError(f"--workers is {','.join(map(str, workers))!r}: different numbers from 1 on")
        return workers

    @field_validator("scratch")
    @classmethod
    def _check_scratch(cls, scratch: Path | None) -> Path | None:
        if scratch is not None and not scratch.is_dir():
            raise ValueError(f"--scratch is {scratch}: is no folder")
        return scratch


class Point(NamedTuple):
    """Features of so many runs by so many processes; ``peak_mb`` is of all together."""

    n_runs: int
    n_workers: int
    seconds: float
    runs_per_s: float
    peak_mb: float


class ScaleResult(Result):
    """Time and memory against the number of runs."""

    run_s: float = described("length of a run", "s")
    seed: int = described("of the runs")
    points: tuple[Point, ...] = described("the measurements")
    speed_up: dict[int, float] = described("by number of processes, times one at the largest size")


def generated_run(seed: int, number: int) -> RunLog:
    """Return a run; it depends on the seed and its number only."""
    rng = np.random.default_rng((seed, number))
    terrain = list(TERRAINS)[number % len(TERRAINS)]
    level_mps2, colour = TERRAINS[terrain]
    n_imu, n_wheels = round(RUN_S * IMU_RATE_HZ), round(RUN_S * WHEEL_RATE_HZ)
    imu = lfilter(
        [level_mps2 * rng.uniform(0.8, 1.25)], [1.0, -colour], rng.standard_normal((n_imu, 6)), axis=0
    )
    imu[:, 5] += 9.81
    wheels = 0.02 * rng.standard_normal((n_wheels, 4)) + np.array([1.0, 1.0, 4.0, 4.0]) * rng.uniform(
        0.4, 0.8
    )
    streams = {
        "imu": Stream(np.arange(n_imu) / IMU_RATE_HZ, imu, IMU),
        "wheels": Stream(np.arange(n_wheels) / WHEEL_RATE_HZ, wheels, WHEELS),
    }
    return RunLog(f"run_{number:06d}", "husky", streams, (Label(0.0, RUN_S, terrain),), source="generated")


def write_generated(seed: int, folder: Path, number: int) -> None:
    """Write a generated run as a run folder."""
    write_run(generated_run(seed, number), folder)


def process_tree(pid: int) -> list[int]:
    """Return a process and all that it started, directly or through others; those that ended are left out."""
    found, pids = [], [pid]
    while pids:
        pid = pids.pop()
        found.append(pid)
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                pids += [int(child) for child in (task / "children").read_text().split()]
        except OSError:
            continue
    return found


def _rss_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, ValueError, IndexError):
        return 0.0


@contextmanager
def peak_memory() -> Iterator[list[float]]:
    """Sample the sum of resident memory in MB while a block lasts, from a thread of its own.

    It is that of this process and all that it started; shared pages count for each.
    """
    samples_mb: list[float] = []
    ended = Event()

    def watch() -> None:
        while not ended.wait(EVERY_S):
            sample()

    def sample() -> None:
        samples_mb.append(sum(_rss_mb(pid) for pid in process_tree(os.getpid())))

    thread = Thread(target=watch, name="memory", daemon=True)
    sample()
    thread.start()
    try:
        yield samples_mb
    finally:
        ended.set()
        thread.join()
        sample()


def run(settings: Settings, progress: Progress = silent) -> ScaleResult:
    """Measure making features of generated runs on this machine."""
    from joblib.externals.loky import get_reusable_executor

    from pipelines.learn.parallel import parallel

    sizes = sorted({max(round(fraction * settings.runs), 1) for fraction in FRACTIONS})
    with TemporaryDirectory(dir=settings.scratch, prefix="fleet-") as folder:
        runs = Path(folder) / "runs"
        numbers = [(number,) for number in range(sizes[-1])]
        given = write_generated, (settings.seed, runs), numbers, max(settings.workers)
        list(parallel(*given, "write runs", progress))
        points: list[Point] = []
        for n_workers in settings.workers:
            # processes of the last size, with the memory they hold
            get_reusable_executor().shutdown(wait=True)
            _measure(runs, min(WARM_RUNS, sizes[-1]), n_workers)
            for n_runs in sizes:
                progress("measure", len(points), len(sizes) * len(settings.workers))
                points.append(_measure(runs, n_runs, n_workers))
        progress("measure", len(points), len(points))
    largest = {point.n_workers: point.seconds for point in points if point.n_runs == sizes[-1]}
    times = {n: largest[1] / seconds for n, seconds in largest.items() if n > 1} if 1 in largest else {}
    return ScaleResult(run_s=RUN_S, seed=settings.seed, points=tuple(points), speed_up=times)


def _measure(runs: Path, n_runs: int, n_workers: int) -> Point:
    from pipelines.data.datasets import RunLoader
    from pipelines.learn.cache import cached_data
    from pipelines.learn.settings import LearnSettings

    folders = [runs / f"run_{number:06d}" for number in range(n_runs)]
    loaders = [RunLoader(partial(read_run, each), False, False, None) for each in folders]
    with TemporaryDirectory(dir=runs.parent, prefix="store-") as out, peak_memory() as samples_mb:
        begun_s = perf_counter()
        cached_data(loaders, LearnSettings(n_jobs=n_workers), Path(out))
        seconds = perf_counter() - begun_s
    return Point(n_runs, n_workers, seconds, n_runs / seconds, max(samples_mb))


def report(result: ScaleResult) -> Report:
    """Return time and memory by size and number of processes."""
    columns = (
        "runs",
        "processes",
        Column("time", ".1f", "s"),
        Column("runs/s", ".1f"),
        Column("peak", ".0f", "MB"),
    )
    slowest, fastest = (f(point.runs_per_s for point in result.points) for f in (min, max))
    times = [(f"{n} processes, times one", ratio, ".2f") for n, ratio in result.speed_up.items()]
    return Report(
        "Features of many runs",
        f"{slowest:.1f} to {fastest:.1f} runs of {result.run_s:g} s a second, with at most "
        f"{max(point.peak_mb for point in result.points):.0f} MB.",
        parts=(Table(columns, result.points), Pairs(times)) if times else (Table(columns, result.points),),
    )
