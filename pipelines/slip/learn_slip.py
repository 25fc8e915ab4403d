"""``terrain learn-slip``: from labelled runs to slip curves, and to the table that control reads."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median_low
from typing import Any, NamedTuple

import numpy as np

from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest
from terrain.control.slip_table import (
    DRIVE_STATES,
    SIGN,
    CurveEntry,
    SlipTable,
    load_slip_table,
    write_slip_table,
)
from terrain.errors import ConfigError, DataError
from terrain.estimation.estimate import filter_run
from terrain.estimation.wheel_slip import wheel_speed_scatter_mps
from terrain.extension import correct
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog, SlipTarget
from terrain.robots import Robot, as_swerve, load_robot
from terrain.slip_learning.slip_curve import (
    LAW_PARAMETERS,
    N_BOOTSTRAP,
    RunBins,
    SlipCurve,
    contradiction,
    learn_curve,
    run_bins,
    slip_range,
    too_little,
)
from terrain.slip_learning.targets import Targets, energy_jpm, targets_of, tractive_efficiency
from terrain.slip_learning.wheel_pull import Balance, body_balance, pull_samples, wheel_pull

FILTER = "vio15"
FALLBACK = "unknown"
PAGE_FILE = "slip.html"
DIGITS = 4
"""Of slips and shares of load in the table: a hundredth of what is known of them."""


class RunPart(NamedTuple):
    """What one run says of one terrain."""

    run_id: str
    terrain: str
    bins: RunBins
    balance: Balance
    left_out: dict[str, int]
    n_samples: int


class Learned(NamedTuple):
    """What was learned of one terrain; where ``curve`` or ``targets`` are None, ``reason`` says why."""

    terrain: str
    parts: list[RunPart]
    status: str
    reason: str
    curve: SlipCurve | None
    targets: Targets | None


def learn_slip(
    runs: Sequence[RunLog],
    robot_name: str,
    out: Path,
    *,
    dataset: str = "",
    figures: Path | None = None,
    seed: int = 0,
    skip_faulty: bool = False,
    on_skip: Callable[[str], None] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn the table, write it, draw the curves and log all of it with MLflow.

    Parameters
    ----------
    runs : labelled logs of the robot, with motor currents
    robot_name : name of a swerve robot or path of its YAML file
    out : YAML file of the table; what is there is replaced at once, when all is done
    dataset : name of the data set, for the record
    figures : folder of the pictures and of a page with them; without, only MLflow gets the pictures
    seed : of the bootstrap
    skip_faulty : leave a run out that lacks what is needed, and tell ``on_skip``, in place of refusing
    progress : told of runs and terrains that are done

    Returns
    -------
    dict that JSON can hold
        ``table, robot, filter, seed, dataset, data_digest, n_runs, runs, terrains, fallback,
        tracking_run_id``; a terrain has ``status, reason, n_runs, slip_range, peak_slip, peak_slip_ci,
        peak_status, law, parameters, targets`` and what else the table holds, None where it is not known.

    Raises
    ------
    ConfigError
        if the robot is no swerve robot or lacks a section, or ``out`` is a folder.
    DataError
        if no run has a label, or one is another robot's or lacks currents or attitude.
    TerrainError
        if a folder cannot be written.
    """
    from pipelines.models.tracking import code_commit, ensure_tracking, log_learning
    from pipelines.slip.figures import curve_figures

    refusal = "robot {name} has the drive {drive!r}: slip curves are learned for 'swerve' alone"
    robot = as_swerve(load_robot(robot_name), refusal)
    robot.require(*robot.sections)
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; --out names the file of the table")
    ensure_writable(out.parent)
    if figures is not None:
        ensure_writable(figures)
    ensure_tracking()
    labelled = [run for run in runs if run.labels]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: what is learned is learned of a terrain")
    parts: list[RunPart] = []
    used: list[RunLog] = []
    for done, run in enumerate(labelled, start=1):
        try:
            parts += run_parts(run, robot)
            used.append(run)
        except DataError as error:
            if not skip_faulty:
                raise
            if on_skip is not None:
                on_skip(f"run skipped: {error}")
        progress("filter", done, len(labelled))
    if not used:
        raise DataError("not one run has what slip curves are learned from: labels, currents and attitude")
    terrains = sorted({part.terrain for part in parts})
    learned = []
    for done, terrain in enumerate(terrains, start=1):
        learned.append(learn_terrain(terrain, [part for part in parts if part.terrain == terrain], seed))
        progress("learn", done, len(terrains))
    table = table_of(learned, robot, name=out.stem)
    rows = {entry.terrain: terrain_row(entry, table) for entry in learned}
    digest = data_digest(used)
    drawn = curve_figures(learned, robot.name)
    write_slip_table(table, out)
    files = _write_figures(drawn, figures)
    if figures is not None:
        from pipelines.slip.page import slip_page

        atomic_write(figures / PAGE_FILE, slip_page(rows, drawn, table, len(used)))
        files.append(str(figures / PAGE_FILE))
    run_id = log_learning(
        out.stem,
        {
            "robot": robot.name,
            "filter": FILTER,
            "n_bootstrap": N_BOOTSTRAP,
            "dataset": dataset,
            "n_runs": len(used),
        },
        _metrics(rows),
        {"data_digest": digest, "commit": code_commit(), "seed": str(seed), "kind": "slip table"},
        {out.name: out.read_text(encoding="utf-8")},
        {"learn_slip.json": {"terrains": rows}},
        drawn,
    )
    return {
        "table": str(out),
        "robot": robot.name,
        "filter": FILTER,
        "seed": seed,
        "dataset": dataset,
        "data_digest": digest,
        "n_runs": len(used),
        "n_unlabelled": len(runs) - len(labelled),
        "runs": [_run_row(part) for part in parts],
        "terrains": rows,
        "fallback": {state: table.targets[FALLBACK][state].slip_ratio for state in DRIVE_STATES},
        "figures": files,
        "tracking_run_id": run_id,
    }


