"""Runs beside the simulation, before and after causes are built in: for figures and sentences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import welch
from scipy.stats import t as student

from terrain.discrepancy.noise import Noise
from terrain.discrepancy.residuals import INPUTS, LowPass, measured_channels, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS
from terrain.records import Array

STRETCH_S = 20.0  #: Length of the stretch that is drawn large.
STRETCH_STEP_S = 1.0  #: Distance of the stretches among which it is chosen.
#: Quantile of the residuals' size at which the example is chosen, among runs and among stretches of a run.
EXAMPLE_QUANTILE = 0.8

MIN_SPREAD = 0.01  #: Range of an input in its own unit, below which no dependence can be seen.


class ComparedRun(NamedTuple):
    """A run beside the simulation, low-pass filtered, faults repaired."""

    run_id: str  #: of the run
    terrain: str
    held_out: bool  #: whether it was held out of the diagnosis
    time_s: Array  #: (m,)
    pace_mps: Array  #: (m,) speed of the wheels, with which noise grows
    measured: Array  #: (m, channels)
    before: Array
    after: Array | None  #: (m, channels) with the causes built in; None where none was named
    #: (m,) of the simulation, by the names of :data:`terrain.discrepancy.residuals.INPUTS`, and ``time_s``
    inputs: Mapping[str, Array]

    def part(self, start_s: float, end_s: float) -> ComparedRun:
        """Return the stretch from start to end."""
        inside = (self.time_s >= start_s) & (self.time_s <= end_s)
        arrays: dict[str, Any] = {
            name: values[inside] for name, values in self._asdict().items() if isinstance(values, np.ndarray)
        }
        return self._replace(**arrays, inputs={name: values[inside] for name, values in self.inputs.items()})

    def residual(self, extended: bool) -> Array:
        """Return measured minus simulated (m, channels), by the extended simulation or the one before."""
        simulated = self.after if extended else self.before
        assert simulated is not None
        return self.measured - simulated


def compare_runs(
    simulation: Simulation,
    extended: Simulation | None,
    signals: Sequence[Signals],
    low_pass: LowPass,
    held_out: bool = False,
) -> tuple[ComparedRun, ...]:
    """Return runs beside the simulation, and beside the extended one if any; too short ones are left out."""
    compared = []
    for run in signals:
        planar = simulation.planar_on(run.terrain)
        rows = rows_of(run, planar, simulation.vector, (), low_pass)
        if len(rows.time_s):
            after = (
                None if extended is None else rows_of(run, planar, extended.vector, (), low_pass).predicted
            )
            inputs = {name: rows.inputs[:, i] for i, name in enumerate(INPUTS) if name != "wheel_phase_rad"}
            inputs["time_s"] = rows.time_s
            about = rows.run_id, rows.terrain, held_out, rows.time_s, rows.pace_mps
            compared.append(ComparedRun(*about, rows.measured, rows.predicted, after, inputs))
    return tuple(compared)


def channels_of(runs: Sequence[ComparedRun]) -> list[str]:
    """Return the channels that any run has."""
    return list(measured_channels(runs))


def rms_of(runs: Sequence[ComparedRun], channel: str, extended: bool) -> float:
    """Return the root mean square of measured minus simulated in a channel; NaN where nothing is known."""
    c = CHANNELS.index(channel)
    left = np.concatenate([run.residual(extended)[:, c] for run in runs] or [np.empty(0)])
    known = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def residual_size(run: ComparedRun, noise: Noise) -> float:
    """Return the mean squared residual of a run over that of noise, before; NaN where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = ((run.measured - run.before) / noise.size(run.pace_mps)) ** 2
    known = squared[np.isfinite(squared)]
    return float(known.mean()) if known.size else math.nan


