"""The slip curve of a terrain: law, resistance, peak, and the slips that targets are made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from terrain.bootstrap import bootstrap_rows
from terrain.records import Array, read_only
from terrain.slip_learning.fit import NO_CURVE, chosen_law, fit_curve, left_out_scores
from terrain.slip_learning.laws import slip_at, traction_ratio
from terrain.slip_learning.peak import (
    INTERVAL,
    SYSTEMATIC_SLIP_STD,
    Peak,
    net_peak,
    peak_interval,
    peak_slip_of_kind,
)
from terrain.slip_learning.samples import RunBins, slip_range

MIN_RUNS = 3
"""Fewer runs do not show how runs differ."""

MIN_RANGE_SLIP = 0.1
"""Slips over less than this are a point of a curve and no curve."""

MIN_BINS = 8
"""Bins of all runs together that a curve is fitted to."""

WORKING_TRACTION_RATIO = 0.035
"""Net traction over load that a start requires: an acceleration of a third of a m/s^2, with which a robot is
behind by a tenth of the distance 5 s after a start to 1 m/s.  More traction costs slip for as long as the
start lasts."""

MIN_THRUST_RATIO = 0.02
"""Ice gives more: a curve that stays below is one without traction."""

N_BOOTSTRAP = 300
"""Draws of the bootstrap over runs."""


class Band(NamedTuple):
    """Slips (m,), and the 5 and 95 % quantiles of the thrust over load at each."""

    slip_ratio: Array
    low_ratio: Array
    high_ratio: Array


class Resistances(NamedTuple):
    """Resistance over load of each run (runs,) and its standard deviation; NaN where it is not known."""

    ratio: Array
    std: Array

    @property
    def known(self) -> Array:
        """Whether (runs,) both are finite."""
        return np.asarray(np.isfinite(self.ratio) & np.isfinite(self.std))


@dataclass(frozen=True, slots=True, eq=False)
class SlipCurve:
    """What was learned of one terrain.

    Parameters
    ----------
    law : ``janosi`` or ``magic``
    parameters : by :data:`terrain.slip_learning.laws.LAW_PARAMETERS`
    resistance_ratio, resistance_std : rolling and compaction resistance over load
    slip_range : smallest and largest slip that two runs or more reach
    peak : of net traction
    peak_interval : contains the peak slip with 90 %
    balance_slip_ratio, balance_std : where thrust and resistance are equal; NaN where they nowhere are
    working_slip_ratio, working_std : slip of the net traction :data:`WORKING_TRACTION_RATIO`; NaN where no
        observed slip gives it
    band : of the law over the bootstrap
    n_runs : the curve is fitted to
    scores : mean log likelihood of a left-out run, by law; and ``none``, of one thrust for all slips
    """

    law: str
    parameters: tuple[float, ...]
    resistance_ratio: float
    resistance_std: float
    slip_range: tuple[float, float]
    peak: Peak
    peak_interval: tuple[float, float]
    balance_slip_ratio: float
    balance_std: float
    working_slip_ratio: float
    working_std: float
    band: Band
    n_runs: int
    scores: Mapping[str, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "band", Band(*(read_only(column) for column in self.band)))

    @property
    def peak_std(self) -> float:
        """Standard deviation of a normal law with the same interval."""
        return (self.peak_interval[1] - self.peak_interval[0]) / (2 * float(ndtri(0.5 + INTERVAL / 2)))

    def thrust_ratio(self, slip_ratio: Array) -> Array:
        """Return the thrust over load (n,) at each slip (n,)."""
        return traction_ratio(self.law, self.parameters, slip_ratio)


class _Model(NamedTuple):
    """Law, its parameters, and the resistance over load."""

    law: str
    parameters: tuple[float, ...]
    resistance_ratio: float

    def thrust(self, slip_ratio: Array) -> Array:
        return traction_ratio(self.law, self.parameters, slip_ratio)

    def net_traction(self, slip_ratio: Array) -> Array:
        return self.thrust(slip_ratio) - self.resistance_ratio

    def slip_of(self, net_ratio: float, high_slip: float = 1.0) -> float:
        """Return the smallest slip with a net traction; NaN where no slip has it."""
        return slip_at(self.law, self.parameters, self.resistance_ratio + net_ratio, high_slip)


def learn_curve(
    runs: Sequence[RunBins],
    resistances: Resistances,
    rng: np.random.Generator,
    n_bootstrap: int = N_BOOTSTRAP,
) -> SlipCurve:
    """Return the curve of a terrain.

    Parameters
    ----------
    runs : at least :data:`MIN_RUNS` with bins
    resistances : of each run
    rng : of the bootstrap
    n_bootstrap : how many draws of runs

    Raises
    ------
    ValueError
        if the runs are too few or cover too little; call :func:`insufficiency` before.
    """
    if (why := insufficiency(runs)) is not None:
        raise ValueError(why)
    low, high = slip_range(runs)
    scores = left_out_scores(runs)
    law = chosen_law(scores)
    rho, rho_std = weighted_resistance(resistances)
    rho = 0.0 if -2 * rho_std < rho < 0 else rho  # slightly negative: not significantly different from none
    model = _Model(law, fit_curve(law, runs).parameters, rho)
    rows = bootstrap_rows(len(runs), n_bootstrap, rng)
    draws = [_refitted(model, runs, resistances, drawn) for drawn in rows]
    peak = net_peak(model.net_traction, low, high)
    peaks = np.array([peak_slip_of_kind(peak.status, draw.net_traction, low, high) for draw in draws])
    slips = np.linspace(0.0, high, 101)
    thrusts = np.array([draw.thrust(slips) for draw in draws])
    return SlipCurve(
        law=law,
        parameters=model.parameters,
        resistance_ratio=rho,
        resistance_std=rho_std,
        slip_range=(low, high),
        peak=peak,
        peak_interval=peak_interval(peaks, runs, peak, model.thrust, high),
        balance_slip_ratio=model.slip_of(0.0),
        balance_std=_std_over_runs([draw.slip_of(0.0) for draw in draws], len(runs)),
        working_slip_ratio=model.slip_of(WORKING_TRACTION_RATIO, high),
        working_std=_std_over_runs([draw.slip_of(WORKING_TRACTION_RATIO) for draw in draws], len(runs)),
        band=Band(slips, *np.quantile(thrusts, [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], axis=0)),
        n_runs=len(runs),
        scores={name: float(np.mean(values)) for name, values in scores.items()},
    )


def _refitted(model: _Model, runs: Sequence[RunBins], resistances: Resistances, drawn: Array) -> _Model:
    """Return the model fitted to the runs of one bootstrap draw."""
    fit = fit_curve(model.law, [runs[i] for i in drawn], model.parameters)
    rho, _ = weighted_resistance(Resistances(resistances.ratio[drawn], resistances.std[drawn]))
    return _Model(model.law, fit.parameters, model.resistance_ratio if math.isnan(rho) else rho)


def _std_over_runs(draws: Sequence[float], n_runs: int) -> float:
    """Return the standard deviation of a slip by its draws and what all runs share; NaN without any."""
    known = np.array(draws)[np.isfinite(draws)]
    if len(known) < 2:
        return math.nan
    return math.hypot(float(np.std(known)) * math.sqrt(n_runs / (n_runs - 1)), SYSTEMATIC_SLIP_STD)


def insufficiency(runs: Sequence[RunBins]) -> str | None:
    """Return why runs do not suffice for a curve, as text; None where they do."""
    with_bins = [run for run in runs if len(run.slip_ratio)]
    if len(with_bins) < MIN_RUNS:
        return f"{len(with_bins)} runs with valid slip and traction, {MIN_RUNS} are needed"
    low, high = slip_range(with_bins)
    if high - low < MIN_RANGE_SLIP:
        return (
            f"two runs or more reach slips from {low:.3f} to {high:.3f} only, "
            f"a range of {MIN_RANGE_SLIP:g} is needed"
        )
    if sum(len(run.slip_ratio) for run in with_bins) < MIN_BINS:
        return f"fewer than {MIN_BINS} bins of slip"
    return None


def contradiction(curve: SlipCurve) -> str | None:
    """Return what contradicts a curve, as text; None where nothing does."""
    if curve.resistance_ratio < 0:
        return f"the estimated resistance is negative, {curve.resistance_ratio:.3f}"
    thrust = curve.thrust_ratio(np.linspace(*curve.slip_range, 201))
    if not thrust[-1] > thrust[0] or thrust.max() < MIN_THRUST_RATIO:
        return "the thrust does not rise with the slip"
    if curve.scores[curve.law] <= curve.scores[NO_CURVE]:
        return "left-out runs are predicted no better than without a curve"
    if thrust.max() <= curve.resistance_ratio or not math.isfinite(curve.balance_slip_ratio):
        return "no observed slip gives more thrust than the resistance"
    return None


def weighted_resistance(resistances: Resistances) -> tuple[float, float]:
    """Return the weighted mean of the runs' resistance over load and its std; NaN where none is known."""
    ratio, std = resistances.ratio[resistances.known], resistances.std[resistances.known]
    if not len(ratio):
        return math.nan, math.nan
    weight = std**-2.0
    mean = float(ratio @ weight / weight.sum())
    scatter = float(np.sum(weight * (ratio - mean) ** 2) / weight.sum()) / max(len(ratio) - 1, 1)
    return mean, math.sqrt(max(scatter, 1.0 / float(weight.sum())))
