"""Metrics of a simulated drive by name, from the truth in its log; and drives compared seed by seed.

Energy is the mechanical work of the wheels' motors, ``max(T w, 0)`` summed over wheels: the motor drivers do
not recover energy.  Controllers are compared at equal distance, as at equal time the consumption of one that
travels less far is lower.  Means over drives and paired differences have 95 % intervals by Student's
distribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from terrain.control.controllers import TRACK, adapts, uses_classifier
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
from terrain.kinematics.logged_wheels import true_slip
from terrain.kinematics.wheels import wheel_frame_velocities
from terrain.logs.schema import TWIST
from terrain.records import Array, RunLog, Stream
from terrain.robots import BicycleRobot, Robot
from terrain.signals import low_pass, true_stretches
from terrain.simulation.scenario import Scenario, fastest_mps_of

PEAK_ABOVE_MPS = 0.2  #: Slip is evaluated above this speed: below it is the ratio of two small speeds.
#: Time constant of the low-pass on slip, the one of its estimate: it removes the slip of single bumps.
SMOOTH_S = 0.05
#: A wheel is locked where its circumferential speed is below this fraction of its speed over ground, above this speed
#: over ground.
LOCKED_RATIO, LOCKED_ABOVE_MPS = 0.1, 0.1
#: Turns are evaluated above the first, from the second after a change of the desired twist on, over the third at least.
TURN_RADPS, TURN_AFTER_S, TURN_LEAST_S = 0.1, 1.5, 0.5
#: Ground or motors give no more where the robot slips by more, the fastest wheel is commanded to nearly its limit (or a
#: car's steering, at the speed that it has), or a wheel is so much slower than its command.
LIMIT_SLIP_RATIO, LIMIT_SPEED_RATIO, LIMIT_BEHIND_RATIO = 0.5, 0.98, 0.8
STANDING_MPS = 0.02  #: A robot that is slower than this stands.
#: A robot is immobilised where it is slower than the first for this time while a speed above the last is desired.
STUCK_MPS, STUCK_S, STUCK_COMMAND_MPS = 0.03, 2.0, 0.2
FINAL_S = 20.0  #: The final speed is the mean over this time, or over the last third of a shorter run.
#: Of a start: the distance over which energy is compared, the times within which distance is, and its slip.
START_DISTANCE_M, START_TIME_S, START_WINDOW_S = 4.0, 5.0, 7.0
TARGET_CHANGE = 0.02  #: Targets that differ by less count as one.
#: Metrics that every drive has, with what they are called and their unit.
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
#: Of a start.
OF_STARTS = "slip_peak", f"distance_{START_TIME_S:g}s_m", f"energy_{START_DISTANCE_M:g}m_j"
#: The same with those of some scenarios.
LABELS = METRICS | {
    "stop_m": ("stopping distance", "m"),
    "steepest_deg": ("steepest grade climbed", "°"),
    "turn_error_ratio": ("error of the yaw rate in steady turns", ""),
    "turn_limit_ratio": ("of their time, at the limit of ground or motors", ""),
    OF_STARTS[1]: (f"distance within {START_TIME_S:g} s of a start", "m"),
    OF_STARTS[2]: (f"energy of the first {START_DISTANCE_M:g} m", "J"),
}
TURNING = "arc", "circle", "spot_turn", "complex", "survey"  #: Scenarios with steady turns.
TURNS = "turn_error_ratio", "turn_limit_ratio"  #: Of steady turns.
#: Metrics of a controller that uses the terrain.
BELIEF = ("believed_ratio", "n_accepted", "n_below_threshold", "n_refused")


class DriveHistory(NamedTuple):
    """The truth of a drive, evenly spaced: rows (n,) or, of driven wheels, (n, wheels)."""

    time_s: Array
    speed_mps: Array  #: magnitude of the velocity over ground
    velocity_mps: Array  #: (n, 2) in body axes
    progress_mps: Array  #: along the desired direction; negative where the robot slides back
    distance_m: Array  #: this and the next three cumulated
    energy_j: Array
    scrub_j: Array  #: dissipated in the contacts
    scrub_along_j: Array  #: of it along the wheels
    wheel_speed_mps: Array  #: circumferential
    ground_mps: Array  #: of each wheel along it
    slip_ratio: Array  #: low-pass filtered, positive in traction in both directions; NaN at rest
    sinkage_m: Array  #: of the deepest wheel
    yaw_rad: Array


def drive_history(
    run: RunLog, robot: Robot, radius_factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> DriveHistory:
    """Return the history of a simulated run of a robot.

    Factors are the true radius of each of the first wheels over the nominal one (``Conditions``); without them, wheels
    of different radii appear to gain energy from the ground.
    """
    truth, wheels, commands = run.streams["truth"], robot.wheels, run.streams.get("commands")
    time_s, step_s = truth.time_s, float(np.median(np.diff(truth.time_s)))
    twist = truth.columns(TWIST)
    rate, steer, torque, traction, side, sinkage = (
        truth.columns(name.format(wheel) for wheel in wheels)
        for name in (
            *("wheel_{}_radps", "steer_{}_rad", "torque_{}_nm"),
            *("traction_{}_n", "side_{}_n", "sinkage_{}_m"),
        )
    )
    rollers, driven = robot.roller_angles_rad, np.isin(wheels, robot.logged_wheels)
    axis = steer + robot.wheel_directions_rad + rollers
    ground, sideways = wheel_frame_velocities(twist, robot.wheel_positions_m, axis)
    ground = ground / np.cos(rollers)
    factors = np.array([*radius_factors, *np.ones(len(wheels))])[: len(wheels)]
    wheel_speed = rate * robot.wheel_radius_m * factors
    along_w = (traction * (wheel_speed - ground)).sum(axis=1)
    velocity = twist[:, :2]
    progress = np.linalg.norm(velocity, axis=1)
    if commands is not None:
        # along the last desired direction: sliding down a slope backwards is negative; over ground before one
        desired = np.column_stack([commands.channel("speed_x_mps"), commands.channel("speed_y_mps")])
        size = np.linalg.norm(desired, axis=1)
        last = np.maximum.accumulate(np.where(size > 0.0, np.arange(size.size), -1))
        at = last[np.clip(np.searchsorted(commands.time_s, time_s, side="right") - 1, 0, size.size - 1)]
        direction = desired[at] / np.maximum(size[at], 1e-9)[:, None]
        progress = np.where(at < 0, progress, np.einsum("ij,ij->i", velocity, direction))
    true = true_slip(truth, robot.logged_wheels)
    slip = low_pass(np.nan_to_num(true), step_s, SMOOTH_S)
    slip[np.isnan(true)] = np.nan
    return DriveHistory(
        time_s,
        np.hypot(velocity[:, 0], velocity[:, 1]),
        velocity,
        progress,
        np.cumsum(progress) * step_s,
        np.cumsum(np.maximum(torque * rate, 0.0).sum(axis=1)) * step_s,
        np.cumsum(along_w - (side * sideways).sum(axis=1)) * step_s,
        np.cumsum(along_w) * step_s,
        wheel_speed[:, driven],
        ground[:, driven],
        slip,
        sinkage.max(axis=1),
        truth.channel("yaw_rad"),
    )


def slip_peak(history: DriveHistory, within: Array | None = None) -> float:
    """Return the largest slip of the robot, the mean over its wheels, above :data:`PEAK_ABOVE_MPS`; or NaN.

    Within some samples, a mask (n,), or in all.
    """
    used = history.speed_mps > PEAK_ABOVE_MPS
    used &= np.isfinite(history.slip_ratio).any(axis=1)
    if within is not None:
        used &= within
    return float(np.nanmean(history.slip_ratio[used], axis=1).max()) if used.any() else math.nan


def energy_over(history: DriveHistory, distance_m: float, start_s: float = 0.0) -> float:
    """Return the energy in J over a distance from a time on; NaN where the robot did not travel so far."""
    first = int(np.searchsorted(history.time_s, start_s))
    travelled = history.distance_m - history.distance_m[first]
    if travelled[-1] < distance_m:
        return math.nan
    return float(np.interp(distance_m, travelled[first:], history.energy_j[first:]) - history.energy_j[first])


def distance_within(history: DriveHistory, start_s: float, length_s: float) -> float:
    """Return the distance in m travelled within ``length_s`` from a time on."""
    first, last = np.searchsorted(history.time_s, [start_s, start_s + length_s])
    return float(history.distance_m[min(last, len(history.distance_m) - 1)] - history.distance_m[first])


def lock_s(history: DriveHistory, start_s: float = 0.0, end_s: float = math.inf) -> float:
    """Return the time in s, between two times, for which the wheel that was locked longest was locked."""
    within = (history.time_s >= start_s) & (history.time_s <= end_s)
    rolling = history.wheel_speed_mps * np.sign(history.ground_mps)
    locked = rolling < LOCKED_RATIO * np.abs(history.ground_mps)
    locked &= np.abs(history.ground_mps) > LOCKED_ABOVE_MPS
    return float(locked[within].sum(axis=0).max() * (history.time_s[1] - history.time_s[0]))


def turn_figures(run: RunLog, history: DriveHistory, robot: Robot, scenario: Scenario) -> tuple[float, float]:
    """Return the error of the yaw rate in steady turns, and in which part of their time ground or motors gave no more.

    The error of a turn is that of its mean yaw rate over the desired one; the mean of those turns, weighted by their
    time, that ground and motors give, NaN without one.  The part is NaN where nothing turns.
    """
    twist, time_s = scenario.twist, scenario.time_s
    constant = np.concatenate([[False], (np.abs(np.diff(twist, axis=0)) < 1e-9).all(axis=1)])
    commands, turns = run.streams["commands"], []
    wheels = commands.columns(f"wheel_{i}_radps" for i in robot.logged_wheels) * robot.wheel_radius_m
    for first, end in true_stretches(constant & (np.abs(twist[:, 2]) > TURN_RADPS)).tolist():
        start_s, end_s = time_s[first] + TURN_AFTER_S, time_s[end - 1]
        if end_s - start_s < TURN_LEAST_S:
            continue
        within, given = (
            (stamps >= start_s) & (stamps <= end_s) for stamps in (history.time_s, commands.time_s)
        )
        speed, command = (
            np.abs(rows.mean(axis=0)) for rows in (history.wheel_speed_mps[within], wheels[given])
        )
        yaw, passed_s = (rows[within][-1] - rows[within][0] for rows in (history.yaw_rad, history.time_s))
        limited = abs(np.nanmean(history.slip_ratio[within])) > LIMIT_SLIP_RATIO
        limited |= command.max() > LIMIT_SPEED_RATIO * fastest_mps_of(robot)
        limited |= (speed < LIMIT_BEHIND_RATIO * command - LOCKED_ABOVE_MPS / 2).any()
        if isinstance(robot, BicycleRobot):
            most = math.tan(robot.steering_max_rad) / robot.wheelbase_m * history.speed_mps[within].mean()
            limited |= abs(twist[first, 2]) > LIMIT_SPEED_RATIO * most
        turns.append((abs(yaw / passed_s / twist[first, 2] - 1.0), limited, end_s - start_s))
    errors, limits, times_s = np.array(turns).reshape(-1, 3).T
    kept_s = times_s * (1.0 - limits)
    error = float(errors @ kept_s / kept_s.sum()) if kept_s.any() else math.nan
    return error, float(limits @ times_s / times_s.sum()) if times_s.size else math.nan


def immobilised(history: DriveHistory, control: Stream) -> int:
    """Return how often the robot was stuck: no motion for :data:`STUCK_S` although one is desired.

    The desired speed is the pilot's ``desired_mps`` and not the wheels' command: a robot that its controller
    stops counts as stuck.  It moves where a wheel moves over ground in the direction of its rotation: a robot
    that turns on the spot is not stuck, one that slides back down a slope is.
    """
    desired = np.interp(history.time_s, control.time_s, control.channel("desired_mps"))
    moving_mps = (history.ground_mps * np.sign(history.wheel_speed_mps)).max(axis=1)
    stuck = np.ptp(true_stretches((desired > STUCK_COMMAND_MPS) & (moving_mps < STUCK_MPS)), axis=1)
    return int((stuck * (history.time_s[1] - history.time_s[0]) >= STUCK_S).sum())


def final_speed(history: DriveHistory) -> float:
    """Return the mean speed in m/s at the end of a drive."""
    length_s = min(FINAL_S, history.time_s[-1] / 3)
    return float(history.progress_mps[history.time_s > history.time_s[-1] - length_s].mean())


def standstill_time(history: DriveHistory, start_s: float) -> float:
    """Return the first time in s, from one on, at which the robot stood or reversed; NaN if never.

    A robot that is braked hard may roll back: the first standstill counts.
    """
    first = int(np.searchsorted(history.time_s, start_s - 1e-9))
    direction = history.velocity_mps[first] / max(history.speed_mps[first], 1e-9)
    stood = np.flatnonzero(history.velocity_mps[first:] @ direction < STANDING_MPS)
    return float(history.time_s[first + stood[0]]) if stood.size else math.nan


def stopping_distance(history: DriveHistory, start_s: float) -> float:
    """Return the distance in m from a time on until the robot stood; NaN where it did not."""
    end_s = standstill_time(history, start_s)
    return distance_within(history, start_s, end_s - start_s) if math.isfinite(end_s) else math.nan


def adaptation_times(control: Stream, changes: Sequence[tuple[float, float]]) -> list[float]:
    """Return the time in s from each change of terrain until the pilot's target is that of the new one.

    A change is its time and the target of the new terrain; NaN where the pilot's did not come within
    :data:`TARGET_CHANGE` of it before the next change.
    """
    target, found = control.channel("target_ratio"), []
    ends_s = [*(change_s for change_s, _ in changes[1:]), math.inf]
    for (change_s, desired), end_s in zip(changes, ends_s, strict=False):
        near = (control.time_s >= change_s) & (control.time_s < end_s)
        near &= np.abs(target - desired) <= TARGET_CHANGE
        found.append(float(control.time_s[near.argmax()] - change_s) if near.any() else math.nan)
    return found


def command_change(commands: Stream) -> float:
    """Return the rms rate of change of the wheels' commands in rad/s^2."""
    wheels = commands.columns(name for name in commands.channels if name.startswith("wheel_"))
    return float(np.sqrt(np.mean((np.diff(wheels, axis=0) / np.diff(commands.time_s)[:, None]) ** 2)))


