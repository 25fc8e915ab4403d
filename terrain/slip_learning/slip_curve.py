"""Traction over slip of one terrain, learned from runs: the law, its peak, and how sure that is.

A run gives points (slip s, thrust over load mu).  They hang together from one moment to the next and share
the run's soil, load and tyres, so they are gathered in bins of slip first, and each run has a factor g_r and
an offset of slip b_r of its own::

    mu = g_r f(s + b_r; theta)      g_r about 1, RUN_STD_RATIO; b_r about 0, SLIP_OFFSET_STD

    janosi   f = M (1 - (1 - exp(-s / k)) k / s)                       k = K / l
    magic    f = D sin(C atan(B s - E (B s - atan(B s))))

(:mod:`terrain.terramechanics.traction`).  Errors are in both axes: with a curve of slope f', a bin counts
with the variance ``var(mu) + f'^2 var(s)`` (effective variance; Orear, American Journal of Physics 50, 1982).
The law is the one that foretells left-out runs better; the peaked one has to do so by more than its standard
error, since it holds the other nearly.

Net pull is f(s) - rho, with the resistance over load rho.  ``peak_slip`` is

- where the largest net pull within the slips seen lies, if that is not within :data:`EDGE_SLIP` of their end
  (status ``peak``);
- else the least slip with 95 % of the largest net pull within the slips seen (status ``no_peak``): on ground
  that shears, the pull rises for ever, and more slip buys next to nothing.

Its 90 % interval is from a bootstrap over whole runs, so that what differs from run to run is in it, whether
or not a factor describes it; percentiles are taken further out as a few runs demand (expanded percentile
interval; Hesterberg, What teachers should know about the bootstrap, American Statistician 69, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr, ndtri, stdtrit

from terrain.records import Array, read_only

LAW_PARAMETERS: dict[str, tuple[str, ...]] = {
    "janosi": ("limit_ratio", "shear_ratio"),
    "magic": ("stiffness_ratio", "shape_ratio", "peak_friction_ratio", "curvature_ratio"),
}
"""Numbers of each law, in the order of :func:`traction_ratio`: M and k; B, C, D and E."""

BIN_EDGES = (
    *(-0.02, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.09, 0.12, 0.15, 0.18, 0.21, 0.24, 0.27),
    *(0.3, 0.34, 0.38, 0.42, 0.46, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0),
)
"""Bins of slip: narrow where hard ground has its bend."""

MIN_IN_BIN = 2
"""Samples that make a bin."""

BIN_STD_RATIO, BIN_STD = 0.03, 0.003
"""Share of its thrust, and thrust over load, by which the mean of even a full bin errs: ground varies along
the way by 3 % (data/soils), and no law is exact.  It keeps long bins from drowning the others."""

RUN_STD_RATIO = 0.15
"""How far a run's factor is believed to lie from 1: friction from place to place (8 %), and load."""

SLIP_OFFSET_STD = 0.004
"""How far all slips of a run are off: half a percent of rolling radius a wheel (data/spread), of three
wheels."""

EDGE_SLIP = 0.03
"""A maximum this near the end of the slips seen may still rise beyond it."""

NEAR_PEAK_SHARE = 0.95
"""Share of the largest net pull that a curve without a peak is asked for."""

MIN_RUNS = 3
"""Fewer runs tell nothing of how runs differ."""

MIN_RANGE_SLIP = 0.1
"""Slips seen over less than this are a point of a curve and no curve."""

MIN_BINS = 8
"""Bins of all runs together that a curve is fitted to."""

SHAPE_STD_RATIO = 0.02
"""Error of the thrust at one slip against that at another, a peak's slip apart, of all runs alike: what
low-pass and lag leave.  It moves a flat peak further than a sharp one."""

WORKING_PULL_RATIO = 0.035
"""Net pull over weight that a start asks for: it gains a third of a m/s^2, by which a tenth of the way is
missing 5 s after a start at 1 m/s^2.  More pull costs slip for as long as the start lasts."""

SYSTEMATIC_SLIP_STD = 0.005
"""What all runs of a robot share, and no bootstrap sees: half a percent of rolling radius."""

LEAST_THRUST_RATIO = 0.02
"""Ice gives more: a curve that stays below saw no traction."""

INTERVAL = 0.9
N_BOOTSTRAP = 300

_MAGIC_PRIOR = {"shape_ratio": (1.65, 1.0), "curvature_ratio": (0.5, 2.0)}
"""Pacejka's usual C of pure longitudinal slip, and E up to 1: they matter where the data stop before the
peak."""

