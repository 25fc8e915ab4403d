"""Samples of slip and thrust over load of one run, and their means in bins of slip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.slip_learning.forces import WheelForces
from terrain.slip_learning.intervals import valid_intervals

SAMPLE_S = 0.2
"""Length of a sample: ten of the wheels' own, which reduces the ripple of Hall steps to a third."""

LAG_S = 0.02
"""One sampling period of the wheels: to this is known which slip a thrust belongs to."""

BIN_EDGES = (
    *(-0.02, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.09, 0.12, 0.15, 0.18, 0.21, 0.24, 0.27),
    *(0.3, 0.34, 0.38, 0.42, 0.46, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0),
)
"""Bins of slip: narrow where the curve of hard terrain bends."""

MIN_IN_BIN = 2
"""Samples that make a bin."""

BIN_STD_RATIO, BIN_STD = 0.03, 0.003
"""Error of the mean of even a full bin, relative to its thrust and as thrust over load: terrain varies along
the path by 3 % (data/soils), and no law is exact.  It keeps bins with many samples from dominating."""


class TractionSamples(NamedTuple):
    """Samples of one run on one terrain, (k,) each.

    Parameters
    ----------
    slip_ratio, slip_std : of the contact
    traction_ratio, traction_std : thrust over load
    lag_std : change of the thrust over load within :data:`LAG_S`; unlike noise it does not average out
    """

    slip_ratio: Array
    slip_std: Array
    traction_ratio: Array
    traction_std: Array
    lag_std: Array


class RunBins(NamedTuple):
    """Bins of slip of one run: mean slip, its std, mean thrust over load, its std; (k,) each."""

    run_id: str
    slip_ratio: Array
    slip_std: Array
    traction_ratio: Array
    traction_std: Array


def traction_samples(
    forces: WheelForces, mass_kg: float, where: Array, wheel_speed_std_mps: float
) -> TractionSamples:
    """Return means over :data:`SAMPLE_S`, of one wheel each.

    Parameters
    ----------
    forces : of a run
    mass_kg : of the robot with its payload
    where : (n,) whether an instant is on the terrain
    wheel_speed_std_mps : standard deviation of a single wheel speed

    Notes
    -----
    Means are taken before samples are sorted by slip: a single slip has the error of the ripple of Hall
    steps, and sorting by it would flatten a steep curve.
    """
    rows = []
    valid = forces.valid
    for i in range(valid.shape[1]):
        for part in valid_intervals(forces.time_s, valid[:, i] & where, SAMPLE_S):
            load_n = float(forces.load_npkg[part, i].mean()) * mass_kg
            n, last = part.stop - part.start, part.stop - 1
            noise_std = wheel_speed_std_mps / (forces.reference_speed_mps[part, i].mean() * math.sqrt(n))
            mean_std = float(np.mean(forces.slip_std[part, i]))
            change_n = abs(float(forces.thrust_n[last, i] - forces.thrust_n[part.start, i]))
            rows.append(
                (
                    float(forces.slip_ratio[part, i].mean()),
                    math.hypot(noise_std, mean_std / math.sqrt(2.0)),
                    float(forces.thrust_n[part, i].mean()) / load_n,
                    forces.thrust_std_n / math.sqrt(n / 5.0) / load_n,
                    LAG_S / SAMPLE_S * change_n / load_n,
                )
            )
    return TractionSamples(*np.array(rows).reshape(-1, 5).T)


def run_bins(run_id: str, samples: TractionSamples) -> RunBins:
    """Return the bins of one run's samples that hold :data:`MIN_IN_BIN` or more."""
    bin_number = np.digitize(samples.slip_ratio, BIN_EDGES)
    rows = []
    for number in range(1, len(BIN_EDGES)):
        inside = bin_number == number
        n = int(inside.sum())
        if n < MIN_IN_BIN:
            continue
        slip, slip_std, traction, traction_std, lag_std = (column[inside] for column in samples)
        residual = traction - traction.mean()
        scatter = float(np.sqrt((residual @ residual) / (n - 1) / n))
        floor = BIN_STD + BIN_STD_RATIO * abs(float(traction.mean()))
        noise = max(scatter, float(traction_std.mean()) / math.sqrt(n))
        std = math.hypot(noise, floor, float(lag_std.mean()))
        slip_mean_std = math.sqrt(float((slip_std**2).mean()) / n)
        rows.append((slip.mean(), slip_mean_std, traction.mean(), std))
    return RunBins(run_id, *np.array(rows).reshape(-1, 4).T)


def slip_range(runs: Sequence[RunBins]) -> tuple[float, float]:
    """Return the smallest and the largest slip that two runs or more reach; NaN where no two runs have bins.

    Examples
    --------
    >>> def bins(*slips):
    ...     return RunBins("r", np.array(slips), *np.zeros((3, len(slips))))
    >>> slip_range([bins(0.01, 0.3), bins(0.05, 0.5), bins(0.03, 0.4)])
    (0.03, 0.4)
    """
    with_bins = [run.slip_ratio for run in runs if len(run.slip_ratio)]
    if len(with_bins) < 2:
        return math.nan, math.nan
    low, high = sorted(min(s) for s in with_bins)[1], sorted(max(s) for s in with_bins)[-2]
    return max(0.0, float(low)), float(high)