def example_stretch(runs: Sequence[ComparedRun], noise: Noise, span_s: float = STRETCH_S) -> ComparedRun:
    """Return a stretch of a run whose residuals over the noise are larger than most, not the largest."""

    def size(run: ComparedRun) -> float:
        return residual_size(run, noise)

    run = _at_quantile(runs, size)
    starts = np.arange(run.time_s[0], max(run.time_s[-1] - span_s, run.time_s[0]) + 1e-9, STRETCH_STEP_S)
    return _at_quantile([run.part(start, start + span_s) for start in starts], size)


def _at_quantile(runs: Sequence[ComparedRun], size: Callable[[ComparedRun], float]) -> ComparedRun:
    sizes = np.array([size(run) for run in runs])
    order = [i for i in np.argsort(sizes, kind="stable") if np.isfinite(sizes[i])]
    return runs[order[round(EXAMPLE_QUANTILE * (len(order) - 1))]] if order else runs[0]


def strongest_input(runs: Sequence[ComparedRun], channel: str) -> str:
    """Return the input over whose bins the mean residual of a channel, before, is largest beyond its error.

    Raises
    ------
    ValueError
        if there is no run.
    """
    c = CHANNELS.index(channel)
    residuals = [run.residual(False)[:, c] for run in runs]

    def size(name: str) -> float:
        found = binned_means([run.inputs[name] for run in runs], residuals)
        error = np.nan_to_num(found.half_interval) / 1.96
        return float(np.mean(found.mean**2 - error**2)) if found.mean.size else -math.inf

    return max(
        (name for name in runs[0].inputs if spread_of(runs, name) > MIN_SPREAD), key=size, default="time_s"
    )


def spread_of(runs: Sequence[ComparedRun], name: str) -> float:
    """Return the range of an input over all runs, outliers left out; 0 where it is not known."""
    values = np.concatenate([run.inputs[name] for run in runs])
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    low, high = input_range(known)
    return high - low


def telling_runs(runs: Sequence[ComparedRun], noise: Noise, n: int) -> list[ComparedRun]:
    """Return so many runs, from the largest residual over the noise to the smallest."""
    if n <= 0:
        return []
    sizes = np.nan_to_num([residual_size(run, noise) for run in runs], nan=-1.0)
    order = np.argsort(-sizes, kind="stable")
    if n >= len(runs):
        return list(runs)
    places = np.unique(np.linspace(0, len(runs) - 1, n).round().astype(int))
    return [runs[order[place]] for place in places]


def without_levels(noise: Noise, runs: Sequence[ComparedRun]) -> Noise:
    """Return the noise with the size that it has without levels and what depends on an input.

    A whitening filter is fitted to all that no effect explains, so that its size holds a constant offset too;
    ``noise.std`` is of what is left when the probes are taken off as well.
    """
    sizes = np.concatenate([noise.size(run.pace_mps) for run in runs]) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = noise.std**2 / sizes.mean(axis=0)
    return noise._replace(growth=noise.growth * np.minimum(factor, 1.0)[:, None])


# -- Statistics of residuals: their spectra, and their means over bins of an input and over runs -----------

N_BINS = 6
#: Part of an input's values beyond the outer bins on either side: outliers would stretch all of them.
TAIL_RATIO = 0.01

MIN_IN_BIN = 3  #: Least rows of a run in a bin for a mean.
SEGMENT_ROWS = 64  #: Longest segment of a spectrum: some 10 s.
MIN_SEGMENT_ROWS = 8  #: Shortest segment of a spectrum.
COVARIANCE_ROWS = 8192  #: Grid of the spectrum from which the covariance of coloured noise is taken.


class BinnedMeans(NamedTuple):
    """Means of residuals over bins of an input: centres, means and half 95 % intervals (bins,)."""

    centre: Array
    mean: Array
    half_interval: Array