LAW_BOUNDS = {
    "janosi": ((1e-3, 1e-3), (5.0, 20.0)),
    "magic": ((0.1, 1.0, 1e-3, -5.0), (200.0, 2.3, 5.0, 1.0)),
}
"""Least and most of each law's parameters, in their order."""

_LEAST_VARIANCE = 1e-9


class RunBins(NamedTuple):
    """Bins of slip of one run: mean slip, its std, mean thrust over load, its std; (k,) each."""

    run_id: str
    slip_ratio: Array
    slip_std: Array
    traction_ratio: Array
    traction_std: Array


class Fit(NamedTuple):
    """A law with its numbers, the factor of each run, and the mean squared residual of a bin."""

    law: str
    parameters: tuple[float, ...]
    run_factors: tuple[float, ...]
    misfit: float


class Peak(NamedTuple):
    """Where a net pull is largest or nearly so (see the module), and which of the two."""

    slip_ratio: float
    status: str


@dataclass(frozen=True, slots=True, eq=False)
class SlipCurve:
    """What runs tell of one terrain.

    Parameters
    ----------
    law : ``janosi`` or ``magic``
    parameters : by :data:`LAW_PARAMETERS`
    resistance_ratio, resistance_std : rolling and compaction over load
    slip_range : least and largest slip that two runs or more reach
    peak : of the net pull
    peak_interval : that holds its slip with 90 %
    balance_slip_ratio, balance_std : where thrust and resistance are equal; NaN where they nowhere are
    working_slip_ratio, working_std : slip that gives :data:`WORKING_PULL_RATIO`; NaN where no slip seen does
    band : (m, 3) slips, and 5 and 95 % of the thrust over load at each
    n_runs : behind it
    scores : log likelihood of left-out runs, a run, by law; and ``none``, of one number for all slips
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
    band: Array
    n_runs: int
    scores: dict[str, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "band", read_only(self.band))

    @property
    def peak_std(self) -> float:
        """Standard deviation that a normal law of the same interval has."""
        return (self.peak_interval[1] - self.peak_interval[0]) / (2 * float(ndtri(0.5 + INTERVAL / 2)))


def traction_ratio(law: str, parameters: Sequence[float], slip_ratio: Array) -> Array:
    """Return the thrust over load (n,) at each slip (n,); odd in the slip.

    Examples
    --------
    >>> traction_ratio("janosi", (0.5, 0.4), np.array([-0.1, 0.0, 0.1, 0.4])).round(3)
    array([-0.058,  0.   ,  0.058,  0.184])
    >>> traction_ratio("magic", (10.0, 1.9, 1.0, 0.97), np.array([0.05, 0.18])).round(3)
    array([0.736, 1.   ])
    """
    size = np.abs(slip_ratio)
    if law == "janosi":
        limit, shear = parameters
        x = size / shear
        small = x < 1e-3
        safe = np.where(small, 1.0, x)
        return np.sign(slip_ratio) * limit * np.where(small, x / 2 - x * x / 6, 1 + np.expm1(-safe) / safe)
    stiffness, shape, peak, curvature = parameters
    x = stiffness * size
    angle = shape * np.arctan(x - curvature * (x - np.arctan(x)))
    return np.sign(slip_ratio) * peak * np.maximum(np.sin(angle), 0.0)


def run_bins(run_id: str, samples: Array) -> RunBins:
    """Return the bins of one run's samples.

    Parameters
    ----------
    run_id : of the run
    samples : (k, 5) slip, its std, thrust over load, its std and its lag
        (:func:`terrain.slip_learning.wheel_pull.pull_samples`)
    """
    place = np.digitize(samples[:, 0], BIN_EDGES)
    rows = []
    for number in range(1, len(BIN_EDGES)):
        inside = samples[place == number]
        if len(inside) < MIN_IN_BIN:
            continue
        slip, slip_std, traction, traction_std, lag = inside.T
        rest = traction - traction.mean()
        scatter = float(np.sqrt((rest @ rest) / (len(inside) - 1) / len(inside)))
        level = BIN_STD + BIN_STD_RATIO * abs(float(traction.mean()))
        noise = max(scatter, float(traction_std.mean()) / math.sqrt(len(inside)))
        std = math.hypot(noise, level, float(lag.mean()))
        slip_mean_std = math.sqrt(float((slip_std**2).mean()) / len(inside))
        rows.append((slip.mean(), slip_mean_std, traction.mean(), std))
    return RunBins(run_id, *np.array(rows).reshape(-1, 4).T)


def fit_curve(law: str, runs: Sequence[RunBins], start: Sequence[float] | None = None) -> Fit:
    """Return a law fitted to runs, each with a factor and an offset of its own.

    Parameters
    ----------
    law : one of :data:`LAW_PARAMETERS`
    runs : at least one with a bin
    start : numbers to start from, of a fit to nearly the same runs; by default several starts are tried

    Notes
    -----
    The effective variance of a bin depends on the slope, hence on the fit: it is held while the numbers are
    sought and then renewed.  Sought together, a steep curve would excuse its own residuals.
    """
    pooled = _Pooled(runs)
    low, high = (np.array(bound) for bound in LAW_BOUNDS[law])
    starts = [np.asarray(start)] if start is not None else _starts(law, pooled)
    best: tuple[float, Array] | None = None
    for guess in starts:
        theta = np.clip(guess, low + 1e-6, high - 1e-6)
        variance = pooled.variance(law, theta) if start is not None else pooled.std**2
        for _ in range(1 if start is not None else 3):
            found = least_squares(
                pooled.residuals,
                theta,
                args=(law, variance),
                bounds=(low, high),
                x_scale=np.maximum(np.abs(theta), 0.1),
                xtol=1e-5,
                ftol=1e-5,
                gtol=1e-8,
                max_nfev=60,
            )
            theta = np.clip(found.x, low + 1e-6, high - 1e-6)
            variance = pooled.variance(law, theta)
        cost = float(np.sum(pooled.residuals(theta, law, variance) ** 2) + np.sum(np.log(variance)))
        if best is None or cost < best[0]:
            best = cost, theta
    assert best is not None
    theta = best[1]
    variance = pooled.variance(law, theta)
    own, rest = pooled.own(law, theta, variance)
    misfit = float(np.mean(rest**2 / variance))
    return Fit(law, tuple(float(x) for x in theta), tuple(1.0 + float(g) for g in own[:, 0]), misfit)


class _Pooled:
    """All bins of all runs in one row."""

    def __init__(self, runs: Sequence[RunBins]) -> None:
        self.n = len(runs)
        self.run = np.repeat(np.arange(self.n), [len(run.slip_ratio) for run in runs])
        self.slip, self.slip_std, self.traction, self.std = (
            np.concatenate([getattr(run, name) for run in runs])
            for name in ("slip_ratio", "slip_std", "traction_ratio", "traction_std")
        )

    def curve(self, law: str, theta: Any) -> tuple[Array, Array]:
        """Return value and slope (k,) of the curve at each bin."""
        f = traction_ratio(law, theta, self.slip)
        return f, (traction_ratio(law, theta, self.slip + 1e-4) - f) / 1e-4

    def variance(self, law: str, theta: Any) -> Array:
        """Return the effective variance (k,) of each bin."""
        by_slip = self.curve(law, theta)[1] * self.slip_std
        return np.asarray(np.maximum(self.std**2 + by_slip**2, _LEAST_VARIANCE))

    def own(self, law: str, theta: Any, variance: Array) -> tuple[Array, Array]:
        """Return each run's own factor less 1 and offset of slip (n, 2), at their best, and what rests (k,).

        ``mu = (1 + g) f + b f'``: linear, with a belief about each, so the best is in closed form.
        """
        f, slope = self.curve(law, theta)
        rest = self.traction - f
        of_run = [
            np.bincount(self.run, row / variance, self.n)
            for row in (f * f, f * slope, slope * slope, f * rest, slope * rest)
        ]
        gg, gb, bb = of_run[0] + RUN_STD_RATIO**-2, of_run[1], of_run[2] + SLIP_OFFSET_STD**-2
        det = gg * bb - gb**2
        own = (
            np.column_stack([bb * of_run[3] - gb * of_run[4], gg * of_run[4] - gb * of_run[3]]) / det[:, None]
        )
        return own, rest - own[self.run, 0] * f - own[self.run, 1] * slope

    def residuals(self, theta: Array, law: str, variance: Array) -> Array:
        """Return residuals of bins, of what is each run's own, and of what is believed of the law."""
        own, rest = self.own(law, theta, variance)
        parts = [rest / np.sqrt(variance), own[:, 0] / RUN_STD_RATIO, own[:, 1] / SLIP_OFFSET_STD]
        if law == "magic":
            places = {name: place for place, name in enumerate(LAW_PARAMETERS[law])}
            beliefs = [(theta[places[name]] - mean) / std for name, (mean, std) in _MAGIC_PRIOR.items()]
            parts.append(np.array(beliefs))
        return np.concatenate(parts)

    def log_likelihood(self, f: Array, slope: Array, variance: Array) -> float:
        """Return the log density of the bins of a single run, its factor and its offset integrated out."""
        ways = np.column_stack([f * RUN_STD_RATIO, slope * SLIP_OFFSET_STD])
        cov = np.diag(variance) + ways @ ways.T
        rest = self.traction - f
        _, log_det = np.linalg.slogdet(cov)
        return -0.5 * float(rest @ np.linalg.solve(cov, rest) + log_det + len(f) * math.log(2 * math.pi))


