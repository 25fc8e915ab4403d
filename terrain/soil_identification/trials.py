"""Trials of one wheel at set slips and slip angles, as arrays, their means over equal settings, and the testbed.

What a testbed adds to the traction of its side force is found by symmetry.  A locked wheel that is dragged
along its axle looks the same from ahead and from behind: its traction is 0.  What is measured there is the
instrument's, as of a mount that bends under the side force::

    Fx_measured = Fx + x Fy,   x = sum(Fx_measured Fy) / sum(Fy^2) over such trials
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.logs.testbed import STREAM
from terrain.records import Array, RunLog, read_only


class Wheel(NamedTuple):
    """A rigid wheel: radius by which it turns, radius up to the grousers' tips, and width."""

    name: str
    radius_m: float
    tip_radius_m: float
    width_m: float


WHEELS: dict[str, Wheel] = {
    "testbed_smooth": Wheel("smooth", 0.058, 0.058, 0.050),
    "testbed_grouser": Wheel("grouser", 0.058, 0.063, 0.050),
}
"""By the name of the robot: Pavlov and Johnson, repository robomechanics/3d-terramechanics."""

MIN_SETTINGS = 20
"""Settings of slip and angle below which a law with twenty parameters is not fitted."""


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """Trials of one wheel, each array (n,).

    Parameters
    ----------
    wheel_radps, travel_mps, slip_angle_rad : measured motion; the commanded angle, which the wheel keeps
    slip_ratio : of the speeds of wheel and travel
    load_n, pull_n, side_n : what the ground does to the wheel: up, ahead, and to the side of the angle's sign
    sinkage_m : of the lowest point
    slip_setting, angle_setting : commanded wheel speed in mm/s and angle in degrees
    n_trials : number of trials behind an entry
    """

    wheel_radps: Array
    travel_mps: Array
    slip_angle_rad: Array
    slip_ratio: Array
    load_n: Array
    pull_n: Array
    side_n: Array
    sinkage_m: Array
    slip_setting: Array
    angle_setting: Array
    n_trials: Array

    def __post_init__(self) -> None:
        for each in fields(self):
            object.__setattr__(self, each.name, read_only(getattr(self, each.name)))

    def __len__(self) -> int:
        return int(self.load_n.size)

    def chosen(self, rows: Array) -> Trials:
        """Return the trials of a mask or of row numbers (m,)."""
        return Trials(*(getattr(self, each.name)[rows] for each in fields(self)))

    @property
    def motion(self) -> Array:
        """Motion and load (n, 4) as :func:`~terrain.terramechanics.inflow_wheel.wheel_forces` takes them."""
        columns = (self.wheel_radps, self.travel_mps, self.slip_angle_rad, self.load_n)
        return np.ascontiguousarray(np.column_stack(columns))


def trials_of(runs: Sequence[RunLog], wheel: Wheel) -> Trials:
    """Return the trials that runs of the testbed hold.

    Raises
    ------
    DataError
        if a run has no stream of the testbed, or no load.
    """
    columns: list[list[float]] = []
    for run in runs:
        if STREAM not in run.streams:
            raise DataError(
                f"run {run.run_id}: has no stream {STREAM!r}, as trials of the wheel testbed have"
            )
        stream = run.streams[STREAM]
        value = {channel: float(stream.channel(channel)[0]) for channel in stream.channels}
        if not value["force_z_n"] > 0.0:
            raise DataError(
                f"run {run.run_id}: force_z_n is {value['force_z_n']:g} N, a load above 0 is needed"
            )
        columns.append(
            [
                value["speed_wheel_mps"] / wheel.radius_m,
                value["speed_travel_mps"],
                value["slip_angle_commanded_rad"],
                value["slip_measured_ratio"],
                value["force_z_n"],
                value["force_x_n"],
                value["force_y_n"],
                value["sinkage_wheel_m"],
                round(value["speed_wheel_commanded_mps"] * 1e3, 3),
                round(np.degrees(value["slip_angle_commanded_rad"]), 3),
                1.0,
            ]
        )
    return Trials(*np.array(columns).T)


def setting_means(trials: Trials) -> Trials:
    """Return the mean trial of each setting of slip and angle, with how many it stands for.

    Raises
    ------
    DataError
        if there are fewer settings than :data:`MIN_SETTINGS`.
    """
    settings = np.column_stack([trials.slip_setting, trials.angle_setting])
    _, index, counts = np.unique(settings, axis=0, return_inverse=True, return_counts=True)
    if len(counts) < MIN_SETTINGS:
        raise DataError(
            f"trials have {len(counts)} settings of slip and angle, a fit needs {MIN_SETTINGS} or more"
        )
    means = {
        each.name: np.bincount(index.ravel(), getattr(trials, each.name)) / counts for each in fields(trials)
    }
    return replace(Trials(**means), n_trials=counts)


MIN_ANGLE_DEG, MAX_SLIP = 89.0, -0.99
MIN_TRIALS = 2


class Coupling(NamedTuple):
    """Part of the side force that is measured as traction; its scatter over trials, and their number.

    ``ratio`` and ``std_ratio`` are NaN without :data:`MIN_TRIALS` trials of a locked wheel along its axle.
    """

    ratio: float
    std_ratio: float
    n_trials: int

    @property
    def text(self) -> str:
        """By how much the measured traction is corrected, or that it is not, in words."""
        if math.isnan(self.ratio):
            return "traction as measured, no trials of a locked wheel along its axle"
        return (
            f"traction less {self.ratio:.3f} ± {self.std_ratio:.3f} of the side force, what {self.n_trials} trials "
            "of a locked wheel along its axle show"
        )


def calibration_rows(trials: Trials) -> Array:
    """Return which trials (n,) are of a locked wheel that is dragged along its axle."""
    return (np.abs(trials.angle_setting) > MIN_ANGLE_DEG) & (trials.slip_ratio < MAX_SLIP)


def side_coupling(trials: Trials) -> Coupling:
    """Return the coupling that the trials of a locked wheel along its axle show."""
    own = trials.chosen(calibration_rows(trials))
    if len(own) < MIN_TRIALS:
        return Coupling(np.nan, np.nan, len(own))
    ratio = float((own.pull_n * own.side_n).sum() / (own.side_n**2).sum())
    return Coupling(ratio, float(np.std(own.pull_n / own.side_n, ddof=1)), len(own))


def without_coupling(trials: Trials, coupling: Coupling) -> Trials:
    """Return trials with their traction corrected, less those that the coupling was found from.

    Without a coupling they are returned as they are.
    """
    if np.isnan(coupling.ratio):
        return trials
    corrected = replace(trials, pull_n=trials.pull_n - coupling.ratio * trials.side_n)
    return corrected.chosen(~calibration_rows(trials))
