"""The slip curve of a terrain: law, resistance, peak, and the target slips that it gives.

**Laws** of thrust over load against slip, those of :mod:`terrain.terramechanics.traction` divided by the load, with
the same parameters for all wheel loads::

    janosi   f = M (1 - (1 - exp(-s / k)) k / s)                       k = K / l
    magic    f = D sin(C atan(B s - E (B s - atan(B s))))

**Fit.**  Samples (slip s, thrust over load mu) of a run are correlated in time and share the run's terrain, load and
tyres, so they are gathered in bins of slip first, and each run has a factor g_r and an offset of slip b_r of
its own::

    mu = g_r f(s + b_r; theta)      g_r about 1, RUN_STD_RATIO; b_r about 0, SLIP_OFFSET_STD

Errors are in both axes: where the curve has the slope f', a bin has the variance ``var(mu) + f'^2 var(s)``
(effective variance; Orear, American Journal of Physics 50, 1982).

**Peak.**  Net traction (drawbar pull of a wheel over its load) is f(s) - rho, with the thrust over load f and the
resistance over load rho.  Its peak slip is

- where the largest net traction within the observed slips lies, if that is not within :data:`EDGE_SLIP` of
  their end (:attr:`PeakStatus.PEAK`);
- else the smallest slip with 95 % of the largest net traction within the observed slips
  (:attr:`PeakStatus.NO_PEAK`): on terrain that shears, traction rises monotonically, and more slip gains next
  to nothing.

Its 90 % interval is from a bootstrap over whole sessions or, of one session, over its runs (which shows nothing of
another day), so that it contains what differs between them, whether or not a factor describes it: the interval of the
curve's own peak, not that of a single new session; percentiles are taken further out as a few runs demand (expanded
percentile interval; Hesterberg, American Statistician 69 (4), 371-386, 2015).

**Targets** for traction, braking and steady motion, with weight W, wheel radius r and bearing friction T_f::

    eta(s) = (f - rho) / f (1 - s)      tractive efficiency
    E(s)   = (f W r + 3 T_f) w / v      energy a metre at the wheels

where w r / v is 1 / (1 - s) in traction and 1 - |s| in braking.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from terrain.bootstrap import bootstrap_rows
from terrain.constants import GRAVITY_MPS2
from terrain.identify import Parameter, identify, select
from terrain.records import Array
from terrain.robots import Robot
from terrain.slip_learning.forces import RunBins, slip_range

LAW_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "janosi": ("limit_ratio", "shear_ratio"),
    "magic": ("stiffness_ratio", "shape_ratio", "peak_friction_ratio", "curvature_ratio"),
}
"""Parameters of each law, in the order of :func:`traction_ratio`: M and k; B, C, D and E."""

LAW_BOUNDS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "janosi": ((1e-3, 1e-3), (5.0, 20.0)),
    "magic": ((0.1, 1.0, 1e-3, -5.0), (200.0, 2.3, 5.0, 1.0)),
}
"""Lower and upper bounds of each law's parameters, in their order."""


def traction_ratio(law: str, parameters: Sequence[float] | Array, slip_ratio: Array) -> Array:
    """Return the thrust over load (n,) at each slip (n,); odd in the slip.

    Examples
    --------
    >>> traction_ratio("janosi", (0.5, 0.4), np.array([-0.1, 0.0, 0.1, 0.4])).round(3)
    array([-0.058,  0.   ,  0.058,  0.184])
    >>> traction_ratio("magic", (10.0, 1.9, 1.0, 0.97), np.array([0.05, 0.18])).round(3)
    array([0.736, 1.   ])
    """
    magnitude = np.abs(slip_ratio)
    if law == "janosi":
        limit, shear = parameters
        x = magnitude / shear
        small = x < 1e-3
        safe = np.where(small, 1.0, x)
        return np.sign(slip_ratio) * limit * np.where(small, x / 2 - x * x / 6, 1 + np.expm1(-safe) / safe)
    stiffness, shape, peak, curvature = parameters
    x = stiffness * magnitude
    angle = shape * np.arctan(x - curvature * (x - np.arctan(x)))
    return np.sign(slip_ratio) * peak * np.maximum(np.sin(angle), 0.0)


