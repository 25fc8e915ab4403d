"""Slip of robots of every drive by what measures their motion: errors and coverage, with it and ten seconds without."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, Names, setting
from pipelines.report.tree import Report, Table
from terrain.errors import ConfigError
from terrain.estimation.estimate import estimate_run
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot, SkidSteerRobot, load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.sensors import Gnss, Poses

EXAMPLE = "python tests/studies slip --runs 2 --seed 7100"
MINE = SkidSteerRobot("mine", 0.2, 0.7, 0.8, 120.0)
"""A skid-steer robot of four numbers."""

SENSORS: Mapping[str, tuple[str, ...]] = {
    "gnss": ("gnss",),
    "positions": ("gnss",),
    "speeds": ("gnss",),
    "pose": ("pose",),
    "speed": ("odometry",),
}
"""Streams of each set of sensors of the motion over ground, beside wheels, steering and IMU: a receiver without a
compass, its positions or speeds alone, poses, and the body's speed, as a camera or a lidar gives it."""

PAIRS = (
    *(
        "mine+gnss",
        "mine+positions",
        "mine+speeds",
        "husky+pose",
        "husky+speed",
        "marmotte+gnss",
        "orchard_ugv+pose",
    ),
    *("robotino+pose", "omnirobot+pose", "adap2e+gnss", "pallet_truck+pose", "agrimaro+gnss"),
)
SCENARIOS = ("survey", "starts", "complex")
LEAST_MPS = 0.3
"""Slower wheels are left out: there an error of 1 cm/s is 3 % of slip."""
GAP_S = 10.0
AFTER_S = 0.5


class SlipFigures(NamedTuple):
    """Slip of a robot by some sensors; NaN where nothing was known."""

    robot: str
    sensors: str
    n_runs: int
    worst_mean: float  #: largest mean error of a run
    rmse: float  #: of all samples
    coverage: float  #: ratio of samples within their 95 % interval
    gap_rmse: float  #: over ten seconds without a reference
    gap_coverage: float
    known: float  #: ratio of samples of wheels that turn whose slip is known


def with_sensors(run: RunLog, sensors: str, rng: np.random.Generator) -> RunLog:
    """Return a run with these sensors of the motion over ground alone."""
    kept = {"wheels", "steering", "imu", "truth", *SENSORS[sensors]}
    streams = {name: stream for name, stream in run.streams.items() if name in kept}
    if sensors in ("positions", "speeds"):
        values = streams["gnss"].values.copy()
        values[:, slice(2, 4) if sensors == "positions" else slice(0, 2)] = math.nan
        streams["gnss"] = Stream(streams["gnss"].time_s, values, streams["gnss"].channels)
    if sensors == "speed":
        truth, time_s = (
            run.streams["truth"],
            np.arange(0.0, run.streams["truth"].time_s[-1] - 0.02, 1.0 / 30.0),
        )
        names = ("speed_x_mps", "speed_y_mps")
        values = np.column_stack([np.interp(time_s, truth.time_s, truth.channel(name)) for name in names])
        streams["odometry"] = Stream(time_s + 0.02, values + 0.03 * rng.standard_normal(values.shape), names)
    return replace(run, streams=streams)


def without_reference(run: RunLog, sensors: str, start_s: float) -> RunLog:
    """Return a run in which nothing measures the motion over ground for some seconds."""
    streams = dict(run.streams)
    for name in SENSORS[sensors]:
        stream = streams[name]
        seen = (stream.time_s < start_s) | (stream.time_s > start_s + GAP_S)
        streams[name] = Stream(stream.time_s[seen], stream.values[seen], stream.channels)
    return replace(run, streams=streams)


def errors_of(run: RunLog, robot: Robot, between_s: tuple[float, float]) -> tuple[Array, Array]:
    """Return errors (n,) of slips of wheels that turn, NaN where slip is unknown, and over their standard deviations.

    The truth comes behind the low-pass of the encoders, as the wheels' speeds do.
    """
    found, truth = estimate_run(run, robot, "slip"), run.streams["truth"]
    slip, errors, relative = found.slip, [], []
    at_s = slip.time_s - robot.encoder_lag_s
    for k, (name, wheel) in enumerate(zip(slip.channels, slip.wheels, strict=True)):
        if name not in truth.channels:  # a wheel that never turned
            continue
        true = np.clip(found.true(name), -1.0, 1.0)  # as slip_ratio is
        turns = np.interp(at_s, truth.time_s, truth.channel(f"wheel_{wheel}_radps")) * robot.wheel_radius_m
        chosen = (np.abs(turns) > LEAST_MPS) & (slip.time_s > between_s[0]) & (slip.time_s < between_s[1])
        errors.append((slip.mean[:, k] - true)[chosen])
        relative.append(errors[-1] / slip.std[chosen, k])
    return np.concatenate(errors), np.concatenate(relative)


