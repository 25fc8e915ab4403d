"""Runs beside the simulation, before and after causes are built in: for figures and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import welch
from scipy.stats import t as student

from terrain.discrepancy.noise import Noise
from terrain.discrepancy.runs import INPUTS, LowPass, Signals, Simulation, rows_of
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.records import Array
from terrain.signals import true_stretches

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
    #: (m,) of the simulation, by the names of :data:`terrain.discrepancy.runs.INPUTS`, and ``time_s``
    inputs: Mapping[str, Array]
    session: str = ""  #: that the run is part of; empty where that is not known

    def part(self, start_s: float, end_s: float) -> ComparedRun:
        """Return the stretch from start to end."""
        inside = (self.time_s >= start_s) & (self.time_s <= end_s)
        arrays: dict[str, Any] = {
            name: values[inside] for name, values in self._asdict().items() if isinstance(values, np.ndarray)
        }
        return self._replace(**arrays, inputs={name: values[inside] for name, values in self.inputs.items()})

    @property
    def speed_mps(self) -> Array:
        """Speed (m,) that the wheels roll, in any direction."""
        return np.asarray(np.hypot(self.inputs["speed_mps"], self.inputs["sideways_mps"]))

    @property
    def simulated(self) -> Array:
        """Prediction (m, channels) of the extended simulation, or of the one before where nothing was built in."""
        return self.before if self.after is None else self.after

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
        planar, after = simulation.planar_on(run.terrain), None
        rows = rows_of(run, planar, simulation.vector, (), low_pass)
        if not len(rows.time_s):
            continue
        if extended is not None:
            after = rows_of(run, extended.planar_on(run.terrain), extended.vector, (), low_pass).predicted
        inputs = dict(zip(INPUTS, rows.inputs.T, strict=False), time_s=rows.time_s)
        del inputs["wheel_phase_rad"]
        about = rows.run_id, rows.terrain, held_out, rows.time_s, rows.pace_mps
        compared.append(ComparedRun(*about, rows.measured, rows.predicted, after, inputs, run.session))
    return tuple(compared)


def beside_extended(
    run: ComparedRun, signals: Signals, extended: Simulation, low_pass: LowPass
) -> ComparedRun:
    """Return a run that is compared already beside another extended simulation."""
    rows = rows_of(signals, extended.planar_on(signals.terrain), extended.vector, (), low_pass)
    return run._replace(after=rows.predicted)


def rms_of(runs: Sequence[ComparedRun], channel: str, extended: bool) -> float:
    """Return the root mean square of measured minus simulated in a channel; NaN where nothing is known."""
    c = CHANNELS.index(channel)
    left = np.concatenate([run.residual(extended)[:, c] for run in runs] or [np.empty(0)])
    known = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def residual_sizes(runs: Sequence[ComparedRun], noise: Noise) -> Array:
    """Return the mean squared residual of runs (runs,) over that of noise, before; NaN where nothing is known."""
    sizes = []
    for run in runs:
        with np.errstate(invalid="ignore", divide="ignore"):
            squared = ((run.measured - run.before) / noise.size(run.pace_mps)) ** 2
        known = squared[np.isfinite(squared)]
        sizes.append(float(known.mean()) if known.size else math.nan)
    return np.array(sizes)


def example_stretch(runs: Sequence[ComparedRun], noise: Noise) -> ComparedRun:
    """Return a stretch of a run whose residuals over the noise are larger than most, not the largest."""

    def at_quantile(some: Sequence[ComparedRun]) -> ComparedRun:
        sizes = residual_sizes(some, noise)
        n_known = int(np.isfinite(sizes).sum())  # NaN comes last in the order
        place = round(EXAMPLE_QUANTILE * (n_known - 1)) if n_known else 0
        return some[np.argsort(sizes, kind="stable")[place] if n_known else 0]

    run = at_quantile(runs)
    last_s = max(run.time_s[-1] - STRETCH_S, run.time_s[0])
    starts_s = np.arange(run.time_s[0], last_s + 1e-9, STRETCH_STEP_S)
    return at_quantile([run.part(start_s, start_s + STRETCH_S) for start_s in starts_s])


def telling_runs(runs: Sequence[ComparedRun], noise: Noise, n: int) -> list[ComparedRun]:
    """Return so many runs, from the largest residual over the noise to the smallest."""
    if n >= len(runs):
        return list(runs)
    order = np.argsort(-np.nan_to_num(residual_sizes(runs, noise), nan=-1.0), kind="stable")
    places = np.unique(np.linspace(0, len(runs) - 1, n).round().astype(int))
    return [runs[i] for i in order[places]]


def varying_inputs(runs: Sequence[ComparedRun]) -> list[str]:
    """Return the inputs that vary over all runs, outliers left out; the time where none does."""
    names = []
    for name in runs[0].inputs:
        low, high = input_range([run.inputs[name] for run in runs])
        if high - low > MIN_SPREAD:
            names.append(name)
    return names or ["time_s"]


def strongest_input(runs: Sequence[ComparedRun], channel: str) -> str:
    """Return the input over whose bins the mean residual of a channel, before, is largest beyond its error."""
    residuals, sizes = [run.residual(False)[:, CHANNELS.index(channel)] for run in runs], {}
    for name in varying_inputs(runs):
        _, mean, half = binned_means([run.inputs[name] for run in runs], residuals)
        error = np.nan_to_num(half) / 1.96
        sizes[name] = float(np.mean(mean**2 - error**2)) if mean.size else -math.inf
    return max(sizes, key=sizes.__getitem__)


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


def spectrum(residuals: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies and one-sided density of residuals of several runs, of stretches without a hole.

    The segment length is halved until half of the known rows lie in stretches of that length; where no
    stretch has :data:`MIN_SEGMENT_ROWS`, the density is NaN.
    """
    parts = [values[a:b] for values in residuals for a, b in true_stretches(np.isfinite(values))]
    lengths, n_rows = np.array([len(part) for part in parts]), SEGMENT_ROWS
    while n_rows > MIN_SEGMENT_ROWS and 2 * lengths[lengths >= n_rows].sum() < lengths.sum():
        n_rows //= 2
    total = np.full(n_rows // 2 + 1, 0.0 if (lengths >= n_rows).any() else np.nan)
    for part in parts:
        if len(part) >= n_rows:
            total += len(part) * welch(part, rate_hz, nperseg=n_rows, detrend=False)[1]
    frequency = np.fft.rfftfreq(n_rows, 1.0 / rate_hz)
    return frequency[1:], total[1:] / max(int(lengths[lengths >= n_rows].sum()), 1)


def noise_spectrum(weights: Array, frequency_hz: Array, rate_hz: float) -> Array:
    """Return the one-sided density of the noise that a whitening filter (order + 1,) turns white."""
    turn = np.exp(-2j * np.pi * np.outer(frequency_hz / rate_hz, np.arange(len(weights))))
    density: Array = 2.0 / rate_hz / np.abs(turn @ weights) ** 2
    return density


def input_range(inputs: Sequence[Array]) -> tuple[float, float]:
    """Return the range of values without outliers; 0 and 0 where none is known."""
    values = np.concatenate(inputs)
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, [TAIL_RATIO, 1.0 - TAIL_RATIO]) if known.size else (0.0, 0.0)
    return float(low), float(high)