def slip_at(law: str, parameters: Sequence[float], traction: float, high_slip: float = 1.0) -> float:
    """Return the smallest slip with a given thrust over load; NaN where no slip up to ``high_slip`` has it.

    Examples
    --------
    >>> round(slip_at("janosi", (0.5, 0.4), 0.1), 3)
    0.186
    """
    slips = np.linspace(0.0, high_slip, 2001)
    reached = traction_ratio(law, parameters, slips) >= traction
    if not reached.any():
        return math.nan
    first = int(np.argmax(reached))
    if first == 0:
        return 0.0
    f = traction_ratio(law, parameters, slips[first - 1 : first + 1])
    return float(np.interp(traction, f, slips[first - 1 : first + 1]))


RUN_STD_RATIO = 0.15
"""Prior standard deviation of a run's factor about 1: friction from place to place (8 %), and load."""

SLIP_OFFSET_STD = 0.004
"""Prior standard deviation of the offset of all slips of a run: half a percent of rolling radius a wheel
(data/spread), of three wheels."""

NO_CURVE = "none"  #: Name of the reference model of :func:`select_law`, which does not depend on the slip

_PRIOR = {"shape_ratio": (1.65, 1.0), "curvature_ratio": (0.5, 2.0)}
"""Mean and standard deviation: Pacejka's usual C of pure longitudinal slip, and E up to 1; they matter where
the data end before the peak."""

_MIN_VARIANCE = 1e-9


class _Pooled:
    """All bins of all runs, one after the other."""

    def __init__(self, runs: Sequence[RunBins]) -> None:
        self.n = len(runs)
        self.run = np.repeat(np.arange(self.n), [len(run.slip_ratio) for run in runs])
        self.slip, self.slip_std, self.traction, self.std = (
            np.concatenate([getattr(run, name) for run in runs])
            for name in ("slip_ratio", "slip_std", "traction_ratio", "traction_std")
        )

    def curve(self, law: str, theta: Sequence[float] | Array) -> tuple[Array, Array]:
        """Return value and slope (k,) of the curve at each bin."""
        f = traction_ratio(law, theta, self.slip)
        return f, (traction_ratio(law, theta, self.slip + 1e-4) - f) / 1e-4

    def variance(self, law: str, theta: Sequence[float] | Array) -> Array:
        """Return the effective variance (k,) of each bin."""
        by_slip = self.curve(law, theta)[1] * self.slip_std
        return np.asarray(np.maximum(self.std**2 + by_slip**2, _MIN_VARIANCE))

    def residuals(self, theta: Array, law: str, variance: Array) -> Array:
        """Return normalized residuals of bins and of the runs' priors, at the most likely terms of each run.

        ``mu = (1 + g) f + b f'`` is linear in both, with a prior on each: the solution is in closed form.
        """
        f, slope = self.curve(law, theta)
        residual = self.traction - f
        sums = [
            np.bincount(self.run, product / variance, self.n)
            for product in (f * f, f * slope, slope * slope, f * residual, slope * residual)
        ]
        gg, gb, bb = sums[0] + RUN_STD_RATIO**-2, sums[1], sums[2] + SLIP_OFFSET_STD**-2
        det = gg * bb - gb**2
        factor, offset = (bb * sums[3] - gb * sums[4]) / det, (gg * sums[4] - gb * sums[3]) / det
        left = (residual - factor[self.run] * f - offset[self.run] * slope) / np.sqrt(variance)
        return np.concatenate([left, factor / RUN_STD_RATIO, offset / SLIP_OFFSET_STD])

    def cost(self, law: str, theta: Array) -> float:
        """Return twice the negative log likelihood of the bins and of the priors, but for a constant."""
        variance, named = self.variance(law, theta), zip(LAW_PARAMETERS[law], theta, strict=True)
        priors = [(value - _PRIOR[name][0]) / _PRIOR[name][1] for name, value in named if name in _PRIOR]
        return float(
            np.sum(self.residuals(theta, law, variance) ** 2)
            + np.sum(np.log(variance))
            + np.sum(np.square(priors))
        )

    def log_likelihood(self, f: Array, slope: Array, variance: Array) -> float:
        """Return the log density of the bins of a single run, its factor and its offset integrated out."""
        effects = np.column_stack([f * RUN_STD_RATIO, slope * SLIP_OFFSET_STD])
        cov = np.diag(variance) + effects @ effects.T
        residual = self.traction - f
        _, log_det = np.linalg.slogdet(cov)
        mahalanobis = residual @ np.linalg.solve(cov, residual)
        return -0.5 * float(mahalanobis + log_det + len(f) * math.log(2 * math.pi))