def run_parts(run: RunLog, robot: Robot) -> list[RunPart]:
    """Return what a run says of each terrain it is labelled with.

    Raises
    ------
    DataError
        if it is another robot's, or lacks currents or attitude.
    """
    if run.robot != robot.name:
        raise DataError(
            f"run {run.run_id} is of robot {run.robot!r}: a table is learned for one, {robot.name!r}"
        )
    run, robot = correct(run, robot)
    found = filter_run(run, robot, FILTER)
    pull = wheel_pull(run, robot, found.track, found.table, found.slip)
    parts = []
    for terrain in run.terrains:
        on = pull.on(run.labels, terrain)
        balance = body_balance(pull, robot, on)
        samples = pull_samples(pull, balance.mass_kg, on, wheel_speed_scatter_mps(robot))
        left_out = Counter({name: int((~good[on]).sum()) for name, good in pull.sound.items()})
        bins = run_bins(run.run_id, samples)
        parts.append(RunPart(run.run_id, terrain, bins, balance, dict(left_out), len(samples)))
    return parts


def learn_terrain(
    terrain: str, parts: Sequence[RunPart], seed: int, n_bootstrap: int = N_BOOTSTRAP
) -> Learned:
    """Return what runs tell of one terrain; coverage is asked for before anything is believed."""
    held = [part for part in parts if len(part.bins.slip_ratio)]
    bins = [part.bins for part in held]
    if (why := too_little(bins)) is not None:
        return Learned(terrain, list(parts), "unestimated", why, None, None)
    resistance = np.array([[part.balance.resistance_ratio, part.balance.resistance_std] for part in held])
    if not np.isfinite(resistance).all(axis=1).any():
        why = "no run drove straight on for long enough to tell the resistance"
        return Learned(terrain, list(parts), "unestimated", why, None, None)
    curve = learn_curve(bins, resistance, np.random.default_rng(seed), n_bootstrap)
    if (why := contradiction(curve)) is not None:
        return Learned(terrain, list(parts), "invalid", why, curve, None)
    return Learned(terrain, list(parts), "estimated", "", curve, targets_of(curve))