def binned_means(inputs: Sequence[Array], residuals: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return bins of equal width (bins,): centres, means of residuals, and half 95 % intervals over runs.

    Examples
    --------
    >>> x = np.linspace(-0.06, 6.06, 613)
    >>> centres, means, _ = binned_means([x, x], [2 * x, 2 * x + 2])
    >>> centres.round(1), means.round(0)
    (array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]), array([ 2.,  4.,  6.,  8., 10., 12.]))
    """
    edges, rows = np.linspace(*input_range(inputs), N_BINS + 1), []
    for low, high in pairwise(edges):
        each = []
        for given, left in zip(inputs, residuals, strict=True):
            inside = (given >= low) & (given < high) & np.isfinite(left)
            if inside.sum() >= MIN_IN_BIN:
                each.append(float(left[inside].mean()))
        n = len(each)
        if n:
            half = student.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n) if n > 2 else math.nan
            rows.append(((low + high) / 2, float(np.mean(each)), half))
    centre, mean, half = np.array(rows).reshape(-1, 3).T
    return centre, mean, half


def run_means(residuals: Sequence[Array], sizes: Sequence[Array], weights: Array) -> tuple[Array, Array]:
    """Return the mean of each run (m,) and half its 95 % interval, if all but the mean is coloured noise.

    ``sizes`` (m,) are those of the noise, ``weights`` those of the filter that whitens it.
    """
    covariance = np.fft.irfft(1.0 / np.abs(np.fft.rfft(weights, COVARIANCE_ROWS)) ** 2)
    means, halves = np.full((2, len(residuals)), np.nan)
    for i, (left, size) in enumerate(zip(residuals, sizes, strict=True)):
        known = np.isfinite(left)
        if n := int(known.sum()):
            lags = np.arange(1, min(n, COVARIANCE_ROWS // 2))
            spread = (covariance[0] + 2.0 * float(((1.0 - lags / n) * covariance[lags]).sum())) / n
            means[i] = left[known].mean()
            halves[i] = 1.96 * math.sqrt(float((size[known] ** 2).mean()) * max(spread, 0.0))
    return means, halves


# -- By which factor, or level, measured and simulated are apart in a channel: a slope through zero, robust ----

#: A factor or a level is stated where it is off by so many standard deviations over runs.
CLEAR_STDS = 3.0
#: Distance of a run from the others, in their standard deviations, beyond which it is far out.
OUTLIER_STDS = 3.0
LEAST_OFF = 0.03  #: Least ratio by which a factor is off: below it a sentence has nothing to state.
#: Least part of the absolute residual that a factor or a level has to remove, to describe it.
EXPLAINS = 0.15
LEVEL_RATIO = 0.3  #: Least ratio of the residual's root mean square that a level has to be.
#: Terrains differ if their factors are so many standard deviations apart, the two furthest of several, and by that
#: ratio.
APART_STDS, APART_RATIO = 4.0, 0.05


class Slope(NamedTuple):
    """Measured over simulated, by a slope through zero, or by a level."""

    ratio: float = math.nan  #: NaN where it is not clear from 1, or does not describe the residual
    std: float = math.nan  #: over runs
    level: float = math.nan
    """Measured minus simulated, in the channel's unit; NaN where a factor is stated or none clear."""


