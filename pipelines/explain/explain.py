"""Find what a robot's simulation gets wrong about measured runs, extend it, and measure the gain."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.explain.classifier import classifier_gain
from pipelines.explain.ground import ground_notes, simulation_for
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest
from terrain.discrepancy.diagnose import INTERVAL_T, MIN_RUNS, diagnose
from terrain.discrepancy.extend import extend
from terrain.discrepancy.gain import gain
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.residuals import INPUTS, LowPass, Rows, low_pass_of, rows_of
from terrain.discrepancy.search import Problem
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import Diagnosis
from terrain.effects import Effect, effect_named, library_of
from terrain.errors import ConfigError, DataError, TerrainError
from terrain.extension import extended_yaml
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.records import Array, RunLog
from terrain.robots import Robot, load_robot

if TYPE_CHECKING:
    from terrain.estimation.estimate import Estimate

HOLD_OUT_FROM, HOLD_OUT_EVERY = 6, 4
"""Runs from which on a gain is measured, and every how many of them is kept for it."""

PAGE_FILE, EXTENDED_FILE, NEXT_FILE, PICTURES = (
    "explain.html",
    "extended.yaml",
    "next_drive.yaml",
    "pictures",
)
FILTERS = {"swerve": "vio12", "skid_steer": "skid"}
"""Whose error is compared before and after, where runs have a truth."""

ERRORS = ("speed_mps", "yaw_rate_radps", "slip_ratio")
"""That are compared: root mean squares of speed and yaw rate, and by how much the mean slip is off."""


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """A diagnosis with all that its page is made from.

    Parameters
    ----------
    diagnosis : what was found
    simulation, extended : before and after; ``extended`` is None where no cause was named
    used, held_out : runs behind the diagnosis, and those kept from it
    noise, low_pass : of the runs behind the diagnosis
    result : what ``--json`` holds
    """

    diagnosis: Diagnosis
    simulation: Simulation
    extended: Simulation | None
    used: tuple[RunLog, ...]
    held_out: tuple[RunLog, ...]
    noise: Noise
    low_pass: LowPass
    result: dict[str, Any]


def explain(
    runs: Sequence[RunLog],
    robot_name: str,
    out: Path,
    *,
    model: str | None = None,
    effects: Sequence[str] | None = None,
    terrain: str | None = None,
    hold_out: int | None = None,
    seed: int = 0,
    dataset: str = "",
    classifier: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Diagnose runs, extend the simulation, measure the gain, and write the page.

    Parameters
    ----------
    runs : of the robot
    robot_name : name of a robot or path of its YAML file
    out : folder of the page, its pictures and, where causes were named, the extended description
    model : YAML file of an extended description that is tested in its place
    effects : names of those that may be named; all by default
    terrain : label of the runs that are looked at; all by default
    hold_out : runs kept for the gain; a quarter of six or more by default
    seed : of which runs are kept, and of the bootstrap
    dataset : name of the data set, for the record
    classifier : measure what the extension is worth to a classifier taught in simulation, too
    progress : told of steps that are done

    Returns
    -------
    dict that JSON can hold
        that of :meth:`terrain.discrepancy.verdict.Diagnosis.as_json` with ``data, data_digest, model,
        built_in, grounds, notes, terrain, effects, seed, used, held_out, gain, extended, page``.

    Raises
    ------
    ConfigError
        if the robot, the model or an effect is not accepted, or ``out`` has an extended description already.
    DataError
        if the runs are of another robot, too few, or cannot be compared with the simulation.
    TerrainError
        if ``out`` cannot be written.
    """
    from pipelines.explain.page import write_explain_page

    robot = _robot(robot_name, model)
    library = _library(robot, effects)
    if (out / EXTENDED_FILE).exists():
        raise ConfigError(
            f"{out / EXTENDED_FILE}: is there already, and is left as it is; choose another --out"
        )
    ensure_writable(out)
    chosen = _of_terrain(runs, terrain)
    _check_robots(chosen, robot)
    found = explained(
        chosen, robot, library, hold_out=hold_out, seed=seed, classifier=classifier, progress=progress
    )
    described = model or robot_name
    result: dict[str, Any] = {
        "data": dataset,
        "data_digest": data_digest(runs),
        **found.result,
        "description": str(described),
        "model": model,
        "terrain": terrain,
        "page": str(out / PAGE_FILE),
    }
    text = None
    if found.extended is not None:
        values, cov, intervals = extended_numbers(robot, found.diagnosis)
        source = f"terrain explain, {found.diagnosis.n_runs} runs of {dataset or 'a data set'}"
        text = extended_yaml(described, values, cov, intervals, source)
        result["extended"] = {"file": str(out / EXTENDED_FILE), "effects": values}
    write_explain_page(out, found, result, progress)
    if text is not None:
        atomic_write(out / EXTENDED_FILE, text)
    _write_next_drive(out, found.diagnosis)
    return result


