"""``terrain drive``: controllers side by side in the closed loop, in the same situations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pipelines.drive.controller_names import TRACK
from pipelines.drive.controllers import (
    DEFAULT_RAMP_MPS2,
    Controller,
    DriveInputs,
    Source,
    drive_once,
    make_controller,
    train_classifier,
)
from pipelines.drive.results import DriveResult
from pipelines.drive.settings import DriveSettings
from pipelines.live.pilot import LivePilot
from pipelines.reporting.progress import Progress, silent
from terrain.control.comparison import mean_interval
from terrain.control.drive_evaluation import (
    START_TIME_S,
    EnergyCurve,
    energy_at_equal_distance,
    energy_curve,
    evaluate_drive,
)
from terrain.control.drive_metrics import drive_history
from terrain.control.situations import SLOPE, STARTS, Situation, SituationOptions, make_situation
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import load_robot

STEEPEST_DEG, SLOPE_STEPS = 25.0, 9
"""Range of the search for the steepest grade, and its bisections: to a tenth of a degree."""

CLIMBING_MPS = 0.05
"""A robot that is faster than this in the last second climbs."""

LEAST_RAMP_MPS2, MOST_RAMP_MPS2, RAMP_STEPS = 0.1, 10.0, 7
"""Range of the search for the matching ramp (up to twice the desired rise, where that is finite), and its
bisections."""

REFERENCES = ("true_terrain", "classified", "fallback")
"""Controllers whose distance the ramp matches: the first of them that is driven."""


class Drive(NamedTuple):
    """Metrics of one drive by name, and its energy over distance."""

    metrics: dict[str, float]
    energy: EnergyCurve


def load_inputs(settings: DriveSettings) -> DriveInputs:
    """Return robots and table, without a classifier.

    Raises
    ------
    TerrainError
        if one cannot be read, or the table is another robot's.
    """
    robot = load_robot(settings.robot)
    plant = None if settings.plant is None else load_robot(settings.plant)
    return DriveInputs(robot, load_slip_table(settings.table, robot.name), plant=plant)


def with_classifier(settings: DriveSettings, inputs: DriveInputs, progress: Progress = silent) -> DriveInputs:
    """Return the inputs with the classifier of the settings, or a newly trained one, where one is needed."""
    if not settings.needs_model:
        return inputs
    if settings.model is None:
        return replace(inputs, model=train_classifier(inputs.robot, settings.first_seed, progress))
    from pipelines.models.tracking import load_model

    return replace(inputs, model=load_model(settings.model))


def check_drive(settings: DriveSettings, inputs: DriveInputs) -> None:
    """Refuse what cannot be driven.

    Raises
    ------
    ConfigError
        if a controller does not exist on the robot or the table, or the situation does not.
    """
    for controller in _controllers(settings, inputs, settings.controllers):
        LivePilot(inputs.robot, controller.table, None, controller.pilot)
    _situation(settings, inputs, settings.first_seed)


def drive(settings: DriveSettings, inputs: DriveInputs, progress: Progress = silent) -> DriveResult:
    """Drive all controllers at the same seeds, and evaluate them.

    Parameters
    ----------
    settings : what is driven
    inputs : robots, table, and the classifier where a controller needs one
    progress : of the drives

    Raises
    ------
    ConfigError
        if a setting is not accepted.
    """
    check_drive(settings, inputs)
    names = settings.controllers
    controllers = _controllers(settings, inputs, [name for name in names if name != "ramp"])
    for one in controllers:
        if one.source is Source.CLASSIFIER and inputs.model is None:
            raise ConfigError(f"controller {one.name!r} needs a classifier: give a model")
    count = _counter(progress, settings.seeds * len(names))
    drives = _drive_all(settings, inputs, controllers, count)
    ramp_mps2 = None
    if "ramp" in names:
        ramp_mps2 = settings.ramp_mps2
        if ramp_mps2 is None:
            ramp_mps2 = _matching_ramp(settings, inputs, drives)
        drives |= _drive_all(settings, inputs, _controllers(settings, inputs, ["ramp"], ramp_mps2), count)
    for at_one_seed in zip(*drives.values(), strict=True):
        energies = energy_at_equal_distance([one.energy for one in at_one_seed])
        for one, energy in zip(at_one_seed, energies, strict=True):
            one.metrics["energy_j_per_m"] = energy
    rows = {name: tuple(one.metrics for one in drives[name]) for name in names}
    return DriveResult(
        scenario=settings.scenario,
        terrain=settings.terrain,
        robot=inputs.robot.name,
        table=inputs.table.name,
        seeds=tuple(_seeds(settings)),
        delay_s=settings.delay_s,
        grade_deg=settings.grade_deg,
        ramp_mps2=ramp_mps2,
        controllers={
            name: {key: mean_interval([row[key] for row in rows[name]]) for key in rows[name][0]}
            for name in names
        },
        rows=rows,
    )


def example_runs(settings: DriveSettings, inputs: DriveInputs, ramp_mps2: float | None) -> dict[str, RunLog]:
    """Return the drive of each controller at the first seed."""
    situation = _situation(settings, inputs, settings.first_seed)
    return {
        one.name: drive_once(inputs, one, situation, one.name)
        for one in _controllers(settings, inputs, settings.controllers, ramp_mps2)
    }


def _seeds(settings: DriveSettings) -> range:
    return range(settings.first_seed, settings.first_seed + settings.seeds)


def _situation(
    settings: DriveSettings, inputs: DriveInputs, seed: int, grade_deg: float | None = None
) -> Situation:
    options = SituationOptions(
        duration_s=settings.duration_s,
        speed_mps=settings.speed_mps,
        accel_mps2=settings.accel_mps2,
        grade_deg=settings.grade_deg if grade_deg is None else grade_deg,
        radius_factors=settings.radius_factors,
        leg_backlash_rad=settings.leg_backlash_rad,
    )
    return make_situation(settings.scenario, inputs.simulated, settings.terrain, seed, options)


def _controllers(
    settings: DriveSettings, inputs: DriveInputs, names: Sequence[str], ramp_mps2: float | None = None
) -> list[Controller]:
    ramp_mps2 = settings.ramp_mps2 if ramp_mps2 is None else ramp_mps2
    ramp_mps2 = DEFAULT_RAMP_MPS2 if ramp_mps2 is None else ramp_mps2
    return [make_controller(name, inputs.table, settings.delay_s, ramp_mps2) for name in names]


def _counter(progress: Progress, total: int) -> Callable[[], None]:
    """Return a function that reports one drive more."""
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        progress("drive", done, total)

    return count


def _drive_all(
    settings: DriveSettings,
    inputs: DriveInputs,
    controllers: Sequence[Controller],
    count: Callable[[], None],
) -> dict[str, list[Drive]]:
    """Return the drives of each controller, one a seed, in as many processes as the settings say."""
    from joblib import Parallel, delayed

    jobs = [(controller, seed) for seed in _seeds(settings) for controller in controllers]
    drives: dict[str, list[Drive]] = {controller.name: [] for controller in controllers}
    pool = Parallel(n_jobs=max(min(settings.n_jobs, len(jobs)), 1), return_as="generator")
    without_model = replace(inputs, model=None)  # which is large to send to another process
    work = pool(
        delayed(_drive_one)(
            settings, inputs if controller.source is Source.CLASSIFIER else without_model, controller, seed
        )
        for controller, seed in jobs
    )
    for (controller, _), one in zip(jobs, work, strict=True):
        drives[controller.name].append(one)
        count()
    return drives


def _drive_one(settings: DriveSettings, inputs: DriveInputs, controller: Controller, seed: int) -> Drive:
    situation = _situation(settings, inputs, seed)
    run = drive_once(inputs, controller, situation)
    history = drive_history(run, inputs.simulated, situation.conditions.radius_factors)
    adapting_to = controller.table if controller.adapts else None
    metrics = evaluate_drive(run, history, inputs.simulated, situation, adapting_to)
    if settings.scenario == SLOPE:
        metrics["steepest_deg"] = steepest(settings, inputs, controller, seed)
    return Drive(metrics, energy_curve(history, situation.scenario))


def steepest(settings: DriveSettings, inputs: DriveInputs, controller: Controller, seed: int) -> float:
    """Return the steepest grade in degrees that a controller climbs, by bisection."""
    low, high = -STEEPEST_DEG, STEEPEST_DEG
    for _ in range(SLOPE_STEPS):
        middle = (low + high) / 2
        truth = drive_once(inputs, controller, _situation(settings, inputs, seed, middle)).streams["truth"]
        last = truth.time_s > truth.time_s[-1] - 1.0
        climbs = truth.channel("speed_x_mps")[last].mean() > CLIMBING_MPS
        low, high = (middle, high) if climbs else (low, middle)
    return low


def _matching_ramp(
    settings: DriveSettings, inputs: DriveInputs, drives: Mapping[str, Sequence[Drive]]
) -> float:
    """Return the ramp that travels as far as the first reference among the controllers, at the same seeds."""
    references = [name for kind in REFERENCES for name in drives if name in (kind, f"{kind}{TRACK}")]
    references += [name for name in drives if name.startswith(("known:", "target:"))]
    if not references:
        return DEFAULT_RAMP_MPS2
    key = f"distance_{START_TIME_S:g}s_m" if settings.scenario == STARTS else "distance_m"

    def distance_m(found: Sequence[Drive]) -> float:
        return float(np.mean([one.metrics[key] for one in found]))

    desired_m = distance_m(drives[references[0]])
    low = LEAST_RAMP_MPS2
    high = 2.0 * settings.accel_mps2 if math.isfinite(settings.accel_mps2) else MOST_RAMP_MPS2
    for _ in range(RAMP_STEPS):
        middle = math.sqrt(low * high)
        ramp = _controllers(settings, inputs, ["ramp"], middle)
        short = distance_m(_drive_all(settings, inputs, ramp, lambda: None)["ramp"]) < desired_m
        low, high = (middle, high) if short else (low, middle)
    return math.sqrt(low * high)