def spectrum(residuals: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies and one-sided density of residuals of several runs, of stretches without a hole.

    The segment length is halved until half of the known rows lie in stretches of that length; where no
    stretch has :data:`MIN_SEGMENT_ROWS`, the density is NaN.
    """
    parts = [part for values in residuals for part in _without_holes(values)]
    n_known = sum(map(len, parts))
    n_rows = SEGMENT_ROWS
    while n_rows > MIN_SEGMENT_ROWS and 2 * sum(len(part) for part in parts if len(part) >= n_rows) < n_known:
        n_rows //= 2
    long = [part for part in parts if len(part) >= n_rows]
    total = np.zeros(n_rows // 2 + 1) if long else np.full(n_rows // 2 + 1, np.nan)
    for part in long:
        total += len(part) * welch(part, rate_hz, nperseg=n_rows, detrend=False)[1]
    frequency = np.fft.rfftfreq(n_rows, 1.0 / rate_hz)
    return frequency[1:], total[1:] / max(sum(map(len, long)), 1)


def noise_spectrum(weights: Array, frequency_hz: Array, rate_hz: float) -> Array:
    """Return the one-sided density of the noise that a whitening filter (order + 1,) turns white."""
    turn = np.exp(-2j * np.pi * np.outer(frequency_hz / rate_hz, np.arange(len(weights))))
    density: Array = 2.0 / rate_hz / np.abs(turn @ weights) ** 2
    return density


def _without_holes(values: Array) -> Iterator[Array]:
    """Yield the stretches of a signal without a hole."""
    known = np.isfinite(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield values[start:end]


def input_range(known: Array) -> tuple[float, float]:
    """Return the range of values without outliers."""
    low, high = np.quantile(known, [TAIL_RATIO, 1.0 - TAIL_RATIO])
    return float(low), float(high)


def binned_means(inputs: Sequence[Array], residuals: Sequence[Array]) -> BinnedMeans:
    """Return the means of residuals in bins of equal width, with intervals over runs.

    Examples
    --------
    >>> x = np.linspace(-0.06, 6.06, 613)
    >>> centres, means, _ = binned_means([x, x], [2 * x, 2 * x + 2])
    >>> centres.round(1), means.round(0)
    (array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]), array([ 2.,  4.,  6.,  8., 10., 12.]))
    """
    known = np.concatenate([x[np.isfinite(x)] for x in inputs])
    nothing = np.empty(0)
    if not known.size:
        return BinnedMeans(nothing, nothing, nothing)
    edges = np.linspace(*input_range(known), N_BINS + 1)
    found = []
    for low, high in itertools.pairwise(edges):
        each = []
        for given, left in zip(inputs, residuals, strict=True):
            inside = (given >= low) & (given < high) & np.isfinite(left)
            if inside.sum() >= MIN_IN_BIN:
                each.append(float(left[inside].mean()))
        n = len(each)
        if n:
            half = student.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n) if n > 2 else math.nan
            found.append(((low + high) / 2, float(np.mean(each)), half))
    return BinnedMeans(*np.array(found).T) if found else BinnedMeans(nothing, nothing, nothing)


def run_means(residuals: Sequence[Array], sizes: Sequence[Array], weights: Array) -> tuple[Array, Array]:
    """Return the mean of each run (m,) and half its 95 % interval, if all but the mean is coloured noise.

    ``sizes`` (m,) are those of the noise, ``weights`` those of the filter that whitens it.
    """
    covariance = np.fft.irfft(1.0 / np.abs(np.fft.rfft(weights, COVARIANCE_ROWS)) ** 2)
    means, halves = [], []
    for left, size in zip(residuals, sizes, strict=True):
        known = np.isfinite(left)
        n = int(known.sum())
        if not n:
            means.append(math.nan)
            halves.append(math.nan)
            continue
        lags = np.arange(1, min(n, COVARIANCE_ROWS // 2))
        spread = (covariance[0] + 2.0 * float(((1.0 - lags / n) * covariance[lags]).sum())) / n
        means.append(float(left[known].mean()))
        halves.append(1.96 * math.sqrt(float((size[known] ** 2).mean()) * max(spread, 0.0)))
    return np.array(means), np.array(halves)