def explained(
    runs: Sequence[RunLog],
    robot: Robot,
    library: Sequence[Effect],
    *,
    hold_out: int | None = None,
    seed: int = 0,
    classifier: bool = False,
    progress: Progress = silent,
) -> Explained:
    """Return the diagnosis of runs and the gain; see :func:`explain`."""
    runs = [with_wheel_speeds(run, robot) for run in sorted(runs, key=lambda run: run.run_id)]
    used, held = split_runs(runs, hold_out, seed)
    simulation, grounds = simulation_for(used, robot, library)
    diagnosis = diagnose(used, simulation, library)
    progress("diagnose", 1, 1)
    extended = extend(simulation, diagnosis) if diagnosis.causes else None
    told: dict[str, Any]
    if extended is None:
        told = {"measured": False, "reason": "no cause was named, so that nothing was built in"}
    elif not held:
        told = {
            "measured": False,
            "reason": f"no run was kept from the diagnosis ({len(runs)} runs; {HOLD_OUT_FROM} or more, or "
            "--hold-out, keep some)",
        }
    else:
        try:
            told = {"measured": True, **gain(simulation, extended, held, seed).as_json()}
        except DataError as error:
            told = {"measured": False, "reason": str(error)}
        told["filter"] = filter_gain(held, robot, extended, seed)
        if classifier:
            told["classifier"] = classifier_gain(
                held, robot, simulation.effects, extended.effects, seed, progress=progress
            )
        progress("gain", 1, 1)
    gone = {run.run_id for run in diagnosis.excluded_runs}
    signals = tuple(signals_of(run, robot) for run in used if run.run_id not in gone)
    low_pass = low_pass_of(signals)
    problem = Problem(signals, simulation, low_pass, tuple(library))
    noise = problem.at(simulation.vector).noise
    result = diagnosis.as_json() | {
        "built_in": dict(simulation.effects),
        "grounds": grounds,
        "notes": ground_notes(grounds),
        "effects": [effect.name for effect in library],
        "seed": seed,
        "used": [run.run_id for run in used],
        "held_out": [run.run_id for run in held],
        "gain": told,
        "extended": None,
    }
    return Explained(diagnosis, simulation, extended, tuple(used), tuple(held), noise, low_pass, result)