def slope_through_zero(simulated: Array, measured: Array) -> float:
    """Return the slope ``b`` that minimises ``sum |measured - b simulated|``; NaN where nothing is simulated.

    It is the median of ``measured / simulated``, each weighted by ``|simulated|``, of rows (n,) without NaN.

    Examples
    --------
    >>> x = np.array([1.0, -2.0, 3.0, 4.0])
    >>> slope_through_zero(x, 0.4 * x + np.array([0.0, 0.0, 9.0, 0.0]))
    0.4
    """
    weight = np.abs(simulated)
    seen = weight > 0.0
    if not seen.any():
        return math.nan
    ratio, weight = measured[seen] / simulated[seen], weight[seen]
    order = np.argsort(ratio, kind="stable")
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, total[-1] / 2.0)])


def slopes_of(runs: Sequence[ComparedRun]) -> dict[str, Slope]:
    """Return the slope of measured on simulated by channel, over all rows of some runs, before."""
    slopes = {}
    for c, channel in enumerate(CHANNELS):
        pairs = []
        for run in runs:
            seen = np.isfinite(run.before[:, c]) & np.isfinite(run.measured[:, c])
            if seen.any():
                pairs.append((run.before[seen, c], run.measured[seen, c]))
        if not pairs:
            continue
        x, y = np.concatenate([x for x, _ in pairs]), np.concatenate([y for _, y in pairs])
        ratio, off = slope_through_zero(x, y), y - x
        most = (1.0 - EXPLAINS) * np.abs(off).sum()  # that a factor or a level leaves
        ratios, levels = np.array(
            [(slope_through_zero(*pair), np.median(pair[1] - pair[0])) for pair in pairs]
        ).T
        std = _std_of_mean(ratios - ratio, np.array([np.abs(x).sum() for x, _ in pairs]))
        level, rms = float(np.median(off)), float(np.sqrt(np.mean(off**2)))
        level_std = _std_of_mean(levels - level, np.array([float(x.size) for x, _ in pairs]))
        if abs(ratio - 1.0) > max(CLEAR_STDS * std, LEAST_OFF) and np.abs(y - ratio * x).sum() < most:
            slopes[channel] = Slope(ratio, std)
        elif abs(level) > max(CLEAR_STDS * level_std, LEVEL_RATIO * rms) and np.abs(off - level).sum() < most:
            slopes[channel] = Slope(level=level)
        else:
            slopes[channel] = Slope()
    return slopes