def evaluate_drive(
    run: RunLog,
    history: DriveHistory,
    robot: Robot,
    situation: Situation,
    adapting_to: SlipTable | None = None,
) -> dict[str, float]:
    """Return the metrics of a drive by name, without the energy at equal distance; NaN where undefined.

    The robot is the one that was simulated, whatever its controller assumed; without targets that a controller adapts
    to, neither adaptation nor belief is evaluated.
    """
    control, scenario = run.streams["control"], situation.scenario
    limited = control.channel("driven_mps") < control.channel("desired_mps") - 1e-6
    error = np.abs(control.channel("slip_ratio") - control.channel("aimed_ratio"))[limited]
    row = {
        "distance_m": float(history.distance_m[-1]),
        "mean_speed_mps": float(history.progress_mps.mean()),
        "final_speed_mps": final_speed(history),
        "slip_peak": slip_peak(history),
        "lock_s": lock_s(history),
        "scrub_j": float(history.scrub_j[-1]),
        "scrub_along_j": float(history.scrub_along_j[-1]),
        "immobilised": float(immobilised(history, control)),
        **dict.fromkeys(("adapt_s", "adapted_ratio"), math.nan),
        "slip_error_ratio": float(np.nanmean(error)) if np.isfinite(error).any() else math.nan,
        "sinkage_m": float(history.sinkage_m.mean()),
        "command_mps2": command_change(run.streams["commands"]) * robot.wheel_radius_m,
        "yaw_drift_rad": float(abs(history.yaw_rad[-1] - history.yaw_rad[0])),
    } | dict.fromkeys(BELIEF, math.nan)
    if adapting_to is not None:
        known = control.channel("terrain_code")[control.channel("desired_mps") >= DRIVING_MPS] >= 0.0
        counted = (OutputStatus.ACCEPTED, OutputStatus.BELOW_THRESHOLD, OutputStatus.REFUSED)
        counts = (float((control.channel("output_code") == status).sum()) for status in counted)
        row |= zip(BELIEF, (float(known.mean()) if known.size else math.nan, *counts), strict=True)
        changes, before = [], math.nan  # when the terrain changes the target, and to which
        begins = [(0.0, run.labels[0].terrain), *terrain_changes(run.labels)] if run.labels else []
        for time_s, terrain in begins:
            target = adapting_to.lookup(terrain)["traction"].slip_ratio
            if abs(target - before) > TARGET_CHANGE:
                changes.append((time_s, target))
            before = target
        if changes:
            times = np.array(adaptation_times(control, changes))
            row["adapted_ratio"] = float(np.isfinite(times).mean())
            row["adapt_s"] = float(np.nanmean(times)) if np.isfinite(times).any() else math.nan
    if scenario.name == STARTS:  # of the first, before which no balance is known, and means of those after it
        of_starts = []
        for start_s in start_times(scenario):
            within = (history.time_s >= start_s) & (history.time_s < start_s + START_WINDOW_S)
            values = (
                slip_peak(history, within),
                distance_within(history, start_s, START_TIME_S),
                energy_over(history, START_DISTANCE_M, start_s),
            )
            of_starts.append(dict(zip(OF_STARTS, values, strict=True)))
        row |= {f"first_{key}": value for key, value in of_starts[0].items()}
        row |= {key: float(np.mean([each[key] for each in of_starts[1:]])) for key in OF_STARTS}
    if scenario.name in TURNING:
        row |= zip(TURNS, turn_figures(run, history, robot, scenario), strict=True)
    if scenario.name == BRAKE:
        stop_s = brake_time(scenario)
        row["stop_m"] = stopping_distance(history, stop_s)
        row["lock_s"] = lock_s(history, stop_s, standstill_time(history, stop_s))
    return row