def split_runs(runs: Sequence[RunLog], hold_out: int | None, seed: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return the runs for the diagnosis and those kept for the gain.

    Runs are put in an order drawn by the seed, terrain after terrain, and of ``n`` that are kept every
    ``len(runs) / n``-th is taken: each terrain gives its share.

    Raises
    ------
    DataError
        if too few would be left.
    """
    n = hold_out
    if n is None:
        n = math.ceil(len(runs) / HOLD_OUT_EVERY) if len(runs) >= HOLD_OUT_FROM else 0
    elif n and len(runs) - n < MIN_RUNS:
        raise DataError(
            f"--hold-out is {n} of {len(runs)} runs; the diagnosis wants {MIN_RUNS} at the least for itself"
        )
    if not n:
        return list(runs), []
    drawn = np.random.default_rng(seed).permutation(len(runs))
    order = sorted(drawn, key=lambda i: runs[i].terrains)
    kept = {order[k * len(runs) // n] for k in range(n)}
    used = [run for i, run in enumerate(runs) if i not in kept]
    return used, [run for i, run in enumerate(runs) if i in kept]


def filter_gain(
    runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int
) -> dict[str, Any] | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs of a run's own root mean square (speed) or mean (slip) error, and the interval
    is that of the difference, by bootstrap over runs.
    """
    from dataclasses import replace

    from terrain.estimation.estimate import estimate_run

    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    rows: list[list[tuple[float, ...]]] = []
    try:
        for run in known:
            rows.append([_errors(estimate_run(run, one, name)) for one in (robot, better)])
    except TerrainError as error:
        return {"name": name, "reason": str(error), "errors": {}}
    table = np.array(rows)  # (runs, 2, errors)
    weights = np.random.default_rng(seed).multinomial(len(rows), np.full(len(rows), 1 / len(rows)), 2000)
    errors = {}
    for k, key in enumerate(ERRORS):
        both = table[:, :, k]
        if np.isfinite(both).all():
            low, high = np.quantile(weights @ (both[:, 1] - both[:, 0]) / len(rows), [0.025, 0.975])
            errors[key] = {
                "before": float(both[:, 0].mean()),
                "after": float(both[:, 1].mean()),
                "change_ci": [float(low), float(high)] if len(rows) > 1 else None,
            }
    return {"name": name, "reason": None, "n_runs": len(rows), "errors": errors}


def _errors(found: Estimate) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    from terrain.estimation.summary import summarize

    summary, track, truth = summarize(found), found.track, found.run.streams["truth"]
    squares = dict.fromkeys(("speed", "yaw_rate"), np.zeros(len(track.time_s)))
    for state in track.states:
        kind = state.removesuffix("_mps").removesuffix("_radps").removesuffix("_x").removesuffix("_y")
        if kind in squares:
            true = truth.channel("speed_x_mps" if state == "speed_mps" else state)
            off = track.state(state) - np.interp(track.time_s, truth.time_s, true)
            squares[kind] = squares[kind] + off**2
    rms = [math.sqrt(float(np.nanmean(square))) for square in squares.values()]
    slip_error = abs(summary.slip_mean - summary.slip_true_mean)
    return (*rms, slip_error if summary.slip_observable else math.nan)


def extended_numbers(
    robot: Robot, diagnosis: Diagnosis
) -> tuple[dict[str, float], Array, dict[str, tuple[float, float]]]:
    """Return values, covariance and intervals of all effects of the extended robot.

    What the description had of a parameter that was found again gives way, with its covariance, to what the
    runs say; what was not touched stays, and the two are taken as independent.
    """
    names = list(dict.fromkeys([*robot.effects, *diagnosis.parameters]))
    cov = np.zeros((len(names), len(names)))
    old = [names.index(name) for name in robot.effects]
    new = [names.index(name) for name in diagnosis.parameters]
    cov[np.ix_(old, old)] = robot.effects_cov
    cov[new], cov[:, new] = 0.0, 0.0
    cov[np.ix_(new, new)] = diagnosis.cov
    if not np.isfinite(cov).all():
        raise ConfigError(
            f"robot {robot.name}: its effects have no covariance, without which an extended description "
            "cannot say how sure it is"
        )
    found = diagnosis.values
    values = {name: robot.effects.get(name, 0.0) + found.get(name, 0.0) for name in names}
    halves = INTERVAL_T * np.sqrt(cov.diagonal())
    intervals = {
        name: (values[name] - float(half), values[name] + float(half))
        for name, half in zip(names, halves, strict=True)
    }
    return values, cov, intervals


def rows_before_after(found: Explained, run: RunLog) -> tuple[Rows, Rows | None]:
    """Return a run behind the low-pass, with the simulation that was given and with the extended one."""
    signals = signals_of(run, found.simulation.robot)
    planar = found.simulation.planar_on(signals.terrain)
    before = rows_of(signals, planar, found.simulation.vector, (), found.low_pass)
    if found.extended is None:
        return before, None
    return before, rows_of(signals, planar, found.extended.vector, (), found.low_pass)


def inputs_of(rows: Rows) -> dict[str, Array]:
    """Return what residuals are drawn against, by name and unit."""
    words = {
        "speed_mps": "speed [m/s]",
        "turn_mps": "turn [m/s]",
        "steer_rad": "steering [rad]",
        "grade_rad": "grade [rad]",
        "roll_rad": "roll [rad]",
        "force_ratio": "force [weight]",
    }
    columns = {words[name]: rows.inputs[:, i] for i, name in enumerate(INPUTS) if name in words}
    return columns | {"time [s]": rows.time_s}


def _robot(robot_name: str, model: str | None) -> Robot:
    robot = load_robot(robot_name)
    if model is None:
        return robot
    extended = load_robot(model)
    if extended.name != robot.name:
        raise ConfigError(f"--model is of the robot {extended.name!r}, --robot is {robot.name!r}")
    if extended.effects and not np.isfinite(extended.effects_cov).all():
        raise ConfigError(f"{model}: its effects have no covariance, which a model that is tested needs")
    return extended


def _library(robot: Robot, names: Sequence[str] | None) -> tuple[Effect, ...]:
    there = library_of(robot.drive)
    if names is None:
        return there
    desired = [effect_named(name) for name in names]
    if not desired:
        raise ConfigError("--effects names none; leave it out for all of them")
    for effect in desired:
        if effect not in there:
            raise ConfigError(
                f"effect {effect.name} does not apply to a robot with the drive {robot.drive!r}"
            )
    return tuple(effect for effect in there if effect in desired)


def _of_terrain(runs: Sequence[RunLog], terrain: str | None) -> list[RunLog]:
    if not runs:
        raise DataError("there is no run to look at")
    if terrain is None:
        return list(runs)
    chosen = [run for run in runs if run.terrains == (terrain,)]
    if not chosen:
        labels = sorted({name for run in runs for name in run.terrains})
        raise DataError(
            f"no run is labelled {terrain!r} throughout; labels are {', '.join(labels) if labels else 'none'}"
        )
    return chosen


def _check_robots(runs: Sequence[RunLog], robot: Robot) -> None:
    others = Counter(run.robot for run in runs if run.robot != robot.name)
    if others:
        (name, n), *_ = others.most_common(1)
        raise DataError(
            f"{n} of {len(runs)} runs are of the robot {name!r}; the simulation is of {robot.name!r}"
        )


def _write_next_drive(out: Path, diagnosis: Diagnosis) -> None:
    import yaml

    if diagnosis.next_drive is None:
        (out / NEXT_FILE).unlink(missing_ok=True)  # an earlier page's
        return
    text = yaml.safe_dump(diagnosis.next_drive._asdict(), sort_keys=False, allow_unicode=True, width=10_000)
    atomic_write(out / NEXT_FILE, text)