def table_of(learned: Sequence[Learned], robot: Robot, name: str) -> SlipTable:
    """Return the table: learned numbers, assumed ones where nothing was learned, and the fallback.

    The fallback is for ground that nobody knows: of each drive state the lower median of the estimated
    terrains' numbers, and the packaged table's own without any.  Not the least of them: on soft ground the
    slip of tiles would not overcome the resistance.
    """
    default = load_slip_table()
    targets: dict[str, dict[str, SlipTarget]] = {}
    curves, reasons = {}, {}
    for entry in learned:
        if entry.curve is not None and entry.targets is not None:
            targets[entry.terrain] = _learned_targets(entry.terrain, entry.targets, entry.curve.n_runs)
            curves[entry.terrain] = curve_entry(entry.curve, entry.targets, robot)
            continue
        reasons[entry.terrain] = entry.reason
        assumed = default.lookup(entry.terrain)
        targets[entry.terrain] = {
            state: SlipTarget(
                entry.terrain,
                state,
                assumed[state].slip_ratio,
                math.nan,
                0,
                entry.status,
                f"table {default.name}, {assumed[state].terrain}: {assumed[state].source}",
            )
            for state in DRIVE_STATES
        }
    reasons.setdefault(FALLBACK, "stands in for ground that is not known")
    targets.setdefault(FALLBACK, _fallback(targets, default))
    return SlipTable(name, FALLBACK, targets, robot.name, curves, reasons)


def _learned_targets(terrain: str, targets: Targets, n_runs: int) -> dict[str, SlipTarget]:
    return {
        state: SlipTarget(
            terrain,
            state,
            round(getattr(targets, state).slip_ratio, DIGITS),
            round(getattr(targets, state).slip_std, DIGITS),
            n_runs,
            "estimated",
            getattr(targets, state).source,
        )
        for state in DRIVE_STATES
    }


def _fallback(targets: Mapping[str, Mapping[str, SlipTarget]], default: SlipTable) -> dict[str, SlipTarget]:
    known = [by_state for by_state in targets.values() if by_state["traction"].status == "estimated"]
    chosen = {}
    for state in DRIVE_STATES:
        if known:
            slip = SIGN[state] * median_low(abs(by_state[state].slip_ratio) for by_state in known)
            source = "lower median of the terrains estimated here"
        else:
            slip = default.targets[default.fallback][state].slip_ratio
            source = f"table {default.name}, its fallback"
        chosen[state] = SlipTarget(FALLBACK, state, slip, math.nan, 0, "unestimated", source)
    return chosen


def curve_entry(curve: SlipCurve, targets: Targets, robot: Robot) -> CurveEntry:
    """Return what the table holds of a curve, rounded."""
    energy = {state: energy_jpm(curve, getattr(targets, state).slip_ratio, robot) for state in DRIVE_STATES}
    names = LAW_PARAMETERS[curve.law]
    return CurveEntry(
        law=curve.law,
        parameters={
            name: round(value, DIGITS + 1) for name, value in zip(names, curve.parameters, strict=True)
        },
        peak_slip_ratio=round(curve.peak.slip_ratio, DIGITS),
        peak_interval_ratio=_rounded(curve.peak_interval),
        peak_status=curve.peak.status,
        slip_range_ratio=_rounded(curve.slip_range),
        resistance_ratio=round(curve.resistance_ratio, DIGITS),
        resistance_std=round(curve.resistance_std, DIGITS),
        balance_slip_ratio=round(curve.balance_slip_ratio, DIGITS),
        peak_based_slip_ratio=round(targets.peak_based_slip_ratio, DIGITS),
        working_slip_ratio=None
        if math.isnan(targets.working_slip_ratio)
        else round(targets.working_slip_ratio, DIGITS),
        traction_efficiency_ratio=round(tractive_efficiency(curve, targets.traction.slip_ratio), 3),
        traction_energy_jpm=round(energy["traction"], 1),
        braking_energy_jpm=round(energy["braking"], 1),
        steady_energy_jpm=round(energy["steady"], 1),
        n_runs=curve.n_runs,
    )