def energy_curve(history: DriveHistory, scenario: Scenario) -> tuple[Array, Array]:
    """Return distance, which never falls, and energy (n,) while motion is desired: coasting costs nothing."""
    driven = history.time_s <= desired_until(scenario)
    return np.maximum.accumulate(history.distance_m[driven]), history.energy_j[driven]


def energy_at_equal_distance(curves: Sequence[tuple[Array, Array]]) -> list[float]:
    """Return the energy per metre in J/m of drives by their :func:`energy_curve`, over the distance that all travelled.

    The distance is the shortest of those drives that travelled at least half of the longest; a drive that
    travelled less has NaN.  So the figure depends on the other drives.

    Examples
    --------
    >>> near, far = ((np.array([0.0, d]), np.array([0.0, 100.0])) for d in (4.0, 5.0))
    >>> energy_at_equal_distance([near, far])
    [25.0, 20.0]
    """
    travelled_m = [float(distance_m[-1]) for distance_m, _ in curves]
    equal_m = min(distance for distance in travelled_m if distance >= max(travelled_m) / 2)
    return [
        float(np.interp(equal_m, *curve) / equal_m) if distance >= equal_m > 0.0 else math.nan
        for curve, distance in zip(curves, travelled_m, strict=True)
    ]


class MeanInterval(NamedTuple):
    """A mean and its 95 % interval, of the known values: None without one, and the interval of a single one."""

    mean: float | None
    ci: tuple[float, float] | None
    n: int

    @property
    def is_significant(self) -> bool:
        """Whether there is an interval, and it excludes zero."""
        return self.ci is not None and (self.ci[0] > 0.0 or self.ci[1] < 0.0)