def _starts(law: str, pooled: _Pooled) -> list[Array]:
    top = max(float(np.quantile(pooled.traction, 0.95)), 0.02)
    reach = max(float(np.max(pooled.slip)), 0.05)
    if law == "janosi":
        return [
            np.array([top * scale, reach * part]) for scale, part in ((1.2, 0.05), (1.5, 0.3), (3.0, 1.0))
        ]
    return [
        np.array([math.tan(math.pi / (2 * shape)) / (reach * part), shape, top, curvature])
        for part in (0.2, 0.5, 1.0)
        for shape, curvature in ((1.4, 0.0), (1.9, 0.9))
    ]


def slip_range(runs: Sequence[RunBins]) -> tuple[float, float]:
    """Return the least and the largest slip that two runs or more reach; NaN where no two runs have bins.

    Examples
    --------
    >>> def bins(*slips):
    ...     return RunBins("r", np.array(slips), *np.zeros((3, len(slips))))
    >>> slip_range([bins(0.01, 0.3), bins(0.05, 0.5), bins(0.03, 0.4)])
    (0.03, 0.4)
    """
    held = [run.slip_ratio for run in runs if len(run.slip_ratio)]
    if len(held) < 2:
        return math.nan, math.nan
    return max(0.0, float(sorted(min(s) for s in held)[1])), float(sorted(max(s) for s in held)[-2])