def _run_figures(
    robot: Robot, sensors: str, terrain: str, scenario: str, seed: int
) -> list[tuple[Array, Array]] | None:
    poses = Poses(20.0, 0.0, 0.002, 0.002) if robot.on_omni_wheels else Poses()
    asked = {"gnss": Gnss()} if SENSORS[sensors] == ("gnss",) else {"poses": poses}
    try:
        run = simulate_run(robot, terrain, scenario, seed, duration_s=60.0, vary=True, **asked)
    except ConfigError:  # a robot that gets stuck there
        return None
    run = with_sensors(run, sensors, np.random.default_rng([seed, 5]))
    gap_s = 20.0
    return [
        errors_of(run, robot, (-math.inf, math.inf)),
        errors_of(without_reference(run, sensors, gap_s), robot, (gap_s + AFTER_S, gap_s + GAP_S)),
    ]


def figures_of(robot: str, sensors: str, found: Sequence[list[tuple[Array, Array]]]) -> SlipFigures:
    """Return the figures of a robot of the errors of its runs."""

    def coverage(relative: Array) -> float:
        known = np.isfinite(relative)
        return float(np.mean(np.abs(relative[known]) < ndtri(0.975))) if known.any() else math.nan

    def rmse(errors: Array) -> float:
        known = errors[np.isfinite(errors)]
        return float(np.sqrt(np.mean(known**2))) if known.size else math.nan

    means = [float(np.nanmean(run[0][0])) for run in found if np.isfinite(run[0][0]).any()]
    (errors, relative), (gap, gap_relative) = (
        tuple(np.concatenate([run[k][i] for run in found]) for i in range(2)) for k in range(2)
    )
    worst = max(map(abs, means), default=math.nan)
    of_gap = rmse(gap), coverage(gap_relative)
    known = float(np.isfinite(errors).mean()) if errors.size else math.nan
    return SlipFigures(robot, sensors, len(found), worst, rmse(errors), coverage(relative), *of_gap, known)


class Settings(JobsSettings):
    """Which runs are simulated."""

    runs: int = setting(1, "Of each scenario on each terrain.", ge=1)
    seed: int = setting(0, "Of all runs.", ge=0)
    pairs: Names = setting(PAIRS, "Robots and sensors, by commas.")
    terrains: Names = setting(
        ("asphalt", "firm_soil_gravel", "grass", "snow", "tilled_loam", "dry_sand"), "By commas."
    )
    scenarios: Names = setting(SCENARIOS, "By commas.")


class SlipResult(Result):
    """Slip by robot and sensors."""

    seed: int = described("of all runs")
    figures: tuple[SlipFigures, ...] = described("errors and coverage of slip, a row a robot and its sensors")


def run(settings: Settings, progress: Progress = silent) -> SlipResult:
    """Simulate runs of each robot, and compare its slip with the truth."""
    from joblib import Parallel, delayed

    rows, pool = [], Parallel(n_jobs=settings.jobs, return_as="list")
    for done, pair in enumerate(settings.pairs, 1):
        name, _, sensors = pair.partition("+")
        if sensors not in SENSORS:
            raise ConfigError(
                f"pair {pair!r} is unknown: a robot and one of {', '.join(SENSORS)} are required"
            )
        robot = MINE if name == "mine" else load_robot(name)
        jobs = [
            (terrain, scenario, settings.seed + 100 * number)
            for terrain in settings.terrains
            for scenario in settings.scenarios
            for number in range(settings.runs)
        ]
        found = pool(delayed(_run_figures)(robot, sensors, *job) for job in jobs)
        rows.append(figures_of(name, sensors, [one for one in found if one is not None]))
        progress("slip", done, len(settings.pairs))
    return SlipResult(settings.seed, tuple(rows))


def report(result: SlipResult) -> Report:
    """Return a line a robot and its sensors."""
    columns = (
        "robot",
        "sensors",
        "runs",
        "largest mean error",
        "RMSE",
        "covered",
        "10 s without: RMSE",
        "covered",
        "known",
    )
    forms = (".3f", ".3f", ".1%", ".3f", ".1%", ".0%")
    cells = tuple(
        (
            row.robot,
            row.sensors,
            str(row.n_runs),
            *(format_value(v, form) for v, form in zip(row[3:], forms, strict=True)),
        )
        for row in result.figures
    )
    worst = max((row.rmse for row in result.figures), default=math.nan)
    return Report(
        "Slip of robots of every drive",
        f"Slip of {len(result.figures)} robots and sensors has an RMSE of at most {format_value(worst, '.3f')}.",
        parts=(Table(columns, cells, title="Errors of slip, and coverage of its 95 % intervals"),),
    )
