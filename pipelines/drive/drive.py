"""``terrain drive``: controllers side by side in the closed loop, on the same ground, days and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import t as student

from pipelines.drive.controllers import CONTROLLERS, Driver, drive_once, make_driver
from pipelines.drive.drives import (
    SLOPE,
    Situation,
    brake_time,
    changes_of,
    desired_until,
    situation,
    start_times,
)
from pipelines.live.pilot import LivePilot, PilotSettings
from pipelines.models.model_files import TerrainModel
from pipelines.reporting.progress import Progress, silent
from terrain.control.drive_metrics import (
    Course,
    adapt_times,
    course_of,
    distance_after,
    energy_to,
    final_speed,
    immobilised,
    lock_s,
    roughness,
    slip_peak,
    standing_from,
    stop_distance,
)
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import Robot

FIRST_M = 4.0
"""Way of a start over which energy is compared."""

AFTER_S = 5.0
"""Time of a start after which distance is."""

TARGET_CHANGE = 0.02
"""Targets that differ by less count as one."""

STEEPEST_DEG = 25.0
SLOPE_STEPS = 8

KEYS = (
    "energy_j_per_m",
    "distance_m",
    "mean_speed_mps",
    "final_speed_mps",
    "slip_peak",
    "lock_s",
    "scrub_j",
    "immobilised",
    "adapt_s",
)
"""What each controller is judged by, everywhere; the others are of some scenarios."""


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What is driven.

    Parameters
    ----------
    scenario, terrain : as :func:`pipelines.drive.drives.situation`
    controllers : of :data:`CONTROLLERS`
    seeds : how many days, from ``first_seed`` on
    first_seed : the first of them
    delay_s : from a sample to the wheel
    ramp_mps2 : of the fixed ramp; without, as fast as gets as far as the best of ours
    duration_s, speed_mps, accel_mps2, grade_deg, radius_factors : of the scenario
    leg_backlash_rad : play of the third leg
    plant : the robot as it is, where that is not what the controllers believe
    """

    scenario: str = "starts"
    terrain: str = "grass"
    controllers: tuple[str, ...] = CONTROLLERS
    seeds: int = 20
    first_seed: int = 0
    delay_s: float = 0.05
    ramp_mps2: float | None = None
    duration_s: float | None = None
    speed_mps: float = 1.0
    accel_mps2: float = 1.0
    grade_deg: float = 0.0
    radius_factors: tuple[float, float, float] | None = None
    leg_backlash_rad: float = 0.0
    plant: Robot | None = None

    def check(self, robot: Robot, table: SlipTable) -> None:
        """Refuse what cannot be driven, before anything is.

        Raises
        ------
        ConfigError
            if a controller, a number, the scenario or the terrain is not accepted.
        """
        if not self.controllers:
            raise ConfigError("no controller is named")
        repeated = {name for name in self.controllers if self.controllers.count(name) > 1}
        if repeated:
            raise ConfigError(f"controllers name {min(repeated)!r} twice")
        if self.seeds < 1:
            raise ConfigError(f"seeds is {self.seeds}, at least 1 is required")
        if not 0.0 <= self.delay_s <= 0.5:
            raise ConfigError(f"delay_s is {self.delay_s!r}, 0 to 0.5 s are accepted")
        if self.scenario == SLOPE and self.grade_deg:
            raise ConfigError("scenario 'slope' looks for the steepest grade itself: leave the grade out")
        ramp_mps2 = PilotSettings().ramp_mps2 if self.ramp_mps2 is None else self.ramp_mps2
        for name in self.controllers:
            driver = make_driver(name, table, self.delay_s, ramp_mps2)
            LivePilot(robot, driver.table, None, driver.pilot)
        self.situation(robot, self.first_seed)

    def situation(self, robot: Robot, seed: int, grade_deg: float | None = None) -> Situation:
        """Return what is driven on the day of a seed."""
        return situation(
            self.scenario,
            self.plant or robot,
            self.terrain,
            seed,
            duration_s=self.duration_s,
            speed_mps=self.speed_mps,
            accel_mps2=self.accel_mps2,
            grade_deg=self.grade_deg if grade_deg is None else grade_deg,
            radius_factors=self.radius_factors,
            leg_backlash_rad=self.leg_backlash_rad,
        )