def net_peak(net_ratio: Callable[[Array], Array], low_slip: float, high_slip: float) -> Peak:
    """Return where a net pull is largest within a range, or has 95 % of it where it rises to the end.

    Parameters
    ----------
    net_ratio : net pull at each of an array of slips, in any unit of force
    low_slip, high_slip : the range

    Examples
    --------
    >>> net_peak(lambda s: 1 - (s - 0.2) ** 2, 0.0, 0.6)
    Peak(slip_ratio=0.2, status='peak')
    >>> net_peak(lambda s: s, 0.0, 0.6)
    Peak(slip_ratio=0.57, status='no_peak')
    """
    slips = np.linspace(low_slip, high_slip, max(2, 1 + round((high_slip - low_slip) / 0.0005)))
    net = net_ratio(slips)
    top = int(np.argmax(net))
    if slips[top] < high_slip - EDGE_SLIP and top > 0:
        return Peak(round(float(slips[top]), 6), "peak")
    near = net >= NEAR_PEAK_SHARE * net[top] if net[top] > 0 else np.arange(len(net)) >= top
    return Peak(round(float(slips[int(np.argmax(near))]), 6), "no_peak")


def slip_at(law: str, parameters: Sequence[float], traction: float, high_slip: float = 1.0) -> float:
    """Return the least slip that gives a thrust over load; NaN where no slip up to ``high_slip`` does.

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


def left_out_scores(runs: Sequence[RunBins]) -> dict[str, Array]:
    """Return the log likelihood (n,) of each run under what the others teach, by law.

    ``none`` is a curve that does not know the slip: the mean of the others' bins.
    """
    scores: dict[str, list[float]] = {law: [] for law in (*LAW_PARAMETERS, "none")}
    whole = {law: fit_curve(law, runs).parameters for law in LAW_PARAMETERS}
    for out, run in enumerate(runs):
        others = [other for number, other in enumerate(runs) if number != out]
        left = _Pooled([run])
        for law in LAW_PARAMETERS:
            trained = fit_curve(law, others, whole[law])
            scores[law].append(
                left.log_likelihood(
                    *left.curve(law, trained.parameters), left.variance(law, trained.parameters)
                )
            )
        rest = np.concatenate([other.traction_ratio for other in others])
        variance = left.std**2 + float(np.var(rest)) + _LEAST_VARIANCE
        level = np.full(len(left.slip), float(rest.mean()))
        scores["none"].append(left.log_likelihood(level, np.zeros_like(level), variance))
    return {law: np.array(values) for law, values in scores.items()}


def chosen_law(scores: dict[str, Array]) -> str:
    """Return the law: ``magic`` where it foretells left-out runs better by more than a standard error.

    Examples
    --------
    >>> chosen_law({"janosi": np.array([1.0, 2.0, 3.0]), "magic": np.array([4.0, 5.5, 6.0])})
    'magic'
    """
    gain = scores["magic"] - scores["janosi"]
    error = float(np.std(gain, ddof=1)) / math.sqrt(len(gain))
    return "magic" if float(np.mean(gain)) > error else "janosi"


def learn_curve(
    runs: Sequence[RunBins],
    resistance: Array,
    rng: np.random.Generator,
    n_bootstrap: int = N_BOOTSTRAP,
) -> SlipCurve:
    """Return the curve of a terrain.

    Parameters
    ----------
    runs : at least :data:`MIN_RUNS` with bins
    resistance : (runs, 2) resistance over load of each run and its std; NaN where a run does not tell it
    rng : of the bootstrap
    n_bootstrap : how many draws of runs

    Raises
    ------
    ValueError
        if the runs are too few or cover too little; ask :func:`too_little` before.
    """
    if (why := too_little(runs)) is not None:
        raise ValueError(why)
    low, high = slip_range(runs)
    by_law = left_out_scores(runs)
    law = chosen_law(by_law)
    fit = fit_curve(law, runs)
    rho, rho_std = weighted_resistance(resistance)
    rho = 0.0 if -2 * rho_std < rho < 0 else rho  # a little below nothing is nothing
    peak = net_peak(lambda s: traction_ratio(law, fit.parameters, s) - rho, low, high)
    slips = np.linspace(0.0, high, 101)
    peaks, curves = [], []
    slips_at: tuple[list[float], list[float]] = [], []
    for _ in range(n_bootstrap):
        drawn = rng.integers(len(runs), size=len(runs))
        again = fit_curve(law, [runs[i] for i in drawn], fit.parameters)
        r = weighted_resistance(resistance[drawn])[0]
        r = rho if math.isnan(r) else r
        theta = again.parameters
        peaks.append(_same_kind(peak.status, law, theta, r, low, high))
        for found, pull in zip(slips_at, (0.0, WORKING_PULL_RATIO), strict=True):
            found.append(slip_at(law, theta, r + pull))
        curves.append(traction_ratio(law, theta, slips))
    shared = math.hypot(SYSTEMATIC_SLIP_STD, _flatness(law, fit.parameters, peak, high))
    interval = expanded_interval(np.array(peaks), telling_runs(runs, peak, high), peak.slip_ratio, shared)
    band = np.quantile(np.array(curves), [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], axis=0)
    return SlipCurve(
        law=law,
        parameters=fit.parameters,
        resistance_ratio=rho,
        resistance_std=rho_std,
        slip_range=(low, high),
        peak=peak,
        peak_interval=interval,
        balance_slip_ratio=slip_at(law, fit.parameters, rho),
        balance_std=_std_over_runs(slips_at[0], len(runs)),
        working_slip_ratio=slip_at(law, fit.parameters, rho + WORKING_PULL_RATIO, high),
        working_std=_std_over_runs(slips_at[1], len(runs)),
        band=np.column_stack([slips, band.T]),
        n_runs=len(runs),
        scores={name: float(np.mean(values)) for name, values in by_law.items()},
    )


def _std_over_runs(draws: Sequence[float], n_runs: int) -> float:
    """Return the standard deviation of a slip by its draws and what all runs share; NaN without any."""
    known = np.array(draws)[np.isfinite(draws)]
    if len(known) < 2:
        return math.nan
    return math.hypot(float(np.std(known)) * math.sqrt(n_runs / (n_runs - 1)), SYSTEMATIC_SLIP_STD)


def _same_kind(status: str, law: str, theta: Sequence[float], rho: float, low: float, high: float) -> float:
    """Return the slip of the largest net pull, or of 95 % of it, as the curve itself was asked."""
    slips = np.linspace(low, high, 1001)
    net = traction_ratio(law, theta, slips) - rho
    top = int(np.argmax(net))
    if status == "peak" or net[top] <= 0:
        return float(slips[top])
    return float(slips[int(np.argmax(net >= NEAR_PEAK_SHARE * net[top]))])


def too_little(runs: Sequence[RunBins]) -> str | None:
    """Return why runs do not suffice for a curve, in words; None where they do."""
    held = [run for run in runs if len(run.slip_ratio)]
    if len(held) < MIN_RUNS:
        return f"{len(held)} runs with believable slip and pull, {MIN_RUNS} are needed"
    low, high = slip_range(held)
    if high - low < MIN_RANGE_SLIP:
        return f"two runs see slips from {low:.3f} to {high:.3f} only, {MIN_RANGE_SLIP:g} of range is needed"
    if sum(len(run.slip_ratio) for run in held) < MIN_BINS:
        return f"fewer than {MIN_BINS} bins of slip"
    return None


def contradiction(curve: SlipCurve) -> str | None:
    """Return what speaks against a curve, in words; None where nothing does."""
    if curve.resistance_ratio < 0:
        return f"the resistance comes out negative, {curve.resistance_ratio:.3f}"
    slips = np.linspace(*curve.slip_range, 201)
    thrust = traction_ratio(curve.law, curve.parameters, slips)
    if not thrust[-1] > thrust[0] or thrust.max() < LEAST_THRUST_RATIO:
        return "the thrust does not rise with the slip"
    if curve.scores[curve.law] <= curve.scores["none"]:
        return "left-out runs are foretold no better than without a curve"
    if thrust.max() <= curve.resistance_ratio or not math.isfinite(curve.balance_slip_ratio):
        return "no slip seen gives more thrust than the resistance"
    return None


def weighted_resistance(resistance: Array) -> tuple[float, float]:
    """Return the mean resistance over load and its std, of runs (n, 2) with their own; NaN without any."""
    known = resistance[np.isfinite(resistance).all(axis=1)]
    if not len(known):
        return math.nan, math.nan
    weight = known[:, 1] ** -2.0
    mean = float(known[:, 0] @ weight / weight.sum())
    scatter = float(np.sum(weight * (known[:, 0] - mean) ** 2) / weight.sum()) / max(len(known) - 1, 1)
    return mean, math.sqrt(max(scatter, 1.0 / float(weight.sum())))


def _flatness(law: str, theta: Sequence[float], peak: Peak, high_slip: float) -> float:
    """Return how far a tilt of the curve by :data:`SHAPE_STD_RATIO` moves a peak or the slip at 95 %.

    Near a peak ``f = f_0 (1 - a (s - s_0)^2)``, with a by what f has lost a third of the way back; the tilt
    is over the peak's slip.  Without a peak, the tilt over the slips seen lifts f here against f there.
    """
    slip = peak.slip_ratio
    here = traction_ratio(law, theta, np.array([slip - 1e-3, slip, 2 / 3 * slip]))
    if peak.status == "no_peak":
        slope = max((here[1] - here[0]) / 1e-3, 1e-6)
        moved = SHAPE_STD_RATIO * here[1] * (high_slip - slip) / high_slip / slope
    else:
        moved = SHAPE_STD_RATIO / (2 * max(1.0 - here[2] / here[1], 1e-4) / (slip / 3) ** 2 * slip)
    return float(min(moved, slip / 2))


def telling_runs(runs: Sequence[RunBins], peak: Peak, high_slip: float) -> int:
    """Return how many runs tell of a peak, 2 or more: with slips beyond it or, without, in the upper half."""
    beyond = peak.slip_ratio if peak.status == "peak" else high_slip / 2
    return max(2, sum(bool((run.slip_ratio > beyond).any()) for run in runs))


def expanded_interval(
    draws: Array, n_runs: int, centre: float, shared_std: float = SYSTEMATIC_SLIP_STD
) -> tuple[float, float]:
    """Return the 90 % interval of a number by its bootstrap draws over ``n_runs`` runs.

    The percentiles are those of the normal law at ``sqrt(n / (n - 1)) t``, the quantile of Student's law with
    n - 1 degrees of freedom; what all runs share is added to both sides in squares.
    """
    wide = math.sqrt(n_runs / (n_runs - 1)) * float(stdtrit(n_runs - 1, 0.5 + INTERVAL / 2))
    share = float(ndtr(-wide))
    low, high = np.quantile(draws, [share, 1 - share])
    shared = shared_std * float(ndtri(0.5 + INTERVAL / 2))
    low, high = min(float(low), centre), max(float(high), centre)
    return (
        max(centre - math.hypot(centre - low, shared), 0.0),
        min(centre + math.hypot(high - centre, shared), 1.0),
    )