def fit_curve(law: str, runs: Sequence[RunBins], start: Sequence[float] | None = None) -> tuple[float, ...]:
    """Return the parameters of a law fitted to runs, each with a factor and an offset of its own.

    Parameters
    ----------
    law : one of :data:`LAW_PARAMETERS`
    runs : at least one with a bin
    start : parameters to start from, of a fit to nearly the same runs; by default several starts are tried

    Notes
    -----
    The effective variance of a bin depends on the slope, hence on the fit: it is held constant during a
    search and then renewed.  If it changed within the search, a steep curve would excuse its own residuals.
    """
    pooled = _Pooled(runs)
    low, high = (np.array(bound) for bound in LAW_BOUNDS[law])
    rows, best, least = list(zip(LAW_PARAMETERS[law], *LAW_BOUNDS[law], strict=True)), (), math.inf
    guesses: list[Any] = [start]
    if start is None:
        top = max(float(np.quantile(pooled.traction, 0.95)), 0.02)
        reach = max(float(np.max(pooled.slip)), 0.05)
        guesses = [[top * scale, reach * part] for scale, part in ((1.2, 0.05), (1.5, 0.3), (3.0, 1.0))]
        if law == "magic":
            guesses = [
                [math.tan(math.pi / (2 * shape)) / (reach * part), shape, top, curvature]
                for part in (0.2, 0.5, 1.0)
                for shape, curvature in ((1.4, 0.0), (1.9, 0.9))
            ]
    for guess in guesses:
        theta = np.clip(guess, low + 1e-6, high - 1e-6)
        variance = pooled.std**2 if start is None else pooled.variance(law, theta)
        for _ in range(3 if start is None else 1):
            parameters = [
                Parameter(name, *(mean, lowest, highest, std), max(abs(value), 0.1))
                for (name, lowest, highest), value in zip(rows, theta.tolist(), strict=True)
                for mean, std in [_PRIOR.get(name, (value, math.inf))]
            ]
            residual = partial(pooled.residuals, law=law, variance=variance)
            found = identify(residual, parameters, starts=[theta], xtol=1e-5, ftol=1e-5, max_nfev=60)
            theta = np.clip(found.value, low + 1e-6, high - 1e-6)
            variance = pooled.variance(law, theta)
        if (cost := pooled.cost(law, theta)) < least or not best:
            best, least = tuple(theta.tolist()), cost
    return best


def select_law(runs: Sequence[RunBins]) -> tuple[str, tuple[float, ...], dict[str, Array]]:
    """Return the law that predicts left-out runs better, its parameters, and the scores of each by run.

    A score is the log likelihood of a run under a fit to other sessions or, of one session, to the other runs.
    ``magic`` is taken where it is better by more than a standard error, since it nearly contains the other.
    :data:`NO_CURVE` is a model that does not depend on the slip: the mean of the others' bins.
    """
    of_all = {law: fit_curve(law, runs) for law in LAW_PARAMETERS}

    def score(law: str, train: Array, test: Array) -> Array:
        others, found = [runs[i] for i in train], []
        traction = np.concatenate([other.traction_ratio for other in others])
        theta = () if law == NO_CURVE else fit_curve(law, others, of_all[law])
        for left_out in (_Pooled([runs[i]]) for i in test):
            f = np.full(len(left_out.slip), float(traction.mean()))
            slope, variance = np.zeros_like(f), left_out.std**2 + float(np.var(traction)) + _MIN_VARIANCE
            if law != NO_CURVE:
                (f, slope), variance = left_out.curve(law, theta), left_out.variance(law, theta)
            found.append(left_out.log_likelihood(f, slope, variance))
        return np.array(found)

    fold = np.empty(len(runs), dtype=int)
    for number, members in enumerate(units(runs)):
        fold[members] = number
    law, scores = select(score, list(LAW_PARAMETERS), fold)
    return law, of_all[law], {**scores, **select(score, [NO_CURVE], fold)[1]}


