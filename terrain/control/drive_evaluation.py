"""Evaluation of a simulated drive: all its metrics by name, and the energy of several at equal distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.control.drive_metrics import (
    DriveHistory,
    adaptation_times,
    command_change,
    distance_within,
    energy_over,
    final_speed,
    immobilised,
    lock_s,
    slip_peak,
    standstill_time,
    stopping_distance,
)
from terrain.control.situations import (
    BRAKE,
    STARTS,
    Situation,
    brake_time,
    desired_until,
    start_times,
    terrain_changes,
)
from terrain.control.slip_table import SlipTable
from terrain.control.switching import DRIVING_MPS, OutputStatus
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.simulation.scenario.scenario import Scenario

START_DISTANCE_M = 4.0
"""Distance of a start over which energy is compared."""

START_TIME_S, START_WINDOW_S = 5.0, 7.0
"""Time of a start within which distance is compared, and in which its slip is."""

TARGET_CHANGE = 0.02
"""Targets that differ by less count as one."""

METRICS = {
    "energy_j_per_m": ("energy per metre", "J/m"),
    "distance_m": ("distance travelled", "m"),
    "mean_speed_mps": ("mean speed", "m/s"),
    "final_speed_mps": ("final speed", "m/s"),
    "slip_peak": ("largest slip", ""),
    "lock_s": ("longest lock of a wheel", "s"),
    "scrub_j": ("energy dissipated in the contacts", "J"),
    "scrub_along_j": ("of it along the wheels", "J"),
    "immobilised": ("times stuck", ""),
    "adapt_s": ("time to the new terrain's target", "s"),
    "adapted_ratio": ("ratio of terrain changes followed", ""),
    "believed_ratio": ("ratio of driving time with a known terrain", ""),
    "n_accepted": ("outputs of the classifier accepted", ""),
    "n_below_threshold": ("outputs below the threshold", ""),
    "n_refused": ("windows the classifier refused", ""),
    "slip_error_ratio": ("slip error while the speed was limited", ""),
    "sinkage_m": ("sinkage of the deepest wheel", "m"),
    "command_mps2": ("change of the wheels' commands, rms", "m/s²"),
    "yaw_drift_rad": ("change of heading over the drive", "rad"),
}
"""Metrics that every drive has, with what they are called and their unit."""

LABELS = METRICS | {
    "stop_m": ("stopping distance", "m"),
    "steepest_deg": ("steepest grade climbed", "°"),
    f"distance_{START_TIME_S:g}s_m": (f"distance within {START_TIME_S:g} s of a start", "m"),
    f"energy_{START_DISTANCE_M:g}m_j": (f"energy of the first {START_DISTANCE_M:g} m", "J"),
}
"""The same with those of some scenarios."""

BELIEF = ("believed_ratio", "n_accepted", "n_below_threshold", "n_refused")
"""Metrics of a controller that uses the terrain: ratio of the driving time with a known terrain, and outputs
of its source by :class:`terrain.control.switching.OutputStatus`."""


class Label(NamedTuple):
    """Name of a metric, and its unit or nothing."""

    text: str
    unit: str

    @property
    def with_unit(self) -> str:
        """The name with its unit in brackets."""
        return f"{self.text} [{self.unit}]" if self.unit else self.text


def metric_label(key: str) -> Label:
    """Return the label of a metric.

    Examples
    --------
    >>> tuple(metric_label("first_distance_5s_m")), metric_label("energy_4m_j").with_unit
    (('distance within 5 s of a start, first start', 'm'), 'energy of the first 4 m [J]')
    """
    text, unit = LABELS[key.removeprefix("first_")]
    return Label(f"{text}, first start" if key.startswith("first_") else text, unit)


class EnergyCurve(NamedTuple):
    """Energy over distance of a drive: distance (n,), which never falls, and energy (n,)."""

    distance_m: Array
    energy_j: Array


def evaluate_drive(
    run: RunLog,
    history: DriveHistory,
    robot: Robot,
    situation: Situation,
    adapting_to: SlipTable | None = None,
) -> dict[str, float]:
    """Return the metrics of a drive by name, without the energy at equal distance; NaN where undefined.

    Parameters
    ----------
    run, history : the drive's log, and the history of its truth
    robot : the one that was simulated, whatever its controller assumed
    situation : in which it was driven
    adapting_to : targets of a controller that uses the terrain; without, neither adaptation nor belief is
        evaluated
    """
    commands, control = run.streams["commands"], run.streams["control"]
    scenario = situation.scenario
    row = {
        "distance_m": float(history.distance_m[-1]),
        "mean_speed_mps": float(history.progress_mps.mean()),
        "final_speed_mps": final_speed(history),
        "slip_peak": slip_peak(history),
        "lock_s": lock_s(history),
        "scrub_j": float(history.scrub_j[-1]),
        "scrub_along_j": float(history.scrub_along_j[-1]),
        "immobilised": float(immobilised(history, control)),
        "adapt_s": math.nan,
        "adapted_ratio": math.nan,
        "slip_error_ratio": _slip_error(run),
        "sinkage_m": float(history.sinkage_m.mean()),
        "command_mps2": command_change(commands) * robot.wheel_radius_m,
        "yaw_drift_rad": float(abs(history.yaw_rad[-1] - history.yaw_rad[0])),
    }
    row |= _belief(control) if adapting_to is not None else dict.fromkeys(BELIEF, math.nan)
    changes = [] if adapting_to is None else _target_changes(run, adapting_to)
    if changes:
        times = np.array(adaptation_times(control, changes))
        row["adapted_ratio"] = float(np.isfinite(times).mean())
        row["adapt_s"] = float(np.nanmean(times)) if np.isfinite(times).any() else math.nan
    if scenario.name == STARTS:
        row |= _evaluate_starts(history, start_times(scenario))
    if scenario.name == BRAKE:
        stop_s = brake_time(scenario)
        row["stop_m"] = stopping_distance(history, stop_s)
        row["lock_s"] = lock_s(history, stop_s, standstill_time(history, stop_s))
    return row


def _belief(control: Stream) -> dict[str, float]:
    """Return :data:`BELIEF`: ratio of driving time with a known terrain, and outputs by their status."""
    driving = control.channel("desired_mps") >= DRIVING_MPS
    known = control.channel("terrain_code")[driving] >= 0.0
    output = control.channel("output_code")
    counted = (OutputStatus.ACCEPTED, OutputStatus.BELOW_THRESHOLD, OutputStatus.REFUSED)
    counts = (float((output == status).sum()) for status in counted)
    return dict(zip(BELIEF, (float(known.mean()) if known.size else math.nan, *counts), strict=True))


def _target_changes(run: RunLog, table: SlipTable) -> list[tuple[float, float]]:
    """Return when the terrain changes the target, and to which."""
    found, before = [], math.nan
    for time_s, terrain in [(0.0, run.labels[0].terrain), *terrain_changes(run.labels)] if run.labels else []:
        target = table.lookup(terrain)["traction"].slip_ratio
        if abs(target - before) > TARGET_CHANGE:
            found.append((time_s, target))
        before = target
    return found


def _slip_error(run: RunLog) -> float:
    """Return the mean error of slip while the speed was limited; NaN without a target."""
    control = run.streams["control"]
    if "aimed_ratio" not in control.channels or "slip_ratio" not in control.channels:
        return math.nan
    limited = control.channel("driven_mps") < control.channel("desired_mps") - 1e-6
    error = np.abs(control.channel("slip_ratio") - control.channel("aimed_ratio"))[limited]
    return float(np.nanmean(error)) if np.isfinite(error).any() else math.nan


def _evaluate_starts(history: DriveHistory, starts: Sequence[float]) -> dict[str, float]:
    """Return metrics of the first start, before which no balance is known, and means of those after it."""
    rows = []
    for start_s in starts:
        within = (history.time_s >= start_s) & (history.time_s < start_s + START_WINDOW_S)
        rows.append(
            {
                "slip_peak": slip_peak(history, within),
                f"distance_{START_TIME_S:g}s_m": distance_within(history, start_s, START_TIME_S),
                f"energy_{START_DISTANCE_M:g}m_j": energy_over(history, START_DISTANCE_M, start_s),
            }
        )
    first, later = rows[0], rows[1:]
    return {
        **{f"first_{key}": value for key, value in first.items()},
        **{key: float(np.mean([row[key] for row in later])) for key in first},
    }


def energy_curve(history: DriveHistory, scenario: Scenario) -> EnergyCurve:
    """Return the energy over distance of a drive, while motion is desired: coasting costs nothing."""
    driven = history.time_s <= desired_until(scenario)
    return EnergyCurve(np.maximum.accumulate(history.distance_m[driven]), history.energy_j[driven])


def energy_at_equal_distance(curves: Sequence[EnergyCurve]) -> list[float]:
    """Return the energy per metre in J/m of each drive, over the distance that all travelled.

    The distance is the shortest of those drives that travelled at least half of the longest; a drive that
    travelled less has NaN.  So the figure depends on the other drives.

    Examples
    --------
    >>> near, far = (EnergyCurve(np.array([0.0, d]), np.array([0.0, 100.0])) for d in (4.0, 5.0))
    >>> energy_at_equal_distance([near, far])
    [25.0, 20.0]
    """
    travelled_m = [float(curve.distance_m[-1]) for curve in curves]
    equal_m = min(distance for distance in travelled_m if distance >= max(travelled_m) / 2)
    return [
        float(np.interp(equal_m, *curve) / equal_m) if distance >= equal_m > 0.0 else math.nan
        for curve, distance in zip(curves, travelled_m, strict=True)
    ]
