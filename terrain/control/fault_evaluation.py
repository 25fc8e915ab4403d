"""What a sensor fault does to a closed-loop drive: its figures, and the bars that they have to meet.

A drive with a fault is compared with two others in the same situation and by the same seed: the *clean* one,
by the same controller without the fault, and the *plain* one, by the commands of the kinematics alone, which
no sensor fault touches.  A fault must not make slip control worse than having none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.control.drive_metrics import PEAK_ABOVE_MPS, STANDING_MPS, DriveHistory, stopping_distance
from terrain.control.situations import BRAKE, brake_time
from terrain.control.traction import TractionStatus
from terrain.records import Array, RunLog, read_only
from terrain.robots import Robot
from terrain.simulation.faults.fault import Nature
from terrain.simulation.scenario.scenario import Scenario

_SLACK_S = 1e-9  # figures and instants that differ by less are the same

RATIO_ABOVE_MPS = 0.3
"""The error of slip is evaluated where each wheel, or the ground below it, is faster: there an error of
1 cm/s in a speed is 3 % of slip."""

OVERSPEED_MPS = 0.05
"""A commanded speed counts as above the desired one by more than this; a wheel's share of the torque among
wheels of different radii is corrected by less."""


class Limits(NamedTuple):
    """Limits of the figures.

    Parameters
    ----------
    ok_s : time for which a stream may be dead or lying before the status is another than OK
    held_back_s : time without OK beyond the clean drive's while a fault is tolerable
    slip_error_ratio : of the slip while the status is OK
    slip_error_chance_ratio : the limit is at least the clean drive's own error and this
    slip_peak_ratio : true slip above the plain drive's: what differs by chance between two drives whose
        commands differ little
    stop_ratio : stopping distance over the plain drive's
    recovery_s : from the end of the fault to OK
    overspeed_s : time for which the commanded speed is above the desired one: a controlled braking from
        1 m/s on a slick floor takes 0.5 s
    """

    ok_s: float = 0.3
    held_back_s: float = 0.3
    slip_error_ratio: float = 0.05
    slip_error_chance_ratio: float = 0.03
    slip_peak_ratio: float = 0.03
    stop_ratio: float = 1.1
    recovery_s: float = 1.0
    overspeed_s: float = 1.0


LIMITS = Limits()


@dataclass(frozen=True, slots=True, eq=False)
class FaultDrive:
    """What is evaluated of a drive, at the instants of its control.

    Parameters
    ----------
    time_s : (n,)
    ok : (n,) whether the status is OK
    slip_ratio, true_slip_ratio : (n,) largest of the wheels, estimated by the controller, and the true one
        behind the estimate's low-pass; NaN where unknown, and the true one where a wheel is slow
    body_slip_ratio : (n,) true slip of the robot, the mean over its wheels; NaN where it is slow
    moving : (n,) whether the robot moves or motion is desired
    commanded_mps, desired_mps, speed_mps : (n,) mean of the wheels' commands, what is desired, and the true
        speed over ground
    stop_s : time of the command to stop; infinite without one
    stop_m : distance travelled from then to standstill; NaN where there was none
    """

    time_s: Array
    ok: Array
    slip_ratio: Array
    true_slip_ratio: Array
    body_slip_ratio: Array
    moving: Array
    commanded_mps: Array
    desired_mps: Array
    speed_mps: Array
    stop_s: float = math.inf
    stop_m: float = math.nan

    def __post_init__(self) -> None:
        for name in ("ok", "moving"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.bool_))
        for name in (
            *("time_s", "slip_ratio", "true_slip_ratio", "body_slip_ratio"),
            *("commanded_mps", "desired_mps", "speed_mps"),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name)))


class FaultFigures(NamedTuple):
    """Figures of a drive with a fault; NaN where one is not defined.

    Parameters
    ----------
    ok_total_s, ok_longest_s : time with status OK while the fault acts and the robot is to move: all, and the
        longest in one piece
    not_ok_s : time without OK meanwhile, beyond the clean drive's
    slip_error_ratio, clean_slip_error_ratio : largest error of slip while the status is OK, from the fault's
        start on; of the clean drive
    slip_peak_ratio, plain_slip_peak_ratio : largest magnitude of the robot's true slip, from the fault's
        start on; of the plain drive
    stop_m, stop_ratio : stopping distance, and over that of the plain drive; infinite without a standstill
    recovery_s : from the end of the fault until the status is OK and remains so while the robot is to move;
        infinite where it does not; NaN of a fault for good, and where the robot stands by then
    overspeed_s : longest time for which the commanded speed is above the desired one
    n_exceptions, n_not_finite : steps at which the controller raised, or gave a command that is not finite
    """

    ok_total_s: float
    ok_longest_s: float
    not_ok_s: float
    slip_error_ratio: float
    clean_slip_error_ratio: float
    slip_peak_ratio: float
    plain_slip_peak_ratio: float
    stop_m: float
    stop_ratio: float
    recovery_s: float
    overspeed_s: float
    n_exceptions: int
    n_not_finite: int


BARS: Mapping[str, str] = {
    "ok_ends": "status OK while a dead or lying stream acts: at most {ok_s:g} s in all",
    "goes_on": "status not OK while a tolerable fault acts: at most {held_back_s:g} s more than without it",
    "slip_error": "error of slip while the status is OK: at most {slip_error_ratio:g}, or the clean drive's "
    "own and {slip_error_chance_ratio:g}",
    "slip_peak": "peak of the true slip: at most that of plain commands and {slip_peak_ratio:g}",
    "stop": "stopping distance: at most {stop_ratio:g} times that of plain commands",
    "recovery": "status OK again after the fault: within {recovery_s:g} s",
    "overspeed": "commanded speed above the desired one: for at most {overspeed_s:g} s",
    "finite": "commands that are not finite, and exceptions: none",
}
"""The bars by name; the limits are those of :class:`Limits`."""


def fault_drive(
    run: RunLog,
    history: DriveHistory,
    robot: Robot,
    scenario: Scenario,
) -> FaultDrive:
    """Return what is evaluated of a drive straight ahead.

    Parameters
    ----------
    run, history : its log with the streams ``control`` and ``commands``, and the history of its truth
    robot : the one that was simulated; its encoders' low-pass is the lag of every estimate
    scenario : straight ahead; a command to stop is one of :func:`terrain.control.situations.brake_time`
    """
    control, commands, time_s = run.streams["control"], run.streams["commands"], run.streams["control"].time_s
    step_s = float(history.time_s[1] - history.time_s[0])
    tau_s = robot.equipment.sensors.encoder_time_constant_s
    wheel, ground = (
        _low_passed(each, step_s, tau_s) for each in (history.wheel_speed_mps, history.ground_mps)
    )
    fastest = np.maximum(np.abs(wheel), np.abs(ground))
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = ((wheel - ground) / fastest).max(axis=1)
    slip[fastest.min(axis=1) < RATIO_ABOVE_MPS] = np.nan
    body = history.slip_ratio.mean(axis=1)
    body[history.speed_mps <= PEAK_ABOVE_MPS] = np.nan
    speed = np.interp(time_s, history.time_s, history.speed_mps)
    wheels = np.column_stack([commands.channel(f"wheel_{i}_radps") for i in robot.wheels])
    desired = np.hypot(scenario.twist[:, 0], scenario.twist[:, 1])
    stop_s = brake_time(scenario) if scenario.name == BRAKE else math.inf
    return FaultDrive(
        time_s=time_s,
        ok=control.channel("status_code") == TractionStatus.OK,
        slip_ratio=control.channel("slip_ratio"),
        true_slip_ratio=np.interp(time_s, history.time_s, slip),
        body_slip_ratio=np.interp(time_s, history.time_s, body),
        moving=(speed > STANDING_MPS) | (desired > 0.0),
        commanded_mps=np.abs(wheels).mean(axis=1) * robot.wheel_radius_m,
        desired_mps=desired,
        speed_mps=speed,
        stop_s=stop_s,
        stop_m=stopping_distance(history, stop_s) if math.isfinite(stop_s) else math.nan,
    )


def _low_passed(values: Array, step_s: float, tau_s: float) -> Array:
    keep = math.exp(-step_s / tau_s) if tau_s > 0.0 else 0.0
    filtered, _ = lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * values[:1])
    return np.asarray(filtered)


def fault_figures(
    drive: FaultDrive,
    clean: FaultDrive,
    plain: FaultDrive,
    start_s: float,
    end_s: float,
    n_exceptions: int = 0,
    n_not_finite: int = 0,
) -> FaultFigures:
    """Return the figures of a drive with a fault.

    Parameters
    ----------
    drive, clean, plain : with the fault, without it, and by plain commands, at the same instants
    start_s, end_s : between which the fault acts; an infinite end is for good
    n_exceptions, n_not_finite : as counted in the drive
    """
    time_s = drive.time_s
    step_s = float(np.median(np.diff(time_s)))
    since = time_s >= start_s - _SLACK_S
    acts = since & (time_s < end_s - _SLACK_S)
    ok, not_ok = (acts & drive.moving & each for each in (drive.ok, ~drive.ok))
    clean_not_ok = acts & clean.moving & ~clean.ok
    too_fast = drive.commanded_mps > drive.desired_mps + OVERSPEED_MPS
    is_stop = math.isfinite(plain.stop_m)
    stop_m = drive.stop_m if math.isfinite(drive.stop_m) else math.inf
    return FaultFigures(
        ok_total_s=_time_s(ok.sum(), step_s),
        ok_longest_s=_time_s(_longest(ok), step_s),
        not_ok_s=_time_s(max(not_ok.sum() - clean_not_ok.sum(), 0), step_s),
        slip_error_ratio=_slip_error(drive, since),
        clean_slip_error_ratio=_slip_error(clean, since),
        slip_peak_ratio=_largest(np.abs(drive.body_slip_ratio[since])),
        plain_slip_peak_ratio=_largest(np.abs(plain.body_slip_ratio[since])),
        stop_m=stop_m if is_stop else math.nan,
        stop_ratio=stop_m / plain.stop_m if is_stop else math.nan,
        recovery_s=_recovery_s(drive, end_s),
        overspeed_s=_time_s(_longest(since & too_fast), step_s),
        n_exceptions=n_exceptions,
        n_not_finite=n_not_finite,
    )


def judge(figures: FaultFigures, nature: Nature, limits: Limits = LIMITS) -> dict[str, bool | None]:
    """Return which of :data:`BARS` are met; None for one that does not apply, or whose figure is undefined.

    Parameters
    ----------
    figures : of the drive
    nature : of the fault, which decides on ``ok_ends`` and ``goes_on``
    limits : of the figures
    """
    one = figures
    error_limit = max(
        limits.slip_error_ratio, one.clean_slip_error_ratio + limits.slip_error_chance_ratio
    )  # the clean drive's error is NaN where it has none: the first then
    return {
        "ok_ends": _at_most(one.ok_total_s, limits.ok_s) if nature in (Nature.DEAD, Nature.LYING) else None,
        "goes_on": _at_most(one.not_ok_s, limits.held_back_s) if nature is Nature.TOLERABLE else None,
        "slip_error": _at_most(one.slip_error_ratio, error_limit),
        "slip_peak": _at_most(one.slip_peak_ratio, one.plain_slip_peak_ratio + limits.slip_peak_ratio),
        "stop": _at_most(one.stop_ratio, limits.stop_ratio),
        "recovery": _at_most(one.recovery_s, limits.recovery_s),
        "overspeed": _at_most(one.overspeed_s, limits.overspeed_s),
        "finite": one.n_exceptions + one.n_not_finite == 0,
    }


def bar_texts(limits: Limits = LIMITS) -> dict[str, str]:
    """Return what each bar asks for.

    Examples
    --------
    >>> bar_texts()["recovery"]
    'status OK again after the fault: within 1 s'
    """
    return {name: text.format(**limits._asdict()) for name, text in BARS.items()}


class BarCount(NamedTuple):
    """A bar over all drives: what it asks for, and how many meet it, do not, and are not judged by it."""

    text: str
    n_met: int
    n_unmet: int
    n_not_judged: int


def count_bars(judged: Sequence[Mapping[str, bool | None]], limits: Limits = LIMITS) -> dict[str, BarCount]:
    """Return each bar by name, over the drives that were judged."""
    counted = {}
    for name, text in bar_texts(limits).items():
        met = [bars[name] for bars in judged]
        counted[name] = BarCount(text, met.count(True), met.count(False), met.count(None))
    return counted


def _at_most(value: float, limit: float) -> bool | None:
    return None if math.isnan(value) or math.isnan(limit) else value <= limit + _SLACK_S


def _slip_error(drive: FaultDrive, since: Array) -> float:
    return _largest(np.abs(drive.slip_ratio - drive.true_slip_ratio)[since & drive.ok])


def _recovery_s(drive: FaultDrive, end_s: float) -> float:
    after = drive.moving & (drive.time_s >= end_s - _SLACK_S)
    if not after.any():
        return math.nan
    time_s, not_ok = drive.time_s[after], np.flatnonzero(~drive.ok[after])
    if not not_ok.size:
        return 0.0
    last = int(not_ok[-1])
    return round(float(time_s[last + 1] - end_s), 6) if last + 1 < time_s.size else math.inf


def _time_s(n_steps: float, step_s: float) -> float:
    """Return the time of so many steps, to a microsecond."""
    return round(float(n_steps) * step_s, 6)


def _longest(mask: Array) -> int:
    """Return the length of the longest stretch of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else math.nan