def units(runs: Sequence[RunBins]) -> list[list[int]]:
    """Return which runs each session has, those that name none as one; each run alone where there is one session."""
    names = sorted({run.session for run in runs})
    if len(names) < 2:
        return [[i] for i in range(len(runs))]
    return [[i for i, run in enumerate(runs) if run.session == name] for name in names]


INTERVAL = 0.9  #: Probability with which an interval contains the peak slip
QUANTILE = float(ndtri(0.5 + INTERVAL / 2))  #: Of the normal law
EDGE_SLIP = 0.03  #: A maximum this near the end of the observed slips may still rise beyond it

NEAR_PEAK_RATIO = 0.95
"""Part of the largest net traction that defines the peak slip of a curve without a peak."""

SHAPE_STD_RATIO = 0.02
"""Error of the thrust at one slip against that at another, a peak's slip apart, that all runs share: residue
of low-pass filter and lag.  It moves a flat peak further than a sharp one."""

SYSTEMATIC_SLIP_STD = 0.005
"""Error that all runs of a robot share, which no bootstrap contains: half a percent of rolling radius."""


class PeakStatus(StrEnum):
    """Kind of a peak slip."""

    PEAK = "peak"
    NO_PEAK = "no_peak"


class Peak(NamedTuple):
    """Slip at which net traction is largest or nearly so, and which of the two."""

    slip_ratio: float
    status: PeakStatus


def net_peak(
    net_ratio: Callable[[Array], Array],
    low_slip: float,
    high_slip: float,
    status: PeakStatus | None = None,
    n: int | None = None,
) -> Peak:
    """Return where net traction is largest within a range, or has 95 % of it where it rises to the end.

    Parameters
    ----------
    net_ratio : net traction at each of an array of slips, in any unit of force
    low_slip, high_slip : the range
    status : which of the two, of a bootstrap draw for instance; by default the one that the maximum's place says
    n : slips that are compared; one every 0.0005 by default

    Examples
    --------
    >>> net_peak(lambda s: 1 - (s - 0.2) ** 2, 0.0, 0.6)
    Peak(slip_ratio=0.2, status=<PeakStatus.PEAK: 'peak'>)
    >>> net_peak(lambda s: s, 0.0, 0.6)
    Peak(slip_ratio=0.57, status=<PeakStatus.NO_PEAK: 'no_peak'>)
    """
    slips = np.linspace(low_slip, high_slip, n or max(2, 1 + round((high_slip - low_slip) / 0.0005)))
    net = net_ratio(slips)
    best = top = int(np.argmax(net))
    if status is None:
        inside = slips[top] < high_slip - EDGE_SLIP and top > 0
        status = PeakStatus.PEAK if inside else PeakStatus.NO_PEAK
    if status is PeakStatus.NO_PEAK and net[top] > 0:
        best = int(np.argmax(net >= NEAR_PEAK_RATIO * net[top]))
    return Peak(float(slips[best]) if n else round(float(slips[best]), 6), status)