def judge(run: RunLog, course: Course, robot: Robot, where: Situation, driver: Driver) -> dict[str, float]:
    """Return what a drive is judged by, but energy at equal distance; NaN where it has none of it.

    ``robot`` is the one that drove, whatever its controller believed, ``course`` what it did.
    """
    commands, control = run.streams["commands"], run.streams["control"]
    starts = start_times(where.scenario)
    row = {
        "distance_m": float(course.distance_m[-1]),
        "mean_speed_mps": float(course.progress_mps.mean()),
        "final_speed_mps": final_speed(course),
        "slip_peak": slip_peak(course),
        "lock_s": lock_s(course),
        "scrub_j": float(course.scrub_j[-1]),
        "scrub_along_j": float(course.scrub_along_j[-1]),
        "immobilised": float(immobilised(course, control)),
        "adapt_s": math.nan,
        "adapted_ratio": math.nan,
        "slip_error_ratio": _slip_error(run),
        "sinkage_m": float(course.sinkage_m.mean()),
        "command_mps2": roughness(commands) * robot.wheel_radius_m,
        "yaw_drift_rad": float(abs(course.yaw_rad[-1] - course.yaw_rad[0])),
    }
    changes = _changes(run, driver)
    if changes and driver.says in ("classifier", "truth"):
        times = np.array(adapt_times(control, changes))
        row["adapted_ratio"] = float(np.isfinite(times).mean())
        row["adapt_s"] = float(np.nanmean(times)) if np.isfinite(times).any() else math.nan
    if where.scenario.name == "starts":
        row |= _starts(course, starts)
    if where.scenario.name == "brake":
        told_s = brake_time(where.scenario)
        row["stop_m"] = stop_distance(course, told_s)
        row["lock_s"] = lock_s(course, told_s, standing_from(course, told_s))
    return row


def _changes(run: RunLog, driver: Driver) -> list[tuple[float, float]]:
    """Return when the ground asked for another target, and which; one that stays asks for nothing."""
    found, before = [], math.nan
    for time_s, ground in [(0.0, run.labels[0].terrain), *changes_of(run.labels)] if run.labels else []:
        desired = driver.table.lookup(ground)["traction"].slip_ratio
        if abs(desired - before) > TARGET_CHANGE:
            found.append((time_s, desired))
        before = desired
    return found


def _slip_error(run: RunLog) -> float:
    """Return how far slip was from what was aimed for while speed was held back; NaN without an aim."""
    control = run.streams["control"]
    if "aimed_ratio" not in control.channels or "slip_ratio" not in control.channels:
        return math.nan
    held = control.channel("driven_mps") < control.channel("desired_mps") - 1e-6
    error = np.abs(control.channel("slip_ratio") - control.channel("aimed_ratio"))[held]
    return float(np.nanmean(error)) if np.isfinite(error).any() else math.nan


def _starts(course: Course, starts: Sequence[float]) -> dict[str, float]:
    """Judge the first start, before which nothing is known but the class, and the mean of those after it."""
    rows = []
    for start_s in starts:
        within = (course.time_s >= start_s) & (course.time_s < start_s + 7.0)
        rows.append(
            {
                "slip_peak": slip_peak(course, within),
                f"distance_{AFTER_S:g}s_m": distance_after(course, start_s, AFTER_S),
                f"energy_{FIRST_M:g}m_j": energy_to(course, FIRST_M, start_s),
            }
        )
    first, later = rows[0], rows[1:]
    return {
        **{f"first_{key}": value for key, value in first.items()},
        **{key: float(np.mean([row[key] for row in later])) for key in first},
    }