UNKNOWN = MeanInterval(None, None, 0)


def mean_interval(values: Sequence[float]) -> MeanInterval:
    """Return the mean of the finite values and its 95 % interval.

    Examples
    --------
    >>> found = mean_interval([1.0, 2.0, 3.0, float("nan")])
    >>> found.mean, [round(end, 3) for end in found.ci], found.n
    (2.0, [-0.484, 4.484], 3)
    """
    known = np.array([value for value in values if math.isfinite(value)])
    if not known.size:
        return UNKNOWN
    mean, n, ci = float(known.mean()), int(known.size), None
    if n > 1:
        half = float(student.ppf(0.975, n - 1) * known.std(ddof=1) / math.sqrt(n))
        ci = mean - half, mean + half
    return MeanInterval(mean, ci, n)


#: Range of the search for the steepest grade, and its bisections: to a tenth of a degree.
STEEPEST_DEG, SLOPE_STEPS = 25.0, 9
CLIMBING_MPS = 0.05  #: A robot that is faster than this in the last second climbs.
#: Range of the search for the matching ramp (up to twice the desired rise, where that is finite), and its bisections.
LEAST_RAMP_MPS2, MOST_RAMP_MPS2, RAMP_STEPS = 0.1, 10.0, 7
#: Controllers whose distance the ramp matches: the first of them that is driven.
REFERENCES = ("true_terrain", "classified", "fallback")
#: Below this ratio of the driving time with a known terrain, nine tenths of a drive are the fallback's.
HARDLY_BELIEVED_RATIO = 0.1
_GENERAL = ("slip_peak", "energy_j_per_m", "distance_m", "final_speed_mps")
#: Metrics that a scenario is about, the most informative first.
_OF_SCENARIO = {
    **dict.fromkeys(TURNING, (*TURNS, *_GENERAL)),
    "starts": ("slip_peak", "energy_j_per_m", "distance_5s_m", "energy_4m_j", "final_speed_mps"),
    "brake": ("stop_m", "lock_s", "slip_peak", "energy_j_per_m"),
    "slope": ("steepest_deg", *_GENERAL),
    "circle": ("scrub_j", *TURNS, *_GENERAL),
    "crab": ("scrub_j", *_GENERAL),
    "course": (*_GENERAL, "adapt_s", "adapted_ratio"),
    "mixed": (*_GENERAL, "adapt_s", "adapted_ratio"),
}
#: Metrics whose differences are given in their unit; all others relative, as drives differ in size.
ABSOLUTE = ("steepest_deg", "lock_s", "immobilised", "adapt_s", "adapted_ratio", *TURNS)
#: Metrics that are compared only where a controller has another value than zero.
WHERE_ANY = ("immobilised", "lock_s", TURNS[1])
#: Metrics of controllers whose target follows the terrain; another's may be close to the target by chance.
ADAPTATION = ("adapt_s", "adapted_ratio")
Metrics = Mapping[str, float]  #: Metrics of one drive by name; NaN where one is undefined.