def peak_interval(
    draws: Array,
    runs: Sequence[RunBins],
    peak: Peak,
    tilted_net: Callable[[float, Array], Array],
    slip_range: tuple[float, float],
) -> tuple[float, float]:
    """Return the 90 % interval of a peak slip.

    What all runs share is the radius' error, and a tilt of the curve by :data:`SHAPE_STD_RATIO` over the peak's slip,
    or over the observed slips where there is no peak; it moves a flat peak further to one side than to the other.
    Runs that determine it have slips beyond it or, without a peak, in the upper half.

    Parameters
    ----------
    draws : (m,) peak slips of the bootstrap over sessions, or runs of one
    runs : behind the curve
    peak : of the curve
    tilted_net : net traction at each of an array of slips, of the thrust of the curve times 1 and a tilt a slip
    slip_range : smallest and largest slip observed
    """
    sharp = peak.status is PeakStatus.PEAK
    tilt = QUANTILE * SHAPE_STD_RATIO / max(peak.slip_ratio if sharp else slip_range[1], EDGE_SLIP)
    moved = (
        abs(net_peak(partial(tilted_net, by), *slip_range, peak.status, 1001).slip_ratio - peak.slip_ratio)
        for by in (-tilt, tilt)
    )
    less, more = (math.hypot(by, QUANTILE * SYSTEMATIC_SLIP_STD) for by in moved)
    beyond = peak.slip_ratio if sharp else slip_range[1] / 2
    informative = max(2, sum(any((runs[i].slip_ratio > beyond).any() for i in unit) for unit in units(runs)))
    return expanded_interval(draws, informative, peak.slip_ratio, (less, more))


def expanded_interval(
    draws: Array, n_units: int, centre: float, shared: tuple[float, float]
) -> tuple[float, float]:
    """Return the 90 % interval of a slip by its bootstrap draws over ``n_units`` sessions, or runs of one.

    The percentiles are those of the normal law at ``sqrt(n / (n - 1)) t``, the quantile of Student's law with
    n - 1 degrees of freedom; what all runs share, 90 % below and above, is added in squares.
    """
    quantile = math.sqrt(n_units / (n_units - 1)) * float(stdtrit(n_units - 1, 0.5 + INTERVAL / 2))
    tail = float(ndtr(-quantile))
    low, high = np.quantile(draws, [tail, 1 - tail])
    below, above = max(centre - float(low), 0.0), max(float(high) - centre, 0.0)
    return max(centre - math.hypot(below, shared[0]), 0.0), min(centre + math.hypot(above, shared[1]), 1.0)


MIN_RUNS = 3  #: Fewer runs do not show how runs differ
MIN_RANGE_SLIP = 0.1  #: Slips over less than this are a point of a curve and no curve
MIN_BINS = 8  #: Bins of all runs together that a curve is fitted to

WORKING_TRACTION_RATIO = 0.035
"""Net traction over load that a start requires: an acceleration of a third of a m/s^2, with which a robot is
behind by a tenth of the distance 5 s after a start to 1 m/s.  More traction costs slip for as long as the
start lasts."""

MIN_THRUST_RATIO = 0.02  #: Ice gives more: a curve that stays below is one without traction
N_BOOTSTRAP = 300  #: Draws of the bootstrap


@dataclass(frozen=True, slots=True, eq=False)
class SlipCurve:
    """What was learned of one terrain."""

    law: str  #: ``janosi`` or ``magic``
    parameters: tuple[float, ...]  #: by :data:`terrain.slip_learning.curve.LAW_PARAMETERS`
    resistance_ratio: float  #: resistance_ratio, resistance_std: rolling and compaction resistance over load
    resistance_std: float
    slip_range: tuple[float, float]  #: smallest and largest slip that two runs or more reach
    peak: Peak  #: of net traction
    peak_interval: tuple[float, float]  #: contains the peak slip with 90 %
    #: balance_slip_ratio, balance_std: where thrust and resistance are equal; NaN where they nowhere are
    balance_slip_ratio: float
    balance_std: float
    #: working_slip_ratio, working_std: slip of the net traction :data:`WORKING_TRACTION_RATIO`; NaN where no observed
    #: slip gives it
    working_slip_ratio: float
    working_std: float
    band: Array  #: (3, m) slips, and the 5 and 95 % quantiles of the law over the bootstrap at each
    n_runs: int  #: n_runs, n_sessions: the curve is fitted to
    n_sessions: int
    #: mean log likelihood of a left-out run, by law; and ``none``, of one thrust for all slips
    scores: Mapping[str, float]

    @property
    def peak_std(self) -> float:
        """Standard deviation of a normal law with the same interval."""
        return (self.peak_interval[1] - self.peak_interval[0]) / (2 * QUANTILE)

    def thrust_ratio(self, slip_ratio: Array) -> Array:
        """Return the thrust over load (n,) at each slip (n,)."""
        return traction_ratio(self.law, self.parameters, slip_ratio)