def drive(
    robot: Robot,
    table: SlipTable,
    settings: DriveSettings,
    model: TerrainModel | None = None,
    progress: Progress = silent,
    n_jobs: int = 2,
) -> dict[str, Any]:
    """Drive all controllers through the same days, and judge them.

    Parameters
    ----------
    robot : swerve robot
    table : targets
    settings : what is driven
    model : classifier, for ``learned``
    progress : told of each drive
    n_jobs : processes

    Returns
    -------
    dict that JSON can hold
        ``scenario, terrain, robot, table, seeds, delay_s, ramp_mps2`` and ``controllers``: by name, each of
        :data:`KEYS` and more with its ``mean``, ``ci`` (95 %, Student's law over seeds) and ``n``; ``rows``,
        the same a day, None where a day has none.

    Raises
    ------
    ConfigError
        if an option is not accepted.
    """
    settings.check(robot, table)
    ramp = settings.ramp_mps2
    named = [name for name in settings.controllers if name != "ramp"]
    drivers = {name: make_driver(name, table, settings.delay_s) for name in named}
    if model is None and any(driver.says == "classifier" for driver in drivers.values()):
        raise ConfigError("controller 'learned' needs a classifier: give a model")
    seeds = range(settings.first_seed, settings.first_seed + settings.seeds)
    n = len(seeds) * len(settings.controllers)
    rows = _drive_all(robot, list(drivers.values()), settings, seeds, model, n_jobs, progress, (0, n))
    if "ramp" in settings.controllers:
        if ramp is None:
            ramp = _matching_ramp(robot, table, settings, rows, n_jobs)
        driver = make_driver("ramp", table, settings.delay_s, ramp)
        done = len(seeds) * len(drivers)
        rows |= _drive_all(robot, [driver], settings, seeds, model, n_jobs, progress, (done, n))
    _share_distance(rows)
    return {
        "scenario": settings.scenario,
        "terrain": settings.terrain,
        "robot": robot.name,
        "table": table.name,
        "seeds": list(seeds),
        "delay_s": settings.delay_s,
        "grade_deg": settings.grade_deg,
        "ramp_mps2": ramp if "ramp" in settings.controllers else None,
        "controllers": {
            name: {
                key: _figure([row[key] for row in rows[name]]) for key in rows[name][0] if key != "_energy"
            }
            for name in settings.controllers
        },
        "rows": {
            name: [
                {key: _known(value) for key, value in row.items() if key != "_energy"} for row in rows[name]
            ]
            for name in settings.controllers
        },
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _drive_all(
    robot: Robot,
    drivers: Sequence[Driver],
    settings: DriveSettings,
    seeds: Sequence[int],
    model: TerrainModel | None,
    n_jobs: int,
    progress: Progress,
    count: tuple[int, int],
) -> dict[str, list[dict[str, Any]]]:
    from joblib import Parallel, delayed

    jobs = [(driver, seed) for seed in seeds for driver in drivers]
    rows: dict[str, list[dict[str, Any]]] = {driver.name: [] for driver in drivers}
    pool = Parallel(n_jobs=max(min(n_jobs, len(jobs)), 1), return_as="generator")
    work = pool(
        delayed(_job)(robot, driver, settings, seed, model if driver.says == "classifier" else None)
        for driver, seed in jobs
    )
    for done, ((driver, _), row) in enumerate(zip(jobs, work, strict=True)):
        rows[driver.name].append(row)
        progress("drive", count[0] + done + 1, count[1])
    return rows


def _job(
    robot: Robot,
    driver: Driver,
    settings: DriveSettings,
    seed: int,
    model: TerrainModel | None,
) -> dict[str, Any]:
    where = settings.situation(robot, seed)
    run = drive_once(robot, driver, where, settings.delay_s, model, plant=settings.plant)
    plant = settings.plant or robot
    course = course_of(run, plant, where.conditions.radius_factors)
    row: dict[str, Any] = judge(run, course, plant, where, driver)
    if settings.scenario == SLOPE:
        row["steepest_deg"] = steepest(robot, driver, settings, seed, model)
    driven = course.time_s <= desired_until(where.scenario)  # a coast after the last stop costs nothing
    row["_energy"] = (np.maximum.accumulate(course.distance_m[driven]), course.energy_j[driven])
    return row


def steepest(
    robot: Robot, driver: Driver, settings: DriveSettings, seed: int, model: TerrainModel | None = None
) -> float:
    """Return the steepest grade in degrees that a driver climbs, by bisection to a tenth of a degree."""
    low, high = -STEEPEST_DEG, STEEPEST_DEG
    for _ in range(SLOPE_STEPS + 1):
        middle = (low + high) / 2
        run = drive_once(
            robot,
            driver,
            settings.situation(robot, seed, middle),
            settings.delay_s,
            model,
            plant=settings.plant,
        )
        truth = run.streams["truth"]
        last = truth.time_s > truth.time_s[-1] - 1.0
        low, high = (middle, high) if truth.channel("speed_x_mps")[last].mean() > 0.05 else (low, middle)
    return low


def _matching_ramp(
    robot: Robot,
    table: SlipTable,
    settings: DriveSettings,
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    n_jobs: int,
) -> float:
    """Return the ramp that gets as far as the first of ours among the controllers, on the same days."""
    kinds = ("oracle", "learned", "fixed")
    ours = [name for kind in kinds for name in rows if name in (kind, f"{kind}+track")]
    others = [name for name in rows if name.startswith(("told:", "target:"))]
    if not ours + others:
        return PilotSettings().ramp_mps2
    key = f"distance_{AFTER_S:g}s_m" if settings.scenario == "starts" else "distance_m"
    desired = np.mean([row[key] for row in rows[(ours + others)[0]]])
    seeds = range(settings.first_seed, settings.first_seed + settings.seeds)
    low, high = 0.1, 2.0 * settings.accel_mps2 if math.isfinite(settings.accel_mps2) else 10.0
    for _ in range(7):
        middle = math.sqrt(low * high)
        driver = make_driver("ramp", table, settings.delay_s, middle)
        got = _drive_all(robot, [driver], settings, seeds, None, n_jobs, silent, (0, 1))
        short = np.mean([row[key] for row in got["ramp"]]) < desired
        low, high = (middle, high) if short else (low, middle)
    return math.sqrt(low * high)


def _share_distance(rows: Mapping[str, list[dict[str, Any]]]) -> None:
    """Add ``energy_j_per_m``, over the way that all made that day who made half of the longest.

    It depends on who else is driven, as the way does; one who made less than half has none that day.
    """
    for day in zip(*rows.values(), strict=True):
        ways = [float(row["_energy"][0][-1]) for row in day]
        shared = min(way for way in ways if way >= max(ways) / 2)
        for row, way in zip(day, ways, strict=True):
            distance, energy = row["_energy"]
            row["energy_j_per_m"] = (
                float(np.interp(shared, distance, energy) / shared) if way >= shared > 0.0 else math.nan
            )


def example_runs(
    robot: Robot,
    table: SlipTable,
    settings: DriveSettings,
    ramp_mps2: float | None = None,
    model: TerrainModel | None = None,
) -> dict[str, RunLog]:
    """Return each controller's drive on the first day, to be looked at."""
    where = settings.situation(robot, settings.first_seed)
    ramp = PilotSettings().ramp_mps2 if ramp_mps2 is None else ramp_mps2
    drivers = [make_driver(name, table, settings.delay_s, ramp) for name in settings.controllers]
    return {
        driver.name: drive_once(robot, driver, where, settings.delay_s, model, driver.name, settings.plant)
        for driver in drivers
    }


def _figure(values: Sequence[float]) -> dict[str, Any]:
    """Return mean and 95 % interval of a figure over days; None where no day has it."""
    known = np.array([value for value in values if math.isfinite(value)])
    if not known.size:
        return {"mean": None, "ci": None, "n": 0}
    mean = float(known.mean())
    if known.size == 1:
        return {"mean": mean, "ci": None, "n": 1}
    half = float(student.ppf(0.975, known.size - 1) * known.std(ddof=1) / math.sqrt(known.size))
    return {"mean": mean, "ci": [mean - half, mean + half], "n": int(known.size)}