class Drive(NamedTuple):
    """Metrics of one drive by name, its energy over distance, and its curves where they are shown."""

    metrics: dict[str, float]
    energy: tuple[Array, Array]
    curves: Any = None


def add_energies(drives: Mapping[str, Sequence[Drive]]) -> None:
    """Add to the metrics of drives, by controller over the same seeds, their energy at equal distance."""
    for at_one_seed in zip(*drives.values(), strict=True):
        energies = energy_at_equal_distance([one.energy for one in at_one_seed])
        for one, energy in zip(at_one_seed, energies, strict=True):
            one.metrics["energy_j_per_m"] = energy


def steepest_grade(drive: Callable[[float], RunLog]) -> float:
    """Return the steepest grade in degrees that is climbed, by bisection over drives at grades."""
    low, high = -STEEPEST_DEG, STEEPEST_DEG
    for _ in range(SLOPE_STEPS):
        middle = (low + high) / 2
        truth = drive(middle).streams["truth"]
        last = truth.time_s > truth.time_s[-1] - 1.0
        climbs = truth.channel("speed_x_mps")[last].mean() > CLIMBING_MPS
        low, high = (middle, high) if climbs else (low, middle)
    return low


def matching_ramp(
    drives: Mapping[str, Sequence[Drive]],
    of_ramp: Callable[[float], Sequence[Drive]],
    scenario: str,
    accel_mps2: float,
) -> float | None:
    """Return the rise of speed in m/s^2 by which the ramp travels as far as the first reference among controllers.

    None where no controller is a reference.  ``of_ramp`` gives drives with a rise of speed, at the same seeds.
    """
    references = [name for kind in REFERENCES for name in drives if name in (kind, f"{kind}{TRACK}")]
    references += [name for name in drives if name.startswith(("known:", "target:"))]
    if not references:
        return None
    key = OF_STARTS[1] if scenario == STARTS else "distance_m"

    def distance_m(found: Sequence[Drive]) -> float:
        return float(np.mean([one.metrics[key] for one in found]))

    desired_m = distance_m(drives[references[0]])
    low = LEAST_RAMP_MPS2
    high = 2.0 * accel_mps2 if math.isfinite(accel_mps2) else MOST_RAMP_MPS2
    for _ in range(RAMP_STEPS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if distance_m(of_ramp(middle)) < desired_m else (low, middle)
    return math.sqrt(low * high)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers over the same seeds."""

    scenario: str  #: that was driven
    rows: Mapping[str, Sequence[Metrics]]  #: by controller, the metrics of each seed

    @cached_property
    def means(self) -> dict[str, dict[str, MeanInterval]]:
        """By controller and metric, its mean over seeds with its 95 % interval."""
        return {
            name: {key: mean_interval([row[key] for row in rows]) for key in rows[0]}
            for name, rows in self.rows.items()
        }

    @cached_property
    def shown(self) -> list[str]:
        """Metrics that are drawn and compared: those of the scenario that a controller has."""
        found = []
        for key in (*_OF_SCENARIO.get(self.scenario, _GENERAL), "immobilised"):
            means = [self.value(name, key).mean for name in self.rows]
            if any(means) if key in WHERE_ANY else any(mean is not None for mean in means):
                found.append(key)
        return found

    def value(self, name: str, key: str) -> MeanInterval:
        """Return a metric of a controller; unknown where it has none, or only by chance."""
        if key in ADAPTATION and not adapts(name):
            return UNKNOWN
        return self.means[name].get(key, UNKNOWN)

    def difference(self, name: str, other: str, key: str) -> MeanInterval | None:
        """Return the mean difference of a metric between two controllers, seed by seed; None where one has none.

        Only seeds at which both are known count; but for :data:`ABSOLUTE` metrics it is relative to the mean of the
        other, which then has to be above zero.
        """
        if self.value(name, key).mean is None or self.value(other, key).mean is None:
            return None
        pairs = np.array([[row.get(key) for row in self.rows[one]] for one in (name, other)], dtype=float).T
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        scale = 1.0 if key in ABSOLUTE or not len(pairs) else float(pairs[:, 1].mean())
        if not len(pairs) or scale <= 0.0:
            return None
        return mean_interval((pairs[:, 0] - pairs[:, 1]) / scale)

    def is_hardly_believed(self, name: str) -> bool:
        """Return whether a controller uses a classifier that was never or hardly believed.

        What such a controller shows is not the classifier's effect.
        """
        believed = self.value(name, "believed_ratio").mean
        return uses_classifier(name) and believed is not None and believed < HARDLY_BELIEVED_RATIO