def learn_curve(
    runs: Sequence[RunBins],
    resistance_ratio: Array,
    resistance_std: Array,
    rng: np.random.Generator,
    n_bootstrap: int = N_BOOTSTRAP,
) -> SlipCurve:
    """Return the curve of a terrain.

    Parameters
    ----------
    runs : at least :data:`MIN_RUNS` with bins
    resistance_ratio, resistance_std : (runs,) resistance over load of each run and its deviation; NaN where unknown
    rng : of the bootstrap
    n_bootstrap : how many draws of sessions or, of one, runs

    Raises
    ------
    ValueError
        if the runs are too few or cover too little; call :func:`insufficiency` before.
    """
    if (why := insufficiency(runs)) is not None:
        raise ValueError(why)
    low, high = slip_range(runs)
    law, parameters, scores = select_law(runs)
    rho, rho_std = weighted_resistance(resistance_ratio, resistance_std)
    rho = 0.0 if -2 * rho_std < rho < 0 else rho  # slightly negative: not significantly different from none

    def net(theta: Sequence[float], resistance: float, tilt: float, slips: Array) -> Array:
        return traction_ratio(law, theta, slips) * (1.0 + tilt * slips) - resistance

    peak = net_peak(partial(net, parameters, rho, 0.0), low, high)
    slips, peaks, thrusts, places = np.linspace(0.0, high, 101), [], [], []
    sessions = units(runs)
    for rows in bootstrap_rows(len(sessions), n_bootstrap, rng):
        drawn = [i for row in rows for i in sessions[row]]
        theta = fit_curve(law, [runs[i] for i in drawn], parameters)
        again, _ = weighted_resistance(resistance_ratio[drawn], resistance_std[drawn])
        again = rho if math.isnan(again) else again
        peaks.append(net_peak(partial(net, theta, again, 0.0), low, high, peak.status, 1001).slip_ratio)
        thrusts.append(traction_ratio(law, theta, slips))
        places.append([slip_at(law, theta, again + by) for by in (0.0, WORKING_TRACTION_RATIO)])
    stds = []  # of balance and working slip: that of the draws, and what all runs share
    for column in np.array(places).T:
        known, spread = column[np.isfinite(column)], math.sqrt(len(sessions) / (len(sessions) - 1))
        scatter = float(np.std(known)) * spread if len(known) > 1 else math.nan
        stds.append(math.hypot(scatter, SYSTEMATIC_SLIP_STD))
    return SlipCurve(
        law=law,
        parameters=parameters,
        resistance_ratio=rho,
        resistance_std=rho_std,
        slip_range=(low, high),
        peak=peak,
        peak_interval=peak_interval(np.array(peaks), runs, peak, partial(net, parameters, rho), (low, high)),
        balance_slip_ratio=slip_at(law, parameters, rho),
        balance_std=stds[0],
        working_slip_ratio=slip_at(law, parameters, rho + WORKING_TRACTION_RATIO, high),
        working_std=stds[1],
        band=np.vstack([slips, np.quantile(thrusts, [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], axis=0)]),
        n_runs=len(runs),
        n_sessions=len({run.session for run in runs}),
        scores={name: float(np.mean(values)) for name, values in scores.items()},
    )


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