def _std_of_mean(off: Array, weight: Array) -> float:
    """Return the standard deviation of a weighted mean by how far runs (n,) are from it.

    A run that is far out, as a stalled one, hardly moves a median, and counts as one at the edge.
    """
    known = np.isfinite(off) & (weight > 0.0)
    if known.sum() < 2:
        return math.inf
    edge = OUTLIER_STDS * 1.48 * float(np.median(np.abs(off[known])))
    off = np.clip(off, -edge, edge)
    return float(np.sqrt(((weight * off)[known] ** 2).sum()) / weight[known].sum())


def terrains_apart(channels: Sequence[str], used: Sequence[ComparedRun]) -> Mapping[str, Slope]:
    """Return measured over simulated by terrain where terrains clearly differ; empty where they do not.

    They are compared in the channels where runs differ; with runs of one label, or runs that are alike, nothing is
    compared.
    """
    labels = sorted({run.terrain for run in used if run.terrain})
    if not channels or len(labels) < 2:
        return {}
    of_label = {label: slopes_of([run for run in used if run.terrain == label]) for label in labels}
    for channel in dict.fromkeys(channels):
        slopes = {label: slopes.get(channel, Slope()) for label, slopes in of_label.items()}
        known = {label: slope for label, slope in slopes.items() if math.isfinite(slope.std)}
        if len(known) > 1:
            low, *_, high = sorted(known.values(), key=lambda slope: slope.ratio)
            least = max(APART_STDS * math.hypot(low.std, high.std), APART_RATIO * abs(low.ratio))
            if high.ratio - low.ratio > least:
                return known
    return {}


# -- What sentences call channels, and what a simulation does that is off in one ---------------------------

#: A factor from the first is stated as "2.5 times", below it in percent; over the second it is not stated.
TIMES, MOST_TIMES = 1.5, 20.0

#: What a channel is called, and its unit.
CHANNEL_WORDS = {
    GYRO: ("yaw rate (gyro)", "rad/s"),
    SPEED_X: ("speed ahead", "m/s"),
    SPEED_Y: ("sideways speed", "m/s"),
    ACCEL: ("accelerometer ahead", "m/s²"),
    CURRENT: ("sum of the motor currents", "A"),
    TURNING_CURRENT: ("right minus left motor current", "A"),
    HEADING: ("yaw rate over ground", "rad/s"),
}
#: Inputs of the simulation as axes call them.
INPUT_LABELS = {
    "speed_mps": "speed [m/s]",
    "turn_mps": "turn [m/s]",
    "steer_rad": "steering [rad]",
    "grade_rad": "grade [rad]",
    "roll_rad": "roll [rad]",
    "force_ratio": "force [weight]",
    "sideways_mps": "sideways speed [m/s]",
    "time_s": "time [s]",
}
#: What a simulation does with too much of it and too little, and with too low a level.
OFF_WORDS = {
    **dict.fromkeys(CHANNEL_WORDS, ("simulated, it is", "large", "small", "small")),
    **dict.fromkeys((GYRO, HEADING), ("the simulation turns", "fast", "slowly", "slow")),
    SPEED_X: ("the simulation drives", "fast", "slowly", "slow"),
}


def off_by(channel: str, ratio: float, level: float = math.nan) -> str:
    """Return by which factor (measured over simulated) or level (measured minus simulated) a channel is off.

    Examples
    --------
    >>> off_by("yaw_rate_radps", 0.4), off_by("speed_x_mps", 1.05)
    ('the simulation turns 2.5 times too fast', 'the simulation drives 4.8 % too slowly')
    >>> off_by("current_a", math.nan, 1.98)
    'simulated, it is 2 A too small throughout'
    """
    verb, more, less, low = OFF_WORDS[channel]
    if not math.isfinite(ratio):
        size = f"{abs(level):.2g} {CHANNEL_WORDS[channel][1]}"
        if channel in (GYRO, HEADING, SPEED_Y):  # a level to one side is no lack of turning
            return f"measured is {size} more to the {'left' if level > 0 else 'right'} throughout"
        is_off = verb if more == "large" else "the simulation is"
        return f"{is_off} {size} too {low if level > 0 else more} throughout"
    if ratio < 0.0:
        return f"{verb} of the wrong sign" if more == "large" else f"{verb} backward"
    times = max(ratio, 1.0 / max(ratio, 1e-9))
    if times < TIMES:
        size = f"{100.0 * abs(1.0 / ratio - 1.0):.2g} %"
    else:
        size = f"{times:.2g} times" if times <= MOST_TIMES else f"more than {MOST_TIMES:g} times"
    return f"{verb} {size} too {more if ratio < 1.0 else less}"