def _rounded(pair: tuple[float, float]) -> tuple[float, float]:
    return round(pair[0], DIGITS), round(pair[1], DIGITS)


def terrain_row(entry: Learned, table: SlipTable) -> dict[str, Any]:
    """Return what JSON holds of a terrain; None where something is not known."""
    held = [part.bins for part in entry.parts if len(part.bins.slip_ratio)]
    low, high = slip_range(held)
    curve = table.curves.get(entry.terrain)
    row: dict[str, Any] = {
        "status": entry.status,
        "reason": entry.reason or None,
        "n_runs": len(held),
        "n_samples": sum(part.n_samples for part in entry.parts),
        "slip_range": None if math.isnan(low) else [round(low, DIGITS), round(high, DIGITS)],
        "peak_slip": None,
        "peak_slip_ci": None,
        "peak_status": None,
        "targets": {
            state: {
                "slip_ratio": target.slip_ratio,
                "slip_std": None if math.isnan(target.slip_std) else target.slip_std,
                "status": target.status,
                "source": target.source,
            }
            for state, target in table.targets[entry.terrain].items()
        },
    }
    if curve is not None and entry.curve is not None:
        row |= {
            "peak_slip": curve.peak_slip_ratio,
            "peak_slip_ci": list(curve.peak_interval_ratio),
            "peak_status": curve.peak_status,
            "law": curve.law,
            "parameters": dict(curve.parameters),
            "resistance_ratio": curve.resistance_ratio,
            "resistance_std": curve.resistance_std,
            "balance_slip": curve.balance_slip_ratio,
            "working_slip": curve.working_slip_ratio,
            "peak_based_slip": curve.peak_based_slip_ratio,
            "traction_efficiency": curve.traction_efficiency_ratio,
            "energy_jpm": {state: getattr(curve, f"{state}_energy_jpm") for state in DRIVE_STATES},
            "scores": {law: round(score, 3) for law, score in entry.curve.scores.items()},
        }
    return row


def _run_row(part: RunPart) -> dict[str, Any]:
    mass, mass_std, ratio, std = part.balance
    slips = part.bins.slip_ratio
    return {
        "run_id": part.run_id,
        "terrain": part.terrain,
        "n_samples": part.n_samples,
        "n_bins": len(slips),
        "slip_range": [round(float(slips.min()), 4), round(float(slips.max()), 4)] if len(slips) else None,
        "mass_kg": round(mass, 1),
        "mass_std_kg": round(mass_std, 1),
        "resistance_ratio": None if math.isnan(ratio) else round(ratio, 4),
        "resistance_std": None if math.isnan(std) else round(std, 4),
        "left_out": part.left_out,
    }


def _metrics(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return a number of each terrain a name, as MLflow's words allow."""
    keys = ("n_runs", "peak_slip", "resistance_ratio", "balance_slip", "traction_efficiency")
    metrics = {
        f"{_word(terrain)}.{key}": float(row[key])
        for terrain, row in rows.items()
        for key in keys
        if row.get(key) is not None
    }
    for terrain, row in rows.items():
        for state in DRIVE_STATES:
            metrics[f"{_word(terrain)}.target_{state}"] = float(row["targets"][state]["slip_ratio"])
    return metrics


def _word(terrain: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "_-. " else "_" for letter in terrain)


def _write_figures(drawn: Mapping[str, Any], folder: Path | None) -> list[str]:
    if folder is None:
        return []
    from pipelines.reporting.drawing import png_bytes, svg_text

    files = []
    for name, figure in drawn.items():
        stem = "".join(letter if letter.isalnum() or letter in "_-." else "_" for letter in name)
        for ending, content in ((".png", png_bytes(figure)), (".svg", svg_text(figure))):
            atomic_write(folder / f"{stem}{ending}", content)
            files.append(str(folder / f"{stem}{ending}"))
    return files