def weighted_resistance(ratio: Array, std: Array) -> tuple[float, float]:
    """Return the weighted mean of the runs' resistance over load (runs,) and its std; NaN where none is known."""
    known = np.isfinite(ratio) & np.isfinite(std)
    if not known.any():
        return math.nan, math.nan
    ratio, weight = ratio[known], std[known] ** -2.0
    mean = float(ratio @ weight / weight.sum())
    scatter = float(np.sum(weight * (ratio - mean) ** 2) / weight.sum()) / max(len(ratio) - 1, 1)
    return mean, math.sqrt(max(scatter, 1.0 / float(weight.sum())))


PEAK_SLIP_RATIO = 0.9
"""Target of traction over the peak slip: beyond the peak more slip gives less traction and a wheel spins up,
and the thrust at nine tenths of the peak slip is within a hundredth of it."""

MIN_ABOVE_BALANCE_SLIP = 0.03
"""Traction has to differ from steady motion by more than the error of the slip, or no robot would start."""

BRAKING_CAP_SLIP = 0.3
"""Where thrust rises monotonically, a wheel is not braked further: it would gain little, lose its side force
with the slip, and plough instead of roll."""


class TargetSlip(NamedTuple):
    """A target slip, its standard deviation, and what it is derived from."""

    slip_ratio: float
    slip_std: float
    source: str


def targets_of(curve: SlipCurve) -> dict[str, TargetSlip]:
    """Return the targets of a terrain by drive state: braking <= 0 <= steady <= traction.

    Traction is near the peak, but not beyond what a start requires, as more slip only costs energy, and at least
    :data:`MIN_ABOVE_BALANCE_SLIP` above steady motion.  Braking is the peak slip mirrored; where there is no peak, at
    most :data:`BRAKING_CAP_SLIP`.
    """
    n = f"{curve.n_runs} runs, {curve.law}{', within one session' if curve.n_sessions == 1 else ''}"
    slip, std, sharp = curve.peak.slip_ratio, curve.peak_std, curve.peak.status is PeakStatus.PEAK
    name = "the peak slip" if sharp else "the slip at 95 % of the largest traction"
    steady = TargetSlip(
        max(curve.balance_slip_ratio, 0.0), curve.balance_std, f"balance with the resistance; {n}"
    )
    traction = TargetSlip(
        PEAK_SLIP_RATIO * slip, PEAK_SLIP_RATIO * std, f"{PEAK_SLIP_RATIO:g} of {name}; {n}"
    )
    if curve.working_slip_ratio < traction.slip_ratio:
        traction = TargetSlip(curve.working_slip_ratio, curve.working_std, f"net traction of a start; {n}")
    least = steady.slip_ratio + MIN_ABOVE_BALANCE_SLIP
    if traction.slip_ratio < least:
        traction = TargetSlip(least, curve.balance_std, f"just above balance; {n}")
    braking = TargetSlip(-slip, std, f"{name}{'' if sharp else ','} mirrored; {n}")
    if not sharp and slip > BRAKING_CAP_SLIP:
        braking = TargetSlip(
            -BRAKING_CAP_SLIP, SYSTEMATIC_SLIP_STD, f"capped: thrust rises monotonically; {n}"
        )
    return {"traction": traction, "braking": braking, "steady": steady}


def tractive_efficiency(curve: SlipCurve, slip_ratio: float) -> float:
    """Return the work of net traction over that of a wheel; NaN without thrust."""
    thrust = float(curve.thrust_ratio(np.array([slip_ratio]))[0])
    return (thrust - curve.resistance_ratio) / thrust * (1.0 - slip_ratio) if thrust > 0 else math.nan


def energy_jpm(curve: SlipCurve, slip_ratio: float, robot: Robot) -> float:
    """Return the energy in J a metre at the wheels of the robot without payload; negative in recuperation."""
    thrust = float(curve.thrust_ratio(np.array([slip_ratio]))[0])
    turns = 1.0 / (1.0 - slip_ratio) if slip_ratio >= 0 else 1.0 + slip_ratio
    friction_n = len(robot.wheels) * robot.motors.friction_nm / robot.wheel_radius_m
    return (thrust * robot.mass_kg * GRAVITY_MPS2 + friction_n) * turns
